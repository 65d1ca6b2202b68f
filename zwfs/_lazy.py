"""Packages that import what they offer at its first use (PEP 562).

Such a package imports its names under ``if TYPE_CHECKING:``, where type checkers and editors read them. This
module reads them there, too. Where a name comes from is therefore written once, and `import zwfs` loads no other
module.
"""

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import get_data
from sys import modules
from typing import Any


def offered(code: str | bytes) -> dict[str, tuple[str, str]]:
    """Return where code imports names from under ``if TYPE_CHECKING:``: module and name there, by name."""
    blocks = (block for block in ast.parse(code).body if isinstance(block, ast.If))
    lines = (line for block in blocks if ast.unparse(block.test) == "TYPE_CHECKING" for line in block.body)
    imports = (line for line in lines if isinstance(line, ast.ImportFrom))
    return {name.asname or name.name: (str(line.module), name.name) for line in imports for name in line.names}


def offer(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` for a package: they know its names and its modules."""

    @cache
    def names() -> dict[str, tuple[str, str]]:
        return offered(get_data(package, "__init__.py") or b"")

    def attribute(name: str) -> Any:
        module, original = names().get(name, (package, name))
        if module != package:
            value = getattr(import_module(module), original)
        elif not name.startswith("__") and find_spec(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        vars(modules[package])[name] = value  # from now on it is found without this function
        return value

    return attribute, lambda: sorted({*vars(modules[package]), *names()})
