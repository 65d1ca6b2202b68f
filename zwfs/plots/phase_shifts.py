"""Figures of section 4.2: pairs of phase shifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from zwfs.paper.phase_shifts import DrawnNoise, PairMaps
from zwfs.plots.style import OTHER_STYLES


def all_pairs(maps: PairMaps) -> Figure:
    """Error, and photon noise for a flat and for an aberrated wavefront, for all pairs of phase shifts.

    Stars mark the best pairs. The angles of the maps must be evenly spaced.
    """
    figure, panels = plt.subplots(1, 3, figsize=(7, 3.6), sharey=True)
    half = (maps.angles[1] - maps.angles[0]) / 2 / np.pi
    ends = np.array([maps.angles[0], maps.angles[-1]]) / np.pi + np.array([-half, half])
    noise = Normalize(0.5, 3)
    for axes, image, norm, title in (
        (panels[0], maps.error, LogNorm(1e-8, 1), "error, no noise"),
        (panels[1], maps.flat, noise, "photon noise, flat"),
        (panels[2], maps.aberrated, noise, "photon noise, aberrated"),
    ):
        axes.grid(False)
        axes.set_facecolor("#d0d0d0")
        axes.add_patch(Rectangle((-3, -3), 6, 6, fc="#d0d0d0", ec="#888888", hatch="//////", lw=0, zorder=0))
        shown = axes.imshow(image, cmap="cividis_r", norm=norm, extent=(*ends, *ends), zorder=1)
        angle = {"ticks": (-1, -0.5, 0, 0.5, 1), "labels": ("−π", "−π/2", "0", "π/2", "π")}
        axes.set_xticks(**angle)
        axes.set_yticks(**angle)
        axes.set(xlim=ends, ylim=ends)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(r"$\theta_a$ (rad)")
        axes.plot([-0.5, 0.5], [0.5, -0.5], "o", mfc="none", mec="#000000", mew=1.5, ms=8, zorder=3)
        scale = r"rad rms" if axes is panels[0] else r"rad $\sqrt{\mathrm{photon}}$"
        more = "neither" if axes is panels[0] else "max"
        figure.colorbar(shown, ax=axes, location="bottom", label=scale, extend=more, aspect=16)
    for axes, name in zip(panels[1:], ("flat", "aberrated"), strict=True):
        theta_a, theta_b, _ = maps.best(name)
        pairs = np.array([[theta_a, theta_b], [theta_b, theta_a]]) / np.pi
        axes.plot(*pairs.T, "*", mfc="#ffffff", mec="#000000", ms=12, zorder=4)
    panels[0].set_ylabel(r"$\theta_b$ (rad)")
    return figure


def pair_noise(angles: NDArray, noise: Mapping[str, NDArray], rows: Sequence[DrawnNoise]) -> Figure:
    """Noise of the pairs (theta, -theta) against theta, relative to its value at pi/2.

    Parameters
    ----------
    angles : ndarray, shape (n,), radian
    noise : mapping of name to ndarray, shape (n,)
        See `zwfs.paper.phase_shifts.noise_of_pairs`.
    rows : sequence of DrawnNoise
        Those of such pairs are drawn with their standard errors.
    """
    figure, axes = plt.subplots(figsize=(7, 4.2))
    middle = int(np.argmin(np.abs(angles - np.pi / 2)))
    for (name, values), style in zip(noise.items(), OTHER_STYLES, strict=False):
        shade, scale = style["color"], values[middle]
        axes.plot(angles / np.pi, values / scale, lw=1.8, label=name, **style | {"marker": "none"})
        least = int(np.argmin(values))
        axes.plot(angles[least] / np.pi, values[least] / scale, "*", color=shade, ms=12)
        if drawn := [row for row in rows if row.name == name and row.theta_a == -row.theta_b]:
            theta, value, error = np.array([(row.theta_a, row.drawn, row.error) for row in drawn]).T
            axes.errorbar(
                theta / np.pi, value / scale, error / scale, fmt="o", mfc="none", color=shade, ms=6, capsize=3
            )
    axes.axhline(1, color="#555555", lw=1)
    axes.axvline(0.5, color="#555555", lw=1)
    axes.set_xticks((0, 0.25, 0.5, 0.75, 1), ("0", "π/4", "π/2", "3π/4", "π"))
    axes.set(xlabel=r"$\theta$ of the pair $(\theta, -\theta)$ (rad)", ylabel="noise / noise at ±π/2")
    axes.set(xlim=(0, 1), ylim=(0.6, 2))
    axes.legend(loc="lower left", fontsize=9)
    return figure
