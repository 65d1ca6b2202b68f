"""Figures of section 4.2: error against the diameter of the dimple, and its reasons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from zwfs.paper.dimple_diameter import DARK_RING, DiameterCurve
from zwfs.plots.style import LOOKS, OTHER_STYLES, _looks


def dimple_diameter(curves: Mapping[int, DiameterCurve], rms: float, threshold: float, claimed: float) -> Figure:
    """Figure 4: mean error and its standard deviation against the diameter of the dimple, on both kinds of axis.

    Parameters
    ----------
    curves : mapping of number of iterations to DiameterCurve
        The first is that of the paper; the others are drawn on the logarithmic axis only.
    rms : float, radian rms
        Input.
    threshold : float
        Ratio of error to input that is marked.
    claimed : float, lambda/D
        Diameter at which the error rises according to the paper, marked.
    """
    figure, (plain, log) = plt.subplots(1, 2, figsize=(9, 4.2))
    look, floor = LOOKS["PhaseShifted"], 1e-7
    (number, curve), *others = curves.items()
    for axes, bottom in ((plain, 0), (log, floor)):
        low, high = (np.maximum(curve.mean + sign * curve.std, bottom) for sign in (-1, 1))
        axes.plot(
            curve.diameters, curve.mean, color=look.color, marker=look.marker, ms=4, label=f"{number} iterations"
        )
        axes.fill_between(curve.diameters, low, high, color=look.color, alpha=0.2, lw=0)
        _diameters(axes, curve.diameters[-1], claimed)
        axes.set_ylabel("error (rad rms)")
    for (number, other), dashes in zip(others, ("--", ":", "-."), strict=False):
        log.plot(other.diameters, other.mean, color="#555555", ls=dashes, lw=1.5, label=f"{number} iterations")
    log.axhline(threshold * rms, color="#555555", lw=1)
    log.text(0.1, threshold * rms * 1.3, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    plain.set_ylim(0, None)
    log.set(yscale="log", ylim=(floor, 4))
    log.legend(loc="upper left", bbox_to_anchor=(0, 0.72), fontsize=9)
    return figure


def diameter_methods(curves: Mapping[str, DiameterCurve], rms: float, threshold: float, claimed: float) -> Figure:
    """Mean error of several methods against the diameter of the dimple; parameters as for `dimple_diameter`."""
    figure, axes = plt.subplots(figsize=(9, 4.6))
    floor = 1e-7
    for name, look in _looks(curves):
        curve = curves[name]
        axes.semilogy(
            curve.diameters, np.maximum(curve.mean, floor), color=look.color, marker=look.marker,
            linestyle=look.line, ms=4.5, label=look.label,
        )  # fmt: skip
    axes.axhline(threshold * rms, color="#555555", lw=1)
    axes.text(0.05, threshold * rms * 1.2, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    _diameters(axes, max(curve.diameters[-1] for curve in curves.values()), claimed)
    axes.set(ylabel="mean error (rad rms)", ylim=(floor, 4))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


def diameter_reasons(
    diameters: NDArray,
    flat: NDArray,
    aberrated: NDArray,
    measured: Mapping[float, float],
    sensitivity: Mapping[str, NDArray],
    claimed: float,
) -> Figure:
    """Factor of one iteration, and sensitivity to single modes, against the diameter of the dimple.

    Parameters
    ----------
    diameters : ndarray, shape (n,), lambda/D
    flat : ndarray, shape (n,)
        Factor around a flat wavefront.
    aberrated : ndarray, shape (n, n_screens)
        Factor around screens.
    measured : mapping of diameter to factor
        Observed on the first screen.
    sensitivity : mapping of name to ndarray, shape (n,), 1 / radian
    claimed : float, lambda/D
        As for `dimple_diameter`.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2))
    color = LOOKS["PhaseShifted"].color
    flat_color, ring_color, *_ = (style["color"] for style in OTHER_STYLES)
    left.plot(diameters, flat, color=flat_color, lw=1.5, label="flat wavefront")
    left.fill_between(
        diameters,
        aberrated.min(axis=1),
        aberrated.max(axis=1),
        color=color,
        alpha=0.3,
        lw=0,
        label="screens, range",
    )
    left.plot(diameters, aberrated[:, 0], color=color, lw=1.5, label="first screen")
    left.plot(
        list(measured), list(measured.values()), "o", mfc="none", mec=ring_color, label="first screen, observed"
    )
    left.axhline(1, color="#555555", lw=1)
    left.text(0.05, 1.015, "diverges above, converges below", color="#555555", fontsize=9)
    left.set(ylabel="factor of the error, one iteration", ylim=(0, 1.2))
    left.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
    for (name, values), style in zip(sensitivity.items(), OTHER_STYLES, strict=False):
        right.plot(diameters, values, lw=1.8, label=name, **style | {"marker": "none"})
    right.set(ylabel="sensitivity of the two frames (1/rad)", ylim=(0, 2.8))
    right.legend(loc="upper right", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
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
