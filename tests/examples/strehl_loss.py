"""Strehl ratio of random wavefronts against their rms."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import Text, two_digits
from zwfs import Pupil, power_law_screens, strehl

LIMITS = parameter_limits("n_pixels inputs n_screens")


def mean_strehl(
    pupil: Pupil, modes: NDArray, inputs: list[float], n_screens: int, seed: int
) -> NDArray[np.float64]:
    """Mean Strehl ratio of random screens of each rms (radian), (n_inputs,)."""
    return np.array([strehl(pupil, power_law_screens(modes, rms, n_screens, seed=seed)).mean() for rms in inputs])


def draw_strehl(inputs: list[float], ratio: NDArray) -> Figure:
    """Strehl ratio against the input."""
    figure, axes = plt.subplots(figsize=(5, 3.5))
    axes.plot(inputs, ratio, **OTHER_STYLES[0])
    axes.set(xlabel="input phase (rad rms)", ylabel="Strehl ratio")
    return figure


def strehl_columns(inputs: list[float], ratio: NDArray) -> dict[str, NDArray]:
    """Columns of the figure."""
    return {"input (rad rms)": np.array(inputs), "Strehl ratio": ratio}


def findings(inputs: list[float], ratio: NDArray) -> Text:
    """Return the Strehl ratio at the last input."""
    return Text(f"**At {inputs[-1]:g} rad rms, the Strehl ratio is {two_digits(ratio[-1])}.**")
