"""Python in the pages: forms of the notebooks' parameters, and all files that a browser needs to run the code.

Nothing is loaded before the reader asks. `book/_static/run.js` is the page's side, `driver.py` that of Python.
"""

import base64
import copy
import io
import json
import os
import re
import shutil
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import nbformat
from docutils import nodes
from nbformat import NotebookNode
from sphinx.application import Sphinx

from book._tools import declared
from book._tools.declared import Parameter
from book._tools.notebook import BOOK
from book._tools.project import PYODIDE, Project
from studies.kit.parameters import Fields
from studies.kit.results import published

COPY = "_static/pyodide"
DATA = "_static/run"
REPOSITORY = "_static/zwfs.zip"
KNOWN = Path(__file__).with_name("pyodide.json")  # sizes and digests of the version that this book uses
SHARES = Path(__file__).with_name("shares.json")  # seconds of the cells and sweeps, see environment/shares.py
FOLDERS = ("book", "environment", "notebooks", "tests", "zwfs")
PURE = "array-api-compat", "markdown-it-py", "mdurl"  # packages that Pyodide does not have
SCRIPTS = ("run/settings.js", "run-worker.js", "run-form.js", "run.js")


def form(figure: str, first: bool) -> str:
    """Return the place of the form, and of the button of every later figure, in HTML for a card."""
    kind = "run-form" if first else "run-figure"
    absent = "With JavaScript, this figure can be computed again here, with other parameters."
    return f'<div class="{kind}" data-figure="{figure}"><noscript>{absent}</noscript></div>'


def mark_cells(notebook: NotebookNode) -> None:
    """Mark on the page, in place, what a run in it replaces, and what holds for the parameters of the book only.

    A cell of code gets its number as a tag, which is a class on the page. Markdown has no such class: the text
    below the heading of a cell with the tag `BOOK` is put into a block.
    """
    for number, cell in enumerate(notebook.cells):
        tags = cell.metadata.get("tags", [])
        if cell.cell_type == "code":
            cell.metadata.tags = [*tags, f"run-{number}"]
        elif BOOK in tags:
            heading, _, text = cell.source.partition("\n")
            cell.source = f"{heading}\n\n::::::::{{div}} {BOOK}\n{text.strip()}\n::::::::"


def described(notebook: NotebookNode, name: str) -> dict[str, Any]:
    """Return what the page needs of a notebook, ready for JSON."""
    study = declared.study_of(notebook)
    cells = [copy.deepcopy(cell) for cell in notebook.cells]
    for cell in cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    return {
        "name": name,
        "parameters": {key: field(parameter) for key, parameter in declared.parameters(notebook).items()},
        "quick": getattr(study, "QUICK", {}),
        "shares": json.loads(SHARES.read_text("utf-8")).get(name, {"book": {}, "quick": {}}),
        "figures": {
            figure: number
            for number, cell in enumerate(cells)
            for figure in (published(cell.source) if cell.cell_type == "code" else [])
        },
        # Files in FITS need it, and no study imports it.
        "extra": ["astropy"] if any(c.cell_type == "code" and "zwfs.frames" in c.source for c in cells) else [],
        "notebook": {"cells": cells, "metadata": notebook.metadata, "nbformat": 4, "nbformat_minor": 5},
    }


def field(parameter: Parameter) -> dict[str, Any]:
    """Return a parameter for the form."""
    return {
        "meaning": parameter.meaning,
        "unit": parameter.unit,
        "default": parameter.default,
        "limits": limits(parameter),
    }


def limits(parameter: Parameter) -> dict[str, Any]:
    """Return the limits of a parameter for the form."""
    match parameter.limits:
        case Fields(kinds=kinds):
            fields = {name: field(value) for name, value in parameter.fields().items() if name != "kind"}
            return {"kinds": {kind: list(of) for kind, of in kinds.items()}, "fields": fields}
        case [item, *more] if isinstance(parameter.limits, list):
            return {"list": limits(Parameter(None, "", "", item)), "empty": bool(more)}
        case (str(), *_) as choices:
            return {"choices": choices}
        case (low, high):
            return {"low": low, "high": high, "whole": isinstance(low, int) and isinstance(high, int)}
    return {"yes": parameter.limits is bool}


def site(project: Project) -> bytes:
    """Return a ZIP of the code and data that the page needs."""
    files = package(project)
    studies = (file for file in project.modules() if file.is_relative_to(project.studies))
    files |= {file.relative_to(project.notebooks).as_posix(): file.read_bytes() for file in studies}
    files["driver.py"] = Path(__file__).with_name("driver.py").read_bytes()
    about = metadata.distribution("zwfs")
    files[f"zwfs-{about.version}.dist-info/METADATA"] = f"Name: zwfs\nVersion: {about.version}\n".encode()
    for file in chain.from_iterable(metadata.files(name) or () for name in PURE):
        if file.suffix == ".py" or file.match("*.dist-info/METADATA") or file.match("*.dist-info/licenses/*"):
            files[file.as_posix()] = file.read_binary()
    return zipped(files)


def package(project: Project) -> dict[str, bytes]:
    """Return the files of the package by name."""
    files = (file for file in (project.root / "zwfs").rglob("*") if file.suffix in (".py", ".npz", ".typed"))
    return {file.relative_to(project.root).as_posix(): file.read_bytes() for file in files}


def repository(project: Project) -> dict[str, bytes]:
    """Return the files of the repository by name, but none of those that its tools leave behind."""
    files = [file for folder in FOLDERS for file in (project.root / folder).rglob("*")] + [*project.root.iterdir()]
    named = {file.relative_to(project.root): file for file in sorted(files) if file.is_file()}
    hidden = re.compile(r"\.|__pycache__|.*\.egg-info")
    return {
        f"zwfs-book/{name.as_posix()}": file.read_bytes()
        for name, file in named.items()
        if not any(map(hidden.match, name.parts))
    }


def zipped(files: dict[str, bytes]) -> bytes:
    """Return a ZIP of files by name; the same content gives the same bytes."""
    stream = io.BytesIO()
    with ZipFile(stream, "w", ZIP_DEFLATED) as archive:
        for name in sorted(files):
            about = ZipInfo(name)  # its date is a constant
            about.compress_type, about.external_attr = ZIP_DEFLATED, 0o644 << 16
            archive.writestr(about, files[name])
    return stream.getvalue()


def write(app: Sphinx, exception: Exception | None) -> None:
    """Write the data of the notebooks, the files of Python, and where Pyodide is."""
    if exception is not None or app.builder.name != "html":
        return
    project, folder = Project(Path(app.srcdir)), Path(app.outdir, DATA)
    folder.mkdir(parents=True, exist_ok=True)
    for source in project.sources():
        notebook = nbformat.read(source, as_version=4)
        write_script(folder / f"{source.stem}.js", "zwfsNotebook", described(notebook, source.stem))
    write_script(folder / "files.js", "zwfsFiles", base64.b64encode(site(project)).decode())
    Path(app.outdir, REPOSITORY).write_bytes(zipped(repository(project)))  # pip installs it
    version = json.loads(KNOWN.read_text("utf-8"))
    write_script(folder / "settings.js", "zwfsPython", version | {"place": place(app)})


def write_script(file: Path, name: str, value: Any) -> None:
    """Write a script that defines data: browsers block pages from the file system from reading data files."""
    file.write_text(f"window.{name} = {json.dumps(value, ensure_ascii=False)};\n", "utf-8")


def place(app: Sphinx) -> str:
    """Return the address of Pyodide; copy a folder into the book if the environment names one."""
    target = Path(app.outdir, COPY)
    shutil.rmtree(target, ignore_errors=True)  # of an earlier build
    if folder := os.environ.get(PYODIDE):
        shutil.copytree(folder, target, copy_function=shutil.copyfile)
        return f"{COPY}/"
    return str(app.config.pyodide)


def add_scripts(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: nodes.document) -> None:
    """Load the scripts on pages with code to run, and there alone."""
    body = context.get("body", "")
    if 'class="run-form"' in body or "runnable" in body:
        app.add_css_file("run.css")
        scripts = (f"run/{Path(page).name}.js", *SCRIPTS) if 'class="run-form"' in body else SCRIPTS
        for script in scripts:
            app.add_js_file(script, loading_method="defer")


def setup(app: Sphinx) -> dict[str, bool]:
    """Mark what can run, and write what it needs."""
    app.add_config_value("pyodide", "", "html")
    app.connect("html-page-context", add_scripts)
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
