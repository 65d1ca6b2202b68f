"""The notebooks of the book: they show their last run, with a card under each published figure."""

import json
import os
import re
from pathlib import Path
from typing import Any

import nbformat
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from sphinx.application import Sphinx

from book._ext.explore import button
from book._ext.finish import VARIANTS
from book._ext.reading import CARD, put_in_order
from book._tools import record
from book._tools.declared import assigned
from book._tools.project import EXECUTED
from zwfs.companion.results import published


def read_notebook(app: Sphinx, document: str, text: list[str]) -> None:
    """Replace the text of a notebook by that of its run, and add the cards."""
    source = Path(app.env.doc2path(document))
    if source.suffix != ".ipynb":
        return
    run = Path(app.srcdir, app.config.executed_notebooks, source.name)
    if not run.exists():
        run = source
    app.env.note_dependency(os.path.relpath(run, app.srcdir))
    notebook = nbformat.reads(run.read_text("utf-8"), as_version=4)
    files = sorted(run.with_suffix(".files").glob("[!.]*"))
    links = {file.name: Path(os.path.relpath(file, source.parent)).as_posix() for file in (run, *files)}
    add_cards(notebook, source.stem, links, versions(run), commit(Path(app.srcdir)))
    put_in_order(notebook)
    text[0] = nbformat.writes(notebook)


def add_cards(notebook: NotebookNode, name: str, links: dict[str, str], versions: str, commit: str) -> None:
    """Add a card under each figure of an executed notebook, in place; the first one shows the parameters.

    Parameters
    ----------
    notebook : NotebookNode
        Run with its defaults.
    name : str
        The stem of its file.
    links : dict of str
        Addresses, from the page, of the files that the cards offer, by name.
    versions, commit : str
        See `versions` and `commit`.
    """
    cells = []
    fold = ["", *parameters(notebook, name), "", f"Commit: {commit}. Versions: {versions}.", ":::"]
    for cell in notebook.cells:
        cells.append(cell)
        for figure in published(cell.source) if cell.cell_type == "code" else []:
            cell.metadata.setdefault("mystnb", {}).setdefault("figure", {})["classes"] = VARIANTS + figure
            explored = button(figure) if f"{figure}.csv" in links else []
            text = "\n".join(["::::{div} run-card", files(name, figure, links), *explored, *fold, "::::"])
            cells.append(new_markdown_cell(text, id=f"{CARD}{figure}"[:64]))
            fold = []
    notebook.cells = cells


def files(name: str, figure: str, links: dict[str, str]) -> str:
    """Return the line of a card that names the origin of a figure and links its files."""
    number = re.match(r"fig(\d+)_", name)
    of_paper = f"Figure {int(number[1])} of the paper" if number else ""
    origin = "Not in the paper"
    if number and figure == name:
        origin = of_paper
    elif number:
        origin += f", goes with {of_paper}"
    offered = {
        "notebook": name + ".ipynb",
        "PNG": figure + ".png",
        "PDF": figure + ".pdf",
        "data (CSV)": figure + ".csv",
    }
    shown = [f"{{download}}`{text} <{links[file]}>`" for text, file in offered.items() if file in links]
    return " · ".join([origin, *shown])


def parameters(notebook: NotebookNode, name: str) -> list[str]:
    """Return the lines of the fold that shows the parameters of a notebook, and the command that changes one."""
    code = next((c.source for c in notebook.cells if "parameters" in c.metadata.get("tags", ())), "")
    numbers = {key: int(value) for key, (value, _) in assigned(notebook).items() if value.isnumeric()}
    changed = f"seed={numbers['seed'] + 1}" if "seed" in numbers else "NAME=VALUE"
    return [
        ":::{dropdown} Parameters (click to change and re-run)",
        "```python",
        code,
        "```",
        "",
        "To re-run the notebook from the root of a clone, with one parameter or more changed:",
        "",
        "```sh",
        f'make rerun FIGURE={name} ARGS="-p {changed}"',
        "```",
    ]


def versions(run: Path) -> str:
    """List the versions of Python and packages of a run, from its record."""
    try:
        known: dict[str, Any] = json.loads(run.with_suffix(".json").read_bytes()).get("versions", {})
    except (OSError, ValueError):
        known = {}
    return ", ".join(f"{package} {version}" for package, version in known.items()) or "not recorded"


def commit(root: Path) -> str:
    """Return the commit of a working tree, and whether the tree has changes, as MyST text."""
    head, changed = record.commit(root)
    return f"`{head[:12]}`{', with changes' if changed else ''}" if head else "not known"


def setup(app: Sphinx) -> dict[str, bool]:
    """Read the notebooks of a run, with cards."""
    # By default the book shows the stored outputs; `make book` names the folder of its runs.
    app.add_config_value("executed_notebooks", os.environ.get(EXECUTED, "notebooks"), "env")
    app.connect("source-read", read_notebook)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
