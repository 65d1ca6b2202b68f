"""Photon noise of the reconstructors next to the Cramer-Rao bound, and a check of error bars. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.companion import sweeps
from zwfs.detector import Detector
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.paper.linearity import check_rms, screens_at
from zwfs.paper.phase_shifts import _rms
from zwfs.reconstructors import LikelihoodReconstruction, MaximumLikelihood
from zwfs.sensor import ZernikeSensor

SIGMAS = np.arange(0.25, 3.01, 0.25)
"""Widths of the error bars whose share of the points is counted, in standard errors."""
EXPECTED = erf(SIGMAS / np.sqrt(2))
"""Share of the points within `SIGMAS`, for Gaussian errors and true standard errors."""


@dataclass(frozen=True)
class PhotonCurves:
    """Errors of reconstructors on noisy frames, next to the bound.

    Attributes
    ----------
    rms : ndarray, shape (n_rms,), radian rms
        Input: wavefront error of the screens.
    photons : ndarray, shape (n_photons,)
        Per point of the pupil, all frames together.
    errors : dict of ndarray, shape (n_rms, n_photons, n_screens), radian rms
        Error of each reconstructor on each screen.
    bound : ndarray, shape (n_rms, n_photons), radian rms
        Cramer-Rao bound of the phases of all points, rms over pupil and screens.
    within : ndarray, shape (n_rms, n_photons)
        Share of the points whose error is less than the standard error of `MaximumLikelihood`.
    """

    rms: NDArray[np.floating]
    photons: NDArray[np.floating]
    errors: dict[str, NDArray[np.float64]]
    bound: NDArray[np.float64]
    within: NDArray[np.float64]

    def error(self, name: str) -> NDArray[np.float64]:
        """Error of a reconstructor, rms over the screens, shape (n_rms, n_photons), radian rms."""
        _check.choice("name", name, self.errors)
        return np.sqrt(np.mean(self.errors[name] ** 2, axis=-1))

    def ratio(self, name: str) -> NDArray[np.float64]:
        """`error` over the bound, shape (n_rms, n_photons)."""
        return self.error(name) / self.bound


def photon_curves(
    sensor: ZernikeSensor,
    reconstructors: Mapping[str, Any],
    modes: NDArray,
    rms: ArrayLike,
    photons: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> PhotonCurves:
    """Error of reconstructors against the number of photons, and the bound.

    Each sensor divides the light equally between its masks. `MaximumLikelihood` knows the number of photons and is
    always among the reconstructors. All inputs use the same screens at every number of photons. An input with a
    number of photons is a task of the sweep "photon_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    sensor : ZernikeSensor
        Sensor of the bound and of `MaximumLikelihood`.
    reconstructors : mapping of str to reconstructor
        Others, each with its own sensor on the same pupil.
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : array_like, shape (n_rms,), radian rms
    photons : array_like, shape (n_photons,)
        Per point of the pupil, all frames together; at least 1.
    n_screens : int
        Screens for each rms.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    PhotonCurves
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    _check.instance("reconstructors", reconstructors, Mapping)
    for name, method in reconstructors.items():
        if _check.sensor_of(f"reconstructors[{name!r}]", method).pupil.shape != sensor.pupil.shape:
            raise ValueError(f"reconstructors[{name!r}] is for another pupil: expected that of the sensor")
    _check.modes("modes", modes, sensor.pupil)
    rms, photons = check_rms(rms), _check_photons(photons)
    n_screens = _check.integer("n_screens", n_screens, 1)
    exponent, seed = _check.number("exponent", exponent), _check.integer_seed("seed", seed)
    shared = sensor, dict(reconstructors), modes, n_screens, exponent, seed
    cells = product(enumerate(rms.tolist()), enumerate(photons.tolist()))
    points = sweeps.run(_photon_point, cells, *shared, name="photon_curves")
    errors, bound, within = zip(*points, strict=True)
    shape = rms.size, photons.size
    return PhotonCurves(
        rms,
        photons,
        {name: np.reshape([one[name] for one in errors], (*shape, n_screens)) for name in errors[0]},
        np.reshape(bound, shape),
        np.reshape(within, shape),
    )


def _photon_point(
    cell: tuple[tuple[int, float], tuple[int, float]],
    sensor: ZernikeSensor,
    reconstructors: dict[str, Any],
    modes: NDArray,
    n_screens: int,
    exponent: float,
    seed: int,
) -> tuple[dict[str, NDArray], float, float]:
    """One input and number of photons: errors (n_screens,) by name, bound, and share within one sigma."""
    (task, rms), (place, photons) = cell
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    likely = MaximumLikelihood(sensor, photons=photons / sensor.n_masks)
    errors = {}
    for name, method in (reconstructors | {"MaximumLikelihood": likely}).items():
        noise = np.random.SeedSequence(seed, spawn_key=(task, place))
        estimate = method(_noisy(method.sensor, screens, photons, noise))
        errors[name] = reconstruction_error(sensor.pupil, estimate.phase, screens)
    within = np.mean(_in_sigmas(sensor, estimate, screens) < 1)
    bound = cramer_rao(sensor, screens, photons=photons / sensor.n_masks)
    return errors, _rms(sensor.pupil.gather(bound)), float(within)


class ErrorBars(NamedTuple):
    """Standard errors of `MaximumLikelihood`, compared with the errors.

    Attributes
    ----------
    assumed : float
        Photons that the reconstructor assumes, over those of the frames.
    within : ndarray, shape (n_sigmas,)
        Share of the points within `SIGMAS` standard errors.
    chi2 : float
        Mean of the reduced chi-square.
    consistent : float
        Share of the frame sets that the reconstructor calls consistent.
    """

    assumed: float
    within: NDArray[np.float64]
    chi2: float
    consistent: float


def error_bars(
    sensor: ZernikeSensor,
    modes: NDArray,
    rms: ArrayLike,
    photons: float,
    assumed: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> list[ErrorBars]:
    """Count the points within the error bars of `MaximumLikelihood`, with right and wrong numbers of photons.

    Parameters
    ----------
    sensor : ZernikeSensor
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : array_like, shape (n_rms,), radian rms
        Inputs, which are counted together. The screens are those of `photon_curves`.
    photons : float
        Per point of the pupil, all frames together; at least 10.
    assumed : array_like, shape (n,)
        Photons that the reconstructor assumes, over those of the frames, from 0.01 to 100. Each reconstruction has
        one start, since wrong numbers may make all frames inconsistent.
    n_screens : int
        Screens for each rms.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    list of ErrorBars
        One for each number in `assumed`.
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    _check.modes("modes", modes, sensor.pupil)
    photons, assumed = _check.number("photons", photons, 10, 1e9), _check.real_map("assumed", assumed, 1)
    if not np.all((assumed >= 0.01) & (assumed <= 100)):
        raise ValueError(f"assumed = {_check.shown(assumed)}: expected a list of values between 0.01 and 100")
    inputs = enumerate(check_rms(rms).tolist())
    screens = np.concatenate([screens_at(modes, value, n_screens, seed, task, exponent) for task, value in inputs])
    frames = _noisy(sensor, screens, photons, _check.integer_seed("seed", seed))
    rows = []
    for factor in assumed.tolist():
        method = MaximumLikelihood(sensor, photons=factor * photons / sensor.n_masks, n_starts=1)
        estimate = method(frames)
        error = _in_sigmas(sensor, estimate, screens)
        within = np.mean(error[..., np.newaxis] < SIGMAS, axis=(0, 1))
        rows.append(ErrorBars(factor, within, float(estimate.chi2.mean()), float(estimate.consistent.mean())))
    return rows


def _noisy(sensor: ZernikeSensor, screens: NDArray, photons: float, seed: Any) -> NDArray[np.float64]:
    """Frames with photon noise; the photons per point of the pupil are divided between the masks."""
    camera = Detector(sensor.pupil, photons * sensor.pupil.n_points / sensor.n_masks)
    return camera.normalise(camera.expose(sensor.measure(screens), seed))


def _in_sigmas(
    sensor: ZernikeSensor, estimate: LikelihoodReconstruction, screens: NDArray
) -> NDArray[np.floating]:
    """Error of each point over its standard error, (n_screens, n_points)."""
    residual = wrapped_residual(sensor.pupil, estimate.phase, screens)
    return sensor.pupil.gather(np.abs(residual) / estimate.sigma)


def _check_photons(photons: ArrayLike) -> NDArray[np.floating]:
    """Return numbers of photons as an array, (n_photons,)."""
    photons = _check.real_map("photons", photons, 1)
    if not np.all((photons >= 1) & (photons <= 1e9)):
        raise ValueError(f"photons = {_check.shown(photons)}: expected a list of values between 1 and 1e9")
    return photons
