"""Screens that are recovered, beyond the paper: by its iteration, accelerated or not, and by maximum likelihood.

A screen is recovered if the error of its phase is below a threshold, 5 % of the input. Errors count modulo 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.companion import sweeps
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.paper.curves import ErrorCurves
from zwfs.paper.dimple_diameter import (
    DARK_RING,
    DiameterCurves,
    _check_diameters,
    diameter_curves,
    iteration_spectrum,
)
from zwfs.paper.linearity import check_rms, screens_at
from zwfs.pupil import Pupil
from zwfs.reconstructors import MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

MASKS = {
    "Keck": (Dimple(2.4, 0.30 * np.pi), Dimple(2.4, -0.68 * np.pi)),
    "OZIRIIS, on the sky": (Dimple(1.96, 0.33 * np.pi), Dimple(1.96, -0.74 * np.pi)),
    "OZIRIIS, in the laboratory": (Dimple(2.14, 0.33 * np.pi), Dimple(2.14, -0.74 * np.pi)),
}
"""Pairs of dimples in instruments.

Keck's are those of Salama et al. 2024, OZIRIIS's those of its telemetry software (Motte 2026).
"""

_TILTS = 2  # the first modes: Noll 2 and 3


def compared_methods(sensor: ZernikeSensor, n_iterations: int) -> dict[str, Any]:
    """Return the paper's iteration, its accelerated form, and maximum likelihood, by name.

    The number of iterations is that of the first two.
    """
    return {
        "PhaseShifted": PhaseShifted(sensor, n_iterations=n_iterations),
        "PhaseShiftedAccelerated": PhaseShifted(sensor, n_iterations=n_iterations, accelerate=True),
        "MaximumLikelihood": MaximumLikelihood(sensor),
    }


def opposite_dimples(pupil: Pupil, diameter: float, phase_shift: float) -> ZernikeSensor:
    """Return the sensor with two dimples of one diameter (lambda/D) and opposite phase shifts (radian)."""
    _check.instance("pupil", pupil, Pupil)
    diameter = _check.number("diameter", diameter, 0, pupil.n_pixels, open_low=True)
    phase_shift = _check.number("phase_shift", phase_shift, 0.01, 3.13)
    return ZernikeSensor(pupil, Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift))


def dimple_curves(
    pupil: Pupil, phase_shift: float, n_iterations: int, diameters: ArrayLike, screens: NDArray
) -> DiameterCurves:
    """Errors of the compared methods for pairs of dimples of opposite phase shifts; see `diameter_curves`."""
    phase_shift = _check.number("phase_shift", phase_shift, 0.01, 3.13)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)

    def make(diameter: float) -> dict[str, Any]:
        return compared_methods(opposite_dimples(pupil, diameter, phase_shift), n_iterations)

    return diameter_curves(make, diameters, screens)


@dataclass(frozen=True)
class DimpleLimits:
    """Convergence of the paper's iteration, and information in the frames, against the diameter of the dimple.

    The bounds are the smallest standard deviation of an unbiased estimate of a mode, in units of that of an ideal
    sensor, 1 / (2 sqrt(photons)) for all detected photons together.

    Attributes
    ----------
    diameters : ndarray, shape (n_diameters,), lambda/D
    factor : ndarray, shape (n_diameters, 1 + n_screens)
        Factor by which an iteration multiplies a small error: around a flat wavefront, and around each screen.
    bound : ndarray, shape (n_diameters, 1 + n_screens, n_modes)
        Bound of each mode, for a flat wavefront and for each screen.
    """

    diameters: NDArray[np.floating]
    factor: NDArray[np.float64]
    bound: NDArray[np.float64]

    @property
    def tilt(self) -> NDArray[np.float64]:
        """Bound of a tilt, rms of the two, shape (n_diameters, 1 + n_screens)."""
        return np.sqrt(np.mean(self.bound[..., :_TILTS] ** 2, axis=-1))

    @property
    def others(self) -> NDArray[np.float64]:
        """Bound of a mode other than tilt, rms over these modes, shape (n_diameters, 1 + n_screens)."""
        return np.sqrt(np.mean(self.bound[..., _TILTS:] ** 2, axis=-1))

    @property
    def total(self) -> NDArray[np.float64]:
        """Bound of a mode, rms over all modes, shape (n_diameters, 1 + n_screens)."""
        return np.sqrt(np.mean(self.bound**2, axis=-1))


def dimple_limits(
    pupil: Pupil, modes: ArrayLike, phase_shift: float, diameters: ArrayLike, screens: ArrayLike
) -> DimpleLimits:
    """Return the factor of the iteration and the bounds of the modes, at each diameter and at the dark ring.

    A diameter is a task of the sweep "dimple_limits", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    pupil : Pupil
    modes : array_like, shape (n_modes, ny, nx)
        Of unit rms, such as those of `zernike_basis`: the first two are the tilts, and there are others.
    phase_shift : float, radian
        That of one dimple; that of the other is opposite.
    diameters : array_like, shape (n_diameters,), lambda/D
    screens : array_like, shape (n_screens, ny, nx), radian

    Returns
    -------
    DimpleLimits

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    _check.instance("pupil", pupil, Pupil)
    basis = pupil.scatter(_check.modes("modes", modes, pupil), fill=0)
    if len(basis) <= _TILTS:
        raise ValueError(f"modes has shape {basis.shape}: expected more than {_TILTS} modes")
    phase_shift = _check.number("phase_shift", phase_shift, 0.01, 3.13)
    diameters = np.union1d(_check_diameters(diameters), DARK_RING)
    flat = np.zeros((1, *pupil.shape))
    phases = np.concatenate([flat, _check.screens("screens", screens, pupil)])
    shared = pupil, basis, phase_shift, phases
    rows = sweeps.run(_limits_point, diameters.tolist(), *shared, name="dimple_limits")
    return DimpleLimits(diameters, *map(np.array, zip(*rows, strict=True)))


def _limits_point(
    diameter: float, pupil: Pupil, modes: NDArray, phase_shift: float, phases: NDArray
) -> tuple[list[float], NDArray]:
    """One diameter of `dimple_limits`: factor, (k,), and bounds, (k, n_modes), around each phase."""
    sensor = opposite_dimples(pupil, diameter, phase_shift)
    factor = [float(np.abs(iteration_spectrum(pupil, diameter, phase)[0])) for phase in phases]
    photons = 1e4  # per point and frame; the ratio does not depend on it
    ideal = 1 / (2 * np.sqrt(sensor.n_masks * photons * pupil.n_points))
    return factor, cramer_rao(sensor, phases, photons=photons, modes=modes) / ideal


class Verdicts(NamedTuple):
    """Numbers of screens by what maximum likelihood says about its phase, and by whether the phase is right."""

    consistent_right: int
    consistent_wrong: int
    inconsistent_right: int
    inconsistent_wrong: int


@dataclass(frozen=True)
class RecoveryCurves(ErrorCurves):
    """Errors of the compared methods against the input, and what maximum likelihood reports.

    Attributes
    ----------
    consistent : ndarray of bool, shape (n_rms, n_screens)
    n_starts : ndarray of int, shape (n_rms, n_screens)
        See `LikelihoodReconstruction`.
    """

    consistent: NDArray[np.bool_]
    n_starts: NDArray[np.integer]

    def right(self, threshold: float = 0.05) -> NDArray[np.bool_]:
        """Whether maximum likelihood recovers each screen, shape (n_rms, n_screens); see `recovered`."""
        threshold = _check.number("threshold", threshold, 0)
        return self.errors["MaximumLikelihood"] <= threshold * self.rms[:, np.newaxis]

    def verdicts(self, threshold: float = 0.05) -> Verdicts:
        """Count the screens by the verdict of maximum likelihood and by the truth."""
        right = self.right(threshold)
        return Verdicts(*(
            int(np.count_nonzero((self.consistent == said) & (right == truth)))
            for said in (True, False)
            for truth in (True, False)
        ))  # fmt: skip


def recovery_curves(
    sensors: Mapping[Any, ZernikeSensor],
    modes: NDArray,
    rms: ArrayLike,
    n_screens: int,
    *,
    n_iterations: int = 25,
    exponent: float = -2.0,
    seed: int = 0,
) -> dict[Any, RecoveryCurves]:
    """Errors of the compared methods on random screens of growing rms, for each of several sensors.

    All sensors see the same screens. An input and a sensor are a task of the sweep "recovery_curves", see
    `zwfs.companion.sweeps`.

    Parameters
    ----------
    sensors : mapping of str or float to ZernikeSensor
        With two masks, on the same pupil.
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
        Screens for each rms.
    n_iterations : int
        Of the paper's iteration and of its accelerated form.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    dict of RecoveryCurves
        By the name of the sensor.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range, or there is no sensor.
    """
    _check.instance("sensors", sensors, Mapping)
    if not sensors:
        raise ValueError("sensors is empty: expected at least one")
    for name, sensor in sensors.items():
        _check.instance(f"sensors[{name!r}]", sensor, ZernikeSensor)
    rms = check_rms(rms)
    n_screens = _check.integer("n_screens", n_screens, 1)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    exponent, seed = _check.number("exponent", exponent), _check.integer_seed("seed", seed)
    # The largest inputs take longest: they begin first, so that all cores end at about the same time.
    points = [(name, task) for task in reversed(range(rms.size)) for name in sensors]
    shared = dict(sensors), modes, rms.tolist(), n_screens, n_iterations, exponent, seed
    found = dict(zip(points, sweeps.run(_recovery_point, points, *shared, name="recovery_curves"), strict=True))
    curves = {}
    for name in sensors:
        errors, *reports = zip(*(found[name, task] for task in range(rms.size)), strict=True)
        by_method = {method: np.array([point[method] for point in errors]) for method in errors[0]}
        curves[name] = RecoveryCurves(rms, by_method, *map(np.array, reports))
    return curves


def _recovery_point(
    point: tuple[Any, int],
    sensors: Mapping[Any, ZernikeSensor],
    modes: NDArray,
    rms: list[float],
    n_screens: int,
    n_iterations: int,
    exponent: float,
    seed: int,
) -> tuple[dict[str, NDArray], NDArray, NDArray]:
    """One sensor and input of `recovery_curves`: errors, consistent and number of starts, (n_screens,) each."""
    name, task = point
    sensor = sensors[name]
    screens = screens_at(modes, rms[task], n_screens, seed, task, exponent)
    frames = sensor.measure(screens)
    found = {method: one(frames) for method, one in compared_methods(sensor, n_iterations).items()}
    errors = {method: reconstruction_error(sensor.pupil, one.phase, screens) for method, one in found.items()}
    likely = found["MaximumLikelihood"]
    return errors, likely.consistent, likely.n_starts
