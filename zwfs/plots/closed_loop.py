"""Figures of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zwfs.paper.closed_loop import LoopRun
from zwfs.plots.style import LOOKS


def loop_runs(runs: Mapping[float, Mapping[str, LoopRun]]) -> Figure:
    """Residual against time: a column for each star, a row for each method, and a line for each screen.

    Parameters
    ----------
    runs : mapping of magnitude to mapping of method to LoopRun
    """
    n_rows = len(next(iter(runs.values())))
    figure, panels = plt.subplots(
        n_rows, len(runs), figsize=(7, 0.8 + 2.1 * n_rows), sharex=True, sharey=True, squeeze=False
    )
    for column, (magnitude, methods) in zip(panels.T, runs.items(), strict=True):
        column[0].set_title(f"magnitude {magnitude:g}", fontsize=10)
        column[-1].set_xlabel("time (ms)")
        for axes, (name, run) in zip(column, methods.items(), strict=True):
            time = 1e3 * run.times
            axes.semilogy(time, run.residual.T, lw=1, color=LOOKS[name].color)
            axes.semilogy(time, np.median(run.open_loop, axis=0), color="#777777", lw=1.5, ls="--")
            axes.set_xlim(0, time[-1])
    for axes, name in zip(panels[:, 0], methods, strict=True):
        axes.set_ylabel(f"{LOOKS[name].name}\nresidual (rad rms)")
    place = 0.97 * time[-1], 1.25 * run.open_loop.mean()
    panels[-1, 0].text(*place, "no correction", ha="right", va="bottom", color="#777777")
    return figure


def capture(inputs: Sequence[float], runs: Sequence[Mapping[str, LoopRun]]) -> Figure:
    """Fraction of the loops that close, and the residual of these, against the wavefront error at the start.

    Parameters
    ----------
    inputs : sequence of float, radian rms
    runs : sequence of mapping of method to LoopRun
        One for each input.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.8))
    for name in runs[0]:
        look = LOOKS[name]
        closed = [100 * np.mean(methods[name].closed()) for methods in runs]
        left.plot(inputs, closed, label=look.label, **look.style)
        right.semilogy(inputs, [methods[name].held() for methods in runs], label=look.label, **look.style)
        points = [(start, value) for start, one in zip(inputs, runs, strict=True) for value in one[name].settled()]
        right.plot(*np.transpose(points), ".", color=look.color, ms=4, alpha=0.5)
    right.plot(inputs, inputs, color="#777777", lw=1, label="as at the start")
    left.set(xlabel="error at the start (rad rms)", ylabel="loops that close (%)", ylim=(-3, 103))
    right.set(xlabel="error at the start (rad rms)", ylabel="settled residual (rad rms)")
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
