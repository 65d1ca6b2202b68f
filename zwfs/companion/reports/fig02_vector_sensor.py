"""Figure 2: columns of the figure, and the table of the two images and their diversity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.tables import Table
from zwfs.masks import Dimple
from zwfs.pupil import Pupil


def columns(pupil: Pupil, phase: NDArray, frames: NDArray) -> dict[str, NDArray]:
    """Columns of the phase and both images at the points of the pupil."""
    x, y = pupil.points.T
    return {
        "x (D)": x,
        "y (D)": y,
        "input phase (rad)": pupil.gather(phase),
        "image 1 (mean of the pupil)": pupil.gather(frames[0]),
        "image 2 (mean of the pupil)": pupil.gather(frames[1]),
    }


def pair(plus: Dimple, minus: Dimple, turn: NDArray, images: NDArray) -> Table:
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
