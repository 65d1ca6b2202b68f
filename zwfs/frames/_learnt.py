"""Calibration of a bench that `fit_bench` fitted: linear operators that are learnt from frames of its model.

`FittedSensor` fits each pair of frames with all of the model. Here the fit gives the places of all points and the
blur. Weights and an offset of each point turn counts into frames of an ideal sensor: a linear fit to predicted
frames of random phases gives them. They hold leakage, pixels that are lit in part, the rest of the blur, and the
focus of the relay to first order. `Prediction` corrects the phases for what they miss.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from zwfs._images import radius
from zwfs.frames._errors import slopes_of, unexplained
from zwfs.frames._exposures import SURE
from zwfs.frames._fit import BenchFit, places_of
from zwfs.frames._fitted import FittedSensor, Windows
from zwfs.frames.pipeline import Optics, unmixed
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

_SCREENS = 24  # random phases from which weights are learnt
_RMS = (0.15, 0.3, 0.5, 0.8)  # radian, of these
_FINEST = 20  # cycles / D
_STIFFNESS = 1e-3  # variance of the frames up to which a weight stays what leakage alone makes it
_FAINTEST = 0.2  # amplitude of the pupil of a fit, relative to the largest


def of_bench(
    kind: type[Calibration], bench: BenchFit, counts: NDArray, phases: NDArray, windows: Windows | None = None,
    dark: NDArray | None = None, **settings: Any,
) -> Calibration:  # fmt: skip
    """Calibration of a fitted bench, from its frames, (n_states, [n_frames,] 2, ny, nx), less the dark.

    By default the frames are the camera images.
    """
    settings["n_averaged"] = counts.shape[1] if counts.ndim == 5 else 1
    counts = counts.mean(axis=1) if counts.ndim == 5 else counts
    size = counts.shape[-2:]
    windows = windows or Windows(np.zeros((2, 2), int), (size[0], size[1]), 2, (size[0], size[1]))
    dark = np.zeros((windows.n_images, *windows.shape)) if dark is None else dark
    calibration = _unweighted(kind, bench, counts, dark, windows, settings)
    work, shape = calibration._work, calibration.good.shape
    good = calibration.good & ~work.touched(work.bad[np.newaxis])[0]

    def intensity(pairs: NDArray) -> NDArray:
        values = work.on_grid(windows.on_camera(np.nan_to_num(pairs)) + calibration.dark, np.inf, good)[0]
        return values.reshape(len(values), 2, *shape) / calibration.unit[:, np.newaxis, np.newaxis]

    counts_seen, ideal = training(bench, calibration.sensor)
    weights, offset = learnt(intensity(counts_seen), ideal, calibration.optics)
    light = intensity(counts)[..., good].mean(axis=(0, 2))
    calibration = replace(calibration, good=good, weights=weights, offset=offset, light=light)
    images = windows.on_camera(np.nan_to_num(counts)) + calibration.dark
    # The lamp is that of the calibration, so its light is known.
    measured = calibration(images if windows.n_images == 2 else images[:, 0], light=1.0, saturation=np.inf)
    around, scatter = measured.background.mean(axis=0), measured.background.std(axis=0)
    return replace(
        calibration, unexplained=unexplained(measured.phase, phases), slopes=slopes_of(measured.filled, good),
        displacements=measured.displacement.astype(float), residual=float(np.nanmax(measured.residual)),
        around=np.where(np.abs(around) > SURE * scatter / np.sqrt(len(images)), around, 0),
    )  # fmt: skip


def _unweighted(
    kind: type[Calibration], bench: BenchFit, counts: NDArray, dark: NDArray, windows: Windows,
    settings: dict[str, Any],
) -> Calibration:  # fmt: skip
    """Calibration with the geometry of a fit, and weights of 0."""
    masks, arms, n = bench.model.masks, bench.model.arms, len(bench.light)
    shares: Any = {"leakage": masks["leakage"], "unmasked": max(masks["unmasked"], 0.0)}
    optics = Optics(masks["diameter"], (masks["first"], masks["second"]), **shares)
    n_pixels, bad = bench.model.n_pixels, ~np.isfinite(counts).all(axis=0)
    light = bench.light * (radius((n, n), ((n - 1) / 2,) * 2) <= n_pixels / 2)
    pupil = Pupil.from_amplitude(np.sqrt(np.maximum(light, 0)), n_pixels, threshold=_FAINTEST)
    background, flux = (np.array([arm[key] for arm in arms]) for key in ("background", "flux"))
    return kind(
        pupil.amplitude, n_pixels, pupil.center, optics, windows.shape, windows.n_images,
        places_of(arms, n, windows.size) + windows.corners[..., None, None], dark.astype(np.float32),
        windows.on_camera(bad[np.newaxis])[0] > 0, pupil.inside, background, flux * light[pupil.inside].mean(),
        np.zeros((2, 2, n, n)), np.zeros((2, n, n)), False, np.ones(2), np.zeros((0, n, n), np.float32),
        np.zeros(0), np.zeros((0, 2)), blur=masks["blur"], commanded=True, bench=bench, **settings,
    )  # fmt: skip


def training(fit: BenchFit, sensor: ZernikeSensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frames of a camera, (k, 2, ny, nx), counts, and of an ideal sensor, (k, 2, n, n), for random phases.

    The finest part of the fitted flat is left out, since blurred frames hardly determine it.
    """
    model, inside, rng = FittedSensor(fit), sensor.pupil.inside, np.random.default_rng(0)
    n, flat = len(inside), _smooth(fit.flat, inside)
    frequency = np.hypot(*np.meshgrid(*(fft.fftfreq(2 * n) * sensor.pupil.n_pixels,) * 2))
    colour = (frequency**2 + 0.5) ** -0.95 * np.exp(-((frequency / _FINEST) ** 2))
    frames, ideal = [], []
    for index in range(_SCREENS):
        screen = fft.ifft2(fft.fft2(rng.normal(size=colour.shape)) * colour).real[:n, :n]
        screen = (screen - screen[inside].mean()) / screen[inside].std()
        phase = flat + _RMS[index % len(_RMS)] * screen
        frames.append(model.frames(phase))
        ideal.append(sensor.measure(np.where(inside, phase, 0))[(..., *sensor.window)])
    return np.array(frames), np.array(ideal)


def learnt(values: NDArray, ideal: NDArray, optics: Optics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (2, 2, ny, nx) and offset (2, ny, nx) that turn intensities (k, 2, ny, nx) into ideal frames."""
    start = unmixed(np.eye(2)[..., None, None], optics.leakage, optics.unmasked, 0)[..., 0, 0]
    missing = ideal - np.einsum("ij,kjyx->kiyx", start, values)
    centred, offset = values - values.mean(axis=0), missing.mean(axis=0)
    normal = np.einsum("kiyx,kjyx->yxij", centred, centred) + _STIFFNESS * len(values) * np.eye(2)
    change = np.linalg.solve(normal, np.einsum("kjyx,kiyx->yxji", centred, missing - offset))
    weights = start[:, :, None, None] + np.transpose(change, (3, 2, 0, 1))
    return weights, ideal.mean(axis=0) - np.einsum("ijyx,jyx->iyx", weights, values.mean(axis=0))


def _smooth(image: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean of neighbours inside, without a trace of a chequerboard."""
    kernel = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
    values, weights = (ndimage.convolve(area, kernel, mode="constant") for area in (inside * image, 1.0 * inside))
    return np.where(inside, values / np.maximum(weights, 1e-9), image)
