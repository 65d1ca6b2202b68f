"""Photons that sensors of different designs need: diameter of the dimple, and phase shifts. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from studies.kit import sweeps
from studies.kit.methods import MASKS
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.tables import Table
from zwfs.bounds import cramer_rao
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes inputs n_screens exponent",
    n_pixels=(16, 200),
    step=(0.05, 1.0),
    diameter_max=(2.0, 8.0),
    n_angles=(2, 100),
    added=(-1.0, 1.0),
)
QUICK = {"n_pixels": 32, "n_screens": 2, "step": 0.4, "n_angles": 7}

_TOLERANCE = 1e-4  # of the model of the sensor: changes the bound by less than 1e-3, and is several times faster


class Design(NamedTuple):
    """A sensor with two dimples of one diameter (lambda/D) and phase shifts (radian)."""

    name: str
    diameter: float
    theta_a: float
    theta_b: float


def _instrument(name: str, *masks: str) -> Design:
    """Design of an instrument, with the mean diameter of its masks in `MASKS`."""
    first, second = MASKS[masks[0]]
    return Design(name, float(np.mean([MASKS[one][0].diameter for one in masks])), first.phase, second.phase)


PUBLISHED = (
    Design("paper", 1.06, np.pi / 2, -np.pi / 2),
    _instrument("Keck", "Keck"),
    _instrument("OZIRIIS", "OZIRIIS, on the sky", "OZIRIIS, in the laboratory"),
)
"""Design of the paper and of two instruments; the diameter of OZIRIIS is the middle of 1.96 to 2.14 lambda/D."""
CLASSIC = Design("one dimple", 1.06, np.pi / 2, np.pi / 2)
"""The classic sensor with one dimple: two equal masks, each with half of the light."""


def uneven(design: Design, shift: float) -> Design:
    """Design with `shift` (radian) added to both phase shifts: their sizes then differ."""
    return Design("uneven", design.diameter, design.theta_a + shift, design.theta_b + shift)


def photon_costs(
    pupil: Pupil, designs: Sequence[Design], wavefronts: Mapping[str, NDArray]
) -> dict[str, NDArray[np.float64]]:
    """Photons that a sensor needs, over those of an ideal sensor with the same error."""
    costs = [_costs(pupil, design, wavefronts) for design in designs]
    return {name: np.array([cost[name] for cost in costs]) for name in wavefronts}


@dataclass(frozen=True)
class DesignMap:
    """Photon costs of sensors with dimples of phase shifts theta and -theta."""

    diameters: NDArray[np.float64]  # (n_diameters,), lambda/D
    angles: NDArray[np.float64]  # (n_angles,), theta, radian
    costs: dict[str, NDArray[np.float64]]  # (n_diameters, n_angles), by the name of the wavefronts

    def best(self, name: str) -> Design:
        """Design with the least cost for the wavefronts `name`."""
        return self._at(f"best, {name}", self.costs[name])

    @property
    def all_round(self) -> Design:
        """Design whose cost exceeds the least one by the smallest factor, in the worst case of all wavefronts."""
        return self._at("all-round", np.max([cost / cost.min() for cost in self.costs.values()], axis=0))

    def _at(self, name: str, values: NDArray) -> Design:
        row, column = np.unravel_index(np.argmin(values), values.shape)
        theta = float(self.angles[column])
        return Design(name, float(self.diameters[row]), theta, -theta)


def design_map(
    pupil: Pupil, diameters: ArrayLike, angles: ArrayLike, wavefronts: Mapping[str, NDArray]
) -> DesignMap:
    """Photon costs for all diameters and all pairs of opposite phase shifts."""
    diameters, angles = np.asarray(diameters), np.asarray(angles)
    rows = sweeps.run(_row, diameters.tolist(), pupil, angles.tolist(), dict(wavefronts), name="design_map")
    return DesignMap(diameters, angles, {name: np.array([row[name] for row in rows]) for name in wavefronts})


def _row(
    diameter: float, pupil: Pupil, angles: list[float], screens: dict[str, NDArray]
) -> dict[str, NDArray[np.float64]]:
    """Costs of one diameter, (n_angles,) each."""
    costs = [_costs(pupil, Design("", diameter, theta, -theta), screens) for theta in angles]
    return {name: np.array([cost[name] for cost in costs]) for name in screens}


def _costs(pupil: Pupil, design: Design, screens: Mapping[str, NDArray]) -> dict[str, float]:
    """Photon cost of one design, by the name of the wavefronts."""
    masks = [Dimple(design.diameter, theta) for theta in design[2:]]
    sensor = ZernikeSensor(pupil, *masks, tolerance=_TOLERANCE)
    together = np.concatenate(list(screens.values()))
    bounds = pupil.gather(cramer_rao(sensor, together, photons=1 / sensor.n_masks))
    ends = np.cumsum([len(phases) for phases in screens.values()])[:-1]
    return {name: 4 * float(np.mean(part**2)) for name, part in zip(screens, np.split(bounds, ends), strict=True)}


COST_LINES = dict.fromkeys((1.25, 1.5, 2), "#222222") | dict.fromkeys((3, 5, 10), "#ffffff")
"""Photon costs at which a line is drawn, and its colour, which differs from that of the map."""
_NEAREST = 0.11  # of a label to anything else, inch
_OUTLINE = withStroke(linewidth=3, foreground="#ffffff")  # of the marks, on dark colours of the map
_MARKS = ("o", "s", "D", "*", "P", "X")


def draw_design_maps(maps: DesignMap, designs: Sequence[Design], costs: Mapping[str, NDArray]) -> Figure:
    """Photon cost against diameter and phase shift, one panel for each kind of wavefront."""
    figure, panels = plt.subplots(1, len(maps.costs), figsize=(7, 4.4), sharey=True, squeeze=False)
    x, y = maps.diameters, maps.angles / np.pi
    half = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1]
    contours: list[dict[float, list[NDArray]]] = []
    for axes, (name, grid) in zip(panels[0], maps.costs.items(), strict=True):
        axes.grid(False)
        shown = axes.imshow(
            grid.T, cmap="cividis_r", norm=LogNorm(1, 10), extent=extent, aspect="auto", interpolation="bilinear"
        )
        lines = axes.contour(x, y, grid.T, list(COST_LINES), colors=list(COST_LINES.values()), linewidths=0.8)
        contours.append(dict(zip(COST_LINES, lines.allsegs, strict=True)))
        marked = zip((*designs, maps.best(name)), (*costs[name], grid.min()), _MARKS, strict=False)
        for design, cost, mark in marked:
            low, high = sorted(abs(theta) / np.pi for theta in design[2:])
            if high > low + 1e-9:
                axes.plot([design.diameter] * 2, [low, high], color="#ffffff", lw=4)
                axes.plot([design.diameter] * 2, [low, high], color="#000000", lw=1.5)
            label = "best of each map" if design.name.startswith("best") else design.name
            size = {"*": 15}.get(mark, 8)
            axes.plot(
                design.diameter, (low + high) / 2, mark, mfc=shown.to_rgba(cost), mec="#000000", mew=1.2, ms=size,
                label=label, ls="none", clip_on=False, zorder=5, path_effects=[_OUTLINE],
            )  # fmt: skip
        axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="diameter (λ/D)")
        axes.set_title(name, fontsize=10)
        axes.yaxis.set_major_formatter(FormatStrFormatter("±%gπ"))
    panels[0, 0].set_ylabel("phase shifts (rad)")
    bar = figure.colorbar(
        shown, ax=list(panels[0]), label="photons / photons of an ideal sensor", extend="max", aspect=25
    )
    bar.ax.yaxis.set_major_locator(FixedLocator([1, 2, 3, 5, 10]))
    bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    marks, labels = panels[0, 0].get_legend_handles_labels()
    handles: list[Any] = [copy(mark) for mark in marks]
    for handle in handles:  # a mark has another colour in each panel
        handle.set_markerfacecolor("#ffffff")
    figure.legend(handles, labels, loc="outside lower center", ncols=5, handletextpad=0.2, columnspacing=1)
    figure.draw_without_rendering()  # which decides the size of the panels
    for axes, paths in zip(panels[0], contours, strict=True):
        _label_contours(axes, paths, extent)
    return figure


def _label_contours(axes: Axes, paths: Mapping[float, Sequence[NDArray]], extent: Sequence[float]) -> None:
    """Write the cost of each contour on it, on the colour that the map has there."""
    marks = np.concatenate([_dense(np.asarray(line.get_xydata())) for line in axes.lines])
    shown: Any = axes.images[0]
    size = axes.get_window_extent().size / shown.figure.dpi
    for cost, (across, up) in label_places(paths, marks, extent, size).items():
        patch = {"facecolor": shown.to_rgba(cost), "edgecolor": "none", "boxstyle": "square,pad=0.1"}
        style: dict[str, Any] = {"color": COST_LINES[cost], "fontsize": 9, "bbox": patch}
        axes.text(across, up, f"{cost:g}", ha="center", va="center", **style)


def label_places(
    paths: Mapping[float, Sequence[NDArray]], marks: NDArray, extent: Sequence[float], size: Sequence[float]
) -> dict[float, NDArray]:
    """Choose a place for the label of each contour: far from other contours, marks, labels and the frame."""
    left, right, low, high = extent
    scale = np.divide(size, (right - left, high - low))
    frame = _dense(np.array([(left, low), (right, low), (right, high), (left, high), (left, low)]))
    points = {level: np.concatenate([np.empty((0, 2)), *parts]) for level, parts in paths.items()}
    places: dict[float, NDArray] = {}
    for level, own in points.items():
        others = [other for key, other in points.items() if key != level]
        taken = np.concatenate([frame, marks, *others, *(place[np.newaxis] for place in places.values())])
        distances = cdist(own * scale, taken * scale).min(axis=1)
        if distances.size and distances.max() > _NEAREST:
            places[level] = own[distances.argmax()]
    return places


def _dense(corners: NDArray) -> NDArray:
    """Points on a line with these corners."""
    steps = np.linspace(0, 1, 25)[:, np.newaxis]
    return np.concatenate([corners[:1], *(a + steps * (b - a) for a, b in pairwise(corners))])


def design_maps_columns(maps: DesignMap) -> dict[str, NDArray]:
    """Columns of the maps."""
    return {
        "diameter (lambda/D)": np.repeat(maps.diameters, maps.angles.size),
        "phase shift (rad)": np.tile(maps.angles, maps.diameters.size),
    } | {f"photons, ideal 1, {name}": cost.ravel() for name, cost in maps.costs.items()}


def _shifts(design: Design) -> str:
    """Phase shifts in units of pi."""
    a, b = (theta / np.pi for theta in design[2:])
    return f"±{a:.3g}π" if np.isclose(a, -b) else f"{a:.3g}π, {b:.3g}π".replace("-", "−")


def _slug(design: Design) -> str:
    return design.name.replace(" ", "_").replace("-", "_")


def designs_table(listed: Sequence[Design], costs: Mapping[str, NDArray]) -> Table:
    """Photon costs of designs, and their share of the photons that the first one needs."""
    return Table(
        ["design", "d (λ/D)", "shifts", *(name.removesuffix(" wavefront") for name in costs)],
        [
            [
                design.name,
                f"{design.diameter:.3g}",
                _shifts(design),
                *(f"{cost[index]:.2f} ({cost[index] / cost[0]:.0%})" for cost in costs.values()),
            ]
            for index, design in enumerate(listed)
        ],
    )


def numbers(maps: DesignMap, listed: Sequence[Design], costs: Mapping[str, NDArray]) -> dict[str, float | str]:
    """Costs of designs by their names, and the best designs; 0 stands for the first kind of wavefront."""
    all_round = maps.all_round
    found = {"all_round_diameter": all_round.diameter, "all_round_shift": all_round.theta_a / np.pi}
    for place, (name, cost) in enumerate(costs.items()):
        found |= {f"{_slug(design)}_{place}": value for design, value in zip(listed, cost, strict=True)}
        best = maps.best(name)
        found |= {
            f"best_{place}": maps.costs[name].min(),
            f"best_diameter_{place}": best.diameter,
            f"best_shift_{place}": best.theta_a / np.pi,
            f"spread_{place}": maps.costs[name].min(axis=1)[maps.diameters >= 1.8].max() / maps.costs[name].min()
            - 1,
            f"saved_{place}": 1 - maps.costs[name].min() / cost[0],
            f"saved_all_round_{place}": 1 - found[f"all_round_{place}"] / cost[0],
        }
    return rounded(found, ".4g")
