"""Iterative phase-shifted reconstruction, section 3.1 of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.lowrank import split_core
from zwfs.reconstructors._common import Reconstruction, count, iterate, settings, unit
from zwfs.sensor import ZernikeSensor, split

_PARALLEL = 1e-6  # sine of the angle between two reference waves below which they count as parallel
_DARK = 1e-9  # amplitude of a reference wave, in units of the mean of the pupil, below which it counts as absent
_RELAXATION = 1.3  # of a step: the factors of convergence lie between 0 and about 0.4
_DIMMEST = 0.01  # least intensity of the first reference wave, relative to that of a flat wavefront


class PhaseShifted:
    """Phase from two or more masks of different phase shifts.

    With the reference waves r_m of the estimate before, every point has one linear equation per mask for the real
    and imaginary part of its field; solving them gives the next estimate. No branch has to be chosen: the phase
    comes back over the whole circle. More than two masks are combined by least squares.

    In real time, take frames in float32, `tolerance=0` and `accelerate=True` with 3 or 4 iterations; or, in a
    control loop, one iteration that starts from the phase of the frames before.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks or more.
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one. With 0 all
        are done.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.
    accelerate : bool
        Same fixed point in fewer iterations: without a start, the first reference wave is dimmed to the light
        that the frames miss, and then the coefficients of the waves are extrapolated by the secant method. The
        paper does neither.

    Raises
    ------
    ValueError
        If the sensor has fewer than two masks, or if for a flat wavefront the determinant of equation (10)
        vanishes everywhere: masks that are the same to a phase shift of 0 mod 2 pi, or the pair (0, pi).

    References
    ----------
    Chambouleyron et al. 2024, section 3.1, equations (9) and (10); `eq-linear-system`, `eq-many-masks` and
    `eq-shared-wave` of the book, `eq-dimming` and `eq-secant` for the acceleration.
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
        accelerate: bool = False,
    ) -> None:
        self.settings = settings(sensor, n_iterations, tolerance, amplitude)
        if sensor.n_masks < 2:
            raise ValueError(f"sensor has {sensor.n_masks} mask: expected two or more with different phase shifts")
        self._pairs = tuple(combinations(range(sensor.n_masks), 2))
        self._accelerate = _check.flag("accelerate", accelerate)
        self._refuse_equal_masks()
        self._shared = _SharedWave.of(sensor.factors.core)
        flat = sensor.intensity(np.zeros((1, *sensor.pupil.shape)), self.settings.amplitude[np.newaxis])
        self._incoming = float(sensor.n_masks * np.sum(self.settings.amplitude**2))
        self._flat_loss = float(self._loss(flat)[0])
        self._constants: dict[np.dtype, _Constants] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_constants": {}}  # made again where they are needed

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

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool) -> dict[str, NDArray]:
        """What the frames give to the linear system, and the coefficients of a flat start."""
        constants = self._in_precision(frames.dtype)
        light = frames[(..., *self.settings.sensor.window)]
        if self._shared is None:
            data = {"excess": light - constants.offset}
        else:
            mixed = constants.weights @ light.reshape(*light.shape[:2], -1)
            data = {"signal": mixed.reshape(len(light), *constants.offset.shape) - constants.offset}
        if flat:
            dimming = self._dimming(frames)[:, np.newaxis] if self._accelerate else np.ones((len(frames), 1))
            data["first"] = constants.flat * dimming.astype(frames.dtype)
        return data

    def step(self, phasor: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Reference waves of the estimate, then the linear system of every point."""
        sensor = self.settings.sensor
        maps = self.settings.maps(phasor.dtype)
        operator = sensor.operator(phasor.dtype)
        coefficients = data.pop("first", None)
        if coefficients is None:
            coefficients = operator.split_project(maps.field(phasor))
        if self._accelerate:
            coefficients = _extrapolate(coefficients, data)
        waves = operator.split_expand(coefficients @ self._in_precision(phasor.dtype).core, in_window=True)
        if self._shared is None:
            solved, singular = self._solve(waves, data["excess"])
        else:
            solved, singular = self._shared.solve(waves[:, 0], data["signal"])
        n_singular = np.zeros(len(phasor), int)
        if singular.any():
            solved = np.where(singular[:, np.newaxis], phasor, solved)
            n_singular = count(singular & sensor.pupil.mask)
        return unit(solved, phasor, maps.inside), n_singular

    def _in_precision(self, dtype: np.dtype) -> _Constants:
        """Constants in float32 or float64; made once, then kept."""
        if dtype not in self._constants:
            sensor, incoming = self.settings.sensor, self.settings.amplitude
            psi = split(np.zeros((1, *incoming.shape)), incoming)
            cores, weights, offset = sensor.factors.core, np.ones((1, 1)), incoming**2
            if self._shared is not None:
                cores, weights = self._shared.core[np.newaxis], self._shared.weights
                offset = weights.sum(axis=1)[:, np.newaxis, np.newaxis] * offset
                # Outside the field is 0, and would have to be kept from being divided by its modulus.
                offset[0, ~sensor.pupil.mask] = -1
            values = split_core(cores), weights, offset, sensor.operator(np.float64).split_project(psi)
            self._constants[dtype] = _Constants(*(array.astype(dtype) for array in values))
        return self._constants[dtype]

    def _loss(self, frames: NDArray) -> NDArray:
        """Light that is missing from the frames inside the pupil, all masks together, shape (k,)."""
        light = frames[(..., *self.settings.sensor.window)].reshape(*frames.shape[:2], -1)
        return self._incoming - (light @ self.settings.maps(frames.dtype).inside.ravel()).sum(axis=1)

    def _dimming(self, frames: NDArray) -> NDArray:
        """Modulus of the reference waves relative to that of a flat wavefront (`eq-dimming`), shape (k,)."""
        if abs(self._flat_loss) <= _PARALLEL * self._incoming:
            return np.ones(len(frames))
        return np.sqrt(np.minimum(np.maximum(self._loss(frames) / self._flat_loss, _DIMMEST), 1))

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


class _Constants(NamedTuple):
    """What all frames share, in one precision."""

    core: NDArray[np.floating]  # coefficients of the field (k, 2 r) to those of the waves
    weights: NDArray[np.floating]  # (2, n_masks), of the intensities in the signal
    offset: NDArray[np.floating]  # (2, ny, nx), the signal of the incoming light; (ny, nx) without shared wave
    flat: NDArray[np.floating]  # (1, 2 r), coefficients of a flat wavefront


@dataclass(frozen=True, eq=False)
class _SharedWave:
    """What dimples of one size have in common: one wave B, of which all reference waves are multiples.

    The linear system of every point then is the same, and its solution is psi conj(B) = |B|^2 + signal, with a
    signal that the frames give once and for all (`eq-shared-wave`).

    Attributes
    ----------
    core : ndarray of complex, shape (q, r)
        Makes the coefficients of B out of those of the field.
    weights : ndarray, shape (2, n_masks)
        Of the intensities in the real and imaginary part of the signal.
    darkest : float
        |B|^2 at and below which the system counts as singular.
    """

    core: NDArray[np.complex128]
    weights: NDArray[np.float64]
    darkest: float

    @classmethod
    def of(cls, cores: NDArray[np.complex128]) -> _SharedWave | None:
        """The wave that masks of these cores share; None if they do not."""
        base = cores[np.argmax(np.linalg.norm(cores, axis=(-2, -1)))]
        factors = np.sum(base.conj() * cores, axis=(-2, -1)) / np.linalg.norm(base) ** 2
        rest = cores - factors[:, np.newaxis, np.newaxis] * base
        if np.linalg.norm(rest) > 1e-12 * np.linalg.norm(base):
            return None
        # Least squares for r_k = factor_k R: psi conj(R) = inverse @ (I - A^2) - bend |R|^2.
        inverse = np.array([1, 1j]) @ np.linalg.pinv(2 * np.stack([factors.real, factors.imag], axis=1))
        bend = inverse @ np.abs(factors) ** 2
        if abs(bend) < _PARALLEL:
            return None
        # With B = -bend R the factor of |B|^2 is 1.
        weights = -bend.conj() * inverse
        factors = -factors / bend
        determinants = [(a.conj() * b).imag for a, b in combinations(factors, 2)]
        return cls(-bend * base, np.stack([weights.real, weights.imag]), _DARK / np.linalg.norm(determinants))

    def solve(self, wave: NDArray, signal: NDArray) -> tuple[NDArray, NDArray]:
        """A multiple of the field at every point, (k, 2, ny, nx), and where the system is singular."""
        real, imag = wave[:, 0], wave[:, 1]
        along = real**2
        along += imag**2
        singular = along <= self.darkest
        along += signal[:, 0]
        across = signal[:, 1]
        solved = along[:, np.newaxis] * wave
        solved[:, 0] -= across * imag
        solved[:, 1] += across * real
        return solved, singular


def _extrapolate(found: NDArray, data: dict[str, NDArray]) -> NDArray:
    """Next coefficients (k, 2 r) by the secant through the last two steps (`eq-secant`), kept in `data`."""
    tried = data.get("tried")
    if tried is None:
        data["tried"] = found
        return found
    change = found - tried
    new = tried + _RELAXATION * change
    if "change" in data:
        turn = change - data["change"]
        size = np.vecdot(turn, turn)
        size[size == 0] = 1
        factor = np.vecdot(turn, change) / size
        new -= factor[:, np.newaxis] * (tried - data["before"] + _RELAXATION * turn)
    data.update(tried=new, before=tried, change=change)
    return new
