"""Range of two images, beyond the paper: errors against the input, with photon noise and with errors of the model.

Errors are radian rms over the pupil, without piston and modulo 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.curves import ErrorCurves, crossing, percent
from studies.kit.iteration import iteration_spectrum
from studies.kit.methods import ACCELERATED, LIKELY, MODES, PLAIN, compared_methods, method_line, method_look
from studies.kit.parameters import SETUP, Fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import SCREENS, Noise, Screens, screens_at
from studies.kit.style import LOOKS, OTHER_STYLES
from zwfs.bounds import cramer_rao
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.reconstructors import Arcsine, Linear, MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes diameter phase_shift n_screens exponent n_iterations threshold",
    inputs=[(0.01, 4.0)],
    inputs_noiseless=[(0.01, 12.0), ...],
    inputs_limit=[(0.1, 4.0)],
    photons=[(1.0, 1e12)],
    photons_shown=(1.0, 1e12),
    diameter_error=(-0.5, 0.5),
    shift_error=(-0.5, 0.5),
    image_shift=(0.0, 5.0),
    amplitude_error=(0.0, 0.3),
    n_subpixels=(2, 8),
    n_screens_model=(1, 1000),
    n_screens_limit=(10, 10000),
    screens=Fields(SETUP["screens"].of, kinds={kind: SETUP["screens"].kinds[kind] for kind in SCREENS[:3]}),
)
QUICK = {
    "n_pixels": 40,
    "inputs": [0.1, 0.5, 1.0, 2.0],
    "photons": [1e2, 1e4],
    "n_screens": 2,
    "n_screens_limit": 10,
}
PIXEL_ERROR = 0.01  # rad rms, from which the text calls the size of the pixels important
_WITHOUT_NOISE = 0.0  # photons


@dataclass(frozen=True)
class Trials:
    """Settings that all experiments of the chapter share."""

    n_iterations: int
    source: Screens
    seed: int

    def screens(self, pupil: Pupil, modes: NDArray, rms: float, n_screens: int, task: int) -> NDArray[np.floating]:
        """Screens of one task on a pupil with these modes, see `screens_at`."""
        return screens_at(replace(self.source, pupil=pupil, modes=modes), rms, n_screens, self.seed, task)


def all_methods(sensor: ZernikeSensor, modes: NDArray, n_iterations: int, photons: float) -> dict[str, Any]:
    """Return `compared_methods`, maximum likelihood on modes, and the methods with one image, by name."""
    single = ZernikeSensor(sensor.pupil, sensor.masks[0])
    return {
        "Linear": Linear(single, modes),
        "Arcsine": Arcsine(single, n_iterations=n_iterations),
        **compared_methods(sensor, n_iterations, photons),
        MODES: MaximumLikelihood(sensor, modes, photons=photons or None, n_starts=1),
    }


@dataclass(frozen=True)
class NoiseCurves(ErrorCurves):
    """Errors against the input for one number of photons, the bounds, and whether a solution is consistent."""

    photons: float  # per point and image; 0 without noise
    bound: dict[str, NDArray[np.float64]]  # (n_rms,) by name: LIKELY for points, MODES for modes; radian rms
    consistent: NDArray[np.bool_]  # (n_rms, n_screens), of maximum likelihood

    def median(self, name: str) -> NDArray[np.float64]:
        """Median error over the screens, shape (n_rms,), radian rms."""
        return np.median(self.errors[name], axis=1)

    def complete_up_to(self, name: str, threshold: float) -> float:
        """Largest input up to which a method recovers every screen, radian rms; 0 if there is none."""
        lost = np.flatnonzero(self.recovered(name, threshold) < 1)
        complete = self.rms[: lost[0]] if lost.size else self.rms
        return float(complete[-1]) if complete.size else 0.0


def noise_curves(
    sensor: ZernikeSensor,
    modes: NDArray,
    photons: Sequence[float],
    inputs: Sequence[float],
    inputs_noiseless: Sequence[float],
    n_screens: int,
    trials: Trials,
) -> list[NoiseCurves]:
    """Errors of all methods for each number of photons, and without noise at more inputs."""
    levels = [_WITHOUT_NOISE, *sorted(photons)]
    rms = {level: sorted({*inputs, *([] if level else inputs_noiseless)}) for level in levels}
    # The largest inputs take longest: they begin first, so that all cores end at about the same time.
    points = [(level, task) for level in levels for task in reversed(range(len(rms[level])))]
    tasks = [(level, task, rms[level][task]) for level, task in points]
    methods = {level: all_methods(sensor, modes, trials.n_iterations, level) for level in levels}
    results = sweeps.run(_noise_point, tasks, methods, modes, n_screens, trials, name="noise_curves")
    by_point = dict(zip(points, results, strict=True))
    curves = []
    for level in levels:
        stacked = sweeps.stacked([by_point[level, task] for task in range(len(rms[level]))])
        curves.append(NoiseCurves(np.array(rms[level]), **stacked, photons=level))
    return curves


def _noise_point(
    point: tuple[float, int, float],
    methods: Mapping[float, Mapping[str, Any]],
    modes: NDArray,
    n_screens: int,
    trials: Trials,
) -> dict[str, Any]:
    """One number of photons and input: errors, (n_screens,), bounds, and consistent, (n_screens,)."""
    photons, task, rms = point
    sensor = methods[photons][LIKELY].sensor
    screens = trials.screens(sensor.pupil, modes, rms, n_screens, task)
    noise = Noise(photons)
    errors, consistent = {}, np.zeros(n_screens, bool)
    for name, method in methods[photons].items():
        result = method(noise(method.sensor, screens, np.random.SeedSequence(trials.seed, spawn_key=(task, 0))))
        errors[name] = reconstruction_error(sensor.pupil, result.phase, screens)
        consistent = result.consistent if name == LIKELY else consistent
    if not photons:
        return {"errors": errors, "bound": {}, "consistent": consistent}
    points = sensor.pupil.gather(cramer_rao(sensor, screens, photons=photons))
    coefficients = cramer_rao(sensor, screens, photons=photons, modes=modes)
    bounds = {
        LIKELY: float(np.median(np.sqrt(np.mean(points**2, axis=-1)))),
        MODES: float(np.median(np.sqrt(np.sum(coefficients**2, axis=-1)))),  # modes of unit rms
    }
    return {"errors": errors, "bound": bounds, "consistent": consistent}


@dataclass(frozen=True)
class ModelErrors:
    """How a camera differs from the model of the reconstructors."""

    diameter: float  # of the dimples, relative
    shift: float  # phase shift of the first dimple, relative
    image_shift: float  # of the second image along x, pixels
    amplitude: float  # rms over the pupil, relative
    n_subpixels: int  # along each side of a pixel


class FineCamera:
    """Camera whose pixels average n x n samples of a finer model of the pupil."""

    def __init__(self, sensor: ZernikeSensor, modes: NDArray, n: int) -> None:
        amplitude = np.kron(sensor.pupil.amplitude, np.ones((n, n)))
        self.pupil = Pupil.from_amplitude(amplitude, n_pixels=n * sensor.pupil.n_pixels)
        self._sensor, self._n = ZernikeSensor(self.pupil, *sensor.masks), n
        # The corners of whole pixels reach beyond the unit circle of the modes: a wider circle holds them.
        wider = Pupil.from_amplitude(amplitude, n_pixels=(1 + 2 / sensor.pupil.n_pixels) * self.pupil.n_pixels)
        self.modes = zernike_basis(wider, len(modes), orthonormal=False)

    def mean(self, values: NDArray) -> NDArray:
        """Mean of fine values over each pixel."""
        *batch, height, width = values.shape
        return values.reshape(*batch, height // self._n, self._n, width // self._n, self._n).mean(axis=(-3, -1))

    def frames(self, screens: NDArray, image_shift: float = 0.0) -> NDArray:
        """Frames of fine screens, the second image displaced along x (pixels)."""
        fine = self._sensor.measure(screens)
        whole, part = divmod(image_shift * self._n, 1)
        moved = np.roll(fine[:, 1], -int(whole), axis=-1)
        fine[:, 1] = (1 - part) * moved + part * np.roll(moved, -1, axis=-1)
        return self.mean(fine)


def model_curves(
    sensor: ZernikeSensor,
    modes: NDArray,
    errors: ModelErrors,
    inputs: Sequence[float],
    n_screens: int,
    trials: Trials,
) -> dict[str, ErrorCurves]:
    """Errors of the two best methods on noiseless frames that their model does not describe, by its error."""
    tasks = list(enumerate(inputs))[::-1]
    shared = sensor, modes, errors, n_screens, trials
    points = sweeps.run(_model_point, tasks, *shared, name="model_curves")[::-1]
    return {kind: ErrorCurves(np.array(inputs), by_name) for kind, by_name in sweeps.stacked(points).items()}


def _model_point(
    point: tuple[int, float],
    sensor: ZernikeSensor,
    modes: NDArray,
    errors: ModelErrors,
    n_screens: int,
    trials: Trials,
) -> dict[str, dict[str, NDArray]]:
    """Errors of one input, (n_screens,) by the error of the model and the method."""
    task, rms = point
    camera = FineCamera(sensor, modes, errors.n_subpixels)
    fine = np.where(camera.pupil.inside, trials.screens(camera.pupil, camera.modes, rms, n_screens, task), 0)
    screens = camera.mean(fine)
    methods = compared_methods(sensor, trials.n_iterations, n_starts=1)  # no phase explains the frames
    return {
        kind: {
            name: reconstruction_error(sensor.pupil, methods[name](frames).phase, screens)
            for name in (ACCELERATED, LIKELY)
        }
        for kind, frames in wrong_frames(sensor, errors, camera, fine, screens, trials.seed).items()
    }


def wrong_frames(
    sensor: ZernikeSensor, errors: ModelErrors, camera: FineCamera, fine: NDArray, screens: NDArray, seed: int
) -> dict[str, NDArray]:
    """Noiseless frames of screens, given on the fine and on the camera's grid, by the error of the model."""
    pupil = sensor.pupil
    first, second = (mask for mask in sensor.masks if isinstance(mask, Dimple))
    wider = (Dimple((1 + errors.diameter) * mask.diameter, mask.phase) for mask in (first, second))
    shifted = Dimple(first.diameter, (1 + errors.shift) * first.phase)
    uneven = 0 * pupil.amplitude
    if errors.amplitude:
        uneven = power_law_screens(zernike_basis(pupil, 60), errors.amplitude, 1, -2.0, seed)[0]
    amplitude = pupil.amplitude * (1 + np.where(pupil.inside, uneven, 0))
    return {
        f"amplitude wrong by {errors.amplitude:.0%} rms": sensor.measure(screens, amplitude),
        f"second image {errors.image_shift:g} pixel off": camera.frames(fine, errors.image_shift),
        f"dimples {errors.diameter:.0%} larger": ZernikeSensor(pupil, *wider).measure(screens),
        f"one phase shift {errors.shift:.0%} off": ZernikeSensor(pupil, shifted, second).measure(screens),
        "phase varies within a pixel": camera.frames(fine),
    }


DIMMED, SECANT = "plain, dimmed start", "secant, flat start"
"""Variants of the iteration that have one of the two ingredients of the acceleration."""


@dataclass(frozen=True)
class Causes:
    """Noiseless screens around the limit of the plain iteration, and what limits it."""

    curves: ErrorCurves  # of PLAIN, DIMMED, SECANT, ACCELERATED
    factor: NDArray[np.float64]  # (n_rms, n_screens), of a small error in one plain iteration near the truth
    example: dict[str, NDArray[np.floating]]  # error after each iteration, (n_iterations + 1,) by name
    example_rms: float

    def half(self, name: str, threshold: float) -> tuple[float, float]:
        """Input at which a method recovers half of the screens, and its standard error, radian rms."""
        share, rms = self.curves.recovered(name, threshold), self.curves.rms
        below = np.flatnonzero(share < 0.5)
        if not below.size or below[0] == 0:
            return (0.0 if below.size else np.inf), 0.0
        low, high = below[0] - 1, below[0]
        slope = (share[low] - share[high]) / (rms[high] - rms[low])
        n_screens = self.curves.errors[name].shape[1]
        return float(rms[low] + (share[low] - 0.5) / slope), float(0.5 / np.sqrt(n_screens) / slope)


def causes(
    sensor: ZernikeSensor,
    modes: NDArray,
    inputs: Sequence[float],
    n_screens: int,
    threshold: float,
    trials: Trials,
) -> Causes:
    """Separate the two ingredients of the acceleration on noiseless frames."""
    shared = sensor, modes, n_screens, trials
    points = sweeps.table(_causes_point, enumerate(inputs), *shared, name="causes")
    rms, factor = np.array(inputs), points["factor"]
    curves = ErrorCurves(rms, points["errors"])
    # An example that only the acceleration recovers, and whose iteration contracts near the truth.
    lost = curves.errors[PLAIN] > threshold * rms[:, np.newaxis]
    kept = curves.errors[ACCELERATED] <= threshold * rms[:, np.newaxis]
    places = np.argwhere(lost & kept & (factor < 1))
    task, index = places[len(places) // 2] if len(places) else (len(rms) - 1, 0)
    screen = trials.screens(sensor.pupil, modes, rms[task], n_screens, int(task))[[index]]
    example = {
        name: reconstruction_error(sensor.pupil, result.history[0], screen[0])
        for name, result in _variants(sensor, sensor.measure(screen), trials.n_iterations, history=True).items()
    }
    return Causes(curves, factor, example, float(rms[task]))


def _variants(sensor: ZernikeSensor, frames: NDArray, n_iterations: int, **options: Any) -> dict[str, Any]:
    """Results of the iteration with none, either and both of the ingredients of the acceleration."""
    plain, accelerated, _ = compared_methods(sensor, n_iterations).values()
    one_step = PhaseShifted(sensor, n_iterations=1, tolerance=0.0, accelerate=True)
    dimmed = np.where(sensor.pupil.inside, one_step(frames).phase, 0)
    return {
        PLAIN: plain(frames, **options),
        SECANT: accelerated(frames, start=0 * dimmed, **options),
        DIMMED: plain(frames, start=dimmed, **options),
        ACCELERATED: accelerated(frames, **options),
    }


def _causes_point(
    point: tuple[int, float], sensor: ZernikeSensor, modes: NDArray, n_screens: int, trials: Trials
) -> dict[str, Any]:
    """Errors, (n_screens,) by variant, and contraction factors, (n_screens,), of one input."""
    task, rms = point
    pupil = sensor.pupil
    screens = trials.screens(pupil, modes, rms, n_screens, task)
    results = _variants(sensor, sensor.measure(screens), trials.n_iterations)
    errors = {name: reconstruction_error(pupil, result.phase, screens) for name, result in results.items()}
    diameter = sensor.masks[0].diameter
    factor = [float(np.abs(iteration_spectrum(pupil, diameter, screen)[0])) for screen in screens]
    return {"errors": errors, "factor": factor}


_INK = "#555555"
_BOUND: dict[str, Any] = {"color": "#888888", "lw": 2, "zorder": 1.5}
_FLOOR = 1e-7  # of a drawn error: below it digits are rounding errors


def _input_axes(axes: Axes, threshold: float, bottom: float, *, named: bool = True) -> None:
    """Logarithmic axes of the error against the input, with the line of recovered screens."""
    axes.set(xscale="log", yscale="log", xlabel="input (rad rms)", ylim=(bottom, 4))
    ends = np.array(axes.get_xlim())
    axes.plot(ends, threshold * ends, color=_INK, lw=1, ls=":", zorder=0.5)
    if named:
        axes.annotate(
            percent(threshold), (ends[1], threshold * ends[1]), (3, 0), textcoords="offset points",
            color=_INK, fontsize=9, va="center",
        )  # fmt: skip
    axes.set_xlim(*ends)
    ticks = [tick for tick in (0.05, 0.1, 0.2, 0.5, 1, 2, 4, 10) if ends[0] <= tick <= ends[1]]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)


def _spaced(number: float) -> str:
    """Whole number with spaces between thousands."""
    return f"{number:,.0f}".replace(",", " ")


def draw_range(curves: Sequence[NoiseCurves], shown: float, threshold: float) -> Figure:
    """Median error against the input: all methods for one number of photons, and one method for all."""
    figure, (methods, light) = plt.subplots(1, 2, figsize=(7, 4.6), sharey=True)
    noiseless, *noisy = curves
    chosen = min(noisy, key=lambda curve: abs(np.log(curve.photons / shown)))
    for name in chosen.errors:
        methods.plot(chosen.rms, chosen.median(name), **method_line(name))
    methods.set_title(f"{_spaced(chosen.photons)} photons per point and image", fontsize=10)
    methods.set_ylabel("median error (rad rms)")
    line = method_line(LIKELY) | {"linestyle": ""}
    for curve in noisy:
        name = f"_{_spaced(curve.photons)} photons per point and image"
        light.plot(curve.rms, curve.median(LIKELY), **line | {"label": name})
        light.plot(curve.rms, curve.bound[LIKELY], label=f"{name}, bound", **_BOUND)
        light.annotate(
            _spaced(curve.photons), (curve.rms[-1], curve.median(LIKELY)[-1]), (7, 0),
            textcoords="offset points", fontsize=9, va="center",
        )  # fmt: skip
    light.set_title("maximum likelihood, by photons", fontsize=10)
    exact = noiseless.complete_up_to(LIKELY, threshold)
    bottom = noisy[-1].median(MODES).min() / 3
    if exact:
        light.text(
            0.98, 0.02, f"no noise: all recovered to {exact:g} rad rms", ha="right", fontsize=9, color=_INK,
            transform=light.transAxes,
        )  # fmt: skip
    for axes in (methods, light):
        _input_axes(axes, threshold, bottom, named=axes is methods)
    handles, labels = methods.get_legend_handles_labels()
    [bound] = light.plot([], [], **_BOUND)
    figure.legend(
        [*handles, bound], [*labels, "Cramér-Rao bound"], loc="outside lower center", ncols=2, fontsize=9
    )
    return figure


def draw_model_errors(curves: Mapping[str, ErrorCurves], noise: NoiseCurves, threshold: float) -> Figure:
    """Median error against the input for frames that the model does not describe, for two methods."""
    figure, panels = plt.subplots(1, 2, figsize=(7, 4.6), sharey=True)
    styles = [*OTHER_STYLES, {"color": _INK, "marker": "o", "markerfacecolor": "none", "linestyle": "-"}]
    for axes, name in zip(panels, (ACCELERATED, LIKELY), strict=True):
        for (kind, curve), style in zip(curves.items(), styles, strict=False):
            axes.plot(curve.rms, np.median(curve.errors[name], axis=1), label=kind, ms=5, **style)
        axes.fill_between(
            noise.rms, noise.median(name), 1e-9, color="#999999", alpha=0.3, lw=0, zorder=0.4,
            label=f"below the photon noise of {_spaced(noise.photons)} per point and image",
        )  # fmt: skip
        axes.set_title(method_look(name).name, fontsize=10)
        rms = next(iter(curves.values())).rms
        axes.set_xlim(rms[0] / 1.1, rms[-1] * 1.1)
        _input_axes(axes, threshold, 5e-4)
    panels[0].set_ylabel("median error (rad rms)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


_CAUSES = {
    PLAIN: ("plain: flat start", ":", "v"),
    SECANT: ("secant steps, flat start", "--", "x"),
    DIMMED: ("plain steps, dimmed start", "-.", "^"),
    ACCELERATED: ("accelerated: both", "-", "o"),
}


def draw_causes(found: Causes, threshold: float) -> Figure:
    """Share of recovered screens for the ingredients of the acceleration, and one screen that they decide."""
    figure, (share, example) = plt.subplots(1, 2, figsize=(7, 4.4))
    color = LOOKS[PLAIN].color
    contracts = 100 * np.mean(found.factor < 1, axis=1)
    close = "plain, from close to the true phase"
    share.plot(found.curves.rms, contracts, color=_INK, lw=4, alpha=0.4, label=close)
    for name, (label, dashes, marker) in _CAUSES.items():
        tone = color if name in (PLAIN, ACCELERATED) else OTHER_STYLES[1 if name == SECANT else 2]["color"]
        style: dict[str, Any] = {"color": tone, "ls": dashes, "marker": marker, "ms": 5, "mfc": "#ffffff"}
        recovered = found.curves.recovered(name, threshold)
        error = np.sqrt(recovered * (1 - recovered) / found.curves.errors[name].shape[1])  # of a binomial share
        share.plot(found.curves.rms, 100 * recovered, label=label, **style)
        bars = {"fmt": "none", "ecolor": tone, "lw": 1, "label": f"_{label}"}
        share.errorbar(found.curves.rms, 100 * recovered, 100 * error, **bars)
        example.semilogy(np.maximum(found.example[name], _FLOOR), label=f"_{label}", **style)
    share.set(xlabel="input (rad rms)", ylabel="screens (%)", ylim=(-4, 104))
    example.axhline(threshold * found.example_rms, color=_INK, lw=1, ls=":")
    example.set(xlabel="iterations", ylabel="error (rad rms)", ylim=(_FLOOR / 2, 5))
    example.set_title(f"one screen of {found.example_rms:g} rad rms", fontsize=10)
    share.set_title("screens recovered", fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    return figure


def numbers(
    curves: Sequence[NoiseCurves],
    model: Mapping[str, ErrorCurves],
    found: Causes,
    shown: float,
    threshold: float,
    settings: Mapping[str, float],
) -> dict[str, float | str]:
    """Return the settings and the numbers of the text."""
    noiseless, *noisy = curves
    chosen = min(noisy, key=lambda curve: abs(np.log(curve.photons / shown)))
    few = min(noisy, key=lambda curve: abs(np.log(curve.photons / 1e3)))
    one, two, three = (int(np.argmin(np.abs(chosen.rms - rms))) for rms in (1.0, 2.0, 3.0))
    limit = int(np.argmin(np.abs(found.curves.rms - 2.0)))
    exact = noiseless.complete_up_to(LIKELY, threshold)
    right = noiseless.errors[LIKELY] <= threshold * noiseless.rms[:, np.newaxis]
    usual = (chosen.rms >= 0.1) & (chosen.rms <= 2)
    usual |= not usual.any()
    amplitude, offset, *_, area = model.values()
    place = int(np.argmin(np.abs(area.rms - 1.0)))
    pixels = np.median(area.errors[LIKELY], axis=1)
    result = dict(settings) | {
        "few_photons": few.photons,
        "shown_photons": chosen.photons,
        "modes_share": np.median(chosen.median(MODES)[usual] / chosen.median(LIKELY)[usual]),
        "modes_from": chosen.rms[usual][0],
        "modes_to": chosen.rms[usual][-1],
        "contracting_at_2": np.mean(found.factor[limit] < 1),
        "exact": exact,
        "exact_screens": right[noiseless.rms <= exact].size,
        "half": found.half(PLAIN, threshold)[0],
        "solutions": right.size,
        "solutions_right": np.count_nonzero(right),
        "solutions_missed": np.count_nonzero(noiseless.consistent & ~right),
        "solutions_refused": np.count_nonzero(right & ~noiseless.consistent),
        "pixels_limit": crossing(area.rms, pixels, PIXEL_ERROR),
        "pixels_error": PIXEL_ERROR,
        "model_input": area.rms[place],
        "amplitude_1": np.median(amplitude.errors[LIKELY][place]),
        "offset_1": np.median(offset.errors[LIKELY][place]),
        "input_2": found.curves.rms[limit],
        "input_3": chosen.rms[three],
        "few_likely_3": few.median(LIKELY)[three],
        "shown_likely_1": chosen.median(LIKELY)[one],
        "shown_likely_2": chosen.median(LIKELY)[two],
    }
    for name, method in (("plain", PLAIN), ("dimmed", DIMMED), ("accelerated", ACCELERATED)):
        result[f"{name}_at_2"] = found.curves.recovered(method, threshold)[limit]
    return rounded(result, ".3g")
