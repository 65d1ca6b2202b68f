"""Figure 2: one mask that acts as two, and the images of both polarisations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon
from numpy.typing import NDArray

from studies.kit.drawings import (
    METAL,
    MINUS,
    NARROW,
    NARROW_LETTERS,
    PLUS,
    RETARDER,
    Point,
    Scene,
    focal_light,
    mask_picture,
    shift_label,
)
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from studies.kit.variants import add_narrow
from zwfs.masks import Dimple, Mask
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter phase_shift rms")


@dataclass(frozen=True)
class _Kind:
    """Kind of mask: title, and the text below it for wide and for narrow drawings."""

    liquid: bool
    title: str
    text: str


_KINDS = (
    _Kind(True, "Liquid crystal", "opposite phases for the\ntwo circular polarisations"),
    _Kind(False, "Metasurface", "opposite phases for the\ntwo linear polarisations"),
)


@dataclass(frozen=True)
class _Places:
    """Distances along the light, and half widths of the beam and of the two lenses, inches."""

    first: float  # lens
    focus: float
    second: float  # lens
    prism: float
    detector: float
    half: float
    lens: float
    apart: float  # from the axis to the middle of an image
    prism_size: Point


_WIDE = _Places(2.3, 3.9, 5.5, 6.05, 7.25, 0.5, 1.3, 0.62, (0.3, 1.25))
_DOWN = _Places(1.5, 2.42, 3.34, 3.74, 4.4, 0.36, 0.95, 0.62, (0.24, 0.95))


@dataclass(frozen=True)
class _Computed:
    """Computed pictures of a sensor for `phase` (radian)."""

    masks: Sequence[Mask]
    phase: NDArray
    halo: NDArray
    frames: NDArray

    @property
    def limit(self) -> float:
        """End of the scale of phases."""
        return float(np.nanmax(np.abs(self.phase)))


def draw_vector_sensor(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 2: a vector mask of liquid crystal and one of a metasurface, with the fields computed for `phase`."""
    pupil = sensor.pupil
    inside = np.where(pupil.inside, phase, np.nan)
    halo = focal_light(pupil, pupil.field(phase), 2.2)
    computed = _Computed(sensor.masks, inside, halo, sensor.measure(phase))

    wide = Scene(9, 8.05)
    for y, kind in zip((6.2, 2.55), _KINDS, strict=True):
        _vector_row(wide, y, computed, kind)
    wide.axes.plot([0.2, 8.8], [4.43, 4.43], color="#cccccc", lw=0.8)
    _legend(wide, sensor.masks, [(0.25, 0.5), (2.75, 0.5), (5.3, 0.5), (5.62, 0.5), (0.45, 0.12), (3.2, 0.12)])

    narrow = Scene(NARROW, 13.8, NARROW_LETTERS)
    for top, kind in zip((13.75, 7.3), _KINDS, strict=True):
        _vector_column(narrow, top, computed, kind)
    narrow.axes.plot([0.1, 3.6], [7.33, 7.33], color="#cccccc", lw=0.8)
    keys = [(0.1, 0.66), (1.85, 0.66), (2.42, 0.37), (2.7, 0.37), (0.2, 0.37), (0.2, 0.08)]
    _legend(narrow, sensor.masks, keys)
    return add_narrow(wide.figure, narrow.figure)


def _optics(scene: Scene, start: float, at: _Places, y: float, kind: _Kind) -> None:
    """Beam from `start` and all optics, one focal length between pupil, focus or detector and a lens."""
    scene.beam(
        [(start, at.half), (at.first, at.half), (at.focus, 0), (at.second, at.half), (at.prism, at.half)],
        origin=(0, y),
    )
    scene.axis((start, y), (at.prism, y))
    scene.edges([(at.focus, 0), (at.second, at.half), (at.prism, at.half)], origin=(0, y))
    scene.split_beam((at.prism, y), at.detector, at.half, at.apart)
    for x in (at.first, at.second):
        scene.lens(x, y, at.lens)
    scene.plate(at.focus, y, 0.07, 0.34, RETARDER)
    if kind.liquid:
        scene.plate(at.second - 0.62 * at.lens / 1.3, y, 0.1, 1.8 * at.half, "#d9c7e8", edge=RETARDER)
    scene.wollaston(at.prism, y, *at.prism_size)
    scene.detector(at.detector, y, 2.3 if scene.down is None else 2 * (at.apart + at.half))
    _focus_marks(scene, at, y)


def _vector_row(scene: Scene, y: float, computed: _Computed, kind: _Kind) -> None:
    """One vector sensor along the height `y`."""
    at, pupil_x, images = _WIDE, 0.8, 8.2
    scene.label(0.2, y + 1.42, kind.title, size=16, weight="bold", ha="left")
    scene.label(0.2, y + 1.34, kind.text, ha="left", va="top", color="#444444")
    _optics(scene, 0.1, at, y, kind)
    scene.arrows(1.52, 2.0, y, 0.25)
    scene.label(at.first, y - 0.9, "lens")
    scene.label(at.second, y + 0.72, "lens")

    shown = scene.picture(pupil_x, y, 1.05, computed.phase, PHASE_MAP, -computed.limit, computed.limit)
    shown.set_label("_phase (rad)")
    scene.label(pupil_x, y + 0.6, r"pupil: $\phi_{in}$ (rad)")
    scene.scale(shown, (pupil_x - 0.45, y - 0.66, 0.9, 0.06), ticks=2)
    scene.label(0.12, y - 1.2, "unpolarised light", ha="left")

    for index, (mask, look, sign) in enumerate(zip(computed.masks, (PLUS, MINUS), (1, -1), strict=True)):
        linear, circular, swapped = _polarisations(sign)
        center = y + sign * 0.77
        mask_picture(scene, at.focus, center, 0.95, mask, computed.halo, 2.2, look)
        scene.axes.plot([at.focus, at.focus], [y, center - sign * 0.475], color=look.color, lw=1, ls=look.line)
        _symbol(scene, at.focus - 0.38, center + sign * 0.64, circular if kind.liquid else linear, look.color)
        name = f"{circular} circular" if kind.liquid else "linear"
        label = f"{name}: {shift_label(mask, plus=True)}"
        scene.label(at.focus - 0.2, center + sign * 0.64, label, ha="left", va="center", color=look.color)
        if kind.liquid:
            # Geometric phase comes with a half-wave retarder, which swaps the handedness.
            _symbol(scene, at.focus + 0.68, y + sign * 0.52, swapped, look.color)
            _symbol(scene, 5.14, y + sign * 0.56, linear, look.color)
        else:
            _symbol(scene, 4.85, y + sign * 0.52, linear, look.color)
        _symbol(scene, 6.65, y + sign * 1.08, linear, look.color)
        center = y + sign * (at.apart + 0.05)
        frame, high = computed.frames[index], computed.frames.max()
        shown = scene.picture(images, center, 1.02, frame, INTENSITY_MAP, 0, high, edge=look.color)
        shown.set_label(f"_image {index + 1}")
        scene.label(images - 0.36, center + sign * 0.64, f"image {index + 1}", va="center", color=look.color)
    scene.scale(shown, (images + 0.15, y - 1.31, 0.38, 0.06), ticks=2)

    scene.label(at.focus - 0.54, y - 0.22, "mask", ha="right", va="top")
    if kind.liquid:
        scene.label(5.0, y - 0.76, "quarter-\nwave plate", va="top")
    scene.label(at.prism - 0.02, y - 0.79, "Wollaston\nprism", va="top")
    scene.label(at.detector - 0.3, y - 1.42, "detector")
    scene.label(at.detector + 0.53, y, "focus shift", ha="left", va="center")


def _vector_column(scene: Scene, top: float, computed: _Computed, kind: _Kind) -> None:
    """One vector sensor from `top` down; the masks and images of both polarisations are side by side."""
    at, x = _DOWN, NARROW / 2
    scene.down = x, top - 0.6
    left: dict[str, Any] = {"ha": "left", "va": "center"}

    def y(along: float) -> float:
        return scene.place(along, 0)[1]

    scene.label(0.1, top - 0.2, kind.title, size=1.1 * scene.size, weight="bold", ha="left")
    scene.label(0.1, top - 0.45, kind.text.replace("\n", " ").replace(" the two", ""), ha="left", color="#444444")
    _optics(scene, 0.0, at, 0, kind)
    scene.arrows(1.05, 1.32, 0, 0.18)
    scene.label(x + 0.55, y(at.first) + 0.08, "lens", ha="left")
    scene.label(x - 0.58, y(at.second), "lens", ha="right", va="center")

    shown = scene.picture(x, y(0.5), 0.95, computed.phase, PHASE_MAP, -computed.limit, computed.limit)
    scene.label(x + 0.55, y(0.2), r"pupil: $\phi_{in}$ (rad)", **left)
    scene.scale(shown, (x + 0.65, y(0.52), 0.9, 0.06), ticks=2)
    scene.label(x - 0.6, y(0.5), "unpolarised\nlight", ha="right", va="center")

    for index, (mask, look, sign) in enumerate(zip(computed.masks, (PLUS, MINUS), (1, -1), strict=True)):
        linear, circular, swapped = _polarisations(sign)
        middle = x - sign * 1.26
        mask_picture(scene, middle, y(at.focus), 0.95, mask, computed.halo, 2.2, look)
        edge = middle + sign * 0.475
        scene.axes.plot([x, edge], [y(at.focus), y(at.focus)], color=look.color, lw=1, ls=look.line)
        name = f"{circular} circular" if kind.liquid else "linear"
        scene.label(middle, y(at.focus - 0.58), shift_label(mask, plus=True), color=look.color)
        scene.label(middle, y(at.focus - 0.8), name, color=look.color)
        _symbol(scene, middle - 0.42, y(at.focus - 0.6), circular if kind.liquid else linear, look.color)
        if kind.liquid:
            _symbol(scene, x - sign * 0.4, y(at.focus + 0.28), swapped, look.color)
            _symbol(scene, x - sign * 0.56, y(at.focus + 0.66), linear, look.color)
        else:
            _symbol(scene, x - sign * 0.5, y(at.focus + 0.5), linear, look.color)
        _symbol(scene, x - sign * 1.02, y(at.prism + 0.2), linear, look.color)
        middle = x - sign * (at.apart - 0.05)
        frame, high = computed.frames[index], computed.frames.max()
        below = y(at.detector + 0.88)
        shown = scene.picture(middle, below, 1.02, frame, INTENSITY_MAP, 0, high, edge=look.color)
        scene.label(x - sign * 1.5, below, f"image {index + 1}", va="center", color=look.color)
    scene.scale(shown, (x + 1.25, below - 0.32, 0.5, 0.06), ticks=2)

    scene.label(x + 0.2, y(at.focus) + 0.06, "mask", ha="left")
    if kind.liquid:
        scene.label(x + 0.76, y(at.focus + 0.52), "quarter-\nwave plate", ha="left", va="top")
    scene.label(x + 0.55, y(at.prism - 0.06), "Wollaston\nprism", ha="left", va="center")
    scene.label(x + at.apart + at.half + 0.06, y(at.detector), "detector", **left)
    scene.label(x - at.apart - at.half - 0.1, y(at.detector), "focus\nshift", ha="right", va="center")


def _polarisations(sign: int) -> tuple[str, str, str]:
    """Linear and circular polarisation that sees the phase of a sign, and the circular one behind the mask."""
    return ("along", "left", "right") if sign > 0 else ("across", "right", "left")


def _symbol(scene: Scene, x: float, y: float, kind: str, color: str) -> None:
    """Sign of a polarisation: "left" or "right" circular; linear, "along" the drawing's plane or "across" it."""
    axes = scene.axes
    if kind == "along":
        style: dict[str, Any] = {"arrowstyle": "<|-|>", "mutation_scale": 8, "shrinkA": 0, "shrinkB": 0, "lw": 1.4}
        dx, dy = (0, 0.15) if scene.down is None else (0.15, 0)
        axes.add_patch(FancyArrowPatch((x - dx, y - dy), (x + dx, y + dy), color=color, **style))
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


def _legend(scene: Scene, masks: Sequence[Mask], places: Sequence[Point]) -> None:
    """Key to the lines and signs."""
    for (x, y), look, mask in zip(places[:2], (PLUS, MINUS), masks, strict=True):
        scene.key(x, y, look, f"phase {shift_label(mask, plus=True)}")
    signs = (
        ("left", ""),
        ("right", "circular"),
        ("along", "linear, in the drawing"),
        ("across", "linear, perpendicular"),
    )
    for (x, y), (kind, text) in zip(places[2:], signs, strict=True):
        _symbol(scene, x, y + 0.07, kind, METAL)
        scene.label(x + 0.27, y, text, ha="left")


def _focus_marks(scene: Scene, at: _Places, y: float) -> None:
    """Planes in which each of the two images is sharp, one before and one behind the detector."""
    planes = at.detector - 0.13, at.detector + 0.2
    for look, sign, where in zip((PLUS, MINUS), (1, -1), planes, strict=True):
        center = y + sign * at.apart
        ends = [(where, center - at.half), (where, center + at.half)]
        scene.line(ends, color=look.color, lw=2.4, ls=(0, (1, 0.7)))
        scene.line([(where, center - sign * at.half), (where, y)], color=look.color, lw=0.9)
    for start, end in ((planes[0] - 0.28, planes[0]), (planes[1] + 0.28, planes[1])):
        scene.arrow((start, y), (end, y), color="#000000")


def pair_table(plus: Dimple, minus: Dimple, turn: NDArray, images: NDArray) -> Table:
    """Phase shifts, angle between the reference waves (radian), determinant, and both images of the pupil."""
    determinant, expected = np.abs(np.sin(turn)), abs(np.sin((plus.phase - minus.phase) / 2))
    return Table(
        ["quantity", "value"],
        [
            ["phase shift for the first polarisation (π)", plus.phase / np.pi],
            ["phase shift for the second (π)", minus.phase / np.pi],
            ["phase between the reference waves, mean (π)", float(np.abs(turn).mean() / np.pi)],
            ["det M, smallest modulus in the pupil", float(determinant.min())],
            ["the modulus is that of sin(Δθ/2) within 1e-12", bool(np.abs(determinant - expected).max() < 1e-12)],
            ["light of image 1 inside the pupil", float(images[0].mean())],
            ["light of image 2 inside the pupil", float(images[1].mean())],
            ["correlation of the two images", float(np.corrcoef(*images)[0, 1])],
        ],
    )
