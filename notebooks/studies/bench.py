"""Figures 5 to 8: layout and frames of the bench, their agreement with a model, and the errors of segments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from studies.kit.bench import ARMS, UNITS, check_bench
from studies.kit.drawings import Picture, draw_layout, focal_light, mask_picture, shift_label
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.style import ALONE, INTENSITY_MAP, LOOKS, PHASE_MAP, show_intensity, show_phase
from studies.kit.tables import Table, Text
from zwfs import Dimple, Pupil, Reconstruction, strehl
from zwfs.bench import Bench, BenchModel

LIMITS = parameter_limits(
    "rms exponent n_iterations", n_pixels=(32, 1024), wavelength=(100.0, 20000.0), bench=bench_fields("n_pixels")
)
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68}

_REACH = 4  # of the picture of the dimple, lambda/D from its centre
_SHOWN = 0.95  # of the errors lie within the scale of their maps
_FOLDED = -1.0  # rad, well below the branch point of one image


def draw_bench_layout(bench: Bench, pistons: NDArray, frames: NDArray, wavelength: float) -> Figure:
    """Figure 5: simplified layout of the SEAL bench, folded at its two deformable mirrors; wavelength in nm."""
    pupil = Pupil.from_segments(bench.segments)
    phase = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    limit = np.nanmax(np.abs(phase))
    no_errors: dict[str, Any] = dict.fromkeys(
        (*bench.errors(), "photons_per_image", "read_noise", "background"), 0
    )
    quilted = replace(bench, **no_errors | {"quilting": bench.quilting}).frames()[0]
    plus, minus = (Dimple(bench.diameter, sign * bench.phase) for sign in (1, -1))
    pictures = {
        "stop": Picture(pupil.amplitude**2, "gray", 0, pupil.amplitude.max() ** 2, "segments in stop"),
        "pistons": Picture(phase, PHASE_MAP, -limit, limit, "pistons (rad)"),
        "quilting": Picture(quilted, INTENSITY_MAP, 0, quilted.max(), "quilting"),
        "dimple": mask_picture(plus, focal_light(pupil, pupil.field(phase), _REACH), _REACH),
        "image_1": Picture(frames[0], INTENSITY_MAP, 0, frames.max(), "image 1"),
        "image_2": Picture(frames[1], INTENSITY_MAP, 0, frames.max(), "image 2"),
    }
    texts = {"plus": shift_label(plus, plus=True), "minus": shift_label(minus, plus=True)}
    texts["wavelength"] = f"{wavelength:g}"
    return draw_layout("bench.svg", "bench_narrow.svg", pictures, texts)


def layout_table(bench: Bench, pistons: NDArray, wavelength: float) -> Table:
    """Sizes of the segments, and the pistons (rad) compared with the wavelength (nm)."""
    pupil = Pupil.from_segments(bench.segments)
    number = pupil.gather(bench.segments)
    share = np.bincount(number)[bench.numbers] / np.bincount(number).max()
    center = {segment: pupil.points[number == segment].mean(axis=0) for segment in (1, 3)}
    pitch = float(np.hypot(*(center[3] - center[1])))  # segment 3 touches segment 1
    rms, phase = float(pistons.std()), bench.commanded_phase(pistons)
    return Table(
        ["quantity", "value"],
        [
            ["segments of the mirror", bench.n_segments + len(bench.missing)],
            ["segments in use", bench.n_segments],
            ["segments across the stop", 1 / pitch],
            ["width of a gap (% of a segment)", bench.gap / pitch * 100],
            ["segments with more than 95 % of their area in the stop", int((share > 0.95).sum())],
            ["smallest share of a segment in the stop", float(share.min())],
            ["share of the stop that segments cover", pupil.n_points / Pupil.circular(bench.n_pixels).n_points],
            ["pistons (rad rms over the segments)", rms],
            ["pistons, wavefront (nm rms over the segments)", rms * wavelength / (2 * np.pi)],
            ["pistons (rad rms over the stop, which cuts the outer segments)", float(pupil.gather(phase).std())],
            ["Strehl ratio with these pistons", float(strehl(pupil, phase))],
        ],
    )


def draw_reference_intensities(frames: NDArray, clear_frames: NDArray) -> Figure:
    """Figure 6: the two images of a flat command, mask in, and the clear frames, (2, ny, nx) each."""
    figure, panels = plt.subplots(1, 4, figsize=(7, 3.1))
    for pair, images, label in ((panels[:2], frames, "mask in"), (panels[2:], clear_frames, "mask out")):
        top = np.quantile(images, 0.9995)
        for axes, image, arm in zip(pair, images, ARMS, strict=True):
            shown = show_intensity(axes, image, top)
            axes.set_title(f"{label},\nimage {arm}", fontsize=10)
        figure.colorbar(shown, ax=pair, label="intensity", location="bottom", shrink=0.7, aspect=30)
    return figure


def error_table(bench: Bench) -> Table:
    """Size of each error of the bench."""
    rows = [[name.replace("_", " "), float(getattr(bench, name)), unit] for name, unit in UNITS.items()]
    return Table(["error", "value", "unit"], rows)


def correlations(model: BenchModel, measured: NDArray, modelled: NDArray) -> list[float]:
    """Correlation of measured and modelled frames inside the pupil, for each image; (2, ny', nx') each."""
    inside = model.shifted.pupil.inside
    pairs = zip(measured[..., *model.shifted.window], modelled[..., *model.shifted.window], strict=True)
    return [float(np.corrcoef(frame[inside], prediction[inside])[0, 1]) for frame, prediction in pairs]


def draw_measured_and_modelled(measured: NDArray, modelled: NDArray, phase: NDArray) -> Figure:
    """Figure 7: frames, the frames that the reconstructed phase makes in the model, and their difference."""
    figure, panels = plt.subplot_mosaic(
        [["m0", "f0", "d0", "phase"], ["m1", "f1", "d1", "phase"]], figsize=(7, 4.1), width_ratios=[1, 1, 1, 1.4]
    )
    top = np.quantile(np.stack([measured, modelled]), 0.999)
    for row, (arm, frame, model) in enumerate(zip(ARMS, measured, modelled, strict=True)):
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
    estimate = show_phase(panels["phase"], phase, np.nanmax(np.abs(phase)))
    bars: dict[str, Any] = {"location": "bottom", "aspect": 25, "shrink": 0.85}
    figure.colorbar(image, ax=[panels[key] for key in ("m0", "f0", "m1", "f1")], label="intensity", **bars)
    figure.colorbar(difference, ax=[panels["d0"], panels["d1"]], label="intensity", extend="both", **bars)
    figure.colorbar(estimate, ax=panels["phase"], label="phase (rad)", **bars)
    return figure


def agreement(correlation: list[float], estimate: Reconstruction) -> Text:
    """Say how well the modelled frames agree with the measured ones."""
    first, second = correlation
    text = (
        f"The correlation of measured and modelled frames is {first:.2g} in image 1 and {second:.2g} in image 2. "
        f"They differ by {float(estimate.residual):.2g} of the mean intensity (rms)."
    )
    if estimate.n_unsolved:
        text += f" At {int(estimate.n_unsolved)} points the frames allow no unique phase."
    return Text(text)


def draw_segment_errors(bench: Bench, commanded: NDArray, errors: Mapping[str, NDArray]) -> Figure:
    """Figure 8: error of the piston of each segment, as points and as maps, and the commands."""
    pistons = {"commanded": commanded} | {f"error, {LOOKS[name].name}": values for name, values in errors.items()}
    maps = {
        title: np.where(bench.segments > 0, bench.commanded_phase(values), np.nan)
        for title, values in pistons.items()
    }
    figure, panels = plt.subplot_mosaic(
        [["points"] * len(maps), list(maps)], figsize=(7, 5.6), height_ratios=[1, 1.3]
    )
    points = panels["points"]
    figure.set_layout_engine("constrained", hspace=0.08)  # between the label of an axis and titles
    for name, values in errors.items():
        look = LOOKS[name]
        label = f"{look.label}: {_rms(values):.2f} rad rms"
        points.plot(bench.numbers, values, look.marker, color=look.color, ms=5, label=label, alpha=0.9)
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    panels["commanded"].set_gid(ALONE)
    all_errors = np.abs(np.concatenate(list(errors.values())))
    for title, image in maps.items():
        alone = title == "commanded"
        # The errors have a scale of their own; the largest ones are beyond it.
        limit = np.nanmax(np.abs(image)) if alone else np.quantile(all_errors, _SHOWN)
        shown = show_phase(panels[title], image, limit)
        panels[title].set_title(title, fontsize=10)
        if alone:
            figure.colorbar(shown, ax=panels[title], location="bottom", label="piston (rad)", aspect=12)
    both = [panels[title] for title in maps if title != "commanded"]
    bar = figure.colorbar(shown, ax=both, location="bottom", extend="both", label="error (rad)", aspect=24)
    bar.locator = MaxNLocator(5)
    return figure


def findings(commanded: NDArray, errors: Mapping[str, NDArray]) -> Text:
    """Say how large the errors of both methods are, and where the linear one fails; (n_segments,) each, rad."""
    linear, shifted = errors["Linear"], errors["PhaseShifted"]
    text = (
        f"For one random screen of pistons of {_rms(commanded):.2g} rad rms, the error of the phase-shifted "
        f"iteration (two images and a model without the bench's errors) is {_rms(shifted):.2g} rad rms. That of "
        f"the linear method (one image and an interaction matrix calibrated on the bench) is {_rms(linear):.2g} "
        "rad rms."
    )
    folded = commanded < _FOLDED
    if folded.any():
        text += (
            f" For pistons below {_FOLDED:.0f} rad, the linear estimate is wrong by "
            f"{np.median(np.abs(linear / commanded)[folded]):.0%} of the piston (median of {folded.sum()})."
        )
    return Text(text)


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
