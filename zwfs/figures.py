"""Figures of the book. The only module that needs matplotlib; `import zwfs` does not import it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Ellipse, FancyArrowPatch, Polygon
from numpy.typing import NDArray

from zwfs import _check
from zwfs.experiments import LinearityCurves
from zwfs.focal import focal_field
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

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

_RC = {
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


def sensor_layout(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 1: the planes of a sensor with one mask, with the fields computed for `phase` (radian)."""
    pupil, mask = sensor.pupil, sensor.masks[0]
    field = pupil.amplitude * np.exp(1j * np.where(pupil.mask, phase, 0))
    axis = np.linspace(-4, 4, 161)
    focus = np.abs(focal_field(pupil, field, axis, axis)) ** 2
    wave = sensor.reference_wave(field)[0]
    frame = np.abs(sensor.propagate(field)[0]) ** 2
    inside = np.where(pupil.mask, 1, np.nan)

    figure = plt.figure(figsize=(9, 4.7), layout="none")
    scene = figure.add_axes((0, 0, 1, 1))
    scene.set(xlim=(0, 9), ylim=(0, 4.7))
    scene.set_axis_off()
    _draw_beam(scene)

    limit = np.nanmax(np.abs(phase * inside))
    _plane(
        figure, scene, 1.15, "pupil plane", r"phase of $\psi_{in}$ (rad)", PHASE_MAP, phase * inside, -limit, limit
    )
    with np.errstate(divide="ignore"):
        halo = np.log10(focus / focus.max())
    focal = _plane(figure, scene, 4.5, "focal plane", r"$|\hat\psi_{in}|^2$ (log$_{10}$)", "magma", halo, -4, 0)
    # The axis runs from -4 to 4 lambda/D over 161 samples.
    focal.add_patch(Circle((80, 80), mask.diameter / 2 * 20, fill=False, ec="white", ls="--", lw=1.3))
    shift = _in_pi(np.angle(mask.transmission(0.0, 0.0)))
    focal.text(
        80, 146, f"mask: {mask.diameter:g} $\\lambda/D$, {shift} rad", color="white", ha="center", fontsize=8
    )
    focal.plot([80, 80], [80 + mask.diameter * 10, 142], color="white", lw=0.8)
    focal.plot([20, 60], [12, 12], color="white", lw=1.5)
    focal.text(40, 17, r"2 $\lambda/D$", color="white", ha="center", fontsize=8)
    _plane(figure, scene, 7.85, "detector plane", r"intensity $I_{out}$", INTENSITY_MAP, frame, 0, frame.max())

    interference = 2 * np.abs(pupil.amplitude * wave) * np.cos(np.angle(field * wave.conj()))
    terms = (
        (r"$I_{out}$", "=", frame, INTENSITY_MAP, 0),
        (r"$I_{in}$", "+", pupil.amplitude**2, INTENSITY_MAP, 0),
        (r"$I_{ref}$", "+", np.abs(wave) ** 2, INTENSITY_MAP, 0),
        (r"$2\sqrt{I_{in}I_{ref}}\,\cos(\phi_{in}-\phi_{ref})$", "", interference, PHASE_MAP, -frame.max()),
    )
    for x, (title, sign, image, colors, low) in zip((1.15, 3.1, 5.05, 7.0), terms, strict=True):
        inset = figure.add_axes(((x - 0.55) / 9, 0.36 / 4.7, 1.1 / 9, 1.1 / 4.7))
        shown = _show(inset, image, colors, low, frame.max())
        scene.text(x, 0.1, title, ha="center", fontsize=10)
        scene.text(x + 0.97, 0.9, sign, ha="center", va="center", fontsize=15)
    bar = figure.add_axes((7.75 / 9, 0.36 / 4.7, 0.08 / 9, 1.1 / 4.7))
    figure.colorbar(shown, cax=bar).set_label("intensity", fontsize=8)
    bar.tick_params(labelsize=7, length=2, pad=1)
    return figure


def _draw_beam(scene: Axes) -> None:
    """Optical axis, beam and two lenses between the three planes."""
    y, half = 3.0, 0.8 * 0.98
    low = [(0.1, y - half), (2.82, y - half), (4.5, y), (6.18, y - half), (8.9, y - half)]
    high = [(x, 2 * y - height) for x, height in reversed(low)]
    scene.add_patch(Polygon(low + high, closed=True, fc="#f3d9a4", ec="none", alpha=0.6))
    scene.plot([0.1, 8.9], [y, y], color="#888888", lw=0.7, ls=(0, (8, 3, 2, 3)))
    for x in (2.82, 6.18):
        scene.add_patch(Ellipse((x, y), 0.22, 1.95, fc="#cfe3f2", ec="#33658a", lw=1.2))
        scene.text(x, y - 1.2, "lens", ha="center", fontsize=9)
    for height in (-0.4, 0.4):
        scene.add_patch(
            FancyArrowPatch(
                (2.05, y + height), (2.6, y + height), arrowstyle="-|>", mutation_scale=9, color="#a8742a"
            )
        )


def _plane(
    figure: Figure,
    scene: Axes,
    x: float,
    title: str,
    scale: str,
    colors: str,
    image: NDArray,
    low: float,
    high: float,
) -> Axes:
    """Picture of a plane on the optical axis, its name above and its colour scale below."""
    axes = figure.add_axes(((x - 0.8) / 9, (3.0 - 0.8) / 4.7, 1.6 / 9, 1.6 / 4.7))
    shown = _show(axes, image, colors, low, high)
    axes.spines[:].set_visible(True)
    scene.text(x, 4.38, title, ha="center", fontsize=11, weight="bold")
    bar = figure.add_axes(((x - 0.6) / 9, 2.02 / 4.7, 1.2 / 9, 0.07 / 4.7))
    figure.colorbar(shown, cax=bar, orientation="horizontal")
    bar.tick_params(labelsize=7, length=2, pad=1)
    bar.locator_params(nbins=4)
    scene.text(x, 4.0, scale, ha="center", fontsize=9)
    return axes


def _looks(methods: Mapping | Sequence) -> list[tuple[str, Look]]:
    unknown = set(methods) - set(LOOKS)
    if unknown:
        raise ValueError(f"methods = {sorted(unknown)}: expected some of {sorted(LOOKS)}")
    return [(name, look) for name, look in LOOKS.items() if name in methods]


def _short(value: float) -> str:
    """Two digits, or a bound where the digits would be those of rounding errors."""
    return f"{value:.2g}" if value >= 1e-6 else "below $10^{-6}$"


def _in_pi(angle: float) -> str:
    """Angle as a multiple of pi where it is a simple one."""
    angle = _check.number("angle", float(angle))
    for parts in (1, 2, 3, 4, 6):
        times = angle / np.pi * parts
        if abs(times - round(times)) < 1e-9 and round(times):
            top = {1: "", -1: "-"}.get(round(times), str(round(times)))
            return f"${top}\\pi$" if parts == 1 else f"${top}\\pi/{parts}$"
    return f"{angle:.3g}"
