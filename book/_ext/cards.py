"""The notebooks of the book: which run of them it shows, and the card under each figure that they publish."""

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import nbformat
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from papermill import inspect_notebook
from sphinx.application import Sphinx

from zwfs.companion.results import published
from zwfs.companion.tables import plain

# The folder of the notebooks that the book shows, from the root: by default those of the sources, with the outputs
# that are stored in them. `make book` names the folder of its own run.
EXECUTED = "ZWFS_EXECUTED"

# Regenerates a figure, from the root of a clone.
RERUN = "make rerun FIGURE={notebook}"


def read_notebook(app: Sphinx, document: str, text: list[str]) -> None:
    """Replace the text of a notebook by that of its run, and add the cards."""
    source = Path(app.env.doc2path(document))
    if source.suffix != ".ipynb":
        return
    run = Path(app.srcdir, app.config.executed_notebooks, source.name)
    if not run.exists():
        run = source
    app.env.note_dependency(os.path.relpath(run, app.srcdir))
    text[0] = run.read_text("utf-8")
    notebook = nbformat.reads(text[0], as_version=4)
    files = sorted(run.with_suffix(".files").glob("[!.]*"))
    links = {file.name: Path(os.path.relpath(file, source.parent)).as_posix() for file in (run, *files)}
    with_cards(notebook, run, links, versions(run), commit(Path(app.srcdir)))
    text[0] = nbformat.writes(notebook)


def with_cards(notebook: NotebookNode, source: Path, links: dict[str, str], versions: str, commit: str) -> None:
    """Add a card under each figure of an executed notebook, in place.

    Parameters
    ----------
    notebook : NotebookNode
        Run with its defaults.
    source : Path
        The file of the notebook; the card lists the parameters in its cell tagged ``parameters``.
    links : dict of str
        The files that the card offers: addresses from the page, by name.
    versions, commit : str
        See `versions` and `commit`.
    """
    cells = []
    for cell in notebook.cells:
        cells.append(cell)
        for figure in published(cell.source) if cell.cell_type == "code" else []:
            text = card(source, figure, links, versions, commit)
            cells.append(new_markdown_cell(text, id=f"card-{figure}"[:64]))
    notebook.cells = cells


def card(source: Path, figure: str, links: dict[str, str], versions: str, commit: str) -> str:
    """Return the card of one figure as MyST text; see `with_cards`."""
    parameters = {name: (about["default"], about["help"]) for name, about in inspect_notebook(str(source)).items()}
    seed, _ = parameters.pop("seed", (None, None))
    offered = {
        "notebook": source.name,
        "PNG": f"{figure}.png",
        "PDF": f"{figure}.pdf",
        "data (CSV)": f"{figure}.csv",
    }
    return "\n".join(
        [
            "::::{div} run-card",
            " · ".join(
                [origin(source.stem, figure)]
                + [f"{{download}}`{text} <{links[name]}>`" for text, name in offered.items() if name in links]
            ),
            "",
            f":::{{dropdown}} How {title(source.stem, figure)} was made",
            "To make it again, from the root of a clone:",
            "",
            "```sh",
            RERUN.format(notebook=source.stem),
            "```",
            "",
            f"Seed: {f'`{seed}`' if seed else 'none, nothing is random'}. Commit: {commit}. Versions: {versions}.",
            "",
            *(f"- `{name} = {value}`: {plain(meaning)}" for name, (value, meaning) in parameters.items()),
            ":::",
            "::::",
        ]
    )


def origin(notebook: str, figure: str) -> str:
    """Name the figure of the paper that a picture reproduces: that of its notebook, if it has the same name."""
    number = re.match(r"fig(\d+)_", notebook)
    if not number:
        return "Not in the paper"
    of_paper = f"Figure {int(number[1])} of the paper"
    return of_paper if figure == notebook else f"Not in the paper, goes with {of_paper}"


def title(notebook: str, figure: str) -> str:
    """Return a name for a figure that no other figure of the book has."""
    number = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(number[1])}" if number and figure == notebook else f"`{figure}`"


def versions(run: Path) -> str:
    """List the versions of Python and packages of a run, from the record next to it."""
    try:
        known: dict[str, Any] = json.loads(run.with_suffix(".json").read_bytes()).get("versions", {})
    except (OSError, ValueError):
        known = {}
    return ", ".join(f"{package} {version}" for package, version in known.items()) or "not recorded"


def commit(root: Path) -> str:
    """Name the commit of a working tree, and say whether the tree has changes.

    A file that is in no commit is a change, too: it may be a notebook, or a module that one imports.
    """

    def git(*command: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *command], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # A copy without a history may lie within another repository.
        if Path(git("rev-parse", "--show-toplevel")) == root.resolve():
            return f"`{git('rev-parse', 'HEAD')[:12]}`{', with changes' if git('status', '--porcelain') else ''}"
    except (OSError, subprocess.CalledProcessError):
        pass
    return "not known"


def setup(app: Sphinx) -> dict[str, bool]:
    """Read the notebooks of a run, with cards."""
    app.add_config_value("executed_notebooks", os.environ.get(EXECUTED, "notebooks"), "env")
    app.connect("source-read", read_notebook)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
