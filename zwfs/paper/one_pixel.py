"""One pixel of a phase-shifted sensor: the phases that explain each of its intensities. Not in the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

CENTRE = 0.22  # distance of the bump and of the pit from the middle of the pupil, D


@dataclass(frozen=True)
class Pixel:
    """One pixel inside the pupil, and what each mask shows of it.

    Attributes
    ----------
    row, column : int
    phase : float, radian
    waves : ndarray of complex, shape (n_masks,)
        Reference waves, for a pixel of amplitude 1.
    """

    row: int
    column: int
    phase: float
    waves: NDArray[np.complex128]

    def intensities(self, phase: ArrayLike) -> NDArray[np.floating]:
        """Intensity behind each mask, equation (5), if the pixel had another phase.

        Parameters
        ----------
        phase : array_like, shape (...), radian
            The reference waves stay: a single pixel hardly changes them.

        Returns
        -------
        ndarray, shape (n_masks, ...)
        """
        field = np.exp(1j * _check.real_array("phase", phase))
        return np.abs(np.add.outer(self.waves, field)) ** 2

    @property
    def mirrored(self) -> NDArray[np.floating]:
        """Other phase in (-pi, pi] with the same intensity, for each mask; `eq-reflection` of the book."""
        return np.angle(np.exp(1j * (2 * np.angle(self.waves) - self.phase)))


def bump_and_pit(pupil: Pupil, height: float, width: float = 0.1) -> NDArray[np.floating]:
    """Return a phase with a Gaussian bump on the left and a pit of the same depth on the right.

    Parameters
    ----------
    pupil : Pupil
    height : float, radian
    width : float, D
        Standard deviation of both.

    Returns
    -------
    ndarray, shape (ny, nx), radian
        The mean over a pupil that is symmetric is 0.
    """
    _check.instance("pupil", pupil, Pupil)
    height, width = _check.number("height", height), _check.number("width", width, 0, open_low=True)
    across = np.exp(-((pupil.x + CENTRE) ** 2) / (2 * width**2)) - np.exp(
        -((pupil.x - CENTRE) ** 2) / (2 * width**2)
    )
    return height * np.outer(np.exp(-(pupil.y**2) / (2 * width**2)), across)


def lowest_pixel(sensor: ZernikeSensor, phase: NDArray) -> Pixel:
    """Return the pixel of the lowest phase inside the pupil.

    Parameters
    ----------
    sensor : ZernikeSensor
    phase : ndarray, shape (ny, nx), radian
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    pupil = sensor.pupil
    phase = _check.map_inside("phase", phase, pupil)
    waves = sensor.reference_wave(pupil.field(phase))[(..., *sensor.window)]
    inside = np.where(pupil.inside, phase, np.inf)
    row, column = map(int, np.unravel_index(np.argmin(inside), inside.shape))
    return Pixel(row, column, float(phase[row, column]), waves[:, row, column] / pupil.amplitude[row, column])
