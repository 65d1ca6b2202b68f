"""Normal form of notebooks: two runs of the same notebook give the same bytes."""

import copy
import json
import re
from pathlib import Path

import nbformat
from nbformat import NotebookNode

BOOK = "book-parameters"
"""Tag of the cells of text that hold for the parameters of the book only."""


def read(path: Path) -> NotebookNode:
    """Read a notebook in its normal form."""
    return normalise(nbformat.read(path, as_version=4))


def normalise(notebook: NotebookNode) -> NotebookNode:
    """Return a copy of a notebook without times, versions and random names, and with joined streams."""
    result = copy.deepcopy(notebook)
    result.nbformat, result.nbformat_minor = 4, 5
    result.metadata.pop("papermill", None)
    result.metadata.get("language_info", {}).pop("version", None)
    result.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
    for index, cell in enumerate(result.cells):
        cell["id"] = f"cell-{index + 1:02d}"
        for name in ("papermill", "execution"):
            cell.metadata.pop(name, None)
        if not cell.metadata.get("tags", True):
            del cell.metadata["tags"]  # papermill gives every cell a list
        if cell.cell_type == "code":
            cell.outputs = [_without_date(output) for output in _merge_streams(cell.outputs)]
    return result


def _merge_streams(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Join neighbouring pieces of a stream: the kernel flushes at random."""
    merged: list[NotebookNode] = []
    for output in outputs:
        if merged and output.output_type == "stream" and merged[-1].get("name") == output.name:
            merged[-1].text += output.text
        else:
            merged.append(output)
    return merged


def _without_date(output: NotebookNode) -> NotebookNode:
    """Remove the time that matplotlib writes into an SVG."""
    if svg := output.get("data", {}).get("image/svg+xml"):
        output.data["image/svg+xml"] = re.sub(r"\s*<dc:date>.*?</dc:date>", "", svg)
    return output


def to_bytes(notebook: NotebookNode) -> bytes:
    """Return a notebook as it is stored: sorted keys, one newline at the end."""
    return (nbformat.writes(notebook).rstrip("\n") + "\n").encode()


def glued_texts(path: Path) -> dict[str, str]:
    """Return what a notebook glues, as text by name."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    outputs = (output for cell in cells for output in cell.get("outputs", ()))
    named = ((output.get("metadata", {}).get("scrapbook", {}).get("name"), output) for output in outputs)
    return {name: "".join(next(iter(output["data"].values()))) for name, output in named if name}


def title(notebook: NotebookNode) -> str:
    """Return the title of a notebook."""
    return notebook.cells[title_cell(notebook)].source.splitlines()[0].lstrip("# ")


def title_cell(notebook: NotebookNode) -> int:
    """Return the index of the cell that begins with the title."""
    cells = enumerate(notebook.cells)
    return next((i for i, cell in cells if cell.cell_type == "markdown" and cell.source.startswith("# ")), 0)
