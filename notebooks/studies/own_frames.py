"""Your own frames: the phase of a pair of camera frames, its verdict, and how it was found."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.style import ALONE, show_intensity, show_phase
from studies.kit.tables import Table, Text, two_digits
from zwfs import opd_to_phase, phase_to_opd
from zwfs.bench import Bench, write_bench
from zwfs.frames import CameraNoise, Phases
from zwfs.frames.files import CameraFile, read_all
from zwfs.frames.pipeline import Measurement, model, recover_phase, reduce_frames
from zwfs.frames.refine import Step
from zwfs.frames.registration import Image, register_frames
from zwfs.frames.verdict import Verdict

_FITTED = "registration", "scale", "background", "diameter", "leakage", "unmasked", "pupil_background"
LIMITS = parameter_limits(
    "n_iterations rms",
    frame_files=[str, ...],
    pupil_files=[str, ...],
    dark_files=[str, ...],
    bad_pixel_files=[str, ...],
    wavelength=(0.0, 1e5),
    diameter=(0.0, 8.0),
    phase_shifts=[(-6.2832, 6.2832), ...],
    pupil_centers=[[(0.0, 1e5)], ...],
    pupil_diameter=(0.0, 1e5),
    exposure_ratio=(1e-6, 1e6),
    saturation=(0.0, 1e12),
    gain=(0.0, 1e6),
    read_noise=(0.0, 1e6),
    fitted=[_FITTED, ...],
    output=str,
    overwrite=bool,
    n_bad=(0, 2000),
)
FILES = ("frame_files", "pupil_files", "dark_files", "bad_pixel_files")


def check_files(**values: Any) -> None:
    """Refuse a file that does not exist, before any work."""
    for name in FILES:
        for path in values[name]:
            if not Path(path).is_file():
                raise FileNotFoundError(f"{name}: {path}: no such file")


CHECK_TOGETHER = check_files

SHOWN = ("BUNIT", "WAVELEN", "PUPDIAM", "DIMPLE", "ROTATE", "MAGNIF", "NBAD")  # keywords of the phase map
_SHOWN = 4  # largest difference of the frames on the scale, over its rms
_BAD = "#FF00FF"  # not in the colour maps, and far from the colours of the methods


def header_noise(source: CameraFile, gain: float, read_noise: float) -> CameraNoise | None:
    """Noise of the camera by these values, or by EGAIN and RDNOISE of the header; None without a gain."""
    gain = gain or (source.keyword("EGAIN") if "EGAIN" in source.header else 0.0)
    read_noise = read_noise or (source.keyword("RDNOISE") if "RDNOISE" in source.header else 0.0)
    return CameraNoise(gain, read_noise) if gain else None


def simulated_flat(bench: Bench, phase: Phases, n_iterations: int, seed: int) -> Phases:
    """Phase of frames of the flat mirror of a simulated bench, with the optics of another phase."""
    with tempfile.TemporaryDirectory() as folder:
        paths = write_bench(folder, bench, seed=np.random.default_rng([seed, 1]))
        frames, clear_frames, _ = read_all([paths["frame"]], [paths["pupils"]], [paths["dark"]])
        registered = register_frames(frames, clear_frames)
    return recover_phase(reduce_frames(registered, phase.agreement.measurement.optics), n_iterations)


def draw_explained(result: Phases) -> Figure:
    """Measured frames, modelled frames and their difference; bad pixels are marked."""
    figure, panels = plt.subplots(2, 3, figsize=(7.2, 5.2))
    agreement, measurement = result.agreement, result.agreement.measurement
    top = np.quantile(agreement.measured[..., *measurement.window][:, measurement.good], 0.999)
    for row, (measured, modelled, bad) in enumerate(
        zip(agreement.measured, agreement.modelled, measurement.bad, strict=True)
    ):
        shown = show_intensity(panels[row, 0], measured, top)
        show_intensity(panels[row, 1], modelled, top)
        remainder = np.where(bad, np.nan, measured - modelled)
        difference = show_phase(panels[row, 2], remainder, _SHOWN * agreement.residual.max())
        for axes in panels[row, ::2]:
            axes.plot(*np.argwhere(bad)[:, ::-1].T, "s", color=_BAD, ms=1.2)
        panels[row, 0].set_ylabel(f"image {row + 1}")
        panels[row, 2].set_xlabel(f"rms {agreement.residual[row]:.3f}")
    for axes, title in zip(panels[0], ("measured", "modelled", "measured − modelled"), strict=True):
        axes.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=panels[:, :2], label="intensity", location="bottom", shrink=0.6, aspect=40)
    figure.colorbar(
        difference, ax=panels[:, 2], label="intensity", location="bottom", extend="both", shrink=0.9, aspect=20
    )
    return figure


def draw_phase_map(result: Phases, wavelength: float, sigma: NDArray | None = None) -> Figure:
    """Phase in radian, with a second scale in nm, and its error bar; bad points are marked."""
    n_panels = 1 if sigma is None else 2
    figure, panels = plt.subplots(1, n_panels, figsize=((4.7, 7.2)[n_panels - 1], 4.2), squeeze=False)
    axes = panels[0, 0]
    # Single points at gaps may be off by a turn: they do not set the scale.
    shown = show_phase(axes, result.phase, np.nanquantile(np.abs(result.phase), 0.99))
    axes.set_title("phase", fontsize=10)
    measurement = result.agreement.measurement
    bad = measurement.pupil.inside & ~measurement.good
    if bad.any():
        axes.plot(*np.argwhere(bad)[:, ::-1].T, "s", color=_BAD, ms=2, label=f"{bad.sum()} bad points")
        figure.legend(loc="outside lower left", fontsize=9)
    _two_scales(figure.colorbar(shown, ax=axes, location="bottom", aspect=30, extend="both"), wavelength)
    if sigma is not None:
        shown = show_intensity(panels[0, 1], 1e3 * sigma, 2e3 * np.nanmedian(sigma))
        panels[0, 1].set_title("error bar: noise only", fontsize=10)
        bar = figure.colorbar(shown, ax=panels[0, 1], location="bottom", aspect=30, extend="max")
        _two_scales(bar, wavelength / 1e3, "mrad")
    return figure


def _two_scales(bar: Colorbar, wavelength: float, unit: str = "rad") -> None:
    """Label a colour bar in this unit of phase below and in nm above: 2 pi units are a wavelength."""
    bar.set_label(unit)
    bar.locator = MaxNLocator(4)
    both = partial(phase_to_opd, wavelength=wavelength), partial(opd_to_phase, wavelength=wavelength)
    nm = bar.ax.secondary_xaxis("top", functions=both)
    nm.set_xlabel("nm of wavefront")
    nm.xaxis.set_major_locator(MaxNLocator(4))


def draw_gains(work: Sequence[Step], errors: Sequence[float] | None = None) -> Figure:
    """Score on unseen data with its control, misfit, and error where the truth is known, step by step."""
    figure, panels = plt.subplots(1, 2 + (errors is not None), figsize=(7.2, 3.8), sharey=True)
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
    panels[0].set(xlabel="score and control\n(correlation)")
    panels[0].margins(x=0.08)
    panels[1].plot([step.result.agreement.misfit for step in work], rows, color="#444444", marker="o", ms=5)
    panels[1].set(xlabel="misfit /\ncontrast")
    if errors is not None:
        panels[2].plot(errors, rows, color="#444444", marker="o", ms=5)
        panels[2].set(xlabel="difference from\ncommands (rad rms)")
    for axes in panels:
        axes.set_gid(ALONE)
    for axes in panels[1:]:
        axes.margins(x=0.08)
        axes.update_datalim([(0, rows[-1])])  # the margin is a share of the whole axis
        axes.autoscale_view()
        axes.set_xlim(left=0)
    panels[0].set_yticks(rows, [step.name for step in work])
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    return figure


def draw_signs(measurement: Measurement, height: float = 0.4) -> Figure:
    """Sketch of the signs: a mirror that is pulled back, its phase, and the change of the two images."""
    sensor, (ny, nx) = model(measurement), measurement.pupil.shape
    y, x = np.mgrid[:ny, :nx]
    apart = np.hypot(x - 0.64 * nx, y - 0.62 * ny) / measurement.registered.diameter
    poke = np.where(sensor.pupil.inside, height * np.exp(-((apart / 0.1) ** 2)), 0)
    change = (sensor.measure(poke) - sensor.measure(np.zeros_like(poke)))[(..., *sensor.window)]
    n_images = len(change)
    figure, panels = plt.subplots(1, 2 + n_images, figsize=(7.8, 3.4), width_ratios=(1.1, *[1] * (1 + n_images)))
    figure.set_layout_engine("constrained", wspace=0.06)
    _pulled_mirror(panels[0])
    maps = [(poke, height, "phase of the poke\nabove 0 (red)")]
    for image, shift in zip(change, measurement.optics.phase_shifts, strict=True):
        word = "brighter (red)" if image.sum(where=apart < 0.1) > 0 else "darker (blue)"
        maps.append(
            (image, np.abs(change).max(), f"image, shift {shift / np.pi:+.2g} π\n{word}".replace("-", "−"))
        )
    for axes, (values, limit, title) in zip(panels[1:], maps, strict=True):
        shown = show_phase(axes, np.where(sensor.pupil.inside, values, np.nan), limit)
        shown.set_label(f"_{title}")
        axes.set_title(title, fontsize=10)
        if axes is panels[1]:
            figure.colorbar(shown, ax=axes, location="bottom", label="phase (rad)", aspect=12)
    figure.colorbar(shown, ax=list(panels[2:]), location="bottom", label="change of the intensity", aspect=26)
    panels[1].set_gid(ALONE)
    panels[1].set_xlabel("x: columns, to the right", fontsize=10)
    panels[1].set_ylabel("y: rows, upwards", fontsize=10)
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
    axes.text(0.0, 0.86, "light", fontsize=10)
    axes.annotate("", (0.0, -0.8), (0.3, -0.8), arrowprops=arrow)
    axes.annotate("", (1.15, 0.0), (1.0, 0.0), arrowprops={"arrowstyle": "<->", "color": "#444444"})
    axes.text(1.2, -0.05, "h", fontsize=10)
    axes.text(0.0, -1.24, "reflected, late by 2 h", fontsize=10)
    axes.set(xlim=(0, 1.5), ylim=(-1.3, 1.05), xticks=[], yticks=[])
    axes.set_title("mirror pulled back by h:\nOPD = +2 h, phase above 0", fontsize=10)
    axes.grid(False)
    axes.spines[:].set_visible(False)


def verdict_table(verdict: Verdict) -> Table:
    """Findings in words."""
    return Table(["question", "answer"], [[topic, sentence] for topic, sentence in verdict.findings.items()])


def result_table(result: Phases) -> Table:
    """Places of the pupils, counts, and agreement of the frames."""
    agreement, measurement = result.agreement, result.agreement.measurement
    registered = measurement.registered
    placement = registered.placement
    pupils = [f"{pupil.row:.2f}, {pupil.column:.2f}, {pupil.diameter:.2f}" for pupil in registered.pupils]
    return Table(
        ["quantity", "value"],
        [
            ["outline of the first pupil: row, column, diameter (pixels)", pupils[0]],
            ["outline of the second pupil: row, column, diameter (pixels)", pupils[1]],
            [
                "shift of the second image (rows, columns; pixels)",
                _with_error(placement.shift, placement.sigma[:2], 3),
            ],
            ["its rotation, x to y (degrees)", _with_error([placement.rotation], placement.sigma[2:3], 3)],
            ["its magnification", _with_error([placement.magnification], placement.sigma[3:], 5)],
            ["background of the clear frames (counts)", _pair(measurement.background[2:], 1)],
            ["counts that make an intensity of 1", _pair(measurement.counts, 0)],
            ["light of image 1 over that of image 2, with the mask", f"{measurement.flux_ratio[0]:.3f}"],
            ["the same, without the mask", f"{measurement.flux_ratio[1]:.3f}"],
            ["points of the pupil", measurement.pupil.n_points],
            ["bad points of the pupil", measurement.n_bad],
            ["points without a unique solution", int(result.n_unsolved)],
            ["correlation of the frames with their fit (too optimistic)", _pair(agreement.correlation, 3)],
            ["rms difference of the frames (mean = 1)", _pair(agreement.residual, 3)],
            ["excess light around the pupil (mean = 1)", f"{agreement.excess_light:.3f}"],
        ],
    )


def image_table(frames: Sequence[Image], clear_frames: Sequence[Image]) -> Table:
    """Size, brightest good pixel and number of bad pixels of each image."""
    rows = [
        [image.name, *image.counts.shape, f"{image.counts[~image.bad].max():.5g}", int(image.bad.sum())]
        for image in (*frames, *clear_frames)
    ]
    return Table(["image", "rows", "columns", "brightest good pixel", "bad pixels"], rows)


def header_table(path: str) -> Table:
    """Some keywords of the phase map."""
    from astropy.io import fits  # not in the page, where only this table needs it

    header = fits.getheader(path)
    return Table(["keyword", "value"], [[key, header[key]] for key in SHOWN], digits=5)


def _with_error(values: Sequence[float] | NDArray, errors: NDArray, digits: int) -> str:
    """Values with their standard errors; a value without one was not determined."""
    pairs = zip(values, errors, strict=True)
    return ", ".join(
        f"{value:.{digits}f} ± {error:.{digits}f}"
        if np.isfinite(error)
        else f"{value:.{digits}f} (not determined)"
        for value, error in pairs
    )


def _pair(values: Sequence[float] | NDArray, digits: int) -> str:
    """Values with a number of digits."""
    return ", ".join(f"{value:.{digits}f}" for value in values)


def findings(
    verdict: Verdict, rms: float, errors: Sequence[float] | None = None, error_flat: float | None = None
) -> Text:
    """Say how good the phase is: by the verdict, and by the commands of a simulated bench, rad rms."""
    noise = "Without a gain of the camera, the phase has no error bar."
    if verdict.sigma is not None:
        noise = f"Noise alone causes an error of {two_digits(float(np.nanmedian(verdict.sigma)))} rad (median)."
    if errors is None or error_flat is None:
        answer = next(iter(verdict.findings.values())).partition(". ")[0].rstrip(".")
        return Text(f"Your frames: {answer[:1].lower()}{answer[1:]}. {noise}")
    return Text(
        f"The frames are simulated: pistons of {rms:.2g} rad rms. The reconstructed pistons are wrong by "
        f"{two_digits(errors[-1])} rad rms. {noise} [Subtracting the phase of a flat "
        "mirror](#subtract-the-flat-mirror) removes the static aberration of the bench, and "
        f"{two_digits(error_flat)} rad rms remain."
    )
