"""Figures of photon noise: errors next to the bound, error bars, and designs of sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from zwfs.paper.design import Design, DesignMap
from zwfs.paper.photon_noise import EXPECTED, SIGMAS, ErrorBars, PhotonCurves
from zwfs.plots.style import LOOKS, OTHER_STYLES, _looks

COST_LINES = dict.fromkeys((1.25, 1.5, 2), "#222222") | dict.fromkeys((3, 5, 10), "#ffffff")
"""Photon costs at which a line is drawn, and its colour, which differs from that of the map."""

_NEAREST = 0.11  # of a label to anything else, inch
_OUTLINE = withStroke(linewidth=3, foreground="#ffffff")  # of the marks, on dark colours of the map
_MARKS = ("o", "s", "D", "*", "P", "X")


def photon_noise(curves: PhotonCurves) -> Figure:
    """Error of each method and the bound against the number of photons, and their ratio; one column per input."""
    size = curves.rms.size
    figure, panels = plt.subplots(2, size, figsize=(7, 6.4), sharex=True, sharey="row", squeeze=False)
    for column, (errors, ratios) in enumerate(panels.T):
        bound = curves.bound[column]
        errors.loglog(
            curves.photons, bound, color="#999999", lw=5, solid_capstyle="round", label="bound", zorder=0
        )
        ratios.axhline(1, color="#999999", lw=5, zorder=0)
        for name, look in _looks(curves.errors):
            errors.plot(curves.photons, curves.error(name)[column], ms=5, label=look.label, **look.style)
            ratios.plot(curves.photons, curves.ratio(name)[column], ms=5, **look.style)
        errors.set_title(f"input {curves.rms[column]:g} rad rms", fontsize=10)
        ratios.set(xlabel="photons per point", xscale="log", ylim=(0.9, 1.6))
    panels[0, 0].set_ylabel("error (rad rms)")
    panels[1, 0].set_ylabel("error / bound")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def error_bars(rows: Sequence[ErrorBars]) -> Figure:
    """Share of the points within a number of standard errors, next to that of Gaussian errors."""
    figure, axes = plt.subplots(figsize=(6.5, 4))
    axes.plot(SIGMAS, EXPECTED, color="#999999", lw=5, label="Gaussian errors", zorder=0)
    wrong = iter(OTHER_STYLES)
    for row in rows:
        right = row.assumed == 1
        style = LOOKS["MaximumLikelihood"].style if right else next(wrong)
        label = "right number of photons" if right else f"{row.assumed:g} times the photons assumed"
        axes.plot(SIGMAS, row.within, ms=6, label=label, **style)
    axes.axvline(1, color="#555555", lw=1, zorder=0.5)
    axes.set(xlabel="width of the error bar (standard errors)", ylabel="share of the points", ylim=(0, 1.02))
    axes.set_xlim(0, SIGMAS[-1] + 0.1)
    axes.legend(loc="lower right")
    return figure


def design_maps(maps: DesignMap, designs: Sequence[Design], costs: Mapping[str, NDArray]) -> Figure:
    """Photon cost against diameter and phase shift, one panel for each kind of wavefront.

    A design is a mark at its diameter and half the difference of its phase shifts, in the colour of its cost. A
    bar joins shifts of different size. The diameters and angles of the maps must be evenly spaced.

    Parameters
    ----------
    maps : DesignMap
    designs : sequence of Design
    costs : mapping of str to ndarray, shape (n_designs,)
        Photon cost of the designs by the name of the wavefronts.
    """
    figure, panels = plt.subplots(1, len(maps.costs), figsize=(7, 4.4), sharey=True, squeeze=False)
    x, y = maps.diameters, maps.angles / np.pi
    half = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1]
    contours: list[dict[float, list[NDArray]]] = []
    for axes, (name, grid) in zip(panels[0], maps.costs.items(), strict=True):
        axes.grid(False)
        shown = axes.imshow(
            grid.T, cmap="cividis_r", norm=LogNorm(1, 10), extent=extent, aspect="auto", interpolation="bilinear"
        )
        lines = axes.contour(x, y, grid.T, list(COST_LINES), colors=list(COST_LINES.values()), linewidths=0.8)
        contours.append(dict(zip(COST_LINES, lines.allsegs, strict=True)))
        marked = zip((*designs, maps.best(name)), (*costs[name], grid.min()), _MARKS, strict=False)
        for design, cost, mark in marked:
            low, high = sorted(abs(theta) / np.pi for theta in design[2:])
            if high > low + 1e-9:
                axes.plot([design.diameter] * 2, [low, high], color="#ffffff", lw=4)
                axes.plot([design.diameter] * 2, [low, high], color="#000000", lw=1.5)
            label = "best of each map" if design.name.startswith("best") else design.name
            size = {"*": 15}.get(mark, 8)
            axes.plot(
                design.diameter, (low + high) / 2, mark, mfc=shown.to_rgba(cost), mec="#000000", mew=1.2, ms=size,
                label=label, ls="none", clip_on=False, zorder=5, path_effects=[_OUTLINE],
            )  # fmt: skip
        axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="diameter (λ/D)")
        axes.set_title(name, fontsize=10)
        axes.yaxis.set_major_formatter(FormatStrFormatter("±%gπ"))
    panels[0, 0].set_ylabel("phase shifts (rad)")
    bar = figure.colorbar(
        shown, ax=list(panels[0]), label="photons / photons of an ideal sensor", extend="max", aspect=25
    )
    bar.ax.yaxis.set_major_locator(FixedLocator([1, 2, 3, 5, 10]))
    bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    marks, labels = panels[0, 0].get_legend_handles_labels()
    handles: list[Any] = [copy(mark) for mark in marks]
    for handle in handles:  # a mark has another colour in each panel
        handle.set_markerfacecolor("#ffffff")
    figure.legend(handles, labels, loc="outside lower center", ncols=5, handletextpad=0.2, columnspacing=1)
    figure.draw_without_rendering()  # which decides the size of the panels
    for axes, paths in zip(panels[0], contours, strict=True):
        _label_contours(axes, paths, extent)
    return figure


def _label_contours(axes: Axes, paths: Mapping[float, Sequence[NDArray]], extent: Sequence[float]) -> None:
    """Write the cost of each contour on it, on the colour that the map has there."""
    marks = np.concatenate([_dense(np.asarray(line.get_xydata())) for line in axes.lines])
    shown: Any = axes.images[0]
    size = axes.get_window_extent().size / shown.figure.dpi
    for cost, (across, up) in label_places(paths, marks, extent, size).items():
        patch = {"facecolor": shown.to_rgba(cost), "edgecolor": "none", "boxstyle": "square,pad=0.1"}
        style: dict[str, Any] = {"color": COST_LINES[cost], "fontsize": 9, "bbox": patch}
        axes.text(across, up, f"{cost:g}", ha="center", va="center", **style)


def label_places(
    paths: Mapping[float, Sequence[NDArray]], marks: NDArray, extent: Sequence[float], size: Sequence[float]
) -> dict[float, NDArray]:
    """Choose a place for the label of each contour: far from other contours, marks, labels and the frame.

    Parameters
    ----------
    paths : mapping of float to sequence of ndarray, shape (n, 2)
        Parts of each contour by its level.
    marks : ndarray, shape (n, 2)
        Places to keep free.
    extent : sequence of float
        Left, right, lower and upper end of the map.
    size : sequence of float
        Width and height of the map, inch.

    Returns
    -------
    dict of ndarray, shape (2,)
        Place by level. A contour without room for a label is left out.
    """
    left, right, low, high = extent
    scale = np.divide(size, (right - left, high - low))
    frame = _dense(np.array([(left, low), (right, low), (right, high), (left, high), (left, low)]))
    points = {level: np.concatenate([np.empty((0, 2)), *parts]) for level, parts in paths.items()}
    places: dict[float, NDArray] = {}
    for level, own in points.items():
        others = [other for key, other in points.items() if key != level]
        taken = np.concatenate([frame, marks, *others, *(place[np.newaxis] for place in places.values())])
        distances = cdist(own * scale, taken * scale).min(axis=1)
        if distances.size and distances.max() > _NEAREST:
            places[level] = own[distances.argmax()]
    return places


def _dense(corners: NDArray) -> NDArray:
    """Points on a line with these corners."""
    steps = np.linspace(0, 1, 25)[:, np.newaxis]
    return np.concatenate([corners[:1], *(a + steps * (b - a) for a, b in pairwise(corners))])
