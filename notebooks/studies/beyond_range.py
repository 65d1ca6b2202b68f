"""Range of two images, beyond the paper: larger inputs and dimples, photon noise, and errors of the model.

Errors are radian rms over the pupil, without piston and modulo 2 pi. A screen is recovered if its error is at most
a threshold times the input.
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
from studies.kit.curves import ErrorCurves, percent
from studies.kit.experiments import DiameterCurves
from studies.kit.iteration import DARK_RING
from studies.kit.methods import (
    ACCELERATED,
    LIKELY,
    MASKS,
    MODES,
    PLAIN,
    compared_methods,
    method_line,
    method_look,
)
from studies.kit.parameters import SETUP, Fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import SCREENS, Noise, Screens, screens_at
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import Table, Text, small, two_digits
from zwfs.bounds import cramer_rao
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.reconstructors import Arcsine, Linear, MaximumLikelihood
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels diameter phase_shift n_screens exponent n_iterations threshold",
    n_modes=(3, 1000),  # tip, tilt and at least one other mode
    inputs=[(0.01, 4.0)],
    inputs_noiseless=[(0.01, 12.0), ...],
    input_many=(0.01, 4.0),
    n_screens_many=(1, 10000),
    photons=[(1.0, 1e12)],
    photons_shown=(1.0, 1e12),
    diameter_error=(-0.5, 0.5),
    shift_error=(-0.5, 0.5),
    image_shift=(0.0, 5.0),
    amplitude_error=(0.0, 0.3),
    n_subpixels=(2, 8),
    n_screens_model=(1, 1000),
    diameters=[(0.1, 8.0)],
    input_dimple=(0.01, 4.0),
    n_screens_dimple=(1, 1000),
    n_screens_bound=(1, 100),
    screens=Fields(SETUP["screens"].of, kinds={kind: SETUP["screens"].kinds[kind] for kind in SCREENS[:3]}),
)
QUICK = {
    "n_pixels": 40,
    "inputs": [0.1, 0.5, 1.0, 2.0],
    "photons": [1e2, 1e4],
    "n_screens": 2,
    "n_screens_many": 20,
    "diameters": [0.5, 1.0, 2.0, 2.4, 3.0, 4.0],
    "n_screens_dimple": 3,
    "n_screens_bound": 1,
}


@dataclass(frozen=True)
class Trials:
    """Sensor, screens and settings that all experiments of the chapter share."""

    sensor: ZernikeSensor
    source: Screens
    n_iterations: int
    seed: int

    def screens(self, rms: float, n_screens: int, task: int, **changed: Any) -> NDArray[np.floating]:
        """Screens of one task, see `screens_at`; `changed`: a different pupil and its modes."""
        return screens_at(replace(self.source, **changed), rms, n_screens, self.seed, task)

    def methods(self, diameter: float) -> dict[str, Any]:
        """Compared methods for a sensor with dimples of a different diameter, lambda/D."""
        return compared_methods(resized(self.sensor, diameter), self.n_iterations)


def resized(sensor: ZernikeSensor, diameter: float) -> ZernikeSensor:
    """Return a sensor with dimples of a different diameter, lambda/D."""
    masks = (replace(mask, diameter=diameter) for mask in sensor.masks if isinstance(mask, Dimple))
    return ZernikeSensor(sensor.pupil, *masks)


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
    """Errors against the input for one number of photons, and the bound for the phase of every point."""

    photons: float  # per point and image; 0 without noise
    bound: NDArray[np.float64]  # (n_rms,), median over the screens, radian rms

    def median(self, name: str) -> NDArray[np.float64]:
        """Median error over the screens, shape (n_rms,), radian rms."""
        return np.median(self.errors[name], axis=1)


def noise_curves(
    trials: Trials, photons: Sequence[float], inputs: Sequence[float], noiseless: Sequence[float], n_screens: int
) -> list[NoiseCurves]:
    """Errors of all methods without noise, also at the inputs `noiseless`, and for each number of photons."""
    curves = []
    for level in (0.0, *sorted(photons)):
        rms = sorted({*inputs, *([] if level else noiseless)})
        # The largest inputs take longest: they begin first, so that all cores end at about the same time.
        tasks = list(enumerate(rms))[::-1]
        points = sweeps.run(_noise_point, tasks, level, trials, n_screens, name="noise_curves")[::-1]
        curves.append(NoiseCurves(np.array(rms), **sweeps.stacked(points), photons=level))
    return curves


def _noise_point(point: tuple[int, float], photons: float, trials: Trials, n_screens: int) -> dict[str, Any]:
    """One input: errors, (n_screens,) by name, and the bound for the phase of every point."""
    task, rms = point
    sensor, modes = trials.sensor, trials.source.modes
    screens, noise = trials.screens(rms, n_screens, task), Noise(photons)
    drawn = np.random.SeedSequence(trials.seed, spawn_key=(task, 0))
    errors = {
        name: reconstruction_error(sensor.pupil, method(noise(method.sensor, screens, drawn)).phase, screens)
        for name, method in all_methods(sensor, modes, trials.n_iterations, photons).items()
    }
    bound = 0.0
    if photons:
        bound = np.median(_rms(sensor.pupil.gather(cramer_rao(sensor, screens, photons=photons))))
    return {"errors": errors, "bound": bound}


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

    def __init__(self, sensor: ZernikeSensor, n_modes: int, n: int) -> None:
        amplitude = np.kron(sensor.pupil.amplitude, np.ones((n, n)))
        self.pupil = Pupil.from_amplitude(amplitude, n_pixels=n * sensor.pupil.n_pixels)
        self._sensor, self._n = ZernikeSensor(self.pupil, *sensor.masks), n
        # The corners of whole pixels reach beyond the unit circle of the modes: a wider circle holds them.
        wider = Pupil.from_amplitude(amplitude, n_pixels=(1 + 2 / sensor.pupil.n_pixels) * self.pupil.n_pixels)
        self.modes = zernike_basis(wider, n_modes, orthonormal=False)

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
    trials: Trials, errors: ModelErrors, inputs: Sequence[float], n_screens: int
) -> dict[str, ErrorCurves]:
    """Errors of the two best methods on noiseless frames that their model does not describe, by its error."""
    tasks = list(enumerate(inputs))[::-1]
    points = sweeps.run(_model_point, tasks, trials, errors, n_screens, name="model_curves")[::-1]
    return {kind: ErrorCurves(np.array(inputs), by_name) for kind, by_name in sweeps.stacked(points).items()}


def _model_point(
    point: tuple[int, float], trials: Trials, errors: ModelErrors, n_screens: int
) -> dict[str, dict[str, NDArray]]:
    """Errors of one input, (n_screens,) by the error of the model and the method."""
    task, rms = point
    sensor = trials.sensor
    camera = FineCamera(sensor, len(trials.source.modes), errors.n_subpixels)
    fine = trials.screens(rms, n_screens, task, pupil=camera.pupil, modes=camera.modes)
    fine = np.where(camera.pupil.inside, fine, 0)
    screens = camera.mean(fine)
    methods = compared_methods(sensor, trials.n_iterations, n_starts=1)  # no phase explains the frames
    return {
        kind: {
            name: reconstruction_error(sensor.pupil, methods[name](frames).phase, screens)
            for name in (ACCELERATED, LIKELY)
        }
        for kind, frames in wrong_frames(sensor, errors, camera, fine, trials.seed).items()
    }


def wrong_frames(
    sensor: ZernikeSensor, errors: ModelErrors, camera: FineCamera, fine: NDArray, seed: int
) -> dict[str, NDArray]:
    """Noiseless frames of screens, which are given on the camera's fine grid, by the error of the model."""
    pupil, screens = sensor.pupil, camera.mean(fine)
    first, second = (mask for mask in sensor.masks if isinstance(mask, Dimple))
    wider = (Dimple((1 + errors.diameter) * mask.diameter, mask.phase) for mask in (first, second))
    shifted = Dimple(first.diameter, (1 + errors.shift) * first.phase)
    uneven = 0 * pupil.amplitude
    if errors.amplitude:
        uneven = power_law_screens(zernike_basis(pupil, 60), errors.amplitude, 1, -2.0, seed)[0]
    amplitude = pupil.amplitude * (1 + np.where(pupil.inside, uneven, 0))
    return {
        f"amplitude wrong by {percent(errors.amplitude)} rms": sensor.measure(screens, amplitude),
        f"second image {errors.image_shift:g} pixel off": camera.frames(fine, errors.image_shift),
        f"dimples {percent(errors.diameter)} larger": ZernikeSensor(pupil, *wider).measure(screens),
        f"one phase shift {percent(errors.shift)} off": ZernikeSensor(pupil, shifted, second).measure(screens),
        "phase varies within a pixel": camera.frames(fine),
    }


TILT, REST = "tilt", "other modes"


def dimple_bounds(trials: Trials, diameters: NDArray, screens: NDArray) -> dict[str, NDArray[np.float64]]:
    """Bounds over that of an ideal sensor, (n_diameters, 1 + n_screens), of a flat wavefront and screens."""
    phases = np.concatenate([np.zeros((1, *trials.sensor.pupil.shape)), screens])
    return sweeps.table(_bounds_point, diameters.tolist(), trials, phases, name="dimple_bounds")


def _bounds_point(diameter: float, trials: Trials, phases: NDArray) -> dict[str, NDArray[np.float64]]:
    """One diameter of `dimple_bounds`, (k,) around each of the phases."""
    sensor = resized(trials.sensor, diameter)
    photons = 1e4  # per point and image; the ratio does not depend on it
    ideal = 1 / (2 * np.sqrt(sensor.n_masks * photons * sensor.pupil.n_points))
    bounds = cramer_rao(sensor, phases, photons=photons, modes=trials.source.modes) / ideal
    return {TILT: _rms(bounds[:, :2]), REST: _rms(bounds[:, 2:])}  # Noll 2 and 3, and the others


def _rms(values: NDArray) -> NDArray[np.float64]:
    """Rms over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))


_INK = "#555555"
_BOUND: dict[str, Any] = {"color": "#888888", "lw": 2, "zorder": 1.5}


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


def shown_curve(curves: Sequence[NoiseCurves], shown: float) -> NoiseCurves:
    """Return the curves of the number of photons nearest to `shown`: text on them names the sampled number."""
    return min(curves[1:], key=lambda curve: abs(np.log(curve.photons / shown)))


def _complete(x: NDArray, recovered: NDArray) -> float:
    """Return the largest value up to which every screen is recovered; 0 if there is none."""
    lost = np.flatnonzero(recovered < 1)
    complete = x[: lost[0]] if lost.size else x
    return float(complete[-1]) if complete.size else 0.0


def draw_range(curves: Sequence[NoiseCurves], shown: float, threshold: float) -> Figure:
    """Median error against the input: all methods for one number of photons, and one method for all."""
    figure, (methods, light) = plt.subplots(1, 2, figsize=(7, 4.6), sharey=True)
    _, *noisy = curves
    chosen = shown_curve(curves, shown)
    for name in chosen.errors:
        methods.plot(chosen.rms, chosen.median(name), **method_line(name))
    methods.set_title(f"{_spaced(chosen.photons)} photons per point and image", fontsize=10)
    methods.set_ylabel("median error (rad rms)")
    line = method_line(LIKELY) | {"linestyle": ""}
    for curve in noisy:
        name = f"_{_spaced(curve.photons)} photons per point and image"
        light.plot(curve.rms, curve.median(LIKELY), **line | {"label": name})
        light.plot(curve.rms, curve.bound, label=f"{name}, bound", **_BOUND)
        light.annotate(
            _spaced(curve.photons), (curve.rms[-1], curve.median(LIKELY)[-1]), (7, 0),
            textcoords="offset points", fontsize=9, va="center",
        )  # fmt: skip
    light.set_title("maximum likelihood, by photons", fontsize=10)
    bottom = noisy[-1].median(MODES).min() / 3
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


def draw_dimples(curves: DiameterCurves, bounds: Mapping[str, NDArray], threshold: float) -> Figure:
    """Share of recovered screens, and `dimple_bounds`, against the diameter of the dimple."""
    figure, (share, bound) = plt.subplots(1, 2, figsize=(7, 4.6))
    for name in curves.errors:
        share.plot(curves.diameters, 100 * curves.recovered(name, threshold), **method_line(name))
    share.set(ylabel="screens recovered (%)", ylim=(-4, 104))
    for (kind, values), style in zip(bounds.items(), OTHER_STYLES[::2], strict=False):
        color, rms = style["color"], f"{curves.rms[0]:.2g} rad rms"
        bound.semilogy(curves.diameters, values[:, 0], color=color, ls="--", label=f"{kind}, flat wavefront")
        bound.semilogy(curves.diameters, _rms(values[:, 1:]), color=color, label=f"{kind}, {rms}")
    bound.set(ylabel="bound / that of an ideal sensor")
    for axes in (share, bound):
        label = "first dark ring" if axes is share else "_first dark ring"
        axes.axvline(DARK_RING, color="#888888", lw=1.2, zorder=0.5, label=label)
        axes.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=curves.diameters[[0, -1]])
    handles = [artist for axes in (share, bound) for artist in axes.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def instruments_table(curves: Mapping[str, ErrorCurves], threshold: float) -> Table:
    """Number of screens that each method recovers on the masks of instruments."""
    names = list(next(iter(curves.values())).errors)
    rows = []
    for mask, curve in curves.items():
        counts = [np.count_nonzero(curve.errors[name] <= threshold * curve.rms) for name in names]
        cells = (f"{count} of {curve.errors[LIKELY].size}" for count in counts)
        rows.append([f"{mask}, {MASKS[mask][0].diameter:g} λ/D", *cells])
    return Table(["mask", *(method_look(name).name for name in names)], rows)


def findings(curves: Sequence[NoiseCurves], many: ErrorCurves, threshold: float) -> Text:
    """Return how far the methods reach without noise, and the errors that photon noise causes."""
    noiseless, *noisy = curves
    exact = _complete(noiseless.rms, noiseless.recovered(LIKELY, threshold))
    n_screens = noiseless.errors[LIKELY][noiseless.rms <= exact].size
    reach = f"recovers all {n_screens} simulated screens (random phase maps) of up to {exact:.3g} rad rms"
    if not exact:
        reach = f"fails on some simulated screens (random phase maps) of {noiseless.rms[0]:.3g} rad rms"
    plain, accelerated = (f"{many.recovered(name, threshold)[0]:.0%}" for name in (PLAIN, ACCELERATED))
    errors = (f"{two_digits(curve.median(LIKELY)[-1])} rad with {_spaced(curve.photons)}" for curve in noisy)
    ratio = np.median([curve.median(MODES) / curve.median(LIKELY) for curve in noisy])
    return Text(
        f"**Without noise, maximum likelihood {reach}.** Of {many.errors[PLAIN].size} screens of "
        f"{many.rms[0]:.3g} rad rms, the paper's iteration recovers {plain}, its accelerated form {accelerated}. "
        f"Photon noise limits maximum likelihood: at {noisy[0].rms[-1]:.3g} rad rms its median error is "
        f"{', '.join(errors)} photons per point and image. If it fits modes instead of the phase of every "
        f"point, the error is {two_digits(ratio)} times as large (median over inputs and photons)."
    )


def findings_model(model: Mapping[str, ErrorCurves], noise: NoiseCurves) -> Text:
    """Return the largest errors of maximum likelihood that errors of the model cause."""
    rms = next(iter(model.values())).rms
    lines = ["Largest median errors of maximum likelihood:", ""]
    for place in sorted({int(np.argmin(np.abs(rms - 1))), len(rms) - 1}):
        errors = {kind: float(np.median(curve.errors[LIKELY][place])) for kind, curve in model.items()}
        largest = sorted(errors, key=lambda kind: -errors[kind])[:2]
        listed = ", ".join(f"{small(errors[kind])} rad ({kind})" for kind in largest)
        light = f"{small(noise.median(LIKELY)[place])} rad (noise of {_spaced(noise.photons)} photons)"
        lines.append(f"- At {rms[place]:.3g} rad rms: {listed}; for comparison, {light}.")
    return Text("\n".join(lines))


def findings_dimples(curves: DiameterCurves, bounds: Mapping[str, NDArray], threshold: float) -> Text:
    """Return up to which diameter each method recovers every screen, and the bounds at the dark ring."""
    ends = {name: _complete(curves.diameters, curves.recovered(name, threshold)) for name in curves.errors}
    shown = {name: f"up to {end:.3g} λ/D" if end else "at no diameter" for name, end in ends.items()}
    ring = curves.diameters == DARK_RING
    factors = {
        kind: f"{two_digits(values[ring, 0].item())} for a flat wavefront, "
        f"{two_digits(_rms(values[ring, 1:]).item())} around {values.shape[1] - 1} of these screens"
        for kind, values in bounds.items()
    }
    return Text(
        f"**Maximum likelihood recovers all {curves.errors[LIKELY].shape[1]} noiseless screens of "
        f"{curves.rms[0]:.2g} rad rms {shown[LIKELY]}, the paper's iteration {shown[PLAIN]}, and its accelerated "
        f"form {shown[ACCELERATED]}.** We tried {curves.diameters[0]:.3g} to {curves.diameters[-1]:.3g} λ/D. "
        f"At the first dark ring of the Airy pattern, {DARK_RING:.2f} λ/D, the bound for tilt, divided by that of "
        f"an ideal sensor, is {factors[TILT]}."
    )


def numbers(
    curves: Sequence[NoiseCurves], many: ErrorCurves, dimples: DiameterCurves, shown: float, threshold: float
) -> dict[str, float | str]:
    """Return the numbers that the claims and pages of the book quote."""
    chosen = shown_curve(curves, shown)
    result = {
        "shown_photons": chosen.photons,
        "shown_likely_2": chosen.median(LIKELY)[np.argmin(np.abs(chosen.rms - 2))],
        "plain_at_2": many.recovered(PLAIN, threshold)[0],
        "accelerated_at_2": many.recovered(ACCELERATED, threshold)[0],
        "screens_at_2": many.errors[PLAIN].size,
        "last_input": dimples.rms[0],
        "plain_last": dimples.exceeds(PLAIN, threshold * dimples.rms[0]),
        "largest": dimples.diameters[-1],
    }
    return rounded(result, ".3g")
