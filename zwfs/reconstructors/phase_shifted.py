"""Iterative phase-shifted reconstruction, section 3.1 of the paper."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs.reconstructors._common import Reconstruction, iterate, settings, unit
from zwfs.sensor import ZernikeSensor, split

_PARALLEL = 1e-6  # sine of the angle between two reference waves below which they count as parallel
_DARK = 1e-9  # amplitude of a reference wave, in units of the mean of the pupil, below which it counts as absent


class PhaseShifted:
    """Phase from two or more masks of different phase shifts.

    With the reference waves r_m of the estimate before, every point has one linear equation per mask for the real
    and imaginary part of its field; solving them gives the next estimate. No branch has to be chosen: the phase
    comes back over the whole circle. More than two masks are combined by least squares.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks or more.
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.

    Raises
    ------
    ValueError
        If the sensor has fewer than two masks, or if for a flat wavefront the determinant of equation (10)
        vanishes everywhere: masks that are the same to a phase shift of 0 mod 2 pi, or the pair (0, pi).

    References
    ----------
    Chambouleyron et al. 2024, section 3.1, equations (9) and (10); `eq-linear-system` and `eq-many-masks` of the
    book.
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
    ) -> None:
        self.settings = settings(sensor, n_iterations, tolerance, amplitude)
        if sensor.n_masks < 2:
            raise ValueError(f"sensor has {sensor.n_masks} mask: expected two or more with different phase shifts")
        self._pairs = tuple(combinations(range(sensor.n_masks), 2))
        self._refuse_equal_masks()

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame set.

        Parameters
        ----------
        frames : array_like, shape (..., n_masks, ny', nx')
            Intensity, 1 = mean of the pupil with the mask out.
        start : array_like, shape (ny, nx) or (..., ny, nx), radian, optional
            Starting phase; flat if left out.
        history : bool
            Keep the phase after each iteration.

        Returns
        -------
        Reconstruction

        Raises
        ------
        TypeError, ValueError
            If frames or start are of the wrong shape, complex, not finite, negative or dark.
        """
        return iterate(self, frames, start, history)

    def prepare(self, frames: NDArray, amplitude: NDArray, start: NDArray) -> dict[str, NDArray]:
        """Intensity less that of the incoming light, at the points of the pupil."""
        return {"excess": frames[(..., *self.settings.sensor.window)] - amplitude**2}

    def step(self, phasor: NDArray, amplitude: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Reference waves of the estimate, then the linear system of every point."""
        operator = self.settings.sensor.operator(phasor.dtype)
        waves = operator.split_reference(phasor * amplitude, in_window=True)
        solved, singular = self._solve(waves, data["excess"])
        if singular.any():
            solved = np.where(singular[:, np.newaxis], phasor, solved)
        n_singular = np.count_nonzero(singular & self.settings.sensor.pupil.mask, axis=(-2, -1))
        return unit(solved, phasor), n_singular

    def _solve(self, waves: NDArray, excess: NDArray) -> tuple[NDArray, NDArray]:
        """A multiple of the field at every point, and where the determinant vanishes.

        The equations are 2 Re(conj(r) psi) = I - A^2 - |r|^2. Each pair of masks gives Cramer's numerators and
        its determinant; weighting the pairs with their determinants makes the sum the least-squares solution.
        """
        real, imag = waves[:, :, 0], waves[:, :, 1]
        power = real**2
        power += imag**2
        right = excess - power
        solved = np.zeros((len(waves), 2, *waves.shape[-2:]), waves.dtype)
        strength = np.zeros((len(waves), *waves.shape[-2:]), waves.dtype)
        scale = np.zeros_like(strength)
        for a, b in self._pairs:
            determinant = real[:, a] * imag[:, b]
            determinant -= imag[:, a] * real[:, b]
            solved[:, 0] += determinant * (right[:, a] * imag[:, b] - right[:, b] * imag[:, a])
            solved[:, 1] += determinant * (right[:, b] * real[:, a] - right[:, a] * real[:, b])
            strength += determinant**2
            scale += power[:, a] * power[:, b]
        return solved, strength <= np.maximum(_PARALLEL**2 * scale, _DARK**2)

    def _refuse_equal_masks(self) -> None:
        config = self.settings
        flat = split(np.zeros((1, *config.sensor.pupil.shape)), config.amplitude)
        waves = config.sensor.operator(np.float64).split_reference(flat, in_window=True)
        _, singular = self._solve(waves, np.zeros((1, config.sensor.n_masks, *config.sensor.pupil.shape)))
        if singular[0][config.sensor.pupil.mask].all():
            raise ValueError(
                "sensor: the determinant sin(phi_ref_b - phi_ref_a) of equation (10) is 0 at every point for "
                "its masks: expected phase shifts that differ by other than 0 mod 2 pi, none of them 0"
            )
