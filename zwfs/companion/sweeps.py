"""Sweeps: independent tasks, on one core, on several, or on a cluster.

An experiment passes its tasks to `run`. With joblib the tasks run on all cores; a `joblib.parallel_config` around
the sweep chooses other workers. Without joblib, or with a single task, they run in this process. The results are
the same to the last bit wherever and in whatever order the tasks run: random numbers depend on the number of the
task, and BLAS uses one thread. Without threadpoolctl BLAS keeps its threads, and the last digits may differ.

Two environment variables are read when a sweep begins:

- ``ZWFS_SWEEPS`` names a folder that keeps the result of each finished task. A sweep that was stopped and is run
  again computes only the missing results. The files are pickles: use a folder that only you can write to.
- ``ZWFS_PROGRESS`` names a file to which each finished task appends a line:
  ``{"name": "linearity_curves", "done": 3, "total": 22}``.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
import scipy

from zwfs import _check
from zwfs._files import write_file
from zwfs._threads import one_thread

STORE = "ZWFS_SWEEPS"
PROGRESS = "ZWFS_PROGRESS"

_PROCESS = uuid4().hex  # identifies this process among those of all machines
_IN_TASK = ContextVar("_IN_TASK", default=False)


def run(task: Callable[..., Any], inputs: Iterable[Any], *shared: Any, name: str) -> list[Any]:
    """Run a task for every input, and return the results in the order of the inputs.

    A sweep that begins within a task runs in the process of that task.

    Parameters
    ----------
    task : callable
        Called as ``task(value, *shared)`` for each `value` of the inputs. Its result may depend on these arguments
        only, so `value` holds the seed of the task, or the number from which the seed is derived.
    inputs : iterable
        Small values, such as a number or a short tuple.
    *shared
        Data that all tasks need, of any size; each process of a cluster receives them once.
    name : str
        Name of the sweep in progress reports and messages.

    Returns
    -------
    list

    Raises
    ------
    TypeError, ValueError
        If the task is not a function, the inputs are not iterable, or the name is not an identifier.
    ImportError
        If joblib or a folder for the results needs cloudpickle or threadpoolctl, and one of them is missing.
    Exception
        The exception of the first task that fails, with a note that names the sweep, the task and its input. The
        results of finished tasks stay in the folder of ``ZWFS_SWEEPS``.

    Examples
    --------
    >>> from zwfs.companion import sweeps
    >>> sweeps.run(pow, range(5), 2, name="squares")
    [0, 1, 4, 9, 16]
    """
    _check.function("task", task)
    try:
        inputs = iter(inputs)
    except TypeError:
        raise TypeError(f"inputs is a {type(inputs).__name__}: expected a list of values") from None
    _check.instance("name", name, str)
    if not name.isidentifier():
        raise ValueError(f"name = {_check.shown(name)}: expected an identifier, such as 'linearity_curves'")
    inputs = list(inputs)
    if _IN_TASK.get():
        return [task(value, *shared) for value in inputs]
    needed = ("cloudpickle", "threadpoolctl") if find_spec("joblib") or os.environ.get(STORE) else ()
    if missing := [package for package in needed if not find_spec(package)]:
        raise ImportError(f"sweeps need {', '.join(missing)}: pip install zwfs[sweeps]")
    store = _Store(name, (task, *shared))
    finished = {index: kept for index, value in enumerate(inputs) if (kept := store.load(value)) is not None}
    if finished:
        _report_progress(name, len(finished), len(inputs))
    waiting = [(index, value) for index, value in enumerate(inputs) if index not in finished]
    for index, *result in _results(waiting, (task, *shared), name):
        store.save(inputs[index], result)
        finished[index] = result
        _report_progress(name, len(finished), len(inputs))
    return [finished[index][0] for index in range(len(inputs))]


def _results(waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as it finishes."""
    with one_thread():
        if len(waiting) < 2 or not find_spec("joblib"):
            yield from (_work(shared, index, (value,), name, _PROCESS) for index, value in waiting)
        else:
            yield from _parallel_results(waiting, shared, name)


def _parallel_results(
    waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str
) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as a worker of joblib finishes it."""
    # Imported here because the rest of the package does not need them.
    from cloudpickle import dumps
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    backend, n_jobs = get_active_backend()
    client = getattr(backend, "client", None)  # of a Dask cluster
    if client is not None:
        # Dask repeats a task if the worker that holds its result is lost; data that were sent would stay lost.
        shared = client.submit(pickle.loads, dumps(shared), pure=False)
    # The tuple keeps joblib from sending a large value to a single Dask worker, with which it could be lost.
    calls = [delayed(_work)(shared, index, (value,), name, _PROCESS) for index, value in waiting]
    # All tasks are submitted at once, so that a cluster can grow while they wait; each result returns by itself.
    pool = Parallel(n_jobs=n_jobs or -1, return_as="generator_unordered", batch_size=1, pre_dispatch="all")
    yield from pool(calls)


def _work(shared: Any, index: int, value: tuple[Any], name: str, caller: str) -> tuple[int, Any]:
    """Run one task, in the caller's process or in a worker."""
    if caller != _PROCESS:
        _limit_threads()
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
def _limit_threads() -> None:
    """Limit BLAS to one thread in this worker process from now on."""
    one_thread()


def _report_progress(name: str, done: int, total: int) -> None:
    """Append a line to the progress file, if the environment names one."""
    if path := os.environ.get(PROGRESS):
        with open(path, "a") as file:
            file.write(json.dumps({"name": name, "done": done, "total": total}) + "\n")


class _Store:
    """Results of the tasks of a sweep, one file for each, if ``ZWFS_SWEEPS`` names a folder.

    The name of a file is a digest of everything that its result depends on: the value, the task, the shared data,
    and the code.
    """

    def __init__(self, name: str, shared: tuple[Any, ...]) -> None:
        self._folder = None
        if folder := os.environ.get(STORE):
            self._folder = Path(folder) / f"{name}-{_digest(shared)}"
            self._folder.mkdir(parents=True, exist_ok=True)

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
            write_file(path, hashlib.sha256(content).digest() + content)

    def _path(self, value: Any) -> Path | None:
        return self._folder and self._folder / f"{_digest(value)}.pickle"


def _digest(value: Any) -> str:
    """Return a digest of any value, of the code of `zwfs`, and of the modules that the value comes from."""
    from cloudpickle import Pickler

    total = hashlib.sha256(f"{sys.version_info[:2]} {np.__version__} {scipy.__version__}".encode())
    files = {str(file) for file in Path(__file__).parents[1].rglob("*.py")}

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
