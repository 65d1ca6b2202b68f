"""Execute one notebook with papermill: the process that `runner` starts for each notebook.

It takes a request as JSON (see `main`) and writes a message, a line of JSON, to standard output:
``{"cell": 3, "of": 12}`` when a cell begins, ``{"failure": {...}}`` when the notebook failed.
"""

import ast
import json
import os
import signal
import sys
from typing import Any, TextIO

import papermill
from papermill.engines import NBClientEngine, papermill_engines
from papermill.exceptions import PapermillExecutionError, strip_color

TRACEBACK_LINES = 12


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
    """Write one message and make sure that it arrives now."""
    print(json.dumps(message), file=messages, flush=True)


def check_parameters(parameters: dict[str, Any], known: dict[str, Any]) -> None:
    """Refuse what papermill lets pass: a name that the notebook does not have, a value of another type.

    Parameters
    ----------
    parameters : dict
        Values by name.
    known : dict
        What `papermill.inspect_notebook` says of the notebook.

    Raises
    ------
    ValueError
        The notebook has no parameter of that name.
    TypeError
        The value is not of the default's type. An int may stand for a float.
    """
    for name, value in parameters.items():
        if name not in known:
            raise ValueError(f"unknown parameter {name!r}: expected one of {', '.join(known) or '(none)'}")
        try:
            default = ast.literal_eval(known[name]["default"])
        except (SyntaxError, ValueError):
            continue  # an expression: its type is known only to the kernel
        same = type(value) is type(default) or (type(value), type(default)) == (int, float)
        if default is not None and not same:
            kind = type(default).__name__
            raise TypeError(f"parameter {name} = {value!r}: expected {kind}, as in {default!r}")


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
        check_parameters(request["parameters"], known)
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
    except Exception as error:
        failure = {"where": ReportingEngine.cell, "parameters": in_force, "error": last_lines(error)}
        send(messages, {"failure": failure})
        return False
    return True


def main() -> int:
    """Serve the request in the first argument: its notebook, target, folder and parameters."""
    # The kernel inherits standard output: keep it for the messages, and send everything else to the log.
    messages = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    # An exception, and not the end of this process, so that papermill ends the kernel first.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    return 0 if execute(json.loads(sys.argv[1]), messages) else 1


if __name__ == "__main__":
    sys.exit(main())
