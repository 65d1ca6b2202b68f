"""Photons that hold a drift of picometres, as in the maintenance of a dark zone. Not in the paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import Table, Text, two_digits
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.loop import Mirror, close_loop
from zwfs.reconstructors import MaximumLikelihood
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes diameter phase_shift",
    n_pixels=(16, 100),
    diameter_best=(0.1, 8.0),
    phase_shift_best=(0.01, 3.13),
    drift=(0.001, 1000.0),
    wavelength=(100.0, 20000.0),
    photons=[(1e4, 1e14)],
    photons_gain=[(1e4, 1e14)],
    gains=[(0.01, 1.5)],
    n_cycles=(4, 10000),
    n_screens=(1, 1000),
)
QUICK = {"photons": [1e8, 1e10], "photons_gain": [1e8], "gains": [0.1, 0.4, 1.0], "n_cycles": 40, "n_screens": 2}

IDEAL = "ideal sensor"
"""Name of a sensor that measures each mode of unit rms with an error of 1 / (2 sqrt(photons)) radian."""


@dataclass(frozen=True)
class Drift:
    """Random walk of a wavefront, and the loop that holds it."""

    modes: NDArray[np.floating]  # (n_modes, ny, nx), unit rms
    rms: float  # of the step in each cycle, all modes together, pm
    wavelength: float  # nm
    n_cycles: int = 80  # of a simulated loop; the last half counts
    n_screens: int = 6
    seed: int = 0

    @property
    def scale(self) -> float:
        """Wavefront per phase, pm / radian."""
        return 1e3 * self.wavelength / (2 * np.pi)


@dataclass(frozen=True)
class DriftCurves:
    """Residuals of simulated loops, and the errors that limit them."""

    drift: Drift
    errors: dict[str, NDArray[np.float64]]  # (n_modes,) of each sensor and of the ideal one, for one photon, pm
    photons: Sequence[float]  # (n,), in a cycle
    held: dict[str, NDArray[np.float64]]  # (n,) of each sensor, with the best gain, pm rms
    gains: Sequence[float]  # (k,)
    by_gain: dict[float, NDArray[np.float64]]  # (k,) of each number of photons, with the last sensor, pm rms


def errors_of_one_photon(sensors: Mapping[str, ZernikeSensor], drift: Drift) -> dict[str, NDArray[np.float64]]:
    """Cramer-Rao bound of each mode for one photon, pm rms: of each sensor by its name, and of an ideal one."""
    flat = np.zeros(drift.modes.shape[1:])
    bounds = {}
    for name, sensor in sensors.items():
        photons = 1 / (sensor.n_masks * sensor.pupil.n_points)
        bounds[name] = drift.scale * cramer_rao(sensor, flat, photons=photons, modes=drift.modes)
    return bounds | {IDEAL: np.full(len(drift.modes), drift.scale / 2)}


def kalman_limit(errors: ArrayLike, drift: Drift, photons: ArrayLike) -> NDArray[np.float64]:
    """Smallest residual of any linear filter on a random walk, pm rms: the shape of `photons`."""
    step = drift.rms**2 / len(drift.modes)
    variance = np.square(errors) / np.asarray(photons, float)[..., np.newaxis]
    return np.sqrt(np.sum(step + np.sqrt(step**2 + 4 * step * variance), axis=-1) / 2)


def integrator_residual(errors: ArrayLike, drift: Drift, photons: float, gains: ArrayLike) -> NDArray[np.float64]:
    """Residual of an integrator with one gain for all modes, pm rms: the shape of `gains`."""
    gains = np.asarray(gains, float)
    step, noise = drift.rms**2, np.sum(np.square(errors)) / photons
    return np.sqrt((gains * noise + step / gains) / (2 - gains))


def best_gain(errors: ArrayLike, drift: Drift, photons: float) -> float:
    """Gain of the smallest `integrator_residual`: g^2 noise^2 = (1 - g) step^2."""
    step, noise = drift.rms, np.sqrt(np.sum(np.square(errors)) / photons)
    return float(2 * step / (step + np.hypot(step, 2 * noise)))


def photons_to_hold(errors: ArrayLike, drift: Drift, residual: float) -> float:
    """Photons per cycle for which `kalman_limit` is a residual (pm rms) above the rms of the drift."""
    root = brentq(lambda decades: kalman_limit(errors, drift, 10**decades) - residual, -3, 30)
    return float(10**root)


def simulate(sensor: ZernikeSensor, drift: Drift, photons: float, gains: Iterable[float]) -> NDArray[np.float64]:
    """Residual of simulated loops with photon noise, pm rms, for each gain."""
    n, pupil = len(drift.modes), sensor.pupil
    rng = np.random.default_rng(drift.seed)
    steps = rng.standard_normal((drift.n_cycles, drift.n_screens, n)) * drift.rms / drift.scale / np.sqrt(n)
    walks = np.tensordot(np.cumsum(steps, axis=0), drift.modes, 1)
    camera, mirror = Detector(photons / sensor.n_masks / pupil.n_points), Mirror(pupil, drift.modes)
    likely = MaximumLikelihood(sensor, drift.modes, photons=camera.photons, n_starts=1)
    residuals = []
    for gain in gains:
        record = close_loop(sensor, mirror, likely, walks, gain=gain, camera=camera, seed=drift.seed)
        residuals.append(drift.scale * np.sqrt(np.mean(record.settled(drift.n_cycles // 2) ** 2)))
    return np.array(residuals)


def hold(sensor: ZernikeSensor, drift: Drift, photons: Iterable[float], errors: ArrayLike) -> NDArray[np.float64]:
    """Residual of simulated loops with the best gain, pm rms, for each number of photons."""
    return np.array([simulate(sensor, drift, light, [best_gain(errors, drift, light)])[0] for light in photons])


def drift_curves(
    sensors: Mapping[str, ZernikeSensor],
    drift: Drift,
    photons: Sequence[float],
    photons_gain: Sequence[float],
    gains: Sequence[float],
) -> DriftCurves:
    """Simulate loops with the best gain for several numbers of photons, and with several gains for others."""
    errors, (*_, last) = errors_of_one_photon(sensors, drift), sensors.values()
    held = {name: hold(sensor, drift, photons, errors[name]) for name, sensor in sensors.items()}
    by_gain = {light: simulate(last, drift, light, gains) for light in photons_gain}
    return DriftCurves(drift, errors, photons, held, gains, by_gain)


_SIZE = 6  # of markers, points; the first sensor has large open ones, as others lie on them
_LIGHTS = (("#333333", "s"), ("#888888", "D"))  # grays and markers of the photons, as colours stand for sensors


def draw_held_drift(curves: DriftCurves) -> Figure:
    """Residual against the photons of a cycle for several sensors, and against the gain of the loop."""
    drift, errors, photons, gains = curves.drift, curves.errors, curves.photons, curves.gains
    held = curves.held
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.8), sharey=True)
    many = np.geomspace(min(photons) / 2, 2 * max(photons), 100)
    styles = {
        name: style | {"markersize": size, "markerfacecolor": "none" if size > _SIZE else style["color"]}
        for name, style, size in zip(held, OTHER_STYLES, (2 * _SIZE, *[_SIZE] * len(held)), strict=False)
    }
    left.axhline(drift.rms, color="#999999", lw=1)
    left.plot(many, kalman_limit(errors[IDEAL], drift, many), color="#777777", ls=":", label=IDEAL)
    for name, style in styles.items():
        limit = style | {"marker": "", "label": f"_{name}, limit"}
        left.plot(many, kalman_limit(errors[name], drift, many), **limit)
        left.plot(photons, held[name], **style | {"linestyle": "", "label": f"_{name}, simulated"})
        left.plot([], [], **style, label=name)
    left.set(xscale="log", yscale="log", xlabel="photons per cycle", ylabel="residual (pm rms)")
    *_, last = held
    if len(held) > 1:
        level = 1.5 * drift.rms
        more, less = (np.interp(-level, -kalman_limit(errors[name], drift, many), many) for name in [*held][-2:])
        _mark_factor(left, less, more, level)
    left.text(many[0], 0.95 * drift.rms, "step of the drift", va="top")
    dense = np.linspace(min(gains) / 1.3, 1.05 * max(gains), 100)
    for (light, simulated), (gray, marker) in zip(curves.by_gain.items(), cycle(_LIGHTS), strict=False):
        name = f"$10^{{{np.log10(light):.2g}}}$ photons"
        right.plot(
            dense, integrator_residual(errors[last], drift, light, dense), color=gray, label=f"_{name}, model"
        )
        right.plot(gains, simulated, marker, color=gray, label=name)
        right.axhline(kalman_limit(errors[last], drift, light), color=gray, lw=0.8, ls=":")
    right.set_xlabel("gain of the integrator")
    right.set_title(f"against the gain, {last}", fontsize=10)
    left.set_title("against the photons, best gain", fontsize=10)
    left.yaxis.set_major_locator(FixedLocator([2, 5, 10, 20, 50, 100, 200]))
    left.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    left.yaxis.set_minor_formatter(NullFormatter())
    right.legend(loc="upper center", fontsize=9)
    left.set_ylim(bottom=0.7 * drift.rms)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _mark_factor(axes: Axes, less: float, more: float, level: float) -> None:
    """Arrow between two numbers of photons that give the same residual, and their ratio."""
    arrow = {"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (less, level), (more, level), arrowprops=arrow)
    text = f"{more / less:.2f} times the photons"
    axes.annotate(text, (more, level), (3, 3), textcoords="offset points", fontsize=9)


def photons_table(curves: DriftCurves) -> Table:
    """Photons per cycle that hold the drift at several residuals."""
    drift = curves.drift
    targets = [factor * drift.rms for factor in (1.2, 1.5, 2.0, 3.0)]
    rows = [
        [name, *(f"{photons_to_hold(errors, drift, target):.2g}" for target in targets)]
        for name, errors in curves.errors.items()
    ]
    return Table(["sensor", *(f"{target:g} pm" for target in targets)], rows)


def findings(curves: DriftCurves) -> Text:
    """Return the photons that hold the drift, for each of the three sensors."""
    drift, target = curves.drift, _target(curves.drift)
    single, paper, best = (f"{photons_to_hold(curves.errors[name], drift, target):.1e}" for name in curves.held)
    return Text(
        f"**The simulated wavefront drifts by {drift.rms:.3g} pm rms in each cycle. To hold the residual below "
        f"{target:.3g} pm rms, the best pair of dimples needs {best} photons per cycle, the pair of the paper "
        f"{paper} and a single dimple {single}.**"
    )


def findings_loops(curves: DriftCurves) -> Text:
    """Return how close the best pair is to an ideal sensor, and the loops to the limit."""
    drift, target = curves.drift, _target(curves.drift)
    *_, best, ideal = curves.errors.values()
    more = photons_to_hold(best, drift, target) / photons_to_hold(ideal, drift, target) - 1
    ratios = [
        held / kalman_limit(curves.errors[name], drift, curves.photons) for name, held in curves.held.items()
    ]
    least, most = min(curves.by_gain), max(curves.by_gain)
    extremes = []
    for light, gain in ((least, max(curves.gains)), (most, min(curves.gains))):
        above = curves.by_gain[light][curves.gains.index(gain)] / kalman_limit(best, drift, light)
        extremes.append(
            f"a gain of {gain:.3g} and {light:.2g} photons, the residual is {two_digits(above)} times the limit"
        )
    return Text(
        f"The best pair needs {two_digits(100 * more)} % more photons than an ideal sensor. With the best gain, "
        f"the residuals of the simulated loops are {np.min(ratios):.2f} to {np.max(ratios):.2f} times the limit. "
        f"With {'; with '.join(extremes)}."
    )


def _target(drift: Drift) -> float:
    """Residual of the text, pm rms."""
    return 1.5 * drift.rms


def numbers(curves: DriftCurves) -> dict[str, float | str]:
    """Return the numbers that a page of the book quotes, for the last sensor."""
    drift = curves.drift
    *_, best, _ideal = curves.errors.values()
    target = _target(drift)
    result = {"drift": drift.rms, "target": target, "photons_2": photons_to_hold(best, drift, target)}
    return rounded(result, ".3g")
