"""What code depends on: the modules that it imports, directly or through others, and their data.

A package such as `zwfs` imports what it offers at its first use, see `zwfs._lazy`. Code that uses ``zwfs.Pupil``
therefore depends on the module of `Pupil`, and not on all that the package offers.
"""

import ast
import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from zwfs._lazy import offered

MAGIC = re.compile(r"^(\s*)[%!].*", re.MULTILINE)
FOR_CHECKERS = re.compile(r"^if TYPE_CHECKING:\n(?: .*(?:\n|\Z)|\n)+", re.MULTILINE)
NO_DATA = {".py", ".pyc", ".toml"}
homes = cache(offered)


def dependencies(notebook: Path, modules: Mapping[str, Path]) -> set[Path]:
    """Return the files of the modules that a notebook depends on, given those of all by name, and their data."""
    texts = {notebook: code_of(notebook)}
    waiting = [notebook]
    while waiting:
        names = imported(texts[waiting.pop()])
        new = {file for name in names for file in files_of(name, modules)} - texts.keys()
        texts |= {file: file.read_text("utf-8") for file in new}
        waiting += new
    shown = (file for file in notebook.parent.rglob("[!.]*") if "__pycache__" not in file.parts)
    data = [file for file in shown if file.is_file() and file.suffix not in NO_DATA and file != notebook]
    stems = {file.with_suffix("") for file in texts if file != notebook}
    used = {file for file in data if file.with_suffix("") in stems or any(file.name in t for t in texts.values())}
    return {*texts, *used} - {notebook}


def code_of(notebook: Path) -> str:
    """Return the code of all cells of a notebook, without magics."""
    cells = json.loads(notebook.read_bytes())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return MAGIC.sub(r"\1pass", code)


@cache
def imported(code: str) -> frozenset[str]:
    """Return the full names of all that code imports or uses of an import, also within functions."""
    nodes = list(ast.walk(ast.parse(FOR_CHECKERS.sub("if True:\n    pass\n", code))))
    names: set[str] = set()
    meanings: dict[str, set[str]] = {}  # of the names that imports bind
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            package = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            for alias in node.names:
                names.add(package + alias.name)
                meanings.setdefault(alias.asname or alias.name, set()).add(package + alias.name)
    for node in nodes:
        if isinstance(node, ast.Attribute):
            first, _, rest = dotted(node).partition(".")
            names |= {f"{meaning}.{rest}" for meaning in meanings.get(first, ())}
    return frozenset(names)


def dotted(node: ast.AST) -> str:
    """Return an expression such as ``a.b.c``; it begins with a dot if ``a`` is not a name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def files_of(name: str, modules: Mapping[str, Path]) -> Iterator[Path]:
    """Yield the files of the modules that a full name leads to, with the packages around them."""
    parts = name.split(".")
    for depth, part in enumerate(parts):
        package = ".".join(parts[:depth])
        if file := modules.get(".".join(parts[: depth + 1])):
            yield file
            continue
        if package and (home := homes(modules[package].read_bytes()).get(part)):
            yield from files_of(".".join([*home, *parts[depth + 1 :]]), modules)
        return
