"""Interactive versions of figures, which Bokeh draws from the published CSV files when a reader asks for them.

A card has a button, see `button`: the page loads the scripts and the data after a click on it.
"""

import csv
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bokeh
import numpy as np
from docutils import nodes
from matplotlib import colormaps, rcParams
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from sphinx.application import Sphinx
from sphinx.util.fileutil import copy_asset_file

from studies.design import PUBLISHED, DesignMap
from studies.kit.style import LOOKS, Look
from studies.kit.variants import dark_color

FOLDER = "_static/explore"
LIBRARY = [
    Path(bokeh.__file__).parent / "server" / "static" / "js" / f"{name}.min.js" for name in ("bokeh", "bokeh-api")
]
HEADER = re.compile(r"([^:,]+)[:,] (.+)")  # a column is "NAME: QUANTITY" or "NAME, QUANTITY"
MEAN, SPREAD = "mean error (rad rms)", "standard deviation (rad rms)"
INPUT, DIAMETER = "input (rad rms)", "diameter (lambda/D)"

# Markers and dashes of matplotlib, in the words of Bokeh.
MARKERS = {"o": "circle", "s": "square", "^": "triangle", "v": "inverted_triangle", "x": "x", "+": "cross"}
MARKERS |= {"D": "diamond", "d": "diamond", "*": "star", "P": "plus"}
DASHES = {"--": "dashed", "-.": "dashdot", ":": "dotted"}

Columns = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Panel:
    """Curves of a quantity, one for each name in the columns of a CSV file.

    Attributes
    ----------
    x, y : str
        Column of the abscissa, and quantity of the ordinate.
    label : str
        Of the ordinate; by default `y`.
    log : str
        The logarithmic axes: "x", "y" or "xy".
    over : str
        Column by which the quantity is divided.
    limits : tuple of float
        First ends of the ordinate; by default those of the data.
    """

    x: str
    y: str
    label: str = ""
    log: str = ""
    over: str = ""
    limits: tuple[float, ...] = ()


@dataclass(frozen=True)
class Figure:
    """Panels of a figure, once for each value of the column `split` if given; `hidden` curves can be shown."""

    panels: tuple[Panel, ...]
    split: str = ""
    hidden: tuple[str, ...] = ()


FIGURES = {
    "fig03_dynamic_range": Figure(
        (Panel(INPUT, MEAN), Panel(INPUT, MEAN, "error / input", "y", INPUT)),
        hidden=("GradientDescentPoints", "GradientDescentStarted"),
    ),
    "fig04_dimple_diameter": Figure((Panel(DIAMETER, MEAN), Panel(DIAMETER, MEAN, log="y"))),
    "fig04_methods": Figure((Panel(DIAMETER, MEAN, log="y"),)),
    "fig09_bench_linearity": Figure((Panel(INPUT, MEAN), Panel(INPUT, "gain", limits=(0, 1.5)))),
    "photon_noise": Figure(
        (
            Panel("photons per point", "error (rad rms)", log="xy"),
            Panel(
                "photons per point", "error (rad rms)", "error / bound", "x", "bound: error (rad rms)", (0.9, 1.6)
            ),
        ),
        split=INPUT,
    ),
}
"""Figures of curves, by their published name."""

MAP = "design"

# Curves that stand for no method look as in the static figures.
_ITERATION = replace(LOOKS["PhaseShifted"], name="25 iterations", sees="", line="-")
OTHERS = {
    "bound": Look("bound", "", "#999999", "", "-"),
    "25 iterations": _ITERATION,
    "100 iterations": Look("100 iterations", "", "#555555", "", "--"),
    "400 iterations": Look("400 iterations", "", "#555555", "", ":"),
}


def button(figure: str) -> list[str]:
    """Return the MyST lines of the button under a published figure; none if it has no interactive version."""
    if figure not in FIGURES and figure != MAP:
        return []
    text = "Explore the map" if figure == MAP else "Explore the curves"
    size = sum(file.stat().st_size for file in LIBRARY) / 1e6
    tag = f'<button type="button" data-explore="{figure}">{text}</button> This loads {size:.1f} MB.'
    return ["", "```{raw} html", f'<p class="explore d-print-none">{tag}</p>', "```"]


def drawing(figure: str, file: Path) -> dict[str, Any]:
    """Return the input of book/_static/explore.js, ready for JSON, from the CSV file of a figure."""
    with file.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    columns = dict(zip(header, np.array(rows, float).T, strict=True))
    drawn = maps(columns) if figure == MAP else curves(columns, FIGURES[figure])
    return drawn | {"table": {"header": header, "rows": rows}}


def curves(columns: Columns, figure: Figure) -> dict[str, Any]:
    """Return the legend and the panels of a figure of curves."""
    found = {name for panel in figure.panels for name in of_quantity(columns, panel.y)}
    if not found:
        raise ValueError(f"columns = {', '.join(columns)}: expected curves of {figure.panels[0].y}")
    looks = {name: look for name, look in (OTHERS | LOOKS).items() if name in found}
    parts = {"": columns}
    if figure.split:
        values = columns[figure.split]
        parts = {
            f"input {one:g} rad rms": {name: column[values == one] for name, column in columns.items()}
            for one in np.unique(values)
        }
    panels = [
        {
            "title": title,
            "x": panel.x.replace("lambda", "λ"),
            "y": panel.label or panel.y,
            "log": panel.log,
            "limits": panel.limits,
            "curves": [points(part, panel, name) for name in looks],
        }
        for title, part in parts.items()
        for panel in figure.panels
    ]
    return {"legend": [entry(look, name not in figure.hidden) for name, look in looks.items()], "panels": panels}


def of_quantity(columns: Columns, quantity: str) -> dict[str, str]:
    """Return the columns of a quantity by the names of their curves."""
    parts = (HEADER.fullmatch(column) for column in columns)
    return {part[1]: part[0] for part in parts if part and part[2] == quantity}


def points(columns: Columns, panel: Panel, name: str) -> dict[str, list[float]]:
    """Return the points of a curve that its axes can show, and one standard deviation around them if known."""
    x, y = columns[panel.x], columns[of_quantity(columns, panel.y)[name]]
    with np.errstate(divide="ignore", invalid="ignore"):
        y = y / columns[panel.over] if panel.over else y
    shown = np.isfinite(y) & ((y > 0) | ("y" not in panel.log)) & ((x > 0) | ("x" not in panel.log))
    curve = {"x": x[shown].tolist(), "y": y[shown].tolist()}
    spread = of_quantity(columns, SPREAD).get(name)
    if spread and panel.y == MEAN and not panel.log:
        deviation = columns[spread][shown]
        curve |= {"low": np.maximum(y[shown] - deviation, 0).tolist(), "high": (y[shown] + deviation).tolist()}
    return curve


def entry(look: Look, shown: bool = True) -> dict[str, Any]:
    """Return an entry of the legend: the look of a curve on a light and on a dark page."""
    return {
        "name": look.label,
        "light": look.color,
        "dark": to_hex(dark_color(look.color)),
        "dash": dashes(look),
        "marker": MARKERS.get(look.marker, ""),
        "width": 5 if look is OTHERS["bound"] else 1.5,
        "shown": shown,
    }


def dashes(look: Look) -> list[float]:
    """Return the lengths of the dashes and gaps of a line, pixels."""
    if isinstance(look.line, tuple):
        pattern = look.line[1]
    else:
        pattern = rcParams[f"lines.{DASHES[look.line]}_pattern"] if look.line in DASHES else ()
    return [2 * length for length in pattern]


def maps(columns: Columns) -> dict[str, Any]:
    """Return the legend and the panels of the maps of designs; phase shifts are in units of pi."""
    diameter, angle, *costs = columns.values()
    titles = [name.rpartition(", ")[2] for name in list(columns)[2:]]
    diameters, angles = np.unique(diameter), np.unique(angle)
    shape = diameters.size, angles.size
    known = DesignMap(
        diameters, angles, {title: cost.reshape(shape) for title, cost in zip(titles, costs, strict=True)}
    )
    marks = [*PUBLISHED, known.all_round]
    cells = {"x": diameter.tolist(), "y": (angle / np.pi).round(6).tolist()}
    cells |= {"width": diameters[1] - diameters[0], "height": (angles[1] - angles[0]) / np.pi}
    panels = [
        {
            "title": title,
            "x": "diameter (λ/D)",
            "y": "phase shifts ± (π rad)",
            "log": "",
            "limits": (),
            "cells": cells | {"value": cost.tolist()},
            "curves": [
                {"x": [one.diameter], "y": [(abs(one.theta_a) + abs(one.theta_b)) / 2 / np.pi]}
                for one in (*marks, known.best(title))
            ],
        }
        for title, cost in zip(titles, costs, strict=True)
    ]
    named = zip((*(one.name for one in marks), "best of each map"), "osD*P", strict=True)
    legend = [
        entry(Look(name, "", "#000000", mark, "")) | {"dark": "#000000", "fill": "#ffffff"} for name, mark in named
    ]
    palette = [to_hex(color) for color in colormaps["cividis_r"](np.linspace(0, 1, 256))]
    return {"legend": legend, "panels": panels, "palette": palette}


def add_script(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: nodes.document) -> None:
    """Add the script to the pages with a button."""
    if "data-explore=" in context.get("body", ""):
        app.add_css_file("explore.css")
        app.add_js_file("explore.js", loading_method="defer")


def write(folder: Path, files: Iterable[Path]) -> None:
    """Write the data of the CSV files of figures to a folder, next to Bokeh."""
    folder.mkdir(parents=True, exist_ok=True)
    for script in LIBRARY:
        copy_asset_file(script, folder)
    for file in files:
        # Browsers block pages from the file system from reading data files.
        text = json.dumps(drawing(file.stem, file), separators=(",", ":"), allow_nan=False)
        (folder / f"{file.stem}.js").write_text(f"(window.zwfsExplore ??= {{}}).{file.stem} = {text};\n", "utf-8")


def write_data(app: Sphinx, exception: Exception | None) -> None:
    """Write the data of the published figures; a book without CSV files needs none."""
    if exception is None and app.builder.format == "html":
        runs = Path(app.srcdir, app.config.executed_notebooks)
        if found := [file for name in (*FIGURES, MAP) for file in runs.glob(f"*.files/{name}.csv")]:
            write(Path(app.outdir, FOLDER), found)


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the script to the pages, and the data at the end of each build."""
    app.connect("html-page-context", add_script)
    app.connect("build-finished", write_data)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
