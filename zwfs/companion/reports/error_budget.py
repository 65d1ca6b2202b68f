"""The error budget: offset and gain of each error of the bench alone, and of leakage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.bench_linearity import BenchCurves

NAME = "PhaseShifted"
Curves = Mapping[str, BenchCurves]


def columns(budget: Curves) -> dict[str, NDArray | list[str]]:
    """Return the columns to publish: the offset, and gain and error at the first input after 0."""
    offsets, gains, errors = _numbers(budget)
    value = next(iter(budget.values())).rms[1]
    return {
        "error": [_words(error) for error in budget],
        "offset (rad rms)": offsets,
        f"gain at {value} rad rms": gains,
        f"error at {value} rad rms (rad rms)": errors,
    }


def errors(budget: Curves) -> Table:
    """Return offset, gains and errors of each error of the bench alone."""
    rows = [
        [_words(error), f"{offset:.1g}" if (offset := curves.mean(NAME)[0]) > 1e-6 else "0", *_row(curves)]
        for error, curves in budget.items()
    ]
    return Table(["error switched on", "offset (rad rms)", *_header(budget)], rows)


def leakage(swept: Mapping[float, BenchCurves]) -> Table:
    """Return gains and errors with nothing but leakage."""
    return Table(["leakage", *_header(swept)], [[f"{value:.0%}", *_row(one)] for value, one in swept.items()])


def claims(budget: Curves, swept: Mapping[float, BenchCurves]) -> Table:
    """Glue the numbers of some errors and of 10 % leakage, and show which errors have the largest effect."""
    offsets, gains, _ = (dict(zip(budget, values, strict=True)) for values in _numbers(budget))
    for case in ("leakage", "focus_difference", "static", "all"):
        glue_numbers({f"offset_{case}": offsets[case], f"gain_{case}": gains[case]})
    glue_numbers({"gain_leakage_10": swept[0.1].gain(NAME)[0] if 0.1 in swept else np.nan})
    alone = [error for error in budget if error not in ("none", "all")]
    return Table(
        ["quantity", "value"],
        [
            ["error with the largest offset", _words(max(alone, key=lambda error: offsets[error]))],
            [
                "error with the lowest gain at the smaller input",
                _words(min(alone, key=lambda error: gains[error])),
            ],
            ["gain without any error", f"{gains['none']:.3f}"],
        ],
    )


def _numbers(budget: Curves) -> tuple[NDArray, NDArray, NDArray]:
    """Offset, and gain and error at the first input after 0, of each error."""
    curves = budget.values()
    return (
        np.array([one.mean(NAME)[0] for one in curves]),
        np.array([one.gain(NAME)[1] for one in curves]),
        np.array([one.mean(NAME)[1] for one in curves]),
    )


def _header(some: Mapping[Any, BenchCurves]) -> list[str]:
    inputs = next((one.rms[one.rms > 0] for one in some.values()), ())
    return [f"{quantity} at {value:g}" for quantity in ("gain", "error") for value in inputs]


def _row(curves: BenchCurves) -> list[str]:
    used = curves.rms > 0
    errors = (f"{value:.2g}" if value > 1e-6 else "0" for value in curves.mean(NAME)[used])
    return [*(f"{value:.3f}" for value in curves.gain(NAME)[used]), *errors]


def _words(error: str) -> str:
    return error.replace("_", " ")
