"""Figures of frames of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zwfs.frames.pipeline import MeasuredPhase, Step
from zwfs.plots.style import OTHER_STYLES, show_intensity, show_phase

_BAD = "#FF00FF"  # not in the colour maps, and far from the colours of the methods


def explained(result: MeasuredPhase) -> Figure:
    """Measured frames, modelled frames and their difference, all on one scale; bad pixels are marked."""
    figure, panels = plt.subplots(2, 3, figsize=(9, 5.6))
    top = np.quantile(result.measured[..., *result.measurement.window][:, result.measurement.good], 0.999)
    for row, (measured, modelled, bad) in enumerate(
        zip(result.measured, result.modelled, result.measurement.bad, strict=True)
    ):
        shown = show_intensity(panels[row, 0], measured, top)
        show_intensity(panels[row, 1], modelled, top)
        difference = show_phase(panels[row, 2], np.where(bad, np.nan, measured - modelled), top / 2)
        for axes in panels[row, ::2]:
            axes.plot(*np.argwhere(bad)[:, ::-1].T, "s", color=_BAD, ms=1.2)
        panels[row, 0].set_ylabel(f"image {row + 1}: correlation {result.correlation[row]:.3f}")
    for axes, title in zip(panels[0], ("measured", "modelled", "measured − modelled"), strict=True):
        axes.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=panels[:, :2], label="intensity", location="bottom", shrink=0.6, aspect=40)
    figure.colorbar(
        difference, ax=panels[:, 2], label="intensity", location="bottom", extend="both", shrink=0.9, aspect=20
    )
    return figure


def phase_map(result: MeasuredPhase, wavelength: float) -> Figure:
    """Phase in radian, with a second scale in nm; bad points are marked.

    Parameters
    ----------
    result : MeasuredPhase
    wavelength : float, nm
    """
    figure, axes = plt.subplots(figsize=(6.4, 5))
    limit = np.nanmax(np.abs(result.phase))
    shown = show_phase(axes, result.phase, limit)
    bad = result.measurement.pupil.inside & ~result.measurement.good
    if bad.any():
        axes.plot(*np.argwhere(bad)[:, ::-1].T, "s", color=_BAD, ms=2, label=f"{bad.sum()} bad points")
        figure.legend(loc="outside lower center", fontsize=9)
    bar = figure.colorbar(shown, ax=axes, label="phase (rad)")
    scale = wavelength / (2 * np.pi)
    nm = bar.ax.secondary_yaxis(-0.9, functions=(partial(np.multiply, scale), partial(np.multiply, 1 / scale)))
    nm.set_ylabel("wavefront (nm)")
    return figure


def gains(work: Sequence[Step], errors: Sequence[float] | None = None) -> Figure:
    """Correlation, prediction of the other frame, and error where the truth is known, step by step.

    Parameters
    ----------
    work : sequence of Step
    errors : sequence of float, radian rms, optional
        Of each step.
    """
    figure, panels = plt.subplots(1, 2 + (errors is not None), figsize=(9, 3.6), sharey=True)
    rows = np.arange(len(work))[::-1]
    for axes, title, values in (
        (panels[0], "correlation of measured\nand modelled frames", [step.result.correlation for step in work]),
        (panels[1], "correlation with the prediction\nfrom the other frame", [step.predicted for step in work]),
    ):
        for index, (points, style) in enumerate(zip(np.transpose(values), OTHER_STYLES, strict=False), start=1):
            axes.plot(points, rows, label=f"image {index}", **style)
        axes.set(xlabel=title)
    if errors is not None:
        panels[2].plot(errors, rows, **OTHER_STYLES[2])
        panels[2].set(xlabel="error of the segments\n(rad rms)", xlim=(0, None))
    panels[0].set_yticks(rows, [step.name for step in work])
    panels[0].legend(fontsize=9)
    return figure
