"""Grids: a task at every combination of some inputs, as one long table; `Recovery` is such a task."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.setups import NOISELESS, Noise, Screens
from studies.kit.style import OTHER_STYLES
from studies.kit.sweeps import run
from zwfs import Dimple, PhaseShifted, ZernikeSensor, reconstruction_error

# Relative error of the reference waves, by the precision of the frames.
_TOLERANCES = {"float64": 1e-10, "float32": 1e-6}
_UNITS = {"diameter": "λ/D", "phase_shift": "rad", "rms": "rad rms", "error": "rad rms"}


@dataclass(frozen=True)
class Recovery:
    """Errors of a reconstructor on random screens, for a dimple and an rms."""

    source: Screens
    method: Callable[[ZernikeSensor], Any] = PhaseShifted
    noise: Noise = NOISELESS
    dtype: str = "float64"

    def __call__(
        self,
        *,
        n_screens: int,
        seed: np.random.SeedSequence,
        rms: float = 0.5,
        diameter: float = 1.06,
        phase_shift: float = np.pi / 2,
    ) -> dict[str, NDArray]:
        """Return "error" (radian rms) and "converged" of each screen."""
        masks = Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift)
        method = self.method(ZernikeSensor(self.source.pupil, *masks, tolerance=_TOLERANCES[self.dtype]))
        screens = self.source(rms, n_screens, seed).astype(self.dtype)
        drawn = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0))
        estimate = method(self.noise(method.sensor, screens, drawn))
        error = reconstruction_error(self.source.pupil, estimate.phase, screens)
        return {"error": error, "converged": np.asarray(estimate.converged)}


@dataclass(frozen=True)
class Grid:
    """Long table of `grid`: a row for each screen of each combination."""

    columns: Mapping[str, NDArray]  # those of the axes, then "screen", then those of the results; shape (n_rows,)
    axes: tuple[str, ...]

    def select(self, **fixed: Any) -> Grid:
        """Return the rows with given values of some axes."""
        rows = np.ones(len(self.columns["screen"]), bool)
        for name, value in fixed.items():
            if name not in (*self.axes, "screen"):
                raise ValueError(f"unknown axis {name!r}: expected one of {', '.join(self.axes)}")
            chosen = self.columns[name] == value
            if not chosen.any():
                raise ValueError(f"{name} = {value!r}: expected one of {np.unique(self.columns[name]).tolist()}")
            rows &= chosen
        return Grid({name: column[rows] for name, column in self.columns.items()}, self.axes)

    def write(self, path: str | Path) -> None:
        """Write the table to a CSV file."""
        with Path(path).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.columns)
            writer.writerows(zip(*(column.tolist() for column in self.columns.values()), strict=True))


def grid(
    task: Callable[..., Mapping[str, Any]],
    *,
    n_screens: int,
    seed: int = 0,
    block: int = 20,
    name: str = "grid",
    **axes: Iterable[Any],
) -> Grid:
    """Run a task at every combination of some inputs, for a number of random screens.

    The task takes a value of each axis, ``n_screens`` and ``seed``. It returns n_screens results by name.
    """
    listed = {axis: np.asarray(list(values)).tolist() for axis, values in axes.items()}
    points = [tuple(zip(listed, point, strict=True)) for point in product(*listed.values())]
    blocks = [(start, min(block, n_screens - start)) for start in range(0, n_screens, block)]
    tasks = list(product(points, blocks))
    if not tasks:
        raise ValueError(f"axes = {listed}, n_screens = {n_screens}: expected at least one value each")
    parts = run(_grid_block, tasks, task, seed, name=name)
    rows = [(*(value for _, value in point), start + i) for point, (start, n) in tasks for i in range(n)]
    inputs = zip((*listed, "screen"), map(np.array, zip(*rows, strict=True)), strict=True)
    results = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return Grid(dict(inputs) | results, tuple(listed))


def _grid_block(
    value: tuple[tuple[tuple[str, Any], ...], tuple[int, int]], task: Callable[..., Mapping[str, Any]], seed: int
) -> dict[str, NDArray]:
    """Results of one block of screens at one point of a grid."""
    point, (start, n) = value
    drawn = task(**dict(point), n_screens=n, seed=np.random.SeedSequence(seed, spawn_key=(start,)))
    arrays = {name: np.asarray(result) for name, result in drawn.items()}
    for name, result in arrays.items():
        if result.shape != (n,):
            raise ValueError(f"the task returns {name} of shape {result.shape}: expected ({n},)")
    return arrays


def draw_slice(grid: Grid, value: str, x: str, y: str = "") -> Figure:
    """Mean over the screens of a result of a grid, against one or two axes; results that are NaN do not count."""
    shown = [name for name in (y, x) if name]
    others = [name for name in grid.axes if name not in shown and len(np.unique(grid.columns[name])) > 1]
    if others:
        raise ValueError(f"axes {others} have several values: expected one each, as after grid.select")
    values, places = zip(*(np.unique(grid.columns[name], return_inverse=True) for name in shown), strict=True)
    mean = _mean(places, grid.columns[value], tuple(map(len, values)))
    figure, axes = plt.subplots(figsize=(6.5, 4))
    axes.set_xlabel(_label(x))
    if y:
        mesh = axes.pcolormesh(values[1], values[0], mean, shading="nearest")
        axes.set_ylabel(_label(y))
        figure.colorbar(mesh, label=f"mean of {_label(value)}")
    else:
        axes.plot(values[0], mean, label="_mean", **OTHER_STYLES[0])
        axes.set_ylabel(f"mean of {_label(value)}")
    return figure


def _label(name: str) -> str:
    return f"{name} ({_UNITS[name]})" if name in _UNITS else name


def _mean(places: tuple[NDArray, ...], values: NDArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Mean of the values at each place; NaN where no value is finite."""
    total, count = np.zeros(shape), np.zeros(shape)
    finite = np.isfinite(values)
    where = tuple(place[finite] for place in places)
    np.add.at(total, where, values[finite])
    np.add.at(count, where, 1)
    return np.divide(total, count, out=np.full(shape, np.nan), where=count > 0)
