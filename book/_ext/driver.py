"""Runs the cells of a notebook, and the examples of a page, in the Python of a browser.

Pyodide imports this file in the worker of `book/_static/run-worker.js`. It replaces a kernel of Jupyter.
"""

import ast
import io
import json
import os
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace
from typing import Any

figures: dict[str, tuple[Any, Any]] = {}  # that the notebook published, with their numbers of single screens
variants: dict[str, dict[str, Any]] = {}  # of the figures, once they are asked for
names: dict[str, Any] = {}  # of the notebook


def prepare(tell: Callable[[str, int, int], None]) -> None:
    """Provide what notebooks expect of Jupyter, and report the progress of sweeps."""
    os.environ["MPLBACKEND"] = "agg"
    _provide("myst_nb", glue=lambda name, value, display=True: None)
    if not find_spec("IPython"):
        _provide("IPython", get_ipython=lambda: None)
        _provide("IPython.display", HTML=lambda text: SimpleNamespace(_repr_html_=lambda: text))
    vars(import_module("studies.kit.sweeps"))["report_progress"] = tell
    vars(import_module("studies.kit.results"))["publish"] = _keep
    _repair_svd()


def _repair_svd() -> None:
    """Replace `numpy.linalg.svd` where it gives NaN: NumPy 2.0.2 of Pyodide does so for some wide matrices."""
    import numpy as np
    from scipy import linalg

    given = np.linalg.svd

    def svd(a: Any, *args: Any, **named: Any) -> Any:
        found = given(a, *args, **named)
        values = found if isinstance(found, np.ndarray) else found[1]
        damaged = np.ndim(a) == 2 and not np.isfinite(values).all() and np.isfinite(a).all()
        return linalg.svd(a, *args, **named) if damaged else found

    vars(np.linalg)["svd"] = svd


def _keep(figure: Any, name: str, screens: Any = None) -> None:
    """Stand for `publish`: files are drawn when the page asks for them."""
    figures[name] = figure, screens


def _provide(module: str, **members: Any) -> None:
    sys.modules[module] = ModuleType(module)
    vars(sys.modules[module]).update(members)


def begin(notebook: str, defaults: str, given: str) -> str:
    """Check parameters as `make rerun` does; return the error, or nothing.

    `defaults` is the source of the cell of parameters, `given` a JSON object of the JSON text of each value.
    """
    import matplotlib.pyplot as plt

    from studies.kit.parameters import check_parameters, typed

    plt.close("all")
    for state in (names, figures, variants):
        state.clear()
    names["__name__"] = "__main__"
    exec(defaults, names)
    known = {name for name in names if name != "np" and not name.startswith("__")}
    study = import_module(f"studies.{notebook}")
    try:
        values = {name: json.loads(text) for name, text in json.loads(given).items()}
        check_parameters(values, **{name: study.LIMITS[name] for name in values})
        names.update({name: typed(value, study.LIMITS[name]) for name, value in values.items()})
        if check := getattr(study, "CHECK_TOGETHER", None):
            check(**{name: names[name] for name in known})
    except (TypeError, ValueError, OSError) as error:
        return str(error)
    return ""


def cell(source: str) -> str:
    """Run a cell; return JSON of its Markdown as HTML, and of the error if it failed."""
    shown: dict[str, Any] = {}
    try:
        value = _run(source, names)
        if represent := getattr(value, "_repr_markdown_", None):
            shown["html"] = in_html(represent())
    except Exception as error:
        shown["error"] = _message(error)
    return json.dumps(shown)


def in_html(markdown: str) -> str:
    """Return Markdown as HTML: paragraphs, lists, tables, links to pages; HTML in it stays text."""
    from markdown_it import MarkdownIt

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for token in (part for block in tokens for part in block.children or ()):
        if address := token.attrs.get("href"):
            token.attrs["href"] = re.sub(r"\.(ipynb|md)(?=#|$)", ".html", str(address))
    return parser.renderer.render(tokens, parser.options, {})


def example(source: str) -> str:
    """Run an example; return JSON of what it printed, with the value of its last line, and of the error."""
    said, shown = io.StringIO(), {}
    try:
        with redirect_stdout(said):
            value = _run(source, {"__name__": "__main__"})
            if value is not None:
                print(repr(value))
    except Exception as error:
        shown["error"] = _message(error)
    return json.dumps(shown | {"text": said.getvalue()})


def _run(source: str, space: dict[str, Any]) -> Any:
    """Run code in a namespace; return the value of its last line, if that is an expression."""
    tree = ast.parse(source)
    last = tree.body[-1] if tree.body else None
    value = ast.Expression(last.value) if isinstance(last, ast.Expr) else None
    if value:
        tree.body.pop()
    exec(compile(tree, "<page>", "exec"), space)
    return eval(compile(value, "<page>", "eval"), space) if value else None


def _message(error: Exception) -> str:
    return str(error) if isinstance(error, TypeError | ValueError) else f"{type(error).__name__}: {error}"


def versions() -> str:
    """Return JSON of the versions of Python and of the packages."""
    from importlib.metadata import version

    packages = {name: version(name) for name in ("numpy", "scipy", "matplotlib", "zwfs")}
    return json.dumps({"python": sys.version.split()[0], "platform": sys.platform} | packages)


def kinds(name: str) -> list[str]:
    """Return the kinds of files of a published figure: those for which `draw` needs no variant come first."""
    figure, screens = figures[name]
    has_narrow = import_module("studies.kit.variants").has_narrow
    narrow = ["narrow.png", "narrow-dark.png"] if has_narrow(figure) else []
    tables = ["csv"] if screens is None else ["csv", "screens.csv"]
    return [*tables, *import_module("studies.kit.results").METADATA, "dark.png", *narrow]


def draw(name: str, kind: str) -> bytes:
    """Return the content of a file of a published figure."""
    results = import_module("studies.kit.results")
    figure, screens = figures[name]
    if kind in ("csv", "screens.csv"):
        return results.csv_bytes(results.drawn_columns(figure) if kind == "csv" else screens)
    if "." not in kind:
        return results.picture_bytes(figure, kind)
    if name not in variants:
        variants[name] = import_module("studies.kit.variants").variants(figure)
    return results.picture_bytes(variants[name][kind.removesuffix(".png")], "png")
