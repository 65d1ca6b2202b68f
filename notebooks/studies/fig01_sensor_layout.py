"""Figure 1: the planes of a sensor with one mask, and the waves that interfere on its detector."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.drawings import Scene, focal_light, shift_label
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP, dashed_circle
from studies.kit.tables import Table
from zwfs.metrics import strehl
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter rms", phase_shift=(-6.2832, 6.2832))

FOCUS_MAP = "magma"


def draw_sensor_layout(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 1: the planes of a sensor with one mask, with the fields computed for `phase` (radian)."""
    pupil, mask = sensor.pupil, sensor.masks[0]
    field = pupil.field(phase)
    wave = sensor.reference_wave(field)[0]
    frame = np.abs(sensor.propagate(field)[0]) ** 2
    inside = np.where(pupil.inside, 1, np.nan)

    scene = Scene(9, 6.1)
    y, half = 3.9, 0.98
    scene.beam([(0.1, half), (2.82, half), (4.5, 0), (6.18, half), (8.9, half)], origin=(0, y))
    scene.axis((0.1, y), (8.9, y))
    for x in (2.82, 6.18):
        scene.lens(x, y, 2.4)
        scene.label(x, y - 1.5, "lens")
    scene.arrows(2.28, 2.66, y, 0.4)

    limit = np.nanmax(np.abs(phase * inside))
    _plane(scene, 1.25, "pupil plane", r"phase of $\psi_{in}$ (rad)", PHASE_MAP, phase * inside, -limit, limit)
    light = focal_light(pupil, field, 4)
    focal = _plane(scene, 4.5, "focal plane", r"$|\hat\psi_{in}|^2$ (log$_{10}$)", FOCUS_MAP, light, -4, 0)
    # The axis runs from -4 to 4 lambda/D over 161 samples.
    dashed_circle(focal, (80, 80), mask.diameter / 2 * 20)
    label = f"{mask.diameter:g} $\\lambda/D$, {shift_label(mask)} rad"
    focal.text(80, 142, label, color="white", ha="center", fontsize=scene.size)
    focal.plot([80, 80], [80 + mask.diameter * 10, 138], color="white", lw=0.8)
    focal.plot([20, 60], [10, 10], color="white", lw=1.5)
    focal.text(40, 16, r"2 $\lambda/D$", color="white", ha="center", fontsize=scene.size)
    _plane(scene, 7.75, "detector plane", r"intensity $I_{out}$", INTENSITY_MAP, frame, 0, frame.max())

    interference = 2 * np.abs(pupil.amplitude * wave) * np.cos(np.angle(field * wave.conj()))
    terms = (
        (r"$I_{out}$", "=", frame, INTENSITY_MAP, 0),
        (r"$I_{in}$", "+", pupil.amplitude**2, INTENSITY_MAP, 0),
        (r"$I_{ref}$", "+", np.abs(wave) ** 2, INTENSITY_MAP, 0),
        (r"$2\sqrt{I_{in}I_{ref}}\,\cos(\phi_{in}-\phi_{ref})$", "", interference, PHASE_MAP, -frame.max()),
    )
    for x, (title, sign, image, colors, low) in zip((1.25, 3.15, 5.05, 6.95), terms, strict=True):
        term = scene.picture(x, 1.1, 1.3, image, colors, low, frame.max(), edge=None)
        scene.label(x, 0.12, title)
        scene.label(x + 0.95, 1.1, sign, size=20, va="center")
    scene.scale(term, (7.75, 0.45, 0.08, 1.3), "intensity", ticks=5)
    return scene.figure


def _plane(
    scene: Scene, x: float, title: str, scale: str, colors: str, image: NDArray, low: float, high: float
) -> Axes:
    """Picture of a plane on the optical axis of Figure 1, its name above and its colour scale below."""
    shown = scene.picture(x, 3.9, 2.0, image, colors, low, high)
    scene.label(x, 5.78, title, weight="bold")
    scene.scale(shown, (x - 0.75, 2.7, 1.5, 0.08))
    scene.label(x, 5.2, scale)
    return shown.axes


def sensor_layout_columns(
    pupil: Pupil, phase: NDArray, measured: NDArray, incoming: NDArray, reference: NDArray
) -> dict[str, NDArray]:
    """Columns along the middle of the pupil: phase, and the intensities whose sum is measured."""
    middle = pupil.shape[0] // 2
    return {
        "x at the middle of the pupil (D)": pupil.x,
        "phase of psi_in (rad)": np.where(pupil.inside, phase, np.nan)[middle],
        "I_out": measured[middle],
        "I_in": incoming[middle],
        "I_ref": reference[middle],
        "interference": (measured - incoming - reference)[middle],
    }


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
                "share of the light inside the image of the pupil",
                float(measured[pupil.inside].sum() / pupil.n_points),
            ],
            ["mean intensity of the reference wave inside the pupil", float(reference[pupil.inside].mean())],
            ["Strehl ratio of the screen", float(strehl(pupil, phase))],
            ["coefficients of the reference wave", sensor.rank],
            ["points of the pupil", pupil.n_points],
        ],
    )
