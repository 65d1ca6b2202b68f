"""The book: run what changed, build it with Jupyter Book, and print it."""

import json
import os
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from zwfs._system import write_file

from .execute import TRACEBACK_LINES, tell
from .project import EXECUTED, PYODIDE, Project, ToolError
from .record import commit, digest, digest_files
from .run import refresh, run
from .scratch import scratch_folder, swap

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
JUPYTER_BOOK = Path(sys.executable).with_name("jupyter-book")
BEAT = 10.0  # between two lines of output while the pages are built, second
OPTIONS = ["-W", "-n", "--keep-going"]  # warnings are errors, and all of them are listed
NEXT = """next:
  make rerun FIGURE=3 ARGS="-p n_screens=5"   run a notebook with other parameters
  make lab                                    open the notebooks
  make help                                   list all commands"""


class BookError(ToolError):
    """Failure of the book; the message holds the warnings of Sphinx."""


def book(project: Project) -> None:
    """Run the notebooks that changed and build the book."""
    run(project)
    print(f"book: {'built' if build(project) else 'unchanged'}")
    print(f"open {(project.build / 'html' / 'index.html').relative_to(project.root)}")
    print(NEXT)


def figures(project: Project) -> None:
    """Replace the committed notebooks and the front figure by freshly run ones."""
    run(project)
    for name in refresh(project):
        print(f"{name} is new")


def build(project: Project) -> bool:
    """Build the book in _build/html unless it is current, and return whether it was built.

    After an error or a warning the earlier book stays.
    """
    html, record = project.build / "html", project.build / "html.json"
    made_from = _digest(project)
    with suppress(OSError, ValueError):  # the book was never built, or not to its end
        if html.is_dir() and json.loads(record.read_bytes()) == made_from:
            return False
    record.unlink(missing_ok=True)  # a failure from here on must be followed by a build
    tell("building the pages")
    with scratch_folder(project.build, "building-") as scratch:
        pages = _write_pages(project, scratch)
        # Sphinx needs it for a later build in the same place. Its digest depends on the place.
        (pages / ".buildinfo").unlink(missing_ok=True)
        swap(pages, html, scratch / "earlier")
    write_file(record, json.dumps(made_from).encode())
    return True


def _output(process: subprocess.Popen[str]) -> str:
    """Wait for a process, with a line after each `BEAT`, and return its output; an interruption ends it."""
    begin = time.monotonic()
    try:
        while True:
            with suppress(subprocess.TimeoutExpired):
                return process.communicate(timeout=BEAT)[0]
            tell(f"building the pages: {time.monotonic() - begin:.0f} s")
    except BaseException:
        process.kill()
        raise


def _digest(project: Project) -> str:
    """Return a digest of everything that the book depends on."""
    root = project.root
    files = [root / name for name in ("_config.yml", "_toc.yml", "pyproject.toml")]
    files += [file for file in (root / "book").rglob("*") if "__pycache__" not in file.parts]
    files += [*project.sources(), *project.modules(), project.lock]
    for notebook in project.sources():
        executed = project.executed / notebook.name
        files += [executed, executed.with_suffix(".json"), *project.published(notebook.stem)]
    named = {file.relative_to(root).as_posix(): file for file in files if file.is_file()}
    # The pages name the commit.
    about = json.dumps([sys.version_info[:2], os.environ.get(PYODIDE), commit(root)])
    return digest([digest_files(named).encode(), about.encode()])


def _write_pages(project: Project, output: Path) -> Path:
    """Run ``jupyter-book build .`` with the executed notebooks, and return the folder of the pages."""
    executed = {EXECUTED: str(project.executed.relative_to(project.root))}
    command: list[str | Path] = [JUPYTER_BOOK, "build", *OPTIONS, "--path-output", output, "."]
    pipe, both = subprocess.PIPE, subprocess.STDOUT
    with subprocess.Popen(
        command, cwd=project.root, env=os.environ | executed, stdout=pipe, stderr=both, text=True
    ) as build:
        log = _output(build)
    if build.returncode:
        said = COLOUR.sub("", log).replace(f"{project.root}{os.sep}", "")
        lines = said.partition("\nThe above exception was the direct cause")[0].strip().splitlines()
        marked = [line for line in lines if "WARNING:" in line or "ERROR:" in line]
        raise BookError("\n".join(["the book was not built:", *(marked or lines[-TRACEBACK_LINES:])]))
    return output / "_build" / "html"
