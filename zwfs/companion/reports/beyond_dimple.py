"""Beyond the paper, the dimple: columns of the figures, failing points, and the masks of instruments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.curves import crossing
from zwfs.paper.dimple_diameter import DARK_RING, DiameterCurves
from zwfs.paper.recovery import MASKS, DimpleLimits, RecoveryCurves
from zwfs.plots.recovery import method_look

LIKELY = "MaximumLikelihood"
USUAL, LARGE = 1.06, 3.0  # diameters of the paper and of a dimple beyond its limit, lambda/D


def recovery_columns(curves: Mapping[float, DiameterCurves], threshold: float) -> dict[str, NDArray]:
    """Columns of the figure: share of recovered screens and mean error of each method, for each input."""
    columns = {}
    for rms, curve in curves.items():
        columns["diameter (lambda/D)"] = curve.diameters
        for name in curve.errors:
            columns[f"{name}, {rms:g} rad rms: share recovered"] = curve.recovered(name, threshold)
            columns[f"{name}, {rms:g} rad rms: mean error (rad rms)"] = curve.mean(name)
    return columns


def _fails(curve: DiameterCurves, name: str, threshold: float) -> tuple[str, str]:
    """Largest diameter up to which every screen is recovered, and where the mean error exceeds the threshold."""
    lost = np.flatnonzero(curve.recovered(name, threshold) < 1)
    if not lost.size:
        last = f"{curve.diameters[-1]:g}, the largest"
    else:
        last = f"{curve.diameters[lost[0] - 1]:g}" if lost[0] else "none"
    passed = curve.exceeds(name, threshold * curve.rms[0])
    return last, f"{passed:.3g}" if passed < np.inf else "never"


def failing(curves: Mapping[float, DiameterCurves], threshold: float) -> Table:
    """Failing point of each method, for each input."""
    percent = f"{100 * threshold:g} %"
    return Table(
        [
            "input (rad rms)",
            "method",
            "recovers every screen up to (λ/D)",
            f"mean error exceeds {percent} from (λ/D)",
        ],
        [
            [f"{rms:g}", method_look(name).name, *_fails(curve, name, threshold)]
            for rms, curve in curves.items()
            for name in curve.errors
        ],
    )


def limits_columns(limits: DimpleLimits) -> dict[str, NDArray]:
    """Columns of the figure on the reasons; the first wavefront is flat, the others are the screens."""
    columns = {"diameter (lambda/D)": limits.diameters}
    for index in range(limits.factor.shape[1]):
        wavefront = f"screen {index}" if index else "flat wavefront"
        columns[f"factor, {wavefront}"] = limits.factor[:, index]
        columns[f"bound of tilt / ideal, {wavefront}"] = limits.tilt[:, index]
        columns[f"bound of other modes / ideal, {wavefront}"] = limits.others[:, index]
        columns[f"bound of all modes / ideal, {wavefront}"] = limits.total[:, index]
    return columns


def instruments(curves: Mapping[str, RecoveryCurves], threshold: float) -> Table:
    """Number of screens that each method recovers on the masks of instruments."""
    names = list(next(iter(curves.values())).errors)
    rows = []
    for mask, curve in curves.items():
        for index, rms in enumerate(curve.rms):
            rows.append(
                [
                    f"{mask}, {MASKS[mask][0].diameter:g} λ/D",
                    f"{rms:g}",
                    *(_count(curve, name, threshold, index) for name in names),
                ]
            )
    return Table(["mask", "input (rad rms)", *(method_look(name).name for name in names)], rows)


def claims(
    curves: Mapping[float, DiameterCurves],
    limits: DimpleLimits,
    masks: Mapping[str, RecoveryCurves],
    threshold: float,
    settings: Mapping[str, float],
) -> None:
    """Glue the settings and the numbers of the text, with the failing points at the first input."""
    first = next(iter(curves.values()))
    usual, large, ring = (_index(limits, diameter) for diameter in (USUAL, LARGE, DARK_RING))
    tilt, others, total = map(_screens, (limits.tilt, limits.others, limits.total))
    ends = [crossing(limits.diameters, row, 1.0) for row in limits.factor.T]
    shares = {
        f"{short}_{end}": pick(pick(curve.recovered(name, threshold)) for curve in masks.values())
        for short, name in (("plain", "PhaseShifted"), ("likely", LIKELY))
        for end, pick in (("least", min), ("most", max))
    }
    numbers: dict[str, Any] = dict(settings) | {
        "n_screens": first.errors[LIKELY].shape[1],
        "first_input": first.rms[0],
        "last_input": list(curves)[-1],
        "largest": first.diameters[-1],
        "smallest": first.diameters[0],
        "plain_fails": _fails(first, "PhaseShifted", threshold)[1],
        "accelerated_fails": _fails(first, "PhaseShiftedAccelerated", threshold)[1],
        "likely_share": min(curve.recovered(LIKELY, threshold).min() for curve in curves.values()),
        "factor_flat": ends[0],
        "factor_screens_least": min(ends[1:]),
        "factor_screens_most": max(ends[1:]),
        "tilt_flat_ring": limits.tilt[ring, 0],
        "others_flat_ring": limits.others[ring, 0],
        "tilt_screens_most": tilt.max(),
        "tilt_usual": tilt[usual],
        "others_usual": others[usual],
        "others_large": others[large],
        "total_usual": total[usual],
        "total_large": total[large],
        "recovered_large": _share(first, "PhaseShifted", LARGE, threshold),
        **{f"masks_{name}": value for name, value in shares.items()},
    }
    glue_numbers(numbers, ".4g")


def _index(limits: DimpleLimits, diameter: float) -> int:
    return int(np.argmin(np.abs(limits.diameters - diameter)))


def _screens(values: NDArray) -> NDArray[np.float64]:
    """Rms over the screens, without the flat wavefront, of (n_diameters, 1 + n_screens)."""
    return np.sqrt(np.mean(values[:, 1:] ** 2, axis=1))


def _count(curve: RecoveryCurves, name: str, threshold: float, index: int) -> str:
    n_screens = curve.errors[name].shape[1]
    return f"{round(n_screens * curve.recovered(name, threshold)[index])} of {n_screens}"


def _share(curve: DiameterCurves, name: str, diameter: float, threshold: float) -> float:
    return float(curve.recovered(name, threshold)[np.argmin(np.abs(curve.diameters - diameter))])
