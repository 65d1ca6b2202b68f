"""Figures of the calibrated bench: errors of the segments and differences of frames, before and after."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from zwfs.paper.bench_linearity import BenchCurves
from zwfs.paper.calibration import WAYS, Example
from zwfs.plots.style import LOOKS, show_intensity, show_phase

_LINES = {"design": ":", "design, less flat": "--", "calibrated": "-", "shuffled": "-."}
_ARMS = ("1 (+θ)", "2 (−θ)")


def _style(name: str) -> dict[str, Any]:
    """Keywords of a curve for `plot`; the model of the design has the colour of its reconstructor."""
    look = LOOKS["PhaseShifted"]
    color, marker = {"calibrated": ("#333333", "*"), "shuffled": ("#777777", "x")}.get(
        name, (look.color, look.marker)
    )
    hollow = {"markerfacecolor": "none"} if name == "design, less flat" else {}
    return {"color": color, "marker": marker, "linestyle": _LINES[name]} | hollow


def calibration_errors(curves: BenchCurves, example: Example, numbers: NDArray) -> Figure:
    """Error of the segments against the input, for each model, and the errors of one screen.

    Parameters
    ----------
    curves : BenchCurves
    example : Example
    numbers : ndarray of int, shape (n_segments,)
        Of the segments.
    """
    figure, (linearity, points) = plt.subplots(1, 2, figsize=(7, 4.6))
    for name, label in WAYS.items():
        style = _style(name)
        linearity.semilogy(curves.rms, curves.mean(name), ms=7, label=label, **style)
        if name != "shuffled":
            points.plot(numbers, example.residuals[name], **{**style, "linestyle": ""}, ms=6)
    linearity.set(xlabel="input (rad rms over the segments)", ylabel="error (rad rms)", xlim=(0, None))
    linearity.yaxis.set_major_locator(LogLocator())
    linearity.yaxis.set_minor_formatter(NullFormatter())
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(*linearity.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


def calibration_frames(example: Example) -> Figure:
    """Measured frames of one screen, and their differences from the frames of each model in units of the noise.

    The calibrated model has a finer scale.
    """
    titles = {"design": "model of\nthe design", "shuffled": "control", "calibrated": "calibrated\nmodel"}
    figure, panels = plt.subplots(2, 1 + len(titles), figsize=(7, 4.6))
    counts, sigma = example.measured
    misfits = {name: (counts - example.modelled[name]) / sigma for name in titles}
    limits = {name: float(np.quantile(np.abs(misfits[name]), 0.99)) for name in ("design", "calibrated")}
    for axes, image, arm in zip(panels[:, 0], counts / np.quantile(counts, 0.999), _ARMS, strict=True):
        light = show_intensity(axes, image, 1.0)
        axes.set_ylabel(f"image {arm}")
    shown = {}
    for column, (name, title) in zip(panels[:, 1:].T, titles.items(), strict=True):
        for axes, image in zip(column, misfits[name], strict=True):
            shown[name] = show_phase(axes, image, limits.get(name, limits["design"]))
        column[0].set_title(title, fontsize=10)
    panels[0, 0].set_title("measured", fontsize=10)
    bars: dict[str, Any] = {"location": "bottom", "shrink": 0.85}
    figure.colorbar(light, ax=panels[:, 0], label="intensity", aspect=12, **bars)
    misfit: dict[str, Any] = {"label": "misfit / noise", "extend": "both"} | bars
    figure.colorbar(shown["design"], ax=panels[:, 1:3], aspect=25, **misfit)
    figure.colorbar(shown["calibrated"], ax=panels[:, 3], aspect=12, **misfit)
    return figure
