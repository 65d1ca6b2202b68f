"""Fast path of a bench that `fit_bench` fitted: linear operators that are learnt from frames of its model.

`FittedSensor` fits each pair of frames with all of the model. Here the fit gives the places of all points and the
blur. Weights and an offset of each point turn counts into frames of an ideal sensor: a linear fit to predicted
frames of random phases gives them. They hold leakage, pixels that are lit in part, the rest of the blur, and the
focus of the relay to first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from zwfs import _check
from zwfs._system import paths_of
from zwfs.frames._blocks import FileError, blocks_of
from zwfs.frames._camera import BenchFit, FittedSensor
from zwfs.frames._stack import Stack
from zwfs.frames.files import CameraFile, images, read
from zwfs.frames.registration import Circle, Image, find_pupils, nearest_good
from zwfs.sensor import ZernikeSensor

_SCREENS = 24  # random phases from which weights are learnt
_RMS = (0.15, 0.3, 0.5, 0.8)  # radian, of these
_FINEST = 20  # cycles / D
_STIFFNESS = 1e-3  # variance of the frames up to which a weight stays what leakage alone makes it
_MOST_STATES = 2**31  # bytes of the frames of all states


def places_of(fit: BenchFit, shape: tuple[int, int], corners: NDArray) -> NDArray[np.float64]:
    """Row and column at which each point of the maps lies on the camera, (2, 2, n, n).

    The fit saw windows of a shape, whose first pixels are the corners (2, 2) on the camera.
    """
    n = len(fit.light)
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2,) * 2, indexing="ij")
    places = []
    for arm, corner in enumerate(corners):
        row, column, angle, size = (
            fit[f"arm {arm} {name}"].value for name in ("row", "column", "rotation", "magnification")
        )
        cosine, sine = size * math.cos(angle), size * math.sin(angle)
        middle = np.array([row, column]) + (np.array(shape) - 1) / 2 + corner
        places.append(np.stack([cosine * y + sine * x, cosine * x - sine * y]) + middle[:, None, None])
    return np.stack(places)


def training(fit: BenchFit, sensor: ZernikeSensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frames of a camera, (k, 2, ny, nx), counts, and of an ideal sensor, (k, 2, n, n), for random phases.

    The finest part of the fitted flat is left out, since blurred frames hardly determine it.
    """
    model, inside, rng = FittedSensor(fit), sensor.pupil.inside, np.random.default_rng(0)
    n, flat = len(inside), _smooth(fit.flat, inside)
    frequency = np.hypot(*np.meshgrid(*(fft.fftfreq(2 * n) * sensor.pupil.n_pixels,) * 2))
    colour = (frequency**2 + 0.5) ** -0.95 * np.exp(-((frequency / _FINEST) ** 2))
    seen, ideal = [], []
    for index in range(_SCREENS):
        screen = fft.ifft2(fft.fft2(rng.normal(size=colour.shape)) * colour).real[:n, :n]
        screen = (screen - screen[inside].mean()) / screen[inside].std()
        phase = flat + _RMS[index % len(_RMS)] * screen
        seen.append(model.frames(phase))
        ideal.append(sensor.measure(np.where(inside, phase, 0))[(..., *sensor.window)])
    return np.array(seen), np.array(ideal)


def learnt(values: NDArray, ideal: NDArray, leakage: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (2, 2, ny, nx) and offset (2, ny, nx) that turn intensities (k, 2, ny, nx) into ideal frames."""
    start = (np.eye(2) - leakage) / (1 - 2 * leakage)
    missing = ideal - np.einsum("ij,kjyx->kiyx", start, values)
    centred, offset = values - values.mean(axis=0), missing.mean(axis=0)
    normal = np.einsum("kiyx,kjyx->yxij", centred, centred) + _STIFFNESS * len(values) * np.eye(2)
    change = np.linalg.solve(normal, np.einsum("kjyx,kiyx->yxji", centred, missing - offset))
    weights = start[:, :, None, None] + np.transpose(change, (3, 2, 0, 1))
    return weights, ideal.mean(axis=0) - np.einsum("ijyx,jyx->iyx", weights, values.mean(axis=0))


def _smooth(image: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean of neighbours inside, without a trace of a chequerboard."""
    sums = [inside * image, inside.astype(float)]
    for axis in (0, 1):
        sums = [ndimage.convolve1d(one, [0.25, 0.5, 0.25], axis=axis, mode="constant") for one in sums]
    return np.where(inside, sums[0] / np.maximum(sums[1], 1e-9), image)


class States(NamedTuple):
    """Camera images of known states, counts: less the dark, NaN where bad or saturated."""

    frames: NDArray[np.float64]  # (n_states, n_frames, n_images, ny, nx)
    clear: NDArray[np.float64]  # (n_frames, n_images, ny, nx)
    commands: NDArray[np.float64]  # (n_states, n, n), radian
    dark: NDArray[np.float64]  # (n_images, ny, nx)
    header: dict[str, Any]  # of the first file of frames
    saturation: float


def read_states(
    frame_files: Sequence[str | Path],
    pupil_files: Sequence[str | Path],
    dark_files: Sequence[str | Path],
    bad_pixel_files: Sequence[str | Path],
    commands: str | Path,
    saturation: float | None,
) -> States:
    """Read camera files of known states; the parameters are those of `calibrate`."""
    phases = read(commands, max_images=2**20).images
    frames, stack = _cube("frame_files", frame_files, 0)
    clear, _ = _cube("pupil_files", pupil_files, frames.shape[1])
    if frames.shape[1:] != clear.shape[1:]:
        raise FileError(
            f"{stack.segments[0].name}: exposures of shape {frames.shape[1:]}: expected {clear.shape[1:]}"
        )
    if len(frames) % len(phases):
        raise FileError(
            f"{Path(commands).name}: {len(phases)} commands for {len(frames)} exposures: expected an exposure for "
            "each, or the same number for each"
        )
    darks, maps = ([read(path) for path in paths] for paths in (dark_files, bad_pixel_files))
    mean = CameraFile(clear.mean(axis=0), Path(pupil_files[0]).name, "")
    bad = np.stack([image.bad for image in images([mean], darks, maps, _check.LARGEST)])
    dark = np.zeros(clear.shape[1:]) + (np.concatenate([one.images for one in darks]) if darks else 0)
    level = (
        stack.header.get("SATURATE", stack.segments[0].blocks[0].full_scale) if saturation is None else saturation
    )
    clear, frames = (np.where(bad | ~(one < level), np.nan, one - dark) for one in (clear, frames))
    frames = frames.reshape(len(phases), -1, *frames.shape[1:])
    return States(frames, clear, phases, dark, stack.header, level)


def _cube(name: str, files: Sequence[str | Path], n_images: int) -> tuple[NDArray[np.float64], Stack]:
    """All exposures of files, (n, n_images, ny, nx); two files with an image each are the images of exposures.

    Where n_images is 0, it follows from the shapes.
    """
    paths = paths_of(name, files)
    if not paths or not paths[0].is_file():
        raise FileNotFoundError(f"{name}: {paths[0] if paths else 'empty'}: expected a file")
    blocks, _ = blocks_of(paths[0])
    full, several = blocks[0].full, len(paths) > 1
    n_images = n_images or 1 + (
        len(blocks) == 2 or len(full) == 4 or len(paths) == 2 or (several and full[0] == 2)
    )
    pair = n_images == len(paths) == 2 and len(blocks) == 1 and full[-3:-2] != (2,)
    stack = Stack(paths[:1] if pair else paths, paths[1:] if pair else [], n_images, (full[-2], full[-1]))
    return stack.read(0, stack.n).astype(float), stack


def windows(
    states: States, centers: Sequence[Sequence[float]] | None, diameter: float | None
) -> tuple[list[NDArray], NDArray[np.int64], float]:
    """Cut frames and clear frames to windows around both pupils.

    Returns the windows (..., 2, side, side), their corners (2, 2), and the diameter D of the pupil. All sides of a
    window have the same margin around the n pixels of the commands.
    """
    n, (n_images, *shape) = states.commands.shape[-1], states.dark.shape
    if centers is None or diameter is None:
        mean, circles = states.clear.mean(axis=0), list[Circle]()
        for one in mean:
            image = Image(nearest_good(one, np.isfinite(one)), ~np.isfinite(one), "clear frame")
            circles += find_pupils(image, 3 - n_images, diameter)
        diameter = diameter or float(np.mean([circle.diameter for circle in circles]))
        centers = centers or [(circle.row, circle.column) for circle in circles]
    middles = np.array([_check.pair("pupil_centers", one, _check.number) for one in centers])
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
