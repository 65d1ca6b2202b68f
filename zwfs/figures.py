"""Figures of the book. Only this module and `zwfs.drawings` need matplotlib; `import zwfs` imports neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from zwfs.experiments import LinearityCurves
from zwfs.pupil import Pupil
from zwfs.variations import DARK_RING, DiameterCurve, PairMaps

PHASE_MAP, INTENSITY_MAP = "RdBu_r", "viridis"


@dataclass(frozen=True)
class Look:
    """How a method is drawn, the same in every figure."""

    name: str
    sees: str
    color: str
    marker: str
    line: str | tuple[float, tuple[float, ...]]

    @property
    def label(self) -> str:
        """Name for a legend."""
        return f"{self.name} ({self.sees})"


# Okabe and Ito's palette, which colour-blind readers can tell apart; marker and dashes say it once more.
LOOKS = {
    "Linear": Look("linear", "one pupil", "#000000", "o", "-"),
    "Arcsine": Look("arcsine", "one pupil", "#E69F00", "s", "--"),
    "GerchbergSaxton": Look("Gerchberg-Saxton", "two pupils", "#009E73", "^", "-."),
    "GradientDescent": Look("gradient descent", "two pupils", "#CC79A7", "D", (0, (3, 1, 1, 1, 1, 1))),
    "GradientDescentPoints": Look("gradient descent on points", "two pupils", "#D55E00", "d", "--"),
    "PhaseShifted": Look("phase-shifted", "two pupils", "#0072B2", "v", ":"),
}

# Curves that stand for no method have colours of their own, of Tol's muted palette, and markers of their own.
OTHER_STYLES: tuple[dict[str, Any], ...] = tuple(
    {"color": color, "marker": marker, "linestyle": line}
    for color, marker, line in (
        ("#332288", "P", "-"),
        ("#AA4499", "X", "--"),
        ("#44AA99", "p", "-."),
        ("#999933", "h", ":"),
    )
)

_RC: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "savefig.bbox": None,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "image.cmap": INTENSITY_MAP,
    "image.interpolation": "nearest",
    "image.origin": "lower",
    # Element ids of SVG files are random unless salted.
    "svg.hashsalt": "zwfs",
}


def use_style(*, vector: bool = False) -> None:
    """Draw figures of this session alike; in a notebook, as sharp PNG or, if `vector`, as SVG without a date."""
    plt.rcParams.update(_RC)
    try:
        from matplotlib_inline.backend_inline import set_matplotlib_formats
    except ImportError:
        return
    if vector:
        set_matplotlib_formats("svg", bbox_inches=None, metadata={"Date": None})
    else:
        set_matplotlib_formats("png", bbox_inches=None, dpi=200)


def show_phase(axes: Axes, phase: NDArray, limit: float) -> AxesImage:
    """Phase map, diverging around 0 from -`limit` to `limit` (radian)."""
    return _show(axes, phase, PHASE_MAP, -limit, limit)


def show_intensity(axes: Axes, frame: NDArray, limit: float) -> AxesImage:
    """Intensity from 0 to `limit`."""
    return _show(axes, frame, INTENSITY_MAP, 0, limit)


def _show(axes: Axes, image: NDArray, colors: str, low: float, high: float) -> AxesImage:
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set_visible(False)
    return axes.imshow(image, cmap=colors, vmin=low, vmax=high)


def linearity(curves: LinearityCurves, threshold: float, names: Sequence[str], rms_max: float) -> Figure:
    """Figure 3: mean error and its standard deviation against the input, and their ratio on a logarithmic axis.

    Parameters
    ----------
    curves : LinearityCurves
    threshold : float
        Ratio of error to input that is marked.
    names : sequence of str
        Curves to draw.
    rms_max : float, radian rms
        End of the axis.
    """
    figure, (plain, ratio) = plt.subplots(1, 2, figsize=(9, 4.4))
    drawn = curves.rms <= rms_max
    bright = drawn & (curves.rms > 0)
    rms = curves.rms[drawn]
    for name, look in _looks(names):
        mean, std = curves.mean(name), curves.std(name)[drawn]
        line = {"color": look.color, "marker": look.marker, "linestyle": look.line, "markersize": 4}
        plain.plot(rms, mean[drawn], label=look.label, **line)
        low, high = np.maximum(mean[drawn] - std, 0), mean[drawn] + std
        plain.fill_between(rms, low, high, color=look.color, alpha=0.15, lw=0)
        ratio.semilogy(curves.rms[bright], mean[bright] / curves.rms[bright], **line)
        limit = curves.dynamic_range(name, threshold)
        if 0 < limit <= rms_max:
            ratio.plot(limit, threshold, "o", mfc="none", mec=look.color, mew=1.8, ms=10, zorder=5)
    gray = {"color": "#555555", "fontsize": 9, "ha": "center", "va": "bottom"}
    plain.plot(rms, threshold * rms, color="#555555", lw=1)
    plain.text(0.6 * rms_max, 0.6 * threshold * rms_max + 0.01, f"{threshold:.0%} of the input", **gray)
    ratio.axhline(threshold, color="#555555", lw=1)
    ratio.text(0.6 * rms_max, threshold * 1.1, f"{threshold:.0%} of the input", **gray)
    plain.set(xlabel="input phase (rad rms)", ylabel="error (rad rms)", xlim=(0, None), ylim=(0, None))
    ratio.set(xlabel="input phase (rad rms)", ylabel="error / input", xlim=(0, None))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


def convergence(errors: Mapping[str, Mapping[float, NDArray]]) -> Figure:
    """Error against iteration, one panel for each input.

    Parameters
    ----------
    errors : mapping of method to mapping of input rms to ndarray, shape (n_screens, n_iterations + 1), radian rms
        A method without iterations has two columns: before and after.
    """
    inputs = list(next(iter(errors.values())))
    figure, panels = plt.subplots(1, len(inputs), figsize=(9, 3.9), sharey=True, squeeze=False)
    for axes, value in zip(panels[0], inputs, strict=True):
        for name, look in _looks(errors):
            middle, low, high = (np.quantile(errors[name][value], q, axis=0) for q in (0.5, 0.1, 0.9))
            if middle.size == 2:
                axes.axhline(middle[1], color=look.color, linestyle=look.line, label=look.label)
                continue
            steps = np.arange(middle.size)
            axes.semilogy(
                steps, middle, color=look.color, linestyle=look.line, marker=look.marker, ms=3.5, label=look.label
            )
            axes.fill_between(steps, low, high, color=look.color, alpha=0.15, lw=0)
        axes.set(xlabel="iteration", title=f"input {value:g} rad rms")
        axes.xaxis.get_major_locator().set_params(integer=True)
    panels[0, 0].set_ylabel("error (rad rms)")
    panels[0, 0].set_ylim(3e-8, 2)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    return figure


def estimates(
    pupil: Pupil, truth: NDArray, found: Mapping[str, NDArray], residuals: Mapping[str, NDArray]
) -> Figure:
    """One screen, what each method makes of it, and what is left (radian), on a scale four times finer."""
    truth = np.where(pupil.mask, truth, np.nan)
    limit = np.nanmax(np.abs(truth))
    figure, panels = plt.subplots(2, len(found) + 1, figsize=(9, 3.6))
    image = show_phase(panels[0, 0], truth, limit)
    panels[0, 0].set_title("input", fontsize=9)
    panels[1, 0].set_axis_off()
    panels[1, 0].text(0.5, 0.5, "residual", ha="center", va="center", transform=panels[1, 0].transAxes)
    for column, (name, look) in enumerate(_looks(found), start=1):
        show_phase(panels[0, column], found[name], limit)
        left = show_phase(panels[1, column], residuals[name], limit / 4)
        panels[0, column].set_title(f"{look.name}\n({look.sees})", fontsize=9)
        rms = np.sqrt(np.nanmean(residuals[name] ** 2))
        panels[1, column].set_xlabel(f"{_short(rms)} rad rms", fontsize=9)
    figure.colorbar(image, ax=panels[0], label="phase (rad)", aspect=12)
    figure.colorbar(left, ax=panels[1], label="residual (rad)", aspect=12, extend="both")
    return figure


def approximation(
    rms: Sequence[float], wave: Mapping[str, Sequence[float]], steps: Mapping[str, Sequence[float]]
) -> Figure:
    """Error of approximate reference waves against the input, and of one step of reconstruction with each.

    Parameters
    ----------
    rms : sequence of float, radian rms
        Input.
    wave : mapping of label to sequence
        Errors of the reference wave.
    steps : mapping of label to sequence
        Error of the reconstructed phase over the input.
    """
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.1))
    for axes, curves in zip(panels, (wave, steps), strict=True):
        for (label, values), style in zip(curves.items(), OTHER_STYLES, strict=False):
            axes.plot(rms, values, markersize=4.5, label=label, **style)
        axes.set(xlabel="input phase (rad rms)", xlim=(0, None), ylim=(0, None))
        axes.legend(fontsize=8)
    panels[0].set_ylabel("error of the reference wave")
    panels[1].set_ylabel("error of the phase / input")
    return figure


def diversity(difference: NDArray, determinant: NDArray, strength: NDArray, named: Mapping[str, int]) -> Figure:
    """Determinant of equation (10) and the one weighted with both reference waves, for many pairs of masks.

    Parameters
    ----------
    difference : ndarray, shape (n_pairs,), radian
        Of the phase shifts.
    determinant, strength : ndarray, shape (n_pairs,)
    named : mapping of label to index
        Pairs to point out.
    """
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.9), sharex=True)
    for axes, values in zip(panels, (determinant, strength), strict=True):
        axes.plot(difference, values, ".", color="#56B4E9", ms=4)
        for (label, index), style in zip(named.items(), OTHER_STYLES, strict=False):
            axes.plot(difference[index], values[index], label=label, markersize=8, **style | {"linestyle": "none"})
        axes.set(xlabel=r"difference of the phase shifts, $\theta_b-\theta_a$ (rad)", ylim=(0, None))
        axes.set_xticks(np.pi / 2 * np.arange(5), ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"])
    panels[0].set_ylabel(r"$|\det M|$")
    panels[1].set_ylabel("determinant with the waves' strength")
    if named:
        panels[0].legend(fontsize=9, loc="lower center")  # below the arch, where no pair is
    return figure


def _looks(methods: Mapping | Sequence) -> list[tuple[str, Look]]:
    unknown = set(methods) - set(LOOKS)
    if unknown:
        raise ValueError(f"methods = {sorted(unknown)}: expected some of {sorted(LOOKS)}")
    return [(name, look) for name, look in LOOKS.items() if name in methods]


def _short(value: float) -> str:
    """Two digits, or a bound where the digits would be those of rounding errors."""
    return f"{value:.2g}" if value >= 1e-6 else "below $10^{-6}$"


def dimple_diameter(curves: Mapping[int, DiameterCurve], rms: float, threshold: float, claimed: float) -> Figure:
    """Figure 4: mean error and its standard deviation against the diameter of the dimple, on both kinds of axis.

    Parameters
    ----------
    curves : mapping of number of iterations to DiameterCurve
        The first is that of the paper; the others are drawn on the logarithmic axis only.
    rms : float, radian rms
        Input.
    threshold : float
        Ratio of error to input that is marked.
    claimed : float, lambda/D
        Diameter at which the error rises according to the paper, marked.
    """
    figure, (plain, log) = plt.subplots(1, 2, figsize=(9, 4.2))
    look, floor = LOOKS["PhaseShifted"], 1e-7
    (number, curve), *others = curves.items()
    for axes, bottom in ((plain, 0), (log, floor)):
        low, high = (np.maximum(curve.mean + sign * curve.std, bottom) for sign in (-1, 1))
        axes.plot(
            curve.diameters, curve.mean, color=look.color, marker=look.marker, ms=4, label=f"{number} iterations"
        )
        axes.fill_between(curve.diameters, low, high, color=look.color, alpha=0.2, lw=0)
        _diameters(axes, curve.diameters[-1], claimed)
        axes.set_ylabel("error (rad rms)")
    for (number, other), dashes in zip(others, ("--", ":", "-."), strict=False):
        log.plot(other.diameters, other.mean, color="#555555", ls=dashes, lw=1.5, label=f"{number} iterations")
    log.axhline(threshold * rms, color="#555555", lw=1)
    log.text(0.1, threshold * rms * 1.3, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    plain.set_ylim(0, None)
    log.set(yscale="log", ylim=(floor, 4))
    log.legend(loc="upper left", bbox_to_anchor=(0, 0.72), fontsize=9)
    return figure


def diameter_methods(curves: Mapping[str, DiameterCurve], rms: float, threshold: float, claimed: float) -> Figure:
    """Mean error of several methods against the diameter of the dimple; parameters as for `dimple_diameter`."""
    figure, axes = plt.subplots(figsize=(9, 4.6))
    floor = 1e-7
    for name, look in _looks(curves):
        curve = curves[name]
        axes.semilogy(
            curve.diameters, np.maximum(curve.mean, floor), color=look.color, marker=look.marker,
            linestyle=look.line, ms=4.5, label=look.label,
        )  # fmt: skip
    axes.axhline(threshold * rms, color="#555555", lw=1)
    axes.text(0.05, threshold * rms * 1.2, f"{threshold:.0%} of the input", color="#555555", fontsize=9)
    _diameters(axes, max(curve.diameters[-1] for curve in curves.values()), claimed)
    axes.set(ylabel="mean error (rad rms)", ylim=(floor, 4))
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    return figure


def diameter_reasons(
    diameters: NDArray,
    flat: NDArray,
    aberrated: NDArray,
    measured: Mapping[float, float],
    sensitivity: Mapping[str, NDArray],
    claimed: float,
) -> Figure:
    """Factor of one iteration, and sensitivity to single modes, against the diameter of the dimple.

    Parameters
    ----------
    diameters : ndarray, shape (n,), lambda/D
    flat : ndarray, shape (n,)
        Factor around a flat wavefront.
    aberrated : ndarray, shape (n, n_screens)
        Factor around screens.
    measured : mapping of diameter to factor
        Observed on the first screen.
    sensitivity : mapping of name to ndarray, shape (n,), 1 / radian
    claimed : float, lambda/D
        As for `dimple_diameter`.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2))
    color = LOOKS["PhaseShifted"].color
    flat_color, ring_color, *_ = (style["color"] for style in OTHER_STYLES)
    left.plot(diameters, flat, color=flat_color, lw=1.5, label="flat wavefront")
    left.fill_between(
        diameters,
        aberrated.min(axis=1),
        aberrated.max(axis=1),
        color=color,
        alpha=0.3,
        lw=0,
        label="screens, range",
    )
    left.plot(diameters, aberrated[:, 0], color=color, lw=1.5, label="first screen")
    left.plot(
        list(measured), list(measured.values()), "o", mfc="none", mec=ring_color, label="first screen, observed"
    )
    left.axhline(1, color="#555555", lw=1)
    left.text(0.05, 1.015, "diverges above, converges below", color="#555555", fontsize=9)
    left.set(ylabel="factor of the error, one iteration", ylim=(0, 1.2))
    left.legend(loc="lower right", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
    for (name, values), style in zip(sensitivity.items(), OTHER_STYLES, strict=False):
        right.plot(diameters, values, lw=1.8, label=name, **style | {"marker": "none"})
    right.set(ylabel="sensitivity of the two frames (1/rad)", ylim=(0, 2.8))
    right.legend(loc="upper right", fontsize=9, frameon=True, framealpha=1, edgecolor="none")
    for axes in (left, right):
        _diameters(axes, diameters[-1], claimed)
    return figure


def _diameters(axes: Axes, end: float, claimed: float) -> None:
    """Axis of the diameter, with the one of the paper and that of the dark ring."""
    axes.axvline(claimed, color="#555555", lw=1.2, ls="--", zorder=0.5)
    axes.axvline(DARK_RING, color="#888888", lw=1.2, zorder=0.5)
    above: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "va": "bottom", "fontsize": 9}
    axes.text(claimed, 1.005, f"paper: {claimed:g} ", ha="right", color="#555555", **above)
    axes.text(DARK_RING, 1.005, " dark ring", ha="left", color="#555555", **above)
    axes.set(xlabel=r"dimple diameter ($\lambda/D$)", xlim=(0, end))


def pair_maps(maps: PairMaps, best: Sequence[tuple[float, float]]) -> Figure:
    """Error, and photon noise for a flat and for an aberrated wavefront, for all pairs of phase shifts.

    Parameters
    ----------
    maps : PairMaps
        For evenly spaced angles.
    best : sequence of (theta_a, theta_b), radian
        Pair that is marked by a star on each of the two maps of noise.
    """
    figure, panels = plt.subplots(1, 3, figsize=(9, 4.1), sharey=True)
    half = (maps.angles[1] - maps.angles[0]) / 2 / np.pi
    ends = np.array([maps.angles[0], maps.angles[-1]]) / np.pi + np.array([-half, half])
    noise = Normalize(0.5, 3)
    for axes, image, norm, title in (
        (panels[0], maps.error, LogNorm(1e-8, 1), "error, no noise"),
        (panels[1], maps.flat, noise, "photon noise, flat"),
        (panels[2], maps.aberrated, noise, "photon noise, aberrated"),
    ):
        axes.grid(False)
        axes.set_facecolor("#d0d0d0")
        axes.add_patch(Rectangle((-3, -3), 6, 6, fc="#d0d0d0", ec="#888888", hatch="//////", lw=0, zorder=0))
        shown = axes.imshow(image, cmap="cividis_r", norm=norm, extent=(*ends, *ends), zorder=1)
        angle = {"ticks": (-1, -0.5, 0, 0.5, 1), "labels": ("−π", "−π/2", "0", "π/2", "π")}
        axes.set_xticks(**angle)
        axes.set_yticks(**angle)
        axes.set(xlim=ends, ylim=ends)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(r"$\theta_a$ (rad)")
        axes.plot([-0.5, 0.5], [0.5, -0.5], "o", mfc="none", mec="#000000", mew=1.5, ms=8, zorder=3)
        scale = r"rad rms" if axes is panels[0] else r"rad $\sqrt{\mathrm{photon}}$"
        more = "neither" if axes is panels[0] else "max"
        figure.colorbar(shown, ax=axes, location="bottom", label=scale, extend=more, aspect=16)
    for axes, (theta_a, theta_b) in zip(panels[1:], best, strict=True):
        pairs = np.array([[theta_a, theta_b], [theta_b, theta_a]]) / np.pi
        axes.plot(*pairs.T, "*", mfc="#ffffff", mec="#000000", ms=12, zorder=4)
    panels[0].set_ylabel(r"$\theta_b$ (rad)")
    return figure


def pair_noise(
    angles: NDArray, curves: Mapping[str, NDArray], drawn: Mapping[str, Sequence[tuple[float, float, float]]]
) -> Figure:
    """Noise of the pairs (theta, -theta) against theta, relative to its value at pi/2.

    Parameters
    ----------
    angles : ndarray, shape (n,), radian
    curves : mapping of name to ndarray, shape (n,)
        Noise over that of the pair of +-pi/2.
    drawn : mapping of name to sequence of (theta, noise, error)
        The same from draws of noise, with its standard error; drawn in the colour of the curve.
    """
    figure, axes = plt.subplots(figsize=(9, 4.2))
    for (name, values), style in zip(curves.items(), OTHER_STYLES, strict=False):
        shade = style["color"]
        axes.plot(angles / np.pi, values, lw=1.8, label=name, **style | {"marker": "none"})
        least = int(np.argmin(values))
        axes.plot(angles[least] / np.pi, values[least], "*", color=shade, ms=12)
        if name in drawn:
            theta, noise, error = np.array(drawn[name]).T
            axes.errorbar(theta / np.pi, noise, error, fmt="o", mfc="none", color=shade, ms=6, capsize=3)
    axes.axhline(1, color="#555555", lw=1)
    axes.axvline(0.5, color="#555555", lw=1)
    axes.set_xticks((0, 0.25, 0.5, 0.75, 1), ("0", "π/4", "π/2", "3π/4", "π"))
    axes.set(xlabel=r"$\theta$ of the pair $(\theta, -\theta)$ (rad)", ylabel="noise / noise at ±π/2")
    axes.set(xlim=(0, 1), ylim=(0.6, 2))
    axes.legend(loc="lower left", fontsize=9)
    return figure
