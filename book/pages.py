"""Build the book with Jupyter Book, from the notebooks as they were just run, and print it."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import printing
import yaml
from runner import Project, digest, digest_files, scratch_folder, swap

from zwfs._files import write_file

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
JUPYTER_BOOK = [sys.executable, "-c", "from jupyter_book.cli.main import main; main()"]
# Read by the extensions `cards` and `finish` in book/_ext.
EXECUTED, PDF = "ZWFS_EXECUTED", "ZWFS_PDF"


class BookError(Exception):
    """The book has warnings or errors; the message holds those of Sphinx."""


def inputs(project: Project) -> dict[str, Path]:
    """Return every file that the book depends on, by its place in the project."""
    root = project.root
    files = [root / name for name in ("_config.yml", "_toc.yml", "pyproject.toml")]
    files += [file for file in (root / "book").rglob("*") if "__pycache__" not in file.parts]
    files += [*project.sources(), *project.shared_inputs()]
    for notebook in project.sources():
        run = project.executed / notebook.name
        files += [run, run.with_suffix(".json"), *project.files(notebook.stem)]
    return {file.relative_to(root).as_posix(): file for file in files if file.is_file()}


def state(root: Path) -> str:
    """Return what the book says of the working tree: the commit, and whether there are changes."""
    git = ["git", "-C", str(root)]
    commands = ([*git, "rev-parse", "HEAD"], [*git, "status", "--porcelain"])
    return str([subprocess.run(command, capture_output=True, text=True).stdout for command in commands])


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
    """Build the book in _build/html, unless it is there and nothing that it depends on has changed.

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
    """
    check_contents(project)
    html, record = project.build / "html", project.build / "html.json"
    chromium = printing.find_chromium() if (project.root / printing.STYLE).exists() else None
    about = json.dumps([sys.version_info[:2], bool(chromium), state(project.root)])
    made_from = digest([digest_files(inputs(project)).encode(), about.encode()])
    try:
        if html.is_dir() and json.loads(record.read_bytes()) == made_from:
            return False
    except (OSError, ValueError):
        pass  # the book was never built, or not to its end
    record.unlink(missing_ok=True)  # a failure from here on must be followed by a build
    with scratch_folder(project.build, "building-") as scratch:
        environment = {EXECUTED: str(project.executed.relative_to(project.root))}
        if chromium:
            environment[PDF] = printing.NAME
        built = write_pages(project.root, scratch, environment)
        if chromium:
            (built / printing.NAME).write_bytes(printing.print_book(project.root, built, chromium))
        swap(built, html, scratch / "earlier")
    write_file(record, json.dumps(made_from).encode())
    return True


def write_pages(root: Path, output: Path, environment: dict[str, str]) -> Path:
    """Run ``jupyter-book build`` with warnings as errors, and return the folder of the pages, in `output`."""
    options = ["-W", "-n", "--keep-going", "--path-output", str(output)]
    done = subprocess.run(
        [*JUPYTER_BOOK, "build", *options, str(root)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | environment,
    )
    if done.returncode:
        lines = COLOUR.sub("", done.stdout).replace(f"{root}{os.sep}", "").splitlines()
        marked = [line for line in lines if "WARNING:" in line or "ERROR:" in line]
        raise BookError("\n".join(["the book was not built:", *(marked or lines[-40:])]))
    return output / "_build" / "html"
