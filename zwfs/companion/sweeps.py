"""Sweeps: tasks that do not depend on each other, on one core, on several, or on a cluster.

An experiment hands its tasks to `run`. With joblib they run on all cores, unless a `joblib.parallel_config` around
the sweep says otherwise. Without joblib they run in this process, and so does a single task. Where and in which
order they run does not change a bit of the results: random numbers come from the number of the task, and BLAS
works with one thread. Without threadpoolctl BLAS keeps its threads, and the last digits may differ.

Two environment variables, read when a sweep begins, name

- ``ZWFS_SWEEPS``, a folder that keeps what each finished task gave. A sweep that was stopped, run again, does only
  what is left. Its files are pickles: use no folder that others can write to.
- ``ZWFS_PROGRESS``, a file that gets a line as each task finishes:
  ``{"name": "linearity_curves", "done": 3, "total": 22}``.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
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

STORE = "ZWFS_SWEEPS"
PROGRESS = "ZWFS_PROGRESS"

_PROCESS = uuid4().hex  # a name for this process that no other one has, on any machine
_IN_TASK = ContextVar("_IN_TASK", default=False)


def run(task: Callable[..., Any], inputs: Iterable[Any], *shared: Any, name: str) -> list[Any]:
    """Do a task for every input, and give the results in the order of the inputs.

    A sweep that is begun within a task is done there, as a part of it.

    Parameters
    ----------
    task : callable
        ``task(value, *shared)`` for each `value` of the inputs. It may not depend on anything that changes from
        task to task but on `value`, which therefore holds the seed, or the number that a seed is made of.
    inputs : iterable
        Small ones: a number, a tuple of a few.
    *shared
        What all tasks need, however large: it travels once to each process of a cluster.
    name : str
        Of the sweep, for progress and messages.

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
        That of the first task that fails, with a note that names the sweep, the task and its input. What other
        tasks had finished stays in the folder of ``ZWFS_SWEEPS``.

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
    found = {index: kept for index, value in enumerate(inputs) if (kept := store.load(value)) is not None}
    if found:
        _tell(name, len(found), len(inputs))
    waiting = [(index, value) for index, value in enumerate(inputs) if index not in found]
    for index, *result in _results(waiting, (task, *shared), name):
        store.save(inputs[index], result)
        found[index] = result
        _tell(name, len(found), len(inputs))
    return [found[index][0] for index in range(len(inputs))]


def _results(waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str) -> Iterator[tuple[int, Any]]:
    """Number and result of each task, as they finish."""
    with _one_thread():
        if len(waiting) < 2 or not find_spec("joblib"):
            yield from (_work(shared, index, (value,), name, _PROCESS) for index, value in waiting)
        else:
            yield from _parallel_results(waiting, shared, name)


def _parallel_results(
    waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str
) -> Iterator[tuple[int, Any]]:
    """Number and result of each task, as joblib's workers finish them."""
    # Not at the top: the rest of the package does without these.
    from cloudpickle import dumps
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    backend, n_jobs = get_active_backend()
    client = getattr(backend, "client", None)  # of a Dask cluster
    if client is not None:
        # The result of a task, unlike data that are sent, is made again if the worker that holds it is lost.
        shared = client.submit(pickle.loads, dumps(shared), pure=False)
    # The value in a tuple: joblib would send a large one to a single Dask worker, with which it could be lost.
    calls = [delayed(_work)(shared, index, (value,), name, _PROCESS) for index, value in waiting]
    # All tasks are handed out at once, so that a cluster can grow as they wait, and each comes back by itself.
    pool = Parallel(n_jobs=n_jobs or -1, return_as="generator_unordered", batch_size=1, pre_dispatch="all")
    yield from pool(calls)


def _one_thread() -> AbstractContextManager[Any]:
    """Let BLAS work with one thread, if threadpoolctl is there to say so."""
    if not find_spec("threadpoolctl"):
        return nullcontext()
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)


def _work(shared: Any, index: int, value: tuple[Any], name: str, caller: str) -> tuple[int, Any]:
    """Do one task, in the caller's process or in another one."""
    if caller != _PROCESS:
        _limit_threads()
    if not isinstance(shared, tuple):
        shared = shared.result()  # on a cluster of one core joblib works in the caller's process
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
    """Let BLAS work with one thread in this process, which is a worker, from now on."""
    _one_thread()


def _tell(name: str, done: int, total: int) -> None:
    """Append a line to the file of the progress, if there is one."""
    if path := os.environ.get(PROGRESS):
        with open(path, "a") as file:
            file.write(json.dumps({"name": name, "done": done, "total": total}) + "\n")


class _Store:
    """What the tasks of a sweep gave, a file for each, if ``ZWFS_SWEEPS`` names a folder.

    A file is known by what its result was made from: the value, the task, what the tasks share, and the code.
    """

    def __init__(self, name: str, shared: tuple[Any, ...]) -> None:
        self._folder = None
        if folder := os.environ.get(STORE):
            self._folder = Path(folder) / f"{name}-{_digest(shared)}"
            self._folder.mkdir(parents=True, exist_ok=True)

    def load(self, value: Any) -> list[Any] | None:
        """The result for a value, in a list; None if it is missing or its file damaged."""
        path = self._path(value)
        if path is None or not path.exists():
            return None
        content = path.read_bytes()
        check, content = content[:32], content[32:]
        return pickle.loads(content) if hashlib.sha256(content).digest() == check else None

    def save(self, value: Any, result: list[Any]) -> None:
        """Keep the result for a value."""
        if path := self._path(value):
            content = pickle.dumps(result)
            write_file(path, hashlib.sha256(content).digest() + content)

    def _path(self, value: Any) -> Path | None:
        return self._folder and self._folder / f"{_digest(value)}.pickle"


def _digest(value: Any) -> str:
    """Digest of any value and of the code that it leads to."""
    from cloudpickle import Pickler

    total = hashlib.sha256(f"{sys.version_info[:2]} {np.__version__} {scipy.__version__}".encode())
    files = {str(file) for file in Path(__file__).parents[1].rglob("*.py")}

    class Digest(Pickler):
        def reducer_override(self, part: Any) -> Any:
            if isinstance(part, CodeType):
                # Without the name of the file and the lines, which differ from one kernel to the next.
                return tuple, ([part.co_code, part.co_consts, part.co_names, part.co_varnames, part.co_freevars],)
            # What is pickled by its name stands for a file, which may change.
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
