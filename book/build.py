"""Run the notebooks and build the book: the commands behind the Makefile."""

import argparse
import sys
from pathlib import Path

import compare
import printing
import runner
from pages import BookError, build_book, check_contents
from printing import PrintError
from runner import NotebookError, Project

from zwfs._files import write_file

FRONT_FIGURE = "fig03_dynamic_range"  # stands in the README, as book/_static/front.png


def book(project: Project) -> int:
    """Run the notebooks that changed and build the book."""
    check_contents(project)
    runner.run(project)
    built = build_book(project)
    html = project.build.relative_to(project.root) / "html"
    print(f"book: {'built' if built else 'unchanged'}\nopen {html / 'index.html'}")
    if not printing.find_chromium():
        print(f"without the PDF: {printing.MISSING}")
    return 0


def pdf(project: Project) -> int:
    """Build the book, and insist on its PDF."""
    if not printing.find_chromium():
        raise PrintError(printing.MISSING)
    check_contents(project)
    runner.run(project)
    build_book(project)
    print(f"open {project.build.relative_to(project.root) / 'html' / printing.NAME}")
    return 0


def run(project: Project) -> int:
    """Run the notebooks that changed."""
    runner.run(project)
    return 0


def figures(project: Project) -> int:
    """Replace the committed notebooks by freshly run ones."""
    runner.run(project)
    for name in refresh(project):
        print(f"{name} is new")
    return 0


def refresh(project: Project) -> list[str]:
    """Copy the executed notebooks, and the front figure, over the committed ones; name those that changed."""
    changed = []
    for committed, fresh in committed_files(project).items():
        content = fresh.read_bytes()
        if not committed.exists() or content != committed.read_bytes():
            write_file(committed, content)
            changed.append(str(committed.relative_to(project.root)))
    return changed


def committed_files(project: Project) -> dict[Path, Path]:
    """Every committed file that a run makes, with the file that the last run made."""
    files = {committed: project.executed / committed.name for committed in project.sources()}
    picture = project.executed / f"{FRONT_FIGURE}.files" / f"{FRONT_FIGURE}.png"
    if picture.exists():
        files[project.root / "book" / "_static" / "front.png"] = picture
    return files


def check(project: Project) -> int:
    """Compare the committed notebooks and the front figure with a fresh run."""
    runner.run(project)
    found = [line for notebook in project.sources() for line in check_notebook(project, notebook.stem)]
    found += check_front(project)
    print("\n".join(found) or "what is committed agrees with the fresh run")
    return 1 if found else 0


def check_front(project: Project) -> list[str]:
    """Say how the committed front figure differs from its fresh run."""
    pictures = {old: new for old, new in committed_files(project).items() if old.suffix == ".png"}
    found = []
    for old, new in pictures.items():
        name = old.relative_to(project.root).as_posix()
        if not old.exists():
            found.append(f"{name} is not there: make figures")
        elif told := compare.picture_difference(old.read_bytes(), new.read_bytes(), compare.Tolerance()):
            found.append(f"{name}: {told}")
    return found


def check_notebook(project: Project, name: str) -> list[str]:
    """List what is wrong with a committed notebook, compared with its fresh run."""
    committed = runner.read(project.notebooks / f"{name}.ipynb")
    found = compare.faults(committed)
    found += compare.differences(committed, runner.read(project.executed / f"{name}.ipynb"))
    return [f"notebooks/{name}.ipynb: {line}" for line in found]


COMMANDS = {command.__name__: command for command in (book, pdf, run, figures, check)}


def main() -> int:
    """Run the command that was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"{name:8} {command.__doc__}" for name, command in COMMANDS.items()),
    )
    parser.add_argument("command", choices=COMMANDS)
    command = COMMANDS[parser.parse_args().command]
    runner.end_cleanly_on_signals()
    try:
        return command(Project(Path(__file__).resolve().parent.parent))
    except (NotebookError, BookError, PrintError) as failure:
        print(failure, file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted: the earlier results are untouched", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
