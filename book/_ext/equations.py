"""Links from each equation to the code that implements it and to its tests, from the citations in docstrings."""

import importlib
import inspect
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

from book._ext import api

LABEL = re.compile(r"`(eq-[\w-]+)`")
NUMBER = re.compile(r"\((\d+)\)")


class LinkCode(SphinxTransform):
    """Add a line with links below each equation that a docstring cites."""

    default_priority = 500

    def apply(self) -> None:
        """Add the lines of a page."""
        root = Path(self.app.srcdir)
        for equation in list(self.document.findall(nodes.math_block)):
            if paths := implementations(root).get(equation.get("label", "")):
                line = nodes.paragraph("", "Code: ", classes=["equation-code"])
                line += joined([self.link(path) for path in paths])
                files = dict.fromkeys(file for path in paths for file in tests(root, path))
                line += nodes.Text(" · " if files else "")
                line += joined([self.test(file) for file in files])
                equation.parent.insert(equation.parent.index(equation) + 1, line)

    def test(self, file: str) -> nodes.Node:
        """Return the name of a file of tests, with a link if the repository has an address."""
        options = self.config.html_theme_options
        if not options["repository_url"]:
            return nodes.literal("", file)
        source = f"{options['repository_url']}/blob/{options['repository_branch']}/tests"
        return nodes.reference("", "", nodes.literal("", file), refuri=f"{source}/{file}")

    def link(self, path: str) -> nodes.Node:
        """Return a link to a name on the API page."""
        about = {"refdomain": "py", "reftype": "obj", "reftarget": path, "refdoc": self.env.docname}
        return pending_xref("", nodes.literal("", path), refexplicit=True, refwarn=True, **about)


def joined(links: list[nodes.Node]) -> list[nodes.Node]:
    """Return links with commas between them."""
    return [part for link in links for part in (nodes.Text(", "), link)][1:]


@cache
def implementations(root: Path) -> dict[str, list[str]]:
    """Return the paths of the public functions and classes whose docstrings cite an equation, by its label."""
    labels, found = api.paper_labels(root / "book"), dict[str, list[str]]()
    for path, text in docstrings():
        numbers = NUMBER.findall(" ".join(api.NUMBERED.findall(text)))
        for label in {*LABEL.findall(text), *(labels[int(number) - 1] for number in numbers)}:
            found.setdefault(label, []).append(path)
    # A method says more than its class.
    return {
        label: sorted({path for path in paths if not any(one.startswith(f"{path}.") for one in paths)})
        for label, paths in found.items()
    }


def docstrings() -> Iterator[tuple[str, str]]:
    """Yield paths and docstrings of the public functions, classes and methods of the package."""
    for name in api.modules():
        module = importlib.import_module(name)
        for own in api.own_names(module):
            thing, path = getattr(module, own), api.path(module, own)
            yield path, inspect.getdoc(thing) or ""
            listed = api.members(thing) if inspect.isclass(thing) else []
            for member in vars(thing) if inspect.isclass(thing) else ():
                value = getattr(thing, member)
                if not (member.startswith("_") or inspect.isclass(value)):
                    yield f"{path}.{member}" if member in listed else path, inspect.getdoc(value) or ""


@cache
def tests(root: Path, path: str) -> list[str]:
    """Return the file with the tests of a name: that of its module, else the one that uses the name most often."""
    thing = nearest(path)
    for part in reversed(thing.__module__.split(".")):
        if (root / "tests" / f"test_{part}.py").exists():
            return [f"test_{part}.py"]
    word = re.compile(rf"\b{thing.__name__}\b")
    files = sorted(set((root / "tests").glob("test_*.py")) - {root / "tests" / "test_bad_input.py"})
    uses = {file.name: len(word.findall(file.read_text("utf-8"))) for file in files}
    return [max(uses, key=uses.__getitem__)] if any(uses.values()) else []


def nearest(path: str) -> type:
    """Return the function or the class at a path; the class of a method."""
    parts = path.split(".")
    start = max(
        depth for depth in range(1, len(parts)) if ".".join(parts[:depth]) in {api.PACKAGE, *api.modules()}
    )
    return getattr(importlib.import_module(".".join(parts[:start])), parts[start])


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the lines to each page."""
    app.add_transform(LinkCode)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
