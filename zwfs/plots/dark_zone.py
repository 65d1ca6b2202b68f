"""Figure of the dark zone: the residual at which a loop holds a drift, against photons and against the gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter
from numpy.typing import NDArray

from zwfs.paper.dark_zone import IDEAL, Drift, integrator_residual, kalman_limit
from zwfs.plots.style import OTHER_STYLES


def held_drift(
    errors: Mapping[str, NDArray],
    drift: Drift,
    held: Mapping[str, NDArray],
    photons: Sequence[float],
    by_gain: Mapping[float, NDArray],
    gains: Sequence[float],
) -> Figure:
    """Residual against the photons of a cycle for several sensors, and against the gain of the loop.

    Parameters
    ----------
    errors : mapping of str to ndarray, pm rms
        Bound of each mode for one photon, by the name of the sensor.
    drift : Drift
    held : mapping of str to ndarray, pm rms
        Simulated residuals of sensors, for each number of photons.
    photons : sequence of float
    by_gain : mapping of float to ndarray, pm rms
        Simulated residuals of the last sensor for each gain, by the photons of a cycle.
    gains : sequence of float
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.8), sharey=True)
    many = np.geomspace(min(photons) / 2, 2 * max(photons), 100)
    styles = dict(zip(held, OTHER_STYLES, strict=False))
    left.axhline(drift.rms, color="#999999", lw=1)
    left.plot(many, kalman_limit(errors[IDEAL], drift, many), color="#777777", ls=":", label=IDEAL)
    for name, style in styles.items():
        left.plot(many, kalman_limit(errors[name], drift, many), **style | {"marker": ""})
        left.plot(photons, held[name], **style | {"linestyle": ""}, label=name)
    left.set(xscale="log", yscale="log", xlabel="photons per cycle", ylabel="residual (pm rms)")
    left.text(many[0], 0.95 * drift.rms, "step of the drift", va="top")
    *_, last = held
    dense = np.linspace(min(gains) / 1.3, 1.05 * max(gains), 100)
    for (light, simulated), style in zip(by_gain.items(), OTHER_STYLES[len(held) - 1 :], strict=False):
        right.plot(dense, integrator_residual(errors[last], drift, light, dense), **style | {"marker": ""})
        right.plot(gains, simulated, **style | {"linestyle": ""}, label=f"$10^{{{np.log10(light):.2g}}}$ photons")
        right.axhline(kalman_limit(errors[last], drift, light), color=style["color"], lw=0.8, ls=":")
    right.set(xlabel="gain of the integrator", title=last)
    left.set_title("best gain")
    left.yaxis.set_major_locator(FixedLocator([2, 5, 10, 20, 50, 100, 200]))
    left.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    left.yaxis.set_minor_formatter(NullFormatter())
    right.legend()
    left.set_ylim(bottom=0.7 * drift.rms)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
