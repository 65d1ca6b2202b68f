"""Figure 9: errors on the bench, and the inputs up to which each reconstructor can be used."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.bench_linearity import BenchCurves
from zwfs.plots import LOOKS

SHOWN = (0.0, 0.1, 0.3, 0.5, 0.8, 1.0)  # inputs of the table, rad rms
GLUED = {
    "linear": "Linear",
    "arcsine": "Arcsine",
    "shifted": "PhaseShifted",
    "saxton": "GerchbergSaxton",
    "descent": "GradientDescent",
}


def columns(curves: BenchCurves) -> dict[str, NDArray]:
    """Return the columns to publish."""
    names = curves.residuals
    return {
        "input (rad rms)": curves.rms,
        **{f"{name}, mean error (rad rms)": curves.mean(name) for name in names},
        **{f"{name}, standard deviation (rad rms)": curves.std(name) for name in names},
        **{f"{name}, gain": curves.gain(name) for name in names},
    }


def errors(curves: BenchCurves) -> Table:
    """Return the mean errors at some inputs."""
    shown = [index for index, value in enumerate(curves.rms) if value in SHOWN]
    header = ["reconstructor", *(f"error at {curves.rms[index]:g}" for index in shown)]
    rows = [
        [LOOKS[name].name, *(f"{curves.mean(name)[index]:.2g}" for index in shown)] for name in curves.residuals
    ]
    return Table(header, rows)


def reach(curves: BenchCurves, name: str, ratio: float = 0.25) -> float:
    """Largest input whose mean error is at most `ratio` times the input, rad rms; 0 if there is none."""
    good = (curves.rms > 0) & (curves.mean(name) <= ratio * curves.rms)
    return float(curves.rms[good].max(initial=0.0))


def _at(curves: BenchCurves, name: str, rms: float) -> float:
    """Mean error at one input (rad rms); NaN where that input was not used."""
    return next(iter(curves.mean(name)[curves.rms == rms]), np.nan)


def claims(curves: BenchCurves) -> Table:
    """Glue and show offset, reach and gain of each reconstructor."""
    large = curves.rms >= 0.3
    alike = curves.mean("Arcsine")[large] / curves.mean("Linear")[large]
    numbers: dict[str, Any] = {
        f"offset_{short}": curves.mean(GLUED[short])[0] for short in ("shifted", "linear", "saxton")
    }
    numbers["arcsine_over_linear"] = round(np.median(alike), 3) if alike.size else np.nan
    numbers |= {f"reach_{short}": reach(curves, name) for short, name in GLUED.items()}
    numbers["shifted_worst"] = curves.mean("PhaseShifted").max()
    numbers["largest_input"] = curves.rms.max()
    numbers["shifted_share_at_01"] = _at(curves, "PhaseShifted", 0.1) / 0.1
    numbers["saxton_worse_up_to"] = curves.rms[curves.mean("GerchbergSaxton") > curves.mean("Linear")].max(
        initial=0.0
    )
    glue_numbers(numbers)
    smallest = np.flatnonzero(curves.rms > 0)[0]
    return Table(
        [
            "reconstructor",
            "error at a flat command (rad rms)",
            "largest input with an error below 25 % (rad rms)",
            "gain at the smallest input",
        ],
        [
            [
                LOOKS[name].name,
                f"{curves.mean(name)[0]:.2g}",
                reach(curves, name) or "none",
                float(curves.gain(name)[smallest]),
            ]
            for name in curves.residuals
        ],
    )
