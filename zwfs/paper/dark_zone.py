"""Photons that hold a drift of picometres, as in the maintenance of a dark zone. Not in the paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from zwfs import _check
from zwfs.detector import Detector
from zwfs.loop import Mirror, _best_gains, close_loop, hold_drift
from zwfs.reconstructors import MaximumLikelihood
from zwfs.sensor import ZernikeSensor

IDEAL = "ideal sensor"
"""Name of a sensor that measures each mode of unit rms with an error of 1 / (2 sqrt(photons)) radian."""


@dataclass(frozen=True)
class Drift:
    """Random walk of a wavefront, and the loop that holds it.

    Attributes
    ----------
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that drift, of unit rms.
    rms : float, pm rms / cycle
        Random step of the wavefront, all modes together.
    wavelength : float, nm
    n_cycles : int
        Of a simulated loop; the last half counts.
    n_screens : int
        Loops that run side by side.
    seed : int
    """

    modes: NDArray[np.floating]
    rms: float
    wavelength: float
    n_cycles: int = 80
    n_screens: int = 6
    seed: int = 0

    @property
    def scale(self) -> float:
        """Wavefront per phase, pm / radian."""
        return 1e3 * self.wavelength / (2 * np.pi)


@dataclass(frozen=True)
class DriftCurves:
    """Residuals of simulated loops, and the errors that limit them.

    Attributes
    ----------
    drift : Drift
    errors : dict of str to ndarray, shape (n_modes,), pm rms
        Of each mode for one photon, by the name of the sensor, and of an ideal one: see `errors_of_one_photon`.
    photons : sequence of float
        In a cycle.
    held : dict of str to ndarray, pm rms
        Residuals with the best gain for each number of photons, by the name of the sensor.
    gains : sequence of float
    by_gain : dict of float to ndarray, pm rms
        Residuals of the last sensor for each gain, by the photons of a cycle.
    """

    drift: Drift
    errors: dict[str, NDArray[np.float64]]
    photons: Sequence[float]
    held: dict[str, NDArray[np.float64]]
    gains: Sequence[float]
    by_gain: dict[float, NDArray[np.float64]]


def drift_curves(
    sensors: Mapping[str, ZernikeSensor],
    drift: Drift,
    photons: Sequence[float],
    photons_gain: Sequence[float],
    gains: Sequence[float],
) -> DriftCurves:
    """Simulate loops with the best gain for several numbers of photons, and with several gains for others.

    Parameters
    ----------
    sensors : mapping of str to ZernikeSensor
        The gains are those of the last one.
    drift : Drift
    photons, photons_gain : sequence of float
        In a cycle.
    gains : sequence of float
    """
    errors, (*_, last) = errors_of_one_photon(sensors, drift), sensors.values()
    held = {name: hold(sensor, drift, photons, errors[name]) for name, sensor in sensors.items()}
    by_gain = {light: simulate(last, drift, light, gains) for light in photons_gain}
    return DriftCurves(drift, errors, photons, held, gains, by_gain)


def errors_of_one_photon(sensors: Mapping[str, ZernikeSensor], drift: Drift) -> dict[str, NDArray[np.float64]]:
    """Cramer-Rao bound of each mode for one photon, pm rms: of each sensor by its name, and of an ideal one.

    The error of n photons is 1 / sqrt(n) times this, since it is that of photon noise only.
    """
    bounds = {
        name: hold_drift(sensor, drift.modes, drift=0, gain=1.0, photons=1.0, wavelength=drift.wavelength).noise
        for name, sensor in sensors.items()
    }
    return bounds | {IDEAL: np.full(len(drift.modes), drift.scale / 2)}


def kalman_limit(errors: ArrayLike, drift: Drift, photons: ArrayLike) -> NDArray[np.float64]:
    """Smallest residual of any linear filter on a random walk, pm rms: the shape of `photons`.

    A mode moves by a random step of variance q in each cycle and is measured with the variance v. The variance P
    of the prediction error of the Kalman filter is constant if P = (1 - K) P + q with K = P / (P + v), so that
    P^2 - q P - q v = 0. An integrator of gain K has the same residual, so it is the best filter here.

    Parameters
    ----------
    errors : array_like, shape (n_modes,), pm rms
        Of each mode for one photon.
    drift : Drift
    photons : array_like
        In each cycle.
    """
    step = drift.rms**2 / len(drift.modes)
    variance = np.square(errors) / np.asarray(photons, float)[..., np.newaxis]
    return np.sqrt(np.sum(step + np.sqrt(step**2 + 4 * step * variance), axis=-1) / 2)


def integrator_residual(errors: ArrayLike, drift: Drift, photons: float, gains: ArrayLike) -> NDArray[np.float64]:
    """Residual of an integrator with one gain for all modes, pm rms: the shape of `gains`.

    The variance of a mode is g v / (2 - g) + q / (g (2 - g)), with q and v as in `kalman_limit`.
    """
    gains = np.asarray(gains, float)
    step, noise = drift.rms**2, np.sum(np.square(errors)) / photons
    return np.sqrt((gains * noise + step / gains) / (2 - gains))


def photons_to_hold(errors: ArrayLike, drift: Drift, residual: float) -> float:
    """Photons per cycle for which `kalman_limit` is a residual (pm rms) above the rms of the drift."""
    residual = _check.number("residual", residual, drift.rms, open_low=True)
    root = brentq(lambda decades: kalman_limit(errors, drift, 10**decades) - residual, -3, 30)
    return float(10**root)


def simulate(sensor: ZernikeSensor, drift: Drift, photons: float, gains: Iterable[float]) -> NDArray[np.float64]:
    """Residual of simulated loops with photon noise, pm rms, for each gain.

    Maximum likelihood reconstructs the frames of each cycle.
    """
    n, pupil = len(drift.modes), sensor.pupil
    rng = np.random.default_rng(drift.seed)
    steps = rng.standard_normal((drift.n_cycles, drift.n_screens, n)) * drift.rms / drift.scale / np.sqrt(n)
    walks = np.tensordot(np.cumsum(steps, axis=0), drift.modes, 1)
    camera, mirror = Detector(pupil, photons / sensor.n_masks), Mirror(pupil, drift.modes)
    likely = MaximumLikelihood(sensor, drift.modes, photons=camera.photons_per_pixel, n_starts=1)
    found = []
    for gain in gains:
        record = close_loop(sensor, mirror, likely, walks, gain=gain, camera=camera, seed=drift.seed)
        found.append(drift.scale * np.sqrt(np.mean(record.settled(drift.n_cycles // 2) ** 2)))
    return np.array(found)


def hold(sensor: ZernikeSensor, drift: Drift, photons: Iterable[float], errors: ArrayLike) -> NDArray[np.float64]:
    """Residual of simulated loops with the best gain, pm rms, for each number of photons."""
    return np.array([simulate(sensor, drift, one, [best_gain(errors, drift, one)])[0] for one in photons])


def best_gain(errors: ArrayLike, drift: Drift, photons: float) -> float:
    """Gain of the smallest `integrator_residual`."""
    return float(_best_gains(drift.rms, np.sqrt(np.sum(np.square(errors)) / photons)))
