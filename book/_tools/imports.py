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

ALL = "*"  # after a package: all of its modules
IMPORTERS = ("find_spec", "import_module", "resolve_name")  # functions that take the name of a module
CLASS = re.compile(r"\w+(\.\w+)*:\w+")  # how a string names a class, see `zwfs.reconstructors.base.load`
MAGIC = re.compile(r"^(\s*)[%!].*", re.MULTILINE)
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
    """Return the full names of all that code imports or uses of an import, also within functions.

    A package that is used as a whole, as in ``getattr(zwfs, name)``, has `ALL` behind its name.
    """
    try:
        nodes = list(_run_nodes(ast.parse(code)))
    except SyntaxError:
        return frozenset({ALL})
    names: set[str] = set()
    meanings: dict[str, set[str]] = {}  # of the names that imports bind
    for node in nodes:
        if isinstance(node, ast.Import):
            for one in node.names:
                names.add(one.name)
                meaning = one.name if one.asname else one.name.partition(".")[0]
                meanings.setdefault(one.asname or meaning, set()).add(meaning)
        elif isinstance(node, ast.ImportFrom):
            origin = f"{node.module}." if not node.level else ALL  # no module here imports from its relatives
            for one in node.names:
                names.add(origin + one.name)
                meanings.setdefault(one.asname or one.name, set()).add(origin + one.name)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and CLASS.fullmatch(node.value):
            names.add(node.value.replace(":", "."))
        elif isinstance(node, ast.Call) and _parts(node.func)[-1] in IMPORTERS and node.args:
            names |= {str(one.value) for one in node.args[:1] if isinstance(one, ast.Constant)}
    inner = {id(node.value) for node in nodes if isinstance(node, ast.Attribute)}
    for node in nodes:
        if isinstance(node, ast.Attribute | ast.Name) and id(node) not in inner:
            first, *rest = _parts(node)
            names |= {".".join([meaning, *(rest or [ALL])]) for meaning in meanings.get(first, ())}
    return frozenset(names)


def _run_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a tree, but those for type checkers only."""
    yield node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and _parts(child.test)[-1] == "TYPE_CHECKING":
            for other in child.orelse:
                yield from _run_nodes(other)
        else:
            yield from _run_nodes(child)


def _parts(node: ast.AST) -> list[str]:
    """Return the names in ``a.b.c``; an empty name stands for the result of an expression."""
    if isinstance(node, ast.Attribute):
        return [*_parts(node.value), node.attr]
    return [node.id if isinstance(node, ast.Name) else ""]


def files_of(name: str, modules: Mapping[str, Path]) -> Iterator[Path]:
    """Yield the files of the modules that a full name leads to, with the packages around them."""
    parts = name.split(".")
    for depth, part in enumerate(parts):
        package = ".".join(parts[:depth])
        if file := modules.get(".".join(parts[: depth + 1])):
            yield file
            continue
        if part.startswith(ALL):
            yield from (
                file for module, file in modules.items() if not package or module.startswith(f"{package}.")
            )
        elif package and (home := homes(modules[package].read_bytes()).get(part)):
            yield from files_of(".".join([*home, *parts[depth + 1 :]]), modules)
        return
