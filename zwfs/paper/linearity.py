"""The numerical experiments behind the figures: reconstructors go in, tables of errors come out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.companion import sweeps
from zwfs.metrics import dynamic_range, reconstruction_error, strehl
from zwfs.modes import power_law_screens


@dataclass(frozen=True)
class LinearityCurves:
    """Error of several reconstructors against the input.

    Attributes
    ----------
    rms : ndarray, shape (n_rms,), radian rms
        Input.
    errors : dict of ndarray, shape (n_rms, n_screens), radian rms
        Error of each reconstructor on each screen.
    converged : dict of ndarray of bool, shape (n_rms, n_screens)
    wrapped : ndarray, shape (n_rms, n_screens)
        Fraction of the points of each screen whose phase, piston removed, is outside (-pi, pi].
    folded : ndarray, shape (n_rms, n_screens)
        Fraction of the points of each screen below -pi/4, which an arcsine at +pi/2 folds back.
    strehl : ndarray, shape (n_rms, n_screens)
        Strehl ratio of each screen: what is left of the light that makes the reference wave.
    """

    rms: NDArray[np.floating]
    errors: dict[str, NDArray[np.float64]]
    converged: dict[str, NDArray[np.bool_]]
    wrapped: NDArray[np.float64]
    folded: NDArray[np.float64]
    strehl: NDArray[np.float64]

    def mean(self, name: str) -> NDArray[np.float64]:
        """Mean error over the screens, shape (n_rms,)."""
        _check.choice("name", name, self.errors)
        return self.errors[name].mean(axis=1)

    def std(self, name: str) -> NDArray[np.float64]:
        """Standard deviation of the error over the screens, shape (n_rms,)."""
        _check.choice("name", name, self.errors)
        return self.errors[name].std(axis=1)

    def dynamic_range(self, name: str, threshold: float = 0.05) -> float:
        """Input at which the mean error leaves `threshold` times the input; see `zwfs.dynamic_range`."""
        return dynamic_range(self.rms, self.mean(name), threshold)

    def recovered(self, name: str, threshold: float = 0.05) -> NDArray[np.float64]:
        """Fraction of the screens with an error of at most `threshold` times the input, shape (n_rms,)."""
        _check.choice("name", name, self.errors)
        threshold = _check.number("threshold", threshold, 0)
        return np.mean(self.errors[name] <= threshold * self.rms[:, np.newaxis], axis=1)

    def columns(self) -> dict[str, NDArray[np.floating]]:
        """Input, and mean and standard deviation of every reconstructor, as columns for `publish`."""
        columns = {"input (rad rms)": self.rms}
        for name in self.errors:
            columns[f"{name}: mean error (rad rms)"] = self.mean(name)
            columns[f"{name}: standard deviation (rad rms)"] = self.std(name)
        return columns


def screens_at(
    modes: NDArray, rms: float, n_screens: int, seed: int, task: int, exponent: float = -2.0
) -> NDArray[np.floating]:
    """Screens of one task of an experiment: they depend on the seed and the task's number, not on the order."""
    seed, task = _check.integer_seed("seed", seed), _check.integer("task", task, 0)
    return power_law_screens(modes, rms, n_screens, exponent, np.random.SeedSequence(seed, spawn_key=(task,)))


def check_rms(rms: ArrayLike) -> NDArray[np.floating]:
    """Return the inputs of an experiment as an array, shape (n_rms,)."""
    rms = _check.real_array("rms", rms)
    if rms.ndim != 1 or not rms.size:
        raise ValueError(f"rms has shape {rms.shape}: expected (n_rms,), at least one")
    for value in rms.tolist():
        _check.number("rms", value, 0)
    return rms


def check_reconstructors(reconstructors: Mapping[str, Any]) -> None:
    """Require a mapping of at least one reconstructor."""
    _check.instance("reconstructors", reconstructors, Mapping)
    if not reconstructors:
        raise ValueError("reconstructors is empty: expected at least one")
    for name, reconstructor in reconstructors.items():
        _check.sensor_of(f"reconstructors[{name!r}]", reconstructor)


def linearity_curves(
    reconstructors: Mapping[str, Any],
    modes: NDArray,
    rms: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> LinearityCurves:
    """Error of reconstructors on random screens of growing rms: the experiment of section 4.1.

    Each input rms has screens of its own; all reconstructors see the same ones, each through its own sensor. An
    input is a task of the sweep "linearity_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    reconstructors : mapping of str to reconstructor
        For sensors on the same pupil. Anything with a `sensor` counts that takes the frames of that sensor and
        returns an object with `phase`, (n_screens, ny, nx), and `converged`, (n_screens,).
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
        Screens for each rms.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    LinearityCurves

    References
    ----------
    Chambouleyron et al. 2024, section 4.1 and Figure 3.
    """
    rms = check_rms(rms)
    n_screens = _check.integer("n_screens", n_screens, 1)
    exponent = _check.number("exponent", exponent)
    seed = _check.integer_seed("seed", seed)
    check_reconstructors(reconstructors)
    shared = dict(reconstructors), modes, n_screens, exponent, seed
    points = sweeps.run(_linearity_point, enumerate(rms.tolist()), *shared, name="linearity_curves")
    errors, converged, *light = zip(*points, strict=True)
    return LinearityCurves(
        rms,
        {name: np.array([point[name] for point in errors]) for name in reconstructors},
        {name: np.array([point[name] for point in converged]) for name in reconstructors},
        *map(np.array, light),
    )


def _linearity_point(
    point: tuple[int, float],
    reconstructors: Mapping[str, Any],
    modes: NDArray,
    n_screens: int,
    exponent: float,
    seed: int,
) -> tuple[dict[str, NDArray], dict[str, NDArray], NDArray, NDArray, NDArray]:
    """One input of the linearity curves: errors, converged, wrapped, folded and Strehl, (n_screens,) each."""
    task, rms = point
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    pupil = next(iter(reconstructors.values())).sensor.pupil
    phase = pupil.gather(screens)
    errors, converged = {}, {}
    for name, reconstructor in reconstructors.items():
        found = reconstructor(reconstructor.sensor.measure(screens))
        errors[name] = reconstruction_error(pupil, found.phase, screens)
        converged[name] = found.converged
    wrapped, folded = np.mean(np.abs(phase) > np.pi, axis=-1), np.mean(phase < -np.pi / 4, axis=-1)
    return errors, converged, wrapped, folded, strehl(pupil, screens)


def convergence(
    reconstructor: Any, modes: NDArray, rms: float, n_screens: int, *, exponent: float = -2.0, seed: int = 0
) -> NDArray[np.float64]:
    """Error of a reconstructor on random screens, iteration by iteration.

    Parameters
    ----------
    reconstructor : reconstructor
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : float, radian rms
    n_screens : int
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    ndarray, shape (n_screens, n_iterations + 1), radian rms
        Before the first iteration (a flat wavefront) and after each one.
    """
    sensor = _check.sensor_of("reconstructor", reconstructor)
    screens = screens_at(modes, rms, n_screens, seed, 0, exponent)
    errors = np.empty((n_screens, reconstructor.settings.n_iterations + 1))
    # One screen at a time: the history of all of them would take much memory.
    for index, screen in enumerate(screens):
        history = reconstructor(sensor.measure(screen), history=True).history
        errors[index] = reconstruction_error(sensor.pupil, history, screen)
    return errors
