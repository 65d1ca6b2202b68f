"""Dark zone: residuals next to the limits, photons that hold a drift, and the numbers of the text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.dark_zone import IDEAL, DriftCurves, best_gain, kalman_limit, photons_to_hold

_TARGETS = 1.2, 1.5, 2.0, 3.0
"""Residuals in the table, over the step of the drift."""


def columns(curves: DriftCurves) -> dict[str, NDArray]:
    """Columns of the simulated residuals and their limits."""
    found = {"photons per cycle": np.array(curves.photons)}
    for name, errors in curves.errors.items():
        found[f"{name}: limit (pm rms)"] = kalman_limit(errors, curves.drift, curves.photons)
        if name in curves.held:
            found[f"{name}: simulated (pm rms)"] = curves.held[name]
    return found


def needed(curves: DriftCurves) -> Table:
    """Photons per cycle that hold the drift at several residuals."""
    drift = curves.drift
    header = ["sensor", *(f"{factor * drift.rms:g} pm" for factor in _TARGETS)]
    rows = [
        [name, *(f"{photons_to_hold(errors, drift, factor * drift.rms):.2g}" for factor in _TARGETS)]
        for name, errors in curves.errors.items()
    ]
    return Table(header, rows)


def numbers(curves: DriftCurves) -> None:
    """Glue photons, residuals and gains; sensors are numbered in their order."""
    drift, errors, held = curves.drift, curves.errors, curves.held
    photons, gains, by_gain = curves.photons, curves.gains, curves.by_gain
    target = 1.5 * drift.rms
    found = {"drift": drift.rms, "target": target, "n_modes": float(len(drift.modes))}
    names = [name for name in errors if name != IDEAL]
    for index, name in enumerate(names):
        found[f"photons_{index}"] = photons_to_hold(errors[name], drift, target)
        found[f"gain_{index}"] = best_gain(errors[name], drift, found[f"photons_{index}"])
    found["photons_ideal"] = photons_to_hold(errors[IDEAL], drift, target)
    found["saved"] = 100 * (1 - found[f"photons_{len(names) - 1}"] / found["photons_1"])
    found["above_ideal"] = 100 * (found[f"photons_{len(names) - 1}"] / found["photons_ideal"] - 1)
    found["pair_over_classic"] = found["photons_1"] / found["photons_0"]
    ratios = [held[name] / kalman_limit(errors[name], drift, photons) for name in names]
    found |= {"agreement_least": float(np.min(ratios)), "agreement_most": float(np.max(ratios))}
    light = min(by_gain)
    limit = float(kalman_limit(errors[names[-1]], drift, light))
    found |= {"light_gain": light, "most_light": max(by_gain)}
    found["best_gain"] = best_gain(errors[names[-1]], drift, light)
    found["highest_gain"] = max(gains)
    found["too_fast"] = float(by_gain[light][np.argmax(gains)]) / limit
    found["too_slow"] = float(by_gain[max(by_gain)][np.argmin(gains)]) / float(
        kalman_limit(errors[names[-1]], drift, max(by_gain))
    )
    found["lowest_gain"] = min(gains)
    glue_numbers(found, ".3g")
