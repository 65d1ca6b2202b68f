"""Fast path of a bench that `fit_bench` fitted: linear operators that are learnt from frames of its model.

`FittedSensor` fits each pair of frames with all of the model. Here the fit gives the places of all points and the
blur. Weights and an offset of each point turn counts into frames of an ideal sensor: a linear fit to predicted
frames of random phases gives them. They hold leakage, pixels that are lit in part, the rest of the blur, and the
focus of the relay to first order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from zwfs.frames._fit import BenchFit
from zwfs.frames._fitted import FittedSensor
from zwfs.frames.pipeline import Optics, unmixed
from zwfs.sensor import ZernikeSensor

_SCREENS = 24  # random phases from which weights are learnt
_RMS = (0.15, 0.3, 0.5, 0.8)  # radian, of these
_FINEST = 20  # cycles / D
_STIFFNESS = 1e-3  # variance of the frames up to which a weight stays what leakage alone makes it


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
    values, weights = (ndimage.convolve(one, kernel, mode="constant") for one in (inside * image, 1.0 * inside))
    return np.where(inside, values / np.maximum(weights, 1e-9), image)
