"""Say how the notebooks that are committed differ from those that were run just now."""

import base64
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from nbformat import NotebookNode
from PIL import Image

# A number that stands by itself: not part of a name, a version or a colour.
NUMBER = re.compile(r"(?<![\w.#])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
EMBEDDED_PNG = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")
SVG_NAME = re.compile(r'(?<=\bid=")[^"]+|(?<=href="#)[^"]+|(?<=url\(#)[^)]+')


LINE = 120  # characters of a line that a message shows


@dataclass(frozen=True)
class Tolerance:
    """How far two runs on two machines may be apart.

    Parameters
    ----------
    relative, absolute : float
        For numbers in text; the wider of the two counts.
    path : float, SVG units
        For numbers in vector pictures, in place of `absolute`.
    pixel_rms : float, levels of 0 to 255
        For the whole of a picture. One changed digit of a label exceeds it.
    pixel : float, levels of 0 to 255
        For each pixel of a picture. Processors with and without AVX-512 differ by up to 5 levels.
    """

    relative: float = 1e-4
    absolute: float = 1e-9
    path: float = 0.05
    pixel_rms: float = 0.5
    pixel: float = 10


def faults(notebook: NotebookNode) -> list[str]:
    """List what makes a committed notebook useless as a reference: nothing in it can be compared."""
    code = [(n, cell) for n, cell in enumerate(notebook.cells, start=1) if cell.cell_type == "code"]
    found = [
        f"cell {number} was never run: it has no execution count"
        for number, cell in code
        if cell.source.strip() and cell.execution_count is None
    ]
    if not any(cell.outputs for _, cell in code):
        found.append("no cell has any output")
    if not any("parameters" in cell.metadata.get("tags", []) for _, cell in code):
        found.append("no cell is tagged 'parameters'")
    return found


def differences(committed: NotebookNode, fresh: NotebookNode, tolerance: Tolerance | None = None) -> list[str]:
    """List what differs between two notebooks, cell by cell.

    Parameters
    ----------
    committed, fresh : NotebookNode
        Both in their normal form.
    tolerance : Tolerance, optional
        What does not count as a difference.

    Returns
    -------
    list of str
        A line for each difference, with both values. Empty if there is none.
    """
    tolerance = tolerance or Tolerance()
    if len(committed.cells) != len(fresh.cells):
        return [f"{len(committed.cells)} cells are committed, {len(fresh.cells)} were run"]
    found = []
    for number, (old, new) in enumerate(zip(committed.cells, fresh.cells, strict=True), start=1):
        if (old.cell_type, old.source, old.metadata) != (new.cell_type, new.source, new.metadata):
            found.append(f"cell {number}: its source differs from the one that was run")
        elif old.cell_type == "code":
            found += [f"cell {number}, {text}" for text in _outputs(old.outputs, new.outputs, tolerance)]
    return found


def _outputs(old: list[NotebookNode], new: list[NotebookNode], tolerance: Tolerance) -> Iterator[str]:
    """Compare the outputs of one cell."""
    if len(old) != len(new):
        yield f"outputs: {len(old)} committed, {len(new)} in the fresh run"
        return
    for number, (a, b) in enumerate(zip(old, new, strict=True), start=1):
        if a.get("metadata") != b.get("metadata"):  # the names of glued values, above all
            yield f"output {number}: metadata {a.get('metadata')} committed, {b.get('metadata')} in the fresh run"
            continue
        a, b = _content(a), _content(b)
        if a.keys() != b.keys():
            kinds = [", ".join(sorted(content)) for content in (a, b)]
            yield f"output {number}: {kinds[0]} committed, {kinds[1]} in the fresh run"
            continue
        for kind in sorted(a):
            difference = _compare(kind, a[kind], b[kind], tolerance)
            if difference:
                yield f"output {number} ({kind}): {difference}"


def _content(output: NotebookNode) -> dict[str, Any]:
    """Return what a reader sees of an output, by its kind."""
    if output.output_type == "stream":
        return {output.name: output.text}
    if output.output_type == "error":
        return {"error": f"{output.ename}: {output.evalue}"}
    return dict(output.data)


def _compare(kind: str, old: Any, new: Any, tolerance: Tolerance) -> str | None:
    """Compare one output of one kind."""
    if kind in ("image/png", "image/jpeg"):
        return picture_difference(base64.b64decode(old), base64.b64decode(new), tolerance)
    if kind == "image/svg+xml":
        return svg_difference(old, new, tolerance)
    return text_difference(str(old), str(new), tolerance.relative, tolerance.absolute)


def text_difference(old: str, new: str, relative: float, absolute: float) -> str | None:
    """Compare two texts: numbers within a tolerance, all else exactly.

    Runs of blanks count as one, since a column of numbers may shift by a digit.

    Returns
    -------
    str or None
        The first difference, with both values.
    """
    old, new = (re.sub(r"[ \t]+", " ", text) for text in (old, new))
    if NUMBER.sub("#", old) != NUMBER.sub("#", new):
        return _first_difference(old.splitlines(), new.splitlines())
    for a, b in zip(NUMBER.finditer(old), NUMBER.finditer(new), strict=True):
        if not math.isclose(float(a[0]), float(b[0]), rel_tol=relative, abs_tol=absolute):
            return f"{a[0]} committed, {b[0]} in the fresh run, in {_line_around(old, a.start())!r}"
    return None


def _first_difference(old: list[str], new: list[str]) -> str:
    """Show the first line in which two texts differ by more than their numbers."""
    for a, b in zip(old, new, strict=False):
        plain = [NUMBER.sub("#", line) for line in (a, b)]
        if plain[0] != plain[1]:
            if max(len(a), len(b)) > LINE:
                same = next(
                    (i for i, (x, y) in enumerate(zip(*plain, strict=False)) if x != y), min(map(len, plain))
                )
                a, b = (line[max(0, same - LINE // 2) : same + LINE // 2] for line in plain)
            return f"{a!r} committed, {b!r} in the fresh run"
    return f"{len(old)} lines committed, {len(new)} in the fresh run"


def _line_around(text: str, position: int) -> str:
    """Return the line that holds a position."""
    end = text.find("\n", position)
    line = text[text.rfind("\n", 0, position) + 1 : end if end >= 0 else None]
    return line if len(line) <= LINE else f"{line[:LINE]}..."


def picture_difference(old: bytes, new: bytes, tolerance: Tolerance) -> str | None:
    """Compare two pictures pixel by pixel: same size, and small differences in rms and in every pixel."""
    a, b = (np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"), dtype=float) for data in (old, new))
    if a.shape != b.shape:
        (h, w), (h2, w2) = a.shape[:2], b.shape[:2]
        return f"{w} x {h} pixels committed, {w2} x {h2} in the fresh run"
    rms, largest = float(np.sqrt(np.mean((a - b) ** 2))), float(np.abs(a - b).max())
    if rms > tolerance.pixel_rms:
        return f"the pictures differ by {rms:.2f} of 255 rms, and {tolerance.pixel_rms} is allowed"
    if largest > tolerance.pixel:
        return f"a pixel of the pictures differs by {largest:.0f} of 255, and {tolerance.pixel} is allowed"
    return None


def svg_difference(old: str, new: str, tolerance: Tolerance) -> str | None:
    """Compare two vector pictures: the rasters in them as pictures, coordinates within a tolerance."""
    rasters = [[base64.b64decode(match) for match in EMBEDDED_PNG.findall(svg)] for svg in (old, new)]
    if len(rasters[0]) != len(rasters[1]):
        return f"{len(rasters[0])} embedded pictures committed, {len(rasters[1])} in the fresh run"
    for number, (a, b) in enumerate(zip(*rasters, strict=True), start=1):
        difference = picture_difference(a, b, tolerance)
        if difference:
            return f"embedded picture {number}: {difference}"
    return text_difference(_plain_svg(old), _plain_svg(new), tolerance.relative, tolerance.path)


def _plain_svg(svg: str) -> str:
    """Leave out the rasters, and number the names: matplotlib makes them from the coordinates' digits."""
    names: dict[str, str] = {}
    svg = EMBEDDED_PNG.sub("", svg)
    return SVG_NAME.sub(lambda match: names.setdefault(match[0], f"name{len(names)}"), svg)
