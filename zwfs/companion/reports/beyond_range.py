"""Beyond the paper, the range: columns of the figures, and what maximum likelihood says about its result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.recovery import RecoveryCurves, Verdicts
from zwfs.plots.recovery import method_look

LIKELY = "MaximumLikelihood"


def columns(curves: Mapping[float, RecoveryCurves], threshold: float) -> dict[str, NDArray]:
    """Columns of the figures: share of recovered screens of each method, and mean number of starts."""
    found = {}
    for diameter, curve in curves.items():
        found["input (rad rms)"] = curve.rms
        for name in curve.errors:
            found[f"{name}, {diameter:g} lambda/D: share recovered"] = curve.recovered(name, threshold)
        found[f"{diameter:g} lambda/D: starts, mean"] = curve.n_starts.mean(axis=1)
    return found


def _all_up_to(curve: RecoveryCurves, name: str, threshold: float) -> float:
    """Largest input up to which a method recovers every screen, 0 if there is none."""
    lost = np.flatnonzero(curve.recovered(name, threshold) < 1)
    known = curve.rms[: lost[0]] if lost.size else curve.rms
    return float(known[-1]) if known.size else 0.0


def ranges(curves: Mapping[float, RecoveryCurves], threshold: float) -> Table:
    """Largest input up to which each method recovers every screen, for each dimple."""
    names = list(next(iter(curves.values())).errors)
    return Table(
        ["every screen up to (rad rms)", *(f"{diameter:g} λ/D" for diameter in curves)],
        [
            [
                method_look(name).name,
                *(f"{_all_up_to(curve, name, threshold):g}" for curve in curves.values()),
            ]
            for name in names
        ],
    )


def verdicts(curves: Mapping[float, RecoveryCurves], threshold: float) -> Table:
    """Numbers of screens by what maximum likelihood says and by the truth."""
    rows = [[f"{diameter:g}", *curve.verdicts(threshold)] for diameter, curve in curves.items()]
    return Table(
        [
            "diameter (λ/D)",
            "consistent and right",
            "consistent and wrong",
            "inconsistent and right",
            "inconsistent and wrong",
        ],
        [*rows, ["all", *_total(curves, threshold)]],
    )


def claims(curves: Mapping[float, RecoveryCurves], threshold: float, settings: Mapping[str, float]) -> None:
    """Glue the settings and the numbers of the text, with the limits of the first, second and third dimple."""
    total = _total(curves, threshold)
    used = np.concatenate([curve.n_starts.ravel() for curve in curves.values()])
    numbers: dict[str, Any] = dict(settings) | {
        "largest": next(iter(curves.values())).rms[-1],
        "n_screens": next(iter(curves.values())).n_starts.shape[1],
        "n_all": sum(total),
        "n_right": total.consistent_right + total.inconsistent_right,
        "n_wrong": total.consistent_wrong + total.inconsistent_wrong,
        "false_alarms": total.inconsistent_right,
        "false_trust": total.consistent_wrong,
        "once": np.mean(used == 1),
        "starts_most": used.max(),
    }
    for short, (diameter, curve) in zip(("first", "second", "third"), curves.items(), strict=False):
        numbers[f"{short}_diameter"] = diameter
        for method, name in (("plain", "PhaseShifted"), ("likely", LIKELY)):
            numbers[f"{short}_{method}"] = _all_up_to(curve, name, threshold)
        numbers[f"{short}_end"] = curve.recovered(LIKELY, threshold)[-1]
    glue_numbers(numbers, ".4g")


def _total(curves: Mapping[float, RecoveryCurves], threshold: float) -> Verdicts:
    return Verdicts(*map(sum, zip(*(curve.verdicts(threshold) for curve in curves.values()), strict=True)))
