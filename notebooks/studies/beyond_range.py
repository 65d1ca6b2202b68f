"""Screens that are recovered, beyond the paper: by its iteration, accelerated or not, and by maximum likelihood.

A screen is recovered if the error of its phase is at most a threshold, 5 % of the input. Errors count modulo 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.curves import ErrorCurves
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import screens_at
from studies.kit.style import LOOKS, OTHER_STYLES, Look
from studies.kit.tables import Table
from zwfs.metrics import reconstruction_error
from zwfs.reconstructors import MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes phase_shift inputs n_screens exponent n_iterations threshold", diameters=[(0.1, 8.0)]
)
PLAIN, ACCELERATED, LIKELY = "PhaseShifted", "PhaseShiftedAccelerated", "MaximumLikelihood"
"""Names of the compared methods."""


def compared_methods(sensor: ZernikeSensor, n_iterations: int) -> dict[str, Any]:
    """Return the paper's iteration, its accelerated form, and maximum likelihood, by name."""
    return {
        PLAIN: PhaseShifted(sensor, n_iterations=n_iterations),
        ACCELERATED: PhaseShifted(sensor, n_iterations=n_iterations, accelerate=True),
        LIKELY: MaximumLikelihood(sensor),
    }


class Verdicts(NamedTuple):
    """Numbers of screens by what maximum likelihood says about its phase, and by whether the phase is right."""

    consistent_right: int
    consistent_wrong: int
    inconsistent_right: int
    inconsistent_wrong: int


@dataclass(frozen=True)
class RecoveryCurves(ErrorCurves):
    """Errors of the compared methods against the input, and what maximum likelihood reports."""

    consistent: NDArray[np.bool_]  # (n_rms, n_screens)
    n_starts: NDArray[np.integer]  # (n_rms, n_screens)

    def complete_up_to(self, name: str, threshold: float) -> float:
        """Largest input up to which a method recovers every screen, radian rms; 0 if there is none."""
        lost = np.flatnonzero(self.recovered(name, threshold) < 1)
        complete = self.rms[: lost[0]] if lost.size else self.rms
        return float(complete[-1]) if complete.size else 0.0

    def verdicts(self, threshold: float = 0.05) -> Verdicts:
        """Count the screens by the verdict of maximum likelihood and by the truth."""
        right = self.errors[LIKELY] <= threshold * self.rms[:, np.newaxis]
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
    """Errors of the compared methods on random screens of growing rms, for each of several sensors."""
    rms = np.asarray(rms)
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
    return errors, found[LIKELY].consistent, found[LIKELY].n_starts


def method_look(name: str) -> Look:
    """Look of a compared method: the accelerated iteration has the colour of the plain one."""
    if name == ACCELERATED:
        return replace(LOOKS[PLAIN], name="phase-shifted, accelerated", line="-")
    return LOOKS[name]


def method_line(name: str) -> dict[str, Any]:
    """How a method is drawn: maximum likelihood wide and below, the accelerated iteration with hollow marks."""
    look = method_look(name)
    style = look.style | {"label": look.label}
    if name == LIKELY:
        return style | {"ms": 8, "lw": 3, "zorder": 1.9}
    return style | {"ms": 5, "lw": 1.6, "mfc": "#ffffff" if name == ACCELERATED else look.color}


def draw_range_recovery(curves: Mapping[float, RecoveryCurves], threshold: float) -> Figure:
    """Share of recovered screens against the input, one panel for each dimple."""
    figure, panels = plt.subplots(1, len(curves), figsize=(7, 3.6), sharey=True, squeeze=False)
    for axes, (diameter, curve) in zip(panels[0], curves.items(), strict=True):
        for name in curve.errors:
            axes.plot(curve.rms, 100 * curve.recovered(name, threshold), **method_line(name))
        axes.set_title(rf"{diameter:g} $\lambda/D$", fontsize=10)
        axes.set(xlabel="input (rad rms)", xlim=(0, None))
    panels[0, 0].set(ylabel="screens recovered (%)", ylim=(-4, 104))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def draw_range_starts(curves: Mapping[float, RecoveryCurves]) -> Figure:
    """Mean number of starts of maximum likelihood against the input, one line for each dimple."""
    figure, axes = plt.subplots(figsize=(7, 3.4))
    for (diameter, curve), style in zip(curves.items(), cycle(OTHER_STYLES), strict=False):
        axes.plot(curve.rms, curve.n_starts.mean(axis=1), label=rf"{diameter:g} $\lambda/D$", **style)
    axes.set(xlabel="input (rad rms)", ylabel="starts per screen, mean", xlim=(0, None), ylim=(0, None))
    axes.legend(fontsize=9)
    return figure


def range_columns(curves: Mapping[float, RecoveryCurves], threshold: float) -> dict[str, NDArray]:
    """Columns of the figures: share of recovered screens of each method, and mean number of starts."""
    columns = {}
    for diameter, curve in curves.items():
        columns["input (rad rms)"] = curve.rms
        for name in curve.errors:
            columns[f"{name}, {diameter:g} lambda/D: share recovered"] = curve.recovered(name, threshold)
        columns[f"{diameter:g} lambda/D: starts, mean"] = curve.n_starts.mean(axis=1)
    return columns


def range_table(curves: Mapping[float, RecoveryCurves], threshold: float) -> Table:
    """Largest input up to which each method recovers every screen, for each dimple."""
    names = next(iter(curves.values())).errors
    return Table(
        ["every screen up to (rad rms)", *(f"{diameter:g} λ/D" for diameter in curves)],
        [
            [method_look(name).name, *(f"{curve.complete_up_to(name, threshold):g}" for curve in curves.values())]
            for name in names
        ],
    )


def verdicts_table(curves: Mapping[float, RecoveryCurves], threshold: float) -> Table:
    """Numbers of screens by what maximum likelihood says and by the truth."""
    rows = [[f"{diameter:g}", *curve.verdicts(threshold)] for diameter, curve in curves.items()]
    names = (name.replace("_", " and ") for name in Verdicts._fields)
    return Table(["diameter (λ/D)", *names], [*rows, ["all", *_all_verdicts(curves, threshold)]])


def _all_verdicts(curves: Mapping[float, RecoveryCurves], threshold: float) -> Verdicts:
    return Verdicts(*map(sum, zip(*(curve.verdicts(threshold) for curve in curves.values()), strict=True)))


def numbers(
    curves: Mapping[float, RecoveryCurves], threshold: float, settings: Mapping[str, float]
) -> dict[str, float | str]:
    """Return the settings and the numbers of the text, with the limits of the first, second and third dimple."""
    verdicts = _all_verdicts(curves, threshold)
    n_starts = np.concatenate([curve.n_starts.ravel() for curve in curves.values()])
    first = next(iter(curves.values()))
    found = dict(settings) | {
        "largest": first.rms[-1],
        "n_screens": first.n_starts.shape[1],
        "n_all": sum(verdicts),
        "n_right": verdicts.consistent_right + verdicts.inconsistent_right,
        "n_wrong": verdicts.consistent_wrong + verdicts.inconsistent_wrong,
        "false_alarms": verdicts.inconsistent_right,
        "false_trust": verdicts.consistent_wrong,
        "once": np.mean(n_starts == 1),
        "starts_most": n_starts.max(),
    }
    for place, (diameter, curve) in zip(("first", "second", "third"), curves.items(), strict=False):
        found |= {
            f"{place}_diameter": diameter,
            f"{place}_plain": curve.complete_up_to(PLAIN, threshold),
            f"{place}_likely": curve.complete_up_to(LIKELY, threshold),
            f"{place}_end": curve.recovered(LIKELY, threshold)[-1],
        }
    return rounded(found, ".4g")
