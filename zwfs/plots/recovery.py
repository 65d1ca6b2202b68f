"""Figures beyond the paper: screens that are recovered, and why the iteration loses them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zwfs.paper.dimple_diameter import DARK_RING, DiameterCurves
from zwfs.paper.recovery import MASKS, DimpleLimits, RecoveryCurves
from zwfs.plots.style import LOOKS, OTHER_STYLES, Look

_FLOOR = 1e-7  # of a drawn error: below it digits are rounding errors
_INK = "#555555"


def method_look(name: str) -> Look:
    """Look of a compared method: the accelerated iteration has the colour of the plain one."""
    if name == "PhaseShiftedAccelerated":
        return replace(LOOKS["PhaseShifted"], name="phase-shifted, accelerated", line="-")
    return LOOKS[name]


def dimple_recovery(curves: Mapping[float, DiameterCurves], threshold: float) -> Figure:
    """Share of recovered screens, and mean error, against the diameter of the dimple.

    Parameters
    ----------
    curves : mapping of float to DiameterCurves
        By the input, radian rms; one column of panels each.
    threshold : float
        Largest ratio of error to input of a recovered screen.
    """
    figure, panels = plt.subplots(2, len(curves), figsize=(7, 6), sharex=True, sharey="row", squeeze=False)
    for (share, error), (rms, curve) in zip(panels.T, curves.items(), strict=True):
        for name in curve.errors:
            line = _line(name)
            share.plot(curve.diameters, 100 * curve.recovered(name, threshold), **line)
            error.semilogy(curve.diameters, np.maximum(curve.mean(name), _FLOOR), **line)
        limit = threshold * rms
        error.axhline(limit, color=_INK, lw=1)
        error.text(0.52, limit * 1.3, f"{threshold:.0%} of the input", color=_INK, fontsize=9)
        share.set_title(f"input {rms:g} rad rms\n", fontsize=10)
        error.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=curve.diameters[[0, -1]], ylim=(_FLOOR / 2, 4))
        for axes in (share, error):
            _instruments(axes)
        above = {"transform": share.get_xaxis_transform(), "va": "bottom", "fontsize": 9, "color": _INK}
        share.text(_span("OZIRIIS")[0], 1.02, "OZIRIIS", ha="center", **above)
        share.text(_span("Keck")[0], 1.02, "Keck", ha="left", **above)
    panels[0, 0].set(ylabel="screens recovered (%)", ylim=(-4, 104))
    panels[1, 0].set_ylabel("mean error (rad rms)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def dimple_limits(limits: DimpleLimits, rms: float) -> Figure:
    """Factor of one iteration, and bound of the modes, against the diameter of the dimple.

    Parameters
    ----------
    limits : DimpleLimits
    rms : float, radian rms
        Of its screens.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 4))
    flat, color = OTHER_STYLES[1]["color"], LOOKS["PhaseShifted"].color
    screens = limits.factor[:, 1:]
    left.plot(limits.diameters, limits.factor[:, 0], color=flat, ls="--", label="flat wavefront")
    left.plot(limits.diameters, screens.mean(axis=1), color=color, label=f"{rms:g} rad rms")
    left.fill_between(limits.diameters, screens.min(axis=1), screens.max(axis=1), color=color, alpha=0.25, lw=0)
    left.axhline(1, color=_INK, lw=1)
    left.text(0.52, 1.015, "diverges above", color=_INK, fontsize=9)
    left.set(ylabel="error after / before an iteration", ylim=(0, 1.2))
    for values, name, style in (
        (limits.tilt, "tilt", OTHER_STYLES[0]),
        (limits.others, "others", OTHER_STYLES[2]),
    ):
        color = style["color"]
        right.semilogy(limits.diameters, values[:, 0], color=color, ls="--", lw=1.2, label=f"{name}, flat")
        mean = np.sqrt(np.mean(values[:, 1:] ** 2, axis=1))
        right.semilogy(limits.diameters, mean, color=color, lw=1.8, label=f"{name}, {rms:g} rad rms")
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


def range_recovery(curves: Mapping[float, RecoveryCurves], threshold: float) -> Figure:
    """Share of recovered screens against the input, one panel for each dimple.

    Parameters
    ----------
    curves : mapping of float to RecoveryCurves
        By the diameter of the dimples, lambda/D.
    threshold : float
        As for `dimple_recovery`.
    """
    figure, panels = plt.subplots(1, len(curves), figsize=(7, 3.6), sharey=True, squeeze=False)
    for axes, (diameter, curve) in zip(panels[0], curves.items(), strict=True):
        for name in curve.errors:
            axes.plot(curve.rms, 100 * curve.recovered(name, threshold), **_line(name))
        axes.set_title(rf"{diameter:g} $\lambda/D$", fontsize=10)
        axes.set(xlabel="input (rad rms)", xlim=(0, None))
    panels[0, 0].set(ylabel="screens recovered (%)", ylim=(-4, 104))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def range_starts(curves: Mapping[float, RecoveryCurves]) -> Figure:
    """Mean number of starts of maximum likelihood against the input, one line for each dimple."""
    figure, axes = plt.subplots(figsize=(7, 3.4))
    styles = (OTHER_STYLES[index % len(OTHER_STYLES)] for index in range(len(curves)))
    for (diameter, curve), style in zip(curves.items(), styles, strict=True):
        axes.plot(curve.rms, curve.n_starts.mean(axis=1), label=rf"{diameter:g} $\lambda/D$", **style)
    axes.set(xlabel="input (rad rms)", ylabel="starts per screen, mean", xlim=(0, None), ylim=(0, None))
    axes.legend(fontsize=9)
    return figure


def _line(name: str) -> dict[str, Any]:
    """How a method is drawn: maximum likelihood wide and below, the accelerated iteration with hollow marks."""
    look = method_look(name)
    style = look.style | {"label": look.label}
    if name == "MaximumLikelihood":
        return style | {"ms": 8, "lw": 3, "zorder": 1.9}
    return style | {"ms": 5, "lw": 1.6, "mfc": "#ffffff" if name == "PhaseShiftedAccelerated" else look.color}


def _span(instrument: str) -> tuple[float, float]:
    """Middle and width of the diameters of the masks of an instrument, lambda/D."""
    diameters = [masks[0].diameter for name, masks in MASKS.items() if name.startswith(instrument)]
    return (min(diameters) + max(diameters)) / 2, max(diameters) - min(diameters)


def _instruments(axes: Axes) -> None:
    """Mark the diameters of the masks in instruments."""
    for instrument in ("OZIRIIS", "Keck"):
        middle, width = _span(instrument)
        axes.axvspan(middle - width / 2 - 0.01, middle + width / 2 + 0.01, color="#d0d0d0", lw=0, zorder=0.4)
