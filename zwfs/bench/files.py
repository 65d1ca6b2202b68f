"""Camera files of the simulated bench, and the error of a phase reconstructed from them."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._system import is_there, path_of, write_file
from zwfs.bench.model import Bench, Seed, segment_pistons, segment_residual
from zwfs.frames._fits import fits_content, fits_module, has_card
from zwfs.frames.phases import Phases

_BENCH_CARD = b"ORIGIN  = 'zwfs"  # header card of the files: no others are replaced
_FULL = 50_000  # counts of the brightest pixel of a simulated 16-bit camera


def write_bench(
    folder: str | Path,
    bench: Bench,
    pistons: ArrayLike | None = None,
    *,
    wavelength: float = 635.0,
    n_bad: int = 0,
    seed: Seed = None,
) -> dict[str, Path]:
    """Let the simulated bench write what a camera would: 16-bit FITS files with both pupils on one image.

    Parameters
    ----------
    folder : str or Path
        It must exist. Files that `write_bench` wrote earlier are replaced.
    bench : Bench
        With a number of photons.
    pistons : as for `Bench.commanded_phase`, optional
        Flat if left out.
    wavelength : float, nm
        For the headers.
    n_bad : int
        Bad pixels of the camera: half of them dark and named by the bad-pixel map, half of them saturated.
    seed : int, Generator or SeedSequence, optional
        Of the noise and of the bad pixels.

    Returns
    -------
    dict of Path
        "frame", "pupils", "dark" and "bad_pixels".

    Raises
    ------
    ImportError
        If astropy is missing.
    ValueError
        If the folder holds another file of the same name.

    Examples
    --------
    >>> import tempfile
    >>> from zwfs.bench.model import Bench
    >>> from zwfs.bench.files import write_bench
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = write_bench(folder, Bench(n_pixels=40), seed=1)
    ...
    >>> sorted(paths)
    ['bad_pixels', 'dark', 'frame', 'pupils']
    """
    fits_module()
    _check.instance("bench", bench, Bench)
    wavelength = _check.number("wavelength", wavelength, 0, open_low=True)
    n_bad = _check.integer("n_bad", n_bad, 0, 2 * math.prod(bench.segments.shape))
    rng = _check.generator("seed", seed)
    if pistons is not None:
        pistons = _check.real_array("pistons", pistons)
        if pistons.ndim != 1:
            raise ValueError(f"pistons has shape {pistons.shape}: expected ({bench.n_segments},), one command")
    folder = path_of("folder", folder)
    if not os.path.isdir(folder):
        raise ValueError(f"folder = {str(folder)!r}: expected a folder that exists")
    paths = {name: folder / f"{name}.fits" for name in ("frame", "pupils", "dark", "bad_pixels")}
    for path in paths.values():
        if is_there(path) and not (path.is_file() and has_card(path, _BENCH_CARD)):
            raise ValueError(
                f"folder = {str(folder)!r} holds a {path.name} that the simulated bench did not write: "
                "expected another folder"
            )
    counts = {"frame": bench.frames(pistons, rng), "pupils": bench.clear_frames(rng), "dark": bench.dark(rng)}
    gain = _FULL / max(pair.max() for pair in counts.values())
    shape = np.concatenate(counts["frame"], axis=-1).shape
    places = rng.choice(shape[0] * shape[1], n_bad, replace=False)
    dead = np.zeros(shape, np.uint8)
    dead.flat[places[: n_bad // 2]] = 1
    origin = ("ORIGIN", "zwfs", "simulated bench")
    cards = [
        ("BUNIT", "adu", ""),
        ("WAVELEN", wavelength, "[nm] wavelength"),
        ("DIMPLE", bench.diameter, "[lambda/D] diameter of the dimple by design"),
        ("THETA1", bench.phase, "[rad] phase shift of the left image"),
        ("THETA2", -bench.phase, "[rad] phase shift of the right image"),
        ("SATURATE", 65535, "[adu] pixels that reach it are saturated"),
        ("EGAIN", 1 / gain, "[electron/adu] gain"),
        ("RDNOISE", bench.read_noise, "[electron] read noise"),
        origin,
    ]
    for name, pair in counts.items():
        image = np.clip(np.rint(np.concatenate(pair, axis=-1) * gain), 0, 65535).astype(np.uint16)
        image[dead > 0] = 0
        image.flat[places[n_bad // 2 :]] = 65535
        write_file(paths[name], fits_content((image, "", cards)))
    write_file(paths["bad_pixels"], fits_content((dead, "", [origin])))
    return paths


def bench_error(bench: Bench, commanded: ArrayLike, phase: Phases, flat: Phases | None = None) -> float:
    """Rms error of the segment pistons in the phase of frames that `write_bench` wrote, radian.

    Parameters
    ----------
    bench : Bench
    commanded : array_like, shape (n_segments,), radian
    phase : Phases
    flat : Phases, optional
        Phase of the flat mirror, whose pistons are subtracted.
    """
    _check.instance("bench", bench, Bench)
    _check.instance("phase", phase, Phases)
    pistons = _pistons(bench, phase)
    if flat is not None:
        _check.instance("flat", flat, Phases)
        pistons = pistons - _pistons(bench, flat)
    return float(segment_residual(pistons, commanded).std())


def _pistons(bench: Bench, phase: Phases) -> NDArray[np.float64]:
    registered = phase.agreement.measurement.registered
    canvas = np.full(registered.clear_frames[0].counts.shape, np.nan)
    row, column = registered.corner
    canvas[row : row + registered.n_pixels, column : column + registered.n_pixels] = phase.phase
    # The pupil stands in the middle of the left half of the image.
    ny, nx = bench.segments.shape
    top = (len(canvas) - ny) // 2
    return segment_pistons(canvas[top : top + ny, top : top + nx], bench.segments, bench.numbers)
