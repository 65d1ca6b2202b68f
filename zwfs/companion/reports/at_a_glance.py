"""The front page's picture: its maps as columns, and the numbers of the text."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.metrics import reconstruction_error
from zwfs.plots import LOOKS
from zwfs.pupil import Pupil


def columns(pupil: Pupil, phase: NDArray, estimates: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of the maps, one row for each point of the pupil."""
    maps = {"input": phase} | {LOOKS[name].name: estimate for name, estimate in estimates.items()}
    places = {"x (D)": pupil.points[:, 0], "y (D)": pupil.points[:, 1]}
    return places | {f"{name} (rad)": np.round(pupil.gather(values), 5) for name, values in maps.items()}


def numbers(pupil: Pupil, phase: NDArray, estimates: Mapping[str, NDArray]) -> None:
    """Store the wavefront error and the error of each method, radian rms."""
    rms = {"input": float(pupil.rms(phase))}
    for name, estimate in estimates.items():
        rms[f"error_{name}"] = float(reconstruction_error(pupil, estimate, phase))
    for name, value in rms.items():
        glue_numbers({name: value}, ".2g" if value > 0.01 else ".1g")  # the digits of small errors are rounding
