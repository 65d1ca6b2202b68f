"""Put the pages and the executed notebooks together and build the book from them."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import api
import cards
import claims
import finish
import live
import performance
import printing
import yaml
from runner import Project, digest, digest_files, read, scratch_folder, swap, to_bytes

from zwfs._files import write_file

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
JUPYTER_BOOK = [sys.executable, "-c", "from jupyter_book.cli.main import main; main()"]


class BookError(Exception):
    """The book has warnings or errors; the message is what Sphinx said."""


def mathjax_files() -> dict[str, Path]:
    """The part of MathJax that a page loads, so that mathematics needs no network."""
    package = importlib.util.find_spec("sphinx-mathjax-offline")
    folder = Path(package.origin).parent / "static" / "mathjax"
    files = [folder / "tex-chtml-full.js", *(folder / "output" / "chtml" / "fonts").rglob("*.woff")]
    return {f"book/_static/mathjax/{file.relative_to(folder).as_posix()}": file for file in files}


def staged_files(project: Project) -> dict[str, Path]:
    """Everything that Sphinx reads, by its place in the staged sources."""
    files = {name: project.root / name for name in ("_config.yml", "_toc.yml")}
    for file in (project.root / "book").rglob("*"):
        if file.is_file() and file.suffix not in (".py", ".pyc"):
            files[file.relative_to(project.root).as_posix()] = file
    for notebook in project.sources():
        executed = project.executed / notebook.name
        files[f"notebooks/{notebook.name}"] = executed
        for file in (executed, *project.files(notebook.stem)):
            place = f"notebooks/downloads/{file.name}"
            if place in files:
                raise BookError(f"{files[place].parent.stem} and {notebook.stem} both publish {file.name}")
            files[place] = file
    return files | mathjax_files()


def check_contents(project: Project) -> None:
    """Check that _toc.yml lists every page and every notebook, and nothing else.

    Raises
    ------
    BookError
        It does not: Sphinx would leave out a page without a warning.
    """
    listed = set(_entries(yaml.safe_load((project.root / "_toc.yml").read_text("utf-8"))))
    pages = {file.relative_to(project.root) for file in (project.root / "book").glob("[!_]*.md")}
    pages |= {file.relative_to(project.root) for file in project.sources()}
    known = {page.with_suffix("").as_posix(): page.as_posix() for page in sorted(pages)}
    wrong = [f"{page} is not listed in _toc.yml" for name, page in known.items() if not {name, page} & listed]
    wrong += [f"_toc.yml lists {name}, which is no page" for name in sorted(listed - {*known, *known.values()})]
    if wrong:
        raise BookError("\n".join(["the book was not built:", *wrong]))


def _entries(contents: Any) -> Iterator[str]:
    """Find the pages that a table of contents names, at any depth."""
    for key, value in contents.items():
        if key in ("root", "file"):
            yield value
        elif isinstance(value, list):
            for entry in value:
                yield from _entries(entry)


def build_book(project: Project) -> bool:
    """Build the book in _build/html, unless it is there and nothing that it is made from changed.

    Parameters
    ----------
    project : Project
        Its notebooks have been run.

    Returns
    -------
    bool
        Whether it was built now.

    Raises
    ------
    BookError
        Sphinx gave a warning or an error. The earlier book stays.
    PrintError
        The PDF would not be whole. The earlier book stays.
    ClaimError
        A claim is judged by a number that no notebook gives.
    """
    check_contents(project)
    html, record = project.build / "html", project.build / "html.json"
    files = staged_files(project)
    chromium = printing.find_chromium() if printing.STYLE in files else None
    modules = (sys.modules[__name__], api, cards, claims, finish, live, performance, printing)
    code = [Path(module.__file__) for module in modules]
    about = [file for file in (project.root / "pyproject.toml",) if file.exists()]
    inputs = {f"{file.parent.name}/{file.name}": file for file in (*code, *about, *project.shared_inputs())}
    origin = {notebook.stem: cards.versions_of(project, notebook.stem) for notebook in project.sources()}
    commit = cards.state_of(project)
    told = [sys.version_info[:2], bool(chromium), commit, origin]
    made_from = digest([digest_files(files | inputs).encode(), json.dumps(told, sort_keys=True).encode()])
    try:
        if html.is_dir() and json.loads(record.read_bytes()) == made_from:
            return False
    except (OSError, ValueError):
        pass  # never built, or not to the end
    record.unlink(missing_ok=True)  # from here on the staged sources are not those of the book that is there
    source = _stage(project, files)
    for name, versions in origin.items():
        page = source / "notebooks" / f"{name}.ipynb"
        # The notebook to take away, among the downloads, stays as it was run.
        page.write_bytes(to_bytes(cards.with_cards(read(page), name, versions, commit)))
    made = {
        claims.PAGE: lambda: claims.fragments(project.executed),
        api.PAGE: api.fragments,
        live.PAGE: lambda: {live.DATA: live.script()},
        performance.PAGE: lambda: performance.fragments(source),
        printing.STYLE: lambda: {printing.LINK: printing.link(chromium)},
    }
    for page, fragments in made.items():
        if page in files:
            _write(source, fragments())
    with scratch_folder(project.build, "building-") as scratch:
        built = write_pages(source, scratch)
        if chromium:
            (built / printing.NAME).write_bytes(printing.print_book(project.root, built, chromium))
        swap(built, html, scratch / "earlier")
    write_file(record, json.dumps(made_from).encode())
    return True


def _stage(project: Project, files: dict[str, Path]) -> Path:
    """Copy the sources into one fresh folder; it is kept, for those who look for a warning's cause."""
    source = project.build / "source"
    shutil.rmtree(source, ignore_errors=True)
    for name, file in files.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, source / name)
    return source


def _write(source: Path, fragments: dict[str, str | bytes]) -> None:
    for name, content in fragments.items():
        (source / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def write_pages(source: Path, output: Path) -> Path:
    """Run Jupyter Book with warnings as errors, finish its pages and return their folder, which is in `output`."""
    options = ["-W", "-n", "--keep-going", "--path-output", str(output)]
    done = subprocess.run(
        [*JUPYTER_BOOK, "build", *options, str(source)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # One extension of Sphinx is ours: `api`.
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
    )
    if done.returncode:
        lines = COLOUR.sub("", done.stdout).replace(f"{source}{os.sep}", "").splitlines()
        marked = [line for line in lines if "WARNING:" in line or "ERROR:" in line]
        raise BookError("\n".join(["the book was not built:", *(marked or lines[-40:])]))
    html = output / "_build" / "html"
    finish.finish(source, html)
    return html
