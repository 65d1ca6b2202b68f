"""Telemetry in bulk: camera files of any length to phases or coefficients, with a table of all frames.

`python -m zwfs.frames` is the command for it.
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._system import one_thread, path_of, paths_of
from zwfs.frames._blocks import FileError
from zwfs.frames._fits import card_value, fits_module
from zwfs.frames._follow import checked_follow
from zwfs.frames._part import Cards, Part, Unit
from zwfs.frames._stack import Stack
from zwfs.frames.calibration import Calibration
from zwfs.frames.files import SHORTEST, check_output, sensor_cards
from zwfs.frames.phases import Flag, Phases
from zwfs.modes import zernike_basis

_CHUNK = 2**24  # bytes of camera images that a thread handles at once
_LONGEST = 256  # exposures of them
# Cards of the input that describe its own data.
_OWN = ("SIMPLE", "XTENSION", "BITPIX", "NAXIS", "EXTEND", "EXTNAME", "PCOUNT", "GCOUNT", "BSCALE", "BZERO",
        "BLANK", "BUNIT", "CHECKSUM", "DATASUM", "COMMENT", "HISTORY", "CONTINUE", "END", "")  # fmt: skip
# Card of the first header with the number of frames that have a flag, and its comment.
_COUNTS = {
    "LOST": ("NLOST", "lost frames"),
    "BAD_PIXELS": ("NBADPIX", "frames with more bad pixels"),
    "SATURATED": ("NSATURAT", "frames with saturated pixels"),
    "INCONSISTENT": ("NINCONS", "inconsistent frames"),
    "NOT_CONVERGED": ("NNOTCONV", "frames that did not converge"),
    "MOVED": ("NMOVED", "frames on which the pupil has moved"),
}


@dataclass(frozen=True)
class Summary:
    """Result of `reconstruct`.

    Attributes
    ----------
    output : Path
    n_frames, n_flagged : int
        All frames, and those with a flag.
    counts : dict
        Number of frames with each flag, by its name.
    n_resumed : int
        Frames that an interrupted run had done.
    """

    output: Path
    n_frames: int
    n_flagged: int
    counts: dict[str, int]
    n_resumed: int

    def __post_init__(self) -> None:
        _check.declared(self)


def reconstruct(
    frames: str | Path | Sequence[str | Path], calibration: Calibration | str | Path, output: str | Path, *,
    second_frames: str | Path | Sequence[str | Path] = (), modes: int | ArrayLike | None = None,
    phases: bool | None = None, photons: float | None = None, read_noise: float = 0.0,
    wavelength: float | None = None, keywords: Sequence[str] = (), saturation: float | None = None,
    largest_residual: float | None = None, n_workers: int | None = None, restart: bool = False,
    overwrite: bool = False, progress: Callable[[int, int], Any] | None = None, follow: bool = False,
) -> Summary:  # fmt: skip
    """Reconstruct all frames of camera files, and write phases or coefficients with a table as FITS.

    The files may be larger than the memory. The output appears when it is complete. An interrupted run keeps the
    file `.NAME.part` next to it. The same call goes on from there, and the file has the same bytes as that of an
    undisturbed run. Damaged data of that file are named by a warning, and computed again. No frame is left out:
    frames that cannot be reconstructed are NaN, and flagged in the table.

    Parameters
    ----------
    frames : path, or sequence of paths
        FITS or NPY files: cubes (n, ny, nx), or (n, 2, ny, nx) where an exposure has two images, or single
        exposures. Two FITS units of one shape are the two images of an exposure, if it has two. Brackets choose a
        unit: ``cube.fits[1]``.
    calibration : Calibration or path
    output : path
        FITS file. An earlier phase map or telemetry file is replaced.
    second_frames : path, or sequence of paths, optional
        Files with the second images, as many as `frames`.
    modes : int, or array_like, shape (n_modes, ny, nx), optional
        Modes whose coefficients go to the table: that many Zernike modes, or maps on the grid of the pupil.
    phases : bool, optional
        Whether to write the phases; by default only without modes.
    photons : float, optional
        Photons that an intensity of 1 puts into a pixel: adds the standard error of all phases or coefficients,
        see `Calibration.sigma`. It takes several times as long as the phases.
    read_noise : float, electrons rms / pixel
    wavelength : float, nm, optional
        For the header, which then holds the nm of a radian; by default WAVELEN of the first file if above 10.
    keywords : sequence of str
        Keywords of the headers that become columns of the table; each file must have them.
    saturation : float, counts, optional
        By default that of the calibration, SATURATE of the first header, or the largest number of an integer type.
    largest_residual : float, optional
        See `Calibration.__call__`.
    n_workers : int, optional
        Threads; by default one for each core.
    restart : bool
        Whether to drop the part of an earlier run.
    overwrite : bool
        Whether `output` may be any file but an input or the calibration.
    progress : callable, optional
        Called with the number of frames that are done, and of all frames.
    follow : bool
        Whether images that have moved since the calibration are moved back, see `Calibration.__call__`.

    Raises
    ------
    FileNotFoundError, ImportError
        If a file or astropy is missing.
    FileError
        A ValueError: if a file is broken, truncated, of another shape, unit or type, or lacks a keyword.
    ValueError
        If `check_output` refuses the output, or something that zwfs did not make has the name of that file.
    OSError
        If there is no space for the output.

    Examples
    --------
    >>> import tempfile
    >>> from zwfs.bench import Bench, write_bench
    >>> from zwfs.frames import Calibration, reconstruct
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = write_bench(folder, Bench(n_pixels=40), seed=1)
    ...     calibration = Calibration.from_files([files["frame"]], [files["pupils"]], [files["dark"]])
    ...     summary = reconstruct(files["frame"], calibration, f"{folder}/phases.fits", n_workers=1)
    ...
    >>> summary.n_frames, summary.n_flagged
    (1, 0)
    """
    fits_module()
    files, second_files = (
        [path_of(name, paths)] if isinstance(paths, str | os.PathLike) else paths_of(name, paths)
        for name, paths in (("frames", frames), ("second_frames", second_frames))
    )
    if not files:
        raise ValueError("frames is empty: expected a file")
    inputs = [*files, *second_files]
    if not isinstance(calibration, Calibration):
        inputs.append(path_of("calibration", calibration))
        calibration = Calibration.load(calibration)
    path = check_output(output, inputs, overwrite=overwrite)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    n_workers = cores if n_workers is None else _check.integer("n_workers", n_workers, 1, 256)
    stack = Stack(files, second_files, calibration.n_images, calibration.shape)
    if largest_residual is not None:
        largest_residual = _check.number_or_inf("largest_residual", largest_residual)
    settings = modes, phases, photons, read_noise, wavelength, keywords, saturation, largest_residual, follow
    job = _Job(stack, calibration, *settings)
    report = _check.callback("progress", progress)
    pieces = _spans(stack.n, job.chunk)
    part = Part(path, job.units, pieces, job.plan(), _check.flag("restart", restart))
    try:
        n_resumed = done = sum(stop - first for first, stop in part.done)
        report(done, stack.n)
        names = [(card_value(block.name), n) for block, n in zip(stack.firsts, stack.lengths, strict=True)]
        part.write(job.files, 0, np.array(names, job.files.dtype))
        for first, stop in job.run(part, n_workers):
            part.note(first, stop)
            done += stop - first
            report(done, stack.n)
        summary = job.counted(part, path, n_resumed)
        check_output(path, inputs, overwrite=overwrite)  # again: the run may have taken hours
        part.finish()
        return summary
    finally:
        part.close()


class _Job:
    """Checked arguments of a run, and the units of its output: the table, and the list of files, come last."""

    def __init__(
        self, stack: Stack, calibration: Calibration, modes: Any, phases: Any, photons: Any, read_noise: Any,
        wavelength: Any, keywords: Any, saturation: Any, largest_residual: float | None, follow: bool,
    ) -> None:  # fmt: skip
        self.stack, self.calibration, pupil = stack, calibration, calibration.sensor.pupil
        self.largest_residual, self.follow = largest_residual, checked_follow(follow, calibration)
        for block in stack.firsts:
            unit, own = str(block.header.get("BUNIT", "")).strip(), calibration.bunit.strip()
            if own and unit and unit.lower() != own.lower():
                raise FileError(f"{block.name}: BUNIT = {unit!r}: expected {own!r}, that of the calibration")
        self.modes = zernike_basis(pupil, modes) if isinstance(modes, int) else modes
        self.matrix = None if modes is None else calibration.modal_matrix(self.modes)
        phases = modes is None if phases is None else _check.flag("phases", phases)
        if not phases and modes is None:
            raise ValueError("phases = False: expected True, or modes")
        self.read_noise = _check.number("read_noise", read_noise, 0)
        self.photons: Any = None if photons is None else _check.number("photons", photons, 1e-6, 1e12)
        if read_noise and photons is None:
            raise ValueError(f"read_noise = {read_noise:g}: expected a number of photons with it")
        if wavelength is not None:
            wavelength = _check.number("wavelength", wavelength, 0, open_low=True)
        elif isinstance(stated := stack.header.get("WAVELEN"), int | float) and SHORTEST < stated < np.inf:
            wavelength = stated  # the phases need none, so any other value is left alone
        level = calibration.saturation if saturation is None else saturation
        if saturation is None and level == np.inf:
            level = stack.saturation
        self.saturation = _check.number_or_inf("saturation", level, open_low=True)
        self.keywords = _columns(stack, keywords)
        names = max(len(card_value(block.name)) for block in stack.firsts)
        of_files = np.dtype([("NAME", f"S{names}"), ("FRAMES", ">i8")])
        self.files = Unit("FILES", of_files, (), len(stack.firsts), [], {})
        self.has_sigma = phases and photons is not None
        units = dict.fromkeys(("COEFFS", "SIGCOEFF", "SIGMA"), "rad")
        self.table = Unit("FRAMES", self._row_type(), (), stack.n, [], units)
        cards, float32 = self._cards(wavelength), np.dtype(">f4")
        maps = [Unit("", np.dtype("u1"), (), 0, cards, {})]
        if phases:
            cards = [("BUNIT", "rad", "in (-pi, pi]; NaN outside, bad and lost"), *cards]
            maps = [Unit("", float32, pupil.shape, stack.n, cards, {})]
        if self.has_sigma:
            maps.append(Unit("SIGMA", float32, pupil.shape, stack.n, [("BUNIT", "rad", "")], {}))
        self.units = [*maps, self.table, self.files]

    def _row_type(self) -> np.dtype:
        columns: list[tuple] = [
            ("FRAME", ">i8"), ("FILE", ">i4"), ("INDEX", ">i8"), ("FLAGS", ">i2"), ("FLUX", ">f4"),
            ("RESIDUAL", ">f4"), ("SHIFT", ">f4", (2,)), ("BACKGR", ">f4", (2,)),
            ("NBAD", ">i4"), ("NSATUR", ">i4"), ("NITER", ">i4"),
        ]  # fmt: skip
        columns += [("SIGMA", ">f4")] * self.has_sigma
        if self.matrix is not None:
            coefficients = ">f4", self.matrix.shape[1:]
            columns += [("SIGCOEFF", *coefficients)] * (self.photons is not None) + [("COEFFS", *coefficients)]
        columns += [(name, values.dtype.newbyteorder(">")) for name, values in self.keywords.items()]
        names = [name for name, *_ in columns]
        if repeated := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"keywords: {sorted(repeated)} are columns already: expected others")
        return np.dtype(columns)

    def _cards(self, wavelength: float | None) -> Cards:
        """Cards of the first header: numbers of the run, then those of the first file."""
        from zwfs import __version__

        stack, calibration = self.stack, self.calibration
        place = calibration.places[0, :, 0, 0]
        row, column = np.rint(place).astype(int).tolist()
        cards: list[tuple[str, Any, str]] = [
            ("CREATOR", f"zwfs {__version__}", ""),
            ("NFRAMES", stack.n, "frames, all of them in the table"),
            ("NFILES", len(stack.firsts), ""),
            *((key, 0, comment) for key, comment in _COUNTS.values()),
            ("NFLAGGED", 0, "frames with any flag"),
            ("RESCALIB", calibration.residual, "residual of the frames of the calibration"),
            ("CALIBSHA", calibration.sha256, ""),
            ("MAPFRAME", "commands" if calibration.commanded else "first image", "frame of reference of the maps"),
            ("CROPROW", row, "[pixel] row where maps begin, from 0"),
            ("CROPCOL", column, "[pixel] its column, on the first image"),
            ("OFFROW", round(place[0] - row, 6), "[pixel] exact row of the first point - CROPROW"),
            ("OFFCOL", round(place[1] - column, 6), "[pixel] exact column of it - CROPCOL"),
            *sensor_cards(calibration.diameter, calibration.center, calibration.optics),
            ("SATURATE", self.saturation, "[count] pixels that reach it are saturated"),
            ("MAXITER", calibration.n_iterations, "largest number of iterations"),
            ("TOLERANC", calibration.tolerance, "[rad] change that ends the iteration"),
            ("FOLLOW", self.follow, "whether images that have moved are moved back"),
        ]
        if wavelength is not None:
            cards += [
                ("WAVELEN", wavelength, "[nm]"),
                ("NMPERRAD", wavelength / (2 * math.pi), "[nm] of a radian"),
            ]
        if self.photons is not None:
            cards += [
                ("PHOTONS", self.photons, "per pixel at an intensity of 1"),
                ("RDNOISE", self.read_noise, "[e-] rms"),
            ]
        own = {key for key, *_ in cards}
        for key, value in stack.header.items():
            plain = isinstance(value, str | bool | int | float)
            if plain and key not in own and key not in _OWN and not key.startswith("NAXIS"):
                cards.append((key, value, "of the first file" if len(str(value)) < 40 else ""))
        return cards

    def plan(self) -> str:
        """All that decides the bytes of the output."""
        settings = [self.photons, self.read_noise, self.saturation, self.largest_residual, self.follow, self.chunk]
        modes = None if self.modes is None else zlib.crc32(np.ascontiguousarray(self.modes).tobytes())
        headers = [unit.header().hex() for unit in self.units]
        state = self.stack.state(), self.calibration.sha256, settings, modes, headers
        return json.dumps(state, default=str)

    @property
    def chunk(self) -> int:
        """Exposures that a thread handles at once."""
        return max(1, min(_LONGEST, _CHUNK // self.stack.bytes_per_exposure))

    def run(self, part: Part, n_workers: int) -> Iterator[tuple[int, int]]:
        """Reconstruct all chunks that are not yet done: first frame of each, and first one after it."""
        chunks = [piece for piece in part.pieces if piece not in part.done]
        with one_thread(), ThreadPoolExecutor(n_workers) as pool:
            yield from pool.map(partial(self._reconstruct, part), chunks)

    def counted(self, part: Part, output: Path, n_resumed: int) -> Summary:
        """Count all flags, and put their numbers into the header."""
        table, counts, n_flagged = self.table, dict.fromkeys(_COUNTS, 0), 0
        for first, stop in _spans(self.stack.n, max(1, _CHUNK // table.row)):
            flags = part.read(table, first, stop)["FLAGS"]
            n_flagged += int(np.count_nonzero(flags))
            for name in counts:
                counts[name] += int(np.count_nonzero(flags & Flag[name]))
        values: dict[str, Any] = {key: counts[name] for name, (key, _) in _COUNTS.items()} | {
            "NFLAGGED": n_flagged
        }
        self.units[0].cards = [(key, values.get(key, value), text) for key, value, text in self.units[0].cards]
        return Summary(output, self.stack.n, n_flagged, counts, n_resumed)

    def _reconstruct(self, part: Part, chunk: tuple[int, int]) -> tuple[int, int]:
        counts = self.stack.read(*chunk)
        limits: dict[str, Any] = {"saturation": self.saturation, "largest_residual": self.largest_residual}
        images = counts[:, 0] if counts.shape[1] == 1 else counts
        phases = self.calibration(images, follow=self.follow, **limits)
        values = {"": phases.phase}
        if self.has_sigma:
            values["SIGMA"] = self.calibration.sigma(phases, self.photons, self.read_noise)
        values["FRAMES"] = self._rows(phases, *chunk, values.get("SIGMA"))
        for unit in self.units[:-1]:
            if unit.n:
                part.write(unit, chunk[0], values[unit.name])
        return chunk

    def _rows(self, phases: Phases, first: int, stop: int, sigma: NDArray | None) -> NDArray:
        rows, numbers = np.zeros(stop - first, self.table.dtype), np.arange(first, stop)
        files = np.searchsorted(self.stack.ends, numbers, "right")
        rows["FRAME"], rows["FILE"], rows["INDEX"] = numbers, files, numbers - self.stack.starts[files]
        for name, values in self.keywords.items():
            rows[name] = values[files]
        rows["FLAGS"], rows["FLUX"], rows["RESIDUAL"] = phases.flags, phases.flux, phases.residual
        rows["SHIFT"], rows["BACKGR"] = phases.displacement, phases.background
        rows["NBAD"], rows["NSATUR"], rows["NITER"] = phases.n_bad, phases.n_saturated, phases.n_iterations
        lost = phases.flags & Flag.LOST > 0
        if sigma is not None:
            rows["SIGMA"][lost] = np.nan
            rows["SIGMA"][~lost] = np.sqrt(np.nanmean(sigma[~lost] ** 2, axis=(1, 2)))
        if self.matrix is not None:
            rows["COEFFS"] = self.calibration.coefficients(phases, self.matrix)
            rows["COEFFS"][lost] = np.nan
            if self.photons is not None:
                rows["SIGCOEFF"] = self.calibration.sigma(phases, self.photons, self.read_noise, self.modes)
        return rows


def _spans(n: int, size: int) -> list[tuple[int, int]]:
    """First row of each piece of n rows, and the first one after it."""
    return [(first, min(first + size, n)) for first in range(0, n, size)]


def _columns(stack: Stack, keywords: Any) -> dict[str, NDArray]:
    """Values of keywords for each file."""
    _check.sequence("keywords", keywords, str, "a list of keywords")
    columns: dict[str, NDArray] = {}
    for key in keywords:
        key = key.upper()
        for block in stack.firsts:
            if key not in block.header:
                raise FileError(f"{block.name}: its header has no {key}: expected it, as one of the keywords")
        values = [block.header[key] for block in stack.firsts]
        numbers = all(isinstance(value, int | float) for value in values)
        strings = [card_value(str(value)).encode() for value in values]
        columns[key] = np.array(values, float) if numbers else np.array(strings)
    return columns
