"""Figure 9: errors on the bench against the input, and the inputs up to which each reconstructor can be used."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.bench import BenchCurves, check_bench
from studies.kit.curves import percent
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.style import LOOKS
from studies.kit.tables import Table, Text

LIMITS = parameter_limits(
    "rms_max n_rms rms_fine n_screens exponent n_iterations",
    n_pixels=(32, 1024),
    extent=(1.0, 4.0),
    poke=(0.001, 1.5),
    bench=bench_fields("n_pixels", "extent"),
)
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68, "n_rms": 5, "n_screens": 2}

SHORT = {"linear": "Linear", "shifted": "PhaseShifted", "saxton": "GerchbergSaxton"}
"""Reconstructors by their names in the text."""

_SHARE = 0.25  # of the input: the largest error of a reconstructor that works on the bench


def reach(curves: BenchCurves, name: str) -> float:
    """Return the largest input of `_within`, rad rms, or 0."""
    return float(_within(curves, name).max(initial=0.0))


def _within(curves: BenchCurves, name: str) -> NDArray[np.floating]:
    """Return the inputs (rad rms) at which the mean error is at most `_SHARE` of the input, without 0."""
    return curves.rms[(curves.rms > 0) & (curves.mean(name) <= _SHARE * curves.rms)]


def draw_bench_linearity(curves: BenchCurves) -> Figure:
    """Figure 9: error of the segments against the input, and the gain, estimated over commanded pistons."""
    figure, (plain, gain) = plt.subplots(1, 2, figsize=(7, 4.4))
    for name in curves.residuals:
        look, mean, std = LOOKS[name], curves.mean(name), curves.std(name)
        plain.plot(curves.rms, mean, markersize=4, label=look.label, **look.style)
        low, high = np.maximum(mean - std, 0), mean + std
        plain.fill_between(
            curves.rms, low, high, color=look.color, alpha=0.15, lw=0, label=f"_{look.label}, scatter"
        )
        gain.plot(curves.rms, curves.gain(name), markersize=4, label=f"_{look.label}", **look.style)
    plain.plot(
        curves.rms, _SHARE * curves.rms, color="#555555", lw=1, ls=":", label=f"{percent(_SHARE)} of the input"
    )
    gain.axhline(1, color="#555555", lw=1)
    plain.set(xlabel="input (rad rms over the segments)", ylabel="error (rad rms)", xlim=(0, None), ylim=(0, None))
    gain.set(xlabel="input (rad rms over the segments)", ylabel="gain")
    gain.set(xlim=(0, None), ylim=(0, 1.5))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, columnspacing=1.0, handletextpad=0.5)
    return figure


def reach_table(curves: BenchCurves) -> Table:
    """Error at a flat command, inputs with a small relative error, and gain of each reconstructor."""
    smallest = np.flatnonzero(curves.rms > 0)[0]
    header = [
        "reconstructor",
        "error at a flat command (rad rms)",
        "inputs with an error ≤ 25 % (rad rms)",
        "gain, smallest input",
    ]
    rows = [
        [
            LOOKS[name].name,
            f"{curves.mean(name)[0]:.2g}",
            _span(_within(curves, name), curves.rms.max()),
            float(curves.gain(name)[smallest]),
        ]
        for name in curves.residuals
    ]
    return Table(header, rows)


def _span(inputs: NDArray, largest: float) -> str:
    """Smallest and largest of some inputs, in words; the largest one that was tried is a bound."""
    if not inputs.size:
        return "none"
    return f"{inputs[0]:g} to {'≥ ' if inputs[-1] == largest else ''}{inputs[-1]:g}"


def findings(curves: BenchCurves) -> Text:
    """Say up to which inputs the methods can be used."""
    mean = {short: curves.mean(name) for short, name in SHORT.items()}
    largest, limit = curves.rms.max(), reach(curves, "Linear")
    text = (
        "On the simulated bench the mean error of the phase-shifted iteration is at most "
        f"{mean['shifted'].max():.2g} rad rms for all inputs up to {largest:.3g} rad rms."
    )
    if limit:
        text += (
            f" The error of the linear method is below {percent(_SHARE)} of the input up to {limit:.2g} rad rms."
        )
    else:
        text += f" The error of the linear method exceeds {percent(_SHARE)} of every input."
    for short, label in (("shifted", "The iteration"), ("saxton", "Gerchberg-Saxton")):
        worse = curves.rms[(curves.rms > 0) & (mean[short] > mean["linear"])]
        if worse.size:
            text += f" {label} has a larger error than the linear method up to {worse.max():.2g} rad rms."
    return Text(text)


def numbers(curves: BenchCurves) -> dict[str, float | str]:
    """Numbers for the claims: offset and reach of the reconstructors, and how they compare."""
    shifted, large = curves.mean("PhaseShifted"), curves.rms >= 0.3
    alike = curves.mean("Arcsine")[large] / curves.mean("Linear")[large]
    return rounded(
        {
            "offset_shifted": shifted[0],
            "arcsine_over_linear": round(np.median(alike), 3) if alike.size else np.nan,
            **{f"reach_{short}": reach(curves, name) for short, name in SHORT.items()},
            "lowest_shifted": next(iter(_within(curves, SHORT["shifted"])), np.nan),
            "largest_input": curves.rms.max(),
            "shifted_share_at_01": next(iter(shifted[curves.rms == 0.1]), np.nan) / 0.1,
        }
    )
