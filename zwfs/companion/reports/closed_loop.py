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
    """Return how many loops close, and the residual and the Strehl ratio of these, for each star and method."""
    return Table(
        [
            "magnitude",
            "photons per step",
            "reconstructor",
            "loops that close",
            "their residual (rad rms)",
            "their Strehl ratio",
        ],
        [
            [
                f"{magnitude:g}",
                f"{photons[magnitude]:.2g}",
                LOOKS[name].name,
                f"{np.count_nonzero(run.closed())} of {len(run.residual)}",
                f"{run.held():.2g}",
                f"{np.median(run.strehl[run.closed(), run.last_third]):.2f}" if run.closed().any() else "–",
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
        columns[f"{name}: median residual of these (rad rms)"] = [one[name].held() for one in runs]
    return columns


def claims(
    stars: StarRuns,
    lag: LoopRun,
    inputs: Sequence[float],
    runs: CaptureRuns,
    rms: float,
    delay: int,
    n_iterations: int,
    cutoff: float,
) -> None:
    """Glue settings, the share and the residual of the loops that close, and the error up to which all close."""
    glue_numbers({"rms": rms, "delay": delay, "iterations": n_iterations, "cutoff": cutoff})
    bright, faint = stars[min(stars)], stars[max(stars)]
    glue_numbers({"faintest": max(stars), "n_screens": len(lag.residual), "lag": lag.held()})
    for name in bright:
        glue_numbers({f"closed_{name}": max(int(one[name].closed().sum()) for one in stars.values())})
        glue_numbers({f"bright_{name}": bright[name].held(), f"faint_{name}": faint[name].held()})
    for name in runs[0]:
        closing = [value for value, one in zip(inputs, runs, strict=True) if one[name].closed().all()]
        glue_numbers({f"all_close_{name}": max(closing, default=0.0)})
