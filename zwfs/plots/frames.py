"""Figures of frames of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from zwfs.frames.pipeline import MeasuredPhase, Measurement, Step, model
from zwfs.plots.style import show_intensity, show_phase
from zwfs.units import opd_to_phase, phase_to_opd

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
        panels[row, 0].set_ylabel(f"image {row + 1}: rms misfit {result.residual[row]:.3f}")
    for axes, title in zip(panels[0], ("measured", "modelled", "measured − modelled"), strict=True):
        axes.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=panels[:, :2], label="intensity", location="bottom", shrink=0.6, aspect=40)
    figure.colorbar(
        difference, ax=panels[:, 2], label="intensity", location="bottom", extend="both", shrink=0.9, aspect=20
    )
    return figure


def phase_map(result: MeasuredPhase, wavelength: float, sigma: NDArray | None = None) -> Figure:
    """Phase in radian, with a second scale in nm, and its error bar; bad points are marked.

    Parameters
    ----------
    result : MeasuredPhase
    wavelength : float, nm
    sigma : ndarray, shape (ny, nx), radian, optional
        Error bar of the phase.
    """
    n_panels = 1 if sigma is None else 2
    figure, panels = plt.subplots(1, n_panels, figsize=(4.7 * n_panels, 4.6), squeeze=False)
    axes = panels[0, 0]
    # Single points at gaps may be off by a turn: they do not set the scale.
    shown = show_phase(axes, result.phase, np.nanquantile(np.abs(result.phase), 0.99))
    axes.set_title("phase", fontsize=10)
    bad = result.measurement.pupil.inside & ~result.measurement.good
    if bad.any():
        axes.plot(*np.argwhere(bad)[:, ::-1].T, "s", color=_BAD, ms=2, label=f"{bad.sum()} bad points")
        figure.legend(loc="outside lower left", fontsize=9)
    _two_scales(figure.colorbar(shown, ax=axes, location="bottom", aspect=30, extend="both"), wavelength)
    if sigma is not None:
        shown = show_intensity(panels[0, 1], sigma, 2 * np.nanmedian(sigma))
        panels[0, 1].set_title("error bar: photon and read noise", fontsize=10)
        bar = figure.colorbar(shown, ax=panels[0, 1], location="bottom", aspect=30, extend="max")
        _two_scales(bar, wavelength)
    return figure


def _two_scales(bar: Colorbar, wavelength: float) -> None:
    """Label a colour bar in radian below and in nm above."""
    bar.set_label("rad")
    bar.locator = MaxNLocator(4)
    nm = bar.ax.secondary_xaxis(
        "top",
        functions=(partial(phase_to_opd, wavelength=wavelength), partial(opd_to_phase, wavelength=wavelength)),
    )
    nm.set_xlabel("nm of wavefront")
    nm.xaxis.set_major_locator(MaxNLocator(4))


def gains(work: Sequence[Step], errors: Sequence[float] | None = None) -> Figure:
    """Score on unseen data with its control, misfit, and error where the truth is known, step by step.

    Parameters
    ----------
    work : sequence of Step
    errors : sequence of float, radian rms, optional
        Of each step.
    """
    figure, panels = plt.subplots(1, 2 + (errors is not None), figsize=(9, 3.8), sharey=True)
    rows = np.arange(len(work))[::-1]
    # Markers for the images: colours would stand for methods.
    for label, color, values in (
        ("score", "#333333", [step.predicted for step in work]),
        ("control", "#999999", [step.control for step in work]),
    ):
        for index, (points, marker) in enumerate(zip(np.transpose(values), "os", strict=True), start=1):
            face = color if index == 1 else "none"
            panels[0].plot(
                points, rows + 0.3 * (1.5 - index), ls="-", lw=0.6, color=color, marker=marker, ms=5, mfc=face,
                label=f"{label}, frame {index}",
            )  # fmt: skip
    panels[0].set(xlabel="correlation of frames 1 and 2\nwith their prediction")
    panels[1].plot([step.result.misfit for step in work], rows, color="#444444", marker="o", ms=5)
    panels[1].set(xlabel="rms misfit\nover contrast")
    if errors is not None:
        panels[2].plot(errors, rows, color="#444444", marker="o", ms=5)
        panels[2].set(xlabel="error of the segments\n(rad rms)")
    for axes in panels[1:]:
        axes.margins(x=0.15)
        axes.set_xlim(left=0)
    panels[0].set_yticks(rows, [step.name for step in work])
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    return figure


def signs(measurement: Measurement, height: float = 0.4) -> Figure:
    """Sketch of the sign conventions: a mirror that is pulled back, its phase, and the change of the two images.

    Parameters
    ----------
    measurement : Measurement
        Its pupil and optics give the (simulated) images.
    height : float, radian
        Phase of the poke.
    """
    sensor, (ny, nx) = model(measurement), measurement.pupil.shape
    y, x = np.mgrid[:ny, :nx]
    apart = np.hypot(x - 0.64 * nx, y - 0.62 * ny) / measurement.recording.diameter
    poke = np.where(sensor.pupil.inside, height * np.exp(-((apart / 0.1) ** 2)), 0)
    change = (sensor.measure(poke) - sensor.measure(np.zeros_like(poke)))[(..., *sensor.window)]
    figure, panels = plt.subplots(1, 4, figsize=(10, 3.2), width_ratios=(1.1, 1, 1, 1))
    _pulled_mirror(panels[0])
    maps = [(poke, height, "phase of the poke\nabove 0 (red)")]
    for image, shift in zip(change, measurement.optics.phase_shifts, strict=True):
        word = "brighter (red)" if image.sum(where=apart < 0.1) > 0 else "darker (blue)"
        maps.append((image, np.abs(change).max(), f"image of phase shift {shift / np.pi:+.2g} π\n{word}"))
    for axes, (values, limit, title) in zip(panels[1:], maps, strict=True):
        show_phase(axes, np.where(sensor.pupil.inside, values, np.nan), limit)
        axes.set_title(title, fontsize=10)
    panels[1].set_xlabel("x: columns, to the right", fontsize=9)
    panels[1].set_ylabel("y: rows, upwards", fontsize=9)
    return figure


def _pulled_mirror(axes: Axes) -> None:
    """Side view: a pit in a mirror delays the reflected wavefront by twice its depth."""
    y = np.linspace(-1, 1, 200)
    pit = np.exp(-((y / 0.25) ** 2))
    axes.fill_betweenx(y, 1 + 0.15 * pit, 1.5, color="#bbbbbb")
    axes.plot(1 + 0.15 * pit, y, color="#444444", lw=2)
    axes.plot(0.35 + 0.3 * pit, y, color="#444444", lw=1.2)
    arrow = {"arrowstyle": "->", "color": "#444444"}
    axes.annotate("", (0.9, 0.8), (0.5, 0.8), arrowprops=arrow)
    axes.text(0.0, 0.86, "light", fontsize=9)
    axes.annotate("", (0.0, -0.8), (0.3, -0.8), arrowprops=arrow)
    axes.annotate("", (1.15, 0.0), (1.0, 0.0), arrowprops={"arrowstyle": "<->", "color": "#444444"})
    axes.text(1.2, -0.05, "h", fontsize=10)
    axes.text(0.0, -1.12, "reflected wavefront, late by 2 h", fontsize=9)
    axes.set(xlim=(0, 1.5), ylim=(-1.2, 1.05), xticks=[], yticks=[])
    axes.set_title("mirror pulled back by h:\nOPD = +2 h, phase above 0", fontsize=10)
    axes.grid(False)
    axes.spines[:].set_visible(False)
