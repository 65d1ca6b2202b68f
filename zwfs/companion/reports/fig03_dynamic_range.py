"""Figure 3: tables of the dynamic range, and the numbers of the claims of section 4.1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table, small
from zwfs.paper.linearity import LinearityCurves, light_lost
from zwfs.plots import LOOKS
from zwfs.reconstructors import GerchbergSaxton

# The methods with one image, and Gerchberg-Saxton: no candidates for a long range.
_SHORT_RANGE = ("Linear", "Arcsine", "GerchbergSaxton", "GerchbergSaxtonModel")


def _columns(curves: LinearityCurves, values: Sequence[float]) -> dict[float, int]:
    """Index of each of these inputs that the curves have."""
    return {value: int(np.flatnonzero(curves.rms == value)[0]) for value in values if value in curves.rms}


def _place(curves: LinearityCurves, name: str, threshold: float) -> str:
    """Input at which a curve exceeds the threshold, in words."""
    limit = curves.dynamic_range(name, threshold)
    if limit == 0:
        return "from the start"
    return f"{limit:.2g}" if limit < np.inf else f"beyond {curves.rms[-1]:g}"


def ranges(curves: LinearityCurves, threshold: float) -> Table:
    """Limit of each reconstructor, and its error at some inputs."""
    at = _columns(curves, (0.1, 0.3, 0.5, 0.8, 1.0, 1.3))
    return Table(
        ["reconstructor", f"exceeds {threshold:.0%} above (rad rms)", *(f"error at {value:g}" for value in at)],
        [
            [
                LOOKS[name].name,
                _place(curves, name, threshold),
                *(small(curves.mean(name)[index]) for index in at.values()),
            ]
            for name in curves.errors
        ],
    )


def one_image(curves: LinearityCurves) -> Table:
    """Errors of the methods that use one image, and the points that an arcsine folds back."""
    return Table(
        ["input (rad rms)", "error / input, linear", "error / input, arcsine", "points below −π/4"],
        [
            [
                value,
                *(f"{curves.mean(name)[index] / value:.1%}" for name in ("Linear", "Arcsine")),
                f"{curves.folded[index].mean():.2%}",
            ]
            for value, index in _columns(curves, (0.1, 0.2, 0.3, 0.4, 0.5)).items()
        ],
    )


def two_images(curves: LinearityCurves, threshold: float) -> Table:
    """Screens that the methods with two images recover, with the wraps and the Strehl ratio of the screens."""
    names = ["PhaseShifted", *(name for name in curves.errors if name not in (*_SHORT_RANGE, "PhaseShifted"))]
    return Table(
        ["input (rad rms)", *(LOOKS[name].name for name in names), "points beyond ±π", "Strehl"],
        [
            [
                float(value),
                *(f"{curves.recovered(name, threshold)[index]:.0%}" for name in names),
                f"{curves.wrapped[index].mean():.2%}",
                f"{curves.strehl[index].mean():.2f}",
            ]
            for index, value in enumerate(curves.rms)
            if value >= 0.5
        ],
    )


def width_columns(variants: Mapping[str, GerchbergSaxton], curves: LinearityCurves) -> dict[str, Any]:
    """Columns of the mean errors of Gerchberg-Saxton on each detector, and of the linear method."""
    names = {
        name: f"{method.sensor.extent:g} D, {method.unmeasured}, {method.settings.n_iterations} iterations"
        for name, method in variants.items()
    } | {"Linear": "linear"}
    return {"input (rad rms)": curves.rms} | {
        f"{title}: mean error (rad rms)": curves.mean(name) for name, title in names.items()
    }


def saxton(variants: Mapping[str, GerchbergSaxton], curves: LinearityCurves) -> Table:
    """Errors of Gerchberg-Saxton on each detector, next to those of the linear method, relative to the input."""
    shares = {name: [f"{ratio:.1%}" for ratio in curves.mean(name) / curves.rms] for name in curves.errors}
    return Table(
        [
            "detector (D)",
            "unmeasured field",
            "iterations",
            "light lost",
            *(f"{value:g} rad" for value in curves.rms),
        ],
        [
            [
                f"{method.sensor.extent:g}",
                method.unmeasured,
                method.settings.n_iterations,
                f"{light_lost(method.sensor):.0%}",
                *shares[name],
            ]
            for name, method in variants.items()
        ]
        + [["1 (linear)", "–", 1, "–", *shares["Linear"]]],
    )


def _better_from(curves: LinearityCurves, name: str) -> float:
    """Smallest input from which on a method has a smaller error than the linear one."""
    worse = curves.rms[curves.mean(name) >= curves.mean("Linear")]
    return float(curves.rms[curves.rms > worse.max(initial=0)].min(initial=np.inf))


def work(passes: Mapping[str, int]) -> Table:
    """Passes through the model of the sensor, see `zwfs.paper.linearity.count_work`."""
    return Table(
        ["reconstructor", "passes through the model"], [[LOOKS[name].name, n] for name, n in passes.items()]
    )


def claims(
    curves: LinearityCurves,
    threshold: float,
    methods: Mapping[str, Any],
    variants: Mapping[str, GerchbergSaxton],
    by_width: LinearityCurves,
    passes: Mapping[str, int],
    fourier: set[str],
    run_out: float,
) -> Table:
    """Glue the numbers of the claims of section 4.1, and show them."""
    rms, mean = curves.rms, {name: curves.mean(name) for name in curves.errors}
    limits = {name: curves.dynamic_range(name, threshold) for name in curves.errors}
    gain = limits["PhaseShifted"] / limits["Linear"] if limits["Linear"] else np.inf
    if limits["Linear"] == np.inf:
        gain = np.nan  # unknown: no input is past the range of the linear one
    *zeros, _, repaired = variants
    widest = max(zeros, key=lambda name: variants[name].sensor.extent)
    usual, wide = methods["GerchbergSaxton"].sensor, variants[widest].sensor
    tenth, half, one = (int(np.argmin(np.abs(rms - value))) for value in (0.1, 0.5, 1.0))
    offset, offset_widest = mean["GerchbergSaxton"][tenth], by_width.mean(widest)[0]
    alike = rms[np.maximum(mean["PhaseShifted"], mean["GradientDescent"]) < 1e-6].max(initial=0)
    low = (rms > 0) & (rms <= 0.3)
    with_wraps = np.mean(curves.wrapped > 0, axis=1)
    recovered = {name: curves.recovered(name, threshold)[one] for name in curves.errors}
    glue_numbers(
        {
            "linear_limit": limits["Linear"],
            "arcsine_limit": limits["Arcsine"],
            "descent_limit": limits["GradientDescent"],
            "saxton_limit": limits["GerchbergSaxton"],
            "shifted_limit": limits["PhaseShifted"],
            "gain": gain,
            "gain_arcsine": limits["PhaseShifted"] / limits["Arcsine"] if limits["Arcsine"] else np.inf,
            "arcsine_over_linear": np.max(mean["Arcsine"][low] / mean["Linear"][low], initial=0),
            "arcsine_ratio_at_05": mean["Arcsine"][half] / rms[half],
            "alike_up_to": alike,
            "modes_recovered_at_1": recovered["GradientDescent"],
            "points_recovered_at_1": recovered["GradientDescentPoints"],
            "recovered_at_1": recovered["PhaseShifted"],
            "strehl_at_1": curves.strehl[one].mean(),
            "strehl_at_limit": np.interp(limits["PhaseShifted"], rms, curves.strehl.mean(axis=1)),
            "wrapped_screens_at_05": with_wraps[half],
            "wrapped_screens_at_1": with_wraps[one],
            "wrap_onset": rms[with_wraps >= 0.5].min(initial=np.inf),
            "saxton_extent": usual.extent,
            "saxton_iterations": methods["GerchbergSaxton"].settings.n_iterations,
            "saxton_error": offset,
            "saxton_error_at_05": mean["GerchbergSaxton"][half],
            "light_lost": light_lost(usual),
            "saxton_widest_extent": wide.extent,
            "saxton_widest_error": offset_widest,
            "saxton_widest_beats_linear": _better_from(by_width, widest),
            "light_lost_widest": light_lost(wide),
            "saxton_model_error": by_width.mean(repaired)[0],
            "saxton_model_limit": limits["GerchbergSaxtonModel"],
            "saxton_model_limit_longer": by_width.dynamic_range(repaired, threshold),
            "saxton_model_iterations_longer": variants[repaired].settings.n_iterations,
            "started_limit": limits["GradientDescentStarted"],
            "started_recovered_at_1": recovered["GradientDescentStarted"],
            "started_error_at_1": mean["GradientDescentStarted"][one],
            "shifted_passes": passes["PhaseShifted"],
            "descent_passes": passes["GradientDescent"],
            "fourier_functions": len(fourier),
            "rank": methods["PhaseShifted"].sensor.rank,
        }
    )
    glue_numbers({"run_out": 10 ** np.ceil(np.log10(run_out))}, ".0e")  # the digits are those of rounding errors
    rows: list[list[Any]] = [
        [
            "7",
            "arcsine is better than linear up to 0.3 rad",
            bool(np.all(mean["Arcsine"][low] <= mean["Linear"][low])),
        ],
        ["7", "arcsine exceeds the threshold near 0.3 rad", _place(curves, "Arcsine", threshold)],
        ["8", "the range grows by more than ten times: by", f"{gain:.0f} times"],
        [
            "9",
            "the offset of Gerchberg-Saxton shrinks on wider detectors",
            bool(offset_widest < offset) if wide.extent > usual.extent else "no wider one",
        ],
        ["9", "and vanishes if the modelled field is kept", bool(by_width.mean(repaired)[0] < 1e-4)],
        ["10", "phase-shifted and gradient descent: both below 1e-6 rad up to", float(alike)],
        [
            "11",
            "screens with points beyond ±π at 0.5 and at 1 rad",
            f"{with_wraps[half]:.0%} and {with_wraps[one]:.0%}",
        ],
        ["12", "screens that phase-shifted recovers at 1 rad", f"{recovered['PhaseShifted']:.0%}"],
        ["13", "Fourier functions called by any reconstructor", len(fourier)],
    ]
    return Table(["claim", "what was looked at", "measured"], rows)
