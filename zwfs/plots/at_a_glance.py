"""The picture of the front page: one wavefront, its images, and three reconstructions."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from zwfs.metrics import wrapped_residual
from zwfs.plots.style import ALONE, LOOKS, show_intensity, show_phase
from zwfs.pupil import Pupil

_ROUNDING = 1e-15  # rad
_SEES = {"one image": "from image 1", "two images": "from both images"}
_LETTERS = 13  # points: on a phone the figure is as wide as the page
_RIGHT = 1.0  # radian, error up to which a point is drawn on the branch of the true phase


def at_a_glance(pupil: Pupil, phase: NDArray, frames: NDArray, estimates: Mapping[str, NDArray]) -> Figure:
    """One wavefront, its two images, and the phase that each method estimates.

    Parameters
    ----------
    pupil : Pupil
    phase : ndarray, shape (ny, nx), radian
    frames : ndarray, shape (2, ny', nx')
    estimates : mapping of method to ndarray, shape (ny, nx), radian
        Drawn without piston, and where it is right on the branch of 2 pi of the true phase.
    """
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
