"""Execute one notebook with papermill: the process that `runner` starts for each notebook.

It takes a request as JSON (see `main`) and writes a message, a line of JSON, to standard output:
``{"cell": 3, "of": 12}`` when a cell begins, ``{"name": "linearity_curves", "done": 3, "total": 22}`` when work
within a cell goes on, ``{"failure": {...}}`` when the notebook failed.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import papermill
from papermill.engines import NBClientEngine, papermill_engines
from papermill.exceptions import PapermillExecutionError, strip_color

TRACEBACK_LINES = 12
PERIOD = 0.2  # of looking into it, second
SENDING = threading.Lock()


class ReportingEngine(NBClientEngine):
    """Papermill's own engine, which also says which cell begins."""

    messages: TextIO
    cell: dict[str, Any] | None = None

    @classmethod
    def execute_managed_notebook(cls, nb_man: Any, kernel_name: str, **options: Any) -> None:
        """Run the cells, with a message before each."""
        cell_start = nb_man.cell_start

        def reported(cell: Any, cell_index: int, **more: Any) -> None:
            place = {"cell": cell_index + 1, "of": len(nb_man.nb.cells)}
            lines = [line for line in cell.source.splitlines() if line.strip()]
            cls.cell = {**place, "first_line": lines[0] if lines else ""}
            send(cls.messages, place)
            cell_start(cell, cell_index, **more)

        nb_man.cell_start = reported
        super().execute_managed_notebook(nb_man, kernel_name, **options)


def send(messages: TextIO, message: dict[str, Any]) -> None:
    """Write one message, whole, and make sure that it arrives now."""
    with SENDING:
        messages.write(f"{json.dumps(message)}\n")
        messages.flush()


@contextmanager
def watch(path: Path, messages: TextIO) -> Iterator[None]:
    """Pass on what work within a cell says of its progress, as long as the context lasts."""
    over = threading.Event()

    def look() -> None:
        seen = 0
        while not over.wait(PERIOD):
            if path.exists():
                with path.open("rb") as file:
                    file.seek(seen)
                    # What follows the last newline is not yet complete.
                    whole, newline, _ = file.read().rpartition(b"\n")
                seen += len(whole + newline)
                if step := progress(whole.rpartition(b"\n")[2]):
                    send(messages, step)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def progress(line: bytes) -> dict[str, Any] | None:
    """Return what a line says of progress; None if it says nothing that can be understood."""
    try:
        said = json.loads(line)
        return {"name": str(said["name"]), "done": int(said["done"]), "total": int(said["total"])}
    except (ValueError, KeyError, TypeError):
        return None


def last_lines(error: BaseException) -> str:
    """Say what went wrong: the end of the notebook's traceback, or the error itself."""
    if isinstance(error, PapermillExecutionError):
        lines = strip_color("\n".join(error.traceback)).splitlines()
        return "\n".join(lines[-TRACEBACK_LINES:]) or f"{error.ename}: {error.evalue}"
    return f"{type(error).__name__}: {error}"


def execute(request: dict[str, Any], messages: TextIO) -> bool:
    """Run the notebook of a request; return whether it came to its end."""
    ReportingEngine.messages = messages
    papermill_engines.register("reporting", ReportingEngine)
    in_force = dict(request["parameters"])
    try:
        known = papermill.inspect_notebook(request["notebook"])
        in_force = {name: p["default"] for name, p in known.items()} | in_force
        with watch(Path(request["progress"]), messages):
            try:
                _run(request)
            except RuntimeError:
                # Two kernels that start at one time may choose the same port, and one of them never answers.
                if ReportingEngine.cell is not None:
                    raise
                _run(request)
    except Exception as error:
        failure = {"where": ReportingEngine.cell, "parameters": in_force, "error": last_lines(error)}
        send(messages, {"failure": failure})
        return False
    return True


def _run(request: dict[str, Any]) -> None:
    papermill.execute_notebook(
        request["notebook"],
        request["target"],
        parameters=request["parameters"],
        cwd=request["folder"],
        engine_name="reporting",
        kernel_name="python3",
        progress_bar=False,
        request_save_on_cell_execute=False,
        shutdown_kernel="immediate",
    )


def end_without(parent: int) -> None:
    """End this process, and with it the kernel, when the process that started it is gone."""
    while os.getppid() == parent:
        time.sleep(PERIOD)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Serve the request in the first argument: its notebook, target, folder, parameters and file of progress."""
    # The kernel inherits standard output: keep it for the messages, and send everything else to the log.
    messages = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    # An exception, and not the end of this process, so that papermill ends the kernel first.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    threading.Thread(target=end_without, args=(os.getppid(),), daemon=True).start()
    return 0 if execute(json.loads(sys.argv[1]), messages) else 1


if __name__ == "__main__":
    sys.exit(main())
