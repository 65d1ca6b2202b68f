"""Phase and amplitude from two masks and a clear frame, and the cost of a wrong amplitude. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import screen_errors, stacked
from studies.kit.setups import screens_at
from studies.kit.style import LOOKS, show_intensity, show_phase
from studies.kit.tables import Table, Text, two_digits
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.modes import power_law_screens
from zwfs.pupil import Pupil
from zwfs.reconstructors import LikelihoodReconstruction, MaximumLikelihood, PhaseShifted, Reconstruction
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes diameter phase_shift rms n_screens exponent",
    n_pixels=(16, 200),
    variations=[(0.0, 0.4)],  # dips cannot vary much more
    shown=(0.0, 0.4),
    photons=(1.0, 1e9),
)
QUICK = {"variations": [0.0, 0.1, 0.3], "n_screens": 2}

KINDS = ("scintillation", "dips")
"""Kinds of amplitude maps, see `amplitude_maps`."""
_SPOTS, _WIDTH = 12, 0.05  # dips of one map, and their standard deviation, D


class Way(NamedTuple):
    """Method, by the name of its class, and its amplitude: "ignored" (uniform), "measured" or "estimated"."""

    method: str
    amplitude: str


WAYS = {
    f"{method}, {amplitude}": Way(method, amplitude)
    for method, amplitude in (
        ("PhaseShifted", "ignored"),
        ("MaximumLikelihood", "ignored"),
        ("PhaseShifted", "measured"),
        ("MaximumLikelihood", "measured"),
        ("MaximumLikelihood", "estimated"),
    )
}
"""Ways to reconstruct a phase from two masks and a clear frame, by name."""
ESTIMATED = "MaximumLikelihood, estimated"


@dataclass(frozen=True)
class AmplitudeCurves:
    """Errors of the ways of `WAYS` against the variation of the amplitude, next to the bound."""

    variations: NDArray[np.floating]  # (n,), rms over mean
    errors: dict[str, NDArray[np.float64]]  # (n, n_screens) of each way, radian rms
    consistent: dict[str, NDArray[np.bool_]]  # (n, n_screens) of each way of maximum likelihood
    bound: NDArray[np.float64]  # (n,), radian rms

    def error(self, way: str) -> NDArray[np.float64]:
        """Error of a way, rms over the screens, shape (n,), radian rms."""
        return np.sqrt(np.mean(self.errors[way] ** 2, axis=1))

    def at(self, variation: float) -> int:
        """Place of the sampled variation, but 0, nearest to `variation`: text on it names the sampled value."""
        return int(np.argmin(np.where(self.variations > 0, np.abs(self.variations - variation), np.inf)))


def amplitude_maps(
    pupil: Pupil,
    modes: ArrayLike,
    kind: str,
    variation: float,
    n_maps: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Random maps of an amplitude whose mean square over the pupil is 1."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "scintillation":
        logarithms = pupil.gather(power_law_screens(modes, 1.0, n_maps, exponent, rng))
    else:
        centers = pupil.points[rng.integers(pupil.n_points, size=(n_maps, _SPOTS))]
        squares = np.sum((pupil.points[:, np.newaxis] - centers[:, np.newaxis]) ** 2, axis=-1)
        logarithms = -np.sum(np.exp(-squares / (2 * _WIDTH**2)), axis=-1)
    return pupil.scatter(np.array([_varied(logarithm, variation) for logarithm in logarithms]), fill=0)


def _varied(logarithm: NDArray, variation: float) -> NDArray[np.float64]:
    """Amplitude of a variation and a mean square of 1 whose logarithm is a multiple of a map, plus a constant."""
    logarithm = (logarithm - logarithm.max()) / logarithm.std()

    def amplitude(scale: float) -> NDArray:
        values = np.exp(scale * logarithm)
        return values / np.sqrt(np.mean(values**2))

    def excess(scale: float) -> float:  # increases with the scale
        values = amplitude(scale)
        return float(values.std() / values.mean()) - variation

    return amplitude(brentq(excess, 0, 20)) if variation else amplitude(0)


def amplitude_curves(
    sensor: ZernikeSensor,
    modes: NDArray,
    variations: ArrayLike,
    rms: float,
    n_screens: int,
    photons: float,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> dict[str, AmplitudeCurves]:
    """Error of the phase against the variation of the amplitude, for each way and kind of amplitude."""
    variations = np.asarray(variations, float)
    shared = sensor, modes, rms, n_screens, photons, exponent, seed
    cells = product(KINDS, enumerate(variations.tolist()))
    points = sweeps.table(_point, cells, *shared, name="amplitude_curves")
    n = variations.size
    parts = {kind: slice(n * place, n * (place + 1)) for place, kind in enumerate(KINDS)}
    return {
        kind: AmplitudeCurves(
            variations,
            {way: error[part] for way, error in points["errors"].items()},
            {way: consistent[part] for way, consistent in points["consistent"].items()},
            points["bound"][part],
        )
        for kind, part in parts.items()
    }


def _point(
    cell: tuple[str, tuple[int, float]],
    sensor: ZernikeSensor,
    modes: NDArray,
    rms: float,
    n_screens: int,
    photons: float,
    exponent: float,
    seed: int,
) -> dict[str, Any]:
    """One kind and variation: errors and consistent, (n_screens,) each, by way, and the bound."""
    kind, (place, variation) = cell
    phases = screens_at(modes, rms, n_screens, seed, 0, exponent)
    amplitudes = amplitude_maps(sensor.pupil, modes, kind, variation, n_screens, exponent=exponent, seed=seed)
    noise = np.random.SeedSequence(seed, spawn_key=(KINDS.index(kind), place))
    frames = noisy_frames(sensor, phases, amplitudes, photons, noise)
    errors, consistent = {}, {}
    for way in WAYS:
        results = reconstruct(way, sensor, frames, photons)
        errors[way] = reconstruction_error(
            sensor.pupil, np.concatenate([result.phase for result in results]), phases
        )
        consistency = [result.consistent for result in results if isinstance(result, LikelihoodReconstruction)]
        if consistency:
            consistent[way] = np.concatenate(consistency)
    bounds = [
        cramer_rao(sensor, phase, photons=photons, amplitude=amplitude, amplitude_known=False)
        for phase, amplitude in zip(phases, amplitudes, strict=True)
    ]
    bound = float(np.sqrt(np.nanmean(np.square(bounds))))
    return {"errors": errors, "consistent": consistent, "bound": bound}


def noisy_frames(
    sensor: ZernikeSensor, phases: ArrayLike, amplitudes: ArrayLike, photons: float, seed: Any = 0
) -> NDArray[np.float64]:
    """Frames with photon noise, for a number of photons per point and image."""
    camera = Detector(photons)
    return camera.normalise(camera.expose(sensor.measure(phases, amplitudes), seed))


def reconstruct(way: str, sensor: ZernikeSensor, frames: NDArray, photons: float) -> list[Reconstruction]:
    """Reconstruct frame sets (k, n_masks, ny, nx) in a way of `WAYS`; `photons` as for `noisy_frames`."""
    method, source = WAYS[way]
    if source == "estimated":
        return [MaximumLikelihood(sensor, photons=photons, amplitude="unknown")(frames)]
    pair = ZernikeSensor(sensor.pupil, *sensor.masks[:-1], extent=sensor.extent, tolerance=sensor.tolerance)
    batches: list[tuple[NDArray | None, NDArray]] = [(None, frames)]
    if source == "measured":
        batches = [(np.sqrt(images[-1][sensor.window]), images[np.newaxis]) for images in frames]
    if method == "PhaseShifted":
        return [PhaseShifted(pair, amplitude=amplitude)(images[:, :-1]) for amplitude, images in batches]
    return [
        MaximumLikelihood(pair, photons=photons, amplitude=amplitude, n_starts=1)(images[:, :-1])
        for amplitude, images in batches
    ]


_LINES = {"ignored": ":", "measured": "--", "estimated": "-"}


def draw_amplitude_errors(curves: Mapping[str, AmplitudeCurves]) -> Figure:
    """Error of each way and the bound against the variation of the amplitude, one panel for each kind."""
    figure, panels = plt.subplots(1, len(curves), figsize=(7, 5), sharey=True, squeeze=False)
    for axes, (kind, curve) in zip(panels[0], curves.items(), strict=True):
        percent = 100 * curve.variations
        axes.semilogy(percent, curve.bound, color="#999999", lw=5, solid_capstyle="round", label="bound", zorder=0)
        for name, way in WAYS.items():
            look = LOOKS[way.method]
            style = {"color": look.color, "marker": look.marker, "linestyle": _LINES[way.amplitude], "ms": 6}
            style["markerfacecolor"] = "white" if way.amplitude == "measured" else look.color
            axes.plot(percent, curve.error(name), label=f"{look.name}, amplitude {way.amplitude}", **style)
        axes.set_title(kind, fontsize=10)
        axes.set(xlabel="variation of the amplitude (%)", xlim=(0, None))
    panels[0, 0].set_ylabel("phase error (rad rms)")
    panels[0, 0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panels[0, 0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
    panels[0, 0].yaxis.set_minor_formatter(NullFormatter())
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=1)
    return figure


def draw_phase_and_amplitude(
    pupil: Pupil, phase: NDArray, amplitude: NDArray, estimate: LikelihoodReconstruction
) -> Figure:
    """True and estimated phase and amplitude of one frame set, and their differences."""
    figure, panels = plt.subplots(2, 3, figsize=(7, 5), layout="constrained")
    outside = np.where(pupil.inside, 0.0, np.nan)
    residual = wrapped_residual(pupil, estimate.phase, phase)
    phases = phase + outside, phase + residual, residual
    amplitudes = amplitude + outside, estimate.amplitude, estimate.amplitude - amplitude
    titles = "true", "estimated", "difference"
    limit, small = (
        max(float(np.nanmax(np.abs(image))) for image in images) for images in (phases[:2], phases[2:])
    )
    for axes, image, title in zip(panels[0], phases, titles, strict=True):
        shown = show_phase(axes, image, small if title == "difference" else limit)
        axes.set_title(f"phase,\n{title}", fontsize=10)
        figure.colorbar(shown, ax=axes, label="rad", shrink=0.85)
    largest = float(np.nanmax(amplitudes[0]))
    for axes, image, title in zip(panels[1], amplitudes, titles, strict=True):
        if title == "difference":
            shown = show_phase(axes, image, float(np.nanmax(np.abs(image))))
        else:
            shown = show_intensity(axes, image, largest)
        axes.set_title(f"amplitude,\n{title}", fontsize=10)
        figure.colorbar(shown, ax=axes, label="amplitude (mean = 1)", shrink=0.85)
    return figure


def amplitude_screens(curves: Mapping[str, AmplitudeCurves]) -> dict[str, NDArray]:
    """Errors of every single screen."""
    variation = "variation of the amplitude"
    return stacked(
        "kind", {kind: screen_errors(variation, curve.variations, curve.errors) for kind, curve in curves.items()}
    )


def findings(curves: Mapping[str, AmplitudeCurves], rms: float, photons: float) -> Text:
    """Return what an ignored and an estimated amplitude cost."""
    any_curves = next(iter(curves.values()))
    place = any_curves.at(0.05)
    ignored = [
        (curve.error(name) / curve.bound)[place]
        for curve in curves.values()
        for name, way in WAYS.items()
        if way.amplitude == "ignored"
    ]
    estimated = max(np.max(curve.error(ESTIMATED) / curve.bound) for curve in curves.values())
    return Text(
        f"**If an amplitude variation of {100 * any_curves.variations[place]:g} % is ignored, the phase error is "
        f"{two_digits(min(ignored))} to {two_digits(max(ignored))} times the photon limit, the Cramér-Rao bound. "
        f"If maximum likelihood estimates phase and amplitude together, it is at most {estimated:.3g} times this "
        f"limit.** The input is {rms:g} rad rms, with {photons:g} photons per point and image."
    )


def findings_example(pupil: Pupil, phase: NDArray, amplitude: NDArray, estimate: LikelihoodReconstruction) -> Text:
    """Return the errors of one estimate, and the shares of them within their standard errors."""
    sizes, shares = [], []
    for error, sigma in (
        (wrapped_residual(pupil, estimate.phase, phase), estimate.sigma),
        (np.asarray(estimate.amplitude) - amplitude, np.asarray(estimate.sigma_amplitude)),
    ):
        sizes.append(two_digits(np.sqrt(np.mean(pupil.gather(error) ** 2))))
        shares.append(f"{np.mean(np.abs(pupil.gather(error)) < pupil.gather(sigma)):.0%}")
    return Text(
        f"In this example the error of the phase is {sizes[0]} rad rms, and that of the amplitude {sizes[1]}. "
        f"{shares[0]} and {shares[1]} of the points are within one standard error; 68% are expected."
    )


def costs_table(curves: Mapping[str, AmplitudeCurves]) -> Table:
    """Return the error over the bound, and the share of consistent frame sets, of each way, at two variations."""
    places = [
        (curve, place, f"{kind}, {100 * curve.variations[place]:g} %")
        for kind, curve in curves.items()
        for place in sorted({curve.at(0.05), curve.at(0.2)})
    ]
    rows = []
    for name, way in WAYS.items():
        ratios = [f"{curve.error(name)[place] / curve.bound[place]:.2f}" for curve, place, _ in places]
        shares = [curve.consistent[name][place] for curve, place, _ in places if name in curve.consistent]
        consistent = f"{np.mean(shares):.0%}" if shares else "not tested"
        rows.append([LOOKS[way.method].name, way.amplitude, *ratios, consistent])
    return Table(["method", "amplitude", *(title for _, _, title in places), "consistent"], rows)
