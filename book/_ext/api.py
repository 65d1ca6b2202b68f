"""The API pages: a directive for the public names of modules, and links in docstrings."""

import importlib
import inspect
import pkgutil
import re
from functools import cache, cached_property
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode

PACKAGE = "zwfs"
KINDS = ("class", "data", "exception", "function")
# The pages with the equations of the paper, in its order.
PAPER = ("sensor.md", "phase_shifted.md", "methods.md")

BACK = re.compile(r'<a class="viewcode-back".*?</a>')
NUMBERED = re.compile(r"(?<=Chambouleyron)[^;]*?equations?\s[^;.\n]*")


class Modules(SphinxDirective):
    """Document the public names of modules; ``package.*`` stands for a package and all its public modules."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Parse a section for each module; MyST appends it to the page."""
        lines = []
        for name in self.arguments[0].split():
            package = name.removesuffix(".*")
            inside = [module for module in modules() if name != package and module.startswith(f"{package}.")]
            for module in (package, *inside):
                lines += section(module)
        self.state.nested_parse(StringList(lines, self.env.docname), 0, nodes.container(), match_titles=True)
        return []


def section(name: str) -> list[str]:
    """Return the MyST text that documents one module."""
    module = importlib.import_module(name)
    directives = []
    for own in own_names(module):
        thing = getattr(module, own)
        kind = "class" if inspect.isclass(thing) else "function"
        listed = members(thing) if inspect.isclass(thing) else []
        options = [f"   :members: {', '.join(listed)}"] if listed else []
        options += ["   :special-members: __call__"] if "__call__" in listed else []
        directives += [f".. auto{kind}:: {path(module, own)}", *options, ""]
    return [f"## `{name}`", "", "```{eval-rst}", f".. automodule:: {name}", "", *directives, "```", ""]


@cache
def modules() -> list[str]:
    """Return the names of the public modules of the package, in order."""
    package = importlib.import_module(PACKAGE)
    walked = (module.name for module in pkgutil.walk_packages(package.__path__, f"{PACKAGE}."))
    named = (name for name in walked if not any(part.startswith("_") for part in name.split(".")))
    # A module with an empty list of public names is a part of the package.
    return sorted(name for name in named if getattr(importlib.import_module(name), "__all__", True))


def own_names(module: ModuleType) -> list[str]:
    """Return the public names that a module, or a private part of a package, defines."""
    package = hasattr(module, "__path__")
    public = getattr(module, "__all__", vars(module))
    # A package may also export what a private part of the whole package defines.
    private = (f"{module.__name__}._", f"{PACKAGE}._") if package else (f"{module.__name__}._",)
    # A package imports what it offers at its first use.
    named = {name: getattr(module, name) for name in (public if package else vars(module))}
    return [
        name
        for name, thing in named.items()
        if (inspect.isclass(thing) or inspect.isfunction(thing))
        and (thing.__module__ == module.__name__ or thing.__module__.startswith(private))
        and name in public
        and not name.startswith("_")
    ]


def members(thing: type) -> list[str]:
    """Return the methods and properties that have entries of their own: they repeat none of a class above."""
    return [
        name
        for name, value in vars(thing).items()
        if isinstance(value, FunctionType | classmethod | staticmethod | property | cached_property)
        and (name == "__call__" or not name.startswith("_"))
        and not any(name in dir(base) for base in thing.__bases__)
    ]


def path(module: ModuleType, name: str) -> str:
    """Return the shortest path from which a name can be imported; a path can also be that of a module."""
    parts, of_modules = module.__name__.split("."), modules()
    for package in (importlib.import_module(".".join(parts[:depth])) for depth in range(1, len(parts))):
        same = getattr(package, name, None) is getattr(module, name)
        if same and name in package.__all__ and f"{package.__name__}.{name}" not in of_modules:
            return f"{package.__name__}.{name}"
    return f"{module.__name__}.{name}"


@cache
def paper_labels(folder: Path) -> list[str]:
    """Return the labels of the paper's equations, from equation (1) on."""
    texts = ((folder / page).read_text("utf-8") for page in PAPER)
    return [label for text in texts for label in re.findall(r"^ *:label: (\S+)$", text, re.MULTILINE)]


def link_equations(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Link the equations of the paper that a docstring cites by number, and escape the bars of moduli."""
    labels = paper_labels(Path(app.srcdir, "book"))

    def label(number: re.Match) -> str:
        return f":eq:`{labels[int(number[1]) - 1]}`"

    text = NUMBERED.sub(lambda cited: re.sub(r"\((\d+)\)", label, cited[0]), "\n".join(lines))
    # A bar is a modulus and no substitution; code in double backticks stays as it is.
    text = re.sub(r"``[^`]*``|\|", lambda part: "\\|" if part[0] == "|" else part[0], text)
    lines[:] = text.splitlines()


def link_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, contnode: nodes.TextElement
) -> nodes.Node | None:
    """Resolve a name in single backticks: a public name of the package, the label of an equation, or code."""
    if (node["refdomain"], node["reftype"]) != ("py", "obj"):
        return None
    target, document = node["reftarget"], node["refdoc"]
    if target.startswith("eq-"):
        return env.domains["math"].resolve_xref(env, document, app.builder, "eq", target, node, contnode)
    named = {
        full: entry
        for full, entry in env.domains["py"].objects.items()
        if entry.objtype in KINDS and not entry.aliased and full.endswith(f".{target}")
    }
    if len(named) == 1:
        [(full, entry)] = named.items()
        return make_refnode(app.builder, document, entry.docname, entry.node_id, contnode, full)
    # Sphinx reports a full path that leads nowhere.
    return None if target.startswith(f"{PACKAGE}.") else contnode


def drop_links_back(app: Sphinx, page: str, template: str, context: dict[str, Any], document: Any) -> None:
    """Drop the links of sources to entries: they name the module of a definition, entries a shorter path."""
    if page.startswith("_modules/"):
        context["body"] = BACK.sub("", context["body"])


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive and the links."""
    app.add_directive("modules", Modules)
    app.connect("autodoc-process-docstring", link_equations, priority=400)
    app.connect("missing-reference", link_name)
    app.connect("html-page-context", drop_links_back)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
