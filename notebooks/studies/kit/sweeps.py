"""Sweeps: independent tasks, on one core, on several, or on a cluster.

An experiment passes its tasks to `run`. With joblib the tasks run on all cores; a `joblib.parallel_config` around
the sweep chooses other workers. Without joblib, or with a single task, they run in this process. The results are
the same to the last bit wherever and in whatever order the tasks run: random numbers depend on the number of the
task, and BLAS uses one thread. Without threadpoolctl BLAS keeps its threads, and the last digits may differ.

Three environment variables are read when a sweep begins:

- ``ZWFS_SWEEPS`` names a folder that keeps the result of each finished task. A sweep that was stopped and is run
  again computes only the missing results. The files are pickles, and reading a pickle can run any code: a folder
  that other users can write to is refused.
- ``ZWFS_PROGRESS`` names a file to which each finished task appends a line:
  ``{"name": "linearity_curves", "done": 3, "total": 22}``.
- ``ZWFS_CLUSTER`` is the address of the scheduler of a Dask cluster, such as ``tcp://host:8786``. The tasks run
  there unless a `joblib.parallel_config` chooses a number of jobs or another cluster.

The workers of a cluster need `zwfs`. A sweep sends them the files of `studies`.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import cache
from importlib import import_module, invalidate_caches
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from time import sleep
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any
from uuid import uuid4
from warnings import filterwarnings

import numpy as np
import scipy

import studies
import zwfs

STORE = "ZWFS_SWEEPS"
PROGRESS = "ZWFS_PROGRESS"
CLUSTER = "ZWFS_CLUSTER"
_PROCESS = os.getpid(), uuid4().hex  # identifies this process among those of all machines
_PERIOD = 0.5  # second between two looks of a worker at its parent
_SENT = "__sent__"  # attribute of `studies`: digest of the files that were sent to a cluster
_IN_TASK = ContextVar("_IN_TASK", default=False)


def run(task: Callable[..., Any], inputs: Iterable[Any], *shared: Any, name: str) -> list[Any]:
    """Run a task for every input, and return the results in the order of the inputs."""
    inputs = list(inputs)
    if _IN_TASK.get():
        return [task(value, *shared) for value in inputs]
    needed = ("cloudpickle", "threadpoolctl") if find_spec("joblib") or os.environ.get(STORE) else ()
    if missing := [package for package in needed if not find_spec(package)]:
        raise ImportError(f"sweeps need {', '.join(missing)}: pip install {' '.join(missing)}")
    store = _Store(name, (task, *shared))
    finished = {index: kept for index, value in enumerate(inputs) if (kept := store.load(value)) is not None}
    if finished:
        report_progress(name, len(finished), len(inputs))
    waiting = [(index, value) for index, value in enumerate(inputs) if index not in finished]
    for index, *result in _results(waiting, (task, *shared), name):
        store.save(inputs[index], result)
        finished[index] = result
        report_progress(name, len(finished), len(inputs))
    return [finished[index][0] for index in range(len(inputs))]


def _results(waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as it finishes."""
    with _one_thread():
        if len(waiting) < 2 or not find_spec("joblib"):
            yield from (_work(shared, index, (value,), name, _PROCESS) for index, value in waiting)
        else:
            with _cluster():
                yield from _parallel_results(waiting, shared, name)


def _one_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread if threadpoolctl is installed."""
    if not find_spec("threadpoolctl"):
        return nullcontext()
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)


@contextmanager
def _cluster() -> Iterator[None]:
    """Use the cluster that the environment names, unless other workers were chosen."""
    from joblib import parallel_config
    from joblib.parallel import get_active_backend

    address, (backend, n_jobs) = os.environ.get(CLUSTER), get_active_backend()
    if not address or n_jobs is not None or getattr(backend, "client", None) is not None:
        yield
        return
    if not find_spec("distributed"):
        raise ImportError(f"{CLUSTER} needs distributed: pip install distributed")
    from distributed import Client

    with Client(address, set_as_default=False) as client, parallel_config(backend="dask", client=client):
        yield


def _parallel_results(
    waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str
) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as a worker of joblib finishes it."""
    # Imported here because a sweep on one core does not need them.
    from cloudpickle import dumps
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    backend, n_jobs = get_active_backend()
    client = getattr(backend, "client", None)  # of a Dask cluster
    # The tuple keeps joblib from sending a large value to a single Dask worker, with which it could be lost.
    arguments = [(index, (value,), name, _PROCESS) for index, value in waiting]
    if client is None:
        calls = [delayed(_work)(shared, *one) for one in arguments]
    else:
        sent = _send_studies(client)
        # Dask repeats a task if the worker that holds its result is lost; data that were sent would stay lost.
        shared = client.submit(pickle.loads, dumps(shared), pure=False)
        calls = [delayed(_work_of(sent))(shared, dumps(one)) for one in arguments]
    # A cluster receives all tasks at once, so that it can grow while they wait. Here joblib joins tasks of a few
    # milliseconds to batches of 0.2 s or more.
    sizes = {"batch_size": "auto"} if client is None else {"batch_size": 1, "pre_dispatch": "all"}
    # A worker that grew is replaced, which changes no result; the warning would put a path into a page.
    filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
    yield from Parallel(n_jobs=n_jobs or -1, return_as="generator_unordered", **sizes)(calls)


def _send_studies(client: Any) -> str:
    """Let all workers of a cluster, also later ones, import the `studies` of this process; return their digest."""
    from distributed import WorkerPlugin

    root = Path(studies.__file__).parent
    files = {f"studies/{file.relative_to(root).as_posix()}": file.read_bytes() for file in root.rglob("*.py")}
    digest = hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()
    studies.__dict__[_SENT] = digest
    noted = _SENT

    class Studies(WorkerPlugin):  # defined here it travels by value
        def setup(self, worker: Any) -> None:
            if getattr(sys.modules.get("studies"), noted, "") == digest:
                return
            folder = Path(worker.local_directory, digest)
            for name, content in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
            for name in [name for name in sys.modules if name.partition(".")[0] == "studies"]:
                del sys.modules[name]  # of an earlier sweep
            sys.path.insert(0, str(folder))
            invalidate_caches()
            import_module("studies").__dict__[noted] = digest

    client.register_plugin(Studies(), name="studies")
    return digest


def _work_of(sent: str) -> Callable[[Any, bytes], tuple[int, Any]]:
    """Return `_work` as a function that travels by value: the scheduler reads it, too, and has no `studies`."""
    package, attribute = studies.__name__, _SENT

    def work(shared: Any, arguments: bytes) -> tuple[int, Any]:
        import importlib
        import pickle

        if getattr(importlib.import_module(package), attribute, "") != sent:
            raise RuntimeError("a later sweep has sent other studies to this cluster: run one after the other")
        return importlib.import_module(f"{package}.kit.sweeps")._work(shared, *pickle.loads(arguments))

    return work


def _work(shared: Any, index: int, value: tuple[Any], name: str, caller: tuple[int, str]) -> tuple[int, Any]:
    """Run one task, in the caller's process or in a worker."""
    if caller != _PROCESS:
        _begin_worker(caller[0])
    if not isinstance(shared, tuple):
        shared = shared.result()  # on a cluster of one core joblib runs tasks in the caller's process
    task, *rest = shared
    within = _IN_TASK.set(True)
    try:
        return index, task(*value, *rest)
    except Exception as error:
        error.add_note(f"in task {index} of the sweep {name}, with the input {value[0]!r:.200}")
        raise
    finally:
        _IN_TASK.reset(within)


@cache
def _begin_worker(caller: int) -> None:
    """Limit BLAS to one thread in this worker process from now on, and end it with the caller, its parent."""
    _one_thread()
    if os.getppid() == caller:  # not so for a worker of a cluster, which has other work to do
        Thread(target=_end_with, args=(caller,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process as soon as its parent has ended, in whatever way: nobody waits for its results."""
    while os.getppid() == parent:
        sleep(_PERIOD)
    os._exit(1)


def report_progress(name: str, done: int, total: int) -> None:
    """Append a line to the progress file, if the environment names one."""
    if path := os.environ.get(PROGRESS):
        with open(path, "a") as file:
            file.write(json.dumps({"name": name, "done": done, "total": total}) + "\n")


class _Store:
    """Results of the tasks of a sweep, one file for each, if ``ZWFS_SWEEPS`` names a folder."""

    def __init__(self, name: str, shared: tuple[Any, ...]) -> None:
        self._folder = None
        if folder := os.environ.get(STORE):
            self._folder = Path(folder) / f"{name}-{_digest(shared)}"
            _make_private(Path(folder))
            _make_private(self._folder)

    def load(self, value: Any) -> list[Any] | None:
        """Return the result for a value, in a list; None if its file is missing or damaged."""
        path = self._path(value)
        if path is None or not path.exists():
            return None
        content = path.read_bytes()
        check, content = content[:32], content[32:]
        return pickle.loads(content) if hashlib.sha256(content).digest() == check else None

    def save(self, value: Any, result: list[Any]) -> None:
        """Store the result for a value."""
        if path := self._path(value):
            content = pickle.dumps(result)
            partial = path.with_name(f".{path.name}.{uuid4().hex}")
            try:
                partial.write_bytes(hashlib.sha256(content).digest() + content)
                partial.replace(path)  # whoever looks sees a whole file
            finally:
                partial.unlink(missing_ok=True)

    def _path(self, value: Any) -> Path | None:
        return self._folder and self._folder / f"{_digest(value)}.pickle"


def _make_private(folder: Path) -> None:
    """Make a folder for pickles unless it exists; refuse one in which another user could put or change files."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.stat()
    if os.name == "posix" and (about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        raise PermissionError(
            f"{STORE}: other users can write to {folder}, and reading its pickles can run any code: "
            "expected a folder of your own that nobody else can write to (chmod go-w)"
        )


def _digest(value: Any) -> str:
    """Return a digest of any value, of the code of `zwfs` and `studies`, and of the modules of the value."""
    from cloudpickle import Pickler

    total = hashlib.sha256(f"{sys.version_info[:2]} {np.__version__} {scipy.__version__}".encode())
    folders = Path(zwfs.__file__).parent, Path(__file__).parents[1]
    files = {str(file) for folder in folders for file in folder.rglob("*.py")}

    class Digest(Pickler):
        def reducer_override(self, part: Any) -> Any:
            if isinstance(part, CodeType):
                # File name and line numbers are left out: they differ from one kernel to the next.
                return tuple, ([part.co_code, part.co_consts, part.co_names, part.co_varnames, part.co_freevars],)
            # An object that is pickled by name depends on its module, whose file may change.
            module = (
                part if isinstance(part, ModuleType) else sys.modules.get(getattr(part, "__module__", None) or "")
            )
            if file := getattr(module, "__file__", None):
                files.add(file)
            return super().reducer_override(part)

    Digest(SimpleNamespace(write=total.update)).dump(value)
    for file in sorted(files):
        total.update(hashlib.sha256(Path(file).read_bytes()).digest())
    return total.hexdigest()[:32]
