"""Runs of the notebooks that changed, and the results of these runs."""

import json
import re
import shutil
from collections.abc import Callable

import joblib
import yaml

from zwfs._system import write_file

from .execute import Run, execute, tell
from .notebook import read, title, to_bytes
from .project import Project
from .record import digest_result, key, read_record, versions
from .scratch import scratch_folder

FRONT_FIGURE, FRONT = "at_a_glance", "book/_static/front.png"  # shown in the README and on the front page
MANIFEST = "codecheck.yml"
SECONDS = "book/_tools/seconds.json"  # that each notebook takes, for those that have never run here
UNKNOWN = 30.0  # seconds of a new notebook
SAME = 1.5  # ratio of two measured times that may be chance


def run(project: Project, say: Callable[[str], None] = tell) -> list[str]:
    """Run every notebook that has no result for its key, with its defaults, and return their names."""
    names = [path.stem for path in project.sources()]
    records = {name: read_record(project, name) for name in names}
    stale = [name for name in names if records[name].get("key") != key(project, name)]
    expected = _stored_seconds(project) | {name: last["seconds"] for name, last in records.items() if last}
    needed = {name: expected.get(name, UNKNOWN) for name in stale}
    stale.sort(key=lambda name: -needed[name])  # the longest first: the others fill the gaps

    def finished(run: Run) -> None:
        if not run.error:
            _store(run)
        say(f"{run.name}: {'failed' if run.error else f'{run.seconds:.1f} s'}")

    if stale:
        cores = joblib.cpu_count()
        wait = max(sum(needed.values()) / cores, max(needed.values()) / max(1, cores // len(stale)))
        say(f"running {len(stale)} of {len(names)} notebooks, about {_words(wait)} on {cores} free cores")
        with scratch_folder(project.build, "running-") as scratch:
            execute([Run(project, name, scratch) for name in stale], finished, say)
    say(f"notebooks: {len(stale)} run, {len(names) - len(stale)} unchanged")
    return stale


def _store(run: Run) -> None:
    """Put the result of a notebook where the book reads it."""
    result, shown = to_bytes(run.notebook), run.project.executed / run.folder.name
    record = {
        "key": run.key,
        "result": digest_result(result, run.files),
        "seconds": run.seconds,
        "versions": versions(),
    }
    # Parts of two results may lie together for a moment; only the record, which comes last, makes them a result.
    write_file(run.project.executed / f"{run.name}.ipynb", result)
    shutil.rmtree(shown, ignore_errors=True)
    shutil.copytree(run.folder, shown)
    write_file(run.project.executed / f"{run.name}.json", json.dumps(record, indent=1).encode())


def _words(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _stored_seconds(project: Project) -> dict[str, float]:
    """Return the seconds that notebooks take, as stored in the repository."""
    file = project.root / SECONDS
    return json.loads(file.read_bytes()) if file.exists() else {}


def _seconds(project: Project) -> bytes:
    """Return the seconds for the repository; only large changes replace those that are stored."""
    stored, seconds = _stored_seconds(project), {}
    for name in (source.stem for source in project.sources()):
        old = stored.get(name, 0)
        new = round(read_record(project, name).get("seconds", old))
        seconds[name] = old if new < SAME * old and old < SAME * new else new
    return f"{json.dumps(seconds, indent=1)}\n".encode()


def refresh(project: Project) -> list[str]:
    """Replace notebooks, their times, front figure and manifest by those of the last run; return what changed."""
    new = {source: (project.executed / source.name).read_bytes() for source in project.sources()}
    picture = project.executed / f"{FRONT_FIGURE}.files" / f"{FRONT_FIGURE}.png"
    if picture.exists():
        new[project.root / FRONT] = picture.read_bytes()
    new |= {project.root / MANIFEST: manifest(project), project.root / SECONDS: _seconds(project)}
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
