"""Figures of section 4.2: error against the diameter of the dimple, and its causes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zwfs.paper.dimple_diameter import DARK_RING, Contraction, DiameterCurves
from zwfs.plots.style import LOOKS, OTHER_STYLES, _looks


def dimple_diameter(curves: Mapping[int, DiameterCurves], threshold: float, claimed: float) -> Figure:
    """Figure 4: mean error and its standard deviation against the diameter of the dimple, on both kinds of axis.

    Parameters
    ----------
    curves : mapping of number of iterations to DiameterCurves
        Of "PhaseShifted". The first are those of the paper; the others are drawn on the logarithmic axis only.
    threshold : float
        Ratio of error to input that is marked.
    claimed : float, lambda/D
        Diameter at which the error rises according to the paper, marked.
    """
    figure, (plain, log) = plt.subplots(1, 2, figsize=(7, 4))
    name, floor = "PhaseShifted", 1e-7
    look = LOOKS[name]
    (number, curve), *others = curves.items()
    mean, std = curve.mean(name), curve.std(name)
    for axes, bottom in ((plain, 0), (log, floor)):
        low, high = (np.maximum(mean + sign * std, bottom) for sign in (-1, 1))
        axes.plot(curve.diameters, mean, color=look.color, marker=look.marker, ms=4, label=f"{number} iterations")
        axes.fill_between(curve.diameters, low, high, color=look.color, alpha=0.2, lw=0)
        _diameters(axes, curve.diameters[-1], claimed)
        axes.set_ylabel("error (rad rms)")
    for (number, other), style in zip(others, OTHER_STYLES[1:], strict=False):
        log.plot(other.diameters, other.mean(name), ms=4, label=f"{number} iterations", **style)
    limit = threshold * curve.rms[0]
    log.axhline(limit, color="#555555", lw=1)
    start, end = 0.64 * claimed, 1.4 * claimed
    log.text(1.01 * start, limit * 1.3, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    plain.set_ylim(0, None)
    log.set(yscale="log", xlim=(start, end), ylim=(floor, 60))  # room for the legend
    log.legend(loc="upper left", fontsize=9, handlelength=1.6)
    return figure


def diameter_methods(curves: Mapping[str, DiameterCurves], threshold: float, claimed: float) -> Figure:
    """Mean error of several methods against the diameter of the dimple.

    Parameters
    ----------
    curves : mapping of method to DiameterCurves
        Those that hold the method.
    threshold, claimed : float
        As for `dimple_diameter`.
    """
    figure, axes = plt.subplots(figsize=(7, 5))
    floor = 1e-7
    for name, look in _looks(curves):
        curve = curves[name]
        mean = np.maximum(curve.mean(name), floor)
        axes.semilogy(curve.diameters, mean, markersize=4.5, label=look.label, **look.style)
    limit = threshold * curve.rms[0]
    axes.axhline(limit, color="#555555", lw=1)
    axes.text(0.05, limit * 1.2, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    _diameters(axes, max(curve.diameters[-1] for curve in curves.values()), claimed)
    axes.set(ylabel="mean error (rad rms)", ylim=(floor / 2, 4))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def diameter_reasons(reasons: Contraction, claimed: float) -> Figure:
    """Factor of one iteration, and sensitivity to single modes, against the diameter of the dimple.

    Parameters
    ----------
    reasons : Contraction
    claimed : float, lambda/D
        As for `dimple_diameter`.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 4))
    color, diameters, aberrated = LOOKS["PhaseShifted"].color, reasons.diameters, reasons.aberrated
    flat_color, ring_color, *_ = (style["color"] for style in OTHER_STYLES)
    left.plot(diameters, reasons.flat, color=flat_color, lw=2, ls="--", zorder=3, label="flat wavefront")
    low, high = aberrated.min(axis=1), aberrated.max(axis=1)
    left.fill_between(diameters, low, high, color=color, alpha=0.3, lw=0, label="screens, range")
    left.plot(diameters, aberrated[:, 0], color=color, lw=1.5, label="first screen")
    observed = list(reasons.observed), list(reasons.observed.values())
    left.plot(*observed, "o", mfc="none", mec=ring_color, label="observed")
    left.axhline(1, color="#555555", lw=1)
    left.text(0.05, 1.015, "diverges above", color="#555555", fontsize=9)
    left.set(ylabel="error after / before an iteration", ylim=(0, 1.2))
    left.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
    for (name, values), style in zip(reasons.sensitivity.items(), OTHER_STYLES, strict=False):
        right.plot(diameters, values, lw=1.8, label=name, **style | {"marker": "none"})
    right.set(ylabel="sensitivity (1/rad)", ylim=(0, 3.5))  # room for the legend on phones
    right.legend(loc="upper left", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
    for axes in (left, right):
        _diameters(axes, diameters[-1], claimed)
    return figure


def _diameters(axes: Axes, end: float, claimed: float) -> None:
    """Axis of the diameter, with the one of the paper and that of the dark ring."""
    axes.axvline(claimed, color="#555555", lw=1.2, ls="--", zorder=0.5)
    axes.axvline(DARK_RING, color="#888888", lw=1.2, zorder=0.5)
    above: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "va": "bottom", "fontsize": 9}
    axes.text(claimed, 1.005, f"paper: {claimed:g} ", ha="right", color="#555555", **above)
    axes.text(DARK_RING, 1.005, " dark ring", ha="left", color="#555555", **above)
    axes.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=(0, end))
