"""Variants of a finished figure: dark for pages in dark mode, narrow for phones, and both."""

from __future__ import annotations

import colorsys
import pickle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba, to_rgba_array
from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 3.7, 2.7  # of a narrow figure and of each panel in it, inch
_PARTS = "color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"


def variants(figure: Figure) -> dict[str, Figure]:
    """Return copies of a figure: "dark", and if its panels lie on a grid "narrow" and "narrow-dark".

    Figures with pictures that have no axes get no narrow variant: they lose little when they are small.
    """
    state = pickle.dumps(figure)
    made = {"dark": _darkened(_copy(state))}
    panels = [axes for axes in figure.axes if axes.get_subplotspec()]
    if panels and all(axes.get_xticks().size for axes in panels):
        made |= {"narrow": _stacked(_copy(state)), "narrow-dark": _darkened(_stacked(_copy(state)))}
    return made


def _copy(state: bytes) -> Figure:
    """Return a copy of a pickled figure that no notebook shows."""
    figure = pickle.loads(state)
    plt.close(figure)
    return figure


def _stacked(figure: Figure) -> Figure:
    """Put the panels of a figure below each other, in place."""
    panels = [axes for axes in figure.axes if axes.get_subplotspec()]
    height = _WIDTH if any(axes.get_aspect() != "auto" for axes in panels) else _HEIGHT
    for axes in panels:
        _label(axes, panels)
    grid = figure.add_gridspec(len(panels), 1)
    for place, axes in enumerate(panels):
        axes.set_subplotspec(grid[place, 0])
    entries = 0
    for legend in list(figure.legends):
        handles: Any = legend.legend_handles
        texts = legend.get_texts()
        legend.remove()
        labels, size = [text.get_text() for text in texts], texts[0].get_fontsize()
        figure.legend(handles, labels, loc="outside lower center", fontsize=size)
        entries += len(texts)
    figure.set_size_inches(_WIDTH, len(panels) * height + 0.2 * entries)
    figure.set_layout_engine("constrained")  # a saved figure has none
    return figure


def _label(axes: Axes, panels: list[Axes]) -> None:
    """Give a panel the labels and the title that it shares with others of its row and column."""
    spec: Any = axes.get_subplotspec()
    for one in panels:
        other: Any = one.get_subplotspec()
        if other.rowspan == spec.rowspan and not axes.get_ylabel() and axes.get_yticks().size:
            axes.set_ylabel(one.get_ylabel())
        if other.colspan == spec.colspan and not axes.get_xlabel() and axes.get_xticks().size:
            axes.set_xlabel(one.get_xlabel())
        if other.colspan == spec.colspan and not axes.get_title():
            axes.set_title(one.get_title(), fontsize=one.title.get_fontsize())
    axes.tick_params(labelbottom=True, labelleft=True)


def _darkened(figure: Figure) -> Figure:
    """Draw a figure in light colours on a dark ground, in place; maps and the marks on them stay."""
    kept: set[Artist] = {figure, *figure.axes}  # their patches are found as well
    for axes in figure.axes:
        if axes.images or axes.get_label() == "<colorbar>":
            drawn = (*axes.images, *axes.lines, *axes.collections, *axes.patches, *axes.texts)
            kept.update(part for artist in drawn for part in artist.findobj())
    for artist in set(figure.findobj()) - kept:
        if getattr(artist, "get_array", lambda: None)() is None:  # else its colours come from a map
            parts = [part for part in _PARTS if hasattr(artist, f"get_{part}") and hasattr(artist, f"set_{part}")]
            colors = {part: getattr(artist, f"get_{part}")() for part in parts}  # all, as one may follow another
            for part, color in colors.items():
                dark = [dark_color(one) for one in to_rgba_array(color)]
                getattr(artist, f"set_{part}")(dark if np.ndim(color) == 2 else dark[0] if dark else color)
    ink, grid = map(dark_color, ("#000000", "#dddddd"))
    for axes in figure.axes:
        axes.tick_params(which="both", color=ink, labelcolor=ink, grid_color=grid)
    return figure


def dark_color(color: Any) -> tuple[float, ...]:
    """Return a colour for a dark ground: grays inverted, others brighter, the dark ones most."""
    *rgb, alpha = to_rgba(color)
    hue, light, saturation = colorsys.rgb_to_hls(*rgb)
    light = 0.94 - 0.87 * light if saturation < 0.1 or light > 0.8 else max(light, 0.455 + 0.3 * light)
    return (*colorsys.hls_to_rgb(hue, light, saturation), alpha)
