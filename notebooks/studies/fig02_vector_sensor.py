"""Figure 2: one mask that acts as two, and the images of both polarisations."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.drawings import Picture, draw_layout, focal_light, mask_picture, shift_label
from studies.kit.parameters import parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from zwfs.masks import Dimple
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels diameter phase_shift rms")


def draw_vector_sensor(sensor: ZernikeSensor, phase: NDArray) -> Figure:
    """Figure 2: a vector mask of liquid crystal and one of a metasurface, with the fields computed for `phase`."""
    pupil, (plus, minus) = sensor.pupil, sensor.masks
    inside = np.where(pupil.inside, phase, np.nan)
    limit = np.nanmax(np.abs(inside))
    halo = focal_light(pupil, pupil.field(phase), _REACH)
    first, second = frames = sensor.measure(phase)
    pictures = {
        "phase": Picture(inside, PHASE_MAP, -limit, limit, "phase (rad)"),
        "plus": mask_picture(plus, halo, _REACH),
        "minus": mask_picture(minus, halo, _REACH),
        "image_1": Picture(first, INTENSITY_MAP, 0, frames.max(), "image 1"),
        "image_2": Picture(second, INTENSITY_MAP, 0, frames.max(), "image 2"),
    }
    texts = {"plus": shift_label(plus, plus=True), "minus": shift_label(minus, plus=True)}
    return draw_layout("fig02_vector_sensor.svg", "fig02_vector_sensor_narrow.svg", pictures, texts)


_REACH = 2.2  # of the pictures of the masks, lambda/D from their centre


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
