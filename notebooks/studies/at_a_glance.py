"""The picture of the front page: one wavefront, its images, and three reconstructions."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import ALONE, LOOKS, show_intensity, show_phase
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.pupil import Pupil

LIMITS = parameter_limits("n_pixels n_modes diameter phase_shift rms exponent n_iterations")

_ROUNDING = 1e-15  # rad
_SEES = {"one image": "from image 1", "two images": "from both images"}
_LETTERS = 13  # points: on a phone the figure is as wide as the page
_RIGHT = 1.0  # radian, error up to which a point is drawn on the branch of the true phase


def draw_steps(pupil: Pupil, phase: NDArray, frames: NDArray, estimates: Mapping[str, NDArray]) -> Figure:
    """One wavefront, its two images, and the phase that each method estimates."""
    truth = np.where(pupil.inside, phase, np.nan)
    rms = np.sqrt(np.nanmean(truth**2))
    limit = 3 * rms
    figure, panels = plt.subplots(2, 3, figsize=(7.2, 5.3))
    shown = show_phase(panels[0, 0], truth, limit)
    panels[0, 0].set_gid(ALONE)
    panels[0, 0].set_title(f"Input: {rms:.1f} rad rms", fontsize=_LETTERS)
    top = np.quantile(frames, 0.99)
    for axes, frame, number in zip(panels[0, 1:], frames, ("1", "2"), strict=True):
        light = show_intensity(axes, np.where(pupil.inside, frame, np.nan), top)
        axes.set_title(f"Image {number}", fontsize=_LETTERS)
    for axes, (name, estimate) in zip(panels[1], estimates.items(), strict=True):
        look, error = LOOKS[name], wrapped_residual(pupil, estimate, phase)
        right = np.abs(error) < _RIGHT
        piston = np.mean((estimate - truth)[right]) if right.any() else 0.0
        show_phase(axes, np.where(right, truth + error, estimate - piston), limit)
        axes.set_title(f"{look.name.capitalize()},\n{_SEES[look.sees]}", fontsize=_LETTERS)
        axes.set_xlabel(_error(np.sqrt(np.nanmean(error**2))), fontsize=_LETTERS)
    bars = [figure.colorbar(light, ax=panels[0], aspect=18, extend="max")]
    bars += [figure.colorbar(shown, ax=panels[1], aspect=18, extend="both")]
    for bar, label in zip(bars, ("intensity", "phase (rad)"), strict=True):
        bar.set_label(label, fontsize=_LETTERS)
        bar.ax.tick_params(labelsize=_LETTERS - 1)
    return figure


def _error(rms: float) -> str:
    """Two digits, or a bound where the digits would be those of rounding errors."""
    if rms >= 0.005:
        return f"error: {rms:.2f} rad rms"
    return f"error: below $10^{{{np.ceil(np.log10(max(rms, _ROUNDING))):.0f}}}$ rad"


def steps_columns(pupil: Pupil, phase: NDArray, estimates: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of the maps, one row for each point of the pupil."""
    maps = {"input": phase} | {LOOKS[name].name: estimate for name, estimate in estimates.items()}
    places = {"x (D)": pupil.points[:, 0], "y (D)": pupil.points[:, 1]}
    return places | {f"{name} (rad)": np.round(pupil.gather(values), 5) for name, values in maps.items()}


def numbers(pupil: Pupil, phase: NDArray, estimates: Mapping[str, NDArray]) -> dict[str, float | str]:
    """Wavefront error and error of each method, radian rms."""
    rms = {"input": float(pupil.rms(phase))}
    rms |= {f"error_{name}": float(reconstruction_error(pupil, one, phase)) for name, one in estimates.items()}
    shifted = rms["error_PhaseShifted"]
    text = "below 10⁻⁶ rad rms" if shifted < 1e-6 else f"{shifted:.2g} rad rms"
    tiny = {name: value for name, value in rms.items() if value <= 0.01}  # their second digit is rounding
    return rounded(rms, ".2g") | rounded(tiny, ".1g") | {"error_text": text}
