"""Files of results for a reader to take away: each figure as a picture, and the numbers behind it."""

from __future__ import annotations

import ast
import csv
import io
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from studies.kit.variants import variants

FOLDER = "ZWFS_RESULTS"  # environment variable that names the folder
_DPI = 200
# Without dates and versions the same figure is the same file.
_METADATA = {"png": {"Software": None}, "pdf": {"Creator": None, "Producer": None, "CreationDate": None}}


def publish(figure: Figure, name: str, columns: Mapping[str, ArrayLike]) -> None:
    """Write a figure and its numbers to the folder that the environment variable ZWFS_RESULTS names."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
        raise ValueError(f"name = {name!r}: expected lower-case letters, digits, - and _")
    contents = {"csv": _csv(columns)}
    folder = os.environ.get(FOLDER)
    if folder:
        contents |= {f"{kind}.png": _picture(one, "png") for kind, one in variants(figure).items()}
    for kind in _METADATA if folder else ("png",):  # the first one fixes the layout
        contents[kind] = _picture(figure, kind)
    if folder:
        for kind, content in contents.items():
            _write(Path(folder) / f"{name}.{kind}", content)


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


def _picture(figure: Figure, kind: str) -> bytes:
    """Draw a figure in a format, with the layout of the first one."""
    stream = io.BytesIO()
    # After a save matplotlib asks these settings for a layout, even if the figure was made without one.
    with rc_context({"figure.constrained_layout.use": False, "figure.autolayout": False}):
        figure.savefig(stream, format=kind, dpi=_DPI, metadata=_METADATA[kind])
        if figure.get_layout_engine() is not None:
            # Constrained layout goes on moving the axes each time it runs.
            figure.set_layout_engine("none")
    return stream.getvalue()


def _csv(columns: Mapping[str, ArrayLike]) -> bytes:
    """Columns as the bytes of a CSV file; a scalar stands in every row."""
    arrays = {header: np.asarray(column) for header, column in columns.items()}
    if len({array.shape for array in arrays.values()} - {()}) > 1:
        sizes = ", ".join(f"{header!r}: {array.size}" for header, array in arrays.items())
        raise ValueError(f"columns differ in length: {sizes}")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(arrays)
    filled = np.broadcast_arrays(*map(np.atleast_1d, arrays.values()))
    writer.writerows(zip(*(map(_text, array) for array in filled), strict=True))
    return stream.getvalue().encode()


def _text(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)


def _write(path: Path, content: bytes) -> None:
    """Write a file in one step, so that nobody reads a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(path)
