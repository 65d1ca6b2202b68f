"""Your own frames: the files, the result, and the gain of each step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.reports import middle_rows
from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.frames.files import read
from zwfs.frames.pipeline import MeasuredPhase, Step
from zwfs.frames.registration import Image
from zwfs.units import phase_to_opd

SHOWN = ("BUNIT", "WAVELEN", "PUPDIAM", "DIMPLE", "CORR1", "CORR2", "NBAD")  # keywords of the phase map


def images(frames: Sequence[Image], clear_frames: Sequence[Image]) -> Table:
    """Return the size, the brightest good pixel and the number of bad pixels of each image."""
    rows = [
        [one.name, *one.counts.shape, f"{one.counts[~one.bad].max():.5g}", int(one.bad.sum())]
        for one in (*frames, *clear_frames)
    ]
    return Table(["image", "rows", "columns", "brightest good pixel", "bad pixels"], rows)


def frame_columns(result: MeasuredPhase) -> dict[str, NDArray]:
    """Return the columns to publish: the middle rows of the frames."""
    return middle_rows({"measured": result.measured, "modelled": result.modelled})


def phase_columns(result: MeasuredPhase, wavelength: float) -> dict[str, NDArray]:
    """Return the columns to publish: the phase on the middle row, in radian and in nm."""
    row = result.phase[result.phase.shape[0] // 2]
    return {
        "column (pixel)": np.arange(row.size),
        "phase on the middle row (rad)": row,
        "the same (nm)": phase_to_opd(row, wavelength),
    }


def result(result: MeasuredPhase) -> Table:
    """Return the places of the pupils, the counts, and the agreement of the frames."""
    measurement, recording = result.measurement, result.measurement.recording
    pupils = [f"{one.row:.2f}, {one.column:.2f}, {one.diameter:.2f}" for one in recording.pupils]
    return Table(
        ["what was found", "value"],
        [
            ["first pupil: row, column, diameter (pixels)", pupils[0]],
            ["second pupil: row, column, diameter (pixels)", pupils[1]],
            ["second image from the first (rows, columns)", _pair(recording.origins[3] - recording.origins[2], 2)],
            ["background of the clear frames (counts)", _pair(measurement.background[2:], 1)],
            ["counts that make an intensity of 1", _pair(measurement.counts, 0)],
            ["light of image 1 over 2, frames", f"{measurement.flux_ratio[0]:.3f}"],
            ["the same, clear frames", f"{measurement.flux_ratio[1]:.3f}"],
            ["points of the pupil", measurement.pupil.n_points],
            ["of these, bad", measurement.n_bad],
            ["points without a unique solution", result.n_unsolved],
            ["correlation of the frames", _pair(result.correlation, 3)],
            ["rms difference of the frames (mean = 1)", _pair(result.residual, 3)],
            ["excess light around the pupil (mean = 1)", f"{result.excess_light:.3f}"],
        ],
    )


def step_columns(work: Sequence[Step], errors: Sequence[float] | None) -> dict[str, Any]:
    """Return the columns to publish: the scores of each step."""
    columns: dict[str, Any] = {"step": [step.name for step in work]}
    columns |= {f"correlation, image {i + 1}": [step.result.correlation[i] for step in work] for i in range(2)}
    columns |= {f"predicted, image {i + 1}": [step.predicted[i] for step in work] for i in range(2)}
    return columns | {"error of the segments (rad rms)": errors or np.nan}


def steps(work: Sequence[Step], errors: Sequence[float] | None) -> Table:
    """Return the scores of each step, and the fitted optics."""
    rows = []
    for index, step in enumerate(work):
        optics = step.result.measurement.optics
        rows.append(
            [
                step.name,
                _pair(step.result.correlation, 3),
                _pair(step.predicted, 2),
                f"{step.result.misfit:.3f}",
                f"{optics.scale:.2f}",
                f"{optics.diameter:.2f}",
                f"{optics.leakage:.2f}",
                f"{errors[index]:.3f}" if errors else "unknown",
            ]
        )
    scores = ["correlation", "from the other frame", "residual over contrast"]
    return Table(["step", *scores, "scale", "dimple", "leakage", "error (rad rms)"], rows)


def phase_file(path: str) -> Table:
    """Return some keywords of the phase map."""
    header = read(path).header
    return Table(["keyword", "value"], [[key, header[key]] for key in SHOWN], digits=5)


def claims(chosen: MeasuredPhase, work: Sequence[Step], errors: Sequence[float] | None) -> None:
    """Glue the correlations and the errors of the chosen result and of the last one."""
    known = errors or [np.nan] * len(work)
    index = [step.result for step in work].index(chosen)
    numbers = dict(zip(("correlation_first", "correlation_second"), chosen.correlation, strict=True))
    numbers |= dict(zip(("last_first", "last_second"), work[-1].result.correlation, strict=True))
    glue_numbers(numbers | {"error": known[index], "error_last": known[-1]})


def _pair(values: Sequence[float] | NDArray, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
