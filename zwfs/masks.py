"""The focal plane: the field there, and masks that change its amplitude and phase on a patch of a few lambda/D.

Sensors and reconstructors need masks only; `focal_field` is for pictures and for the design of masks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.pupil import Pupil

_MOST_SAMPLES = 1024  # seconds for a mask of 1 lambda/D

Outline = Callable[[NDArray], NDArray]
"""Outline of a part of a mask: its diameter, twice the distance from the axis, lambda/D, at angles in radian."""


class Mask(Protocol):
    """Interface of a mask, whose transmission is 1 outside a disc around the axis."""

    @property
    def diameter(self) -> float:
        """Diameter of the disc, lambda/D."""

    @property
    def breaks(self) -> Sequence[float | Outline]:
        """Diameters of circles, lambda/D, and outlines at which the transmission jumps."""

    @property
    def n_samples(self) -> int:
        """Smallest number of nodes around the axis."""

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission at the focal coordinates u (horizontal) and v (vertical), in lambda/D."""


@dataclass(frozen=True)
class Dimple:
    """Uniform disc, the classic Zernike mask.

    Parameters
    ----------
    diameter : float, lambda/D
    phase : float, radian
        Phase shift theta of the light that goes through the dimple, from -2 pi to 2 pi.
    amplitude : float
        Amplitude transmission of the dimple, in [0, 1].

    References
    ----------
    Chambouleyron et al. 2024, section 2.2.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> zwfs.Dimple(diameter=2.0, phase=0.5)
    Dimple(diameter=2.0, phase=0.5, amplitude=1.0)
    >>> complex(zwfs.Dimple(1.06, np.pi / 2, amplitude=0.8).transmission(0.0, 0.0).round(3))
    0.8j
    """

    diameter: float
    phase: float
    amplitude: float = 1.0
    breaks: tuple[float, ...] = field(default=(), init=False, repr=False)
    n_samples: int = field(default=0, init=False, repr=False)

    def __post_init__(self) -> None:
        values = {
            "diameter": _check.number("diameter", self.diameter, 0, open_low=True),
            "phase": _check.radian("phase", self.phase),
            "amplitude": _check.number("amplitude", self.amplitude, 0, 1),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission, the same everywhere in the dimple."""
        u, _ = _coordinates(u, v)
        return np.full(u.shape, self.amplitude * np.exp(1j * self.phase))


@dataclass(frozen=True)
class Patch:
    """Patch of any complex transmission, the general mask of section 2.1 of the paper.

    The transmission is integrated by Gauss-Legendre nodes along the radius and equispaced ones around the axis.
    It should be smooth, except at circles and outlines, which are to be named in `breaks`; a function with
    structure finer than that of the diffraction pattern of the pupil needs a larger `n_samples`. A sensor
    estimates the error of this quadrature and warns where it exceeds the tolerance.

    A smooth outline in `breaks` is as exact as a circle: the reference wave of an ellipse of 1.6 x 1.0 lambda/D
    has an error of 2e-14 at the smallest tolerance. Without its outline the error is 1e-4 with 1024 samples.
    Corners limit the accuracy: a square of 1 lambda/D with its outline has an error of 2e-4 with 256 samples, and
    of 5e-5 with 512.

    Parameters
    ----------
    diameter : float, lambda/D
        Diameter of the disc outside of which the transmission is 1.
    function : callable
        `function(u, v)` gives the complex transmission at focal coordinates in lambda/D (arrays of one shape;
        u is horizontal, v vertical); its modulus may not be above 1.
    breaks : sequence of float or callable, lambda/D
        Where the transmission jumps: diameters of circles, and outlines around the axis. An outline is a function
        `outline(angle)` of angles in radian, from the axis of u to that of v, that gives the diameter there, twice
        the distance from the axis, at most `diameter`.
    n_samples : int
        Smallest number of nodes around the axis, at most 1024, fewer for wide masks; half as many are taken along
        each radius. Raise it for a transmission with fine structure, or an outline with corners.

    References
    ----------
    Chambouleyron et al. 2024, section 2.1.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> def two_steps(u, v):
    ...     return np.where(np.hypot(u, v) < 0.5, 1j, -1j)
    ...
    >>> ring = zwfs.Patch(2.0, two_steps, breaks=[1.0])
    >>> zwfs.ZernikeSensor(zwfs.Pupil.circular(32), ring).n_masks
    1

    An ellipse of 1.6 x 1.0 lambda/D:

    >>> def inside(u, v):
    ...     return np.where(np.hypot(u / 1.6, v) < 0.5, 1j, 1)
    ...
    >>> def outline(angle):
    ...     return 1 / np.hypot(np.cos(angle) / 1.6, np.sin(angle))
    ...
    >>> zwfs.ZernikeSensor(zwfs.Pupil.circular(32), zwfs.Patch(1.6, inside, breaks=[outline])).n_masks
    1
    """

    diameter: float
    function: Callable[[NDArray, NDArray], NDArray]
    breaks: Sequence[float | Outline] = ()
    n_samples: int = 0

    def __post_init__(self) -> None:
        diameter = _check.number("diameter", self.diameter, 0, open_low=True)
        if not callable(self.function):
            raise TypeError(f"function = {_check.shown(self.function)}: expected a callable of (u, v)")
        breaks = _check.breaks("breaks", self.breaks, diameter)
        n_samples = _check.integer("n_samples", self.n_samples, 0, _MOST_SAMPLES)
        for name, value in {"diameter": diameter, "breaks": breaks, "n_samples": n_samples}.items():
            object.__setattr__(self, name, value)

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """Complex transmission at (u, v), checked."""
        u, v = _coordinates(u, v)
        # Copies: a function that works in place must not move the nodes of a sensor.
        values = _check.complex_array("transmission", self.function(u.copy(), v.copy()))
        try:
            values = np.broadcast_to(values, u.shape).astype(np.complex128)
        except ValueError:
            raise ValueError(f"transmission has shape {values.shape}: expected {u.shape}, as u and v") from None
        _check.finite("transmission", values)
        largest = np.abs(values).max(initial=0.0)
        if largest > 1 + 1e-12:
            raise ValueError(f"transmission reaches a modulus of {largest:.6g}: expected at most 1")
        return values


def focal_field(pupil: Pupil, field: ArrayLike, u: ArrayLike, v: ArrayLike) -> NDArray[np.complexfloating]:
    """Field in the focal plane: the Fourier sum over the pupil.

    Parameters
    ----------
    pupil : Pupil
    field : array_like of complex, shape (..., ny, nx)
        Field in the pupil plane; the stop blocks what lies outside the pupil.
    u, v : array_like, shapes (nu,) and (nv,), lambda/D
        Horizontal and vertical coordinates of the grid, at most half the number of pixels across D: the sum
        repeats beyond.

    Returns
    -------
    ndarray of complex, shape (..., nv, nu)
        In units of the field of a flat wavefront on the axis times the mean amplitude: 1 at (0, 0) for a uniform
        pupil and a flat wavefront.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> u = np.array([0.0, 1.22])
    >>> np.abs(zwfs.masks.focal_field(pupil, pupil.amplitude, u, [0.0])).round(2)
    array([[1., 0.]])
    """
    _check.instance("pupil", pupil, Pupil)
    field = _check.complex_array("field", field)
    _check.trailing_shape("field", field, pupil.shape, "the shape of the pupil")
    _check.moderate("field", field)
    u, v = (_check.real_array(name, axis) for name, axis in (("u", u), ("v", v)))
    for name, axis in (("u", u), ("v", v)):
        if axis.ndim != 1:
            raise ValueError(f"{name} has shape {axis.shape}: expected one dimension")
        _check.finite(name, axis)
        largest = np.abs(axis).max(initial=0.0)
        if largest > pupil.n_pixels / 2:
            raise ValueError(
                f"{name} reaches {largest:g} lambda/D: expected at most {pupil.n_pixels / 2:g}, half the number "
                "of pixels across D"
            )
    from_x = np.exp(-2j * np.pi * np.outer(pupil.x, u))
    from_y = np.exp(-2j * np.pi * np.outer(v, pupil.y))
    return from_y @ (field * pupil.inside) @ from_x / pupil.n_points


def _coordinates(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """Checked coordinates, of the shape that they have in common."""
    u, v = _check.real_array("u", u), _check.real_array("v", v)
    _check.finite("u", u)
    _check.finite("v", v)
    shape = _check.broadcast(u=u, v=v)
    return np.broadcast_to(u, shape), np.broadcast_to(v, shape)
