"""The command `python -m zwfs.frames`: calibrate a bench, and reconstruct camera files of any length."""

from __future__ import annotations

import argparse
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zwfs.frames.calibration import Calibration
from zwfs.frames.telemetry import reconstruct

_PERIOD = 10.0  # second between two lines of progress where there is no terminal
_FILES: Any = {"nargs": "+", "metavar": "FILE"}
_EXIT_CODES = """exit codes:
  0    complete
  1    a file or a value was refused, or the disk is full; the message names the cause
  2    the command line is wrong
  3    complete, but frames are flagged (only with --strict)
  130  interrupted; the same `reconstruct` goes on from there"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, by default with the arguments of the command line, and return its exit code."""
    options = vars(_parser().parse_args(arguments))
    run = options.pop("run")
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return run(**options)
    except KeyboardInterrupt:
        print(f"\ninterrupted{': the same command goes on from there' * (run is _reconstruct)}", file=sys.stderr)
        return 130
    except (OSError, ValueError, TypeError, ImportError) as error:
        message = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        name = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        print(f"error: {name}{message}", file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGTERM, previous)


def _parser() -> argparse.ArgumentParser:
    shared: dict[str, Any] = {"epilog": _EXIT_CODES, "formatter_class": argparse.RawDescriptionHelpFormatter}
    about = "Camera files of a phase-shifted Zernike wavefront sensor to phases."
    parser = argparse.ArgumentParser(prog="python -m zwfs.frames", description=about, **shared)
    commands = parser.add_subparsers(required=True, metavar="command")
    about = "make a calibration from frames and clear frames"
    _add_calibrate(commands.add_parser("calibrate", help=about, **shared))
    _add_reconstruct(commands.add_parser("reconstruct", help="reconstruct camera files of any length", **shared))
    return parser


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    """Add the options of `calibrate`; those without a value stay away from `Calibration.from_files`."""
    absent: Any = argparse.SUPPRESS
    parser.set_defaults(run=_calibrate)
    add = parser.add_argument
    add("output", help="calibration to write, NPZ")
    add("--frames", dest="frame_files", required=True, help="a frame, or one for each image", **_FILES)
    add("--pupils", dest="pupil_files", required=True, help="clear frames, likewise", **_FILES)
    add("--dark", dest="dark_files", default=(), help="counts without light", **_FILES)
    add("--pupil-dark", dest="pupil_dark_files", default=(), help="that of the clear frames", **_FILES)
    add("--images", dest="n_images", type=int, metavar="N", help="of an exposure, 1 or 2; default: from the files")
    add("--bad-pixels", dest="bad_pixel_files", default=(), help="maps, not 0 where bad", **_FILES)
    add("--diameter", type=float, default=0.0, help="of the dimple in lambda/D; default: DIMPLE")
    shifts: Any = {"type": float, "nargs": "+", "default": (), "metavar": "RAD"}
    add("--phase-shifts", help="default: THETA1, THETA2", **shifts)
    add("--pupil-centers", type=float, nargs="+", metavar="PIXEL", help="row, column of each pupil")
    add("--pupil-diameter", type=float, metavar="PIXEL", help="default: from the clear frames")
    trust: Any = {"dest": "subpixel", "action": "store_false", "default": absent}
    add("--no-registration", help="trust the outlines", **trust)
    add("--exposure", type=float, default=absent, help="of frames over that of clear frames; default: EXPTIME")
    add("--saturation", type=float, metavar="COUNTS", help="default: SATURATE, or the type's largest")
    add("--fit", dest="fitted", nargs="+", default=(), metavar="NAME", help="parameter to fit")
    add("--commands", metavar="FILE", help="known phases of the frames, radian: fit the bench with them")
    add("--noise", type=float, metavar="COUNTS", help="rms of a pixel without light; default: from the frames")
    add("--gain", type=float, default=1.0, metavar="ELECTRONS", help="of a count; both with --commands")
    add("--iterations", dest="n_iterations", type=int, default=25, metavar="N", help="default: 25")
    add("--tolerance", type=float, default=1e-3, metavar="RAD", help="that ends them; default: 1e-3")
    add("--quiet", action="store_true", help="no steps of a fit")


def _add_reconstruct(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_reconstruct)
    add = parser.add_argument
    add("frames", nargs="+", help="FITS or NPY files with frames")
    add("--calibration", required=True, metavar="FILE", help="that `calibrate` wrote")
    add("--output", "-o", required=True, metavar="FILE", help="FITS file to write")
    add("--second", dest="second_frames", default=(), help="of the second images", **_FILES)
    add("--modes", type=int, metavar="N", help="write coefficients of N Zernike modes, not phases")
    add("--phases", action="store_true", default=None, help="write phases, too")
    add("--photons", type=float, help="per pixel at an intensity of 1: write standard errors")
    add("--read-noise", type=float, default=0.0, metavar="ELECTRONS", help="rms per pixel")
    add("--wavelength", type=float, metavar="NM", help="for the header; default: WAVELEN")
    add("--keywords", nargs="+", default=(), metavar="KEY", help="of the headers, for the table")
    add("--saturation", type=float, metavar="COUNTS", help="default: that of the calibration")
    add("--largest-residual", type=float, metavar="RMS", help="of a consistent frame")
    add("--follow", action="store_true", help="move images back that have moved since the calibration")
    add("--workers", dest="n_workers", type=int, metavar="N", help="default: one for each core")
    add("--restart", action="store_true", help="drop the part of an interrupted run")
    add("--overwrite", action="store_true", help="replace any file")
    add("--strict", action="store_true", help="exit with 3 if frames are flagged")
    add("--quiet", action="store_true", help="no progress and no summary")


def _calibrate(output: str, pupil_centers: Sequence[float] | None, quiet: bool, **settings: Any) -> int:
    pairs = range(0, len(pupil_centers or ()), 2)
    centers = None if pupil_centers is None else [pupil_centers[first : first + 2] for first in pairs]
    with warnings.catch_warnings(record=True) as remarks:
        try:
            calibration = Calibration.from_files(
                **settings, pupil_centers=centers, progress=None if quiet else _Progress()
            )
        finally:
            if settings["commands"] and not quiet and sys.stderr.isatty():
                print(file=sys.stderr)
    for remark in remarks:
        print(f"warning: {remark.message}", file=sys.stderr)
    calibration.save(output)
    print(
        f"{output}: pupil {calibration.diameter:.2f} pixels wide, residual of the frames "
        f"{calibration.residual:.3f}, counts at an intensity of 1: {calibration.unit[0]:.6g} and "
        f"{calibration.unit[1]:.6g}"
    )
    return 0


def _reconstruct(output: str, strict: bool, quiet: bool, **settings: Any) -> int:
    summary = reconstruct(output=output, progress=None if quiet else _Progress().frames, **settings)
    if not quiet:
        flags = ", ".join(f"{n} {name.lower().replace('_', ' ')}" for name, n in summary.counts.items() if n)
        flags = f": {flags}" if flags else ""
        print(f"{Path(output)}: {summary.n_frames} frames, {summary.n_flagged} flagged{flags}")
    return 3 if strict and summary.n_flagged else 0


class _Progress:
    """Progress on stderr: on a terminal in one place, elsewhere a line after each `_PERIOD`."""

    def __init__(self) -> None:
        self._said = time.monotonic()

    def __call__(self, text: str) -> None:
        """Report a step."""
        if sys.stderr.isatty():
            print(f"\r{text:<60}", end="", file=sys.stderr, flush=True)
        elif time.monotonic() - self._said > _PERIOD:
            print(text, file=sys.stderr, flush=True)
            self._said = time.monotonic()

    def frames(self, done: int, total: int) -> None:
        """Report the number of finished frames."""
        width = 40 * done // total if sys.stderr.isatty() else 0
        bar = f"[{'#' * width}{'.' * (40 - width)}] " if sys.stderr.isatty() else ""
        self(f"{bar}{done} of {total} frames")
        if bar and done == total:
            print(file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
