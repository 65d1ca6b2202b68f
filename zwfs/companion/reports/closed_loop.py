"""The closed loop: residuals for each star, and the errors from which every loop closes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.closed_loop import LoopRun
from zwfs.plots import LOOKS

StarRuns = Mapping[float, Mapping[str, LoopRun]]
CaptureRuns = Sequence[Mapping[str, LoopRun]]  # for each error at the start


def star_columns(runs: StarRuns) -> dict[str, Any]:
    """Return the columns to publish: the median residual for each star and method."""
    columns = {}
    for magnitude, methods in runs.items():
        for name, run in methods.items():
            columns["time (s)"] = run.times
            columns[f"{name}, magnitude {magnitude:g}: median (rad rms)"] = np.median(run.residual, axis=0)
    return columns


def stars(runs: StarRuns, photons: Mapping[float, float]) -> Table:
    """Return the settled residual, the Strehl ratio and the number of closed loops for each star and method."""
    return Table(
        [
            "magnitude",
            "photons per step",
            "reconstructor",
            "settled residual (rad rms)",
            "Strehl ratio",
            "loops that close",
        ],
        [
            [
                f"{magnitude:g}",
                f"{photons[magnitude]:.2g}",
                LOOKS[name].name,
                f"{np.median(run.settled()):.2g}",
                f"{np.median(run.strehl[:, run.last_third]):.2f}",
                f"{np.count_nonzero(run.closed())} of {len(run.residual)}",
            ]
            for magnitude, methods in runs.items()
            for name, run in methods.items()
        ],
    )


def capture_columns(inputs: Sequence[float], runs: CaptureRuns) -> dict[str, Any]:
    """Return the columns to publish: the fraction of loops that close, and their residual, for each start."""
    columns: dict[str, Any] = {"start (rad rms)": inputs}
    for name in runs[0]:
        columns[f"{name}: loops that close"] = [np.mean(one[name].closed()) for one in runs]
        columns[f"{name}: median residual (rad rms)"] = [np.median(one[name].settled()) for one in runs]
    return columns


def claims(
    lag: LoopRun,
    inputs: Sequence[float],
    runs: CaptureRuns,
    rms: float,
    delay: int,
    n_iterations: int,
    cutoff: float,
) -> None:
    """Glue settings, the residual of a run without noise, and the largest error from which all loops close."""
    glue_numbers({"rms": rms, "delay": delay, "iterations": n_iterations, "cutoff": cutoff})
    glue_numbers({"lag": np.median(lag.settled())})
    for name in runs[0]:
        closing = [value for value, one in zip(inputs, runs, strict=True) if one[name].closed().all()]
        glue_numbers({f"all_close_{name}": max(closing, default=0.0)})
