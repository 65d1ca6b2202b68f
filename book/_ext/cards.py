"""The notebooks of the book: they show their last run, with a card under each published figure.

A card offers the notebook with the studies that it imports, as a ZIP that is written next to the pages.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

import nbformat
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from sphinx.application import Sphinx

from book._ext import run
from book._ext.finish import VARIANTS
from book._ext.reading import CARD, put_in_order
from book._tools import record
from book._tools.project import EXECUTED, Project
from studies.kit.results import SCREENS, published

DOWNLOADS = "_downloads"  # folder of the pages


def read_notebook(app: Sphinx, document: str, text: list[str]) -> None:
    """Replace the text of a notebook by that of its run, and add the cards."""
    source = Path(app.env.doc2path(document))
    if source.suffix != ".ipynb":
        return
    last = run_of(app, source)
    app.env.note_dependency(os.path.relpath(last, app.srcdir))
    notebook = nbformat.reads(last.read_text("utf-8"), as_version=4)
    files = sorted(last.with_suffix(".files").glob("[!.]*"))
    links = {file.name: Path(os.path.relpath(file, source.parent)).as_posix() for file in files}
    run.mark_cells(notebook)
    add_cards(notebook, source.stem, links, versions(last), commit(Path(app.srcdir)))
    put_in_order(notebook)
    text[0] = nbformat.writes(notebook)


def run_of(app: Sphinx, source: Path) -> Path:
    """Return the file of the last run of a notebook, or the notebook itself if it was not run."""
    run = Path(app.srcdir, app.config.executed_notebooks, source.name)
    return run if run.exists() else source


def add_cards(notebook: NotebookNode, name: str, links: dict[str, str], versions: str, commit: str) -> None:
    """Add a card under each figure of an executed notebook, in place; the first one has the form of parameters.

    The last line of the page says from which commit and versions its figures come.
    """
    cells = []
    for cell in notebook.cells:
        cells.append(cell)
        for figure in published(cell.source) if cell.cell_type == "code" else []:
            cell.metadata.setdefault("mystnb", {}).setdefault("figure", {})["classes"] = VARIANTS + figure
            first = not any(cell_above.id.startswith(CARD) for cell_above in cells)
            text = ["::::{div} run-card", files(name, figure, links), "", run.form(figure, first), "::::"]
            cells.append(new_markdown_cell("\n".join(text), id=f"{CARD}{figure}"[:64]))
    if not any(cell.id.startswith(CARD) for cell in cells):  # the page shows tables only
        place = next((number for number, cell in enumerate(cells, 1) if cell.get("outputs")), len(cells))
        text = ["::::{div} run-card", files(name, "", links), "", run.form("", True), "::::"]
        cells.insert(place, new_markdown_cell("\n".join(text), id=f"{CARD}{name}"[:64]))
    if versions:
        origin = f"::::{{div}} run-card\nCommit: {commit}. Versions: {versions}.\n::::"
        cells.append(new_markdown_cell(origin, id=f"{CARD}made"))
    notebook.cells = cells


def files(name: str, figure: str, links: dict[str, str]) -> str:
    """Return the line of a card that names the origin of a figure and links its files."""
    number = re.match(r"fig(\d+)_", figure) or re.match(r"fig(\d+)_", name)
    of_paper = f"Figure {int(number[1])} of the paper" if number else ""
    origin = "Not in the paper"
    if number and (figure == name or not name.startswith("fig")):
        origin = of_paper
    elif number:
        origin += f", goes with {of_paper}"
    offered = {kind.upper(): f"{figure}.{kind}" for kind in ("png", "svg", "pdf")}
    offered |= {"data (CSV)": f"{figure}.csv", "single screens (CSV)": f"{figure}{SCREENS}.csv"}
    shown = [f"{{download}}`{text} <{links[file]}>`" for text, file in offered.items() if file in links]
    address = f"../{DOWNLOADS}/{name}.zip"
    archive = f'<a class="reference download" href="{address}" download>notebook with its code (ZIP)</a>'
    return " · ".join([origin, archive, *shown])


def versions(run: Path) -> str:
    """List the versions of Python and packages of a run, from its record; nothing without one."""
    try:
        recorded: dict[str, Any] = json.loads(run.with_suffix(".json").read_bytes()).get("versions", {})
    except (OSError, ValueError):
        recorded = {}
    return ", ".join(f"{package} {version}" for package, version in recorded.items())


def commit(root: Path) -> str:
    """Return the commit of a working tree, and whether the tree has changes, as MyST text."""
    head, changed = record.commit(root)
    return f"`{head[:12]}`{', with changes' if changed else ''}" if head else "not known"


def write_archives(app: Sphinx, exception: Exception | None) -> None:
    """Write the ZIP of each notebook."""
    if exception is not None or app.builder.format != "html":
        return
    project, folder = Project(Path(app.srcdir)), Path(app.outdir, DOWNLOADS)
    folder.mkdir(exist_ok=True)
    for source in project.sources():
        if source.relative_to(project.root).with_suffix("").as_posix() in app.env.found_docs:
            (folder / f"{source.stem}.zip").write_bytes(archive(project, run_of(app, source)))


def archive(project: Project, notebook: Path) -> bytes:
    """Return a ZIP of a notebook, the studies that it imports and their data."""
    studies = (file for file in project.depends_on(notebook.stem) if file.is_relative_to(project.studies))
    files = {file.relative_to(project.notebooks).as_posix(): file.read_bytes() for file in studies}
    return run.zipped(files | {notebook.name: notebook.read_bytes()})


def setup(app: Sphinx) -> dict[str, bool]:
    """Read the notebooks of a run, with cards."""
    # By default the book shows the stored outputs; `make book` names the folder of its runs.
    app.add_config_value("executed_notebooks", os.environ.get(EXECUTED, "notebooks"), "env")
    app.connect("source-read", read_notebook)
    app.connect("build-finished", write_archives)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
