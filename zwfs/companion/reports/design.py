"""Designs of a sensor: their photon costs, and the numbers of the text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.design import Design, DesignMap


def columns(maps: DesignMap) -> dict[str, NDArray]:
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


def designs(listed: Sequence[Design], costs: Mapping[str, NDArray]) -> Table:
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


def numbers(maps: DesignMap, listed: Sequence[Design], costs: Mapping[str, NDArray]) -> None:
    """Glue the costs of designs by their names, and the best designs; 0 stands for the first kind of wavefront."""
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
    glue_numbers(found, ".4g")
