"""Runs of the notebooks that changed, and the results of these runs."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tqdm import tqdm

from zwfs._files import write_file

from .execute import Run, execute
from .notebook import read, to_bytes
from .project import Project
from .record import digest_result, key, read_record, versions
from .scratch import scratch_folder

FRONT_FIGURE = "at_a_glance"  # shown in the README and on the front page, as book/_static/front.png


def run(project: Project, say: Callable[[str], None] = tqdm.write) -> list[str]:
    """Run every notebook whose result is not current, with its defaults.

    Parameters
    ----------
    project : Project
    say : callable
        Takes a line for each notebook that is finished.

    Returns
    -------
    list of str
        The names of the notebooks that were run.

    Raises
    ------
    NotebookError
        After the end of all others. The earlier results of the failed notebooks stay.
    """
    names = [path.stem for path in project.sources()]
    records = {name: read_record(project, name) for name in names}
    stale = [name for name in names if records[name].get("key") != key(project, name, {})]
    # The longest first, as measured in earlier runs: the others fill the gaps.
    stale.sort(key=lambda name: -records[name].get("seconds", float("inf")))

    def finished(run: Run) -> None:
        if not run.error:
            _store(run)
        say(f"{run.name}: {'failed' if run.error else f'{run.seconds:.1f} s'}")

    if stale:
        with scratch_folder(project.build, "running-") as scratch:
            execute([Run(project, name, scratch) for name in stale], finished)
    say(f"notebooks: {len(stale)} run, {len(names) - len(stale)} unchanged")
    return stale


def _store(run: Run) -> None:
    """Replace the stored result of a notebook."""
    executed, result = run.project.executed, to_bytes(run.notebook)
    record = {
        "key": run.key,
        "result": digest_result(result, run.files),
        "seconds": run.seconds,
        "versions": versions(),
    }
    # Parts of two runs may lie together for a moment; only the record, which comes last, makes them a result.
    write_file(executed / f"{run.name}.ipynb", result)
    shutil.rmtree(executed / run.folder.name, ignore_errors=True)
    run.folder.rename(executed / run.folder.name)
    write_file(executed / f"{run.name}.json", json.dumps(record, indent=1).encode())


def moved_numbers(project: Project) -> dict[str, list[str]]:
    """Return the glued numbers that differ between committed and executed notebooks, by committed file."""
    return {
        committed.relative_to(project.root).as_posix(): differences(_glued(committed), _glued(fresh))
        for committed in project.sources()
        if (fresh := project.executed / committed.name).exists()
    }


def _glued(path: Path) -> dict[str, str]:
    """Return what a notebook glues, as text by name."""
    found = {}
    for cell in read(path).cells:
        for output in cell.get("outputs", ()):
            if name := output.get("metadata", {}).get("scrapbook", {}).get("name"):
                found[name] = next((text for kind, text in output.data.items() if kind.endswith("text/plain")), "")
    return found


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return the values that differ, in words, with the relative change of numbers."""
    lines = []
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name, "none"), after.get(name, "none")
        if old != new:
            change = ""
            with suppress(ValueError, ZeroDivisionError):  # not numbers
                change = f" ({100 * (float(new) / float(old) - 1):+.2g} %)"
            lines.append(f"{name}: {old} -> {new}{change}")
    return lines


def refresh(project: Project) -> list[str]:
    """Replace the committed notebooks and the front figure by the executed ones; return the names that changed."""
    files = {committed: project.executed / committed.name for committed in project.sources()}
    picture = project.executed / f"{FRONT_FIGURE}.files" / f"{FRONT_FIGURE}.png"
    if picture.exists():
        files[project.root / "book" / "_static" / "front.png"] = picture
    changed = []
    for committed, fresh in files.items():
        content = fresh.read_bytes()
        if not committed.exists() or content != committed.read_bytes():
            write_file(committed, content)
            changed.append(committed.relative_to(project.root).as_posix())
    return changed
