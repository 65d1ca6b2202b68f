"""Calibration of a bench from its camera files."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._system import path_of, paths_of
from zwfs.frames._blocks import FileError, blocks_of
from zwfs.frames._fit import fit_bench
from zwfs.frames._stack import Stack
from zwfs.frames.calibration import Calibration
from zwfs.frames.files import CameraFile, averaged, dark_of, images, read, read_all
from zwfs.frames.pipeline import Measurement, Optics, reduce_frames
from zwfs.frames.refine import _check_fit, fit
from zwfs.frames.registration import Image, check_centers, check_diameter, find_pupils, register_frames


def calibrate(
    frame_files: Sequence[str | Path], pupil_files: Sequence[str | Path], dark_files: Sequence[str | Path] = (),
    bad_pixel_files: Sequence[str | Path] = (), *, diameter: float = 0.0, phase_shifts: Sequence[float] = (),
    saturation: float | None = None, fitted: Sequence[str] = (), commands: str | Path | None = None,
    noise: float | None = None, gain: float = 1.0, n_iterations: int = 25, tolerance: float = 1e-3,
    pupil_dark_files: Sequence[str | Path] = (), n_images: int | None = None,
    progress: Callable[[str], Any] | None = None, **settings: Any,
) -> Calibration:  # fmt: skip
    """Calibration from camera files: frames as those to come, and clear frames.

    With known commands of a mirror, `fit_bench` fits a model of the camera to the frames, which takes minutes. Of
    three states or more, the last is first left out: if a fit to the others measures it worse than a calibration
    without commands, a warning says so, and the latter is returned.

    Parameters
    ----------
    frame_files, pupil_files, dark_files, bad_pixel_files : sequence of str or Path
        See `zwfs.frames.files.read_all`.
    diameter, phase_shifts : float, lambda/D, and sequence of one or two floats, radian
        Of the dimple; DIMPLE, THETA1 and THETA2 of the header if 0 and empty. With one, there is one image.
    saturation : float, counts, optional
        Of the camera, see `zwfs.frames.files.images`. Without it the frames to come are compared with SATURATE of
        the header, or with the largest number of their type.
    fitted : sequence of str
        Parameters that `zwfs.frames.refine.fit` fits to these frames.
    commands : str or Path, optional
        File with known phases (n_states, n, n), radian, as for `fit_bench`. Then the files of frames hold one or
        more exposures of each state in turn, (n, ny, nx) or (n, 2, ny, nx). The clear frames may be such a cube.
    noise, gain : float, counts rms and electrons / count
        As for `fit_bench`.
    n_iterations, tolerance : int and float, radian
    pupil_dark_files, n_images : sequence of str or Path, and int, optional
        See `zwfs.frames.files.read_all`.
    progress : callable, optional
        With commands, called with a short text before each step of the fit.
    **settings
        Of `zwfs.frames.registration.register_frames`: pupil_centers, pupil_diameter, exposure, subpixel. With
        commands only the first two.

    Returns
    -------
    Calibration

    Raises
    ------
    FileNotFoundError, ImportError, TypeError, ValueError
        If a file or a value is not as expected, or astropy is needed and missing.

    Examples
    --------
    >>> import tempfile
    >>> from zwfs.bench import Bench, write_bench
    >>> from zwfs.frames import calibrate
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = write_bench(folder, Bench(n_pixels=40), seed=1)
    ...     calibration = calibrate([files["frame"]], [files["pupils"]], [files["dark"]])
    ...
    >>> calibration.optics.diameter, round(calibration.diameter)
    (1.06, 40)
    """
    progress = _check.callback("progress", progress)
    gain = _check.number("gain", gain, 0, open_low=True)
    noise = None if noise is None else _check.number("noise", noise, 0, open_low=True)
    files = frame_files, pupil_files, dark_files, bad_pixel_files
    if n_images is not None:
        n_images = _check.integer("n_images", n_images, 1, 2)
    kept: dict[str, Any] = {"n_iterations": n_iterations, "tolerance": tolerance}
    diameter = _check.number("diameter", diameter, 0)
    _check.sequence("phase_shifts", phase_shifts, expected="a list of one or two numbers")
    if commands is not None:
        commands = path_of("commands", commands)
        if others := set(settings) - {"pupil_centers", "pupil_diameter"}:
            raise TypeError(f"{min(others)} with commands: expected pupil_centers and pupil_diameter only")
        if fitted:
            raise ValueError(
                f"fitted = {_check.shown(fitted)}: expected none with commands, which fit all of them"
            )
        states = _read_states(*files, commands, saturation, pupil_dark_files, n_images)
        header = states.header
        shifts: Any = tuple(phase_shifts) or (header.get("THETA1", np.pi / 2), header.get("THETA2", -np.pi / 2))
        optics = Optics(diameter or header.get("DIMPLE", 1.06), shifts)
        if optics.single:
            raise ValueError(f"phase_shifts = {_check.shown(shifts)} with commands: expected two")
        kept |= {"saturation": states.saturation, "bunit": str(header.get("BUNIT", ""))}
        place = settings.get("pupil_centers"), settings.get("pupil_diameter")
        return _from_commands(states, optics, *place, {"noise": noise, "gain": gain, "progress": progress}, kept)
    masked, unmasked, sources = read_all(*files, saturation, pupil_dark_files=pupil_dark_files, n_images=n_images)
    first = len(frame_files) + len(pupil_files)
    dark = dark_of(sources[: len(frame_files)], sources[first : first + len(dark_files)], n_images)
    try:
        optics = sources[0].optics(diameter, phase_shifts)
        _check_fit("fitted", fitted, optics)
        settings["n_pupils"] = len(optics.phase_shifts)
        registered, optics = fit(register_frames(masked, unmasked, **settings), optics, fitted)
        if saturation is None:
            saturation = sources[0].keyword("SATURATE") if "SATURATE" in sources[0].header else np.inf
        kept |= {"saturation": saturation, "bunit": str(sources[0].header.get("BUNIT", ""))}
        return Calibration.of(reduce_frames(registered, optics), dark, **kept)
    except ValueError as error:  # any of the files can be the cause
        raise ValueError(f"{error} (files: {', '.join(source.name for source in sources)})") from error


def _from_commands(
    states: _States, optics: Optics, centers: Any, diameter: Any, camera: dict[str, Any], kept: dict[str, Any]
) -> Calibration:
    """Calibration with a fit of the bench, or without where the fit measures an unseen state no better."""
    (frames, clear), corners, n_pixels = _windows(states, centers, diameter)
    n_images, *shape = states.dark.shape
    design: Any = {"n_pixels": n_pixels, "diameter": optics.diameter, "phase_shifts": optics.phase_shifts}

    def fitted_to(n_states: int) -> tuple[Calibration, tuple[str, ...]]:
        pairs, commands = frames[:n_states], states.commands[:n_states]
        fit = fit_bench(pairs, clear, commands, **design, **camera)
        return Calibration.from_bench(
            fit,
            pairs,
            commands,
            states.dark,
            corners=corners,
            shape=(shape[0], shape[1]),
            n_images=n_images,
            **kept,
        ), fit.remarks

    n_states = len(states.commands)
    try:
        plain = Calibration.of(_measured(states, optics, centers, diameter), states.dark, **kept)
    except ValueError as error:
        warnings.warn(f"The fit was not compared with a calibration without commands: {error}", stacklevel=3)
        n_states = 2
    if n_states > 2:
        partial, _ = fitted_to(n_states - 1)
        error_fitted, error_plain = (_error_of_last(bench, partial, states) for bench in (partial, plain))
        if error_fitted > error_plain:
            warnings.warn(
                f"The fit of the bench does not help: fitted to the other commands, it measures the last one to "
                f"{error_fitted:.3g} rad rms, a calibration without commands to {error_plain:.3g} rad rms. The "
                "calibration without commands is kept.",
                stacklevel=3,
            )
            return plain
    calibration, remarks = fitted_to(len(states.commands))
    for remark in remarks:
        warnings.warn(remark, stacklevel=3)
    return calibration


def _measured(states: _States, optics: Optics, centers: Any, diameter: Any) -> Measurement:
    """Frames of the first state, with the clear frames, for a calibration without commands."""
    frames, clear = (
        [Image(nearest_good(counts, np.isfinite(counts)), ~np.isfinite(counts), name) for counts in pair]
        for pair, name in ((states.frames[0].mean(axis=0), "frame"), (states.clear.mean(axis=0), "clear frame"))
    )
    place = {} if centers is None or diameter is None else {"pupil_centers": centers, "pupil_diameter": diameter}
    return reduce_frames(register_frames(frames, clear, **place), optics)


def _error_of_last(calibration: Calibration, grid: Calibration, states: _States) -> float:
    """Rms error, radian, with which a calibration measures the last command less the first.

    Phases are compared on the grid of the commands, which another calibration has, 2 pixels and more from edges.
    """
    images = np.nan_to_num(states.frames[[0, -1]].mean(axis=1)) + states.dark
    phases = calibration(images[:, 0] if calibration.n_images == 1 else images, saturation=np.inf).phase
    row, column = grid.places[0] - calibration.places[0, :, :1, :1]
    waves = np.nan_to_num(np.exp(1j * phases.astype(float)))
    first, last = (ndimage.map_coordinates(wave, (row, column), order=1) for wave in waves)
    change = np.exp(1j * (states.commands[-1] - states.commands[0]))
    inner = ndimage.binary_erosion(grid.good, iterations=2)
    known = inner & (
        np.minimum(np.abs(first), np.abs(last)) > 0.8
    )  # next to a point without a phase it is smaller
    error = (last * np.conj(first * change))[known]
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
    frame_files: Sequence[str | Path], pupil_files: Sequence[str | Path], dark_files: Sequence[str | Path],
    bad_pixel_files: Sequence[str | Path], commands: str | Path, saturation: float | None,
    pupil_dark_files: Sequence[str | Path] = (), n_images: int | None = None,
) -> _States:  # fmt: skip
    """Read camera files of known states; the parameters are those of `calibrate`."""
    phases = read(commands, max_images=2**20).images
    frames, stack = _cube("frame_files", frame_files, n_images or 0)
    clear, clear_stack = _cube("pupil_files", pupil_files, frames.shape[1])
    if frames.shape[1:] != clear.shape[1:]:
        raise FileError(
            f"{stack.firsts[0].name}: exposures of shape {frames.shape[1:]}: expected {clear.shape[1:]}"
        )
    if len(frames) % len(phases):
        raise FileError(
            f"{Path(commands).name}: {len(phases)} commands for {len(frames)} exposures: expected an exposure for "
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
    bad = np.stack([image.bad for image in images(means[1:], (), maps, _check.LARGEST)])
    dark, clear_dark = (
        np.zeros(clear.shape[1:]) if values is None else values
        for values in (dark_of(means[:1], darks), dark_of(means[1:], pupil_darks or darks))
    )
    bad |= ~np.isfinite(dark + clear_dark)
    level = stack.saturation if saturation is None else saturation
    clear, frames = (
        np.where(bad | ~(one < level), np.nan, one - less) for one, less in ((clear, clear_dark), (frames, dark))
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
) -> tuple[list[NDArray], NDArray[np.int64], float]:
    """Cut frames and clear frames to windows around both pupils.

    Returns the windows (..., 2, side, side), their corners (2, 2), and the diameter D of the pupil. All sides of a
    window have the same margin around the n pixels of the commands.
    """
    n, (n_images, *shape) = states.commands.shape[-1], states.dark.shape
    diameter = None if diameter is None else check_diameter(diameter, tuple(shape))
    middles = None if centers is None else check_centers(centers)
    if middles is None or diameter is None:
        pairs = [(one, np.isfinite(one)) for one in states.clear.mean(axis=0)]
        clear = [Image(nearest_good(one, good), ~good, "clear frame") for one, good in pairs]
        circles = [circle for one in clear for circle in find_pupils(one, 3 - n_images, diameter)]
        diameter = diameter or float(np.mean([circle.diameter for circle in circles]))
        middles = np.array([circle[:2] for circle in circles]) if middles is None else middles
    room = np.minimum(middles + 0.5, np.array(shape) - 0.5 - middles).min() - n / 2
    if room < -0.5:
        raise ValueError(f"commands have {n} pixels: expected at most {n + 2 * room:.0f}, to fit the frames")
    side = n + 2 * min(max(math.floor(room), 0), n // 6)
    corners = np.rint(middles - (side - 1) / 2).astype(int)
    places = [
        (min(index, n_images - 1), slice(row, row + side), slice(column, column + side))
        for index, (row, column) in enumerate(corners)
    ]
    cut = [np.stack([one[(..., *place)] for place in places], axis=-3) for one in (states.frames, states.clear)]
    return cut, corners, diameter
