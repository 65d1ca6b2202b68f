"""Figure of the dark zone: the residual at which a loop holds a drift, against photons and against the gain."""

from __future__ import annotations

from itertools import cycle

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

from zwfs.paper.dark_zone import IDEAL, DriftCurves, integrator_residual, kalman_limit
from zwfs.plots.style import OTHER_STYLES

_SIZE = 6  # of markers, points; the first sensor has large open ones, as others lie on them
_LIGHTS = (("#333333", "s"), ("#888888", "D"))  # grays and markers of the photons, as colours stand for sensors


def held_drift(curves: DriftCurves) -> Figure:
    """Residual against the photons of a cycle for several sensors, and against the gain of the loop."""
    drift, errors, photons, held = curves.drift, curves.errors, curves.photons, curves.held
    gains = curves.gains
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.8), sharey=True)
    many = np.geomspace(min(photons) / 2, 2 * max(photons), 100)
    styles = {
        name: style | {"markersize": size, "markerfacecolor": "none" if size > _SIZE else style["color"]}
        for name, style, size in zip(held, OTHER_STYLES, (2 * _SIZE, *[_SIZE] * len(held)), strict=False)
    }
    left.axhline(drift.rms, color="#999999", lw=1)
    left.plot(many, kalman_limit(errors[IDEAL], drift, many), color="#777777", ls=":", label=IDEAL)
    for name, style in styles.items():
        left.plot(many, kalman_limit(errors[name], drift, many), **style | {"marker": ""})
        left.plot(photons, held[name], **style | {"linestyle": ""})
        left.plot([], [], **style, label=name)
    left.set(xscale="log", yscale="log", xlabel="photons per cycle", ylabel="residual (pm rms)")
    *_, last = held
    if len(held) > 1:
        level = 1.5 * drift.rms
        more, less = (np.interp(-level, -kalman_limit(errors[name], drift, many), many) for name in [*held][-2:])
        _mark_factor(left, less, more, level)
    left.text(many[0], 0.95 * drift.rms, "step of the drift", va="top")
    dense = np.linspace(min(gains) / 1.3, 1.05 * max(gains), 100)
    for (light, simulated), (gray, marker) in zip(curves.by_gain.items(), cycle(_LIGHTS), strict=False):
        right.plot(dense, integrator_residual(errors[last], drift, light, dense), color=gray)
        right.plot(gains, simulated, marker, color=gray, label=f"$10^{{{np.log10(light):.2g}}}$ photons")
        right.axhline(kalman_limit(errors[last], drift, light), color=gray, lw=0.8, ls=":")
    right.set_xlabel("gain of the integrator")
    right.set_title(f"against the gain, {last}", fontsize=10)
    left.set_title("against the photons, best gain", fontsize=10)
    left.yaxis.set_major_locator(FixedLocator([2, 5, 10, 20, 50, 100, 200]))
    left.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    left.yaxis.set_minor_formatter(NullFormatter())
    right.legend(loc="upper center", fontsize=9)
    left.set_ylim(bottom=0.7 * drift.rms)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _mark_factor(axes: Axes, less: float, more: float, level: float) -> None:
    """Arrow between two numbers of photons that give the same residual, and their ratio."""
    arrow = {"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (less, level), (more, level), arrowprops=arrow)
    text = f"{more / less:.2f} times the photons"
    axes.annotate(text, (more, level), (3, 3), textcoords="offset points", fontsize=9)
