"""Files of results for a reader to take away: each figure as a picture, and the numbers behind it."""

from __future__ import annotations

import ast
import csv
import io
import os
import re
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit.drawn import drawn_columns
from studies.kit.variants import variants

FOLDER = "ZWFS_RESULTS"  # environment variable that names the folder
SCREENS = "_screens"  # after the name of a figure: the file with a row for each screen
_DPI = 200
# Without dates and versions the same figure is the same file.
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
_RC: dict[Any, Any] = {
    # After a save matplotlib asks these two for a layout, even if the figure was made without one.
    "figure.constrained_layout.use": False,
    "figure.autolayout": False,
    "pdf.fonttype": 42,  # TrueType: journals refuse the default, Type 3
    "svg.hashsalt": "zwfs",  # element ids are random unless salted
}


def publish(figure: Figure, name: str, screens: Mapping[str, ArrayLike] | None = None) -> None:
    """Write a figure, its numbers and those of single screens to the folder that ZWFS_RESULTS names."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
        raise ValueError(f"name = {name!r}: expected lower-case letters, digits, - and _")
    contents = {}
    folder = os.environ.get(FOLDER)
    if folder:
        contents = {".csv": csv_bytes(drawn_columns(figure))}
        contents |= {} if screens is None else {f"{SCREENS}.csv": csv_bytes(screens)}
        contents |= {f".{kind}.png": picture_bytes(variant, "png") for kind, variant in variants(figure).items()}
    for kind in METADATA if folder else ("png",):  # the first one fixes the layout
        contents[f".{kind}"] = picture_bytes(figure, kind)
    if folder:
        for end, content in contents.items():
            _write(Path(folder) / f"{name}{end}", content)


def screen_columns(axes: Mapping[str, ArrayLike], values: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns with a row for each screen, from values (n_1, ..., n_screens) along the named axes."""
    *_, n_screens = next(iter(values.values())).shape
    grid = np.meshgrid(*axes.values(), np.arange(1, n_screens + 1), indexing="ij")
    named = zip((*axes, "screen"), grid, strict=True)
    return {header: column.ravel() for header, column in (*named, *values.items())}


def screen_errors(axis: str, values: ArrayLike, errors: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns with a row for each screen, from errors (n, n_screens) by name along an axis."""
    return screen_columns({axis: values}, {f"{name}: error (rad rms)": error for name, error in errors.items()})


def stacked(header: str, tables: Mapping[Any, Mapping[str, NDArray]]) -> dict[str, NDArray]:
    """Columns of several tables below each other; the first column has the key of each row's table."""
    columns = list(zip(*(table.values() for table in tables.values()), strict=True))
    sizes = [len(column) for column in columns[0]]
    names = next(iter(tables.values()))
    keys = np.repeat(np.array(list(tables)), sizes)
    return {header: keys} | {name: np.concatenate(parts) for name, parts in zip(names, columns, strict=True)}


def glue_numbers(numbers: Mapping[str, float | str]) -> None:
    """Store numbers in the output of a notebook's cell, under names by which pages of the book show them."""
    from myst_nb import glue

    for name, value in numbers.items():
        glue(name, value, display=False)


def rounded(numbers: Mapping[str, float | str], form: str = ".4f") -> dict[str, float | str]:
    """Return numbers for the text, rounded so that they are the same on every machine; strings stay."""
    return {
        name: value if isinstance(value, str) else float(f"{float(value):{form}}")
        for name, value in numbers.items()
    }


def published(source: str) -> list[str]:
    """Return the names under which code publishes figures."""
    if "publish(" not in source:
        return []
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    named = (call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "publish")
    return [ast.literal_eval(call.args[1]) for call in named]


def picture_bytes(figure: Figure, kind: str) -> bytes:
    """Draw a figure in a format, with the layout of the first one."""
    stream = io.BytesIO()
    with rc_context(_RC):
        figure.savefig(stream, format=kind, dpi=_DPI, metadata=METADATA[kind])
        if figure.get_layout_engine() is not None:
            # Constrained layout goes on moving the axes each time it runs.
            figure.set_layout_engine("none")
    return stream.getvalue()


def csv_bytes(columns: Mapping[str, ArrayLike]) -> bytes:
    """Columns as the bytes of a CSV file; the short ones end with empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    texts = (map(_text, np.asarray(column)) for column in columns.values())
    writer.writerows(zip_longest(*texts, fillvalue=""))
    return stream.getvalue().encode()


def _text(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)


def _write(path: Path, content: bytes) -> None:
    """Write a file in one step, so that nobody reads a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(path)
