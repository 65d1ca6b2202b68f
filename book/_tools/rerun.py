"""Run of one notebook with other parameters: its results go to a separate folder."""

import argparse
import json
import re
import shlex
import shutil
import sys
from contextlib import chdir
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell

from studies.kit.results import published
from studies.kit.tables import plain

from . import declared, record
from .declared import Parameter, ParameterError
from .notebook import BOOK, normalise, read, title, title_cell, to_bytes
from .project import Project
from .scratch import scratch_folder, swap

RECORD = "record.json"
MAKER = "zwfs rerun"  # marks the record of a folder with results
COMMAND = ".venv/bin/python -m book._tools rerun"
LINE = "--line="  # before all arguments in one string, as make passes them
READABLE = 60  # characters of a folder's name for the parameters
EXAMPLES = """examples:
  rerun                                     list the notebooks
  rerun 3 --list                            list the parameters of Figure 3
  rerun 3 -p rms_max=2.0 -p n_screens=50    run it
  rerun 3 -p pupil.kind=vlt                 a field of a parameter
  rerun phase_shift_pairs -f mine.yaml      with parameters from a file
"""


class Parser(argparse.ArgumentParser):
    """Parser that raises its errors."""

    def error(self, message: str) -> NoReturn:
        """Raise an error of the command line."""
        raise ParameterError(message)


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    if len(arguments) == 1 and arguments[0].startswith(LINE):
        try:
            arguments = shlex.split(arguments[0].removeprefix(LINE))
        except ValueError as error:  # a quotation without an end
            raise ParameterError(f"{arguments[0]}: {error}") from None
    layout = argparse.RawDescriptionHelpFormatter
    parser = Parser("rerun", description=__doc__, epilog=EXAMPLES, formatter_class=layout)
    add = parser.add_argument
    add("figure", nargs="?", help="number of a figure, or name of a notebook")
    add("-p", metavar="NAME=VALUE", action="append", default=[], help="a parameter, in YAML")
    add("-f", metavar="FILE", type=Path, help="YAML file of parameters; -p overrides")
    add("--list", action="store_true", help="list parameters, and run nothing")
    add("--output", metavar="DIR", type=Path, help="folder for the results")
    return parser.parse_args(arguments)


def rerun(project: Project, arguments: list[str]) -> None:
    """Serve a command line; before a refusal nothing runs, and a notebook that fails leaves nothing."""
    asked = parse(arguments)
    if asked.figure in (None, "list"):
        if asked.p or asked.f or asked.output:
            raise ParameterError("name a figure, as in: rerun 3 -p n_screens=50")
        print(titles(project))
        if asked.list:
            print(*(f"\n{description(project, path.stem)}" for path in project.sources()), sep="\n")
        return
    name = resolve(project, asked.figure)
    if asked.list:
        print(description(project, name))
        return
    notebook = read(project.source(name))
    parameters = declared.parameters(notebook)
    from_file = declared.mapping(_text(asked.f), str(asked.f)) if asked.f else {}
    changed = declared.accept(declared.joined(from_file | declared.assignments(asked.p), parameters), parameters)
    with chdir(project.notebooks):  # as the notebook runs: its files are named from there
        declared.accept_together(
            notebook, {key: parameter.default for key, parameter in parameters.items()} | changed
        )
        _check_classes(changed.get("reconstructors", []))
    folder = (asked.output or project.build / "rerun" / folder_name(name, changed)).resolve()
    check_folder(folder, name, project.build)
    print(f"{name}: {make(project, name, changed, parameters, folder):.1f} s")
    page = folder / f"{name}.html"
    print(f"open {page.relative_to(Path.cwd()) if page.is_relative_to(Path.cwd()) else page}")


def resolve(project: Project, figure: str) -> str:
    """Return the name of the notebook for a number of a figure or a name."""
    names = [path.stem for path in project.sources()]
    wanted = Path(figure).name.removesuffix(".ipynb")
    if wanted in names:
        return wanted
    if number := re.fullmatch(r"(?:fig(?:ure)?)?[ _]?0*(\d+)", wanted, re.IGNORECASE):
        numbers = {digits: path.stem for path in project.sources() for digits in _numbers(path)}
        if number[1] in numbers:
            return numbers[number[1]]
        expected = ", ".join(numbers) or "none"
        raise ParameterError(f"no notebook makes Figure {number[1]}: expected one of {expected}")
    raise ParameterError(f"unknown notebook {wanted!r}: {declared.nearest(wanted, names)}")


def _numbers(source: Path) -> list[str]:
    """Return the numbers of the paper's figures that a notebook makes, from its name and those of its figures."""
    code = (cell.source for cell in read(source).cells if cell.cell_type == "code")
    names = source.stem, *(figure for lines in code for figure in published(lines))
    return sorted({number[1] for name in names if (number := re.match(r"fig0*(\d+)_", name))}, key=int)


def _text(file: Path) -> str:
    """Return the content of a file of parameters."""
    try:
        return file.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"-f {file}: {getattr(error, 'strerror', 'expected text in UTF-8')}") from None


def _check_classes(paths: list[str]) -> None:
    """Refuse classes that the notebook could not use; their modules run here first."""
    if not paths:
        return
    from studies.kit.methods import check_own  # it takes a second

    sys.path.insert(0, str(Path.cwd()))
    try:
        check_own(paths)
    except (TypeError, ValueError) as error:
        raise ParameterError(f"reconstructors = {json.dumps(paths)}: {error}") from None
    finally:
        sys.path.pop(0)


def titles(project: Project) -> str:
    """List the notebooks: number, name, title."""
    rows = [(_numbers(path), path.stem, title(read(path))) for path in project.sources()]
    rows.sort(key=lambda row: (not row[0], int(next(iter(row[0]), 0)), row[1]))
    return table(["figure", "notebook", "title"], [[", ".join(numbers), *named] for numbers, *named in rows])


def description(project: Project, name: str) -> str:
    """List the parameters of a notebook."""
    listed: dict[str, Parameter] = {}
    for key, parameter in declared.parameters(read(project.source(name))).items():
        listed |= {key: parameter} | {f"{key}.{field}": value for field, value in parameter.fields().items()}
    rows = [
        [key, row.kind, "" if row.default is None else json.dumps(row.default), row.allowed, row.unit, row.meaning]
        for key, row in listed.items()
    ]
    return f"{name}\n\n{table(['parameter', 'type', 'default', 'allowed', 'unit', 'meaning'], rows)}"


def table(header: list[str], rows: list[list[str]]) -> str:
    """Set rows in columns."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def folder_name(name: str, changed: dict[str, Any]) -> str:
    """Return a readable name for the results that is different for other parameters."""
    if not changed:
        return f"{name}-defaults"
    values = "-".join(f"{key}={json.dumps(value)}" for key, value in changed.items())
    readable = re.sub(r"[^\w.=,+-]+", "", values.replace(" ", ""), flags=re.ASCII)[:READABLE]
    return f"{name}-{readable}-{sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:8]}"


def check_folder(folder: Path, name: str, build: Path) -> None:
    """Refuse a folder that holds anything but an earlier result of a notebook, or that has no parent."""
    if not folder.is_relative_to(build.resolve()) and not folder.parent.is_dir():
        raise ParameterError(f"--output {folder}: {folder.parent} is not a folder")
    if not folder.exists():
        return
    try:
        files = {file.name for file in folder.iterdir()}
        earlier = json.loads((folder / RECORD).read_bytes()) if files else {}
        foreign = files - {RECORD, *earlier.get("files", ())}
        ours = not files or (earlier["made_by"], earlier["notebook"]) == (MAKER, name)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        ours = False
    if not ours:
        raise ParameterError(f"{folder} holds no result of {name}: name another folder")
    if foreign:
        raise ParameterError(f"{folder} holds other files, such as {min(foreign)}: move them first")


def notice(changed: dict[str, Any], parameters: dict[str, Parameter]) -> NotebookNode:
    """Return a cell that lists the parameters that are not the defaults."""
    rows = [
        f"| `{name}` | {_code(value)} | {_code(parameters[name].default)} "
        f"| {plain(parameters[name].unit)} | {plain(parameters[name].meaning)} |"
        for name, value in changed.items()
    ]
    text = [
        "> **The parameters of this page are not those of the book.**",
        "> Pictures, tables and numbers show this run. Text on the parameters of the book only is left out.",
        "",
        "| parameter | here | default | unit | meaning |",
        "| --- | --- | --- | --- | --- |",
    ]
    return new_markdown_cell("\n".join([*text, *rows]))


def _code(value: Any) -> str:
    """Return a value as code in a table, without the characters that end the code or the cell."""
    return "`" + json.dumps(value).replace("`", r"\u0060").replace("|", r"\u007c") + "`"


def make(
    project: Project, name: str, changed: dict[str, Any], parameters: dict[str, Parameter], folder: Path
) -> float:
    """Run a notebook, move all its results into a folder in one step, and return the seconds.

    The folder is absent or holds an earlier result, which is replaced.
    """
    # Not at the top: these imports take seconds, and only a run needs them.
    from . import page
    from .execute import Run, execute

    commit, changed_since = record.commit(project.root)
    within = project.build if folder.is_relative_to(project.build.resolve()) else folder.parent
    with scratch_folder(within, "rerunning-") as scratch:
        run, new = Run(project, name, scratch, changed), scratch / "new"
        execute([run], lambda _: None)
        notebook = run.notebook
        if changed:
            notebook.cells = [cell for cell in notebook.cells if BOOK not in cell.metadata.get("tags", ())]
            notebook.cells.insert(title_cell(notebook) + 1, notice(changed, parameters))
        notebook = normalise(notebook)
        shutil.copytree(run.folder, new)
        (new / f"{name}.ipynb").write_bytes(to_bytes(notebook))
        html, warnings = page.page(project, name, notebook, run.files, scratch / "page", changed=bool(changed))
        (new / f"{name}.html").write_text(html, "utf-8")
        values = {key: parameter.default for key, parameter in parameters.items()} | changed
        about = {
            "made_by": MAKER,
            "made": datetime.now(UTC).isoformat(timespec="seconds"),
            "notebook": name,
            "command": command(name, changed),
            "parameters": values,
            "changed": changed,
            "seed": values.get("seed"),
            "versions": record.versions(),
            "commit": commit,
            "changed_since": changed_since,
            "seconds": run.seconds,
            "files": {file.name: sha256(file.read_bytes()).hexdigest() for file in sorted(new.iterdir())},
        }
        (new / RECORD).write_text(json.dumps(about, indent=2) + "\n", "utf-8")
        folder.parent.mkdir(parents=True, exist_ok=True)
        swap(new, folder, scratch / "earlier")
    if warnings:
        print(f"the page has gaps:\n{warnings}", file=sys.stderr)
    return run.seconds


def command(name: str, changed: dict[str, Any]) -> str:
    """Return the command that repeats a run, from the root of a clone."""
    values = [shlex.quote(f"{key}={json.dumps(value, ensure_ascii=False)}") for key, value in changed.items()]
    return " ".join([COMMAND, name, *(f"-p {value}" for value in values)])
