"""Masks: a patch of a few lambda/D in the focal plane that changes amplitude and phase of the light."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from zwfs import _check


class Mask(Protocol):
    """What a sensor needs to know of a mask: its transmission is 1 outside a disc around the axis."""

    diameter: float
    breaks: tuple[float, ...]
    n_samples: int

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission at the focal coordinates u (horizontal) and v (vertical), in lambda/D."""


@dataclass(frozen=True)
class Dimple:
    """Uniform disc, the classic Zernike mask.

    Parameters
    ----------
    diameter : float, lambda/D
    phase : float, radian
        Phase shift theta of the light that goes through the dimple.
    amplitude : float
        Amplitude transmission of the dimple, in [0, 1].

    Raises
    ------
    ValueError
        If the diameter is not above 0 or the amplitude is outside [0, 1].

    References
    ----------
    Chambouleyron et al. 2024, section 2.2.
    """

    diameter: float
    phase: float
    amplitude: float = 1.0
    breaks: tuple[float, ...] = field(default=(), init=False, repr=False)
    n_samples: int = field(default=0, init=False, repr=False)

    def __post_init__(self) -> None:
        _check.number("diameter", self.diameter, 0, open_low=True)
        _check.number("phase", self.phase)
        _check.number("amplitude", self.amplitude, 0, 1)

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission, the same everywhere in the dimple."""
        return np.full(np.shape(u), self.amplitude * np.exp(1j * self.phase))


@dataclass(frozen=True)
class Patch:
    """Patch of any complex transmission, the general mask of section 2.1 of the paper.

    The transmission is integrated by Gauss-Legendre nodes along the radius and equispaced ones around the axis.
    It should be smooth, except at circles, which are to be named in `breaks`; a function with structure finer than
    that of the diffraction pattern of the pupil needs a larger `n_samples`.

    Parameters
    ----------
    diameter : float, lambda/D
        Diameter of the disc outside of which the transmission is 1.
    function : callable
        `function(u, v)` gives the complex transmission at focal coordinates in lambda/D (arrays of one shape;
        u is horizontal, v vertical); its modulus may not be above 1.
    breaks : sequence of float, lambda/D
        Diameters of circles at which the transmission jumps.
    n_samples : int
        Smallest number of nodes around the axis; half as many are taken along each radius. Raise it for a
        transmission with fine structure or jumps across the angle.

    Raises
    ------
    ValueError
        If the diameter is not above 0, or a break is not inside the patch.

    References
    ----------
    Chambouleyron et al. 2024, section 2.1.
    """

    diameter: float
    function: Callable[[NDArray, NDArray], NDArray]
    breaks: Sequence[float] = ()
    n_samples: int = 0

    def __post_init__(self) -> None:
        diameter = _check.number("diameter", self.diameter, 0, open_low=True)
        if not callable(self.function):
            raise TypeError(f"function = {self.function!r}: expected a callable of (u, v)")
        breaks = tuple(
            _check.number(f"breaks[{i}]", value, 0, diameter, open_low=True, open_high=True)
            for i, value in enumerate(self.breaks)
        )
        _check.integer("n_samples", self.n_samples, 0)
        object.__setattr__(self, "breaks", tuple(sorted(breaks)))

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission at (u, v), checked."""
        values = _check.complex_array("transmission", self.function(u, v))
        values = np.broadcast_to(values, np.shape(u)).astype(np.complex128)
        _check.finite("transmission", values)
        largest = np.abs(values).max(initial=0.0)
        if largest > 1 + 1e-12:
            raise ValueError(f"transmission reaches a modulus of {largest:.6g}: expected at most 1")
        return values
