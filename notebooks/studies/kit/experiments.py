"""The two experiments of the paper that several studies repeat: errors against the input, and the diameter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.curves import ErrorCurves, Limit, crossing, refined_limit
from studies.kit.results import screen_columns, screen_errors
from studies.kit.setups import NOISELESS, Noise, Screens, screens_at
from zwfs.metrics import reconstruction_error, strehl

TABLED = (1.06, 1.5, 2.0, 2.2, 2.4, 2.6, 3.0, 3.5)
"""Diameters of the table on the causes of Figure 4, lambda/D."""


@dataclass(frozen=True)
class LinearityCurves(ErrorCurves):
    """Errors of several reconstructors against the input, and properties of the screens."""

    converged: dict[str, NDArray[np.bool_]]  # (n_rms, n_screens) by name
    wrapped: NDArray[np.float64]  # (n_rms, n_screens), share of the points beyond +-pi
    folded: NDArray[np.float64]  # (n_rms, n_screens), share of the points below -pi/4
    strehl: NDArray[np.float64]  # (n_rms, n_screens)
    size: NDArray[np.float64]  # (n_rms, n_screens), rms of each screen, radian

    def screens(self) -> dict[str, NDArray]:
        """Input, rms, Strehl ratio and errors of every single screen, as columns for `publish`."""
        own = {"rms of the screen (rad)": self.size, "Strehl ratio": self.strehl}
        return screen_columns({"input (rad rms)": self.rms}, own) | super().screens()


def linearity_curves(
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    rms: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
    noise: Noise = NOISELESS,
    first_task: int = 0,
) -> LinearityCurves:
    """Error of reconstructors on random screens of growing rms (radian): the experiment of section 4.1.

    With `d_over_r0` of the screens, an input is the root mean square over all screens of turbulence. Each input
    has a task number from `first_task` on; screens and noise depend on this number and on the seed.
    """
    rms = np.asarray(rms, float)
    shared = dict(reconstructors), modes, n_screens, exponent, seed, noise
    points = enumerate(rms.tolist(), first_task)
    return LinearityCurves(rms, **sweeps.table(_linearity_point, points, *shared, name="linearity_curves"))


def _linearity_point(
    point: tuple[int, float],
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    n_screens: int,
    exponent: float,
    seed: int,
    noise: Noise,
) -> dict[str, Any]:
    """One input of the linearity curves: fields of `LinearityCurves`, (n_screens,) each."""
    task, rms = point
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    pupil = next(iter(reconstructors.values())).sensor.pupil
    phase = pupil.gather(screens)
    errors, converged = {}, {}
    for name, reconstructor in reconstructors.items():
        drawn = np.random.SeedSequence(seed, spawn_key=(task, 0))
        estimate = reconstructor(noise(reconstructor.sensor, screens, drawn))
        errors[name] = reconstruction_error(pupil, estimate.phase, screens)
        converged[name] = estimate.converged
    return {
        "errors": errors,
        "converged": converged,
        "wrapped": np.mean(np.abs(phase) > np.pi, axis=-1),
        "folded": np.mean(phase < -np.pi / 4, axis=-1),
        "strehl": strehl(pupil, screens),
        "size": pupil.rms(screens),
    }


@dataclass(frozen=True)
class DiameterCurves(ErrorCurves):
    """Errors of several reconstructors against the diameter of the dimple, on screens of one rms."""

    diameters: NDArray[np.floating]  # (n_diameters,), lambda/D

    def at(self, name: str, diameter: float) -> float:
        """Mean error at a sampled diameter (lambda/D), radian rms; NaN if it was not sampled."""
        means = self.mean(name)[np.abs(self.diameters - diameter) < 1e-9]
        return float(means[0]) if means.size else np.nan

    def exceeds(self, name: str, limit: float, start: float = 0.0) -> float:
        """Diameter, from `start` on, at which the mean error exceeds `limit` (radian rms); see `crossing`."""
        used = self.diameters >= start - 1e-9
        return crossing(self.diameters[used], self.mean(name)[used], limit)

    def screens(self) -> dict[str, NDArray]:
        """Diameter and errors of every single screen, as columns for `publish`."""
        return screen_errors("diameter (lambda/D)", self.diameters, self.errors)


def diameter_curves(
    make: Callable[[float], Mapping[str, Any]],
    diameters: ArrayLike,
    screens: NDArray,
    *,
    noise: Noise = NOISELESS,
    seed: int = 0,
) -> DiameterCurves:
    """Errors of the reconstructors that `make` returns for each diameter (lambda/D), on the same screens."""
    diameters = np.asarray(diameters, float)
    shared = make, screens, noise, seed
    points = sweeps.table(_diameter_point, diameters.tolist(), *shared, name="diameter_curves")
    return DiameterCurves(**points, diameters=diameters)


def _diameter_point(
    diameter: float, make: Callable[[float], Mapping[str, Any]], screens: NDArray, noise: Noise, seed: int
) -> dict[str, Any]:
    """One diameter of the curves: rms of the screens, and errors on each of them, (n_screens,)."""
    errors = {}
    for name, reconstructor in make(diameter).items():
        sensor = reconstructor.sensor
        estimate = reconstructor(noise(sensor, screens, seed))
        errors[name] = reconstruction_error(sensor.pupil, estimate.phase, screens)
    return {"rms": float(np.mean(sensor.pupil.rms(screens))), "errors": errors}


def sampled_diameters(step: float, diameter_max: float, step_fine: float) -> NDArray[np.float64]:
    """Diameters of Figure 4 (lambda/D): every `step`, every `step_fine` from 2 to 2.6, those tabled, the end."""
    coarse = np.arange(step, diameter_max, step)
    fine = np.arange(2.0, 2.6 + step_fine / 2, step_fine)
    return up_to(diameter_max, [*coarse, *fine, *TABLED])


def up_to(end: float, diameters: ArrayLike) -> NDArray[np.float64]:
    """Diameters below an end, and the end."""
    listed = np.unique(np.round([*np.ravel(diameters), end], 9))
    return listed[listed <= end + 1e-9]


def diameter_limit(
    curve: DiameterCurves, name: str, make: Callable[[NDArray], DiameterCurves], threshold: float
) -> Limit:
    """Diameter at which a mean error exceeds `threshold` times the input; `make` tries other screens."""
    coarse = curve.exceeds(name, threshold * curve.rms[0])
    if not curve.diameters[0] < coarse < np.inf:
        return Limit(coarse)

    def ratios(diameters: NDArray) -> NDArray:
        curves = make(diameters)
        return curves.errors[name] / curves.rms[:, np.newaxis]

    return refined_limit(ratios, coarse, threshold, width=0.025)
