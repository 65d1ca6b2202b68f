"""Figure 4, section 4.2 of the paper: errors against the diameter of the dimple, and why the iteration diverges.

Everything rests on one identity. With beta the part of the field psi that passes through the dimple and
c_k = exp(i theta_k) - 1, the frame of mask k is |psi|^2 + 2 Re(conj(c_k) W) with

    W = conj(beta) (psi - beta),

because |c_k|^2 = -2 Re(c_k). Two frames of an allowed pair are equivalent to the complex map W, whatever the pair.
A step of the phase-shifted iteration therefore solves conj(beta) (psi' - beta) = W for psi', with the beta of the
estimate before, and keeps its phase: the phase shifts drop out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit.curves import Limit, percent
from studies.kit.experiments import TABLED, DiameterCurves, diameter_curves, up_to
from studies.kit.iteration import DARK_RING, iteration_spectrum, mode_sensitivity
from studies.kit.methods import opposite_dimples, own_reconstructors, paper_reconstructors
from studies.kit.parameters import SETUP, parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import NOISELESS, Noise, check_setup
from studies.kit.style import LOOKS, OTHER_STYLES, TALL, looks_of
from studies.kit.tables import Table, Text, small
from zwfs.masks import Dimple
from zwfs.metrics import wrapped_residual
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels phase_shift n_screens exponent n_iterations extent threshold",
    n_modes=(149, 1000),
    rms=(0.01, 4.0),
    more_iterations=[(1, 10000)],
    step=(0.05, 2.0),
    diameter_max=(1.0, 8.0),
    step_fine=(0.01, 0.3),
    n_screens_few=(1, 1000),
    n_screens_methods=(1, 1000),
    claimed=(0.1, 8.0),
    **SETUP,
)
CHECK_TOGETHER = check_setup
QUICK = {"n_pixels": 64, "n_screens": 4, "step": 0.5, "step_fine": 0.2, "n_screens_few": 2, "n_screens_methods": 4}

FEW = (0.5, 1.0, 1.06, 1.5, 1.6, 1.75, 2.0, 2.2, 2.4, 2.6, 3.0, 3.5, 4.0)
"""Diameters at which the costly methods are compared, lambda/D."""
ITERATION = "PhaseShifted"
USUAL = 1.06
"""Diameter of the paper's other figures, lambda/D."""
SHORT = {
    "Linear": "linear",
    "Arcsine": "arcsine",
    "GerchbergSaxton": "saxton",
    "GradientDescent": "descent",
    "GradientDescentPoints": "descent_points",
}
"""Names of the methods in the numbers for the text."""
_MODES = {"tilt": 0, "defocus": 2, "high order (Noll 150)": 148}  # by their place among the modes


def near_limit(diameters: NDArray, low: float = 1.75, high: float = 2.5) -> NDArray[np.float64]:
    """Diameters for more iterations: fewer suffice below, and more lead away above; all if none is near."""
    near = diameters[(diameters >= low) & (diameters <= high)]
    return near if near.size else diameters


def iteration_curves(
    pupil: Pupil, phase_shift: float, n_iterations: int, diameters: ArrayLike, screens: NDArray, **noise: Any
) -> DiameterCurves:
    """Errors of the phase-shifted iteration, without an early stop; `noise` and `seed` as in `diameter_curves`."""

    def make(diameter: float) -> dict[str, Any]:
        sensor = opposite_dimples(pupil, diameter, phase_shift)
        return {ITERATION: PhaseShifted(sensor, n_iterations=n_iterations, tolerance=0.0)}

    return diameter_curves(make, diameters, screens, **noise)


def other_curves(
    pupil: Pupil,
    modes: NDArray,
    phase_shift: float,
    screens: NDArray,
    *,
    diameter_max: float = FEW[-1],
    own: Sequence[str] = (),
    noise: Noise = NOISELESS,
    seed: int = 0,
    **settings: Any,
) -> DiameterCurves:
    """Errors of the other methods, at few diameters up to the largest one."""

    def make(diameter: float) -> dict[str, Any]:
        methods = paper_reconstructors(pupil, modes, diameter, phase_shift, **settings)
        methods |= own_reconstructors(own, methods, modes)
        del methods[ITERATION]
        return methods

    few = up_to(diameter_max, [*FEW, *np.arange(5.0, diameter_max)])
    return diameter_curves(make, few, screens, noise=noise, seed=seed)


def measured_factor(
    pupil: Pupil, diameter: float, phase: NDArray, away: NDArray, n_iterations: int = 400
) -> float:
    """Factor by which an iteration of `PhaseShifted` multiplies a small error, observed."""
    size = float(pupil.rms(away))
    sensor = ZernikeSensor(pupil, *(Dimple(diameter, theta) for theta in (np.pi / 2, -np.pi / 2)), tolerance=1e-13)
    method = PhaseShifted(sensor, n_iterations=1)
    frames, error, factors = sensor.measure(phase), away, []
    for _ in range(n_iterations):
        error = wrapped_residual(pupil, method(frames, start=phase + error).phase, phase)
        error = np.where(pupil.inside, error, 0)
        factors.append(float(pupil.rms(error)) / size)
        error /= factors[-1]
    return float(np.exp(np.mean(np.log(factors[n_iterations // 2 :]))))


@dataclass(frozen=True)
class Contraction:
    """Factor by which an iteration multiplies a small error, and sensitivity to modes, against the diameter."""

    diameters: NDArray[np.floating]  # (n_diameters,), lambda/D
    flat: NDArray[np.float64]  # (n_diameters,), factor around a flat wavefront
    aberrated: NDArray[np.float64]  # (n_diameters, n_screens), factor around each screen
    observed: dict[float, float]  # factor on the first screen, by diameter
    sensitivity: dict[str, NDArray[np.float64]]  # (n_diameters,) by mode, 1/rad

    def index(self, diameter: float) -> int:
        """Index of the sampled diameter that is nearest to `diameter` (lambda/D)."""
        return int(np.argmin(np.abs(self.diameters - diameter)))


def contraction(
    pupil: Pupil, modes: NDArray, diameters: ArrayLike, screens: NDArray, away: NDArray
) -> Contraction:
    """Return the causes of Figure 4: the linearised iteration and the sensitivity, at each diameter."""
    end = np.max(diameters)
    diameters = np.unique([*np.ravel(diameters), *([DARK_RING] if end > DARK_RING else [])])
    chosen = modes[list(_MODES.values())]
    tabled = [diameter for diameter in TABLED if diameter <= end] or [float(end)]
    observed = {diameter: measured_factor(pupil, diameter, screens[0], away) for diameter in tabled}

    def factor(diameter: float, phase: NDArray | None = None) -> float:
        return float(np.abs(iteration_spectrum(pupil, diameter, phase)[0]))

    sensitivity = np.array([mode_sensitivity(pupil, diameter, chosen) for diameter in diameters]).T
    return Contraction(
        diameters,
        np.array([factor(diameter) for diameter in diameters]),
        np.array([[factor(diameter, screen) for screen in screens] for diameter in diameters]),
        observed,
        dict(zip(_MODES, sensitivity, strict=True)),
    )


def draw_dimple_diameter(curves: Mapping[int, DiameterCurves], threshold: float, claimed: float) -> Figure:
    """Figure 4: mean error and its standard deviation against the diameter of the dimple, on two kinds of axes."""
    figure, (plain, log) = plt.subplots(1, 2, figsize=(7, 4))
    name, floor = ITERATION, 1e-7
    look = LOOKS[name]
    (number, curve), *others = curves.items()
    mean, std = curve.mean(name), curve.std(name)
    for axes, bottom in ((plain, 0), (log, floor)):
        low, high = (np.maximum(mean + sign * std, bottom) for sign in (-1, 1))
        drawn = np.maximum(mean, bottom)
        axes.plot(curve.diameters, drawn, color=look.color, marker=look.marker, ms=4, label=f"{number} iterations")
        scatter = f"_{number} iterations, scatter"
        axes.fill_between(curve.diameters, low, high, color=look.color, alpha=0.2, lw=0, label=scatter)
        _diameters(axes, curve.diameters[-1], claimed)
        axes.set_ylabel("error (rad rms)")
    for index, ((number, longer), style) in enumerate(zip(others, OTHER_STYLES[1:], strict=False)):
        style = style | {"ms": 5, "mfc": "#ffffff" if index % 2 else None, "label": f"{number} iterations"}
        log.plot(longer.diameters, np.maximum(longer.mean(name), floor), **style)
    limit = threshold * curve.rms[0]
    log.axhline(limit, color="#555555", lw=1)
    end = min(1.4 * claimed, curve.diameters[-1])
    start = min(0.64 * claimed, end / 2)
    log.text(end, 1.2 * limit, f"{percent(threshold)} ", color="#555555", fontsize=9, ha="right", va="bottom")
    plain.set_ylim(0, None)
    log.set(yscale="log", xlim=(start, end), ylim=(0.3 * floor, 60))  # room for the legend
    log.legend(loc="upper left", fontsize=9, handlelength=1.6)
    return figure


def draw_diameter_methods(curves: Mapping[str, DiameterCurves], threshold: float, claimed: float) -> Figure:
    """Mean error of several methods against the diameter of the dimple."""
    figure, axes = plt.subplots(figsize=(7, 5))
    floor = 1e-7
    for name, look in looks_of(curves):
        curve = curves[name]
        mean = np.maximum(curve.mean(name), floor)
        axes.semilogy(curve.diameters, mean, markersize=4.5, label=look.label, **look.style)
    limit = threshold * curve.rms[0]
    axes.axhline(limit, color="#555555", lw=1)
    axes.text(0.05, limit * 1.2, f"{percent(threshold)} of the input", color="#555555", fontsize=9)
    _diameters(axes, max(curve.diameters[-1] for curve in curves.values()), claimed)
    axes.set(ylabel="mean error (rad rms)", ylim=(0.3 * floor, 4))
    axes.set_gid(TALL)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def draw_diameter_reasons(reasons: Contraction, claimed: float) -> Figure:
    """Factor of one iteration above the sensitivity to single modes, on one axis of the diameter."""
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 6), sharex=True, height_ratios=(1, 0.8))
    color, diameters, aberrated = LOOKS[ITERATION].color, reasons.diameters, reasons.aberrated
    flat_color, ring_color, *_ = (style["color"] for style in OTHER_STYLES)
    top.plot(diameters, reasons.flat, color=flat_color, lw=2, ls="--", zorder=3, label="flat wavefront")
    low, high = aberrated.min(axis=1), aberrated.max(axis=1)
    top.fill_between(diameters, low, high, color=color, alpha=0.3, lw=0, label="screens, range")
    top.plot(diameters, aberrated[:, 0], color=color, lw=1.5, label="first screen")
    observed = list(reasons.observed), list(reasons.observed.values())
    top.plot(*observed, "o", mfc="none", mec=ring_color, label="observed")
    top.axhline(1, color="#555555", lw=1)
    top.text(0.05, 1.015, "diverges above", color="#555555", fontsize=9)
    top.set(ylabel="error after an iteration / before", ylim=(0, 1.2))
    top.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1, edgecolor="white")
    for (name, values), style in zip(reasons.sensitivity.items(), OTHER_STYLES, strict=False):
        bottom.plot(diameters, values, lw=1.8, label=name, **style | {"marker": "none"})
    bottom.set(ylabel="sensitivity (1/rad)", ylim=(0, 3.2))  # room for the legend on phones
    bottom.legend(loc="upper left", fontsize=9, frameon=True, framealpha=1, edgecolor="white")
    for axes in (top, bottom):
        _diameters(axes, diameters[-1], claimed)
    if diameters[-1] > DARK_RING:
        top.plot(DARK_RING, 1, "o", ms=14, mfc="none", mec="#000000", mew=1.5, zorder=4)
        bottom.plot(DARK_RING, 0, "o", ms=14, mfc="none", mec="#000000", mew=1.5, zorder=4, clip_on=False)
    top.set_xlabel("")
    return figure


def _diameters(axes: Axes, end: float, claimed: float) -> None:
    """Axis of the diameter, with the one of the paper and that of the dark ring."""
    above: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "va": "bottom", "fontsize": 9}
    if claimed < end:
        axes.axvline(claimed, color="#555555", lw=1.2, ls="--", zorder=0.5)
        axes.text(claimed, 1.005, f"paper: {claimed:g} ", ha="right", color="#555555", **above)
    if end > DARK_RING:
        axes.axvline(DARK_RING, color="#888888", lw=1.2, zorder=0.5)
        axes.text(DARK_RING, 1.005, " dark ring", ha="left", color="#555555", **above)
    axes.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=(0, end))


def limits_table(curves: Mapping[int, DiameterCurves], threshold: float, limits: Mapping[int, Limit]) -> Table:
    """Diameters at which the error exceeds 1e-3 rad and the threshold, by the number of iterations."""
    rows = [[n, curve.exceeds(ITERATION, 1e-3), limits[n].value] for n, curve in curves.items()]
    return Table(
        ["iterations", "exceeds 10⁻³ rad above about (λ/D)", f"exceeds {percent(threshold)} above about (λ/D)"],
        rows,
    )


def factors_table(reasons: Contraction, curve: DiameterCurves, n_iterations: int) -> Table:
    """Factor of one iteration and sensitivity to tilt at some diameters, with the error of the iteration."""
    rows = []
    for diameter, observed in reasons.observed.items():
        at = reasons.index(diameter)
        values = reasons.flat[at], reasons.aberrated[at, 0], observed, reasons.sensitivity["tilt"][at]
        rows.append([diameter, *map(float, values), small(curve.at(ITERATION, diameter))])
    return Table(
        [
            "diameter (λ/D)",
            "factor, flat",
            "factor, first screen",
            "observed, first screen",
            "tilt sensitivity (1/rad)",
            f"mean error after {n_iterations} (rad rms)",
        ],
        rows,
    )


def _usual(curve: DiameterCurves) -> float:
    """Diameter of the paper's other figures, or the largest one if that is smaller (lambda/D)."""
    return min(USUAL, float(curve.diameters[-1]))


def _rise(curve: DiameterCurves, name: str, allowed: float) -> float:
    """Diameter, from the usual one on, at which an error exceeds what is allowed, or twice its first value."""
    start = _usual(curve)
    error = curve.at(name, start)
    return curve.exceeds(name, 2 * error if error > allowed else allowed, start)


def methods_table(curves: Mapping[str, DiameterCurves], threshold: float) -> Table:
    """Errors of the methods at some sampled diameters, and the diameters at which they rise."""
    sampled = next(iter(curves.values()))
    usual = _usual(sampled)
    places = [usual, *(diameter for diameter in (2.0, 2.6, 3.5) if usual < diameter <= sampled.diameters[-1])]
    return Table(
        [
            "method",
            *f"error {', '.join(f'at {diameter:.4g}' for diameter in places)} (λ/D)".split(", "),
            f"exceeds {percent(threshold)}, or twice the error at {usual:.4g}, above about (λ/D)",
        ],
        [
            [
                LOOKS[name].name,
                *(small(curve.at(name, diameter)) for diameter in places),
                _rise(curve, name, threshold * curve.rms[0]),
            ]
            for name, curve in curves.items()
        ],
    )


def _above(diameter: float, largest: float) -> str:
    """Diameters above which an error is too large, in words."""
    return f"above {diameter:.3g} λ/D" if np.isfinite(diameter) else f"at no diameter up to {largest:.3g} λ/D"


def findings(limits: Mapping[int, Limit], threshold: float, largest: float) -> Text:
    """Return the diameters above which the error exceeds the threshold, by the number of iterations."""
    first, *more = (f"after {n} iterations {_above(limit.value, largest)}" for n, limit in limits.items())
    return Text(
        f"**The mean error of the iteration exceeds {percent(threshold)} of the input "
        f"{', and '.join([first, *more])}.** The first dark ring of the Airy pattern is at {DARK_RING:.3g} λ/D."
    )


def findings_rise(curve: DiameterCurves, n_iterations: int) -> Text:
    """Return the diameter above which the error is no longer tiny."""
    rise = _above(curve.exceeds(ITERATION, 1e-3), curve.diameters[-1])
    return Text(f"After {n_iterations} iterations the mean error exceeds 10⁻³ rad {rise}.")


def findings_methods(curves: Mapping[str, DiameterCurves], threshold: float) -> Text:
    """Return the methods whose error rises at the smallest and the largest diameter."""
    rises = {name: _rise(curve, name, threshold * curve.rms[0]) for name, curve in curves.items()}
    names = sorted(rises, key=rises.__getitem__)
    first, last = (
        f"{LOOKS[name].name} ({_above(rises[name], curves[name].diameters[-1])})"
        for name in names[:: len(names) - 1]
    )
    return Text(
        f"The mean error exceeds {percent(threshold)} of the input, or twice the error at "
        f"{_usual(curves[ITERATION]):.3g} λ/D if that is larger, first with {first}, and last with {last}."
    )


def numbers(
    by_iterations: Mapping[int, DiameterCurves],
    by_method: Mapping[str, DiameterCurves],
    limits: Mapping[int, Limit],
    threshold: float,
) -> dict[str, float | str]:
    """Numbers of the text and of the claims of section 4.2 on the diameter."""
    paper = by_method[ITERATION]
    allowed = threshold * paper.rms[0]
    limit, last = (list(limits.values())[place] for place in (0, -1))
    values: dict[str, Any] = {
        "iterations": next(iter(by_iterations)),
        "diameter_5_percent": limit.value,
        "diameter_5_percent_longest": last.value,
        "input": paper.rms[0],
        "error_at_20": paper.at(ITERATION, 2.0),
        "error_at_26": paper.at(ITERATION, 2.6),
        "dark_ring": DARK_RING,
        "n_few": by_method["Linear"].errors["Linear"].shape[-1],
        **{f"claim17_{short}_rise": _rise(by_method[name], name, allowed) for name, short in SHORT.items()},
        "longest": list(by_iterations)[-1],
    }
    return rounded(values, ".4g")
