"""Photons that sensors of different designs need: diameter of the dimple, and phase shifts. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MultipleLocator
from numpy.typing import ArrayLike, NDArray

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

# Tolerances of the model of the sensor, for dimples up to 3 lambda/D and for larger ones, which take most of the
# time. They change costs below 10 by less than 1e-3.
_TOLERANCES = 1e-4, 1e-3


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


def diameters(largest: float, step: float) -> NDArray[np.float64]:
    """Diameters (lambda/D) from 0.8 on, by a step up to 3 and by ten times the step above."""
    fine = np.arange(0.8, min(largest, 3.0) + step / 2, step)
    return np.concatenate([fine, np.arange(fine[-1] + 10 * step, largest + step / 2, 10 * step)]).round(9)


def design_map(
    pupil: Pupil, diameters: ArrayLike, angles: ArrayLike, wavefronts: Mapping[str, NDArray]
) -> DesignMap:
    """Photon costs for all diameters and all pairs of opposite phase shifts."""
    diameters, angles = np.asarray(diameters), np.asarray(angles)
    shared = pupil, angles.tolist(), dict(wavefronts)
    return DesignMap(diameters, angles, sweeps.table(_row, diameters.tolist(), *shared, name="design_map"))


def _row(
    diameter: float, pupil: Pupil, angles: list[float], screens: dict[str, NDArray]
) -> dict[str, NDArray[np.float64]]:
    """Costs of one diameter, (n_angles,) each."""
    costs = [_costs(pupil, Design("", diameter, theta, -theta), screens) for theta in angles]
    return {name: np.array([cost[name] for cost in costs]) for name in screens}


def _costs(pupil: Pupil, design: Design, screens: Mapping[str, NDArray]) -> dict[str, float]:
    """Photon cost of one design, by the name of the wavefronts."""
    masks = [Dimple(design.diameter, theta) for theta in design[2:]]
    sensor = ZernikeSensor(pupil, *masks, tolerance=_TOLERANCES[design.diameter > 3])
    together = np.concatenate(list(screens.values()))
    bounds = pupil.gather(cramer_rao(sensor, together, photons=1 / sensor.n_masks))
    ends = np.cumsum([len(phases) for phases in screens.values()])[:-1]
    return {name: 4 * float(np.mean(part**2)) for name, part in zip(screens, np.split(bounds, ends), strict=True)}


_LABEL_WIDTH = 0.75  # of the label of a design in a panel, over its width
_NARROWEST = 0.3  # line that gets a number, over the width of a panel, if there is a longer one of its level
COST_MAP = "cividis_r"
CONTOURS = [1.5, 2, 3, 5]  # photon costs of the lines in a map


def draw_design_maps(maps: DesignMap, designs: Sequence[Design], costs: Mapping[str, NDArray]) -> Figure:
    """Photon cost against diameter and phase shift, one panel for each kind of wavefront.

    Designs whose phase shifts are of equal size are marked with their cost, and a star marks the best one.
    """
    figure, panels = plt.subplots(1, len(maps.costs), figsize=(7, 3.8), sharey=True, squeeze=False)
    x, y = maps.diameters, maps.angles
    colors = {"cmap": COST_MAP, "norm": LogNorm(1, 10)}
    for axes, (name, grid) in zip(panels[0], maps.costs.items(), strict=True):
        axes.grid(False)
        shown = axes.pcolormesh(x, y, grid.T, shading="gouraud", rasterized=True, **colors)
        lines = axes.contour(
            x, y, grid.T, CONTOURS, colors=["#000000", "#000000", "#000000", "#ffffff"], linewidths=1
        )
        marked = []
        for design, cost in zip(designs, costs[name], strict=True):
            if np.isclose(design.theta_a, -design.theta_b):
                place = design.diameter, design.theta_a
                marked.append(place)
                axes.plot(*place, "o", mfc="#ffffff", mec="#000000", ms=8, zorder=7)
                axes.annotate(f"{design.name}: {cost:.2f}", place, (8, 0), textcoords="offset points", **_LABEL)
        best = maps.best(name)
        axes.plot(best.diameter, best.theta_a, "*", mfc="#ffffff", mec="#000000", ms=13, zorder=6)
        axes.set(xscale="log", xlim=x[[0, -1]], ylim=y[[0, -1]], xlabel="diameter (λ/D)")
        axes.spines[:].set(visible=True, color="#888888")
        axes.clabel(lines, fmt="%g", fontsize=9, manual=_free_places(lines, x, y, marked))
        axes.xaxis.set(major_locator=FixedLocator([1, 2, 3, 5, 7]), major_formatter="{x:g}", minor_formatter="")
        axes.set_title(name, fontsize=10)
        axes.yaxis.set(major_locator=MultipleLocator(np.pi / 5), major_formatter=_both_signs)
    panels[0, 0].set_ylabel("phase shifts (rad)")
    label = "photons / photons of an ideal sensor"
    bar = figure.colorbar(shown, ax=list(panels[0]), label=label, extend="max", aspect=25)
    bar.set_ticks([1, *CONTOURS, 10], labels=[f"{level:g}" for level in (1, *CONTOURS, 10)])
    bar.minorticks_off()
    return figure


def _both_signs(angle: float, place: int) -> str:
    """Phase shifts of equal size, as a label."""
    return f"±{angle / np.pi:.2g}π"


def _free_places(
    lines: ContourSet, x: NDArray, y: NDArray, marked: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Return a point of each long line that is far from the labels of the marked places and from the edges."""

    def fraction(points: ArrayLike) -> NDArray[np.float64]:
        points = np.asarray(points, float).reshape(-1, 2)
        across = np.log(points[:, 0] / x[0]) / np.log(x[-1] / x[0])
        return np.stack([across, (points[:, 1] - y[0]) / (y[-1] - y[0])], axis=-1)

    taken = [
        np.array([px + shift, py]) for px, py in fraction(marked) for shift in np.arange(0, _LABEL_WIDTH, 0.05)
    ]
    levels = [[fraction(one) for one in path.to_polygons(closed_only=False)] for path in lines.get_paths()]
    every = [one for level in levels for one in level]
    found: list[NDArray] = []
    for level in levels:
        for at in level:
            if np.ptp(at[:, 0]) < _NARROWEST and len(at) < max(map(len, level)):
                continue
            rest = [one for one in every if one is not at] or [at + 1]
            apart = _apart(at, np.concatenate(rest))
            room = np.min([np.minimum(at, 1 - at).min(axis=-1), _apart(at, [*taken, *found]), 3 * apart], axis=0)
            found.append(at[np.argmax(room)])
    return [(x[0] * (x[-1] / x[0]) ** u, y[0] + v * (y[-1] - y[0])) for u, v in found]


def _apart(points: NDArray, others: ArrayLike) -> NDArray[np.float64]:
    """Distance of each point from the closest of the others; 1 without others."""
    others = np.asarray(others, float).reshape(-1, 2)
    return np.linalg.norm(points[:, np.newaxis] - others, axis=-1).min(axis=-1, initial=1)


_BOX = {"facecolor": "#ffffff", "edgecolor": "none", "boxstyle": "square,pad=0.15"}
_LABEL: dict[str, Any] = {"va": "center", "fontsize": 9, "bbox": _BOX, "zorder": 6}  # of designs


def _shifts(design: Design) -> str:
    """Phase shifts in units of pi."""
    a, b = (theta / np.pi for theta in design[2:])
    return f"±{a:.3g}π" if np.isclose(a, -b) else f"{a:.3g}π, {b:.3g}π".replace("-", "−")


def designs_table(listed: Sequence[Design], costs: Mapping[str, NDArray]) -> Table:
    """Photon costs of designs. Costs above 100 have no number."""
    return Table(
        ["design", "d (λ/D)", "shifts", *(name.removesuffix(" wavefront") for name in costs)],
        [
            [
                design.name,
                f"{design.diameter:.3g}",
                _shifts(design),
                *(f"{cost[index]:.2f}" if cost[index] <= 100 else "over 100" for cost in costs.values()),
            ]
            for index, design in enumerate(listed)
        ],
    )


def numbers(maps: DesignMap, listed: Sequence[Design], costs: Mapping[str, NDArray]) -> dict[str, float | str]:
    """Costs of designs by their names, and the best designs; 0 stands for the first kind of wavefront."""
    all_round = maps.all_round
    found = {"all_round_diameter": all_round.diameter, "all_round_shift": all_round.theta_a / np.pi}
    for place, (name, cost) in enumerate(costs.items()):
        for design, value in zip(listed, cost, strict=True):
            found[f"{design.name.replace(' ', '_').replace('-', '_')}_{place}"] = value
        best, least = maps.best(name), maps.costs[name].min(axis=1)
        found |= {
            f"best_{place}": maps.costs[name].min(),
            f"best_diameter_{place}": best.diameter,
            f"best_shift_{place}": best.theta_a / np.pi,
            f"spread_{place}": least[maps.diameters >= 1.8].max() / least.min() - 1,
            f"saved_{place}": 1 - maps.costs[name].min() / cost[0],
            f"saved_all_round_{place}": 1 - found[f"all_round_{place}"] / cost[0],
        }
    return rounded(found, ".4g")
