"""Drawings of optical layouts with computed pictures in their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.layout_engine import PlaceHolderLayoutEngine
from matplotlib.patches import Ellipse, FancyArrowPatch, Polygon
from numpy.typing import NDArray

from studies.kit.style import PHASE_MAP
from zwfs.masks import Mask, focal_field
from zwfs.pupil import Pupil

_MASK_SAMPLES = 161
_BEAM, _RAY, _EDGE = "#e0a030", "#7a4d0c", "#33658a"
_CLEAR = 0.18  # opacity of a beam: arrows, axes and edges must stay visible on it
_GLASS, _CRYSTAL = ("#3f8fc8", 0.28), ("#3f8fc8", 0.5)
METAL, RETARDER = "#444444", "#7a5195"
FOCUS_MAP = "magma"
LETTERS = 14.2
"""Size of the letters of a drawing 9 inches wide, points: on a page they are as large as its prose."""
NARROW, NARROW_LETTERS = 3.7, 11.5
"""Width of a drawing for a phone, inches, and size of its letters."""
Point = tuple[float, float]  # inches
Profile = list[tuple[float, float]]  # distance along a beam and half of its width, inches


@dataclass(frozen=True)
class Polarisation:
    """How one of the two polarisations is drawn: colour, and dashes for those who do not see it."""

    color: str
    line: str | tuple[float, tuple[float, ...]]


# Red and indigo, close to the ends of the phase map for +theta and -theta. They are far from the colours of the
# methods, and colour-blind readers can distinguish them.
PLUS, MINUS = Polarisation("#B2182B", "-"), Polarisation("#313695", (0, (4, 2)))


@dataclass(frozen=True)
class Plane:
    """Picture in a plane of a sensor, its name, and the name, colours and ends of its colour scale."""

    name: str
    scale: str
    image: NDArray
    colors: str
    low: float
    high: float


class Scene:
    """Figure without visible axes: positions in inches from its lower left corner, text of `size` points.

    With `down`, the light goes down from this point, and parts of the optics have positions along and to the left
    of it.
    """

    def __init__(self, width: float, height: float, size: float = LETTERS, down: Point | None = None) -> None:
        # Not "none": after it, a figure that is saved twice gets the layout engine of the style.
        self.figure = plt.figure(figsize=(width, height), layout=PlaceHolderLayoutEngine(True, True))
        self.width, self.height, self.size, self.down = width, height, size, down
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

    def show(self, x: float, y: float, size: float, plane: Plane) -> AxesImage:
        """Picture in a plane, centred on (x, y)."""
        shown = self.picture(x, y, size, plane.image, plane.colors, plane.low, plane.high)
        shown.set_label(f"_{plane.name}: {plane.scale}")
        return shown

    def scale(
        self, shown: AxesImage, box: tuple[float, float, float, float], name: str = "", ticks: int = 4
    ) -> None:
        """Colour scale of a picture in a box (left, bottom, width, height), along its longer side."""
        axes = self._part(*box)
        flat = box[2] > box[3]
        bar = self.figure.colorbar(shown, cax=axes, orientation="horizontal" if flat else "vertical")
        bar.set_label(name, fontsize=self.size)
        axes.tick_params(labelsize=self.size, length=2, pad=1)
        axes.locator_params(nbins=ticks)
        if ticks == 2:  # a third label, 0, would touch the others
            bar.set_ticks([one for one in bar.get_ticks() if one and abs(one) <= shown.get_clim()[1]])

    def label(
        self, x: float, y: float, text: str, size: float | None = None, ha: str = "center", **style: Any
    ) -> None:
        """Text, centred on x unless said otherwise, in points; the size is that of the scene if None."""
        self.axes.text(x, y, text, ha=ha, fontsize=size or self.size, **style)

    def place(self, along: float, across: float) -> Point:
        """Position of a point of the optics."""
        return (self.down[0] - across, self.down[1] - along) if self.down else (along, across)

    def _fill(self, points: Profile, **style: Any) -> None:
        corners = [self.place(*point) for point in points]
        self.axes.add_patch(Polygon(corners, closed=True, **style))

    def line(self, points: Sequence[Point], **style: Any) -> None:
        """Line through points of the optics."""
        self.axes.plot(*np.transpose([self.place(*point) for point in points]), **style)

    def beam(self, profile: Profile, origin: Point, angle: float = 0.0) -> None:
        """Beam of light: (distance along the axis, half of the width) at its corners."""
        low, high = _turned(profile, origin, angle)
        self._fill([*low, *high[::-1]], fc=(_BEAM, _CLEAR), ec="none")

    def edges(self, profile: Profile, origin: Point) -> None:
        """Edges of a beam that holds both polarisations, in both of their colours."""
        for look in (PLUS, MINUS):
            for side in _turned(profile, origin, 0.0):
                self.line(side, color=look.color, ls=look.line, lw=1.6)

    def axis(self, start: Point, end: Point) -> None:
        """Optical axis."""
        self.line([start, end], color="#666666", lw=0.9, ls=(0, (8, 3, 2, 3)))

    def arrows(self, start: float, end: float, y: float, apart: float) -> None:
        """Two arrows along the light."""
        for height in (y - apart, y + apart):
            self.arrow((start, height), (end, height))

    def arrow(self, start: Point, end: Point, color: str = _RAY) -> None:
        """Arrow from one point to another."""
        style: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 11, "shrinkA": 0, "shrinkB": 0, "lw": 1.4}
        self.axes.add_patch(FancyArrowPatch(self.place(*start), self.place(*end), color=color, zorder=4, **style))

    def lens(self, x: float, y: float, height: float, angle: float = 0.0) -> None:
        """Lens; `angle` (radian) is that of the light."""
        width = min(0.22, 0.13 * height)
        turn = np.degrees(angle) + (90 if self.down else 0)
        self.axes.add_patch(Ellipse(self.place(x, y), width, height, angle=turn, fc=_GLASS, ec=_EDGE, lw=1.2))

    def plate(self, x: float, y: float, width: float, height: float, color: str, edge: str = "none") -> None:
        """Plate across the light."""
        left, right, low, high = x - width / 2, x + width / 2, y - height / 2, y + height / 2
        corners = [(left, low), (right, low), (right, high), (left, high)]
        self._fill(corners, fc=color, ec=edge, zorder=3)

    def path(
        self, start: float, lenses: tuple[float, float], end: float, y: float, half: float, height: float
    ) -> None:
        """Beam of a width of twice `half` through two lenses of some height, with a focus between them."""
        profile = [(start, half), (lenses[0], half), (sum(lenses) / 2, 0.0), (lenses[1], half), (end, half)]
        self.beam(profile, origin=(0, y))
        self.axis((start, y), (end, y))
        for along in lenses:
            self.lens(along, y, height)

    def corner(self, *points: Point) -> None:
        """Light in front of a mirror that folds the beam."""
        self._fill(list(points), fc=(_BEAM, _CLEAR), ec="none")

    def stop(self, x: float, y: float, half: float, reach: float) -> None:
        """Two blades that leave an opening of twice `half`."""
        for sign in (-1, 1):
            self.plate(x, y + sign * (half + reach) / 2, 0.06, reach - half, METAL)

    def wollaston(self, x: float, y: float, width: float, height: float) -> None:
        """Wollaston prism: two wedges of crystal with their axes crossed."""
        left, right, low, high = x - width / 2, x + width / 2, y - height / 2, y + height / 2
        for corners, color in (
            ([(left, low), (right, low), (left, high)], _GLASS),
            ([(right, low), (right, high), (left, high)], _CRYSTAL),
        ):
            self._fill(corners, fc=color, ec=_EDGE, lw=1.1, zorder=3)

    def split_beam(self, start: Point, end: float, half: float, apart: float) -> None:
        """Beams of the two polarisations from a Wollaston prism to their images `apart` from the axis."""
        x, y = start
        for look, sign in ((PLUS, 1), (MINUS, -1)):
            low, high = ([(x, y + edge), (end, y + sign * apart + edge)] for edge in (-half, half))
            self._fill([*low, *high[::-1]], fc=(look.color, 0.13), ec="none")
            for side in (low, high):
                self.line(side, color=look.color, ls=look.line, lw=1.6)

    def detector(self, x: float, y: float, height: float) -> None:
        """Detector, from the side."""
        self.plate(x + 0.04, y, 0.08, height, METAL)

    def key(self, x: float, y: float, look: Polarisation, text: str) -> None:
        """Line of a polarisation, and what it means."""
        self.axes.plot([x, x + 0.4], [y + 0.05, y + 0.05], color=look.color, ls=look.line, lw=1.6)
        self.label(x + 0.47, y, text, ha="left")

    def callout(self, *points: Point) -> None:
        """Thin line from an element to its picture."""
        self.axes.plot(*np.transpose(points), color="#888888", lw=0.8, zorder=1)


def _turned(profile: Profile, origin: Point, angle: float) -> tuple[list[Point], list[Point]]:
    """Lower and upper edge of a beam along a direction (radian)."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    start = np.asarray(origin)

    def edge(sign: int) -> list[Point]:
        return [(x, y) for x, y in (start + s * along + sign * half * across for s, half in profile)]

    return edge(-1), edge(1)


def mask_picture(
    scene: Scene, x: float, y: float, size: float, mask: Mask, halo: NDArray, reach: float, look: Polarisation
) -> None:
    """Phase map of a mask, in the colours of phase, over the image of the source, in faint grey."""
    axes = scene.picture(x, y, size, halo, "Greys", -4, 3, edge=look.color).axes
    u = np.linspace(-reach, reach, _MASK_SAMPLES)
    inside = np.hypot(u, u[:, np.newaxis]) <= mask.diameter / 2
    phase = np.where(inside, np.angle(mask.transmission(*np.meshgrid(u, u))), np.nan)
    # Same sampling as the image below it: one pixel of the map is one of the picture.
    axes.imshow(phase, cmap=PHASE_MAP, vmin=-np.pi, vmax=np.pi, origin="lower", interpolation="none")


def focal_light(pupil: Pupil, field: NDArray, reach: float) -> NDArray:
    """Decadic logarithm of the intensity in the focal plane, relative to its peak, to `reach` (lambda/D)."""
    axis = np.linspace(-reach, reach, _MASK_SAMPLES)
    focus = np.abs(focal_field(pupil, field, axis, axis)) ** 2
    with np.errstate(divide="ignore"):
        return np.log10(focus / focus.max())


def shift_label(mask: Mask, *, plus: bool = False) -> str:
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
