"""Variants of a finished figure: dark for pages in dark mode, narrow for phones, and both."""

from __future__ import annotations

import colorsys
import pickle
import textwrap
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text

from studies.kit.style import ALONE, DARK_PHASE_MAP, PHASE_MAP, TALL

_WIDTH, _HEIGHT = 3.7, 2.7  # of a narrow figure and of each panel in it, inch
_LETTERS = 11  # points, at most: some figures have larger ones, as pages show them smaller than they are
_LONE = 0.7  # width of pictures that stand alone in their rows, over that of the figure
_ENTRY = 420  # points times letters: an entry of a legend with so many letters is as wide as the figure
_LETTERS_OF_ENTRY = 44  # in a line
_MARGIN = 0.1  # around what is drawn, inch
_ROUNDS = 12  # at most, to find the height
_STEP = 1.8  # of the height over the gaps, which fall by about half of it
_PAD = 0.07  # above and below a panel, inch: the label of one and the title of the next must not touch
_BAR = 0.6  # height of a colour bar with its numbers and its label, inch
_DIMMEST = 0.22  # luminance of a colour on the dark ground: a contrast of 4.7, enough for letters
_PARTS = "color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"


_DRAWN: WeakKeyDictionary[Figure, Figure] = WeakKeyDictionary()  # the narrow variants of drawings


def add_narrow(figure: Figure, narrow: Figure) -> Figure:
    """Give a drawing, whose parts lie on no grid, its narrow variant, and return the drawing."""
    plt.close(narrow)
    _DRAWN[figure] = narrow
    return figure


def has_narrow(figure: Figure) -> bool:
    """Whether a figure has narrow variants."""
    return figure in _DRAWN or any(axes.get_subplotspec() for axes in figure.axes)


def variants(figure: Figure) -> dict[str, Figure]:
    """Return copies of a figure: "dark", and for panels on a grid and some drawings "narrow" and "narrow-dark"."""
    state = pickle.dumps(figure)
    copies = {"dark": _darkened(_copy(state))}
    if has_narrow(figure):
        drawn = _DRAWN.get(figure)
        copies["narrow"] = _copy(pickle.dumps(drawn)) if drawn else _stacked(_copy(state))
        copies["narrow-dark"] = _darkened(_copy(pickle.dumps(copies["narrow"])))
    return copies


def _copy(state: bytes) -> Figure:
    """Return a copy of a pickled figure that no notebook shows."""
    figure = pickle.loads(state)
    plt.close(figure)
    return figure


def _stacked(figure: Figure) -> Figure:
    """Put the panels of a figure below each other, in place, and pictures in pairs."""
    panels = [axes for axes in figure.axes if axes.get_subplotspec()]
    by_columns = _have_common_titles(panels)
    for axes in panels:
        _label(axes, panels)
    rows = _rows(panels, by_columns=by_columns)
    paired = any(len(row) == 2 for row in rows)
    heights = [_height(row, _WIDTH / 2 if paired else _WIDTH * _LONE) for row in rows]
    grid = figure.add_gridspec(len(rows), 2, height_ratios=heights)
    for place, row in enumerate(rows):
        for column, axes in enumerate(row):
            axes.set_subplotspec(grid[place, column] if len(row) == 2 else grid[place, :])
    bars = sum(_turn(figure, axes) for axes in list(figure.axes) if axes.get_label() == "<colorbar>")
    entries = 0
    alone = panels[0].get_legend() if len(panels) == 1 else None
    for legend in [*figure.legends, *([alone] if alone else [])]:
        handles: Any = legend.legend_handles
        texts = legend.get_texts()
        legend.remove()
        labels = [textwrap.fill(text.get_text(), _LETTERS_OF_ENTRY) for text in texts]
        lines = [line for label in labels for line in label.split("\n")]
        size = min(texts[0].get_fontsize(), _ENTRY / max(map(len, lines)))
        # Readers meet the key before the first of several panels.
        place_of_key: Any = "outside upper center" if len(rows) > 1 else "outside lower center"
        figure.legend(handles, labels, loc=place_of_key, fontsize=size)
        entries += len(lines)
    for text in figure.findobj(Text):
        text.set_fontsize(min(text.get_fontsize(), _LETTERS))
    figure.set_size_inches(_WIDTH, sum(heights) + _BAR * bars + 0.2 * entries)
    figure.set_layout_engine("constrained", h_pad=_PAD)  # a saved figure has none
    _fit_height(figure)
    for axes in panels:
        # The layout ignores the width of labels.
        if axes.xaxis.label.get_window_extent().x1 > figure.bbox.x1 - figure.dpi * _MARGIN:
            axes.set_xlabel(axes.get_xlabel(), loc="right")
    return figure


def _have_common_titles(panels: list[Axes]) -> bool:
    """Whether the title of a panel stands for others below it."""
    columns: dict[Any, set[bool]] = {}
    for axes in panels:
        spec: Any = axes.get_subplotspec()
        columns.setdefault((spec.colspan.start, spec.colspan.stop), set()).add(bool(axes.get_title()))
    return any(len(kinds) == 2 for kinds in columns.values())


def _fit_height(figure: Figure) -> None:
    """Adapt the height, as pictures keep their proportions and the layout leaves gaps or cuts labels off."""
    for _ in range(_ROUNDS):
        for _ in range(2):  # the layout has settled after the second time
            figure.draw_without_rendering()
        change = figure.get_tightbbox().height + 2 * _MARGIN - figure.get_figheight()
        if abs(change) < _MARGIN:
            return
        figure.set_figheight(round(figure.get_figheight() + _STEP * change, 2))


def _rows(panels: list[Axes], *, by_columns: bool) -> list[list[Axes]]:
    """Order panels by columns or rows; two pictures of one that follow each other share a row."""

    def order(axes: Axes) -> tuple[int, int]:
        spec: Any = axes.get_subplotspec()
        place = spec.colspan.stop, spec.rowspan.start
        return place if by_columns else place[::-1]

    rows: list[list[Axes]] = []
    for axes in sorted(panels, key=order):
        pair = [*rows[-1], axes] if rows else []
        if len(pair) == 2 and len({order(panel)[0] for panel in pair}) == 1 and all(map(_fits_half, pair)):
            rows[-1] = pair
        else:
            rows.append([axes])
    return rows


def _is_picture(axes: Axes) -> bool:
    return not axes.get_xticks().size


def _fits_half(axes: Axes) -> bool:
    """Whether a panel is a picture that is not too wide, nor its title, for half of a narrow figure."""
    size = min(float(axes.title.get_fontsize()), _LETTERS)
    letters = max(map(len, axes.get_title().split("\n")))
    fits = _proportion(axes) > 0.6 and letters * size <= _ENTRY / 2
    return _is_picture(axes) and fits and axes.get_gid() != ALONE


def _proportion(axes: Axes) -> float:
    """Height of a panel with equal units on both axes over its width."""
    return abs(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim()))


def _height(row: list[Axes], width: float) -> float:
    """Height of a row of panels with their titles, inch: of pictures of that width."""
    if _is_picture(row[0]):
        texts = [axes.get_title() + "\n" * bool(axes.get_title()) + axes.get_xlabel() for axes in row]
        lines = max(len(text.splitlines()) for text in texts)
        return width * max(map(_proportion, row)) + 0.2 * lines
    if row[0].get_aspect() != "auto":
        return _WIDTH * _proportion(row[0])
    return _HEIGHT * (1.5 if row[0].get_gid() == TALL else 1)


def _turn(figure: Figure, axes: Axes) -> bool:
    """Put a colour bar at the side of pictures below them, and one that several other panels share above them.

    Return whether a bar is below or above its panels now.
    """
    info = axes._colorbar_info  # type: ignore[attr-defined]  # the only record of the panels that share the bar
    parents = info["parents"]
    pictures = all(map(_is_picture, parents))
    if info["location"] == "right" and (pictures or len(parents) > 1):
        old: Any = axes._colorbar  # type: ignore[attr-defined]
        label, size = axes.get_ylabel(), axes.yaxis.label.get_fontsize()
        marks = dict(zip(old.get_ticks(), axes.get_yticklabels(), strict=False))
        ticks = axes.get_yticklabels()[0].get_fontsize()
        mappable, extend = old.mappable, old.extend
        old.remove()
        place = "bottom" if pictures else "top"
        bar = figure.colorbar(mappable, ax=parents, location=place, extend=extend, aspect=20)
        if not pictures:
            bar.set_ticks(list(marks), labels=[mark.get_text() for mark in marks.values()])
            bar.minorticks_off()
        bar.set_label(label, fontsize=size)
        bar.ax.tick_params(labelsize=ticks)
    return pictures or len(parents) > 1


def _label(axes: Axes, panels: list[Axes]) -> None:
    """Give a panel the labels and the title that it shares with others of its row and column."""
    spec: Any = axes.get_subplotspec()
    for panel in panels:
        place: Any = panel.get_subplotspec()
        if place.rowspan == spec.rowspan and not axes.get_ylabel() and axes.get_yticks().size:
            axes.set_ylabel(panel.get_ylabel())
        if place.colspan == spec.colspan and not axes.get_xlabel() and axes.get_xticks().size:
            axes.set_xlabel(panel.get_xlabel())
        if place.colspan == spec.colspan and not axes.get_title():
            axes.set_title(panel.get_title(), fontsize=panel.title.get_fontsize())
    axes.tick_params(labelbottom=True, labelleft=True)


def _darkened(figure: Figure) -> Figure:
    """Draw a figure in light colours on a dark ground, in place; maps and their marks stay, but phases darken."""
    phases = [image for axes in figure.axes for image in axes.images if image.get_cmap().name == PHASE_MAP]
    for image in phases:
        image.set_cmap(DARK_PHASE_MAP)
        if image.colorbar:  # a copy does not follow its map
            image.colorbar.update_normal(image)
    marked: set[Artist] = {figure, *figure.axes}  # their patches are found as well
    for axes in {*figure.axes} - {image.axes for image in phases}:
        if axes.images or axes.findobj(QuadMesh):
            marks = (*axes.images, *axes.lines, *axes.collections, *axes.patches, *axes.texts)
            marked.update(part for artist in marks for part in artist.findobj())
    drawn = set(figure.findobj()) - marked
    arrows = [text.arrow_patch for text in drawn if isinstance(text, Annotation) and text.arrow_patch]
    boxes = [text.get_bbox_patch() for text in drawn if isinstance(text, Text) and text.get_bbox_patch()]
    for artist in drawn.union(arrows, boxes):
        if getattr(artist, "get_array", lambda: None)() is None:  # else its colours come from a map
            parts = [part for part in _PARTS if hasattr(artist, f"get_{part}") and hasattr(artist, f"set_{part}")]
            colors = {part: getattr(artist, f"get_{part}")() for part in parts}  # all, as one may follow another
            for part, color in colors.items():
                dark = [dark_color(rgba) for rgba in to_rgba_array(color)]
                getattr(artist, f"set_{part}")(dark if np.ndim(color) == 2 else dark[0] if dark else color)
    ink, grid = map(dark_color, ("#000000", "#dddddd"))
    for axes in figure.axes:
        axes.tick_params(which="both", color=ink, labelcolor=ink, grid_color=grid)
    return figure


def dark_color(color: Any) -> tuple[float, ...]:
    """Return a colour for a dark ground: grays inverted, others brighter, the dark ones most."""
    *rgb, alpha = to_rgba(color)
    hue, light, saturation = colorsys.rgb_to_hls(*rgb)
    brightest = 3 * light  # else dark shades of a colour would look the same
    light = 0.94 - 0.87 * light if saturation < 0.1 or light > 0.8 else max(light, 0.455 + 0.3 * light)
    while saturation >= 0.1 and _luminance(colorsys.hls_to_rgb(hue, light, saturation)) < _DIMMEST:
        light += 0.01
    while saturation >= 0.1 and _luminance(colorsys.hls_to_rgb(hue, light, saturation)) > brightest:
        light -= 0.01
    return (*colorsys.hls_to_rgb(hue, light, saturation), alpha)


def _luminance(rgb: Sequence[float]) -> float:
    """Relative luminance of a colour, 1 for white."""
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in rgb)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
