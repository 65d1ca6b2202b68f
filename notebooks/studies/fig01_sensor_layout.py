"""Figure 1: the planes of a sensor with one mask, and the waves that interfere on its detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.drawings import FOCUS_MAP, NARROW, NARROW_LETTERS, Plane, Point, Scene, focal_light, shift_label
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP, dashed_circle
from studies.kit.tables import Table
from studies.kit.variants import add_narrow
from zwfs.masks import Mask
from zwfs.metrics import strehl
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter rms", phase_shift=(-6.2832, 6.2832))


@dataclass(frozen=True)
class _Term:
    """Picture of a term of the intensity on the detector, its name, and the sign behind it."""

    name: str
    sign: str
    image: NDArray
    colors: str
    low: float


def draw_sensor_layout(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 1: the planes of a sensor with one mask, with the fields computed for `phase` (radian)."""
    planes, terms = _pictures(sensor, phase)
    return add_narrow(_wide(sensor, planes, terms), _narrow(sensor, planes, terms))


def _pictures(sensor: ZernikeSensor, phase: NDArray) -> tuple[list[Plane], list[_Term]]:
    """Pictures in the planes, and those whose sum is the intensity on the detector."""
    pupil = sensor.pupil
    field = pupil.field(phase)
    wave = sensor.reference_wave(field)[0]
    frame = np.abs(sensor.propagate(field)[0]) ** 2
    inside = np.where(pupil.inside, 1, np.nan)
    limit = np.nanmax(np.abs(phase * inside))
    light = focal_light(pupil, field, _REACH)
    planes = [
        Plane("pupil plane", r"phase of $\psi_{in}$ (rad)", phase * inside, PHASE_MAP, -limit, limit),
        Plane("focal plane", r"$|\hat\psi_{in}|^2$ (log$_{10}$)", light, FOCUS_MAP, -4, 0),
        Plane("detector plane", r"intensity $I_{out}$", frame, INTENSITY_MAP, 0, frame.max()),
    ]
    interference = 2 * np.abs(pupil.amplitude * wave) * np.cos(np.angle(field * wave.conj()))
    terms = [
        _Term(r"$I_{out}$", "=", frame, INTENSITY_MAP, 0),
        _Term(r"$I_{in}$", "+", pupil.amplitude**2, INTENSITY_MAP, 0),
        _Term(r"$I_{ref}$", "+", np.abs(wave) ** 2, INTENSITY_MAP, 0),
        _Term(r"$2\sqrt{I_{in}I_{ref}}\,\cos(\phi_{in}-\phi_{ref})$", "", interference, PHASE_MAP, -frame.max()),
    ]
    return planes, terms


def _wide(sensor: ZernikeSensor, planes: list[Plane], terms: list[_Term]) -> Figure:
    """Light from left to right, and the terms in a row below."""
    scene = Scene(9, 6.2)
    y, lenses = 4.25, (2.82, 6.18)
    scene.path(0.1, lenses, 8.9, y, half=0.98, height=2.4)
    for x in lenses:
        scene.label(x, y - 1.5, "lens")
    scene.arrows(2.28, 2.66, y, 0.4)
    for x, plane in zip((1.25, 4.5, 7.75), planes, strict=True):
        shown = scene.show(x, y, 2.0, plane)
        scene.label(x, y + 1.64, plane.name, weight="bold")
        scene.label(x, y + 1.3, plane.scale)
        scene.scale(shown, (x - 0.75, y - 1.2, 1.5, 0.08))
        if plane.colors == FOCUS_MAP:
            _mark_dimple(shown.axes, sensor.masks[0])
            _mark_length(shown.axes)
            style: dict[str, Any] = {"color": "white", "ha": "center", "fontsize": scene.size}
            mask = sensor.masks[0]
            shown.axes.plot([80, 80], [80 + mask.diameter * 10, 118], color="white", lw=0.8)
            label = f"dimple\n{mask.diameter:g} $\\lambda/D$, {shift_label(mask)} rad"
            shown.axes.text(80, 120, label, linespacing=1.1, **style)
            shown.axes.text(40, 16, r"2 $\lambda/D$", **style)
    _draw_terms(scene, terms, [(x, 1.52) for x in (1.25, 3.35, 5.45, 7.55)], 1.3)
    return scene.figure


def _narrow(sensor: ZernikeSensor, planes: list[Plane], terms: list[_Term]) -> Figure:
    """Light from top to bottom, and the terms in two rows below."""
    height, x, f, size = 11.85, 0.95, 1.3, 1.4
    scene = Scene(NARROW, height, NARROW_LETTERS, down=(x, height - 0.1))
    first, focus, second = 0.8 + f, 0.8 + 2 * f, 0.8 + 3 * f
    end = second + f
    scene.path(0, (first, second), end, 0, half=0.62, height=1.6)
    for along in (first, second):
        scene.label(x + 0.95, scene.place(along, 0)[1], "lens", ha="left", va="center")
    scene.arrows(first - 0.38, first - 0.12, 0, 0.25)
    left, mask = x + 0.9, sensor.masks[0]
    for along, plane in zip((0.8, focus, end), planes, strict=True):
        y = scene.place(along, 0)[1]
        shown = scene.show(x, y, size, plane)
        top = y + 0.42
        scene.label(left, top, plane.name, ha="left", va="center", weight="bold")
        scene.label(left, top - 0.28, plane.scale, ha="left", va="center")
        scene.scale(shown, (left + 0.1, top - 0.56, 1.4, 0.08))
        if plane.colors == FOCUS_MAP:
            _mark_dimple(shown.axes, mask)
            _mark_length(shown.axes)
            shown.axes.text(40, 16, r"2 $\lambda/D$", color="white", ha="center", fontsize=scene.size)
            shown.axes.plot([80 + mask.diameter * 10, 160], [80, 30], color="white", lw=0.8)
            end_y = y - 0.44
            scene.callout((x + size / 2, end_y), (left - 0.05, end_y))
            label = f"dimple: {mask.diameter:g} $\\lambda/D$,\n{shift_label(mask)} rad"
            scene.label(left, end_y + 0.09, label, ha="left", va="top")
    _draw_terms(scene, terms, [(0.85, 3.65), (2.65, 3.65), (0.85, 1.45), (2.65, 1.45)], 1.3)
    return scene.figure


_REACH = 4.0  # of the picture of the focal plane, lambda/D from its centre, over 161 samples


def _mark_dimple(axes: Axes, mask: Mask) -> None:
    """Edge of the dimple."""
    dashed_circle(axes, (80, 80), mask.diameter / 2 * 80 / _REACH)


def _mark_length(axes: Axes) -> None:
    """Line of 2 lambda/D."""
    axes.plot([20, 60], [10, 10], color="white", lw=1.5)


def _draw_terms(scene: Scene, terms: list[_Term], places: list[Point], size: float) -> None:
    """Intensity on the detector as a sum; the scale of its end holds for all intensities."""
    high = terms[0].image.max()
    gap = (places[1][0] - places[0][0] - size) / 2
    for (x, y), term in zip(places, terms, strict=True):
        shown = scene.picture(x, y, size, term.image, term.colors, term.low, high, edge=None)
        shown.set_label(f"_{term.name}")
        scene.label(x, y - size / 2 - 0.12, term.name, va="top")
        scene.label(x + size / 2 + gap, y, term.sign, size=20, va="center")
        scene.scale(shown, (x - size / 2, y - size / 2 - 0.53, size, 0.08), ticks=3)


def identity_table(
    sensor: ZernikeSensor, phase: NDArray, measured: NDArray, two_waves: NDArray, reference: NDArray
) -> Table:
    """Difference of the measured intensity and that of two waves, and the light in both."""
    pupil = sensor.pupil
    return Table(
        ["quantity", "value"],
        [
            ["the two sides differ by less than 1e-13", bool(np.abs(measured - two_waves).max() < 1e-13)],
            [
                "share of all light inside the image of the pupil",
                float(measured[pupil.inside].sum() / pupil.n_points),
            ],
            ["mean intensity of the reference wave inside the pupil", float(reference[pupil.inside].mean())],
            ["Strehl ratio of the screen", float(strehl(pupil, phase))],
            ["coefficients of the reference wave", sensor.rank],
            ["points of the pupil", pupil.n_points],
        ],
    )
