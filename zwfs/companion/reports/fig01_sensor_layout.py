"""Figure 1: columns of the figure, and the table of the identity behind it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.tables import Table
from zwfs.metrics import strehl
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor


def columns(
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


def identity(
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
