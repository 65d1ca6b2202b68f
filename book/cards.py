"""The card under each published figure: what it regenerates, what made it, and how to make it again."""

import ast
import json
import re

import runner
from declared import assigned
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from runner import Project

from zwfs.companion.tables import plain

# Makes a figure again, from the root of a clone.
RERUN = "make rerun FIGURE={notebook}"


def with_cards(notebook: NotebookNode, name: str, versions: dict[str, str], commit: str) -> NotebookNode:
    """Add a card under each figure of an executed notebook, in place, and return the notebook.

    Parameters
    ----------
    notebook : NotebookNode
        Run with its defaults. A cell makes a figure if it calls ``publish(figure, "name", ...)``.
    name : str
        The stem of its file.
    versions : dict of str
        Of Python and the packages that it was run with.
    commit : str
        See `state_of`.
    """
    known = assigned(notebook)
    cells = []
    for cell in notebook.cells:
        cells.append(cell)
        if cell.cell_type == "code":
            for figure in published(cell.source):
                text = card(name, figure, known, versions, commit)
                cells.append(new_markdown_cell(text, id=f"card-{figure}"[:64]))
    notebook.cells = cells
    return notebook


def published(source: str) -> list[str]:
    """Return the names under which a cell publishes figures."""
    if "publish(" not in source:
        return []
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    named = (call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "publish")
    return [ast.literal_eval(call.args[1]) for call in named]


def card(
    notebook: str, figure: str, known: dict[str, tuple[str, str]], versions: dict[str, str], commit: str
) -> str:
    """Return the card of one figure as MyST.

    Parameters
    ----------
    notebook : str
        The stem of the notebook's file.
    figure : str
        The stem of the figure's files.
    known : dict of (value, comment)
        See `declared.assigned`.
    versions, commit
        See `with_cards`.
    """
    seed = f"`{known['seed'][0]}`" if "seed" in known else "none, nothing is random"
    rows = [
        f"- `{name} = {value}`: {plain(comment)}" for name, (value, comment) in known.items() if name != "seed"
    ]
    told = ", ".join(f"{package} {version}" for package, version in versions.items())
    return "\n".join(
        [
            "::::{div} run-card",
            f"{origin(notebook, figure)} · {_link('notebook', f'{notebook}.ipynb')} · "
            + " · ".join(_link(word, f"{figure}.{word.lower()}") for word in ("PNG", "PDF"))
            + f" · {_link('data (CSV)', f'{figure}.csv')}",
            "",
            f":::{{dropdown}} How {_called(notebook, figure)} was made",
            "To make it again, from the root of a clone:",
            "",
            "```sh",
            RERUN.format(notebook=notebook),
            "```",
            "",
            f"Seed: {seed}. Commit: {commit}. Versions: {told or 'not known'}.",
            "",
            *rows,
            ":::",
            "::::",
        ]
    )


def origin(notebook: str, figure: str) -> str:
    """Say which figure of the paper a picture makes again: that of its notebook, if it has its name."""
    number = re.match(r"fig(\d+)_", notebook)
    if not number:
        return "Not in the paper"
    of_paper = f"Figure {int(number[1])} of the paper"
    return of_paper if figure == notebook else f"Not in the paper, goes with {of_paper}"


def _called(notebook: str, figure: str) -> str:
    """Return a name for a figure that no other figure of the book has."""
    number = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(number[1])}" if number and figure == notebook else f"`{figure}`"


def _link(text: str, file: str) -> str:
    return f"{{download}}`{text} <downloads/{file}>`"


def versions_of(project: Project, name: str) -> dict[str, str]:
    """Return the versions that a notebook was run with, from what `runner` left beside the result."""
    try:
        return json.loads((project.executed / f"{name}.json").read_bytes()).get("versions", {})
    except (OSError, ValueError):
        return {}


def state_of(project: Project) -> str:
    """Return the commit of the working tree, and say if it has changes."""
    commit, changed = runner.commit(project.root)
    return f"`{commit[:12]}`{', with changes' if changed else ''}" if commit else "not known"
