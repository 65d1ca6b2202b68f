"""The card under each published figure: what it regenerates, what made it, and how to make it again."""

import ast
import io
import json
import re
import subprocess
import tokenize
from dataclasses import dataclass
from pathlib import Path

from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from runner import Project

# Makes a figure again, from the root of a clone.
RERUN = "make rerun FIGURE={notebook}"

MARKDOWN = re.compile(r"([\\`*_{}\[\]<>$|#])")


@dataclass(frozen=True)
class Parameter:
    """A value that a notebook was run with.

    Parameters
    ----------
    value : str
        As it is written.
    meaning : str
        The comment behind it: meaning and unit.
    """

    value: str
    meaning: str


def with_cards(notebook: NotebookNode, name: str, versions: dict[str, str], commit: str) -> NotebookNode:
    """Add a card under each figure of an executed notebook, in place, and return the notebook.

    Parameters
    ----------
    notebook : NotebookNode
        A cell makes a figure if it calls ``publish(figure, "name", ...)``.
    name : str
        The stem of its file.
    versions : dict of str
        Of Python and the packages that it was run with.
    commit : str
        The state of the repository.
    """
    known = parameters(notebook)
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


def parameters(notebook: NotebookNode) -> dict[str, Parameter]:
    """Return the parameters in force: the defaults, and over them what a run put in their place."""
    found: dict[str, Parameter] = {}
    for tag in ("parameters", "injected-parameters"):
        for cell in notebook.cells:
            if tag in cell.metadata.get("tags", ()):
                for name, new in _assignments(cell.source).items():
                    found[name] = Parameter(new.value, new.meaning or found.get(name, new).meaning)
    return found


def _assignments(source: str) -> dict[str, Parameter]:
    """Return the values that a cell assigns, with the comments behind them."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    meanings = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    return {
        node.targets[0].id: Parameter(
            ast.get_source_segment(source, node.value), meanings.get(node.end_lineno, "")
        )
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign)
    }


def card(notebook: str, figure: str, known: dict[str, Parameter], versions: dict[str, str], commit: str) -> str:
    """Return the card of one figure as MyST.

    Parameters
    ----------
    notebook : str
        The stem of the notebook's file.
    figure : str
        The stem of the figure's files.
    known : dict of Parameter
        All parameters in force, by name.
    versions, commit
        See `with_cards`.
    """
    seed = f"`{known['seed'].value}`" if "seed" in known else "none, nothing is random"
    rows = [
        f"- `{name} = {parameter.value}`: {_plain(parameter.meaning)}"
        for name, parameter in known.items()
        if name != "seed"
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


def _plain(text: str) -> str:
    """Return text that Markdown shows as it is."""
    return MARKDOWN.sub(r"\\\1", text)


def versions_of(project: Project, name: str) -> dict[str, str]:
    """Return the versions that a notebook was run with, from what `runner` left beside the result."""
    try:
        return json.loads((project.executed / f"{name}.json").read_bytes()).get("versions", {})
    except (OSError, ValueError):
        return {}


def commit_of(root: Path) -> str:
    """Return the commit of a working tree, and say if it has changes; a copy without a history has none."""
    if not (root / ".git").exists():
        return "not known"
    try:
        head, changes = (
            subprocess.run(["git", "-C", str(root), *command], capture_output=True, text=True, check=True).stdout
            for command in (["rev-parse", "--short=12", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        )
    except (OSError, subprocess.CalledProcessError):
        return "not known"
    return f"`{head.strip()}`{', with changes' if changes else ''}"
