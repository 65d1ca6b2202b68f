"""Run the notebooks that changed, in parallel, and keep their results in one normal form."""

import copy
import fcntl
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import nbformat
from nbformat import NotebookNode
from tqdm import tqdm

from zwfs._files import write_file
from zwfs.companion import results, sweeps

HERE = Path(__file__).parent
EXECUTE = HERE / "execute.py"

# One thread for each kernel keeps numbers and timings the same however many notebooks run beside it.
KERNEL_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
}

# Holds the number of cores that the sweeps of a notebook use, see `zwfs.companion.sweeps`.
CORES = "LOKY_MAX_CPU_COUNT"

LOCK = ".zwfs-lock"  # in a scratch folder; the process that uses the folder holds a lock on it


class NotebookError(Exception):
    """One or more notebooks did not run to their end; the message says which, where and why."""


@dataclass(frozen=True)
class Project:
    """Where things lie.

    Parameters
    ----------
    root : Path
        The folder with notebooks/, zwfs/, book/ and the lock. Results go to its _build/.
    """

    root: Path

    @property
    def notebooks(self) -> Path:
        """The committed notebooks."""
        return self.root / "notebooks"

    @property
    def build(self) -> Path:
        """All that is made from them."""
        return self.root / "_build"

    @property
    def executed(self) -> Path:
        """The executed notebooks, each with its files and the record of what it was made from."""
        return self.build / "notebooks"

    def files(self, name: str) -> list[Path]:
        """The figures and tables that the last run of a notebook left, in order."""
        return sorted((self.executed / f"{name}.files").glob("[!.]*"))

    def sources(self) -> list[Path]:
        """The committed notebooks, in order."""
        return sorted(self.notebooks.glob("*.ipynb"))

    def shared_inputs(self) -> list[Path]:
        """The files that the result of every notebook depends on."""
        files = sorted((self.root / "zwfs").rglob("*.py"))
        files.append(self.root / "environment" / "requirements.lock")
        return [file for file in files if file.exists()]


@dataclass
class Children:
    """The processes that run now, so that an interruption can end them."""

    cores: int = 1  # for the sweeps of each
    running: set[subprocess.Popen] = field(default_factory=set)
    stopped: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def start(self, request: dict[str, Any], log: Path) -> Iterator[subprocess.Popen]:
        """Start a notebook's process, and see that it is gone in the end."""
        with self.lock, log.open("w") as errors:
            if self.stopped:
                raise InterruptedError
            child = subprocess.Popen(
                [sys.executable, str(EXECUTE), json.dumps(request)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=os.environ
                | KERNEL_ENVIRONMENT
                | {results.FOLDER: request["files"], sweeps.PROGRESS: request["progress"]}
                | {CORES: str(max(1, self.cores))},
                # A session of its own: Ctrl-C reaches this process only, which then ends its children.
                start_new_session=True,
            )
            self.running.add(child)
        with child:
            try:
                yield child
            finally:
                child.terminate()
                with self.lock:
                    self.running.remove(child)

    def stop(self) -> None:
        """End all of them, and start no more."""
        with self.lock:
            self.stopped = True
            for child in self.running:
                child.terminate()


def digest(parts: Iterable[bytes]) -> str:
    """Return the sha256 of several byte strings; where one ends counts."""
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def digest_files(files: dict[str, Path]) -> str:
    """Return the sha256 of files and of the names they are known by."""
    return digest(part for name in sorted(files) for part in (name.encode(), files[name].read_bytes()))


def read(path: Path) -> NotebookNode:
    """Read a notebook in its normal form."""
    return normalise(nbformat.read(path, as_version=4))


def cell_sources(notebook: NotebookNode) -> list[list[Any]]:
    """What a person wrote in each cell: kind, text, tags and other metadata; no outputs."""
    return [[cell.cell_type, cell.source, cell.metadata] for cell in notebook.cells]


def key(project: Project, name: str, parameters: dict[str, Any]) -> str:
    """Return a digest of everything that the result of a notebook depends on."""
    files = {str(file.relative_to(project.root)): file for file in project.shared_inputs()}
    files |= {"runner": Path(__file__), "execute": EXECUTE}
    files |= {f"parameter {file}": file for file in _named_files(project.notebooks, parameters)}
    own = [list(sys.version_info[:2]), parameters, cell_sources(read(project.notebooks / f"{name}.ipynb"))]
    return digest([json.dumps(own, sort_keys=True).encode(), digest_files(files).encode()])


def _named_files(folder: Path, value: Any) -> Iterator[Path]:
    """Find the files that parameters name: what is in them counts as much as their names."""
    if isinstance(value, dict | list | tuple):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _named_files(folder, one)
    elif isinstance(value, str):
        with suppress(OSError, ValueError):  # no text that names a file
            if (folder / value).is_file():
                yield folder / value


def normalise(notebook: NotebookNode) -> NotebookNode:
    """Return a notebook without what differs between two runs: times, versions, random names, chunking.

    Parameters
    ----------
    notebook : NotebookNode
        Any notebook of format 4; it is not changed.
    """
    result = copy.deepcopy(notebook)
    result.nbformat, result.nbformat_minor = 4, 5
    result.metadata.pop("papermill", None)
    result.metadata.get("language_info", {}).pop("version", None)
    result.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
    for index, cell in enumerate(result.cells):
        cell["id"] = f"cell-{index + 1:02d}"
        for name in ("papermill", "execution"):
            cell.metadata.pop(name, None)
        if not cell.metadata.get("tags", True):
            del cell.metadata["tags"]  # papermill gives every cell a list
        if cell.cell_type == "code":
            cell.outputs = [_without_date(output) for output in _merge_streams(cell.outputs)]
    return result


def _merge_streams(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Join neighbouring pieces of one stream: where the kernel flushed is chance."""
    merged: list[NotebookNode] = []
    for output in outputs:
        if merged and output.output_type == "stream" and merged[-1].get("name") == output.name:
            merged[-1].text += output.text
        else:
            merged.append(output)
    return merged


def _without_date(output: NotebookNode) -> NotebookNode:
    """Remove the time that matplotlib writes into an SVG."""
    svg = output.get("data", {}).get("image/svg+xml")
    if svg:
        output.data["image/svg+xml"] = re.sub(r"\s*<dc:date>.*?</dc:date>", "", svg)
    return output


def to_bytes(notebook: NotebookNode) -> bytes:
    """Write a notebook as it is stored: sorted keys, one newline at the end."""
    return (nbformat.writes(notebook).rstrip("\n") + "\n").encode()


def end_cleanly_on_signals() -> None:
    """Treat SIGTERM and SIGHUP like Ctrl-C, which ends the notebooks and removes the scratch folders."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, signal.default_int_handler)


@contextmanager
def scratch_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """Create a folder for unfinished results; remove it in the end, and those of killed processes now.

    The system releases a lock when the process that holds it ends, in whatever way. A folder whose lock is free
    therefore belongs to no running process. Folders without a lock file are not touched.

    Parameters
    ----------
    parent : Path
        The folder to create it in; created if it is not there.
    prefix : str
        Start of the names of such folders.
    """
    parent.mkdir(parents=True, exist_ok=True)
    for lock in parent.glob(f"{prefix}*/{LOCK}"):
        with suppress(OSError), lock.open("r") as file:  # another process holds it, or has just removed it
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=parent, prefix=prefix) as name:
        new = Path(name) / f"{LOCK}.new"
        with new.open("w") as file:
            with suppress(OSError):  # a file system without locks: nobody can remove the folder either
                fcntl.flock(file, fcntl.LOCK_EX)
            new.rename(new.with_name(LOCK))  # whoever sees the lock file finds it locked
            yield Path(name)


def swap(new: Path, current: Path, earlier: Path) -> None:
    """Put a new folder in the place of the current one; put that back if it does not work."""
    try:
        if current.exists():
            current.rename(earlier)
        new.rename(current)
    except BaseException:
        if earlier.exists() and not current.exists():
            earlier.rename(current)
        raise


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide what a notebook shows."""
    packages = {"NumPy": "numpy", "SciPy": "scipy", "Matplotlib": "matplotlib", "zwfs": "zwfs"}
    return {"Python": platform.python_version()} | {name: metadata.version(p) for name, p in packages.items()}


def commit(root: Path) -> tuple[str | None, bool | None]:
    """Return the commit of a working tree, and whether it has changes; None where there is no history.

    A file that is in no commit is a change, too: it may be a notebook, or a module that one imports.
    """

    def git(*command: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *command], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # A copy without a history may lie within another repository.
        if Path(git("rev-parse", "--show-toplevel")) == root.resolve():
            return git("rev-parse", "HEAD"), bool(git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        pass
    return None, None


def _digest_result(notebook: bytes, files: list[Path]) -> str:
    """Return a digest of an executed notebook and of the files that it left."""
    return digest([notebook, digest_files({file.name: file for file in files}).encode()])


def _record(project: Project, name: str) -> dict[str, Any]:
    """What is known of the last result of a notebook; empty if there is none that can be trusted."""
    result = project.executed / f"{name}.ipynb"
    try:
        record = json.loads(result.with_suffix(".json").read_bytes())
        return record if record["result"] == _digest_result(result.read_bytes(), project.files(name)) else {}
    except (OSError, ValueError, KeyError):
        return {}


def run(
    project: Project,
    n_processes: int | None = None,
    say: Callable[[str], None] = tqdm.write,
) -> list[str]:
    """Run every notebook whose result is not current, with its defaults.

    Parameters
    ----------
    project : Project
        Where the notebooks and the results are.
    n_processes : int, optional
        Notebooks that run at the same time; by default as many as there are cores.
    say : callable
        Takes a line for each notebook that is finished.

    Returns
    -------
    list of str
        The names of the notebooks that were run.

    Raises
    ------
    NotebookError
        After all others were run. What was there from earlier runs of the failed ones stays.
    """
    names = [path.stem for path in project.sources()]
    records = {name: _record(project, name) for name in names}
    stale = [name for name in names if records[name].get("key") != key(project, name, {})]
    # The longest first, as far as earlier runs tell: the others fill the gaps.
    stale.sort(key=lambda name: -records[name].get("seconds", float("inf")))
    if stale:
        _run_all(project, stale, n_processes, say)
    say(f"notebooks: {len(stale)} run, {len(names) - len(stale)} unchanged")
    return stale


@dataclass
class Progress:
    """A bar that counts the cells of notebooks and tells how far each one is that runs now.

    Parameters
    ----------
    project : Project
    names : list of str
        The notebooks.
    title : str
        What stands before the bar.
    """

    project: Project
    names: list[str]
    title: str
    now: dict[str, list[str]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __enter__(self) -> "Progress":
        cells = sum(len(read(self.project.notebooks / f"{name}.ipynb").cells) for name in self.names)
        self.bar = tqdm(total=cells, unit="cell", desc=self.title, disable=None, leave=False, dynamic_ncols=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def heard(self, name: str, message: dict[str, Any]) -> None:
        """Take a message of a notebook's process."""
        with self.lock:
            if "cell" in message:
                self.now[name] = [f"cell {message['cell']}/{message['of']}"]
                self.bar.update()
            elif "done" in message and name in self.now:
                self.now[name][1:] = [f"{message['name']} {message['done']}/{message['total']}"]
            self._show()

    def over(self, name: str) -> None:
        """Forget a notebook that has ended."""
        with self.lock:
            self.now.pop(name, None)
            self._show()

    def _show(self) -> None:
        several = len(self.names) > 1
        told = [", ".join([name.split("_")[0], *now] if several else now) for name, now in self.now.items()]
        self.bar.set_postfix_str("; ".join(told))


def _run_all(
    project: Project,
    names: list[str],
    n_processes: int | None,
    say: Callable[[str], None],
) -> None:
    """Run notebooks side by side, and store the result of each as soon as it is there."""
    children, failures = Children(os.cpu_count() // min(n_processes or os.cpu_count(), len(names))), []
    with (
        scratch_folder(project.build, "running-") as scratch,
        ThreadPoolExecutor(n_processes or os.cpu_count()) as pool,
        Progress(project, names, f"0/{len(names)} notebooks") as progress,
    ):
        try:
            futures = {pool.submit(_run_one, project, name, scratch, children, progress): name for name in names}
            for done, future in enumerate(as_completed(futures), start=1):
                progress.bar.set_description(f"{done}/{len(names)} notebooks")
                try:
                    say(f"{futures[future]}: {future.result():.1f} s")
                except NotebookError as failure:
                    say(f"{futures[future]}: failed")
                    failures.append(str(failure))
        except BaseException:
            children.stop()
            raise
    if failures:
        raise NotebookError("\n\n".join(failures))


@dataclass(frozen=True)
class Execution:
    """The result of one run.

    Attributes
    ----------
    notebook : NotebookNode
        Executed, in its normal form.
    files : list of Path
        The figures and tables that it left.
    key : str or None
        What it was made from; None if that changed meanwhile.
    seconds : float
    """

    notebook: NotebookNode
    files: list[Path]
    key: str | None
    seconds: float


def execute(
    project: Project,
    name: str,
    parameters: dict[str, Any],
    scratch: Path,
    children: Children,
    progress: Progress,
) -> Execution:
    """Run one notebook in a process of its own.

    Parameters
    ----------
    project : Project
    name : str
        The stem of the notebook's file.
    parameters : dict
        Values that replace defaults in its cell tagged ``parameters``.
    scratch : Path
        A folder for everything that the run writes.
    children : Children
        Takes the process.
    progress : Progress
        Hears its messages.

    Raises
    ------
    NotebookError
        If it did not come to its end.
    """
    begin = time.perf_counter()
    made_from = key(project, name, parameters)
    source, target, log = (scratch / f"{name}{ending}" for ending in (".source.ipynb", ".ipynb", ".log"))
    files = scratch / f"{name}.files"
    files.mkdir()
    source.write_bytes(to_bytes(read(project.notebooks / f"{name}.ipynb")))
    request = {
        "notebook": str(source),
        "files": str(files),
        "target": str(target),
        "folder": str(project.notebooks),
        "progress": str(scratch / f"{name}.progress"),
        "parameters": parameters,
    }
    failure, place = None, None
    try:
        with children.start(request, log) as child:
            for line in child.stdout:
                message = json.loads(line)
                failure = message.get("failure")
                place = message if "cell" in message else place
                progress.heard(name, message)
            status = child.wait()
    finally:
        progress.over(name)
    if status:
        ended = f"its process ended with status {status}\n{log.read_text()[-2000:]}"
        failure = failure or {"where": place, "parameters": parameters, "error": ended}
        raise NotebookError(describe(f"notebooks/{name}.ipynb", failure))
    # Whoever edits while a notebook runs gets a result of unknown origin: it must not count as current.
    unchanged = key(project, name, parameters) == made_from
    return Execution(
        notebook=read(target),
        files=sorted(files.glob("[!.]*")),
        key=made_from if unchanged else None,
        seconds=round(time.perf_counter() - begin, 1),
    )


def _run_one(project: Project, name: str, scratch: Path, children: Children, progress: Progress) -> float:
    """Run one notebook with its defaults, store its result, and return the seconds it took."""
    done = execute(project, name, {}, scratch, children, progress)
    result = to_bytes(done.notebook)
    record = {
        "key": done.key,
        "result": _digest_result(result, done.files),
        "seconds": done.seconds,
        "versions": versions(),
    }
    # Pieces of two runs may lie together for a moment; only the record, which comes last, makes them a result.
    write_file(project.executed / f"{name}.ipynb", result)
    shutil.rmtree(project.executed / f"{name}.files", ignore_errors=True)
    (scratch / f"{name}.files").rename(project.executed / f"{name}.files")
    write_file(project.executed / f"{name}.json", json.dumps(record, indent=1).encode())
    return done.seconds


def describe(notebook: str, failure: dict[str, Any]) -> str:
    """Say in which cell, with which parameters, and how a notebook failed."""
    where = failure["where"]
    lines = [f"{notebook} failed before its first cell"]
    if where:
        lines = [f"{notebook} failed in cell {where['cell']} of {where['of']}"]
        lines += [f"  the cell begins: {where['first_line']}"] if "first_line" in where else []
    values = ", ".join(f"{name} = {value}" for name, value in failure["parameters"].items())
    lines += [f"  parameters in force: {values or '(none)'}", "", failure["error"]]
    return "\n".join(lines)
