"""Drawings of optical layouts: SVG files, with pictures, colour scales and texts that a study computes.

Only simple elements are read, each with its own colours: ``rect``, ``polygon``, ``polyline``, ``line``,
``circle``, ``ellipse`` and ``text``. The class of a ``rect`` names the picture in it, and a second word, scale,
says that it holds the colour scale of that picture. A ``line`` is an arrow. Texts may hold TeX.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import PlaceHolderLayoutEngine
from matplotlib.patches import Ellipse, FancyArrowPatch, Patch, Polygon
from numpy.typing import NDArray

from studies.kit.style import PHASE_MAP
from studies.kit.variants import add_narrow
from zwfs.masks import Mask, focal_field
from zwfs.pupil import Pupil

_FOLDER = Path(__file__).parent.parent
_UNITS = 100  # of an SVG file in an inch
_POINTS = 72 / _UNITS  # in a unit
_MASK_SAMPLES = 161
FOCUS_MAP = "magma"
_NUMBERS = "x1", "y1", "x2", "y2", "cx", "cy", "r", "rx", "ry"
_SIDES = {"start": "left", "middle": "center", "end": "right"}
Marks = Callable[[dict[str, Axes], bool], None]
"""Draws on the axes of pictures, by their names; the second argument says whether the drawing is narrow."""


@dataclass(frozen=True)
class Picture:
    """Picture in a drawing, its colours and their ends, its name with its unit, and a picture on top of it."""

    image: NDArray
    colors: str
    low: float
    high: float
    name: str = ""
    over: Picture | None = None


def draw_layout(
    wide: str,
    narrow: str,
    pictures: Mapping[str, Picture],
    texts: Mapping[str, str] | None = None,
    marks: Marks | None = None,
) -> Figure:
    """Draw two SVG files, for screens and for phones, with these pictures, and texts for names in brackets."""
    drawings = []
    for file in (wide, narrow):
        figure, insets = _draw(_FOLDER / file, pictures, texts or {})
        if marks:
            marks(insets, file == narrow)
        drawings.append(figure)
    return add_narrow(*drawings)


def _draw(file: Path, pictures: Mapping[str, Picture], texts: Mapping[str, str]) -> tuple[Figure, dict[str, Axes]]:
    root = ElementTree.parse(file).getroot()
    *_, width, height = map(float, root.attrib["viewBox"].split())
    # Not "none": after it, a figure that is saved twice gets the layout engine of the style.
    figure = plt.figure(figsize=(width / _UNITS, height / _UNITS), layout=PlaceHolderLayoutEngine(True, True))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    insets: dict[str, Axes] = {}
    for order, element in enumerate(root):
        kind = element.tag.rpartition("}")[2]
        if kind == "rect":
            x, y, w, h = (float(element.attrib[name]) for name in ("x", "y", "width", "height"))
            inset = figure.add_axes((x / width, 1 - (y + h) / height, w / width, h / height))
            name, *scale = element.attrib["class"].split()
            if scale:
                _show_scale(inset, insets[name], element)
            else:
                insets[name] = inset
                _show_picture(inset, pictures[name], element)
        elif kind == "text":
            _write(axes, element, texts)
        elif kind != "defs":
            axes.add_artist(_shape(kind, element, order))
    return figure, insets


def _style(element: Any) -> dict[str, Any]:
    """Colours, width and dashes of an element, as keywords of a patch."""
    read = element.attrib.get
    face, edge = (
        "none" if read(part, "none") == "none" else to_rgba(read(part), float(read(f"{part}-opacity", 1)))
        for part in ("fill", "stroke")
    )
    width = float(read("stroke-width", 0)) * _POINTS
    dashes = [float(length) * _POINTS / width for length in read("stroke-dasharray", "").split()]
    return {"fc": face, "ec": edge, "lw": width, "ls": (0, dashes) if dashes else "-"}


def _shape(kind: str, element: Any, order: int) -> Patch:
    """Element of a drawing; later ones cover earlier ones."""
    style = _style(element) | {"zorder": 1 + order / 1000}
    values = {name: float(value) for name, value in element.attrib.items() if name in _NUMBERS}
    if kind in ("polygon", "polyline"):
        points = [tuple(map(float, point.split(","))) for point in element.attrib["points"].split()]
        return Polygon(points, closed=kind == "polygon", capstyle="butt", **style)
    if kind == "line":
        heads = "<|-|>" if "marker-start" in element.attrib else "-|>"
        style |= {"fc": style["ec"], "mutation_scale": 8 if heads == "<|-|>" else 11, "shrinkA": 0, "shrinkB": 0}
        start, end = (values["x1"], values["y1"]), (values["x2"], values["y2"])
        return FancyArrowPatch(start, end, arrowstyle=heads, **style)
    if kind not in ("circle", "ellipse"):
        raise ValueError(f"<{kind}> in a drawing: expected one of the simple elements of {__name__}")
    width, height = (2 * values.get(name, values.get("r", 0)) for name in ("rx", "ry"))
    turn = re.match(r"rotate\(([-\d.]+)", element.attrib.get("transform", ""))
    return Ellipse((values["cx"], values["cy"]), width, height, angle=float(turn[1]) if turn else 0, **style)


def _write(axes: Axes, element: Any, texts: Mapping[str, str]) -> None:
    read = element.attrib.get
    text = re.sub(r"\[(\w+)\]", lambda name: texts[name[1]], element.text)
    style = {"color": read("fill", "#000000"), "weight": read("font-weight", "normal")}
    style["ha"] = _SIDES[read("text-anchor", "start")]
    axes.text(float(read("x")), float(read("y")), text, fontsize=float(read("font-size")) * _POINTS, **style)


def _show_picture(axes: Axes, picture: Picture, element: Any) -> None:
    """Show a picture and those on top of it, its first row at the bottom, with the frame of the element."""
    edge = _style(element)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=edge["lw"] > 0, color=edge["ec"], linewidth=edge["lw"])
    layer: Picture | None = picture
    while layer:
        shown = axes.imshow(
            layer.image, cmap=layer.colors, vmin=layer.low, vmax=layer.high, origin="lower", interpolation="none"
        )
        shown.set_label(f"_{layer.name}")
        layer = layer.over


def _show_scale(axes: Axes, inset: Axes, element: Any) -> None:
    """Show the colour scale of a picture."""
    shown, size = inset.images[0], float(element.attrib["font-size"]) * _POINTS
    bar = axes.figure.colorbar(shown, cax=axes, orientation="horizontal")
    axes.tick_params(labelsize=size, length=2, pad=1)
    ticks = int(element.attrib["data-ticks"])
    axes.locator_params(nbins=ticks)
    if ticks == 2:  # a third label, 0, would touch the others
        bar.set_ticks([tick for tick in bar.get_ticks() if tick and abs(tick) <= shown.get_clim()[1]])


def mask_picture(mask: Mask, halo: NDArray, reach: float) -> Picture:
    """Phase map of a mask, in the colours of phase, over the image of the source, in faint grey."""
    u = np.linspace(-reach, reach, _MASK_SAMPLES)
    inside = np.hypot(u, u[:, np.newaxis]) <= mask.diameter / 2
    phase = np.where(inside, np.angle(mask.transmission(*np.meshgrid(u, u))), np.nan)
    # Same sampling as the image below it: one pixel of the map is one of the picture.
    return Picture(halo, "Greys", -4, 3, over=Picture(phase, PHASE_MAP, -np.pi, np.pi))


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
