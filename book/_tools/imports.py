"""Static import graph: the files of this project that a piece of code depends on, found without running it.

A module counts with its whole file and with everything that it imports, in functions, too. For a package this
would be too much: its ``__init__.py`` usually imports every module of the package. Code that uses one name of a
package depends on the module that defines this name. Where in doubt, these rules count too much:

- ``from package import name`` and ``package.name`` count the module that the name comes from. If ``__init__.py``
  itself defines the name, or the name is unknown, ``__init__.py`` counts with everything that it imports.
- A package that is used as a value, as in ``getattr(package, name)``, counts with all its modules. An
  ``__init__.py`` that counts and imports by computed names counts all its modules, too.
- A module that acts when it is imported, rather than only defining names, counts for all code that imports
  anything of its package, because some ``__init__.py`` may import it.
- A string "module:name" counts as an import, as do the full name of a module and ``python -m module`` in a string.
  Docstrings do not count.

Imports under ``if TYPE_CHECKING`` do not count: they never run.
"""

import ast
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

_ENTRY = re.compile(r"([A-Za-z_][\w.]*):[A-Za-z_]\w*")  # module:name
_MODULE = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+")
_COMMAND = re.compile(r"-m\s+([A-Za-z_][\w.]*)")
_BY_NAME = {"import_module", "__import__", "resolve_name"}

Names = tuple[str, ...]  # ("zwfs", "plots", "band_errors") is zwfs.plots.band_errors


class Uses(NamedTuple):
    """Dependencies of a piece of code, as names that are not resolved.

    Attributes
    ----------
    bound : dict of set
        Full names that imports bind to each name.
    used : set
        Full names that the code uses.
    named : set
        Full names of modules, or of anything else, that strings mention.
    acts : bool
        Whether it does more than define names.
    computed : bool
        Whether it imports modules whose names are computed.
    """

    bound: dict[str, set[Names]]
    used: set[Names]
    named: set[Names]
    acts: bool
    computed: bool


@cache
def uses(source: str, package: Names = ()) -> Uses:
    """Read the dependencies of a piece of code that lies in a package.

    Raises
    ------
    SyntaxError
        If the code is not Python.
    """
    tree = _without_type_checking(ast.parse(source))
    of = Uses(defaultdict(set), set(), set(), any(map(_acts, tree.body)), _imports_computed(tree))
    docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=aliases):
                for alias in aliases:
                    module = tuple(alias.name.split("."))
                    of.bound[alias.asname or module[0]].add(module if alias.asname else module[:1])
                    if module[1:] and not alias.asname:
                        of.used.add(module)
            case ast.ImportFrom(module=module, names=aliases, level=level):
                base = package[: len(package) - level + 1] if level else ()
                base += tuple(module.split(".")) if module else ()
                for alias in aliases:
                    if alias.name == "*":
                        of.used.add(base)
                    else:
                        of.bound[alias.asname or alias.name].add((*base, alias.name))
            case ast.Constant(value=str(text)) if node not in docstrings:
                of.named.update(modules_in(text))
    for name, *attributes in _chains(tree):
        of.used.update((*base, *attributes) for base in of.bound.get(name, ()))
    return of


def _imports_computed(tree: ast.AST) -> bool:
    """Whether the code imports a module by a name that is not written there."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    by_name = [call for call in calls if getattr(call.func, "attr", getattr(call.func, "id", "")) in _BY_NAME]
    return any(not (call.args and isinstance(call.args[0], ast.Constant)) for call in by_name)


def modules_in(text: str) -> Iterator[Names]:
    """Names in a string that may be those of modules."""
    if entry := _ENTRY.fullmatch(text):
        yield tuple(entry[1].split("."))
    elif _MODULE.fullmatch(text):
        yield tuple(text.split("."))
    for module in _COMMAND.findall(text):
        yield (*module.split("."), "__main__")
        yield tuple(module.split("."))


def _without_type_checking(tree: ast.Module) -> ast.Module:
    """Remove the code that only type checkers read."""

    class Removal(ast.NodeTransformer):
        def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
            self.generic_visit(node)
            match node.test:
                case ast.Name(id="TYPE_CHECKING"):
                    return node.orelse
                case ast.UnaryOp(op=ast.Not(), operand=ast.Name(id="TYPE_CHECKING")):
                    return node.body
            return node

    return Removal().visit(tree)


def _chains(tree: ast.AST) -> Iterator[Names]:
    """Names with their attributes, at every place where they are read: ``plots.style.LOOKS``."""
    inner = set()
    for node in ast.walk(tree):  # from the outside to the inside
        if node in inner or not isinstance(node, ast.Attribute | ast.Name):
            continue
        attributes, value = [], node
        while isinstance(value, ast.Attribute):
            attributes.append(value.attr)
            value = value.value
            inner.add(value)
        if isinstance(value, ast.Name):
            yield (value.id, *reversed(attributes))


def _acts(node: ast.stmt) -> bool:
    """Whether a statement at the top of a module does more than define names."""
    match node:
        case ast.Import() | ast.ImportFrom() | ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return False
        case ast.Expr(value=ast.Constant()):
            return False
        case ast.Assign(targets=targets):
            return not all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
        case ast.AnnAssign(target=target):
            return not isinstance(target, ast.Name)
        case ast.If(test=ast.Compare(left=ast.Name(id="__name__"))):
            return False
    return True


class Graph:
    """Import graph of the modules in some folders.

    Parameters
    ----------
    folders : list of Path
        Places on Python's path, in order. Modules that lie elsewhere do not count.
    """

    def __init__(self, *folders: Path) -> None:
        self._folders = folders
        self._file = cache(self._find)

    def files(self, source: str, texts: Iterable[str] = ()) -> set[Path]:
        """Return the files that a piece of code depends on, with those of modules that other texts name.

        Raises
        ------
        SyntaxError
            If the code, or that of a module, is not Python.
        """
        found: set[Path] = set()
        self._add(uses(source), found)
        for text in texts:
            self._add_named(modules_in(text), found)
        packages = {self._folder(file) / file.relative_to(self._folder(file)).parts[0] for file in found}
        for file in [file for package in packages if package.is_dir() for file in package.rglob("*.py")]:
            if self._uses(file).acts:
                self._visit(file, found)
        return found

    def _add(self, of: Uses, found: set[Path]) -> None:
        """Add the files that a piece of code depends on."""
        for names in of.used:
            self._resolve(names, found)
        for names in set().union(*of.bound.values()):
            if not self._is_package(names):  # of a package, only the names that are used count
                self._resolve(names, found)
        self._add_named(of.named, found)

    def _add_named(self, named: Iterable[Names], found: set[Path]) -> None:
        for names in named:
            if self._file(names):
                self._resolve(names, found)

    def _resolve(self, names: Names, found: set[Path]) -> None:
        """Add the files behind a full name."""
        for n in range(1, len(names) + 1):
            file = self._file(names[:n])
            if file is None:  # of another project, or a name in the module before
                return
            if not self._is_package(names[:n]):
                self._visit(file, found)
                return
            if n == len(names):
                self._everything(file, found)
                return
            # A package may bind a name to something else than its module of that name: both count.
            bound = {one for one in self._uses(file).bound.get(names[n], ()) if one[: n + 1] != names[: n + 1]}
            for one in bound:
                self._resolve((*one, *names[n + 1 :]), found)
            if not bound and not self._file(names[: n + 1]) and names[n] != "__version__":  # of the installation
                self._visit(file, found)

    def _visit(self, file: Path, found: set[Path]) -> None:
        """Add a file and everything that it imports."""
        if file in found:
            return
        found.add(file)
        of = self._uses(file)
        self._add(of, found)
        if of.computed and file.name == "__init__.py":
            self._everything(file, found)

    def _everything(self, init: Path, found: set[Path]) -> None:
        """Add all modules of a package."""
        for file in init.parent.rglob("*.py"):
            self._visit(file, found)

    def _folder(self, file: Path) -> Path:
        return next(folder for folder in self._folders if file.is_relative_to(folder))

    def _uses(self, file: Path) -> Uses:
        return uses(file.read_text("utf-8"), file.relative_to(self._folder(file)).parent.parts)

    def _find(self, module: Names) -> Path | None:
        """File of a module; None if the folders do not hold it."""
        for folder in self._folders:
            path = folder.joinpath(*module)
            for file in (path / "__init__.py", path.with_name(f"{path.name}.py")):
                if file.is_file():
                    return file
        return None

    def _is_package(self, module: Names) -> bool:
        file = self._file(module)
        return file is not None and file.name == "__init__.py"
