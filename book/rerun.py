"""Run one notebook with parameters of your own, and keep what it makes in a folder of its own."""

import os
import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
    # The imports below take a second, and there is nothing to remove yet: Ctrl-C needs no traceback.
    signal.signal(signal.SIGINT, lambda *_: (os.write(2, b"interrupted: nothing was written\n"), os._exit(1)))

import argparse
import json
import re
import shlex
import shutil
import stat
import sys
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

import declared
import runner
from declared import Parameter, ParameterError
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from runner import Children, NotebookError, Progress, Project

from zwfs.companion.tables import plain

RECORD = "record.json"
MAKER = "zwfs rerun"  # by this a folder is known to be ours
READABLE = 60  # characters of a folder's name that tell the parameters
ROOM = 50_000_000  # bytes on the disk that a run may need for its scratch files
EXAMPLES = """examples:
  rerun                                     list the notebooks
  rerun 3 --list                            list the parameters of Figure 3
  rerun 3 -p rms_max=2.0 -p n_screens=50    run it
  rerun phase_shift_pairs -f mine.yaml      with parameters from a file
"""


class Parser(argparse.ArgumentParser):
    """One that says in one line what is wrong."""

    def error(self, message: str) -> NoReturn:
        """Raise what `main` tells."""
        raise ParameterError(message)


def parser() -> Parser:
    """Return what reads the command line."""
    reads = Parser(
        "rerun", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    reads.add_argument("figure", nargs="?", help="number of a figure, or name of a notebook")
    reads.add_argument("-p", metavar="NAME=VALUE", action="append", default=[], help="a parameter, in YAML")
    reads.add_argument(
        "-f",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="YAML file of parameters; -p wins over it",
    )
    reads.add_argument("--list", action="store_true", help="list parameters, and run nothing")
    reads.add_argument("--force", action="store_true", help="run even if the result is there")
    reads.add_argument("--output", metavar="DIR", type=Path, help="folder for the results")
    reads.add_argument("--line", metavar="TEXT", help="all arguments in one string, quoted as for a shell")
    return reads


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    for argument in arguments:
        if re.search("[\ud800-\udfff]", argument):  # bytes that are no UTF-8
            raise ParameterError(f"{argument}: expected UTF-8")
    asked = parser().parse_args(arguments)
    if asked.line is None:
        return asked
    if len(arguments) > 1:
        raise ParameterError("--line replaces all other arguments: expected no other")
    try:
        return parse(shlex.split(asked.line))
    except ValueError as error:  # of a quotation without an end
        raise ParameterError(f"{asked.line}: {error}") from None


def resolve(project: Project, figure: str) -> str:
    """Return the name of the notebook that a reader means.

    Raises
    ------
    ParameterError
        If there is none.
    """
    names = [path.stem for path in project.sources()]
    wanted = Path(figure).name.removesuffix(".ipynb")
    number = re.fullmatch(r"(?:fig(?:ure)?)?[ _]?0*(\d+)", wanted, re.IGNORECASE)
    found = [name for name in names if name == wanted or (number and name.startswith(f"fig{int(number[1]):02d}_"))]
    if found:
        return found[0]
    known = ", ".join(numbers) if (numbers := [n for name in names if (n := _number(name))]) else "none"
    raise ParameterError(
        f"no notebook makes Figure {number[1]}: expected one of {known}"
        if number
        else f"unknown notebook {wanted!r}: {declared.nearest(wanted, names)}"
    )


def _number(name: str) -> str:
    found = re.match(r"fig0*(\d+)_", name)
    return found[1] if found else ""


def titles(project: Project) -> str:
    """List the notebooks: number, name, title."""
    lines = []
    for path in project.sources():
        notebook = runner.read(path)
        title = notebook.cells[title_cell(notebook)].source.splitlines()[0].lstrip("# ")
        lines.append([_number(path.stem), path.stem, title])
    return table(["figure", "notebook", "title"], sorted(lines, key=lambda line: (not line[0], line[1])))


def title_cell(notebook: NotebookNode) -> int:
    """Return the index of the cell that begins with the title."""
    cells = enumerate(notebook.cells)
    return next((i for i, cell in cells if cell.cell_type == "markdown" and cell.source.startswith("# ")), 0)


def table(header: list[str], rows: list[list[str]]) -> str:
    """Set rows in columns."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def description(name: str, known: dict[str, Parameter]) -> str:
    """List the parameters of a notebook."""
    rows = [
        [key, one.kind, json.dumps(one.default), one.allowed, one.unit, one.meaning] for key, one in known.items()
    ]
    return f"{name}\n\n{table(['parameter', 'type', 'default', 'allowed', 'unit', 'meaning'], rows)}"


def folder_name(name: str, changed: dict[str, Any]) -> str:
    """Return a name for the results that tells the parameters, and is another one for any others."""
    if not changed:
        return f"{name}-defaults"
    told = "-".join(f"{key}={json.dumps(value)}" for key, value in changed.items())
    told = re.sub(r"[^\w.=,+-]+", "", told.replace(" ", ""), flags=re.ASCII)[:READABLE]
    return f"{name}-{told}-{sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:8]}"


def ours(folder: Path, name: str) -> dict[str, Any]:
    """Return the record of an earlier result; empty if the folder is not there, or is empty.

    Raises
    ------
    ParameterError
        If it holds anything else, which is not to be lost.
    """
    if not folder.exists():
        return {}
    if not folder.is_dir():
        raise ParameterError(f"{folder} is not a folder")
    here = {file.name for file in folder.glob("[!.]*")}
    try:
        record = json.loads((folder / RECORD).read_bytes()) if here else {}
        if here and (record["made_by"], record["notebook"]) != (MAKER, name):
            raise KeyError
        foreign = here - {RECORD, *record.get("files", ())}
    except (OSError, ValueError, KeyError, TypeError):
        raise ParameterError(f"{folder} holds no result of {name}: name another folder") from None
    if foreign:
        raise ParameterError(f"{folder} holds files that rerun did not make, as {min(foreign)}: move them first")
    return record


def is_current(record: dict[str, Any], folder: Path, key: str) -> bool:
    """Say whether a result is there that was made from the same code, parameters and lock, and was not changed."""
    try:
        return record.get("key") == key and record["files"] == digests(folder, record["files"])
    except (OSError, KeyError):
        return False


def digests(folder: Path, names: Any) -> dict[str, str]:
    """Return the sha256 of files by name."""
    return {name: sha256((folder / name).read_bytes()).hexdigest() for name in sorted(names)}


def notice(changed: dict[str, Any], known: dict[str, Parameter]) -> NotebookNode:
    """Return a cell that says what was run with other parameters."""
    rows = [
        f"| `{name}` | {_code(value)} | {_code(known[name].default)} "
        f"| {plain(known[name].unit)} | {plain(known[name].meaning)} |"
        for name, value in changed.items()
    ]
    text = [
        "> **This page was run with other parameters than those of the book.**",
        "> Pictures, tables and numbers are those of this run. The text was written for the defaults:",
        "> what it says of the results may not hold here.",
        "",
        "| parameter | here | default | unit | meaning |",
        "| --- | --- | --- | --- | --- |",
    ]
    return new_markdown_cell("\n".join([*text, *rows]))


def _code(value: Any) -> str:
    """Return a value as code in a table; it can hold neither the sign that ends the code nor that of the cell."""
    return "`" + json.dumps(value).replace("`", r"\u0060").replace("|", r"\u007c") + "`"


def make(project: Project, name: str, changed: dict[str, Any], known: dict[str, Parameter], folder: Path) -> float:
    """Run a notebook, and put all that it makes into a folder in one step.

    Parameters
    ----------
    project : Project
    name : str
        The notebook.
    changed : dict
        Values that are not the defaults; they were checked.
    known : dict of Parameter
        Its parameters.
    folder : Path
        Absent, or an earlier result, which is replaced.

    Returns
    -------
    float
        Seconds that the notebook took.
    """
    within = project.build if folder.is_relative_to(project.build) else folder.parent
    commit, changed_since = runner.commit(project.root)
    with runner.scratch_folder(within, "rerunning-") as scratch:
        if (free := shutil.disk_usage(scratch).free) < ROOM:
            raise ParameterError(f"{within}: {free / 1e6:.0f} MB are free: expected at least {ROOM / 1e6:.0f} MB")
        import standalone  # its imports are slow: only a run needs them

        new = scratch / "new"
        with Progress(project, [name], name) as progress:
            done = runner.execute(project, name, changed, scratch, Children(os.cpu_count()), progress)
        new.mkdir()
        for file in done.files:
            file.rename(new / file.name)
        if changed:
            done.notebook.cells.insert(title_cell(done.notebook) + 1, notice(changed, known))
        notebook = runner.normalise(done.notebook)
        (new / f"{name}.ipynb").write_bytes(runner.to_bytes(notebook))
        pictures = [new / file.name for file in done.files]
        html, warnings = standalone.page(project, name, notebook, pictures, scratch / "page")
        (new / f"{name}.html").write_text(html, "utf-8")
        parameters = {key: one.default for key, one in known.items()} | changed
        record = {
            "made_by": MAKER,
            "made": datetime.now(UTC).isoformat(timespec="seconds"),
            "notebook": name,
            "command": command(name, changed),
            "parameters": parameters,
            "changed": changed,
            "seed": parameters.get("seed"),
            "versions": runner.versions(),
            "commit": commit,
            "changed_since": changed_since,
            "key": done.key,
            "seconds": done.seconds,
            "files": digests(new, [file.name for file in new.iterdir()]),
        }
        (new / RECORD).write_text(json.dumps(record, indent=2) + "\n", "utf-8")
        folder.parent.mkdir(parents=True, exist_ok=True)
        runner.swap(new, folder, scratch / "earlier")
    if warnings:
        print(f"the page has gaps:\n{warnings}", file=sys.stderr)
    return done.seconds


def command(name: str, changed: dict[str, Any]) -> str:
    """Return what makes a result again, from the root of a clone."""
    values = [shlex.quote(f"{key}={json.dumps(value)}") for key, value in changed.items()]
    return " ".join([".venv/bin/python book/rerun.py", name, *(f"-p {value}" for value in values)])


def rerun(project: Project, arguments: list[str]) -> None:
    """Do what a command line asks for.

    Raises
    ------
    ParameterError
        If it asks for something that cannot be; no notebook has been started.
    NotebookError
        If the notebook failed; nothing has been written.
    """
    asked = parse(arguments)
    if asked.figure in (None, "list"):
        if asked.p or asked.f or asked.output or asked.force:
            raise ParameterError("name a figure, as in: rerun 3 -p n_screens=50")
        print(titles(project))
        if asked.list:
            print(*(f"\n{describe(project, path.stem)}" for path in project.sources()), sep="\n")
        return
    name = resolve(project, asked.figure)
    if asked.list:
        print(describe(project, name))
        return
    known = declared.parameters(runner.read(project.notebooks / f"{name}.ipynb"))
    if len(asked.f) > 1:
        raise ParameterError(f"-f {' -f '.join(map(str, asked.f))}: expected one file")
    given = declared.mapping(_text(asked.f[0]), str(asked.f[0])) if asked.f else {}
    changed = declared.accept(given | declared.assignments(asked.p), known)
    folder = asked.output or project.build / "rerun" / folder_name(name, changed)
    folder = Path(os.path.realpath(folder))  # Path.resolve fails in a circle of links
    if not folder.is_relative_to(project.build.resolve()) and not folder.parent.is_dir():
        raise ParameterError(f"--output {asked.output}: {folder.parent} is not a folder")
    record = ours(folder, name)
    if not asked.force and is_current(record, folder, runner.key(project, name, changed)):
        print(f"{name}: unchanged, from {record['made']}")
    else:
        print(f"{name}: {make(project, name, changed, known, folder):.1f} s")
    page = folder / f"{name}.html"
    print(f"open {page.relative_to(Path.cwd()) if page.is_relative_to(Path.cwd()) else page}")


def describe(project: Project, name: str) -> str:
    """List the parameters of a notebook by its name."""
    return description(name, declared.parameters(runner.read(project.notebooks / f"{name}.ipynb")))


def _text(file: Path) -> str:
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise ParameterError(f"-f {file}: expected a regular file")
        with file.open("rb") as stream:
            content = stream.read(declared.LONGEST + 1)
        if len(content) > declared.LONGEST:
            raise ParameterError(f"-f {file}: expected at most {declared.LONGEST} bytes")
        return content.decode()
    except OSError as error:
        raise ParameterError(f"-f {file}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ParameterError(f"-f {file}: expected text in UTF-8") from None


def interruptible() -> None:
    """End by a signal as by Ctrl-C; a signal that whoever started this process ignores stays ignored."""
    runner.end_cleanly_on_signals()
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def main() -> int:
    """Serve the command line."""
    try:
        interruptible()
        rerun(Project(Path(__file__).resolve().parent.parent), sys.argv[1:])
    except ParameterError as refused:
        print(f"rerun: {refused}", file=sys.stderr)
        return 2
    except NotebookError as failure:
        print(failure, file=sys.stderr)
        return 1
    except OSError as error:  # a full disk, a folder that is locked, a name that is too long
        print(f"rerun: {declared.one_line(str(error))}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
