"""Figures of the simulated bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from zwfs.paper.bench_linearity import BenchCurves
from zwfs.plots.style import LOOKS, _looks, show_intensity, show_phase

_ARMS = ("+θ", "−θ")


def reference_intensities(frames: NDArray, pupil_images: NDArray) -> Figure:
    """Figure 6: the two images of a flat command, mask in, and the off-mask images, (2, ny, nx) each."""
    figure, panels = plt.subplots(1, 4, figsize=(9, 3.4))
    for pair, images, label in ((panels[:2], frames, "mask in"), (panels[2:], pupil_images, "mask out")):
        top = np.quantile(images, 0.9995)
        for axes, image, arm in zip(pair, images, _ARMS, strict=True):
            shown = show_intensity(axes, image, top)
            axes.set_title(f"{label}, image {arm}", fontsize=10)
        figure.colorbar(shown, ax=pair, label="intensity", location="bottom", shrink=0.7, aspect=30)
    return figure


def measured_and_modelled(measured: NDArray, modelled: NDArray, phase: NDArray) -> Figure:
    """Figure 7: frames, the frames that the reconstructed phase makes in the model, and their difference.

    Parameters
    ----------
    measured, modelled : ndarray, shape (2, ny, nx)
    phase : ndarray, shape (ny', nx'), radian
        Reconstructed phase.
    """
    figure, panels = plt.subplot_mosaic(
        [["m0", "f0", "d0", "phase"], ["m1", "f1", "d1", "phase"]], figsize=(9, 4.6), width_ratios=[1, 1, 1, 1.4]
    )
    top = np.quantile(np.stack([measured, modelled]), 0.999)
    for row, (arm, frame, model) in enumerate(zip(_ARMS, measured, modelled, strict=True)):
        image = show_intensity(panels[f"m{row}"], frame, top)
        show_intensity(panels[f"f{row}"], model, top)
        difference = show_phase(panels[f"d{row}"], frame - model, top / 4)
        panels[f"m{row}"].set_ylabel(f"image {arm}")
    for key, title in (("m0", "measured"), ("f0", "modelled"), ("d0", "difference"), ("phase", "phase found")):
        panels[key].set_title(title, fontsize=10)
    found = show_phase(panels["phase"], phase, np.nanmax(np.abs(phase)))
    bars: dict[str, Any] = {"location": "bottom", "aspect": 25, "shrink": 0.85}
    figure.colorbar(image, ax=[panels[key] for key in ("m0", "f0", "m1", "f1")], label="intensity", **bars)
    figure.colorbar(difference, ax=[panels["d0"], panels["d1"]], label="intensity", extend="both", **bars)
    figure.colorbar(found, ax=panels["phase"], label="phase (rad)", **bars)
    return figure


def segment_errors(numbers: NDArray, residuals: Mapping[str, NDArray], maps: Mapping[str, NDArray]) -> Figure:
    """Figure 8: residual piston of each segment, as points and as maps (radian).

    Parameters
    ----------
    numbers : ndarray, shape (n_segments,)
    residuals : mapping of method to ndarray, shape (n_segments,)
    maps : mapping of title to ndarray, shape (ny, nx)
    """
    figure, panels = plt.subplot_mosaic(
        [["points"] * len(maps), list(maps)], figsize=(9, 5.2), height_ratios=[1, 1.1]
    )
    points = panels["points"]
    for name, values in residuals.items():
        look = LOOKS[name]
        rms = np.sqrt(np.mean(values**2))
        points.plot(
            numbers,
            values,
            look.marker,
            color=look.color,
            ms=5,
            label=f"{look.label}: {rms:.2f} rad rms",
            alpha=0.9,
        )
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    points.legend(loc="upper center", bbox_to_anchor=(0.5, 1.2), ncols=2, fontsize=9)
    limit = max(np.nanmax(np.abs(image)) for image in maps.values())
    for title, image in maps.items():
        shown = show_phase(panels[title], image, limit)
        panels[title].set_title(title, fontsize=10)
    figure.colorbar(shown, ax=[panels[title] for title in maps], label="phase (rad)", shrink=0.8, aspect=16)
    return figure


def bench_linearity(curves: BenchCurves, names: Sequence[str]) -> Figure:
    """Figure 9: error of the segments against the input, and the gain, the slope of found against commanded."""
    figure, (plain, gain) = plt.subplots(1, 2, figsize=(9, 4.2))
    for name, look in _looks(names):
        mean, std = curves.mean(name), curves.std(name)
        line = {"color": look.color, "marker": look.marker, "linestyle": look.line, "markersize": 4}
        plain.plot(curves.rms, mean, label=look.label, **line)
        low, high = np.maximum(mean - std, 0), mean + std
        plain.fill_between(curves.rms, low, high, color=look.color, alpha=0.15, lw=0)
        gain.plot(curves.rms, curves.gain(name), **line)
    gain.axhline(1, color="#555555", lw=1)
    plain.set(xlabel="input (rad rms over the segments)", ylabel="error (rad rms)", xlim=(0, None), ylim=(0, None))
    gain.set(xlabel="input (rad rms over the segments)", ylabel="gain: found / commanded", xlim=(0, None))
    gain.set_ylim(0, 1.5)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


def budget(labels: Sequence[str], offsets: NDArray, gains: NDArray, errors: NDArray) -> Figure:
    """What each error of the bench does alone: offset at a flat command, loss of gain, error at two inputs.

    Parameters
    ----------
    labels : sequence of str, length n
    offsets : ndarray, shape (n,), radian rms
    gains : ndarray, shape (n,)
    errors : ndarray, shape (n,), radian rms
    """
    figure, panels = plt.subplots(1, 3, figsize=(9, 3.4), sharey=True)
    rows = np.arange(len(labels))[::-1]
    quantities = (
        ("offset at a flat command\n(rad rms)", offsets),
        ("change of the gain\n(%)", 100 * (gains - 1)),
        ("error\n(rad rms)", errors),
    )
    for axes, (title, values) in zip(panels, quantities, strict=True):
        axes.barh(rows, values, color=LOOKS["PhaseShifted"].color, height=0.65)
        axes.axvline(0, color="#555555", lw=1)
        axes.set(xlabel=title)
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks(rows, labels)
    return figure
