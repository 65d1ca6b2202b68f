"""Figure 4: columns of the figures, tables of the limits on the diameter, and the numbers of the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table, small
from zwfs.paper.curves import crossing
from zwfs.paper.dimple_diameter import DARK_RING, FEW, Contraction, DiameterCurves
from zwfs.plots import LOOKS

ITERATION = "PhaseShifted"
USUAL = 1.06  # diameter of the paper's other figures, lambda/D
SHORT = {
    "Linear": "linear",
    "Arcsine": "arcsine",
    "GerchbergSaxton": "saxton",
    "GradientDescent": "descent",
    "GradientDescentPoints": "descent_points",
}


def iteration_columns(curves: Mapping[int, DiameterCurves]) -> dict[str, NDArray]:
    """Columns of the figure of the paper, by the number of iterations; NaN where a curve was not computed."""
    diameters = next(iter(curves.values())).diameters
    columns = {"diameter (lambda/D)": diameters}
    for n, curve in curves.items():
        computed = np.isin(diameters, curve.diameters)
        both = {"mean error": curve.mean(ITERATION), "standard deviation": curve.std(ITERATION)}
        for quantity, values in both.items():
            column = columns[f"{n} iterations: {quantity} (rad rms)"] = np.full(diameters.size, np.nan)
            column[computed] = values
    return columns


def limits(curves: Mapping[int, DiameterCurves], threshold: float) -> Table:
    """Diameters at which the error exceeds 1e-3 rad and the threshold, by the number of iterations."""
    return Table(
        ["iterations", "passes 10⁻³ rad at (λ/D)", f"passes {100 * threshold:g} % at (λ/D)"],
        [
            [n, *(curve.exceeds(ITERATION, limit) for limit in (1e-3, threshold * curve.rms[0]))]
            for n, curve in curves.items()
        ],
    )


def reason_columns(reasons: Contraction) -> dict[str, NDArray]:
    """Columns of the figure on the causes."""
    return {
        "diameter (lambda/D)": reasons.diameters,
        "factor, flat wavefront": reasons.flat,
        **{f"factor, screen {i}": row for i, row in enumerate(reasons.aberrated.T, start=1)},
        **{f"sensitivity, {name} (1/rad)": row for name, row in reasons.sensitivity.items()},
    }


def factors(reasons: Contraction, curve: DiameterCurves, n_iterations: int) -> Table:
    """Factor of one iteration and sensitivity to tilt at some diameters, with the error of the iteration."""
    rows = []
    for diameter, observed in reasons.observed.items():
        at = reasons.index(diameter)
        values = reasons.flat[at], reasons.aberrated[at, 0], observed, reasons.sensitivity["tilt"][at]
        rows.append([diameter, *map(float, values), small(curve.at(ITERATION, diameter))])
    return Table(
        [
            "diameter (λ/D)",
            "factor, flat",
            "factor, first screen",
            "observed on it",
            "tilt sensitivity (1/rad)",
            f"mean error after {n_iterations} (rad rms)",
        ],
        rows,
    )


def _ends(reasons: Contraction) -> tuple[float, list[float]]:
    """Diameters at which the factor exceeds 1: for a flat wavefront, and for each screen."""
    return (
        crossing(reasons.diameters, reasons.flat, 1.0),
        [crossing(reasons.diameters, row, 1.0) for row in reasons.aberrated.T],
    )


def ends(reasons: Contraction) -> Table:
    """Diameters at which the factor exceeds 1."""
    flat, screens = _ends(reasons)
    return Table(
        ["the factor passes 1 at", "λ/D"],
        [
            ["dark ring, theory", DARK_RING],
            ["flat wavefront", flat],
            ["screens, least", min(screens)],
            ["screens, most", max(screens)],
        ],
        digits=4,
    )


def method_columns(curves: Mapping[str, DiameterCurves]) -> dict[str, Sequence[float]]:
    """Columns of the comparison of the methods."""
    return {
        "diameter (lambda/D)": FEW,
        **{f"{name}, mean error (rad rms)": [curve.at(name, d) for d in FEW] for name, curve in curves.items()},
    }


def _start(curve: DiameterCurves, name: str, threshold: float) -> str:
    """Diameter, from the usual one on, at which the error exceeds the threshold, in words."""
    limit = threshold * curve.rms[0]
    if curve.at(name, USUAL) > limit:
        return "at all diameters"
    return _place(curve.exceeds(name, limit, start=USUAL))


def _doubled(curve: DiameterCurves, name: str) -> str:
    """Diameter at which the error exceeds twice that at the usual one, in words."""
    error = curve.at(name, USUAL)
    return "–" if error < 1e-6 else _place(curve.exceeds(name, 2 * error, start=USUAL))


def _place(diameter: float) -> str:
    return f"{diameter:.3g}" if diameter < np.inf else "never"


def methods(curves: Mapping[str, DiameterCurves], threshold: float) -> Table:
    """Errors of the methods at some diameters, and the diameters at which they rise."""
    return Table(
        [
            "method",
            "error at 1.06",
            "at 2",
            "at 2.6",
            "at 3.5 (λ/D)",
            f"passes {100 * threshold:g} % at (λ/D)",
            "twice that at 1.06 from (λ/D)",
        ],
        [
            [
                LOOKS[name].name,
                *(small(curve.at(name, diameter)) for diameter in (USUAL, 2.0, 2.6, 3.5)),
                _start(curve, name, threshold),
                _doubled(curve, name),
            ]
            for name, curve in curves.items()
        ],
    )


def claims(
    by_iterations: Mapping[int, DiameterCurves],
    reasons: Contraction,
    by_method: Mapping[str, DiameterCurves],
    threshold: float,
) -> Table:
    """Glue the numbers of the claims of section 4.2 on the diameter, and show them."""
    paper, longest = by_method[ITERATION], list(by_iterations.values())[-1]
    limit = threshold * paper.rms[0]
    flat, screens = _ends(reasons)
    tilt = reasons.sensitivity["tilt"]
    usual, at_22, at_3 = map(reasons.index, (USUAL, 2.2, 3.0))
    ratios = {name: curve.at(name, 2.6) / curve.at(name, 2.0) for name, curve in by_method.items()}
    lost = _start(by_method["GradientDescent"], "GradientDescent", threshold)
    numbers: dict[str, Any] = {
        "iterations": next(iter(by_iterations)),
        "diameter_5_percent": paper.exceeds(ITERATION, limit),
        "diameter_1e3": paper.exceeds(ITERATION, 1e-3),
        "diameter_5_percent_400": longest.exceeds(ITERATION, limit),
        "diameter_1e3_400": longest.exceeds(ITERATION, 1e-3),
        "error_at_20": paper.at(ITERATION, 2.0),
        "error_at_22": paper.at(ITERATION, 2.2),
        "error_at_26": paper.at(ITERATION, 2.6),
        "claim16_ratio": ratios[ITERATION],
        "contraction_at_106": reasons.flat[usual],
        "contraction_at_22": reasons.flat[at_22],
        "contraction_crosses_1": flat,
        "contraction_crosses_1_screens_least": min(screens),
        "contraction_crosses_1_screens_most": max(screens),
        "contraction_observed_difference": max(
            abs(observed / reasons.aberrated[reasons.index(diameter), 0] - 1)
            for diameter, observed in reasons.observed.items()
        ),
        "dark_ring": DARK_RING,
        "tilt_at_22": tilt[at_22] / tilt[usual],
        "tilt_at_dark_ring": tilt.min() / tilt[usual],
        "tilt_at_3": tilt[at_3] / tilt[usual],
        **{f"claim17_{short}_ratio": ratios[name] for name, short in SHORT.items()},
        "descent_passes": f"at {lost} λ/D" if lost[0].isdigit() else lost,
    }
    glue_numbers(numbers, ".4g")
    rising = [LOOKS[name].name for name, ratio in ratios.items() if ratio > 10]
    return Table(
        ["claim", "what was looked at", "measured"],
        [
            ["16", "error at 2.6 over that at 2.0 λ/D", f"{ratios[ITERATION]:.2g}"],
            ["16", "factor 1 is passed at (λ/D)", flat],
            ["17", "methods whose error at 2.6 is over ten times that at 2.0 λ/D", ", ".join(rising) or "none"],
        ],
    )
