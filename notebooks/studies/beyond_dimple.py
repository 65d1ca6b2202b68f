"""Diameters of the dimple, beyond the paper: its iteration, accelerated or not, and maximum likelihood.

A screen is recovered if the error of its phase is at most a threshold, 5 % of the input. Errors count modulo 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.curves import ErrorCurves, Limit, crossing, percent
from studies.kit.experiments import DiameterCurves, diameter_curves, diameter_limit
from studies.kit.iteration import DARK_RING, iteration_spectrum
from studies.kit.methods import (
    ACCELERATED,
    LIKELY,
    MASKS,
    PLAIN,
    compared_methods,
    method_line,
    method_look,
    opposite_dimples,
)
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded, stacked
from studies.kit.style import LOOKS, OTHER_STYLES
from studies.kit.tables import Table
from zwfs.bounds import cramer_rao
from zwfs.pupil import Pupil

LIMITS = parameter_limits(
    "n_pixels phase_shift inputs n_screens exponent n_iterations threshold",
    n_modes=(3, 1000),  # tip, tilt and at least one other mode
    step=(0.05, 2.0),
    diameter_min=(0.1, 1.0),
    diameter_max=(3.5, 8.0),
    step_fine=(0.01, 0.3),
    n_screens_few=(1, 100),
)
QUICK = {"n_pixels": 40, "n_screens": 3, "step": 0.5, "step_fine": 0.3}
_TILTS = 2  # the first modes: Noll 2 and 3


def dimple_curves(
    pupil: Pupil,
    phase_shift: float,
    n_iterations: int,
    diameters: ArrayLike,
    screens: NDArray,
    names: Sequence[str] = (PLAIN, ACCELERATED, LIKELY),
) -> DiameterCurves:
    """Errors of the compared methods for pairs of dimples of opposite phase shifts; see `diameter_curves`."""

    def make(diameter: float) -> dict[str, Any]:
        methods = compared_methods(opposite_dimples(pupil, diameter, phase_shift), n_iterations)
        return {name: methods[name] for name in names}

    return diameter_curves(make, diameters, screens)


def failing_limit(
    curve: DiameterCurves, pupil: Pupil, phase_shift: float, n_iterations: int, screens: NDArray, threshold: float
) -> Limit:
    """Diameter at which the mean error of the paper's iteration exceeds the threshold, from other screens."""

    def make(diameters: NDArray) -> DiameterCurves:
        return dimple_curves(pupil, phase_shift, n_iterations, diameters, screens, [PLAIN])

    return diameter_limit(curve, PLAIN, make, threshold)


@dataclass(frozen=True)
class DimpleLimits:
    """Convergence of the paper's iteration, and information in the frames, against the diameter of the dimple.

    The first wavefront is flat, the others are the screens. Bounds are divided by that of an ideal sensor.
    """

    diameters: NDArray[np.floating]  # (n_diameters,), lambda/D
    factor: NDArray[np.float64]  # (n_diameters, 1 + n_screens), of an error in one iteration
    bound: NDArray[np.float64]  # (n_diameters, 1 + n_screens, n_modes)

    @property
    def tilt(self) -> NDArray[np.float64]:
        """Bound of a tilt, rms of the two, shape (n_diameters, 1 + n_screens)."""
        return _rms(self.bound[..., :_TILTS])

    @property
    def others(self) -> NDArray[np.float64]:
        """Bound of a mode other than tilt, rms over these modes, shape (n_diameters, 1 + n_screens)."""
        return _rms(self.bound[..., _TILTS:])

    @property
    def total(self) -> NDArray[np.float64]:
        """Bound of a mode, rms over all modes, shape (n_diameters, 1 + n_screens)."""
        return _rms(self.bound)


def dimple_limits(
    pupil: Pupil, modes: NDArray, phase_shift: float, diameters: ArrayLike, screens: NDArray
) -> DimpleLimits:
    """Return the factor of the iteration and the bounds of the modes, at each diameter and at the dark ring."""
    diameters = np.union1d(diameters, DARK_RING)
    phases = np.concatenate([np.zeros((1, *pupil.shape)), screens])
    shared = pupil, modes, phase_shift, phases
    return DimpleLimits(
        diameters, **sweeps.table(_limits_point, diameters.tolist(), *shared, name="dimple_limits")
    )


def _limits_point(
    diameter: float, pupil: Pupil, modes: NDArray, phase_shift: float, phases: NDArray
) -> dict[str, Any]:
    """One diameter of `dimple_limits`: factor, (k,), and bounds, (k, n_modes), around each phase."""
    sensor = opposite_dimples(pupil, diameter, phase_shift)
    factor = [float(np.abs(iteration_spectrum(pupil, diameter, phase)[0])) for phase in phases]
    photons = 1e4  # per point and frame; the ratio does not depend on it
    ideal = 1 / (2 * np.sqrt(sensor.n_masks * photons * pupil.n_points))
    return {"factor": factor, "bound": cramer_rao(sensor, phases, photons=photons, modes=modes) / ideal}


def _rms(values: NDArray) -> NDArray[np.float64]:
    """Rms over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))


_FLOOR = 1e-7  # of a drawn error: below it digits are rounding errors
_INK = "#555555"
_INSTRUMENTS = {"OZIRIIS": "center", "Keck": "left"}  # alignment of the name over the diameters of its masks


def draw_dimple_recovery(curves: Mapping[float, DiameterCurves], threshold: float) -> Figure:
    """Share of recovered screens, and mean error, against the diameter of the dimple."""
    figure, panels = plt.subplots(2, len(curves), figsize=(7, 6), sharex=True, sharey="row", squeeze=False)
    for (share, error), (rms, curve) in zip(panels.T, curves.items(), strict=True):
        for name in curve.errors:
            line = method_line(name)
            share.plot(curve.diameters, 100 * curve.recovered(name, threshold), **line)
            error.semilogy(curve.diameters, np.maximum(curve.mean(name), _FLOOR), **line)
        limit = threshold * rms
        error.axhline(limit, color=_INK, lw=1)
        error.text(0.52, limit * 1.3, f"{percent(threshold)} of the input", color=_INK, fontsize=9)
        share.set_title(f"input {rms:g} rad rms\n", fontsize=10)
        error.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=curve.diameters[[0, -1]], ylim=(_FLOOR / 2, 4))
        for axes in (share, error):
            _mark_instruments(axes)
        above = {"transform": share.get_xaxis_transform(), "va": "bottom", "fontsize": 9, "color": _INK}
        for instrument, side in _INSTRUMENTS.items():
            share.text(np.mean(_span(instrument)), 1.02, instrument, ha=side, **above)
    panels[0, 0].set(ylabel="screens recovered (%)", ylim=(-4, 104))
    panels[1, 0].set_ylabel("mean error (rad rms)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def draw_dimple_limits(limits: DimpleLimits, rms: float) -> Figure:
    """Factor of one iteration, and bound of the modes, against the diameter of the dimple."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 4))
    flat, color = OTHER_STYLES[1]["color"], LOOKS[PLAIN].color
    screens = limits.factor[:, 1:]
    left.plot(limits.diameters, limits.factor[:, 0], color=flat, ls="--", label="flat wavefront")
    left.plot(limits.diameters, screens.mean(axis=1), color=color, label=f"{rms:g} rad rms")
    low, high = screens.min(axis=1), screens.max(axis=1)
    left.fill_between(limits.diameters, low, high, color=color, alpha=0.25, lw=0, label="_all screens")
    left.axhline(1, color=_INK, lw=1)
    left.text(0.52, 1.015, "diverges above", color=_INK, fontsize=9)
    left.set(ylabel="error after / before an iteration", ylim=(0, 1.2))
    for values, name, style in ((limits.tilt, "tilt", 0), (limits.others, "others", 2)):
        color = OTHER_STYLES[style]["color"]
        right.semilogy(limits.diameters, values[:, 0], color=color, ls="--", lw=1.2, label=f"{name}, flat")
        right.semilogy(
            limits.diameters, _rms(values[:, 1:]), color=color, lw=1.8, label=f"{name}, {rms:g} rad rms"
        )
    right.set(ylabel="bound / that of an ideal sensor", ylim=(0.9, 3e4))  # room for the legend
    for axes in (left, right):
        axes.axvline(DARK_RING, color="#888888", lw=1.2, zorder=0.5)
        axes.text(
            DARK_RING, 1.01, "dark ring", color=_INK, fontsize=9, ha="center", va="bottom",
            transform=axes.get_xaxis_transform(),
        )  # fmt: skip
        axes.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=limits.diameters[[0, -1]])
        axes.legend(loc="lower right" if axes is left else "upper left", fontsize=9, frameon=axes is left)
    return figure


def _span(instrument: str) -> tuple[float, float]:
    """Smallest and largest diameter of the masks of an instrument, lambda/D."""
    diameters = [masks[0].diameter for name, masks in MASKS.items() if name.startswith(instrument)]
    return min(diameters), max(diameters)


def _mark_instruments(axes: Axes) -> None:
    """Mark the diameters of the masks in instruments."""
    for instrument in _INSTRUMENTS:
        low, high = _span(instrument)
        axes.axvspan(low - 0.01, high + 0.01, color="#d0d0d0", lw=0, zorder=0.4)


def recovery_screens(curves: Mapping[float, DiameterCurves]) -> dict[str, NDArray]:
    """Columns with a row for each screen of the first figure."""
    return stacked("input (rad rms)", {rms: curve.screens() for rms, curve in curves.items()})


def failing_table(curves: Mapping[float, DiameterCurves], threshold: float) -> Table:
    """Failing point of each method, for each input."""
    exceeded = f"mean error exceeds {percent(threshold)} from about (λ/D)"
    rows = []
    for rms, curve in curves.items():
        for name in curve.errors:
            lost = curve.diameters[curve.recovered(name, threshold) < 1]
            complete = curve.diameters[curve.diameters < lost.min(initial=np.inf)]
            limit = curve.exceeds(name, threshold * rms)
            rows.append([rms, method_look(name).name, float(complete[-1]) if complete.size else np.nan, limit])
    return Table(["input (rad rms)", "method", "recovers every screen up to (λ/D)", exceeded], rows)


def instruments_table(curves: Mapping[str, ErrorCurves], threshold: float) -> Table:
    """Number of screens that each method recovers on the masks of instruments."""
    names = list(next(iter(curves.values())).errors)
    rows = []
    for mask, curve in curves.items():
        n_screens = curve.errors[names[0]].shape[1]
        shares = np.transpose([curve.recovered(name, threshold) for name in names])
        for rms, row in zip(curve.rms, shares, strict=True):
            counts = (f"{round(n_screens * share)} of {n_screens}" for share in row)
            rows.append([f"{mask}, {MASKS[mask][0].diameter:g} λ/D", f"{rms:g}", *counts])
    return Table(["mask", "input (rad rms)", *(method_look(name).name for name in names)], rows)


def numbers(
    curves: Mapping[float, DiameterCurves],
    limits: DimpleLimits,
    fails: Limit,
    threshold: float,
    settings: Mapping[str, float],
) -> dict[str, float | str]:
    """Return the settings and the numbers of the text, with the failing point at the first input."""
    first, last = (list(curves.values())[place] for place in (0, -1))
    ring = int(np.argmin(np.abs(limits.diameters - DARK_RING)))
    found = dict(settings) | {
        "first_input": first.rms[0],
        "last_input": list(curves)[-1],
        "plain_last": last.exceeds(PLAIN, threshold * last.rms[0]),
        "largest": first.diameters[-1],
        "smallest": first.diameters[0],
        "factor_flat": crossing(limits.diameters, limits.factor[:, 0], 1.0),
        "tilt_flat_ring": limits.tilt[ring, 0],
        "others_flat_ring": limits.others[ring, 0],
        "tilt_screens_most": _rms(limits.tilt[:, 1:]).max(),  # of each diameter, rms over the screens
        "threshold": threshold,
        "plain_limit": fails.value,
    }
    return rounded(found, ".4g")
