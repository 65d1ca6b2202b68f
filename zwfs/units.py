"""Phase in radian, and the optical path difference (OPD) in nm.

Positive is the same everywhere: a longer optical path. See `phase_to_opd`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check

_LARGEST = 1e20  # phase or path difference: the result is a number in single precision, too


def phase_to_opd(phase: ArrayLike, wavelength: float) -> NDArray[np.float64]:
    """Optical path difference of a phase: phase times wavelength over 2 pi.

    A positive phase is a longer optical path: the light arrives later. A mirror surface that is pushed by h
    towards the incoming light shortens the path, so that its OPD is -2 h. The phase shift of a dimple has the same
    sense: a dot of glass of thickness h and index n above its surroundings has +2 pi (n - 1) h / wavelength.

    Parameters
    ----------
    phase : array_like, any shape, radian
        NaN stays NaN.
    wavelength : float, nm

    Returns
    -------
    ndarray, the shape of `phase`, nm

    Examples
    --------
    >>> import zwfs
    >>> float(zwfs.phase_to_opd(3.14159265, 635.0).round(3))
    317.5
    """
    return _bounded("phase", phase) * (_check.wavelength(wavelength) / (2 * np.pi))


def opd_to_phase(opd: ArrayLike, wavelength: float) -> NDArray[np.float64]:
    """Phase of an optical path difference, the inverse of `phase_to_opd`.

    Parameters
    ----------
    opd : array_like, any shape, nm
        Of the wavefront: twice the displacement of a mirror's surface. NaN stays NaN.
    wavelength : float, nm

    Returns
    -------
    ndarray, the shape of `opd`, radian

    Examples
    --------
    >>> import zwfs
    >>> float(zwfs.opd_to_phase(317.5, 635.0).round(6))
    3.141593
    """
    return _bounded("opd", opd) * (2 * np.pi / _check.wavelength(wavelength))


def _bounded(name: str, values: ArrayLike) -> NDArray:
    """Return real numbers, or NaN, that are small enough to be converted."""
    array = _check.real_array(name, values)
    largest = np.fmax.reduce(np.abs(array), axis=None, initial=0.0)
    if largest > _LARGEST:
        raise ValueError(f"{name} reaches {largest:.3g}: expected at most {_LARGEST:g}")
    return array
