"""The phase-shifted iteration, linearised: how a step changes a small error, and what the frames show of it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

DARK_RING = 2 * 1.2196698912665045
"""Diameter of the first dark ring of the Airy pattern, lambda/D: twice the first zero of J1(pi r)."""
_TOLERANCE = 1e-12  # of the low-rank factors, as the spectrum is to be exact where the iteration is


class DimpleLight:
    """The part of a field that passes through a dimple (lambda/D), beta, at the points of the pupil.

    It is beta = expand(project(field) @ core): a few coefficients lie between the two planes.
    """

    def __init__(self, pupil: Pupil, diameter: float) -> None:
        # For a phase shift of pi the reference wave is -2 beta.
        factors = ZernikeSensor(pupil, Dimple(diameter, np.pi), tolerance=_TOLERANCE).factors
        self.core = factors.core[0].T.real / -2
        self._pupil, self._factors = pupil, factors

    def __call__(self, field: NDArray) -> NDArray[np.complex128]:
        """Beta of complex fields at the points of the pupil, (k, n_points) to (k, n_points)."""
        return self.expand(self.project(field) @ self.core)

    def project(self, field: NDArray) -> NDArray[np.complex128]:
        """Coefficients of fields, (k, n_points) to (k, rank)."""
        return self._factors.pupil.project(self._pupil.scatter(np.asarray(field, complex), fill=0))

    def expand(self, coefficients: NDArray) -> NDArray:
        """Fields of coefficients behind the dimple, (k, rank) to (k, n_points)."""
        return self._pupil.gather(self._factors.detector.expand(coefficients))


def iteration_spectrum(pupil: Pupil, diameter: float, phase: NDArray | None = None) -> NDArray[np.complex128]:
    """Eigenvalues of the linearised phase-shifted step, piston left out."""
    light, psi, beta = _linearised(pupil, diameter, phase)
    # A step maps an error to the few coefficients of the change of beta, and these to the next error. Its
    # eigenvalues other than 0 are those of the two maps in the opposite order: a small matrix.
    unit = light.expand(light.core)
    # The map is linear over the real numbers only: real and imaginary parts of the coefficients count separately.
    errors = _error_after(psi, beta, np.concatenate([unit, 1j * unit]))
    coefficients = light.project(1j * psi * errors)
    values = np.linalg.eigvals(np.concatenate([coefficients.real, coefficients.imag], axis=1))
    # A piston returns unchanged: its eigenvalue is exactly 1, and no frame shows a piston.
    values = np.delete(values, np.argmin(np.abs(values - 1)))
    return values[np.argsort(-np.abs(values), kind="stable")]


def mode_sensitivity(
    pupil: Pupil,
    diameter: float,
    modes: NDArray,
    phase_shifts: tuple[float, ...] = (np.pi / 2, -np.pi / 2),
    phase: NDArray | None = None,
) -> NDArray[np.float64]:
    """Sensitivity of the frames to each mode, the change of the reference wave included."""
    light, psi, beta = _linearised(pupil, diameter, phase)
    direct = 1j * psi * pupil.gather(modes)
    through = light(direct)
    power = np.zeros(len(direct))
    for theta in phase_shifts:
        strength = np.exp(1j * theta) - 1
        out = psi + strength * beta
        power += np.mean((2 * np.real(out.conj() * (direct + strength * through))) ** 2, axis=-1)
    return np.sqrt(power)


_light = lru_cache(maxsize=64)(DimpleLight)  # one for all wavefronts


def _linearised(pupil: Pupil, diameter: float, phase: NDArray | None) -> tuple[DimpleLight, NDArray, NDArray]:
    """Light in the dimple, and the field and its beta at the points of the pupil, (n_points,) each."""
    psi = pupil.gather(pupil.field(np.zeros(pupil.shape) if phase is None else phase))
    light = _light(pupil, float(diameter))
    return light, psi, light(psi[np.newaxis])[0]


def _error_after(psi: NDArray, beta: NDArray, change: NDArray) -> NDArray[np.float64]:
    """Error of the phase after a step that uses beta + change in place of beta."""
    relative = change / beta
    return relative.imag - 2 * relative.real * np.imag(beta.conj() * psi) / np.abs(psi) ** 2
