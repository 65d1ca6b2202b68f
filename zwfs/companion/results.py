"""Files of results for a reader to take away: each figure as a picture, and the numbers behind it."""

from __future__ import annotations

import ast
import csv
import io
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from zwfs import _check
from zwfs._files import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = "ZWFS_RESULTS"  # environment variable that names the folder

# Without dates and versions the same figure is the same file.
_METADATA = {"png": {"Software": None}, "pdf": {"Creator": None, "Producer": None, "CreationDate": None}}


def publish(figure: Figure, name: str, columns: Mapping[str, ArrayLike], *, dpi: float = 200) -> None:
    """Write a figure and its numbers to the folder that the environment variable ZWFS_RESULTS names.

    The files are NAME.png, NAME.pdf and NAME.csv, and the pictures of `zwfs.plots.variants.variants`, such as
    NAME.dark.png. They are the same byte for byte from run to run. If the variable is not set nothing is written,
    but the arguments are checked and the figure is drawn. Drawing fixes its layout, so a notebook shows the same
    figure with and without a folder.

    Parameters
    ----------
    figure : matplotlib Figure
        To be finished: its layout stays as it is saved.
    name : str
        Stem of the files: lower-case letters, digits, ``-`` and ``_``. No two notebooks may use the same.
    columns : mapping of str to array_like, shape (n,), or scalar
        Columns of the CSV file by their header, which holds the unit, as in ``"input (rad rms)"``. A scalar stands
        for a column of equal values. Floats are written with at most 9 significant digits.
    dpi : float, dots per inch
        Resolution of the PNG file.

    Raises
    ------
    TypeError, ValueError
        If the figure cannot be saved, the name holds other characters, there is no column, a column is complex or
        holds objects, columns differ in length or have two axes, or the resolution is not above 0.
    """
    if not hasattr(figure, "savefig") or isinstance(figure, type):
        raise TypeError(f"figure is a {type(figure).__name__}: expected a Figure of matplotlib")
    _check.instance("name", name, str)
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
        raise ValueError(f"name = {_check.shown(name)}: expected lower-case letters, digits, - and _")
    dpi = _check.number("dpi", dpi, 0, open_low=True)
    folder = os.environ.get(FOLDER)
    contents = {"csv": _csv(columns)}
    if folder:
        from zwfs.plots.variants import variants

        for name_of, variant in variants(figure).items():
            contents[f"{name_of}.png"] = _picture(variant, dpi, "png")
    for kind in _METADATA if folder else ("png",):  # the first one fixes the layout
        contents[kind] = _picture(figure, dpi, kind)
    if folder:
        for kind, content in contents.items():
            write_file(Path(folder) / f"{name}.{kind}", content)


def glue_numbers(numbers: Mapping[str, float | str], form: str = ".4f") -> None:
    """Store numbers in the output of a notebook's cell, under names by which pages of the book show them.

    Parameters
    ----------
    numbers : mapping of str to float or str
        A string is stored as it is.
    form : str
        Format that rounds the numbers, so that they are the same on every machine.
    """
    from myst_nb import glue

    for name, value in numbers.items():
        glue(name, value if isinstance(value, str) else float(f"{float(value):{form}}"), display=False)


def published(source: str) -> list[str]:
    """Return the names under which code publishes figures.

    Parameters
    ----------
    source : str
        The code of a cell. Only calls ``publish(figure, "name", ...)`` with a literal name count.
    """
    if "publish(" not in source:
        return []
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    named = (call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "publish")
    return [ast.literal_eval(call.args[1]) for call in named]


def _picture(figure: Figure, dpi: float, kind: str) -> bytes:
    """Draw a figure in a format, with the layout of the first one."""
    from matplotlib import rc_context

    stream = io.BytesIO()
    # After a save matplotlib asks these settings for a layout, even if the figure was made without one.
    with rc_context({"figure.constrained_layout.use": False, "figure.autolayout": False}):
        figure.savefig(stream, format=kind, dpi=dpi, metadata=_METADATA[kind])
        if figure.get_layout_engine() is not None:
            # Constrained layout goes on moving the axes each time it runs.
            figure.set_layout_engine("none")
    return stream.getvalue()


def _csv(columns: Mapping[str, ArrayLike]) -> bytes:
    """Columns as the bytes of a CSV file."""
    _check.instance("columns", columns, Mapping)
    arrays = {}
    for header, column in columns.items():
        name = f"columns[{header!r}]"
        _check.instance(f"header of {name}", header, str)
        array = arrays[header] = _check.plain_array(name, column)
        if array.dtype.kind == "c":
            raise TypeError(f"{name} is complex: expected its real and imaginary parts as separate columns")
        if array.dtype.kind not in "biufU":
            raise TypeError(f"{name} has dtype {array.dtype}: expected numbers or strings")
        if array.ndim > 1:
            raise ValueError(f"{name} has shape {array.shape}: expected (n,) or a scalar")
    lengths = {header: array.size for header, array in arrays.items() if array.ndim}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{header!r}: {length}" for header, length in lengths.items())
        raise ValueError(f"columns differ in length: {sizes}")
    if not arrays:
        raise ValueError("columns is empty: expected at least one")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(arrays)
    filled = np.broadcast_arrays(*map(np.atleast_1d, arrays.values()))
    writer.writerows(zip(*(map(_text, array) for array in filled), strict=True))
    return stream.getvalue().encode()


def _text(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)
