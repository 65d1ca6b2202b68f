"""Figure of a slice of a grid of inputs."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zwfs import _check
from zwfs.companion.sweeps import Grid
from zwfs.plots.style import OTHER_STYLES


def grid_slice(grid: Grid, value: str, x: str, y: str = "", *, lines: str = "") -> Figure:
    """Mean over the screens of a result of a grid, against one or two axes.

    Parameters
    ----------
    grid : Grid
        Slice in which every other axis has a single value, see `Grid.select`.
    value : str
        Name of the result.
    x : str
        Axis from left to right.
    y : str
        Axis from bottom to top of a map; without it the figure shows curves.
    lines : str
        Axis with a curve for each value.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        If a name is unknown, or another axis has several values.
    """
    _check.choice("value", value, dict(grid.values))
    shown = [name for name in (y or lines, x) if name]
    for name in shown:
        _check.choice("axis", name, list(grid.axes))
    others = [name for name, known in grid.axes.items() if name not in (*shown, "screen") and len(known) > 1]
    if others:
        raise ValueError(f"axes {others} have several values: expected one each, as after grid.select")
    names = list(grid.axes)
    order = [names.index(name) for name in shown]
    rest = tuple(range(len(shown), len(names)))
    mean = np.moveaxis(grid.values[value], order, range(len(shown))).mean(axis=rest)
    figure, axes = plt.subplots(figsize=(6.5, 4))
    axes.set_xlabel(x)
    if y:
        mesh = axes.pcolormesh(grid.axes[x], grid.axes[y], mean, shading="nearest")
        axes.set_ylabel(y)
        figure.colorbar(mesh, label=f"mean of {value}")
        return figure
    styles = [{}] if not lines else [OTHER_STYLES[n % len(OTHER_STYLES)] for n in range(len(mean))]
    for row, style, at in zip(np.atleast_2d(mean), styles, grid.axes[lines] if lines else [""], strict=True):
        axes.plot(grid.axes[x], row, label=f"{lines} {at:g}" if lines else None, **style)
    axes.set_ylabel(f"mean of {value}")
    if lines:
        axes.legend()
    return figure
