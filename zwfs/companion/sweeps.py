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

`grid` is a sweep over all combinations of several inputs, with a labelled result.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import pickle
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from threading import Thread
from time import sleep
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
import scipy
from numpy.typing import NDArray

from zwfs import _check
from zwfs._files import path_of, write_file
from zwfs._threads import one_thread

STORE = "ZWFS_SWEEPS"
PROGRESS = "ZWFS_PROGRESS"
CLUSTER = "ZWFS_CLUSTER"

_PROCESS = os.getpid(), uuid4().hex  # identifies this process among those of all machines
_PERIOD = 0.5  # second between two looks of a worker at its parent
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
    PermissionError
        If other users can write to the folder of ``ZWFS_SWEEPS``.
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
        raise ImportError(f"sweeps need {', '.join(missing)}: pip install {' '.join(missing)}")
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


@dataclass(frozen=True)
class Grid:
    """Labelled result of `grid`.

    Attributes
    ----------
    axes : dict of tuple
        Values of each axis; the last axis, "screen", numbers the screens.
    values : dict of ndarray, shape of the axes
        Results by name.
    """

    axes: Mapping[str, tuple[Any, ...]]
    values: Mapping[str, NDArray]

    def select(self, **fixed: Any) -> Grid:
        """Return the slice at given values of some axes.

        Raises
        ------
        ValueError
            If the grid has no axis of that name, or the axis has no such value.
        """
        axes, index = dict(self.axes), []
        for name in fixed:
            _check.choice("axis", name, list(axes))
        for name, known in self.axes.items():
            if name in fixed and fixed[name] not in known:
                raise ValueError(f"{name} = {fixed[name]!r}: expected one of {_check.shown(list(known))}")
            if name in fixed:
                del axes[name]
            index.append(known.index(fixed[name]) if name in fixed else slice(None))
        return Grid(axes, {name: values[tuple(index)] for name, values in self.values.items()})

    def columns(self) -> dict[str, NDArray]:
        """Return the long table: a column for each axis and each result, a row for each screen of each point."""
        mesh = np.meshgrid(*map(np.asarray, self.axes.values()), indexing="ij")
        columns = {name: one.ravel() for name, one in zip(self.axes, mesh, strict=True)}
        return columns | {name: one.ravel() for name, one in self.values.items()}

    def write(self, path: str | Path) -> None:
        """Write the long table to a file: CSV, or Parquet if the name ends in ``.parquet``.

        Raises
        ------
        ImportError
            If Parquet needs pyarrow: ``pip install pyarrow``.
        """
        path, columns = path_of("path", path), self.columns()
        if path.suffix == ".parquet":
            if not find_spec("pyarrow"):
                raise ImportError("Parquet needs pyarrow: pip install pyarrow")
            import pyarrow
            from pyarrow import parquet

            parquet.write_table(pyarrow.table(columns), path)
            return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(one.tolist() for one in columns.values()), strict=True))
        write_file(path, text.getvalue().encode())

    def to_xarray(self) -> Any:
        """Return an `xarray.Dataset` with the axes as coordinates: ``pip install xarray``."""
        if not find_spec("xarray"):
            raise ImportError("to_xarray needs xarray: pip install xarray")
        from xarray import Dataset

        names = tuple(self.axes)
        return Dataset(
            {name: (names, one) for name, one in self.values.items()},
            {axis: list(known) for axis, known in self.axes.items()},
        )


def grid(
    task: Callable[..., Mapping[str, Any]],
    *,
    n_screens: int,
    seed: int = 0,
    block: int = 20,
    name: str = "grid",
    **axes: Iterable[Any],
) -> Grid:
    """Run a task at every combination of some inputs, for a number of random screens.

    Every combination uses the same random numbers: two results differ because of the inputs. The result of a
    combination does not depend on the other ones, so that a larger grid computes only what is new, see
    ``ZWFS_SWEEPS``.

    Parameters
    ----------
    task : callable
        Called with a value of each axis, `n_screens` and a SeedSequence, `seed`, by name. It returns arrays of
        shape (n_screens,) by name; `zwfs.paper.grids.Recovery` is one.
    n_screens : int
        Screens at each combination.
    seed : int
    block : int
        Largest number of screens in a task of the sweep. Smaller blocks occupy more workers.
    name : str
        Name of the sweep.
    **axes
        Values of each axis, at least one.

    Returns
    -------
    Grid

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind or out of range, or the task returns other shapes.

    Examples
    --------
    >>> from zwfs.companion import sweeps
    >>> def task(x, y, n_screens, seed):
    ...     return {"sum": [x + y] * n_screens}
    ...
    >>> result = sweeps.grid(task, x=[1, 2], y=[10, 20, 30], n_screens=2)
    >>> result.values["sum"].shape, result.select(y=20, screen=0).values["sum"]
    ((2, 3, 2), array([21, 22]))
    """
    _check.function("task", task)
    n_screens, block = _check.integer("n_screens", n_screens, 1), _check.integer("block", block, 1)
    seed = _check.integer_seed("seed", seed)
    listed = {axis: tuple(_check.items(axis, values, "a list of values")) for axis, values in axes.items()}
    if not listed or not all(listed.values()):
        raise ValueError(f"axes = {_check.shown(listed)}: expected at least one axis, and a value on each")
    plain = {
        axis: tuple(v.item() if isinstance(v, np.generic) else v for v in one) for axis, one in listed.items()
    }
    points = [tuple(zip(plain, point, strict=True)) for point in product(*plain.values())]
    blocks = [(start, min(block, n_screens - start)) for start in range(0, n_screens, block)]
    parts = run(_grid_block, product(points, blocks), task, seed, name=name)
    shape = *map(len, plain.values()), n_screens
    values = {key: np.concatenate([part[key] for part in parts]).reshape(shape) for key in parts[0]}
    return Grid(plain | {"screen": tuple(range(n_screens))}, values)


def _grid_block(
    value: tuple[tuple[tuple[str, Any], ...], tuple[int, int]], task: Callable[..., Mapping[str, Any]], seed: int
) -> dict[str, NDArray]:
    """Results of one block of screens at one point of a grid."""
    point, (start, n) = value
    drawn = task(**dict(point), n_screens=n, seed=np.random.SeedSequence(seed, spawn_key=(start,)))
    arrays = {name: np.asarray(one) for name, one in drawn.items()}
    for name, one in arrays.items():
        if one.shape != (n,):
            raise ValueError(f"the task returns {name} of shape {one.shape}: expected ({n},)")
    return arrays


def _results(waiting: list[tuple[int, Any]], shared: tuple[Any, ...], name: str) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each task as it finishes."""
    with one_thread():
        if len(waiting) < 2 or not find_spec("joblib"):
            yield from (_work(shared, index, (value,), name, _PROCESS) for index, value in waiting)
        else:
            with _cluster():
                yield from _parallel_results(waiting, shared, name)


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
    # A cluster receives all tasks at once, so that it can grow while they wait. Here joblib joins tasks of a few
    # milliseconds to batches of 0.2 s or more.
    sizes = {"batch_size": "auto"} if client is None else {"batch_size": 1, "pre_dispatch": "all"}
    yield from Parallel(n_jobs=n_jobs or -1, return_as="generator_unordered", **sizes)(calls)


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
    one_thread()
    if os.getppid() == caller:  # not so for a worker of a cluster, which has other work to do
        Thread(target=_end_with, args=(caller,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process as soon as its parent has ended, in whatever way: nobody waits for its results."""
    while os.getppid() == parent:
        sleep(_PERIOD)
    os._exit(1)


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
            write_file(path, hashlib.sha256(content).digest() + content)

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
