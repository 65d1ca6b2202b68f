"""Reconstructors, iteration by iteration: columns of the figures, tables of one screen and of the model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.tables import Table, small
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.plots import LOOKS
from zwfs.pupil import Pupil
from zwfs.reconstructors import Reconstruction


def quantiles(errors: Mapping[str, Mapping[float, NDArray]]) -> dict[str, NDArray]:
    """Columns of the errors after each iteration: median and middle 80 % of the screens."""
    n_steps = max(error.shape[1] for by_input in errors.values() for error in by_input.values())
    columns = {"iteration": np.arange(n_steps)}
    for name, by_input in errors.items():
        for value, error in by_input.items():
            for level in (0.1, 0.5, 0.9):
                curve = np.quantile(error, level, axis=0)
                # A method without iterations: before and after.
                curve = curve[-1] if curve.size == 2 else curve
                columns[f"{name} at {value:g} rad: quantile {level:g} (rad rms)"] = curve
    return columns


def cut(pupil: Pupil, screen: NDArray, phases: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of the estimates and the residuals along the middle of the pupil."""
    row = pupil.shape[0] // 2
    return {
        "x at the middle of the pupil (D)": pupil.x,
        "input (rad)": np.where(pupil.inside, screen, np.nan)[row],
        **{f"{name} (rad)": phase[row] for name, phase in phases.items()},
        **{
            f"{name}, residual (rad)": wrapped_residual(pupil, phase, screen)[row]
            for name, phase in phases.items()
        },
    }


def results(pupil: Pupil, screen: NDArray, found: Mapping[str, Reconstruction]) -> Table:
    """Result that each method reports, and its error."""
    return Table(
        ["reconstructor", "iterations", "mismatch of the frames (rms)", "error (rad rms)"],
        [
            [
                LOOKS[name].name,
                int(result.n_iterations),
                small(float(result.residual)),
                small(float(reconstruction_error(pupil, result.phase, screen))),
            ]
            for name, result in found.items()
        ],
    )


def accuracy(rows: NDArray) -> Table:
    """Rank and error of the low-rank model, see `zwfs.paper.linearity.model_accuracy`."""
    return Table(
        ["tolerance", "rank", "error of the reference wave, below"],
        [
            [f"{tolerance:.0e}", int(rank), f"{10.0 ** np.ceil(np.log10(error)):.0e}"]
            for tolerance, rank, error in rows
        ],
    )
