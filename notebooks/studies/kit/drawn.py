"""Numbers of a figure as columns, from what its panels show: curves, bars, bands, error bars and pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.container import BarContainer, ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

Series = tuple[dict[str, NDArray], str, NDArray]
"""Places by the name of their axis, name of the values there, and values."""


def drawn_columns(figure: Figure) -> dict[str, NDArray]:
    """Return the numbers of a figure as columns of unequal length: places, then all values at these places.

    The labels of a figure name the columns. A label that begins with _ is not in the legend, but in a column. If a
    panel has curves with labels, those without one guide the eye, and have no column.
    """
    groups: dict[Any, dict[str, NDArray]] = {}
    for places, name, values in _all_series(figure):
        key = tuple((axis, column.tobytes()) for axis, column in places.items())
        group = groups.setdefault(key, dict(places))
        if not np.array_equal(group.get(name, np.nan), values):
            group[_unused(name, group)] = values
    columns: dict[str, NDArray] = {}
    for group in groups.values():
        for name, column in group.items():
            columns[_unused(name, columns)] = column
    return columns


def _unused(name: str, columns: dict[str, NDArray]) -> str:
    """Return a name, with a number if a column has it already."""
    names = (f"{name} ({number})" if number > 1 else name for number in range(1, len(columns) + 2))
    return next(unused for unused in names if unused not in columns)


def _all_series(figure: Figure) -> Iterator[Series]:
    pictures = [picture for axes in figure.axes for picture in (*axes.images, *axes.collections)]
    bars = [(picture, picture.colorbar.ax) for picture in pictures if picture.colorbar]
    scales = {_colors(picture): bar.get_ylabel() or bar.get_xlabel() for picture, bar in bars}
    panels = [axes for axes in figure.axes if all(axes is not bar for _, bar in bars)]
    for axes in panels:
        labels = shared_labels(axes, panels)
        maps = list(_pictures(axes, labels, scales))
        yield from maps
        if not maps and axes.axison and axes.get_xticks().size:  # else marks on a picture, or a drawing
            yield from _curves(axes, *labels[:2], title=labels[2] if len(panels) > 1 else "")


def _colors(picture: Any) -> tuple[str, Any]:
    return picture.get_cmap().name, picture.get_clim()


def shared_labels(axes: Any, panels: list[Any]) -> tuple[str, str, str]:
    """Return the label of x and of y and the title of a panel, or those of others of its column or row."""
    spec = axes.get_subplotspec()
    placed = [panel for panel in panels if panel.get_subplotspec()] if spec else []
    row = [axes, *(panel for panel in placed if panel.get_subplotspec().rowspan == spec.rowspan)]
    column = [axes, *(panel for panel in placed if panel.get_subplotspec().colspan == spec.colspan)]
    return (
        next(filter(None, (panel.get_xlabel() for panel in column)), ""),
        next(filter(None, (panel.get_ylabel() for panel in row)), ""),
        next(filter(None, (panel.get_title() for panel in column)), ""),
    )


def _curves(axes: Any, x: str, y: str, title: str) -> Iterator[Series]:
    across = 0
    if _categories(axes.yaxis) is not None:  # rows with names: the values are across
        x, y, across = y or "row", x, 1

    def series(points: Any, label: Any, *more: str) -> Series:
        places, values = points[:, across], points[:, 1 - across]
        axis = axes.yaxis if across else axes.xaxis
        names = _categories(axis)
        if names is not None:
            places = names[np.clip(np.rint(places).astype(int), 0, len(names) - 1)]
        return (
            {_joined(x): places} | _second_axes(axes, points[:, 0]),
            _joined(title, _named(label), *more, y),
            values,
        )

    lines = [line for line in axes.lines if len(line.get_xydata()) and line.get_label() != "_nolegend_"]
    for line in [line for line in lines if _named(line.get_label())] or lines:
        places, name, values = series(line.get_xydata(), line.get_label())
        if line.get_transform() == axes.transData:
            yield places, name, values
        elif line.get_transform() == axes.get_yaxis_transform():  # one value everywhere
            yield {}, name, values[:1]
    for container in axes.containers:
        if isinstance(container, BarContainer):
            ends = [(bar.get_x() + bar.get_width(), bar.get_y() + bar.get_height() / 2) for bar in container]
            yield series(np.array(ends), container.get_label())
        if isinstance(container, ErrorbarContainer):
            if container.lines[0]:
                yield series(container.lines[0].get_xydata(), container.get_label())
            bars = np.array(container.lines[2][0].get_segments())
            half = bars.mean(axis=1)
            half[:, 1 - across] = np.ptp(bars, axis=1)[:, 1 - across] / 2
            yield series(half, container.get_label(), "error bar")
    for band in axes.collections:
        if isinstance(band, PolyCollection) and _named(band.get_label()):
            outline: Any = band.get_paths()[0].vertices  # along one edge, and back along the other
            half_way = (len(outline) - 3) // 2
            yield series(outline[1 : half_way + 1], band.get_label(), "low")
            yield series(outline[half_way + 2 : -1][::-1], band.get_label(), "high")


def _second_axes(axes: Any, places: NDArray) -> dict[str, NDArray]:
    """Places on the second horizontal axes of a panel, by their labels."""
    scaled = axes.xaxis.get_transform().transform(places)
    second = (child for child in axes.child_axes if hasattr(child, "set_functions"))  # no inset
    return {
        _joined(child.get_xlabel()): child.xaxis.get_transform().inverted().transform(scaled) for child in second
    }


def _pictures(axes: Any, labels: tuple[str, str, str], scales: dict[tuple[str, Any], str]) -> Iterator[Series]:
    x, y, title = labels
    if not axes.get_xticks().size:  # without ticks, the label beside a picture is the name of its row
        x, y, title = "", "", _joined(y, title)
    for picture in (*axes.images, *axes.collections):
        name = _named(picture.get_label()) or title
        if name and (picture in axes.images or isinstance(picture, QuadMesh)):
            values: NDArray = np.ma.filled(np.ma.asarray(picture.get_array(), float), np.nan)
            shown = np.isfinite(values)
            places = zip((x or "x (pixel)", y or "y (pixel)"), _places(picture, values.shape), strict=True)
            by_axis = {_joined(axis): place[shown] for axis, place in places}
            yield by_axis, _joined(name, scales.get(_colors(picture), "")), values[shown]


def _places(picture: Any, shape: tuple[int, ...]) -> Any:
    """Middles of the pixels of a picture, x and y."""
    if isinstance(picture, QuadMesh):
        coordinates: Any = picture.get_coordinates()
        corners = np.moveaxis(coordinates, -1, 0)
        return corners if corners.shape[1:] == shape else (corners[:, 1:, 1:] + corners[:, :-1, :-1]) / 2
    x_low, x_high, y_low, y_high = picture.get_extent()
    width, height = (x_high - x_low) / shape[1], (y_high - y_low) / shape[0]
    middle = x_low + width / 2, y_low + height / 2
    return np.meshgrid(middle[0] + width * np.arange(shape[1]), middle[1] + height * np.arange(shape[0]))


def _categories(axis: Any) -> NDArray | None:
    """Return the names of the ticks of an axis at 0, 1, 2 ...; None if it shows numbers."""
    ticks = np.sort(axis.get_majorticklocs())
    names = axis.get_major_formatter().format_ticks(ticks)
    if not isinstance(axis.get_major_locator(), FixedLocator) or names == [f"{tick:g}" for tick in ticks]:
        return None
    return np.array([*map(_plain, names)]) if np.array_equal(ticks, np.arange(ticks.size)) else None


def _named(label: Any) -> str:
    """Return a label, or nothing if matplotlib invented it."""
    invented = re.fullmatch(r"_((child|image|container)\d+|nolegend_)?", str(label))
    return "" if invented else str(label).removeprefix("_")


def _joined(*parts: str) -> str:
    return ": ".join(filter(None, map(_plain, parts)))


def _plain(text: str) -> str:
    """Return a text on one line, without the marks of TeX."""
    text = re.sub(r"\\mathrm\{(\w+)\}|(?<=_)\{(\w+)\}|\\hat|\\,", r"\1\2", text)
    return " ".join(re.sub(r"[\\$]", "", text).replace("{", "(").replace("}", ")").split())
