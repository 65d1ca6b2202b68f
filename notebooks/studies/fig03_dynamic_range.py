"""Figure 3, section 4.1 of the paper: errors of the reconstructors on random screens, their causes and cost."""

from __future__ import annotations

import cProfile
import pstats
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.curves import Limit, percent, refined_limit
from studies.kit.experiments import LinearityCurves, linearity_curves
from studies.kit.parameters import SETUP, parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import Screens, check_setup
from studies.kit.style import LOOKS, TALL, looks_of
from studies.kit.tables import Table, Text, small, two_digits
from zwfs.reconstructors import GerchbergSaxton
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes diameter phase_shift rms_max n_rms rms_fine n_screens exponent n_iterations extent "
    "threshold",
    steeper=(-6.0, 0.0),
    rms_beyond=[(0.0, 4.0), ...],
    extents=[(1.0, 8.0)],
    **SETUP,
)
CHECK_TOGETHER = check_setup
QUICK = {"n_pixels": 64, "n_rms": 6, "rms_fine": [0.05], "rms_beyond": [1.6, 2.0], "n_screens": 4}

STATED = {"Arcsine": 0.3, "PhaseShifted": 1.0}
"""Limits of two methods in the text of section 4.1, about, rad rms."""
_PASSES = ("split_expand", "split_adjoint")  # functions that pass through the low-rank model of the sensor


def curves_at(
    rms: float,
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    curves: LinearityCurves,
    **settings: Any,
) -> LinearityCurves:
    """Errors of further reconstructors on the screens of `curves` whose input is nearest to `rms`."""
    place = _nearest(curves, rms)
    n_screens = curves.strehl.shape[1]
    return linearity_curves(reconstructors, modes, curves.rms[[place]], n_screens, first_task=place, **settings)


def _nearest(curves: LinearityCurves, rms: float) -> int:
    """Place of the input nearest to `rms`: text on it names the sampled input."""
    return int(np.argmin(np.abs(curves.rms - rms)))


# Methods whose limits are refined, with the screens of each input close to the limit, over those of the curves.
REFINED = {
    "Linear": 3,
    "Arcsine": 3,
    "PhaseShifted": 3,
    "GerchbergSaxtonModel": 1,
    "GradientDescent": 0.5,
}


def error_limits(
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    curves: LinearityCurves,
    threshold: float,
    more: Mapping[str, float] = REFINED,
    **settings: Any,
) -> dict[str, Limit]:
    """Input at which each mean error exceeds `threshold` times the input; those of `more` from other screens.

    `more` gives the screens of each input close to the limit, over those of the curves.
    """
    limits = {name: Limit(curves.dynamic_range(name, threshold)) for name in curves.errors}

    def refined(name: str) -> Limit:
        method, n_screens = {name: reconstructors[name]}, max(1, round(more[name] * curves.strehl.shape[1]))

        def ratios(rms: NDArray) -> NDArray:
            tried = linearity_curves(method, modes, rms, n_screens, first_task=1000, **settings)
            return tried.errors[name] / rms[:, np.newaxis]

        return refined_limit(ratios, limits[name].value, threshold, width=0.15)

    finite = [name for name, limit in limits.items() if 0 < limit.value < np.inf]
    return limits | {name: refined(name) for name in finite if name in more}


AUTHORS = "authors' code"


class SaxtonOfEachImage:
    """Gerchberg-Saxton of each of two images alone, with zero field where nothing is measured, then combined.

    Each phase gives a reference wave and the cosine of the angle to it; `eq-phase-shifted` combines both cosines.
    The authors' public code does so.
    """

    def __init__(self, sensor: ZernikeSensor, n_iterations: int) -> None:
        self.sensor = sensor
        alone = [ZernikeSensor(sensor.pupil, mask, extent=sensor.extent) for mask in sensor.masks]
        self._methods = [GerchbergSaxton(image, n_iterations=n_iterations) for image in alone]

    def __call__(self, frames: NDArray) -> SimpleNamespace:
        pupil, angles, cosines = self.sensor.pupil, [], []
        for index, method in enumerate(self._methods):
            phase = np.nan_to_num(method(frames[..., [index], :, :]).phase)
            waves = method.sensor.reference_wave(pupil.amplitude * np.exp(1j * phase))
            angles.append(np.angle(waves[..., 0, :, :][(..., *method.sensor.window)]))
            cosines.append(np.cos(phase - angles[-1]))
        (unit, second_unit), (cosine, second_cosine) = np.exp(1j * np.array(angles)), cosines
        phasor = 1j * (second_cosine * unit - cosine * second_unit) / np.imag(second_unit * unit.conj())
        return SimpleNamespace(phase=np.angle(phasor), converged=np.ones(frames.shape[:-3], bool))


def saxton_by_width(
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    extents: Sequence[float],
    n_screens: int,
    **settings: Any,
) -> tuple[dict[str, GerchbergSaxton], LinearityCurves]:
    """Error of variants of Gerchberg-Saxton on detectors of several widths (D), and of the linear method."""
    original = reconstructors["GerchbergSaxton"]
    sensor, n_iterations = original.sensor, original.settings.n_iterations
    chosen = [(extent, "zero", n_iterations) for extent in extents]
    chosen += [(min(extents), "model", n) for n in (n_iterations, 8 * n_iterations)]
    variants = {
        f"{extent:g} D, {unmeasured}, {n}": GerchbergSaxton(
            ZernikeSensor(sensor.pupil, *sensor.masks, extent=extent), n_iterations=n, unmeasured=unmeasured
        )
        for extent, unmeasured, n in chosen
    }
    methods = {"Linear": reconstructors["Linear"], AUTHORS: SaxtonOfEachImage(sensor, n_iterations), **variants}
    inputs = [0.1, 0.2, 0.3, 0.5, 0.8]
    return variants, linearity_curves(methods, modes, inputs, n_screens, **settings)


def light_lost(sensor: ZernikeSensor) -> float:
    """Fraction of the light of a flat wavefront that misses the detector behind the first mask."""
    return 1 - float(sensor.measure(np.zeros(sensor.pupil.shape))[0].sum()) / sensor.pupil.n_points


def count_work(reconstructors: Mapping[str, Any], phase: NDArray) -> tuple[dict[str, int], set[str]]:
    """Passes of each reconstructor through the model of the sensor, and the Fourier functions that it calls."""
    passes, fourier = {}, set()
    for name, reconstructor in reconstructors.items():
        frames = reconstructor.sensor.measure(phase)
        reconstructor(frames)  # the first call also builds what later calls use again
        profile = cProfile.Profile()
        profile.runcall(reconstructor, frames)
        calls = pstats.Stats(profile).stats  # type: ignore[attr-defined]
        places = {place: f"{place[0]}:{place[2]}" for place in calls}
        fourier |= {text for text in places.values() if "fft" in text}
        passes[name] = sum(calls[place][1] for place in places if place[2] in _PASSES)
    return passes, fourier


# Look, title, dashes and markers of the variants of Gerchberg-Saxton, by what they do where nothing is measured.
_UNMEASURED = {
    "zero": ("GerchbergSaxton", "zero where not measured", ("-", "-.", "--", ":"), "^<v>"),
    "model": ("GerchbergSaxtonModel", "modelled field, {:g} D", ("-", "--"), "x+"),
}


def draw_linearity(curves: LinearityCurves, threshold: float, rms_max: float) -> Figure:
    """Figure 3: mean error and its standard deviation against the input."""
    figure, axes = plt.subplots(figsize=(7, 4.6))
    drawn = curves.rms <= rms_max
    rms = curves.rms[drawn]
    ends = []
    for name, look in looks_of(curves.errors):
        mean, std = curves.mean(name)[drawn], curves.std(name)[drawn]
        axes.plot(rms, mean, label=look.label, ms=4, **look.style)
        scatter = f"_{look.label}, scatter"
        axes.fill_between(
            rms, np.maximum(mean - std, 0), mean + std, color=look.color, alpha=0.15, lw=0, label=scatter
        )
        ends.append((float(mean[-1]), textwrap.fill(look.label, 22), look.style))
    axes.plot(rms, threshold * rms, color="#555555", lw=1)
    ends.append((threshold * rms[-1], f"{percent(threshold)} of the input", {"color": "#555555", "marker": ""}))
    axes.set(xlabel="input phase (rad rms)", ylabel="error (rad rms)", xlim=(-0.03, None), ylim=(-0.03, None))
    _label_ends(axes, ends)
    axes.set_gid(TALL)
    return figure


_LINE = 0.05  # height of a line of a label, over that of the axes


def _label_ends(axes: Axes, ends: list[tuple[float, str, dict[str, Any]]]) -> None:
    """Write the labels of curves next to their right ends, (height, text, style) each, without an overlap."""
    low, high = axes.get_ylim()
    ends.sort(key=lambda end: end[0])
    heights = [_LINE * (1.3 + text.count("\n")) for _, text, _ in ends]
    lowest = 0.0
    for number, (value, text, style) in enumerate(ends):
        half = heights[number] / 2
        room = 1 - sum(heights[number:]) + half  # else those above would leave the axes
        middle = max(lowest + half, min((value - low) / (high - low), room))
        axes.plot(1.03, middle, ms=5, transform=axes.transAxes, clip_on=False, **style)
        options: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "center"}
        axes.annotate(text, (1.03, middle), (6, 0), fontsize=9, **options)
        lowest = middle + half


def draw_ratios(curves: LinearityCurves, limits: Mapping[str, Limit], threshold: float) -> Figure:
    """Mean error over the input on a logarithmic axis, and where it reaches the threshold."""
    figure, axes = plt.subplots(figsize=(7, 4.6))
    bright = curves.rms > 0
    for name, look in looks_of(curves.errors):
        axes.semilogy(
            curves.rms[bright],
            curves.mean(name)[bright] / curves.rms[bright],
            label=look.label,
            ms=4,
            **look.style,
        )
        if 0 < limits[name].value < np.inf:
            axes.plot(limits[name].value, threshold, "o", mfc="none", mec=look.color, mew=1.8, ms=10, zorder=5)
        if name in STATED:
            axes.plot(STATED[name], threshold, "*", color=look.color, mec="white", ms=15, zorder=6)
    axes.axhline(threshold, color="#555555", lw=1)
    end = axes.get_yaxis_transform()  # the right end of the line, which no curve crosses
    axes.text(1.01, threshold, percent(threshold), transform=end, color="#555555", fontsize=9, va="center")
    axes.set(xlabel="input phase (rad rms)", ylabel="error / input", xlim=(0, None))
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, columnspacing=1)
    return figure


def draw_saxton_widths(
    variants: Mapping[str, GerchbergSaxton], curves: LinearityCurves, threshold: float
) -> Figure:
    """Mean error over the input of Gerchberg-Saxton on detectors of several widths, and of the linear method."""
    figure, panels = plt.subplots(1, 2, figsize=(7, 4.2), sharex=True, sharey=True)
    for axes, (kind, (family, title, *lines)) in zip(panels, _UNMEASURED.items(), strict=True):
        drawn = {name: method for name, method in variants.items() if method.unmeasured == kind}
        colors = _shades(LOOKS[family].color, len(drawn))
        for (name, method), color, line, marker in zip(drawn.items(), colors, *map(cycle, lines), strict=False):
            ratio = curves.mean(name) / curves.rms
            label = f"{method.settings.n_iterations} iterations"
            if kind == "zero":
                place: dict[str, Any] = {"xytext": (-7, 0), "textcoords": "offset points", "va": "center"}
                text = f"{method.sensor.extent:g} D"
                label = f"{text}, {label}"
                axes.annotate(text, (curves.rms[0], ratio[0]), color="#333333", fontsize=9, ha="right", **place)
            axes.semilogy(curves.rms, ratio, color=color, linestyle=line, marker=marker, label=label)
        axes.plot(curves.rms, curves.mean("Linear") / curves.rms, label="linear", **LOOKS["Linear"].style)
        axes.axhline(threshold, color="#555555", lw=1)
        axes.set(xlabel="input phase (rad rms)", xlim=(0, None))
        axes.set_title(title.format(method.sensor.extent), fontsize=10)
    zero, model = panels
    zero.set_ylabel("error / input")
    own: dict[str, Any] = {"color": "#333333", "linestyle": (0, (1, 1)), "marker": "D", "ms": 4}
    zero.semilogy(curves.rms, curves.mean(AUTHORS) / curves.rms, label="each image alone", **own)
    zero.legend(handles=zero.get_lines()[-1:], loc="upper right", fontsize=9)
    model.legend(loc="lower right", fontsize=9)
    style: dict[str, Any] = {"color": "#555555", "fontsize": 9, "ha": "right", "va": "top"}
    line = f"{percent(threshold)} of the input"
    zero.text(0.99, 0.9 * threshold, line, transform=zero.get_yaxis_transform(), **style)
    return figure


def _shades(color: str, count: int) -> list[tuple[float, ...]]:
    """Return shades of a colour, from dark to light."""
    ends = LinearSegmentedColormap.from_list("shades", ["black", color, "white"])
    return [ends(level) for level in np.linspace(0.3, 0.65, count)] if count != 1 else [to_rgba(color)]


# The methods with one image, and Gerchberg-Saxton: no candidates for a long range.
_SHORT_RANGE = ("Linear", "Arcsine", "GerchbergSaxton", "GerchbergSaxtonModel")


def _indices(curves: LinearityCurves, values: Sequence[float]) -> dict[float, int]:
    """Index of each of these inputs that the curves have."""
    return {value: int(np.flatnonzero(curves.rms == value)[0]) for value in values if value in curves.rms}


def _place(curves: LinearityCurves, limit: Limit) -> str:
    """Input at which a curve exceeds the threshold, in words."""
    if limit.value == 0:
        return "at all inputs"
    return str(limit) if limit.value < np.inf else f"beyond {curves.rms[-1]:g}"


def ranges_table(curves: LinearityCurves, limits: Mapping[str, Limit], threshold: float) -> Table:
    """Limit of each reconstructor, and its error at some inputs."""
    at = _indices(curves, (0.1, 0.3, 0.5, 0.8, 1.0, 1.3))
    return Table(
        [
            "reconstructor",
            f"exceeds {percent(threshold)} above (rad rms)",
            *(f"error at {value:g}" for value in at),
        ],
        [
            [
                LOOKS[name].name,
                _place(curves, limits[name]),
                *(small(curves.mean(name)[index]) for index in at.values()),
            ]
            for name in curves.errors
        ],
    )


def one_image_table(curves: LinearityCurves) -> Table:
    """Errors of the methods that use one image, and the points that an arcsine folds back."""
    return Table(
        ["input (rad rms)", "error / input, linear", "error / input, arcsine", "points below −π/4"],
        [
            [
                value,
                *(f"{curves.mean(name)[index] / value:.1%}" for name in ("Linear", "Arcsine")),
                f"{curves.folded[index].mean():.2%}",
            ]
            for value, index in _indices(curves, (0.1, 0.2, 0.3, 0.4, 0.5)).items()
        ],
    )


def two_images_table(curves: LinearityCurves, threshold: float) -> Table:
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


def work_table(passes: Mapping[str, int]) -> Table:
    """Passes through the model of the sensor, see `count_work`."""
    return Table(
        ["reconstructor", "passes through the model"], [[LOOKS[name].name, n] for name, n in passes.items()]
    )


def _reach(curves: LinearityCurves, limit: Limit) -> str:
    """Inputs up to which an error stays within the threshold, in words."""
    if limit.value == 0:
        return "at no input"
    return f"up to {two_digits(min(limit.value, curves.rms[-1]))} rad rms" + (
        "" if np.isfinite(limit.value) else ", the largest input"
    )


def findings(curves: LinearityCurves, limits: Mapping[str, Limit], threshold: float) -> Text:
    """Return the ranges of the linear method and of the phase-shifted iteration."""
    linear, shifted = limits["Linear"], limits["PhaseShifted"]
    ratio = shifted.over(linear).value
    further = f", {two_digits(ratio)} times as far" if 0 < ratio < np.inf else ""
    return Text(
        f"**With one image, the mean error of the linear method stays within {percent(threshold)} of the input "
        f"{_reach(curves, linear)}. With two images, that of the phase-shifted iteration does so "
        f"{_reach(curves, shifted)}{further}.**"
    )


def findings_one_image(curves: LinearityCurves) -> Text:
    """Return up to where the arcsine has a smaller error than the linear method."""
    bright = curves.rms > 0
    better = np.logical_and.accumulate(curves.mean("Arcsine")[bright] < curves.mean("Linear")[bright])
    if not better[0]:
        return Text("The arcsine has no smaller error than the linear method at the smallest input.")
    last = curves.rms[bright][better][-1]
    return Text(f"The arcsine has a smaller mean error than the linear method up to {last:.3g} rad rms.")


def findings_two_images(curves: LinearityCurves, descents: LinearityCurves, threshold: float) -> Text:
    """Return the shares of recovered screens at the input nearest to 1 rad rms, and where phases wrap."""
    place, onset = _nearest(curves, 1.0), _wrap_onset(curves)
    shifted, modes = (curves.recovered(name, threshold)[place] for name in ("PhaseShifted", "GradientDescent"))
    points = descents.recovered("GradientDescentPoints", threshold)[0]
    wraps = f"from {onset:.3g} rad rms on" if np.isfinite(onset) else "at no input"
    return Text(
        f"At {curves.rms[place]:.3g} rad rms, the iteration recovers {shifted:.0%} of the screens, gradient "
        f"descent on modes {modes:.0%}, and gradient descent with the phase of each point as an unknown "
        f"{points:.0%}. At least half of the screens have phase wraps, points beyond ±π, {wraps}."
    )


def findings_saxton(
    by_width: LinearityCurves, variants: Mapping[str, GerchbergSaxton], longer: Limit, threshold: float
) -> Text:
    """Return the lost light, the error at the smallest input, and the range with the modelled field."""
    *_, repaired = variants
    zeros = [
        f"{two_digits(by_width.mean(name)[0])} rad on a detector of {method.sensor.extent:g} D, which loses "
        f"{light_lost(method.sensor):.0%} of the light"
        for name, method in variants.items()
        if method.unmeasured == "zero"
    ]
    return Text(
        f"With zero field and {by_width.strehl.shape[1]} screens, the error at {by_width.rms[0]:g} rad rms is "
        f"{'; '.join(zeros)}. If each image is reconstructed alone, on the detector of Figure 3, it is "
        f"{two_digits(by_width.mean(AUTHORS)[0])} rad. "
        f"With the modelled field and {variants[repaired].settings.n_iterations} iterations, on a detector of "
        f"{variants[repaired].sensor.extent:g} D, the error stays within "
        f"{percent(threshold)} of the input {_reach(by_width, longer)}."
    )


def findings_work(passes: Mapping[str, int], reconstructors: Mapping[str, Any]) -> Text:
    """Return the passes of two methods, and the coefficients of the reference wave."""
    return Text(
        f"At 0.5 rad rms the phase-shifted iteration takes {passes['PhaseShifted']} passes, gradient descent on "
        f"modes {passes['GradientDescent']}. The reference wave has {reconstructors['PhaseShifted'].sensor.rank} "
        "coefficients."
    )


def findings_steep(curves: LinearityCurves, limits: Mapping[str, Limit], exponent: float) -> Text:
    """Return the ranges with another spectrum, for the linear method, the arcsine and the iteration."""
    linear, arcsine, shifted = (_reach(curves, limits[name]) for name in ("Linear", "Arcsine", "PhaseShifted"))
    return Text(
        f"With the exponent {exponent:.3g}, the linear method stays within the threshold {linear}, the arcsine "
        f"{arcsine}, and the iteration {shifted}."
    )


_SHORT = {
    "Linear": "linear",
    "Arcsine": "arcsine",
    "PhaseShifted": "shifted",
    "GerchbergSaxtonModel": "saxton_model",
    "GradientDescent": "descent",
}


def steep_numbers(curves: LinearityCurves, limits: Mapping[str, Limit]) -> dict[str, float | str]:
    """Limits of some methods with another spectrum, and the smallest input at which half of its screens wrap."""
    linear, arcsine, shifted = (limits[name] for name in ("Linear", "Arcsine", "PhaseShifted"))
    return rounded(
        {
            "steep_arcsine": arcsine.value,
            "steep_shifted": shifted.value,
            "steep_gain": shifted.over(linear).value,
            "steep_wrap_onset": _wrap_onset(curves),
        }
    )


def _alike_up_to(curves: LinearityCurves) -> float:
    """Largest input up to which the errors of the iteration and of descent on modes are below 1e-6 rad, or 0."""
    both = np.maximum(curves.mean("PhaseShifted"), curves.mean("GradientDescent")) < 1e-6
    return float(curves.rms[np.logical_and.accumulate(both)].max(initial=0))


def _wrap_onset(curves: LinearityCurves) -> float:
    """Smallest input at which half of the screens reach beyond +-pi, infinity if none does."""
    return float(curves.rms[np.mean(curves.wrapped > 0, axis=1) >= 0.5].min(initial=np.inf))


def numbers(
    curves: LinearityCurves,
    descents: LinearityCurves,
    limits: Mapping[str, Limit],
    threshold: float,
    methods: Mapping[str, Any],
    variants: Mapping[str, GerchbergSaxton],
    by_width: LinearityCurves,
    longer: Limit,
    passes: Mapping[str, int],
    fourier: set[str],
) -> dict[str, float | str]:
    """Numbers of the text and of the claims of section 4.1."""
    rms, mean = curves.rms, {name: curves.mean(name) for name in curves.errors}
    gain = limits["PhaseShifted"].over(limits["Linear"])
    *zeros, _, repaired = variants
    widest = max(zeros, key=lambda name: variants[name].sensor.extent)
    usual, wide = methods["GerchbergSaxton"].sensor, variants[widest].sensor
    tenth, half, full = (_nearest(curves, value) for value in (0.1, 0.5, 1.0))
    offset, offset_widest = mean["GerchbergSaxton"][tenth], by_width.mean(widest)[0]
    alike = _alike_up_to(curves)
    low = (rms > 0) & (rms <= 0.3)
    with_wraps = np.mean(curves.wrapped > 0, axis=1)
    recovered = {name: curves.recovered(name, threshold)[full] for name in curves.errors}
    recovered |= {name: descents.recovered(name, threshold)[0] for name in descents.errors}
    values: dict[str, Any] = {
        "n_screens": curves.strehl.shape[1],
        "saxton_limit": limits["GerchbergSaxton"].value,
        "gain": gain.value,
        "gain_over_arcsine": limits["PhaseShifted"].over(limits["Arcsine"]).value,
        "arcsine_over_linear": np.max(mean["Arcsine"][low] / mean["Linear"][low], initial=0),
        "arcsine_ratio_at_05": mean["Arcsine"][half] / rms[half],
        "alike_up_to": alike,
        "modes_recovered_at_1": recovered["GradientDescent"],
        "points_recovered_at_1": recovered["GradientDescentPoints"],
        "recovered_at_1": recovered["PhaseShifted"],
        "strehl_at_1": curves.strehl[full].mean(),
        "wrapped_screens_at_05": with_wraps[half],
        "wrapped_screens_at_1": with_wraps[full],
        "wrap_onset": _wrap_onset(curves),
        "saxton_extent": usual.extent,
        "saxton_iterations": methods["GerchbergSaxton"].settings.n_iterations,
        "saxton_error": offset,
        "saxton_error_at_05": mean["GerchbergSaxton"][half],
        "light_lost": light_lost(usual),
        "saxton_widest_extent": wide.extent,
        "saxton_widest_error": offset_widest,
        "light_lost_widest": light_lost(wide),
        "saxton_model_error": by_width.mean(repaired)[0],
        "saxton_model_iterations_longer": variants[repaired].settings.n_iterations,
        "shifted_passes": passes["PhaseShifted"],
        "descent_passes": passes["GradientDescent"],
        "fourier_functions": len(fourier),
        "rank": methods["PhaseShifted"].sensor.rank,
    }
    for name, short in _SHORT.items():
        values[f"{short}_limit"] = limits[name].value
    values["saxton_model_limit_longer"] = longer.value
    return rounded(values)
