"""The picture of the front page: one wavefront, its images, and three reconstructions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.style import LOOKS, show_intensity, show_phase
from studies.kit.tables import Text, small, two_digits
from studies.kit.variants import add_narrow
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.pupil import Pupil

LIMITS = parameter_limits("n_pixels n_modes diameter phase_shift rms exponent n_iterations")

_ROUNDING = 1e-15  # rad
_SEES = {"one image": "from image 1", "two images": "from both images"}
_RIGHT = 1.0  # radian, error up to which a point is drawn on the branch of the true phase


def draw_steps(pupil: Pupil, phase: NDArray, frames: NDArray, estimates: Mapping[str, NDArray]) -> Figure:
    """One wavefront, its two images, and the phase that each method estimates.

    On a phone the last estimate stands next to the wavefront.
    """
    *others, best = estimates
    images = ["Image 1", "Image 2"]
    maps = partial(_draw_maps, pupil, phase, dict(zip(images, frames, strict=True)), estimates)
    wide = maps([["input", *images], [*others, best]], (7.2, 5.3), 13, "right")
    return add_narrow(wide, maps([["input", best], images, others], (3.7, 7.5), 11, "bottom"))


def _draw_maps(
    pupil: Pupil,
    phase: NDArray,
    frames: Mapping[str, NDArray],
    estimates: Mapping[str, NDArray],
    layout: list[Any],  # rows of names
    size: tuple[float, float],
    letters: float,
    bars: Literal["right", "bottom"],
) -> Figure:
    """Draw the maps in this order; a colour bar stands next to the images, and one next to the last row."""
    truth = np.where(pupil.inside, phase, np.nan)
    rms = np.sqrt(np.nanmean(truth**2))
    limit = 3 * rms
    figure, panels = plt.subplot_mosaic(layout, figsize=size)
    shown = show_phase(panels["input"], truth, limit)
    panels["input"].set_title(f"Input: {two_digits(rms)} rad rms", fontsize=letters)
    top = np.quantile(list(frames.values()), 0.99)
    for title, frame in frames.items():
        light = show_intensity(panels[title], np.where(pupil.inside, frame, np.nan), top)
        panels[title].set_title(title, fontsize=letters)
    for name, estimate in estimates.items():
        look, error = LOOKS[name], wrapped_residual(pupil, estimate, phase)
        right = np.abs(error) < _RIGHT
        piston = np.mean((estimate - truth)[right]) if right.any() else 0.0
        show_phase(panels[name], np.where(right, truth + error, estimate - piston), limit)
        panels[name].set_title(f"{look.name.capitalize()},\n{_SEES[look.sees]}", fontsize=letters)
        panels[name].set_xlabel(_error(np.sqrt(np.nanmean(error**2))), fontsize=letters)
    [images] = (row for row in layout if {*frames} <= {*row})
    for mappable, row, label in ((light, images, "intensity"), (shown, layout[-1], "phase (rad)")):
        extend = "max" if mappable is light else "both"
        places = [panels[name] for name in row]
        bar = figure.colorbar(mappable, ax=places, location=bars, aspect=18, extend=extend)
        bar.set_label(label, fontsize=letters)
        bar.ax.tick_params(labelsize=letters - 1)
    return figure


def _error(rms: float) -> str:
    """Two digits, or a bound where the digits would be those of rounding errors."""
    if rms >= 0.005:
        return f"error: {rms:.2f} rad rms"
    return f"error: below $10^{{{np.ceil(np.log10(max(rms, _ROUNDING))):.0f}}}$ rad"


def findings(pupil: Pupil, phase: NDArray, estimates: Mapping[str, NDArray]) -> Text:
    """Return the error of each method."""
    linear, arcsine, shifted = (
        f"{small(reconstruction_error(pupil, estimates[name], phase).item()).replace('<', 'below ')} rad rms"
        for name in ("Linear", "Arcsine", "PhaseShifted")
    )
    return Text(
        f"**From one image of a wavefront of {two_digits(pupil.rms(phase).item())} rad rms, the error of the "
        f"linear method is {linear}, and that of the arcsine {arcsine}. From two images, the error of the "
        f"phase-shifted iteration is {shifted}.**"
    )
