"""Photons that sensors of different designs need: diameter of the dimple, and phase shifts. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.companion import sweeps
from zwfs.masks import Dimple
from zwfs.paper.phase_shifts import _check_wavefronts, _rms
from zwfs.paper.recovery import MASKS
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

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
    _check.instance("design", design, Design)
    shift = _check.number("shift", shift, -np.pi, np.pi)
    return Design("uneven", design.diameter, design.theta_a + shift, design.theta_b + shift)


def photon_costs(
    pupil: Pupil, designs: Sequence[Design], wavefronts: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.float64]]:
    """Photons that a sensor needs, over those of an ideal sensor with the same error.

    With n photons per point of the pupil, all frames together, the error of an ideal sensor is 1 / (2 sqrt(n))
    radian at every point. That of a sensor with a photon cost c is sqrt(c) times as large: the rms, over pupil and
    screens, of its Cramer-Rao bound.

    Parameters
    ----------
    pupil : Pupil
    designs : sequence of Design
    wavefronts : mapping of str to array_like, shape (n_screens, ny, nx), radian

    Returns
    -------
    dict of ndarray, shape (n_designs,)
        Photon cost by the name of the wavefronts.
    """
    screens = _check_wavefronts(pupil, wavefronts)
    _check.sequence("designs", designs, Design)
    costs = [_costs(pupil, design, screens) for design in designs]
    return {name: np.array([cost[name] for cost in costs]) for name in screens}


@dataclass(frozen=True)
class DesignMap:
    """Photon costs of sensors with dimples of phase shifts theta and -theta.

    Attributes
    ----------
    diameters : ndarray, shape (n_diameters,), lambda/D
    angles : ndarray, shape (n_angles,), radian
        Theta.
    costs : dict of ndarray, shape (n_diameters, n_angles)
        Photon cost by the name of the wavefronts, see `photon_costs`.
    """

    diameters: NDArray[np.float64]
    angles: NDArray[np.float64]
    costs: dict[str, NDArray[np.float64]]

    def best(self, name: str) -> Design:
        """Design with the least cost for the wavefronts `name`."""
        _check.choice("name", name, self.costs)
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
    pupil: Pupil, diameters: ArrayLike, angles: ArrayLike, wavefronts: Mapping[str, ArrayLike]
) -> DesignMap:
    """Photon costs for all diameters and all pairs of opposite phase shifts.

    A diameter is a task of the sweep "design_map", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    pupil : Pupil
    diameters : array_like, shape (n_diameters,), lambda/D
        From 0.1 to 8.
    angles : array_like, shape (n_angles,), radian
        Theta of the pairs (theta, -theta), from 0.01 to 3.13: at pi both masks are the same.
    wavefronts : mapping of str to array_like, shape (n_screens, ny, nx), radian

    Returns
    -------
    DesignMap
    """
    screens = _check_wavefronts(pupil, wavefronts)
    diameters, angles = _check.real_map("diameters", diameters, 1), _check.real_map("angles", angles, 1)
    for name, values, low, high in (("diameters", diameters, 0.1, 8), ("angles", angles, 0.01, 3.13)):
        if not np.all((values >= low) & (values <= high)):
            raise ValueError(
                f"{name} = {_check.shown(values)}: expected a list of values between {low} and {high}"
            )
    rows = sweeps.run(_row, diameters.tolist(), pupil, angles.tolist(), screens, name="design_map")
    return DesignMap(diameters, angles, {name: np.array([row[name] for row in rows]) for name in screens})


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
    return {name: 4 * _rms(part) ** 2 for name, part in zip(screens, np.split(bounds, ends), strict=True)}
