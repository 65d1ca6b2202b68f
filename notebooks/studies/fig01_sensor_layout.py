"""Figure 1: the planes of a sensor with one mask, and the waves that interfere on its detector."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.drawings import FOCUS_MAP, Picture, draw_layout, focal_light, shift_label
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP, dashed_circle
from studies.kit.tables import Table
from zwfs.metrics import strehl
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter rms", phase_shift=(-6.2832, 6.2832))


def draw_sensor_layout(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 1: the planes of a sensor with one mask, with the fields computed for `phase` (radian)."""
    mask = sensor.masks[0]
    texts = {"diameter": f"{mask.diameter:g}", "shift": shift_label(mask)}
    dimple = "dimple\n{diameter} $\\lambda/D$, {shift} rad".format_map(texts)

    def mark(pictures: dict[str, Axes], narrow: bool) -> None:
        """Edge of the dimple with a line to its name, and a length of 2 lambda/D."""
        axes, edge = pictures["focus"], 80 * mask.diameter / 2 / _REACH
        size = axes.figure.axes[0].texts[0].get_fontsize()
        style: dict[str, Any] = {"color": "white", "ha": "center", "fontsize": size, "linespacing": 1.1}
        dashed_circle(axes, (80, 80), edge)
        axes.plot([20, 60], [10, 10], color="white", lw=1.5)
        axes.text(40, 16, r"2 $\lambda/D$", **style)
        end = (160, 30) if narrow else (80, 118)
        start = (80 + edge, 80) if narrow else (80, 80 + edge)
        axes.plot(*zip(start, end, strict=True), color="white", lw=0.8)
        if not narrow:
            axes.text(80, 120, dimple, **style)

    files = "fig01_sensor_layout.svg", "fig01_sensor_layout_narrow.svg"
    return draw_layout(*files, _pictures(sensor, phase), texts, mark)


def _pictures(sensor: ZernikeSensor, phase: NDArray) -> dict[str, Picture]:
    """Pictures in the planes, and those of the terms whose sum is the intensity on the detector."""
    pupil = sensor.pupil
    field = pupil.field(phase)
    wave = sensor.reference_wave(field)[0]
    frame = np.abs(sensor.propagate(field)[0]) ** 2
    inside = np.where(pupil.inside, phase, np.nan)
    limit = np.nanmax(np.abs(inside))
    light = focal_light(pupil, field, _REACH)
    interference = 2 * np.abs(pupil.amplitude * wave) * np.cos(np.angle(field * wave.conj()))
    high = frame.max()
    return {
        "pupil": Picture(inside, PHASE_MAP, -limit, limit, "phase (rad)"),
        "focus": Picture(light, FOCUS_MAP, -4, 0, "intensity in the focal plane (log10)"),
        "detector": Picture(frame, INTENSITY_MAP, 0, high, "I_out"),
        "out": Picture(frame, INTENSITY_MAP, 0, high, "I_out"),
        "in": Picture(pupil.amplitude**2, INTENSITY_MAP, 0, high, "I_in"),
        "reference": Picture(np.abs(wave) ** 2, INTENSITY_MAP, 0, high, "I_ref"),
        "interference": Picture(interference, PHASE_MAP, -high, high, "interference"),
    }


_REACH = 4.0  # of the picture of the focal plane, lambda/D from its centre, over 161 samples


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
