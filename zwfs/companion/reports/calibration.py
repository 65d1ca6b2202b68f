"""Calibration of the bench: parameters next to those put in, and errors before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.reports import middle_rows
from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.bench_linearity import BenchCurves
from zwfs.paper.calibration import WAYS, Example, Recording, Recovered

_SHORT = {"design": "design", "design, less flat": "less_flat", "calibrated": "calibrated", "shuffled": "shuffled"}


def columns(curves: BenchCurves) -> dict[str, NDArray]:
    """Return the columns to publish."""
    return {
        "input (rad rms)": curves.rms,
        **{f"{label}: mean error (rad rms)": curves.mean(name) for name, label in WAYS.items()},
    }


def frame_columns(example: Example) -> dict[str, NDArray]:
    """Return the middle rows of the measured and modelled images."""
    return middle_rows({"measured": example.measured.counts, **example.modelled})


def parameters(rows: Sequence[Recovered]) -> Table:
    """Return the parameters put in, those fitted, and their differences in units of the error bar."""
    return Table(
        ["parameter", "put in", "fitted", "error bar", "deviation (error bars)"],
        [
            [one.name, f"{one.true:.5g}", f"{one.value:.5g}", f"{one.sigma:.1g}", f"{one.deviation:+.1f}"]
            for one in rows
        ],
    )


def numbers(recording: Recording, rows: Sequence[Recovered], curves: BenchCurves, example: Example) -> None:
    """Glue the settings of the text, the errors at the input of the example, and the agreement of its frames."""
    bench = recording.bench
    place = int(np.argmin(np.abs(curves.rms - example.commanded.std())))
    found: dict[str, float] = {"commands": len(recording.commands) - 1, "shown": curves.rms[place]}
    found["photons"] = bench.photons / np.count_nonzero(bench.segments)
    found["largest_deviation"] = max(abs(one.deviation) for one in rows)
    for name, short in _SHORT.items():
        found |= {f"{short}_error": curves.mean(name)[place], f"{short}_largest": curves.mean(name).max()}
    found["improvement"] = found["less_flat_error"] / found["calibrated_error"]
    counts, sigma = example.measured
    margin = (counts.shape[-1] - bench.n_pixels) // 2
    lit = np.pad(bench.segments > 0, margin)
    for name, frames in example.modelled.items():
        found[f"{name}_misfit"] = np.sqrt(np.mean(((frames - counts) / sigma) ** 2))
        found[f"{name}_correlation"] = min(
            np.corrcoef(one[lit], other[lit])[0, 1] for one, other in zip(frames, counts, strict=True)
        )
    glue_numbers(found, ".4g")
