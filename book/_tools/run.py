"""Runs of the notebooks that changed, and the results of these runs."""

import json
import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import yaml
from tqdm import tqdm

from zwfs._system import write_file

from .execute import Run, execute
from .notebook import glued_texts, read, title, to_bytes
from .project import Project
from .record import digest_result, key, read_record, versions
from .scratch import scratch_folder, swap

KEPT = 4  # results of each notebook
FRONT_FIGURE, FRONT = "at_a_glance", "book/_static/front.png"  # shown in the README and on the front page
MANIFEST = "codecheck.yml"


def run(project: Project, say: Callable[[str], None] = tqdm.write) -> list[str]:
    """Run every notebook that has no result for its key, with its defaults, and return their names.

    The last results of each notebook are kept, so that undoing a change runs nothing.
    """
    names = [path.stem for path in project.sources()]
    records = {name: read_record(project, name) for name in names}
    keys = {name: key(project, name, {}) for name in names}
    changed = [name for name in names if records[name].get("key") != keys[name]]
    restored = [name for name in changed if _restore(project, name, keys[name])]
    # The longest first, as measured in earlier runs: the others fill the gaps.
    stale = [name for name in changed if name not in restored]
    stale.sort(key=lambda name: -records[name].get("seconds", float("inf")))

    def finished(run: Run) -> None:
        if not run.error:
            _store(run)
        say(f"{run.name}: {'failed' if run.error else f'{run.seconds:.1f} s'}")

    if stale:
        with scratch_folder(project.build, "running-") as scratch:
            execute([Run(project, name, scratch) for name in stale], finished)
    again = f"{len(restored)} from earlier runs, " if restored else ""
    say(f"notebooks: {len(stale)} run, {again}{len(names) - len(changed)} unchanged")
    return stale


def _store(run: Run) -> None:
    """Keep the result of a notebook under its key, and show it."""
    result, name = to_bytes(run.notebook), run.name
    record = {
        "key": run.key,
        "result": digest_result(result, run.files),
        "seconds": run.seconds,
        "versions": versions(),
    }
    new = run.folder.with_name(f"{name}.result")
    new.mkdir()
    run.folder.rename(new / run.folder.name)
    (new / f"{name}.ipynb").write_bytes(result)
    (new / f"{name}.json").write_text(json.dumps(record, indent=1))
    _show(run.project, name, new)
    if run.key:
        kept = run.project.kept / name
        kept.mkdir(parents=True, exist_ok=True)
        swap(new, kept / run.key, new.with_suffix(".earlier"))
        for old in sorted(kept.iterdir(), key=lambda folder: folder.stat().st_mtime)[:-KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _restore(project: Project, name: str, key: str) -> bool:
    """Show the result that was kept under a key, and return whether there is one."""
    folder = project.kept / name / key
    if not read_record(project, name, folder):
        return False
    _show(project, name, folder)
    os.utime(folder)
    return True


def _show(project: Project, name: str, folder: Path) -> None:
    """Copy the result in a folder to the place where the book reads it."""
    # Parts of two results may lie together for a moment; only the record, which comes last, makes them a result.
    shown = project.executed / f"{name}.files"
    write_file(project.executed / f"{name}.ipynb", (folder / f"{name}.ipynb").read_bytes())
    shutil.rmtree(shown, ignore_errors=True)
    shutil.copytree(folder / shown.name, shown)
    write_file(project.executed / f"{name}.json", (folder / f"{name}.json").read_bytes())


def moved_numbers(project: Project) -> dict[str, list[str]]:
    """Return the glued numbers that differ between committed and executed notebooks, by committed file."""
    return {
        committed.relative_to(project.root).as_posix(): differences(*map(glued_texts, (committed, fresh)))
        for committed in project.sources()
        if (fresh := project.executed / committed.name).exists()
    }


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
    """Replace notebooks, front figure and manifest by those of the last run; return the names that changed."""
    new = {source: (project.executed / source.name).read_bytes() for source in project.sources()}
    picture = project.executed / f"{FRONT_FIGURE}.files" / f"{FRONT_FIGURE}.png"
    if picture.exists():
        new[project.root / FRONT] = picture.read_bytes()
    new[project.root / MANIFEST] = manifest(project)
    changed = {file: content for file, content in new.items() if not file.exists() or file.read_bytes() != content}
    for file, content in changed.items():
        write_file(file, content)
    return [file.relative_to(project.root).as_posix() for file in changed]


def manifest(project: Project) -> bytes:
    """Return codecheck.yml with the list of the notebooks and the front figure; the rest of it stays."""
    titles = {source.relative_to(project.root).as_posix(): title(read(source)) for source in project.sources()}
    titles[FRONT] = "Figure of the front page and of the README"
    entries = [{"file": name, "comment": comment} for name, comment in titles.items()]
    listed = yaml.safe_dump({"manifest": entries}, sort_keys=False, allow_unicode=True, width=1000)
    text = (project.root / MANIFEST).read_text("utf-8")
    return re.sub(r"(?m)^manifest:.*\n(?:[- ].*\n)*", lambda _: listed, text).encode()
