"""Calibration of a bench from its camera files."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._system import paths_of
from zwfs.frames._blocks import FileError, blocks_of
from zwfs.frames._fit import fit_bench
from zwfs.frames._fitted import Windows
from zwfs.frames._learnt import of_bench
from zwfs.frames._stack import Stack
from zwfs.frames.calibration import Calibration
from zwfs.frames.files import CameraFile, averaged, combined, read, read_all, relative_exposure
from zwfs.frames.pipeline import Measurement, Optics, reduce_frames
from zwfs.frames.refine import _check_fit, fit
from zwfs.frames.registration import Image, check_centers, check_diameter, find_pupils, register_frames


class Source(NamedTuple):
    """Camera files of a calibration, and what is known of them, see `Calibration.from_files`."""

    files: tuple[Sequence[str | Path], ...]  # of frames, clear frames, darks, maps, and darks of the clear frames
    diameter: float
    phase_shifts: tuple[float, ...]
    saturation: float | None
    n_images: int | None
    settings: dict[str, Any]  # of the registration
    kept: dict[str, Any]  # attributes of the calibration

    def registered(self, fitted: Sequence[str]) -> Calibration:
        """Calibration without known commands."""
        frames, pupils, darks, maps, pupil_darks = self.files
        masked, unmasked, sources = read_all(
            frames, pupils, darks, maps, self.saturation, pupil_dark_files=pupil_darks, n_images=self.n_images
        )
        header, saturation = sources[0].header, self.saturation
        try:
            optics = sources[0].optics(self.diameter, self.phase_shifts)
            _check_fit("fitted", fitted, optics)
            settings = {"exposure": relative_exposure(sources[0], sources[len(frames)])} | self.settings
            registered = register_frames(masked, unmasked, **settings, n_pupils=len(optics.phase_shifts))
            registered, optics = fit(registered, optics, fitted)
            if saturation is None:
                saturation = sources[0].keyword("SATURATE") if "SATURATE" in header else np.inf
            camera = {"saturation": saturation, "bunit": str(header.get("BUNIT", ""))}
            return Calibration.of(reduce_frames(registered, optics), **self.kept, **camera)
        except ValueError as error:  # any of the files can be the cause
            names = ", ".join(source.name for source in sources)
            two = [source.name for source in sources[: len(frames) + len(pupils)] if source.n_exposures == 2]
            hint = f"; n_images = 2 takes the two exposures of {two[0]} for two images" if two else ""
            raise ValueError(f"{error} (files: {names}{hint})") from error

    def commanded(self, commands: Path, **camera: Any) -> Calibration:
        """Calibration with a fit of the bench, or without where the fit measures an unseen state no better."""
        if excess := set(self.settings) - {"pupil_centers", "pupil_diameter"}:
            raise TypeError(f"{min(excess)} with commands: expected pupil_centers and pupil_diameter only")
        states = _read_states(self.files, commands, self.saturation, self.n_images)
        header = states.header
        shifts = self.phase_shifts or (header.get("THETA1", np.pi / 2), header.get("THETA2", -np.pi / 2))
        optics = Optics(self.diameter or header.get("DIMPLE", 1.06), shifts)
        if optics.single:
            raise ValueError(f"phase_shifts = {_check.shown(shifts)} with commands: expected two")
        attributes = self.kept | {"saturation": states.saturation, "bunit": str(header.get("BUNIT", ""))}
        place = {name: self.settings.get(name) for name in ("pupil_centers", "pupil_diameter")}
        windows, n_pixels = _windows(states, *place.values())
        frames, clear = windows.cut(states.frames), windows.cut(states.clear)
        design: Any = {"n_pixels": n_pixels, "diameter": optics.diameter, "phase_shifts": optics.phase_shifts}

        def fitted_to(n_states: int) -> Calibration:
            counts, commands = frames[:n_states], states.commands[:n_states]
            bench = fit_bench(counts, clear, commands, **design, **camera)
            return of_bench(Calibration, bench, counts, commands, windows, states.dark, **attributes)

        try:
            plain = Calibration.of(_measured(states, optics, place), **attributes)
        except ValueError as error:
            warnings.warn(f"The fit was not compared with a calibration without commands: {error}", stacklevel=3)
        else:
            if len(states.commands) > 2 and _does_not_help(fitted_to(len(states.commands) - 1), plain, states):
                return plain
        calibration = fitted_to(len(states.commands))
        assert calibration.bench is not None
        for remark in calibration.bench.remarks:
            warnings.warn(remark, stacklevel=3)
        return calibration


def _does_not_help(partial: Calibration, plain: Calibration, states: _States) -> bool:
    """Whether a fit to the other commands measures the last one worse than a calibration without commands."""
    error_fitted, error_plain = (_error_of_last(bench, partial, states) for bench in (partial, plain))
    if error_fitted > error_plain:
        warnings.warn(
            f"The fit of the bench does not help: fitted to the other commands, it measures the last one to "
            f"{error_fitted:.3g} rad rms, a calibration without commands to {error_plain:.3g} rad rms. The "
            "calibration without commands is kept.",
            stacklevel=4,
        )
    return error_fitted > error_plain


def _measured(states: _States, optics: Optics, place: dict[str, Any]) -> Measurement:
    """Frames of the first state, with the clear frames, for a calibration without commands."""
    frames = map(Image.of, states.frames[0].mean(axis=0), ["frame"] * 2, states.dark)
    clear = map(Image.of, states.clear.mean(axis=0), ["clear frame"] * 2)
    return reduce_frames(register_frames([*frames], [*clear], **({} if None in place.values() else place)), optics)


def _error_of_last(calibration: Calibration, grid: Calibration, states: _States) -> float:
    """Rms error, radian, with which a calibration measures the last command less the first.

    Phases are compared on the grid of the commands, which another calibration has, off the edges if possible.
    """
    images = np.nan_to_num(states.frames[[0, -1]].mean(axis=1)) + states.dark
    phases = calibration(images[:, 0] if calibration.n_images == 1 else images, saturation=np.inf).phase
    row, column = grid.places[0] - calibration.places[0, :, :1, :1]
    waves = np.nan_to_num(np.exp(1j * phases.astype(float)))
    first, last = (ndimage.map_coordinates(wave, (row, column), order=1) for wave in waves)
    change = np.exp(1j * (states.commands[-1] - states.commands[0]))
    # Next to a point without a phase a wave is smaller.
    usable = grid.good & (np.minimum(np.abs(first), np.abs(last)) > 0.8)
    layers = [usable, *(usable & ndimage.binary_erosion(grid.good, iterations=apart) for apart in (1, 2))]
    compared = [points for points in layers if points.any()][-1]  # segments may be narrow
    error = (last * np.conj(first * change))[compared]
    return float(np.angle(error * np.conj(error.mean())).std())


class _States(NamedTuple):
    """Camera images of known states, counts: less the dark, NaN where bad or saturated."""

    frames: NDArray[np.float64]  # (n_states, n_frames, n_images, ny, nx)
    clear: NDArray[np.float64]  # (n_frames, n_images, ny, nx)
    commands: NDArray[np.float64]  # (n_states, n, n), radian
    dark: NDArray[np.float64]  # (n_images, ny, nx)
    header: dict[str, Any]  # of the first file of frames
    saturation: float


def _read_states(
    files: tuple[Sequence[str | Path], ...], commands: Path, saturation: float | None, n_images: int | None
) -> _States:
    """Read camera files of known states, see `Source`."""
    frame_files, pupil_files, dark_files, bad_pixel_files, pupil_dark_files = files
    phases = read(commands, max_images=2**20).images
    frames, stack = _cube("frame_files", frame_files, n_images or 0)
    clear, clear_stack = _cube("pupil_files", pupil_files, frames.shape[1])
    if frames.shape[1:] != clear.shape[1:]:
        raise FileError(
            f"{stack.firsts[0].name}: exposures of shape {frames.shape[1:]}: expected {clear.shape[1:]}"
        )
    if len(frames) % len(phases):
        raise FileError(
            f"{commands.name}: {len(phases)} commands for {len(frames)} exposures: expected an exposure for "
            "each, or the same number for each"
        )
    n_images = clear.shape[1]
    kinds = {"dark_files": dark_files, "bad_pixel_files": bad_pixel_files, "pupil_dark_files": pupil_dark_files}
    darks, maps, pupil_darks = (
        [averaged(path, n_images, np.inf) for path in paths_of(name, paths)] for name, paths in kinds.items()
    )
    means = [
        CameraFile(cube.mean(axis=0), source.firsts[0].name, "", source.header)
        for cube, source in ((frames, stack), (clear, clear_stack))
    ]
    masked, unmasked = combined(means[:1], darks), combined(means[1:], pupil_darks or darks, maps)
    dark, clear_dark = (np.stack([image.dark for image in pair]) for pair in (masked, unmasked))
    bad = np.stack([image.bad for image in unmasked]) | ~np.isfinite(dark)
    level = stack.saturation if saturation is None else saturation
    clear, frames = (
        np.where(bad | ~(cube < level), np.nan, cube - unlit)
        for cube, unlit in ((clear, clear_dark), (frames, dark))
    )
    dark = np.nan_to_num(dark)
    frames = frames.reshape(len(phases), -1, *frames.shape[1:])
    return _States(frames, clear, phases, dark, stack.header, level)


def _cube(name: str, files: Sequence[str | Path], n_images: int) -> tuple[NDArray[np.float64], Stack]:
    """All exposures of files, (n, n_images, ny, nx); two files with an image each are the images of exposures.

    Where n_images is 0, it follows from the shapes.
    """
    paths = paths_of(name, files)
    if not paths or not paths[0].is_file():
        raise FileNotFoundError(f"{name}: {paths[0] if paths else 'empty'}: expected a file")
    blocks = blocks_of(paths[0])
    full, several = blocks[0].full, len(paths) > 1
    n_images = n_images or 1 + (
        len(blocks) == 2 or len(full) == 4 or len(paths) == 2 or (several and full[0] == 2)
    )
    pair = n_images == len(paths) == 2 and len(blocks) == 1 and full[-3:-2] != (2,)
    stack = Stack(paths[:1] if pair else paths, paths[1:] if pair else [], n_images, (full[-2], full[-1]))
    return stack.read(0, stack.n).astype(float), stack


def _windows(
    states: _States, centers: Sequence[Sequence[float]] | None, diameter: float | None
) -> tuple[Windows, float]:
    """Windows around both pupils, and the diameter D of the pupil.

    All sides of a window have the same margin around the n pixels of the commands.
    """
    n, (n_images, *shape) = states.commands.shape[-1], states.dark.shape
    diameter = None if diameter is None else check_diameter(diameter, tuple(shape))
    middles = None if centers is None else check_centers(centers)
    if middles is None or diameter is None:
        clear = [Image.of(counts, "clear frame") for counts in states.clear.mean(axis=0)]
        circles = [circle for image in clear for circle in find_pupils(image, 3 - n_images, diameter)]
        diameter = diameter or float(np.mean([circle.diameter for circle in circles]))
        middles = np.array([circle[:2] for circle in circles]) if middles is None else middles
    room = np.minimum(middles + 0.5, np.array(shape) - 0.5 - middles).min() - n / 2
    if room < -0.5:
        raise ValueError(f"commands have {n} pixels: expected at most {n + 2 * room:.0f}, to fit the frames")
    side = n + 2 * min(max(math.floor(room), 0), n // 6)
    corners = np.rint(middles - (side - 1) / 2).astype(int)
    return Windows(corners, (side, side), n_images, (shape[0], shape[1])), diameter
