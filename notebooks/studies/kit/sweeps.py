"""Sweeps: independent tasks, on one core, on several, or on a cluster.

An experiment passes its tasks to `run`. With joblib the tasks run on all cores; a `joblib.parallel_config` around
the sweep chooses other workers. Without joblib, or with a single task, they run in this process. The results are
the same to the last bit wherever and in whatever order the tasks run: random numbers depend on the number of the
task, and BLAS uses one thread. Without threadpoolctl BLAS keeps its threads, and the last digits may differ.

Three environment variables are read when a sweep begins:

- ``ZWFS_SWEEPS`` names a folder in which `joblib.Memory` keeps the result of each finished task. A sweep that was
  stopped and is run again computes only the missing results. The files are pickles, and reading a pickle can run
  any code: a folder that other users can write to is refused.
- ``ZWFS_PROGRESS`` names a file to which each finished task appends a line:
  ``{"name": "linearity_curves", "done": 3, "total": 22}``.
- ``ZWFS_CLUSTER`` is the address of the scheduler of a Dask cluster, such as ``tcp://host:8786``. The tasks run
  there unless a `joblib.parallel_config` chooses a number of jobs or another cluster.

The scheduler and the workers of a cluster need `zwfs`, and the folder of `studies` on the path of Python.
"""

from __future__ import annotations

import json
import os
import stat
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from pickle import loads
from typing import Any
from warnings import filterwarnings

import numpy as np
import scipy

STORE = "ZWFS_SWEEPS"
PROGRESS = "ZWFS_PROGRESS"
CLUSTER = "ZWFS_CLUSTER"
_IN_TASK = ContextVar("_IN_TASK", default=False)
_INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def run(task: Callable[..., Any], inputs: Iterable[Any], *shared: Any, name: str) -> list[Any]:
    """Run a task for every input, and return the results in the order of the inputs."""
    inputs = list(inputs)
    if _IN_TASK.get():
        return [task(value, *shared) for value in inputs]
    done: dict[int, Any] = {}
    for index, result in _results((task, *shared), inputs, name):
        done[index] = result
        report_progress(name, len(done), len(inputs))
    return [done[index] for index in range(len(inputs))]


def table(task: Callable[..., Any], inputs: Iterable[Any], *shared: Any, name: str) -> dict[str, Any]:
    """Run a task that returns a mapping, as `run` does; its arrays get the inputs as their first axis."""
    return stacked(run(task, inputs, *shared, name=name))


def stacked(results: Sequence[Any]) -> Any:
    """Stack the results of several tasks by name, also within mappings."""
    if isinstance(results[0], Mapping):
        return {name: stacked([result[name] for result in results]) for name in results[0]}
    return np.array(results)


def report_progress(name: str, done: int, total: int) -> None:
    """Append a line to the progress file, if the environment names one."""
    if path := os.environ.get(PROGRESS):
        with open(path, "a") as file:
            file.write(json.dumps({"name": name, "done": done, "total": total}) + "\n")


def _results(call: tuple[Any, ...], inputs: list[Any], name: str) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task: first those that are kept, then each one as it finishes."""
    numbered = list(enumerate(inputs))
    if not find_spec("joblib"):
        yield from (_work(call, task, name) for task in numbered)
        return
    from joblib import Memory  # here, as a sweep in a page has no joblib

    keep = Memory(_folder(), verbose=0).cache(_keep, ignore=["compute"])
    keys = _keys(call, inputs) if os.environ.get(STORE) else [""] * len(inputs)
    waiting = []
    for index, value in numbered:
        if keep.check_call_in_cache(keys[index], None):
            again = partial(_work, call, (index, value), name)  # if the file is damaged
            yield index, keep(keys[index], lambda again=again: again()[1])
        else:
            waiting.append((index, value))
    for index, result in _computed(call, waiting, name):
        yield index, keep(keys[index], lambda result=result: result)


def _keep(key: str, compute: Callable[[], Any]) -> Any:
    """Result of a task, which `joblib.Memory` keeps under a key."""
    return compute()


def _folder() -> Path | None:
    """Return the folder of the results, if the environment names one; refuse one that others can change."""
    if not os.environ.get(STORE):
        return None
    folder = Path(os.environ[STORE])
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.stat()
    if os.name == "posix" and (about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        raise PermissionError(
            f"{STORE}: other users can write to {folder}, and reading its pickles can run any code: "
            "expected a folder of your own that nobody else can write to (chmod go-w)"
        )
    return folder


def _keys(call: tuple[Any, ...], inputs: list[Any]) -> list[str]:
    """Return a key for each task: its arguments, versions, and all loaded code but that of other packages."""
    from cloudpickle import dumps
    from joblib import hash as digest

    loaded = {name: getattr(module, "__file__", None) or "" for name, module in sorted(sys.modules.items())}
    code = {
        name: Path(file).read_bytes()
        for name, file in loaded.items()
        if file.endswith(".py") and (name.split(".")[0] == "zwfs" or not file.startswith(_INSTALLED))
    }
    common = digest((code, sys.version_info[:2], np.__version__, scipy.__version__, dumps(call)))
    return [digest((common, dumps(value))) for value in inputs]


def _computed(call: tuple[Any, ...], waiting: list[tuple[int, Any]], name: str) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as a worker finishes it."""
    if len(waiting) < 2:
        yield from (_work(call, task, name) for task in waiting)
        return
    from cloudpickle import dumps
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    # A worker that grew is replaced, which changes no result; the warning would put a path into a page.
    filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
    with _cluster():
        backend, n_jobs = get_active_backend()
        client = getattr(backend, "client", None)  # of a Dask cluster
        # Dask repeats a task if the worker that holds its result is lost; data that were sent would stay lost.
        shared = client.submit(loads, dumps(call), pure=False) if client else call
        # A cluster gets all tasks at once, so that it can grow while they wait.
        parallel = Parallel(
            n_jobs=n_jobs or -1, return_as="generator_unordered", pre_dispatch="all" if client else "2 * n_jobs"
        )
        yield from parallel(delayed(_work)(shared, task, name) for task in waiting)


@contextmanager
def _cluster() -> Iterator[None]:
    """Use the cluster that the environment names, unless other workers were chosen."""
    from joblib import parallel_config
    from joblib.parallel import get_active_backend

    address, (backend, n_jobs) = os.environ.get(CLUSTER), get_active_backend()
    if not address or n_jobs is not None or getattr(backend, "client", None) is not None:
        yield
        return
    from distributed import Client

    with Client(address, set_as_default=False) as client, parallel_config(backend="dask", client=client):
        yield


def _work(call: Any, numbered: tuple[int, Any], name: str) -> tuple[int, Any]:
    """Run one task, in this process or in a worker, and return its number and result."""
    if not isinstance(call, tuple):
        call = call.result()  # on a cluster of one core joblib runs tasks in the caller's process
    (task, *shared), (index, value) = call, numbered
    within = _IN_TASK.set(True)
    try:
        with _one_thread():
            return index, task(value, *shared)
    except Exception as error:
        error.add_note(f"in task {index} of the sweep {name}, with the input {value!r:.200}")
        raise
    finally:
        _IN_TASK.reset(within)


def _one_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread if threadpoolctl is installed."""
    if not find_spec("threadpoolctl"):
        return nullcontext()
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)
