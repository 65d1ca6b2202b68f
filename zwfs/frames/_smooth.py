"""Phases of camera images with the fitted optics of a calibration and a smooth prior."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._fitted import FittedSensor, PairFit
from zwfs.frames._learnt import Windows
from zwfs.frames._solver import MapPrior
from zwfs.frames.phases import Flag, Phases
from zwfs.frames.pipeline import MOST_BAD

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration


def smooth_phases(
    calibration: Calibration, counts: NDArray, level: float, prior: bool | MapPrior, noise: Any
) -> Phases:
    """Phases of exposures (k, n_images, ny, nx), one fit each, see `Calibration.__call__`."""
    if calibration.bench is None:
        raise ValueError(
            "smooth needs the `bench` of a calibration, and this one has none: expected one from known commands, "
            "in the process that made it"
        )
    if not isinstance(prior, MapPrior) and prior is not True:
        raise TypeError(f"smooth = {_check.shown(prior)}: expected True or False, or one of `priors` of phases")
    sensor, windows = FittedSensor(calibration.bench), Windows.of(calibration, calibration.bench)
    if noise is not None:
        noise, images = _check.real_array("noise", noise), counts.shape[1:]
        if noise.shape not in ((), images[1:], images):
            raise ValueError(f"noise has shape {noise.shape}: expected {images[1:]} or {images}, or a number")
        noise = windows.cut(np.broadcast_to(noise, images))
    _, good, n_bad, n_saturated = calibration._work.on_grid(counts, level, calibration.good)
    inside = calibration.sensor.pupil.inside
    lost = np.count_nonzero(good, axis=(1, 2)) < (1 - MOST_BAD) * np.count_nonzero(inside)
    fits = []
    for number in range(len(counts)):
        exposure = counts[number].astype(float)
        usable = (exposure < level) & (exposure > -_check.LARGEST) & ~calibration.bad
        pair = windows.cut(np.where(usable, exposure - calibration.dark, np.nan))
        fits.append(_lost(inside.shape) if lost[number] else sensor(pair, noise, None if prior is True else prior))
    phase, sigma = (np.stack([fit[index] for fit in fits]) for index in (0, 1))
    misfit, consistent, converged = (np.array([fit[index] for fit in fits]) for index in (2, 3, 4))
    flags = Flag.LOST * lost + Flag.BAD_PIXELS * (n_bad > 0) + Flag.SATURATED * (n_saturated > 0)
    flags += Flag.INCONSISTENT * ~(consistent | lost) + Flag.NOT_CONVERGED * ~(converged | lost)
    none, zero = np.full(len(counts), np.nan, np.float32), np.zeros(len(counts), int)
    return Phases(
        phase=np.where(inside, phase, np.nan),
        filled=np.where(inside, np.nan_to_num(phase), 0),
        flux=np.where(lost, none, 1),
        n_bad=n_bad,
        n_saturated=n_saturated,
        residual=none,
        displacement=np.stack([none, none], axis=-1),
        n_iterations=zero,
        n_unsolved=zero,
        flags=np.asarray(flags, int),
        sigma=np.where(inside, sigma, np.nan),
        misfit=misfit,
        priors=tuple(fit.prior for fit in fits),
    )


def _lost(shape: tuple[int, ...]) -> PairFit:
    empty = np.full(shape, np.nan)
    return PairFit(empty, empty, np.nan, False, False, MapPrior(np.nan))
