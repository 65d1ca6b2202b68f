"""Relay optics of the simulated bench: from the plane of the pupil to the camera, on a plane without an end."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import read_only
from zwfs._lowrank import _bandwidth, gauss_legendre

__all__: list[str] = []  # a part of the package, not for its users

_ROUNDING = 1e-13


@dataclass(frozen=True)
class Relay:
    """Path of the light of one image: free space and a shift.

    Relay and dimple multiply the same spectrum. The light of the dimple behind the relay is therefore the
    reference wave of a mask, which this class is: its transmission less 1 is that of the relay.

    Parameters
    ----------
    diameter : float, lambda/D
        Of the dimple.
    distance : float, D^2 / lambda
        From the pupil to the plane in focus.
    shift : float, D
        Of the image, along both axes.
    """

    diameter: float
    distance: float
    shift: float
    breaks = ()
    n_samples = 0

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        """1 + the transfer function of the relay at focal coordinates, lambda/D."""
        return 1 + _transfer(u, self.distance, self.shift) * _transfer(v, self.distance, self.shift)

    def direct(self, field: NDArray, n_camera: int, n_pixels: int) -> NDArray[np.complex128]:
        """Field of n_camera x n_camera pixels of a field on the pupil, whose middle is the same.

        Parameters
        ----------
        field : ndarray, shape (n, n)
            Samples; the field between them is a sum of sinc functions, and 0 at all pixels beyond.
        n_camera : int, pixels
            As even or odd as n.
        n_pixels : int, pixels
            Diameter D.

        Returns
        -------
        ndarray, shape (n_camera, n_camera)
        """
        kernel = _kernel(n_camera, len(field), n_pixels, self.distance, self.shift)
        return kernel @ field @ kernel.T


def _transfer(u: NDArray, distance: float, shift: float) -> NDArray[np.complex128]:
    """Transfer function along one axis."""
    return np.exp(-1j * np.pi * (distance * u**2 + 2 * shift * u))


@lru_cache(maxsize=16)  # each image of a bench needs its kernels again
def _kernel(n_camera: int, n_source: int, n_pixels: int, distance: float, shift: float) -> NDArray[np.complex128]:
    """Matrix from samples on an axis to samples on a longer one: the integral over all frequencies of the grid."""
    farthest = (n_camera + n_source) / 2 + (abs(distance) * n_pixels + abs(shift)) * n_pixels
    unit, weights = gauss_legendre(_bandwidth(np.pi * farthest, _ROUNDING) // 2 + 8)
    steps = np.arange(1 - n_source, n_camera) - (n_camera - n_source) // 2
    waves = np.exp(1j * np.pi * np.outer(steps, unit))
    line = waves @ (weights / 2 * _transfer(unit * n_pixels / 2, distance, shift))
    return read_only(line[np.subtract.outer(np.arange(n_camera), np.arange(n_source)) + n_source - 1])
