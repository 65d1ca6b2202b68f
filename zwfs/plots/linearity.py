"""Figures of section 4.1: error against input, convergence, and single estimates."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from zwfs.metrics import wrapped_residual
from zwfs.paper.linearity import LinearityCurves
from zwfs.plots.style import ALONE, LOOKS, _looks, show_phase
from zwfs.pupil import Pupil
from zwfs.reconstructors import GerchbergSaxton

# Look and title of the variants of Gerchberg-Saxton, by what they do where nothing is measured.
_UNMEASURED = {
    "zero": ("GerchbergSaxton", "zero where not measured"),
    "model": ("GerchbergSaxtonModel", "modelled field kept"),
}


def linearity(curves: LinearityCurves, threshold: float, names: Sequence[str], rms_max: float) -> Figure:
    """Figure 3: mean error and its standard deviation against the input, and their ratio on a logarithmic axis.

    Parameters
    ----------
    curves : LinearityCurves
    threshold : float
        Ratio of error to input that is marked.
    names : sequence of str
        Curves to draw.
    rms_max : float, radian rms
        End of the first axis; the second has all inputs.
    """
    figure, (plain, ratio) = plt.subplots(1, 2, figsize=(7, 4.6))
    drawn = curves.rms <= rms_max
    bright = curves.rms > 0
    rms = curves.rms[drawn]
    limits = {name: curves.dynamic_range(name, threshold) for name in names}
    for name, look in _looks(names):
        mean, std = curves.mean(name), curves.std(name)[drawn]
        line = {"color": look.color, "marker": look.marker, "linestyle": look.line, "markersize": 4}
        limit = limits[name]
        reach = f": {limit:.2g} rad" if 0 < limit <= curves.rms[-1] else ""
        plain.plot(rms, mean[drawn], label=look.label + reach, **line)
        low, high = np.maximum(mean[drawn] - std, 0), mean[drawn] + std
        plain.fill_between(rms, low, high, color=look.color, alpha=0.15, lw=0)
        ratio.semilogy(curves.rms[bright], mean[bright] / curves.rms[bright], **line)
        if 0 < limit <= curves.rms[-1]:
            ratio.plot(limit, threshold, "o", mfc="none", mec=look.color, mew=1.8, ms=10, zorder=5)
    plain.plot(rms, threshold * rms, color="#555555", lw=1)
    plain.annotate(
        f"{threshold:.0%}", (rms[-1], threshold * rms[-1]), (4, 0), textcoords="offset points", color="#555555",
        fontsize=9, va="center",
    )  # fmt: skip
    ratio.axhline(threshold, color="#555555", lw=1)
    end = ratio.get_yaxis_transform()  # the right end of the line, which no curve crosses
    ratio.text(
        1.02, threshold, f"{threshold:.0%}\nof the\ninput", transform=end, color="#555555", fontsize=9, va="center"
    )
    plain.set(xlabel="input phase (rad rms)", ylabel="error (rad rms)", xlim=(0, None), ylim=(0, None))
    ratio.set(xlabel="input phase (rad rms)", ylabel="error / input", xlim=(0, None))
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    return figure


def saxton_widths(variants: Mapping[str, GerchbergSaxton], curves: LinearityCurves, threshold: float) -> Figure:
    """Mean error over the input of Gerchberg-Saxton on detectors of several widths, and of the linear method.

    Parameters
    ----------
    variants : mapping of str to GerchbergSaxton
    curves : LinearityCurves
        Of the variants and "Linear".
    threshold : float
        Ratio of error to input that is marked.
    """
    figure, panels = plt.subplots(1, 2, figsize=(7, 4.2), sharex=True)
    for axes, (kind, (family, title)) in zip(panels, _UNMEASURED.items(), strict=True):
        drawn = {name: method for name, method in variants.items() if method.unmeasured == kind}
        colors = _shades(LOOKS[family].color, len(drawn))
        for (name, method), color, line in zip(drawn.items(), colors, cycle(("-", "-.", "--", ":")), strict=False):
            ratio = curves.mean(name) / curves.rms
            axes.semilogy(curves.rms, ratio, **LOOKS[family].style | {"color": color, "linestyle": line})
            text, place = _variant_label(method)
            axes.annotate(text, (curves.rms[0], ratio[0]), textcoords="offset points", fontsize=9, **place)
        [linear] = axes.plot(curves.rms, curves.mean("Linear") / curves.rms, **LOOKS["Linear"].style)
        axes.axhline(threshold, color="#555555", lw=1)
        axes.set(xlabel="input phase (rad rms)", xlim=(0, None))
        axes.set_title(title, fontsize=10)
    zero, model = panels
    zero.set(ylabel="error / input", ylim=(threshold / 2, None))
    style: dict[str, Any] = {"color": "#555555", "fontsize": 9, "ha": "right", "va": "top"}
    line = f"{threshold:.0%} of the input"
    zero.text(0.99, 0.9 * threshold, line, transform=zero.get_yaxis_transform(), **style)
    model.set_ylim(bottom=model.get_ylim()[0] / 4)  # room for the labels
    figure.legend([linear], ["linear"], loc="outside lower center", fontsize=9)
    return figure


def _variant_label(method: GerchbergSaxton) -> tuple[str, dict[str, Any]]:
    """What distinguishes a variant from the others in its panel, and where to write it at the first point."""
    if method.unmeasured == "zero":
        return f"{method.sensor.extent:g} D", {"xytext": (-7, 0), "ha": "right", "va": "center"}
    return f"{method.settings.n_iterations} iterations", {"xytext": (6, -11), "va": "top"}


def _shades(color: str, count: int) -> list[tuple[float, ...]]:
    """Return shades of a colour, from dark to light."""
    ends = LinearSegmentedColormap.from_list("shades", ["black", color, "white"])
    return [ends(level) for level in np.linspace(0.3, 0.65, count)] if count != 1 else [to_rgba(color)]


def convergence(errors: Mapping[str, Mapping[float, NDArray]]) -> Figure:
    """Error against iteration, one panel for each input.

    Parameters
    ----------
    errors : mapping of method to mapping of input rms to ndarray, shape (n_screens, n_iterations + 1), radian rms
        A method without iterations has two columns: before and after.
    """
    inputs = list(next(iter(errors.values())))
    figure, panels = plt.subplots(1, len(inputs), figsize=(7.2, 4.2), sharey=True, squeeze=False)
    for axes, value in zip(panels[0], inputs, strict=True):
        for name, look in _looks(errors):
            middle, low, high = (np.quantile(errors[name][value], q, axis=0) for q in (0.5, 0.1, 0.9))
            if middle.size == 2:
                axes.axhline(middle[1], color=look.color, linestyle=look.line, label=look.label)
                continue
            steps = np.arange(middle.size)
            axes.semilogy(
                steps, middle, color=look.color, linestyle=look.line, marker=look.marker, ms=3.5, label=look.label
            )
            axes.fill_between(steps, low, high, color=look.color, alpha=0.15, lw=0)
        axes.set(xlabel="iteration", title=f"input {value:g} rad")
        axes.xaxis.get_major_locator().set_params(integer=True)
    panels[0, 0].set_ylabel("error (rad rms)")
    panels[0, 0].set_ylim(3e-8, 2)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def estimates(pupil: Pupil, truth: NDArray, phases: Mapping[str, NDArray]) -> Figure:
    """One screen, the phase (radian) that each method estimates, and the residual, on a scale four times finer."""
    truth = np.where(pupil.inside, truth, np.nan)
    limit = np.nanmax(np.abs(truth))
    figure, panels = plt.subplots(2, len(phases) + 1, figsize=(7.2, 4.6))
    image = show_phase(panels[0, 0], truth, limit)
    panels[0, 0].set_title("input", fontsize=9)
    panels[0, 0].set_gid(ALONE)
    panels[1, 0].remove()
    panels[1, 1].set_ylabel("residual")
    for column, (name, look) in enumerate(_looks(phases), start=1):
        residual = wrapped_residual(pupil, phases[name], truth)
        show_phase(panels[0, column], phases[name], limit)
        shown = show_phase(panels[1, column], residual, limit / 4)
        short, rms = textwrap.fill(look.name, 10), np.sqrt(np.nanmean(residual**2))
        panels[0, column].set_title(short, fontsize=9)
        panels[1, column].set_title(f"{short}\n{_short(rms)} rad", fontsize=9)
    below: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "aspect": 40}
    figure.colorbar(image, ax=panels[0], label="phase (rad)", **below)
    figure.colorbar(shown, ax=list(panels[1, 1:]), label="residual (rad)", extend="both", **below)
    return figure


def _short(value: float) -> str:
    """Two digits, or a bound where the digits would be those of rounding errors."""
    return f"{value:.2g}" if value >= 1e-6 else "< $10^{-6}$"
