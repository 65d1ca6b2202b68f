"""Execution of notebooks with papermill: in parallel, with progress, stopped cleanly by an interruption."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import joblib
import papermill
from nbformat import NotebookNode
from papermill.clientwrap import PapermillNotebookClient
from papermill.engines import NBClientEngine, papermill_engines
from papermill.exceptions import PapermillExecutionError, strip_color
from tqdm import tqdm

from studies.kit import results, sweeps

from . import declared
from .environment import clean
from .notebook import read, to_bytes
from .project import Project, ToolError
from .record import key

CORES = "LOKY_MAX_CPU_COUNT"  # the number of cores for the sweeps of a notebook, see `studies.kit.sweeps`

PERIOD = 0.2  # of the progress bar, second
PICTURES = ("image/png", "image/svg+xml")  # a cell shows a figure as one of them
SILENCE = 30.0  # longest without a line of output where there is no progress bar, second
TRACEBACK_LINES = 12
LOG_CHARACTERS = 2000


class NotebookError(ToolError):
    """Failure of notebooks; the message says in which cell, with which parameters and why."""


class Run:
    """One execution of a notebook, which writes to the folder `scratch`."""

    error: NotebookError | None = None
    key: str | None = None  # see `record.key`; None if the inputs changed during the run
    seconds = 0.0
    cell = 0  # the cell that runs, from 1; 0 before the first one
    _client: Any = None
    _stopped = False

    def __init__(
        self, project: Project, name: str, scratch: Path, parameters: dict[str, Any] | None = None
    ) -> None:
        self.project, self.name, self.parameters = project, name, parameters or {}
        self.folder = scratch / f"{name}.files"
        self._target, self._log, self._progress = (
            scratch / f"{name}{end}" for end in (".ipynb", ".log", ".progress")
        )
        self._source = read(project.source(name))
        self.cells = self._source.cells

    @property
    def notebook(self) -> NotebookNode:
        """The executed notebook, in its normal form."""
        return read(self._target)

    @property
    def files(self) -> list[Path]:
        """The figures and tables that it published."""
        return sorted(self.folder.glob("[!.]*"))

    def execute(self, cores: int) -> None:
        """Run the notebook to its end, or set `error`."""
        begin = time.perf_counter()
        try:
            made_from = key(self.project, self.name)
            self.folder.mkdir()
            source = self._target.with_suffix(".source.ipynb")
            source.write_bytes(to_bytes(self._source))
            try:
                self._papermill(source, cores)
            except RuntimeError:
                # Another program may take the port of a kernel that starts: the kernel never answers.
                if self.cell or self._stopped:
                    raise
                self._papermill(source, cores)
            if not _complete(self.notebook):
                raise RuntimeError("the cell ended Python: expected all cells to run")
            self._check_pictures()
            # The result of a notebook that is edited during the run is not current.
            self.key = made_from if key(self.project, self.name) == made_from else None
        except Exception as error:
            self.error = NotebookError(self._describe(error))
        self.cell = len(self.cells)
        self.seconds = round(time.perf_counter() - begin, 1)

    def _papermill(self, source: Path, cores: int) -> None:
        own = {results.FOLDER: str(self.folder), sweeps.PROGRESS: str(self._progress), CORES: str(cores)}
        papermill.execute_notebook(
            source,
            self._target,
            parameters=self.parameters,
            engine_name="zwfs",
            kernel_name="python3",
            progress_bar=False,
            request_save_on_cell_execute=False,
            run=self,
            environment=clean(os.environ) | own,
        )

    def _check_pictures(self) -> None:
        """Refuse a run in which a cell publishes a figure that it does not show."""
        for number, cell in enumerate(self.notebook.cells, 1):
            figures = results.published(cell.source) if cell.cell_type == "code" else []
            kinds = [kind for output in cell.get("outputs", ()) for kind in output.get("data", ())]
            if sum(kind in PICTURES for kind in kinds) < len(figures):
                self.cell = number
                raise RuntimeError(f"no picture of {', '.join(figures)}: expected each figure in the output")

    def start_kernel(self, client: PapermillNotebookClient, environment: dict[str, str]) -> None:
        """Run the cells in a kernel with this environment; its messages go to a log."""
        self._client = client
        with self._log.open("w") as log:
            client.execute(env=environment, cwd=str(self.project.notebooks), stdout=log, stderr=log)

    def begin_cell(self, number: int) -> None:
        """Note that a cell begins; refuse if the run was stopped."""
        if self._stopped:
            raise InterruptedError
        self._progress.unlink(missing_ok=True)
        self.cell = number

    def stop(self) -> None:
        """End the kernel and all processes that it started, at once."""
        self._stopped = True
        with suppress(AttributeError, OSError):  # the kernel has not started, or has ended
            os.killpg(self._client.km.provisioner.pid, signal.SIGKILL)

    def progress(self) -> str:
        """Return the number of the cell that runs, and the progress of a sweep in it."""
        said = f"cell {self.cell}/{len(self.cells)}"
        with suppress(OSError, ValueError, KeyError, TypeError):  # no sweep runs, or its last line is incomplete
            sweep = json.loads(self._progress.read_bytes().rpartition(b"\n")[0].rpartition(b"\n")[2])
            said += f", {sweep['name']} {sweep['done']:d}/{sweep['total']:d}"
        return said

    def _describe(self, error: Exception) -> str:
        """Return where the notebook failed, with which parameters, and why."""
        lines = [f"notebooks/{self.name}.ipynb failed before its first cell"]
        if self.cell:
            lines = [f"notebooks/{self.name}.ipynb failed in cell {self.cell} of {len(self.cells)}"]
            code = [line for line in self.cells[self.cell - 1].source.splitlines() if line.strip()]
            lines += [f"  the cell begins: {line}" for line in code[:1]]
        defaults = {name: value for name, (value, _) in declared.assigned(self._source).items()}
        values = ", ".join(f"{name} = {value}" for name, value in (defaults | self.parameters).items())
        lines += [f"  parameters in force: {values or '(none)'}", ""]
        if isinstance(error, PapermillExecutionError):
            traceback = strip_color("\n".join(error.traceback)).splitlines()[-TRACEBACK_LINES:]
            return "\n".join([*lines, *(traceback or [f"{error.ename}: {error.evalue}"])])
        log = self._log.read_text(errors="replace")[-LOG_CHARACTERS:] if self._log.exists() else ""
        return "\n".join([*lines, *log.splitlines(), f"{type(error).__name__}: {error}"])


def _complete(notebook: NotebookNode) -> bool:
    """Return whether every cell of code has run to its end; papermill takes sys.exit(0) for an end."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    return all(c.execution_count and all(output.output_type != "error" for output in c.outputs) for c in cells)


class Engine(NBClientEngine):
    """Papermill's engine, with an environment for each kernel; it reports each cell to the `Run`."""

    @classmethod
    def execute_managed_notebook(
        cls, nb_man: Any, kernel_name: str, *, run: Run, environment: dict[str, str], **_: Any
    ) -> None:
        """Run the cells of a notebook."""
        begin, run.cells = nb_man.cell_start, list(nb_man.nb.cells)

        def cell_start(cell: NotebookNode, cell_index: int, **options: Any) -> None:
            run.begin_cell(cell_index + 1)
            begin(cell, cell_index, **options)

        nb_man.cell_start = cell_start
        client = PapermillNotebookClient(
            nb_man, kernel_name=kernel_name, timeout=None, shutdown_kernel="immediate"
        )
        run.start_kernel(client, environment)


papermill_engines.register("zwfs", Engine)


def tell(text: str) -> None:
    """Print a line above the progress bar, at once."""
    tqdm.write(text)
    sys.stdout.flush()


def execute(runs: list[Run], finished: Callable[[Run], None], say: Callable[[str], None] = tell) -> None:
    """Execute notebooks in parallel, by default on all cores; `finished` takes each run at its end.

    Without a terminal for the progress bar, `say` reports after each `SILENCE`. The error of all that failed is
    raised after the end of the last one.
    """
    n_processes = min(joblib.cpu_count(), len(runs))
    cores = max(1, joblib.cpu_count() // n_processes)
    with (
        tqdm(unit="cell", total=1, disable=None, leave=False, dynamic_ncols=True) as bar,
        ThreadPoolExecutor(n_processes) as pool,
    ):
        waiting = {pool.submit(run.execute, cores): run for run in runs}
        said = time.monotonic()
        try:
            while waiting:
                for future in wait(waiting, PERIOD, FIRST_COMPLETED).done:
                    future.result()
                    finished(waiting.pop(future))
                    said = time.monotonic()
                _show(bar, runs, list(waiting.values()))
                if bar.disable and time.monotonic() - said > SILENCE:
                    say(f"{bar.desc}: {bar.postfix}")
                    said = time.monotonic()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for run in runs:
                run.stop()
            raise
    if failures := [str(run.error) for run in runs if run.error]:
        raise NotebookError("\n\n".join(failures))


def _show(bar: tqdm, runs: list[Run], waiting: list[Run]) -> None:
    """Draw the progress of all notebooks."""
    several = len(runs) > 1
    title = f"{len(runs) - len(waiting)}/{len(runs)} notebooks" if several else runs[0].name
    now = ((run.name.split("_")[0] + ", " if several else "") + run.progress() for run in waiting if run.cell)
    bar.total, bar.n = sum(len(run.cells) for run in runs), sum(run.cell for run in runs)
    bar.set_description_str(title, refresh=False)
    bar.set_postfix_str("; ".join(now))
