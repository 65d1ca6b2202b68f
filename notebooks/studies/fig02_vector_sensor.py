"""Figure 2: one mask that acts as two, and the images of both polarisations."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon
from numpy.typing import NDArray

from studies.kit.drawings import METAL, MINUS, PLUS, RETARDER, Scene, focal_light, mask_picture, shift_label
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter phase_shift rms")

# Title and text of a drawing, by whether its mask is of liquid crystal.
_KINDS = {
    True: ("Liquid crystal", "opposite phases for the\ntwo circular polarisations"),
    False: ("Metasurface", "opposite phases for the\ntwo linear polarisations"),
}


def draw_vector_sensor(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 2: a vector mask of liquid crystal and one of a metasurface, with the fields computed for `phase`."""
    scene = Scene(9, 8.05)
    for y, liquid in ((6.2, True), (2.55, False)):
        _vector_row(scene, y, sensor, phase, liquid=liquid)
    scene.axes.plot([0.2, 8.8], [4.43, 4.43], color="#cccccc", lw=0.8)
    _legend(scene)
    return scene.figure


def _vector_row(scene: Scene, y: float, sensor: ZernikeSensor, phase: NDArray, *, liquid: bool) -> None:
    """One vector sensor along the height `y`: pupil, focus and detector one focal length from each lens."""
    pupil_x, first, focus, second, prism, detector, images = 0.8, 2.3, 3.9, 5.5, 6.05, 7.25, 8.2
    half, apart = 0.5, 0.62
    title, text = _KINDS[liquid]
    scene.label(0.2, y + 1.42, title, size=16, weight="bold", ha="left")
    scene.label(0.2, y + 1.34, text, ha="left", va="top", color="#444444")

    scene.beam([(0.1, half), (first, half), (focus, 0), (second, half), (prism, half)], origin=(0, y))
    scene.axis((0.1, y), (prism, y))
    scene.edges([(focus, 0), (second, half), (prism, half)], origin=(0, y))
    scene.split_beam((prism, y), detector, half, apart)
    scene.arrows(1.52, 2.0, y, 0.25)
    for x in (first, second):
        scene.lens(x, y, 1.3)
    scene.label(first, y - 0.9, "lens")
    scene.label(second, y + 0.72, "lens")

    pupil = sensor.pupil
    inside = np.where(pupil.inside, phase, np.nan)
    limit = np.nanmax(np.abs(inside))
    shown = scene.picture(pupil_x, y, 1.05, inside, PHASE_MAP, -limit, limit)
    scene.label(pupil_x, y + 0.6, r"pupil: $\phi_{in}$ (rad)")
    scene.scale(shown, (pupil_x - 0.45, y - 0.66, 0.9, 0.06), ticks=2)
    scene.label(0.12, y - 1.2, "unpolarised light", ha="left")

    halo = focal_light(pupil, pupil.field(phase), 2.2)
    frames = sensor.measure(phase)
    for index, (mask, look, sign) in enumerate(zip(sensor.masks, (PLUS, MINUS), (1, -1), strict=True)):
        linear, circular, swapped = ("along", "left", "right") if sign > 0 else ("across", "right", "left")
        center = y + sign * 0.77
        mask_picture(scene, focus, center, 0.95, mask, halo, 2.2, look)
        scene.axes.plot([focus, focus], [y, center - sign * 0.475], color=look.color, lw=1, ls=look.line)
        _symbol(scene, focus - 0.38, center + sign * 0.64, circular if liquid else linear, look.color)
        name = f"{circular} circular" if liquid else "linear"
        label = f"{name}: {shift_label(mask, plus=True)}"
        scene.label(focus - 0.2, center + sign * 0.64, label, ha="left", va="center", color=look.color)
        if liquid:
            # Geometric phase comes with a half-wave retarder, which swaps the handedness.
            _symbol(scene, focus + 0.68, y + sign * 0.52, swapped, look.color)
            _symbol(scene, 5.14, y + sign * 0.56, linear, look.color)
        else:
            _symbol(scene, 4.85, y + sign * 0.52, linear, look.color)
        _symbol(scene, 6.65, y + sign * 1.08, linear, look.color)
        center = y + sign * (apart + 0.05)
        shown = scene.picture(images, center, 1.02, frames[index], INTENSITY_MAP, 0, frames.max(), edge=look.color)
        scene.label(images - 0.36, center + sign * 0.64, f"image {index + 1}", va="center", color=look.color)
    scene.scale(shown, (images + 0.15, y - 1.31, 0.38, 0.06), ticks=2)

    scene.plate(focus, y, 0.07, 0.34, RETARDER)
    scene.label(focus - 0.13, y - 0.09, "mask", ha="right", va="top")
    if liquid:
        scene.plate(4.88, y, 0.1, 0.9, "#d9c7e8", edge=RETARDER)
        scene.label(4.93, y - 0.76, "quarter-\nwave plate", va="top")
    scene.wollaston(prism, y, 0.3, 1.25)
    scene.label(prism + 0.02, y - 0.7, "Wollaston\nprism", va="top")
    scene.detector(detector, y, 2.3)
    scene.label(detector - 0.3, y - 1.42, "detector")
    _focus_marks(scene, detector, y, half, apart)


def _symbol(scene: Scene, x: float, y: float, kind: str, color: str) -> None:
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


def _legend(scene: Scene) -> None:
    """Key to the lines and signs, in two rows."""
    for x, look, text in ((0.25, PLUS, r"sees phase $+\theta$"), (2.75, MINUS, r"sees phase $-\theta$")):
        scene.key(x, 0.5, look, text)
    for x, y, kind, text in (
        (5.3, 0.5, "left", ""),
        (5.62, 0.5, "right", "circular"),
        (0.45, 0.12, "along", "linear, in the drawing"),
        (3.2, 0.12, "across", "linear, perpendicular"),
    ):
        _symbol(scene, x, y + 0.07, kind, METAL)
        scene.label(x + 0.27, y, text, ha="left")


def _focus_marks(scene: Scene, x: float, y: float, half: float, apart: float) -> None:
    """Planes in which each of the two images is sharp, one before and one behind the detector."""
    planes = x - 0.13, x + 0.2
    for look, sign, where in zip((PLUS, MINUS), (1, -1), planes, strict=True):
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


def vector_sensor_columns(pupil: Pupil, phase: NDArray, frames: NDArray) -> dict[str, NDArray]:
    """Columns of the phase and both images at the points of the pupil."""
    x, y = pupil.points.T
    return {
        "x (D)": x,
        "y (D)": y,
        "input phase (rad)": pupil.gather(phase),
        "image 1 (mean of the pupil)": pupil.gather(frames[0]),
        "image 2 (mean of the pupil)": pupil.gather(frames[1]),
    }


def pair_table(plus: Dimple, minus: Dimple, turn: NDArray, images: NDArray) -> Table:
    """Phase shifts, angle between the reference waves (radian), determinant, and both images of the pupil."""
    determinant, expected = np.abs(np.sin(turn)), abs(np.sin((plus.phase - minus.phase) / 2))
    return Table(
        ["quantity", "value"],
        [
            ["phase shift for the first polarisation (π)", plus.phase / np.pi],
            ["phase shift for the second (π)", minus.phase / np.pi],
            ["between the reference waves, mean (π)", float(np.abs(turn).mean() / np.pi)],
            ["det M, smallest modulus in the pupil", float(determinant.min())],
            ["the modulus is that of sin(Δθ/2) within 1e-12", bool(np.abs(determinant - expected).max() < 1e-12)],
            ["light of image 1 inside the pupil", float(images[0].mean())],
            ["light of image 2 inside the pupil", float(images[1].mean())],
            ["correlation of the two images", float(np.corrcoef(*images)[0, 1])],
        ],
    )
