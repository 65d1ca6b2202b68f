"""The focal plane, for pictures and for the design of masks; no sensor or reconstructor needs it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.pupil import Pupil


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

    Raises
    ------
    TypeError, ValueError
        If a shape is wrong, or a value is not finite or too large.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> u = np.array([0.0, 1.22])
    >>> np.abs(zwfs.focal.focal_field(pupil, pupil.amplitude, u, [0.0])).round(2)
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
