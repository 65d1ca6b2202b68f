"""Figures of the simulated bench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from zwfs.bench.model import Bench
from zwfs.paper.bench_linearity import BenchCurves
from zwfs.plots.style import ALONE, LOOKS, _looks, show_intensity, show_phase

_ARMS = ("1 (+θ)", "2 (−θ)")


def reference_intensities(frames: NDArray, clear_frames: NDArray) -> Figure:
    """Figure 6: the two images of a flat command, mask in, and the clear frames, (2, ny, nx) each."""
    figure, panels = plt.subplots(1, 4, figsize=(7, 3.1))
    for pair, images, label in ((panels[:2], frames, "mask in"), (panels[2:], clear_frames, "mask out")):
        top = np.quantile(images, 0.9995)
        for axes, image, arm in zip(pair, images, _ARMS, strict=True):
            shown = show_intensity(axes, image, top)
            axes.set_title(f"{label},\nimage {arm}", fontsize=10)
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
        [["m0", "f0", "d0", "phase"], ["m1", "f1", "d1", "phase"]], figsize=(7, 4.1), width_ratios=[1, 1, 1, 1.4]
    )
    top = np.quantile(np.stack([measured, modelled]), 0.999)
    for row, (arm, frame, model) in enumerate(zip(_ARMS, measured, modelled, strict=True)):
        image = show_intensity(panels[f"m{row}"], frame, top)
        show_intensity(panels[f"f{row}"], model, top)
        difference = show_phase(panels[f"d{row}"], frame - model, top / 4)
        panels[f"m{row}"].set_ylabel(f"image {arm}")
    for key, title in (
        ("m0", "measured"),
        ("f0", "modelled"),
        ("d0", "difference"),
        ("phase", "reconstructed\nphase"),
    ):
        panels[key].set_title(title, fontsize=10)
    found = show_phase(panels["phase"], phase, np.nanmax(np.abs(phase)))
    bars: dict[str, Any] = {"location": "bottom", "aspect": 25, "shrink": 0.85}
    figure.colorbar(image, ax=[panels[key] for key in ("m0", "f0", "m1", "f1")], label="intensity", **bars)
    figure.colorbar(difference, ax=[panels["d0"], panels["d1"]], label="intensity", extend="both", **bars)
    figure.colorbar(found, ax=panels["phase"], label="phase (rad)", **bars)
    return figure


def segment_errors(bench: Bench, commanded: NDArray, errors: Mapping[str, NDArray]) -> Figure:
    """Figure 8: error of the piston of each segment, as points and as maps, and the commands.

    Parameters
    ----------
    bench : Bench
    commanded : ndarray, shape (n_segments,), radian
    errors : mapping of method to ndarray, shape (n_segments,), radian
    """
    pistons = {"commanded": commanded} | {f"error,\n{LOOKS[name].name}": values for name, values in errors.items()}
    maps = {
        title: np.where(bench.segments > 0, bench.commanded_phase(values), np.nan)
        for title, values in pistons.items()
    }
    figure, panels = plt.subplot_mosaic(
        [["points"] * len(maps), list(maps)], figsize=(7, 5.2), height_ratios=[1, 1]
    )
    points = panels["points"]
    for name, values in errors.items():
        look = LOOKS[name]
        rms = np.sqrt(np.mean(values**2))
        label = f"{look.label}: {rms:.2f} rad rms"
        points.plot(bench.numbers, values, look.marker, color=look.color, ms=5, label=label, alpha=0.9)
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    limit = max(np.nanmax(np.abs(image)) for image in maps.values())
    panels["commanded"].set_gid(ALONE)
    for title, image in maps.items():
        shown = show_phase(panels[title], image, limit)
        panels[title].set_title(title, fontsize=10)
    figure.colorbar(shown, ax=[panels[title] for title in maps], label="phase (rad)", shrink=0.8, aspect=16)
    return figure


def bench_linearity(curves: BenchCurves) -> Figure:
    """Figure 9: error of the segments against the input, and the gain, estimated over commanded pistons."""
    figure, (plain, gain) = plt.subplots(1, 2, figsize=(7, 4.4))
    for name, look in _looks(curves.residuals):
        mean, std = curves.mean(name), curves.std(name)
        plain.plot(curves.rms, mean, markersize=4, label=look.label, **look.style)
        low, high = np.maximum(mean - std, 0), mean + std
        plain.fill_between(curves.rms, low, high, color=look.color, alpha=0.15, lw=0)
        gain.plot(curves.rms, curves.gain(name), markersize=4, **look.style)
    gain.axhline(1, color="#555555", lw=1)
    plain.set(xlabel="input (rad rms over the segments)", ylabel="error (rad rms)", xlim=(0, None), ylim=(0, None))
    gain.set(
        xlabel="input (rad rms over the segments)", ylabel="gain: estimated / commanded piston", xlim=(0, None)
    )
    gain.set_ylim(0, 1.5)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


def budget(curves: Mapping[str, BenchCurves], name: str) -> Figure:
    """Effect of each error of the bench alone: offset at a flat command, gain and error at the first other input.

    Parameters
    ----------
    curves : mapping of the name of an error to BenchCurves
    name : str
        Reconstructor.
    """
    figure, panels = plt.subplots(1, 3, figsize=(7, 3.6), sharey=True)
    rows = np.arange(len(curves))[::-1]
    value = next(iter(curves.values())).rms[1]
    quantities = (
        ("error at a flat\ncommand (rad rms)", [one.mean(name)[0] for one in curves.values()]),
        (
            f"change of the gain at\n{value:g} rad rms (%)",
            [100 * (one.gain(name)[1] - 1) for one in curves.values()],
        ),
        (f"error at {value:g} rad\nrms (rad rms)", [one.mean(name)[1] for one in curves.values()]),
    )
    for axes, (title, values) in zip(panels, quantities, strict=True):
        axes.barh(rows, values, color=LOOKS[name].color, height=0.65)
        axes.axvline(0, color="#555555", lw=1)
        axes.set(xlabel=title)
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks(rows, [error.replace("_", " ") for error in curves])
    return figure
