"""Calibration of the simulated bench: a fitted model of its optics, and the segments measured with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.bench import ARMS, BenchCurves, middle_rows
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import LOOKS, show_intensity, show_phase
from studies.kit.tables import Table
from zwfs import PhaseShifted
from zwfs.bench import Bench, BenchModel, segment_pistons, segment_residual, segment_screens
from zwfs.frames import FittedSensor, fit_bench
from zwfs.frames.joint import JointFit

LIMITS = parameter_limits(
    "inputs n_screens n_iterations",
    n_pixels=(32, 200),
    extent=(1.1, 2.0),
    n_commands=(2, 50),
    rms_commands=(0.05, 2.0),
    photons=(100.0, 1e9),
)
QUICK = {"n_pixels": 36, "n_commands": 2, "inputs": [0.8], "n_screens": 1}

WAYS = {
    "design": "model of the design",
    "design, less flat": "model of the design, less its flat",
    "calibrated": "calibrated model",
    "shuffled": "control: calibrated with shuffled commands",
}
"""Ways to measure the segments, and their names in the figure."""

_N_DARKS = 16  # averaged
_FIT: dict[str, Any] = {"n_inner": 30, "tolerance": 5e-4}
_CONTROL_STEPS = 4  # of a fit that cannot succeed


class Shot(NamedTuple):
    """One pair of frames, less the dark, photoelectrons."""

    counts: NDArray[np.float64]  # (2, ny, nx)
    sigma: NDArray[np.float64]  # noise of each pixel, rms


@dataclass(frozen=True, eq=False)
class CalibrationFrames:
    """Frames with which a bench is calibrated, less the dark, photoelectrons."""

    bench: Bench
    commands: NDArray[np.float64]  # (n_commands + 1, n_segments), rad; the first one is flat
    frames: NDArray[np.float64]  # (n_commands + 1, 2, ny, nx)
    clear: NDArray[np.float64]  # (2, ny, nx)
    dark: NDArray[np.float64]  # (2, ny, nx)

    @property
    def noise(self) -> float:
        """Noise of a pixel without light, photoelectrons rms."""
        return float(np.hypot(np.sqrt(self.bench.background), self.bench.read_noise))

    def shot(self, command: NDArray, seed: np.random.SeedSequence) -> Shot:
        """Take frames of a different command."""
        counts = self.bench.frames(command, seed) - self.dark
        return Shot(counts, np.sqrt(np.maximum(counts, 0) + self.noise**2))


@lru_cache(maxsize=16)  # a new bench computes its dimples anew
def dimmed(bench: Bench, photons: float) -> Bench:
    """Return the bench with other exposures: photons per pixel of the pupil, and background and noise to match."""
    total = photons * np.count_nonzero(bench.segments)
    share = total / bench.photons
    background, read_noise = share * bench.background, np.sqrt(share) * bench.read_noise
    return replace(bench, photons=total, background=background, read_noise=read_noise)


def take_calibration_frames(bench: Bench, n_commands: int, rms: float, seed: int = 0) -> CalibrationFrames:
    """Take frames of a flat and of random segment commands, clear frames and darks."""
    draws, masked, clear, *darks = np.random.SeedSequence(seed).spawn(3 + _N_DARKS)
    commands = rms * np.random.default_rng(draws).normal(size=(n_commands + 1, bench.n_segments))
    commands[0] = 0
    dark = np.mean([bench.dark(one) for one in darks], axis=0)
    frames, clear_frames = bench.frames(commands, masked) - dark, bench.clear_frames(clear) - dark
    return CalibrationFrames(bench, commands, frames, clear_frames, dark)


def fit_models(taken: CalibrationFrames) -> dict[str, JointFit]:
    """Fit the model of the optics to the frames, and for control to the frames with shuffled commands."""
    names = "calibrated", "shuffled"
    return dict(zip(names, sweeps.run(_fit_model, names, taken, name="fit_models"), strict=True))


def _fit_model(name: str, taken: CalibrationFrames) -> JointFit:
    """Fit one of the two models."""
    bench, commands, settings = taken.bench, taken.commands, _FIT
    if name == "shuffled":
        commands, settings = np.roll(commands, 1, axis=0), {**_FIT, "errors": False, "n_steps": _CONTROL_STEPS}
    known = bench.commanded_phase(commands)
    return fit_bench(taken.frames, taken.clear, known, n_pixels=bench.n_pixels, noise=taken.noise, **settings)


class FittedParameter(NamedTuple):
    """A parameter of the bench, put in and fitted."""

    name: str
    true: float
    value: float
    sigma: float

    @property
    def deviation(self) -> float:
        """Error over its standard deviation."""
        return (self.value - self.true) / self.sigma


def fitted_parameters(bench: Bench, fit: JointFit) -> list[FittedParameter]:
    """Parameters of the bench next to those of a fit."""
    index = {one.name: number for number, one in enumerate(fit.estimates)}
    values = np.array([one.value for one in fit.estimates])

    def row(name: str, true: float, plus: str, minus: str | None = None) -> FittedParameter:
        weights = np.zeros(len(values))
        weights[index[plus]] = 1
        if minus is not None:
            weights[index[minus]] = -1
        sigma = np.sqrt(weights @ fit.covariance @ weights)
        return FittedParameter(name, true, float(weights @ values), float(sigma))

    return [
        row("diameter of the dimple (λ/D)", bench.diameter * (1 + bench.dimple_error), "diameter"),
        row("phase shift of the first image (rad)", bench.phase, "first"),
        row("phase shift of the second image (rad)", -bench.phase, "second"),
        row("leakage", bench.leakage, "leakage"),
        row("blur (pixels rms)", bench.blur, "blur"),
        row("focus difference (D²/λ)", bench.focus_difference, "arm 0 focus", "arm 1 focus"),
        row("distance of the images, rows (pixels)", bench.misregistration, "arm 0 row", "arm 1 row"),
        row("distance of the images, columns (pixels)", bench.misregistration, "arm 0 column", "arm 1 column"),
    ]


@dataclass(frozen=True, eq=False)
class Example:
    """One screen: its frames, those that the models predict for the measured phases, and the errors."""

    commanded: NDArray[np.float64]  # (n_segments,), rad
    measured: Shot
    modelled: dict[str, NDArray[np.float64]]  # (2, ny, nx) for each model, photoelectrons
    residuals: dict[str, NDArray[np.float64]]  # (n_segments,) for each of `WAYS`, rad


def measure_segments(
    taken: CalibrationFrames,
    fits: Mapping[str, JointFit],
    rms: ArrayLike,
    n_screens: int,
    *,
    n_iterations: int = 25,
    seed: int = 0,
) -> tuple[BenchCurves, list[list[Example]]]:
    """Measure random segment commands, which no calibration has seen, with each of `WAYS`."""
    rms, bench = np.asarray(rms, dtype=float), taken.bench
    model = BenchModel.from_images(bench, seed)
    design = _Design(model, PhaseShifted(model.shifted, n_iterations=n_iterations))
    sensors = {name: FittedSensor(fit, n_steps=2) for name, fit in fits.items()}
    flat, _ = design(taken.shot(np.zeros(bench.n_segments), np.random.SeedSequence(seed, spawn_key=(0,))))
    models = {"design": design, **{name: _Fitted(sensor) for name, sensor in sensors.items()}}
    flats = {"design": flat, **{name: sensor.flat for name, sensor in sensors.items()}}
    tasks = [(row, column) for row in range(len(rms)) for column in range(n_screens)]
    examples = sweeps.run(_measure, tasks, rms, seed, taken, models, flats, name="measure_segments")
    rows = [examples[start : start + n_screens] for start in range(0, len(examples), n_screens)]
    commanded = np.array([[one.commanded for one in row] for row in rows])
    residuals = {
        name: np.array([[one.residuals[name] for one in row] for row in rows]) for name in examples[0].residuals
    }
    return BenchCurves(rms, commanded, residuals), rows


@dataclass(frozen=True, eq=False)
class _Design:
    """The phase-shifted iteration with the model of the design."""

    model: BenchModel
    reconstruct: PhaseShifted

    def __call__(self, shot: Shot) -> tuple[NDArray, NDArray]:
        """Phase of a frame set, and the frames that the model predicts for it."""
        estimate = self.reconstruct(shot.counts / self.model.scale)
        return estimate.phase, self.model.shifted.measure(estimate.phase) * self.model.scale


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A fitted model."""

    sensor: FittedSensor

    def __call__(self, shot: Shot) -> tuple[NDArray, NDArray]:
        """Phase of a frame set, and the frames that the model predicts for it."""
        phase = self.sensor(*shot)
        return phase, self.sensor.frames(phase)


def _measure(
    task: tuple[int, int],
    rms: NDArray,
    seed: int,
    taken: CalibrationFrames,
    models: Mapping[str, _Design | _Fitted],
    flats: Mapping[str, NDArray],
) -> Example:
    """Measure one screen with each model."""
    bench = taken.bench
    screen, noise = np.random.SeedSequence(seed, spawn_key=(1, *task)).spawn(2)
    [command] = segment_screens(bench, rms[task[0]], 1, seed=screen)
    shot = taken.shot(command, noise)
    modelled, residuals = {}, {}
    for name, find in models.items():
        phase, modelled[name] = find(shot)
        pistons, flat = (segment_pistons(one, bench.segments, bench.numbers) for one in (phase, flats[name]))
        if name == "design":
            residuals[name] = segment_residual(pistons, command)
        residuals["design, less flat" if name == "design" else name] = segment_residual(pistons - flat, command)
    return Example(command, shot, modelled, residuals)


_LINES = {"design": ":", "design, less flat": "--", "calibrated": "-", "shuffled": "-."}


def _style(name: str) -> dict[str, Any]:
    """Keywords of a curve for `plot`; the model of the design has the colour of its reconstructor."""
    look = LOOKS["PhaseShifted"]
    color, marker = {"calibrated": ("#333333", "*"), "shuffled": ("#777777", "x")}.get(
        name, (look.color, look.marker)
    )
    hollow = {"markerfacecolor": "none"} if name == "design, less flat" else {}
    return {"color": color, "marker": marker, "linestyle": _LINES[name]} | hollow


def draw_calibration_errors(curves: BenchCurves, example: Example, segments: NDArray) -> Figure:
    """Error of the segments against the input, for each model, and the errors of one screen."""
    figure, (linearity, points) = plt.subplots(1, 2, figsize=(7, 4.6))
    for name, label in WAYS.items():
        style = _style(name)
        linearity.semilogy(curves.rms, curves.mean(name), ms=7, label=label, **style)
        if name != "shuffled":
            points.plot(segments, example.residuals[name], **{**style, "linestyle": ""}, ms=6)
    linearity.set(xlabel="input (rad rms over the segments)", ylabel="error (rad rms)", xlim=(0, None))
    linearity.yaxis.set_major_locator(LogLocator())
    linearity.yaxis.set_minor_formatter(NullFormatter())
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(*linearity.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


def draw_calibration_frames(example: Example) -> Figure:
    """Measured frames of one screen, and their differences from the frames of each model in units of the noise."""
    titles = {"design": "model of\nthe design", "shuffled": "control", "calibrated": "calibrated\nmodel"}
    figure, panels = plt.subplots(2, 1 + len(titles), figsize=(7, 4.6))
    counts, sigma = example.measured
    misfits = {name: (counts - example.modelled[name]) / sigma for name in titles}
    limits = {name: float(np.quantile(np.abs(misfits[name]), 0.99)) for name in ("design", "calibrated")}
    for axes, image, arm in zip(panels[:, 0], counts / np.quantile(counts, 0.999), ARMS, strict=True):
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


def error_columns(curves: BenchCurves) -> dict[str, NDArray]:
    """Mean error of each of `WAYS`."""
    return {
        "input (rad rms)": curves.rms,
        **{f"{label}: mean error (rad rms)": curves.mean(name) for name, label in WAYS.items()},
    }


def frame_columns(example: Example) -> dict[str, NDArray]:
    """Middle rows of the measured and modelled images."""
    return middle_rows({"measured": example.measured.counts, **example.modelled})


def parameter_table(parameters: Sequence[FittedParameter]) -> Table:
    """Parameters put in, those fitted, and their differences in units of the error bar."""
    return Table(
        ["parameter", "put in", "fitted", "error bar", "deviation (error bars)"],
        [
            [one.name, f"{one.true:.5g}", f"{one.value:.5g}", f"{one.sigma:.1g}", f"{one.deviation:+.1f}"]
            for one in parameters
        ],
    )


def numbers(
    taken: CalibrationFrames, parameters: Sequence[FittedParameter], curves: BenchCurves, example: Example
) -> dict[str, float | str]:
    """Numbers for the text: settings, errors at the input of the example, and agreement of its frames."""
    bench = taken.bench
    place = int(np.argmin(np.abs(curves.rms - example.commanded.std())))
    found = {
        "commands": len(taken.commands) - 1,
        "shown": curves.rms[place],
        "photons": bench.photons / np.count_nonzero(bench.segments),
        "largest_deviation": max(abs(one.deviation) for one in parameters),
    }
    for name in WAYS:
        short, mean = "less_flat" if name == "design, less flat" else name, curves.mean(name)
        found |= {f"{short}_error": mean[place], f"{short}_largest": mean.max()}
    found["improvement"] = found["less_flat_error"] / found["calibrated_error"]
    counts, sigma = example.measured
    lit = np.pad(bench.segments > 0, (counts.shape[-1] - bench.n_pixels) // 2)
    for name, frames in example.modelled.items():
        found[f"{name}_misfit"] = np.sqrt(np.mean(((frames - counts) / sigma) ** 2))
        pairs = zip(frames, counts, strict=True)
        found[f"{name}_correlation"] = min(np.corrcoef(one[lit], other[lit])[0, 1] for one, other in pairs)
    return rounded(found, ".4g")
