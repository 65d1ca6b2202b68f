"""The API page: every public name of `zwfs` with its docstring, and the hooks that make the docstrings link."""

import importlib
import inspect
import pkgutil
import re
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sphinx.pycode import ModuleAnalyzer

import zwfs

PAGE = "book/api.md"

# The order of the page. A module that is in no group fails the build.
GROUPS = {
    "Pupil, modes and screens": ("zwfs.pupil", "zwfs.modes"),
    "Sensor": ("zwfs.masks", "zwfs.sensor", "zwfs.detector"),
    "Reconstructors": (
        "zwfs.reconstructors",
        "zwfs.reconstructors.linear",
        "zwfs.reconstructors.arcsine",
        "zwfs.reconstructors.phase_shifted",
        "zwfs.reconstructors.gerchberg_saxton",
        "zwfs.reconstructors.gradient_descent",
        "zwfs.reconstructors.base",
    ),
    "Metrics": ("zwfs.metrics",),
    "Low-rank factors": ("zwfs.lowrank", "zwfs.focal"),
    "Simulated bench": ("zwfs.bench", "zwfs.bench.model", "zwfs.bench.segments", "zwfs.bench.recording"),
    "Camera frames": ("zwfs.frames", "zwfs.frames.files", "zwfs.frames.registration", "zwfs.frames.pipeline"),
    "Experiments of the paper": (
        "zwfs.paper",
        "zwfs.paper.identities",
        "zwfs.paper.linearity",
        "zwfs.paper.dimple_diameter",
        "zwfs.paper.phase_shifts",
        "zwfs.paper.bench_linearity",
        "zwfs.paper.closed_loop",
    ),
    "Figures": (
        "zwfs.plots.style",
        "zwfs.plots.layouts",
        "zwfs.plots.identities",
        "zwfs.plots.linearity",
        "zwfs.plots.dimple_diameter",
        "zwfs.plots.phase_shifts",
        "zwfs.plots.bench",
        "zwfs.plots.frames",
        "zwfs.plots.closed_loop",
        "zwfs.plots",
    ),
    "Support for notebooks": (
        "zwfs.companion",
        "zwfs.companion.parameters",
        "zwfs.companion.results",
        "zwfs.companion.sweeps",
        "zwfs.companion.tables",
    ),
}

# The pages whose equations have the paper's numbers, in its order.
PAPER = ("sensor.md", "phase_shifted.md", "methods.md")

LABEL = re.compile(r"`(eq-[a-z-]+)`")
OF_THE_BOOK = re.compile(r"(:eq:`[a-z-]+`)\s+of\s+the\s+(?:book|theory\s+page)")
NUMBERED = re.compile(r"(?<=Chambouleyron)[^;]*?equations?\s[^;.\n]*")
CODE = re.compile(r"(?<![`:\w])`([^`\n]+)`(?![`_])")


class ApiError(Exception):
    """The API page cannot be made."""


def modules() -> list[str]:
    """Return the names of the public modules of the package, in order."""
    found = pkgutil.walk_packages(zwfs.__path__, "zwfs.")
    return sorted(m.name for m in found if not any(part.startswith("_") for part in m.name.split(".")))


def public_names(module: ModuleType) -> list[str]:
    """Return the functions, classes and documented constants of a module that do not begin with an underscore."""
    own = [
        name
        for name, thing in vars(module).items()
        if (inspect.isclass(thing) or inspect.isfunction(thing)) and thing.__module__ == module.__name__
    ]
    names = dict.fromkeys([*getattr(module, "__all__", ()), *own, *constants(module)])
    return [name for name in names if not name.startswith("_")]


def constants(module: ModuleType) -> dict[str, str]:
    """Return the docstrings of a module's constants: the string after the assignment."""
    found = ModuleAnalyzer.for_module(module.__name__).find_attr_docs()
    return {name: " ".join(lines).strip() for (owner, name), lines in found.items() if not owner}


def targets() -> dict[str, dict[str, str]]:
    """Return, by module, the directive for each public name, by the shortest path that it can be imported from.

    Raises
    ------
    ApiError
        A module is in no group, or a group names one that does not exist.
    """
    listed = [name for group in GROUPS.values() for name in group]
    if wrong := set(listed) ^ set(modules()):
        raise ApiError(f"book/api.py: GROUPS and the package differ in {', '.join(sorted(wrong))}")
    found: dict[str, dict[str, str]] = {}
    seen: set[str] = set()
    for name in listed:
        module = importlib.import_module(name)
        found[name] = {}
        for own in public_names(module):
            thing = getattr(module, own)
            path = f"zwfs.{own}" if getattr(zwfs, own, None) is thing else f"{name}.{own}"
            if path not in seen:
                seen.add(path)
                found[name][path] = _directive(thing)
    return found


def _directive(thing: Any) -> str:
    if inspect.isclass(thing):
        return "autoclass"
    return "autofunction" if inspect.isfunction(thing) else "py:data"


def fragments() -> dict[str, str]:
    """Return the part of the page that is made from the package, by file name."""
    found, lines = targets(), []
    for title, group in GROUPS.items():
        lines += [f"## {title}", ""]
        for name in group:
            if not found[name]:
                continue
            summary = (importlib.import_module(name).__doc__ or "").strip().splitlines()[0]
            lines += [f"### `{name}`", "", "```{eval-rst}", f".. py:module:: {name}", "", linked(summary), ""]
            told = constants(importlib.import_module(name))
            for path, directive in found[name].items():
                owner, own = path.rsplit(".", 1)
                if directive == "py:data":
                    lines += [f".. py:data:: {own}", f"   :module: {owner}", "", f"   {linked(told[own])}", ""]
                else:
                    members = ["   :members:"] if directive == "autoclass" else []
                    lines += [f".. {directive}:: {path}", *members, ""]
            lines += ["```", ""]
    return {"book/_api.md": "\n".join(lines)}


@cache
def known() -> dict[str, str]:
    """Return the full path of each public name, by the ways in which a docstring may write it."""
    paths = [path for by_path in targets().values() for path in by_path]
    return {path.rsplit(".", 1)[1]: path for path in paths} | {path: path for path in paths}


def linked(text: str) -> str:
    """Turn what a docstring says of equations and has in single backticks into links, or into code.

    Parameters
    ----------
    text : str
        Mentions of the paper's equations by number, and of any by label: ``eq-low-rank of the book``.
    """
    text = OF_THE_BOOK.sub(r"\1", LABEL.sub(r":eq:`\1`", text))
    text = NUMBERED.sub(lambda match: re.sub(r"\((\d+)\)", _numbered, match[0]), text)
    return re.sub(r"``[^`]*``|\|", _escaped, CODE.sub(_reference, text))


def _escaped(match: re.Match) -> str:
    """Take the meaning from a bar, which marks a modulus and no substitution; code stays."""
    return "\\|" if match[0] == "|" else match[0]


@cache
def paper_labels() -> list[str]:
    """Return the labels of the paper's equations: the first is that of its equation (1)."""
    texts = (Path(__file__).with_name(page).read_text("utf-8") for page in PAPER)
    return [label for text in texts for label in re.findall(r"^ *:label: (\S+)$", text, re.MULTILINE)]


def _numbered(match: re.Match) -> str:
    return f":eq:`{paper_labels()[int(match[1]) - 1]}`"


def _reference(match: re.Match) -> str:
    path = known().get(match[1])
    return f":py:obj:`{match[1]} <{path}>`" if path else f"``{match[1]}``"


def _process(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring in place, before it is parsed."""
    lines[:] = linked("\n".join(lines)).splitlines()


def setup(app: Any) -> dict[str, bool]:
    """Connect the hooks: this module is an extension of Sphinx, too."""
    app.connect("autodoc-process-docstring", _process, priority=400)
    return {"parallel_read_safe": True}
