"""Figures of phase and amplitude: errors against the variation of the amplitude, and maps of one estimate."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from zwfs.metrics import wrapped_residual
from zwfs.paper.phase_amplitude import WAYS, AmplitudeCurves
from zwfs.plots.style import LOOKS, show_intensity, show_phase
from zwfs.pupil import Pupil
from zwfs.reconstructors import LikelihoodReconstruction

_LINES = {"ignored": ":", "measured": "--", "estimated": "-"}


def amplitude_errors(curves: Mapping[str, AmplitudeCurves]) -> Figure:
    """Error of each way and the bound against the variation of the amplitude, one panel for each kind."""
    figure, panels = plt.subplots(1, len(curves), figsize=(7, 5), sharey=True, squeeze=False)
    for axes, (kind, one) in zip(panels[0], curves.items(), strict=True):
        percent = 100 * one.variations
        axes.semilogy(percent, one.bound, color="#999999", lw=5, solid_capstyle="round", label="bound", zorder=0)
        for name, way in WAYS.items():
            look = LOOKS[way.method]
            style = {"color": look.color, "marker": look.marker, "linestyle": _LINES[way.amplitude], "ms": 6}
            style["markerfacecolor"] = "white" if way.amplitude == "measured" else look.color
            axes.plot(percent, one.error(name), label=f"{look.name}, amplitude {way.amplitude}", **style)
        axes.set_title(kind, fontsize=10)
        axes.set(xlabel="variation of the amplitude (%)", xlim=(0, None))
    panels[0, 0].set_ylabel("phase error (rad rms)")
    panels[0, 0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panels[0, 0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
    panels[0, 0].yaxis.set_minor_formatter(NullFormatter())
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=1)
    return figure


def phase_and_amplitude(
    pupil: Pupil, phase: NDArray, amplitude: NDArray, estimate: LikelihoodReconstruction
) -> Figure:
    """True and estimated phase and amplitude of one frame set, and their differences.

    Parameters
    ----------
    pupil : Pupil
    phase, amplitude : ndarray, shape (ny, nx), radian and 1
    estimate : LikelihoodReconstruction
        Of one frame set, with an unknown amplitude.
    """
    figure, panels = plt.subplots(2, 3, figsize=(7, 5), layout="constrained")
    outside = np.where(pupil.inside, 0.0, np.nan)
    residual = wrapped_residual(pupil, estimate.phase, phase)
    phases = phase + outside, phase + residual, residual
    amplitudes = amplitude + outside, estimate.amplitude, estimate.amplitude - amplitude
    titles = "true", "estimated", "difference"
    limit, small = (max(float(np.nanmax(np.abs(one))) for one in some) for some in (phases[:2], phases[2:]))
    for axes, image, title in zip(panels[0], phases, titles, strict=True):
        shown = show_phase(axes, image, small if title == "difference" else limit)
        axes.set_title(f"phase,\n{title}", fontsize=10)
        figure.colorbar(shown, ax=axes, label="rad", shrink=0.85)
    largest = float(np.nanmax(amplitudes[0]))
    for axes, image, title in zip(panels[1], amplitudes, titles, strict=True):
        if title == "difference":
            shown = show_phase(axes, image, float(np.nanmax(np.abs(image))))
        else:
            shown = show_intensity(axes, image, largest)
        axes.set_title(f"amplitude,\n{title}", fontsize=10)
        figure.colorbar(shown, ax=axes, shrink=0.85)
    return figure
