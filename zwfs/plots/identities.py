"""Figures of section 2: the common approximation and the diversity of two masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zwfs.paper.identities import DimplePairs
from zwfs.plots.style import OTHER_STYLES

_FIFTH: dict[str, Any] = {"color": "#777777", "marker": "s", "linestyle": (0, (4, 1))}


def approximation(
    rms: Sequence[float], wave: Mapping[str, Sequence[float]], steps: Mapping[str, Sequence[float]]
) -> Figure:
    """Error of approximate reference waves against the input, and of one step of reconstruction with each.

    Parameters
    ----------
    rms : sequence of float, radian rms
        Input.
    wave : mapping of label to sequence
        Errors of the reference wave.
    steps : mapping of label to sequence
        Error of the reconstructed phase over the input. A label that occurs in both has the same look.
    """
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 4.0))
    styles = dict(zip(dict.fromkeys([*steps, *wave]), cycle((*OTHER_STYLES, _FIFTH)), strict=False))
    for axes, curves in zip(panels, (wave, steps), strict=True):
        for label, values in curves.items():
            axes.plot(rms, values, markersize=4.5, label=label, **styles[label])
        top = max(max(values) for values in curves.values())
        axes.set(xlabel="input phase (rad rms)", xlim=(0, None), ylim=(0, 1.4 * top))  # room for the legend
        axes.legend(fontsize=8)
    panels[0].set_ylabel("error of the reference wave")
    panels[1].set_ylabel("error of the phase / input")
    return figure


# Pairs of phase shifts to point out, where the grid has them, rad.
_NAMED = {
    "±π/2": (-np.pi / 2, np.pi / 2),
    "±2π/3": (-2 * np.pi / 3, 2 * np.pi / 3),
    "π/12 and −11π/12": (np.pi / 12, -11 * np.pi / 12),
}


def diversity(pairs: DimplePairs) -> Figure:
    """Determinant of equation (10) and the one weighted with both reference waves, for many pairs of masks."""
    matches = {label: np.isclose(pairs.shifts, pair).all(axis=1) for label, pair in _NAMED.items()}
    named = {label: int(match.argmax()) for label, match in matches.items() if match.any()}
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.8), sharex=True)
    for axes, values in zip(panels, (pairs.determinant, pairs.strength), strict=True):
        axes.plot(pairs.difference, values, ".", color="#56B4E9", ms=4)
        for (label, index), style in zip(named.items(), OTHER_STYLES, strict=False):
            point = pairs.difference[index], values[index]
            axes.plot(*point, label=label, markersize=8, **style | {"linestyle": "none"})
        axes.set(xlabel=r"difference $\theta_b-\theta_a$ (rad)", ylim=(0, None))
        axes.set_xticks(np.pi / 2 * np.arange(5), ["0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$", r"$2\pi$"])
    panels[0].set_ylabel(r"$|\det M|$")
    panels[1].set_ylabel("weighted determinant")
    if named:
        panels[0].legend(fontsize=9, loc="lower center")  # below the arch, where no pair is
    return figure
