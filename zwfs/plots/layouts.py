"""Drawings of optical layouts with computed pictures in their planes; they need matplotlib."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import PlaceHolderLayoutEngine
from matplotlib.patches import Circle, Ellipse, FancyArrowPatch, Polygon, Rectangle
from numpy.typing import NDArray

from zwfs.bench.model import Bench
from zwfs.focal import focal_field
from zwfs.masks import Dimple, Mask
from zwfs.plots.style import INTENSITY_MAP, PHASE_MAP, dashed_circle
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

FOCUS_MAP = "magma"
_MASK_SAMPLES = 161
_BEAM, _RAY, _GLASS, _EDGE, _METAL = "#f8e8c8", "#a8742a", "#cfe3f2", "#33658a", "#444444"
_RETARDER = "#7a5195"

_Point = tuple[float, float]  # inches
_Profile = list[tuple[float, float]]  # distance along a beam and half of its width, inches


@dataclass(frozen=True)
class _Polarisation:
    """How one of the two polarisations is drawn: colour, and dashes for those who do not see it."""

    color: str
    line: str | tuple[float, tuple[float, ...]]


# Red and indigo, close to the ends of the phase map for +theta and -theta. They are far from the colours of the
# methods, and colour-blind readers can distinguish them.
_PLUS, _MINUS = _Polarisation("#B2182B", "-"), _Polarisation("#313695", (0, (4, 2)))


def sensor_layout(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 1: the planes of a sensor with one mask, with the fields computed for `phase` (radian)."""
    pupil, mask = sensor.pupil, sensor.masks[0]
    field = pupil.field(phase)
    wave = sensor.reference_wave(field)[0]
    frame = np.abs(sensor.propagate(field)[0]) ** 2
    inside = np.where(pupil.inside, 1, np.nan)

    scene = _Scene(9, 4.7, size=10.5)
    y, half = 3.0, 0.8 * 0.98
    scene.beam([(0.1, half), (2.82, half), (4.5, 0), (6.18, half), (8.9, half)], origin=(0, y))
    scene.axis((0.1, y), (8.9, y))
    for x in (2.82, 6.18):
        scene.lens(x, y, 1.95)
        scene.label(x, y - 1.2, "lens")
    scene.arrows(2.05, 2.6, y, 0.4)

    limit = np.nanmax(np.abs(phase * inside))
    _plane(scene, 1.15, "pupil plane", r"phase of $\psi_{in}$ (rad)", PHASE_MAP, phase * inside, -limit, limit)
    focal = _plane(
        scene, 4.5, "focal plane", r"$|\hat\psi_{in}|^2$ (log$_{10}$)", FOCUS_MAP, _halo(pupil, field, 4), -4, 0
    )
    # The axis runs from -4 to 4 lambda/D over 161 samples.
    dashed_circle(focal, (80, 80), mask.diameter / 2 * 20)
    label = f"mask: {mask.diameter:g} $\\lambda/D$, {_shift(mask)} rad"
    focal.text(80, 146, label, color="white", ha="center", fontsize=9)
    focal.plot([80, 80], [80 + mask.diameter * 10, 142], color="white", lw=0.8)
    focal.plot([20, 60], [12, 12], color="white", lw=1.5)
    focal.text(40, 17, r"2 $\lambda/D$", color="white", ha="center", fontsize=9.5)
    _plane(scene, 7.85, "detector plane", r"intensity $I_{out}$", INTENSITY_MAP, frame, 0, frame.max())

    interference = 2 * np.abs(pupil.amplitude * wave) * np.cos(np.angle(field * wave.conj()))
    terms = (
        (r"$I_{out}$", "=", frame, INTENSITY_MAP, 0),
        (r"$I_{in}$", "+", pupil.amplitude**2, INTENSITY_MAP, 0),
        (r"$I_{ref}$", "+", np.abs(wave) ** 2, INTENSITY_MAP, 0),
        (r"$2\sqrt{I_{in}I_{ref}}\,\cos(\phi_{in}-\phi_{ref})$", "", interference, PHASE_MAP, -frame.max()),
    )
    for x, (title, sign, image, colors, low) in zip((1.15, 3.1, 5.05, 7.0), terms, strict=True):
        term = scene.picture(x, 0.91, 1.1, image, colors, low, frame.max(), edge=None)
        scene.label(x, 0.1, title, size=10)
        scene.label(x + 0.97, 0.9, sign, size=15, va="center")
    scene.scale(term, (7.75, 0.36, 0.08, 1.1), "intensity", ticks=5)
    return scene.figure


def vector_sensor(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 2: a vector mask of liquid crystal and one of a metasurface, with the fields computed for `phase`.

    Parameters
    ----------
    sensor : ZernikeSensor
        Two masks, one for each polarisation.
    phase : ndarray, shape (ny, nx), radian

    Raises
    ------
    ValueError
        If the sensor has another number of masks.
    """
    if sensor.n_masks != 2:
        raise ValueError(f"sensor has {sensor.n_masks} masks: expected two, one for each polarisation")
    scene = _Scene(9, 7.25, size=10.5)
    for y, liquid in ((5.5, True), (2.05, False)):
        _vector_row(scene, y, sensor, phase, liquid=liquid)
    scene.axes.plot([0.2, 8.8], [3.86, 3.86], color="#cccccc", lw=0.8)
    _legend(scene, 0.16)
    return scene.figure


def _vector_row(scene: _Scene, y: float, sensor: ZernikeSensor, phase: NDArray, *, liquid: bool) -> None:
    """One vector sensor along the height `y`: pupil, focus and detector one focal length from each lens."""
    pupil_x, first, focus, second, prism, detector, images = 0.8, 2.3, 3.9, 5.5, 6.05, 7.25, 8.2
    half, apart = 0.5, 0.62
    title, text = _KINDS[liquid]
    scene.label(0.2, y + 1.42, title, size=12, weight="bold", ha="left")
    scene.label(0.2, y + 1.34, text, ha="left", va="top", color="#444444")

    scene.beam([(0.1, half), (first, half), (focus, 0), (second, half), (prism, half)], origin=(0, y))
    scene.axis((0.1, y), (prism, y))
    scene.edges([(focus, 0), (second, half), (prism, half)], origin=(0, y))
    scene.split_beam((prism, y), detector, half, apart)
    scene.arrows(1.52, 2.0, y, 0.25)
    for x in (first, second):
        scene.lens(x, y, 1.3)
        scene.label(x, y - 0.84, "lens")

    pupil = sensor.pupil
    inside = np.where(pupil.inside, phase, np.nan)
    limit = np.nanmax(np.abs(inside))
    shown = scene.picture(pupil_x, y, 1.05, inside, PHASE_MAP, -limit, limit)
    scene.label(pupil_x, y + 0.6, r"pupil: $\phi_{in}$ (rad)")
    scene.scale(shown, (pupil_x - 0.45, y - 0.66, 0.9, 0.06))
    scene.label(pupil_x, y - 1.1, "unpolarised light")

    halo = _halo(pupil, pupil.field(phase), 2.2)
    frames = sensor.measure(phase)
    for index, (mask, look, sign) in enumerate(zip(sensor.masks, (_PLUS, _MINUS), (1, -1), strict=True)):
        linear, circular, swapped = ("along", "left", "right") if sign > 0 else ("across", "right", "left")
        center = y + sign * 0.77
        _mask_picture(scene, focus, center, 0.95, mask, halo, 2.2, look)
        scene.axes.plot([focus, focus], [y, center - sign * 0.475], color=look.color, lw=1, ls=look.line)
        _symbol(scene, focus - 0.38, center + sign * 0.64, circular if liquid else linear, look.color)
        name = f"{circular} circular" if liquid else "linear"
        label = f"{name}: {_shift(mask, plus=True)}"
        scene.label(focus - 0.2, center + sign * 0.64, label, ha="left", va="center", color=look.color)
        if liquid:
            # Geometric phase comes with a half-wave retarder, which swaps the handedness.
            _symbol(scene, focus + 0.68, y + sign * 0.52, swapped, look.color)
            _symbol(scene, 5.14, y + sign * 0.56, linear, look.color)
        else:
            _symbol(scene, 4.85, y + sign * 0.52, linear, look.color)
        _symbol(scene, 6.65, y + sign * 1.08, linear, look.color)
        center = y + sign * apart
        shown = scene.picture(images, center, 1.02, frames[index], INTENSITY_MAP, 0, frames.max(), edge=look.color)
        scene.label(images - 0.24, center + sign * 0.64, f"image {index + 1}", va="center", color=look.color)
    scene.scale(shown, (images + 0.15, y - 1.25, 0.35, 0.06), ticks=2)

    scene.plate(focus, y, 0.07, 0.34, _RETARDER)
    scene.label(focus - 0.13, y - 0.09, "mask", ha="right", va="top")
    if liquid:
        scene.plate(4.88, y, 0.1, 0.9, "#d9c7e8", edge=_RETARDER)
        scene.label(4.84, y - 0.76, "quarter-\nwave plate", va="top")
    scene.wollaston(prism, y, 0.3, 1.25)
    scene.label(prism + 0.02, y - 0.7, "Wollaston\nprism", va="top")
    scene.detector(detector, y, 2.3)
    scene.label(detector - 0.05, y - 1.32, "detector")
    _focus_marks(scene, detector, y, half, apart)


_KINDS = {
    True: ("Liquid crystal", "geometric phase, of opposite sign for\nthe two circular polarisations"),
    False: ("Metasurface", "structures below the wavelength, for\nthe two linear polarisations directly"),
}


def bench_layout(bench: Bench, pistons: NDArray, frames: NDArray) -> Figure:
    """Figure 5: simplified layout of the SEAL bench, folded at its two deformable mirrors.

    Parameters
    ----------
    bench : Bench
        Its layout and mask are drawn, and the flat frame that its quilting alone makes.
    pistons : ndarray, shape (n_segments,), radian
        Commands of the segments; the mirror's side view exaggerates them.
    frames : ndarray, shape (2, ny', nx')
        What the camera shows of them.

    Raises
    ------
    ValueError
        If the commands are not those of the bench, or there are not two frames.
    """
    phase = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    if len(frames) != 2:
        raise ValueError(f"frames has {len(frames)} images: expected two, one for each polarisation")
    scene = _Scene(9, 7.05)
    top, bottom, corner, f, f_last, half = 6.2, 1.2, 8.25, 1.5, 1.75, 0.27
    stop, focus, camera = corner - 4 * f, corner - 2 * f_last, corner - 4 * f_last

    # Each leg takes a pupil to the next one, two lenses and four focal lengths on.
    relay = [(stop + f, half), (stop + 2 * f, 0), (stop + 3 * f, half), (corner - half, half)]
    scene.beam([(0.75, 0), (1.45, half), *relay], origin=(0, top))
    down = (top - bottom) / 4
    scene.beam(
        [(half, half), (down, half), (2 * down, 0), (3 * down, half), (4 * down - half, half)],
        origin=(corner, top),
        angle=-np.pi / 2,
    )
    prism = camera + 1.25
    scene.beam(
        [(half, half), (f_last, half), (2 * f_last, 0), (3 * f_last, half), (corner - prism, half)],
        origin=(corner, bottom),
        angle=np.pi,
    )
    for y, side in ((top, -1), (bottom, 1)):
        inner = y + side * half
        scene.corner((corner - half, y - half), (corner - half, y + half), (corner + half, inner))
    _source(scene, 0.75, top)
    scene.stop(stop, top, half, 0.5)
    scene.label(stop, top + 0.58, "pupil stop")
    scene.arrows(2.55, 3.05, top, 0.13)
    for x in (1.45, stop + f, stop + 3 * f):
        scene.lens(x, top, 0.9)
    for y in (top - down, bottom + down):
        scene.lens(corner, y, 0.9, angle=np.pi / 2)
    _segmented_mirror(scene, (corner, top), np.pi / 4, bench, pistons)
    scene.label(8.85, top + 0.6, "IrisAO segmented mirror", ha="right")
    _actuated_mirror(scene, (corner, bottom), -np.pi / 4)
    scene.label(8.85, bottom - 0.72, "BMC deformable mirror", ha="right")

    scene.split_beam((prism, bottom), camera, half, 0.37)
    scene.edges([(focus, 0), (focus - f_last, half), (prism, half)], origin=(0, bottom))
    for x in (focus + f_last, focus - f_last):
        scene.lens(x, bottom, 0.9)
    scene.plate(focus, bottom, 0.07, 0.3, _RETARDER)
    scene.label(focus, bottom - 0.4, "vector-Zernike\nmask", va="top")
    scene.plate(focus - 0.75, bottom, 0.09, 0.6, "#d9c7e8", edge=_RETARDER)
    scene.label(focus - 0.9, bottom - 0.4, "quarter-\nwave plate", va="top")
    scene.wollaston(prism, bottom, 0.24, 0.85)
    scene.label(prism, bottom - 0.5, "Wollaston\nprism", va="top")
    scene.detector(camera - 0.08, bottom, 1.5)
    scene.callout((camera - 0.04, bottom + 0.75), (camera - 0.04, bottom + 1.2))
    scene.label(camera - 0.2, bottom, "camera", ha="right", va="center")
    _bench_pictures(scene, bench, phase, frames)
    return scene.figure


def _bench_pictures(scene: _Scene, bench: Bench, phase: NDArray, frames: NDArray) -> None:
    """Computed pictures of Figure 5, next to their elements."""
    pupil = Pupil.from_segments(bench.segments)
    limit = np.nanmax(np.abs(phase))
    left, right, upper, lower, size = 4.75, 6.7, 4.8, 2.87, 1.35
    scene.callout((8.0, 5.95), (right + size / 2, upper + size / 2))
    scene.picture(left, upper, size, pupil.amplitude**2, "gray", 0, pupil.amplitude.max() ** 2)
    scene.label(left, upper + 0.73, "segments in the stop")
    shown = scene.picture(right, upper, size, phase, PHASE_MAP, -limit, limit)
    scene.label(right, upper + 0.73, "pistons (rad)")
    scene.scale(shown, (right - 0.55, upper - 0.77, 1.1, 0.06))

    scene.callout((8.0, 1.45), (right + size / 2, lower - size / 2))
    none: dict[str, Any] = dict.fromkeys((*bench.errors(), "photons", "read_noise", "background"), 0)
    clean = replace(bench, **none)
    quilted = replace(clean, quilting=bench.quilting).frames()[0]
    scene.picture(right, lower, size, quilted, INTENSITY_MAP, 0, quilted.max())
    scene.label(right, lower + 0.73, "quilting in a flat frame")
    mask = Dimple(bench.diameter, bench.phase)
    halo = _halo(pupil, pupil.field(phase), 4)
    scene.callout((left, 1.2), (left, lower))
    _mask_picture(scene, left, lower, size, mask, halo, 4, _PLUS)
    scene.label(left, lower + 0.73, f"focus, dimple of {_shift(mask, plus=True)}")

    for frame, x, look, number in zip(frames, (1.2, 3.05), (_PLUS, _MINUS), (1, 2), strict=True):
        scene.picture(x, 3.27, 1.72, frame, INTENSITY_MAP, 0, frames.max(), edge=look.color)
        scene.label(x, 4.2, f"image {number}", color=look.color, size=10)
    for y, look, text in ((5.12, _PLUS, r"sees phase $+\theta$"), (4.82, _MINUS, r"sees phase $-\theta$")):
        scene.key(0.35, y, look, text)


class _Scene:
    """Figure without visible axes: positions in inches from its lower left corner, text of `size` points."""

    def __init__(self, width: float, height: float, size: float = 9) -> None:
        # Not "none": after it, a figure that is saved twice gets the layout engine of the style.
        self.figure = plt.figure(figsize=(width, height), layout=PlaceHolderLayoutEngine(True, True))
        self.width, self.height, self.size = width, height, size
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, width), ylim=(0, height))
        self.axes.set_axis_off()

    def _part(self, left: float, bottom: float, width: float, height: float) -> Axes:
        return self.figure.add_axes(
            (left / self.width, bottom / self.height, width / self.width, height / self.height)
        )

    def picture(
        self,
        x: float,
        y: float,
        size: float,
        image: NDArray,
        colors: str,
        low: float,
        high: float,
        edge: str | None = "black",
    ) -> AxesImage:
        """Picture centred on (x, y), its first row at the bottom, with a frame unless `edge` is None."""
        axes = self._part(x - size / 2, y - size / 2, size, size)
        axes.set(xticks=[], yticks=[])
        axes.grid(False)
        axes.spines[:].set(
            visible=edge is not None, color=edge or "none", linewidth=0.8 if edge == "black" else 1.6
        )
        return axes.imshow(image, cmap=colors, vmin=low, vmax=high, origin="lower", interpolation="none")

    def scale(
        self, shown: AxesImage, box: tuple[float, float, float, float], name: str = "", ticks: int = 4
    ) -> None:
        """Colour scale of a picture in a box (left, bottom, width, height), along its longer side."""
        axes = self._part(*box)
        flat = box[2] > box[3]
        bar = self.figure.colorbar(shown, cax=axes, orientation="horizontal" if flat else "vertical")
        bar.set_label(name, fontsize=self.size - 1)
        axes.tick_params(labelsize=self.size - 1, length=2, pad=1)
        axes.locator_params(nbins=ticks)

    def label(
        self, x: float, y: float, text: str, size: float | None = None, ha: str = "center", **style: Any
    ) -> None:
        """Text, centred on x unless said otherwise, in points; the size is that of the scene if None."""
        self.axes.text(x, y, text, ha=ha, fontsize=size or self.size, **style)

    def beam(self, profile: _Profile, origin: _Point, angle: float = 0.0) -> None:
        """Beam of light: (distance along the axis, half of the width) at its corners."""
        low, high = _turned(profile, origin, angle)
        self.axes.add_patch(Polygon([*low, *high[::-1]], closed=True, fc=_BEAM, ec="none"))

    def edges(self, profile: _Profile, origin: _Point) -> None:
        """Edges of a beam that holds both polarisations, in both of their colours."""
        for look in (_PLUS, _MINUS):
            for side in _turned(profile, origin, 0.0):
                self.axes.plot(*np.transpose(side), color=look.color, ls=look.line, lw=1.2)

    def axis(self, start: _Point, end: _Point) -> None:
        """Optical axis."""
        self.axes.plot(*np.transpose([start, end]), color="#888888", lw=0.7, ls=(0, (8, 3, 2, 3)))

    def arrows(self, start: float, end: float, y: float, apart: float) -> None:
        """Two arrows along the light."""
        for height in (y - apart, y + apart):
            self.axes.add_patch(
                FancyArrowPatch((start, height), (end, height), arrowstyle="-|>", mutation_scale=9, color=_RAY)
            )

    def lens(self, x: float, y: float, height: float, angle: float = 0.0) -> None:
        """Lens; `angle` (radian) is that of the light."""
        width = min(0.22, 0.13 * height)
        self.axes.add_patch(Ellipse((x, y), width, height, angle=np.degrees(angle), fc=_GLASS, ec=_EDGE, lw=1.2))

    def plate(self, x: float, y: float, width: float, height: float, color: str, edge: str = "none") -> None:
        """Plate across the light."""
        self.axes.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, fc=color, ec=edge, zorder=3))

    def corner(self, *points: _Point) -> None:
        """Light in front of a mirror that folds the beam."""
        self.axes.add_patch(Polygon(points, closed=True, fc=_BEAM, ec=_BEAM, lw=0.5))

    def stop(self, x: float, y: float, half: float, reach: float) -> None:
        """Two blades that leave an opening of twice `half`."""
        for sign in (-1, 1):
            self.plate(x, y + sign * (half + reach) / 2, 0.06, reach - half, _METAL)

    def wollaston(self, x: float, y: float, width: float, height: float) -> None:
        """Wollaston prism: two wedges of crystal with their axes crossed."""
        left, right, low, high = x - width / 2, x + width / 2, y - height / 2, y + height / 2
        for corners, color in (
            ([(left, low), (right, low), (left, high)], _GLASS),
            ([(right, low), (right, high), (left, high)], "#a9cbe4"),
        ):
            self.axes.add_patch(Polygon(corners, closed=True, fc=color, ec=_EDGE, lw=1.1, zorder=3))

    def split_beam(self, start: _Point, end: float, half: float, apart: float) -> None:
        """Beams of the two polarisations from a Wollaston prism to their images `apart` from the axis."""
        x, y = start
        for look, sign in ((_PLUS, 1), (_MINUS, -1)):
            low, high = ([(x, y + edge), (end, y + sign * apart + edge)] for edge in (-half, half))
            self.axes.add_patch(Polygon([*low, *high[::-1]], closed=True, fc=look.color, ec="none", alpha=0.13))
            for side in (low, high):
                self.axes.plot(*np.transpose(side), color=look.color, ls=look.line, lw=1.2)

    def detector(self, x: float, y: float, height: float) -> None:
        """Detector, from the side."""
        self.plate(x + 0.04, y, 0.08, height, _METAL)

    def key(self, x: float, y: float, look: _Polarisation, text: str) -> None:
        """Line of a polarisation, and what it means."""
        self.axes.plot([x, x + 0.4], [y + 0.05, y + 0.05], color=look.color, ls=look.line, lw=1.6)
        self.label(x + 0.47, y, text, ha="left")

    def callout(self, *points: _Point) -> None:
        """Thin line from an element to its picture."""
        self.axes.plot(*np.transpose(points), color="#888888", lw=0.8, zorder=1)


def _turned(profile: _Profile, origin: _Point, angle: float) -> tuple[list[_Point], list[_Point]]:
    """Lower and upper edge of a beam along a direction (radian)."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    start = np.asarray(origin)

    def edge(sign: int) -> list[_Point]:
        return [(x, y) for x, y in (start + s * along + sign * half * across for s, half in profile)]

    return edge(-1), edge(1)


def _plane(
    scene: _Scene, x: float, title: str, scale: str, colors: str, image: NDArray, low: float, high: float
) -> Axes:
    """Picture of a plane on the optical axis of Figure 1, its name above and its colour scale below."""
    shown = scene.picture(x, 3.0, 1.6, image, colors, low, high)
    scene.label(x, 4.38, title, size=11, weight="bold")
    scene.scale(shown, (x - 0.6, 2.02, 1.2, 0.07))
    scene.label(x, 4.0, scale)
    return shown.axes


def _mask_picture(
    scene: _Scene, x: float, y: float, size: float, mask: Mask, halo: NDArray, reach: float, look: _Polarisation
) -> None:
    """Phase map of a mask, in the colours of phase, over the image of the source, in faint grey."""
    axes = scene.picture(x, y, size, halo, "Greys", -4, 3, edge=look.color).axes
    u = np.linspace(-reach, reach, _MASK_SAMPLES)
    inside = np.hypot(u, u[:, np.newaxis]) <= mask.diameter / 2
    phase = np.where(inside, np.angle(mask.transmission(*np.meshgrid(u, u))), np.nan)
    # Same sampling as the image below it: one pixel of the map is one of the picture.
    axes.imshow(phase, cmap=PHASE_MAP, vmin=-np.pi, vmax=np.pi, origin="lower", interpolation="none")


def _halo(pupil: Pupil, field: NDArray, reach: float) -> NDArray:
    """Decadic logarithm of the intensity in the focal plane, relative to its peak, to `reach` (lambda/D)."""
    axis = np.linspace(-reach, reach, _MASK_SAMPLES)
    focus = np.abs(focal_field(pupil, field, axis, axis)) ** 2
    with np.errstate(divide="ignore"):
        return np.log10(focus / focus.max())


def _symbol(scene: _Scene, x: float, y: float, kind: str, color: str) -> None:
    """Sign of a polarisation: "left" or "right" circular; linear, "along" the drawing's plane or "across" it."""
    axes = scene.axes
    if kind == "along":
        style: dict[str, Any] = {"arrowstyle": "<|-|>", "mutation_scale": 8, "shrinkA": 0, "shrinkB": 0, "lw": 1.4}
        axes.add_patch(FancyArrowPatch((x, y - 0.15), (x, y + 0.15), color=color, **style))
        return
    if kind == "across":
        axes.add_patch(Circle((x, y), 0.09, fc="white", ec=color, lw=1.4))
        axes.add_patch(Circle((x, y), 0.03, fc=color, ec="none"))
        return
    turn = 1 if kind == "left" else -1
    angle = np.radians(90 + turn * np.linspace(30, 300, 40))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    axes.plot(x + 0.1 * arc[:, 0], y + 0.1 * arc[:, 1], color=color, lw=1.4, solid_capstyle="butt")
    ahead = turn * np.array([-arc[-1, 1], arc[-1, 0]])
    head = [0.1 * arc[-1] + 0.1 * ahead, 0.15 * arc[-1], 0.05 * arc[-1]]
    axes.add_patch(Polygon(np.array(head) + np.array([x, y]), closed=True, fc=color, ec="none"))


def _shift(mask: Mask, *, plus: bool = False) -> str:
    """Phase shift at the centre of a mask, with a + if asked for."""
    axis = np.zeros(1)
    angle = np.angle(mask.transmission(axis, axis)).item()
    text = _in_pi(angle)
    return f"$+${text}" if plus and angle > 0 else text


def _in_pi(angle: float) -> str:
    """Angle as a multiple of pi where it is a simple one."""
    for parts in (1, 2, 3, 4, 6):
        times = angle / np.pi * parts
        if abs(times - round(times)) < 1e-9 and round(times):
            top = {1: "", -1: "-"}.get(round(times), str(round(times)))
            return f"${top}\\pi$" if parts == 1 else f"${top}\\pi/{parts}$"
    return f"{angle:.3g}"


def _legend(scene: _Scene, y: float) -> None:
    """Key to the lines and signs."""
    for x, look, text in ((0.25, _PLUS, r"sees phase $+\theta$"), (1.95, _MINUS, r"sees phase $-\theta$")):
        scene.key(x, y, look, text)
    gray = "#444444"
    for x, kind, text in (
        (3.7, "left", ""),
        (4.02, "right", "circular"),
        (5.05, "along", "linear, in the drawing"),
        (7.0, "across", "linear, perpendicular"),
    ):
        _symbol(scene, x, y + 0.05, kind, gray)
        scene.label(x + 0.18, y, text, ha="left")


def _focus_marks(scene: _Scene, x: float, y: float, half: float, apart: float) -> None:
    """Planes in which each of the two images is sharp, one before and one behind the detector."""
    planes = x - 0.13, x + 0.2
    for look, sign, where in zip((_PLUS, _MINUS), (1, -1), planes, strict=True):
        center = y + sign * apart
        scene.axes.plot([where, where], [center - half, center + half], color=look.color, lw=2.4, ls=(0, (1, 0.7)))
        scene.axes.plot([where, where], [center - sign * half, y - sign * 0.05], color=look.color, lw=0.9)
    style: dict[str, Any] = {
        "arrowstyle": "-|>",
        "mutation_scale": 7,
        "shrinkA": 0,
        "shrinkB": 0,
        "lw": 1,
        "zorder": 4,
    }
    for start, end in ((planes[0] - 0.2, planes[0]), (planes[1] + 0.2, planes[1])):
        scene.axes.add_patch(FancyArrowPatch((start, y), (end, y), color="black", **style))
    scene.label(planes[1] + 0.24, y, "focus shift", ha="left", va="center")


def _source(scene: _Scene, x: float, y: float) -> None:
    """Source of light, a point."""
    scene.axes.add_patch(Rectangle((x - 0.58, y - 0.16), 0.54, 0.32, fc=_METAL, ec="none"))
    scene.axes.add_patch(Circle((x, y), 0.04, fc="#c1121f", ec="none", zorder=4))
    scene.label(x - 0.31, y, "source", color="white", va="center")
    scene.label(x - 0.58, y + 0.27, "635 nm", ha="left")


def _segmented_mirror(scene: _Scene, center: _Point, tilt: float, bench: Bench, pistons: NDArray) -> None:
    """Segments along the vertical diameter, each pushed by its command, on a plate."""
    middle = bench.segments[:, bench.segments.shape[1] // 2]
    numbers = [number for number in dict.fromkeys(middle.tolist()) if number]
    moved = dict(zip(bench.numbers.tolist(), pistons / np.abs(pistons).max(initial=1e-9), strict=True))
    width = 0.84 / len(numbers)
    for index, number in enumerate(numbers):
        across = (index - (len(numbers) - 1) / 2) * width
        corners = [(0.045 * moved[number] + s, across + t) for s, t in _box(0.0, 0.16, 0.45 * width)]
        _solid(scene, center, tilt, corners, "#8d99ae", _METAL)
    _solid(scene, center, tilt, _box(0.2, 0.3, 0.46), _METAL, "none")


def _actuated_mirror(scene: _Scene, center: _Point, tilt: float) -> None:
    """Continuous mirror on actuators, which leave their print on its face."""
    across = np.linspace(-0.42, 0.42, 127)
    face = [(0.022 * (1 - np.cos(2 * np.pi * t / 0.12)), t) for t in across]
    for t in np.linspace(-0.36, 0.36, 7):
        _solid(scene, center, tilt, [(s, t + d) for s, d in _box(0.1, 0.22, 0.015)], _METAL, "none")
    _solid(scene, center, tilt, _box(0.2, 0.3, 0.46), _METAL, "none")
    _solid(scene, center, tilt, [*face, (0.12, 0.42), (0.12, -0.42)], "#8d99ae", _METAL)


def _box(low: float, high: float, half: float) -> list[_Point]:
    return [(low, -half), (high, -half), (high, half), (low, half)]


def _solid(scene: _Scene, center: _Point, tilt: float, corners: list[_Point], color: str, edge: str) -> None:
    """Polygon given by (depth, height), turned by `tilt` (radian) around `center`."""
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    points = np.asarray(corners) @ turn.T + center
    scene.axes.add_patch(Polygon(points, closed=True, fc=color, ec=edge, lw=0.8, zorder=3))
