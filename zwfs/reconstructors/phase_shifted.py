"""Iterative phase-shifted reconstruction, section 3.1 of the paper."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind
from zwfs.lowrank import Operator, split_core
from zwfs.reconstructors._acceleration import Acceleration, dimming
from zwfs.reconstructors.base import (
    Estimate,
    Reconstruction,
    Reconstructor,
    check_frames,
    count,
    for_each,
    iterate,
    settings,
    start_phase,
    steady,
    turn,
)
from zwfs.sensor import PupilMaps, ZernikeSensor, square

_PARALLEL = 1e-6  # sine of the angle between two reference waves below which they count as parallel
_DARK = 1e-9  # amplitude of a reference wave, in units of the mean of the pupil, below which it counts as absent
_SMALL_TILT = 1e-3  # radian per D, by which the speed of convergence is found


class PhaseShifted(Reconstructor):
    """Phase from two or more masks of different phase shifts.

    With the reference waves r_m of the estimate before, every point has one linear equation per mask for the real
    and imaginary part of its field; solving them gives the next estimate. No branch has to be chosen: the phase
    comes back over the whole circle. More than two masks are combined by least squares.

    The frames do not depend on the piston of the wavefront. Before each iteration the estimate is turned by the
    piston that brings its reference waves nearest to those before. The phase therefore converges on noisy frames,
    too, with a piston near that of the start.

    In real time, take frames in float32, `tolerance=0` and `accelerate=True` with 2 or 3 iterations; or, in a
    control loop, one iteration that starts from the phase of the frames before. On a GPU, hand in many frames at
    once, as an array of PyTorch or CuPy: the phase comes back as one.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks or more.
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one. With 0 all
        are done; without acceleration, noise may then add some piston in each of them.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.
    accelerate : bool
        Same fixed point in fewer iterations: without a start, the first two reference waves are dimmed to the
        light that the frames miss, and from then on the coefficients of the waves are extrapolated by the secant
        method. The paper does neither. Frames that have not converged at the end, as frames of a wrong unit may,
        are iterated without acceleration, too; the result is the phase that explains them better. With a tolerance
        of 0 they are not.

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
        super().__init__(settings(sensor, n_iterations, tolerance, amplitude))
        if sensor.n_masks < 2:
            raise ValueError(f"sensor has {sensor.n_masks} mask: expected two or more with different phase shifts")
        self._pairs = tuple(combinations(range(sensor.n_masks), 2))
        accelerate = _check.flag("accelerate", accelerate)
        self._refuse_equal_masks()
        self._shared = _SharedWave.of(sensor.factors.core)
        self._acceleration = self._accelerated() if accelerate else None
        self._constants: dict[Kind, _Constants] = {}

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

        Warns
        -----
        UserWarning
            If a frame is more than 10 times as bright, inside the pupil, as with the mask out: raw counts?
        """
        result = iterate(self, frames, start, history)
        if self._acceleration is None or not self.settings.tolerance:
            return result
        return result if Kind.of(result.phase).xp.all(result.converged) else self._secured(result, frames, start)

    def _secured(self, result: Reconstruction, frames: ArrayLike, start: ArrayLike | None) -> Reconstruction:
        """Replace the phases that did not converge where the plain iteration explains the frames better."""
        checked, batch = check_frames(self.sensor, frames)
        kind = Kind.of(checked)
        xp, n_frames = kind.xp, checked.shape[0]
        converged = xp.reshape(result.converged, (n_frames,))
        lost = [index for index in range(n_frames) if not converged[index]]
        which = kind.integers(lost)
        first = None if start is None else xp.take(start_phase(self.sensor, start, batch, kind), which, axis=0)
        plain = copy(self)
        plain._acceleration, plain._constants = None, {}
        other = iterate(plain, xp.take(checked, which, axis=0), first, result.history is not None)
        better = other.residual < xp.take(xp.reshape(result.residual, (n_frames,)), which, axis=0)
        parts = {}
        for name in ("phase", "n_iterations", "converged", "n_unsolved", "history"):
            values, news = getattr(result, name), getattr(other, name)
            if values is None:
                continue
            flat = xp.reshape(values, (n_frames, *values.shape[len(batch) :]))
            for place, index in enumerate(lost):
                if better[place]:
                    flat[index, ...] = news[place, ...]
            parts[name] = xp.reshape(flat, values.shape)
        return replace(result, **parts)

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool, kind: Kind) -> dict[str, NDArray]:
        """What the frames give to the linear system, and the reference waves of a flat start."""
        xp, constants = kind.xp, self._of(kind)
        acceleration = constants.acceleration
        light, n_frames = frames[(..., *self.sensor.window)], frames.shape[0]
        if self._shared is None:
            data = {"excess": light - constants.offset}
        else:
            mixed = constants.weights @ xp.reshape(light, (*light.shape[:2], -1))
            data = {"signal": xp.reshape(mixed, (n_frames, *constants.offset.shape)) - constants.offset}
        if not flat:
            return data
        if acceleration is None or not acceleration.lost > 0:
            start = {"waves": constants.flat_waves, "tried": constants.flat}
            return data | {name: for_each(array, n_frames, xp) for name, array in start.items()}
        lost = constants.incoming - xp.reshape(light, (n_frames, -1)) @ constants.inside
        lost = acceleration.missing(lost, xp)
        factor = dimming(lost, acceleration.lost, xp)
        waves = constants.flat_waves * factor[..., np.newaxis, np.newaxis, np.newaxis]
        return data | {"waves": waves, "tried": constants.flat * factor, "lost": lost}

    def step(self, phasor: NDArray, data: dict[str, NDArray], kind: Kind) -> Estimate:
        """Reference waves of the estimate, then the linear system of every point."""
        constants = self._of(kind)
        waves = data.pop("waves", None)
        if waves is None:
            operator = constants.operator
            coefficients = operator.split_project(constants.maps.field(phasor))
            if constants.acceleration is not None:
                coefficients = constants.acceleration.extrapolate(coefficients, data, kind.xp)
            elif self.settings.tolerance:
                coefficients = steady(coefficients, data, kind.xp)
            waves = operator.split_expand(coefficients @ constants.core, in_window=True)
        if self._shared is None:
            solved, singular = self._solve(waves, data["excess"], kind)
        else:
            solved, singular = self._shared.solve(waves[:, 0, ...], data["signal"], kind)
        if singular is None:
            return Estimate(solved)
        solved = kind.xp.where(singular[:, np.newaxis, ...], phasor, solved)
        return Estimate(solved, count(singular & constants.maps.mask, kind))

    def _of(self, kind: Kind) -> _Constants:
        """Constants for arrays of one kind; made once, then kept."""
        if kind not in self._constants:
            sensor, incoming, exact = self.sensor, self.settings.amplitude**2, Kind.numpy()
            cores, weights, offset = sensor.factors.core, np.ones((1, 1)), incoming
            if self._shared is not None:
                cores, weights = self._shared.core[np.newaxis], self._shared.weights
                offset = weights.sum(axis=1)[:, np.newaxis, np.newaxis] * offset
            operator, core = sensor.operator(exact), split_core(cores)
            flat = operator.split_project(self._flat())
            flat_waves = operator.split_expand(flat @ core, in_window=True)
            inside = np.tile(self.settings.maps(exact).inside.ravel(), sensor.n_masks)
            self._constants[kind] = _Constants(
                sensor.operator(kind),
                self.settings.maps(kind),
                kind.array(core),
                kind.array(weights),
                kind.array(offset),
                kind.array(flat),
                kind.array(flat_waves),
                kind.array(inside),
                sensor.n_masks * self.settings.light,
                self._acceleration and self._acceleration.to(kind),
            )
        return self._constants[kind]

    def _flat(self) -> NDArray[np.float64]:
        """Split field of a flat wavefront, (1, 2, ny, nx)."""
        maps = self.settings.maps(Kind.numpy())
        return maps.field(maps.flat)

    def _accelerated(self) -> Acceleration:
        sensor, amplitude = self.sensor, self.settings.amplitude
        x = sensor.pupil.gather(np.broadcast_to(sensor.pupil.x, sensor.pupil.shape))
        tilt = _SMALL_TILT * (x - x.mean())  # without the piston, which no frame shows
        frames = sensor.measure(sensor.pupil.scatter(tilt), amplitude)
        plain = PhaseShifted(sensor, n_iterations=1, tolerance=0.0, amplitude=amplitude)
        found = sensor.pupil.gather(plain(frames).phase)
        flat = sensor.operator(Kind.numpy()).split_project(self._flat())
        return Acceleration.of(sensor, flat, 1 - float(found @ tilt / (tilt @ tilt)))

    def _solve(self, waves: NDArray, excess: NDArray, kind: Kind) -> tuple[NDArray, NDArray | None]:
        """The field at every point, and where the determinant vanishes, if anywhere.

        The equations are 2 Re(conj(r) psi) = I - A^2 - |r|^2. Each pair of masks gives Cramer's numerators and
        its determinant; weighting the pairs with their determinants makes the sum the least-squares solution.
        """
        xp, real, imag = kind.xp, waves[:, :, 0, ...], waves[:, :, 1, ...]
        power = real * real + imag * imag
        right = excess - power
        solved = kind.zeros(excess.shape[0], 2, *excess.shape[-2:])
        strength = xp.zeros_like(solved[:, 0, ...])
        scale = xp.zeros_like(strength)
        for a, b in self._pairs:
            real_a, imag_a, right_a, real_b, imag_b, right_b = (
                array[:, mask, ...] for mask in (a, b) for array in (real, imag, right)
            )
            determinant = real_a * imag_b - imag_a * real_b
            solved[:, 0, ...] += determinant * (right_a * imag_b - right_b * imag_a)
            solved[:, 1, ...] += determinant * (right_b * real_a - right_a * real_b)
            strength += determinant * determinant
            scale += power[:, a, ...] * power[:, b, ...]
        singular = (strength <= _DARK**2) | (strength <= _PARALLEL**2 * scale)
        # Weak waves would make a solution too small to be told from none.
        solved /= xp.where(singular, kind.array(1.0), strength)[:, np.newaxis, ...]
        return solved, singular if xp.any(singular) else None

    def _refuse_equal_masks(self) -> None:
        sensor, kind = self.sensor, Kind.numpy()
        waves = sensor.operator(kind).split_reference(self._flat(), in_window=True)
        _, singular = self._solve(waves, np.zeros((1, sensor.n_masks, *sensor.pupil.shape)), kind)
        if singular is not None and singular[0][sensor.pupil.inside].all():
            raise ValueError(
                "sensor: the determinant sin(phi_ref_b - phi_ref_a) of equation (10) is 0 at every point for "
                "its masks: expected phase shifts that differ by other than 0 mod 2 pi, none of them 0, and "
                "dimples that are large enough to make a reference wave"
            )


class _Constants(NamedTuple):
    """What all frames share, as arrays of one kind."""

    operator: Operator
    maps: PupilMaps
    core: NDArray[np.floating]  # coefficients of the field (k, 2 r) to those of the waves
    weights: NDArray[np.floating]  # (2, n_masks), of the intensities in the signal
    offset: NDArray[np.floating]  # (2, ny, nx), the signal of the incoming light; (ny, nx) without shared wave
    flat: NDArray[np.floating]  # (1, 2 r), coefficients of a flat wavefront
    flat_waves: NDArray[np.floating]  # (1, n, 2, ny, nx), its reference waves
    inside: NDArray[np.floating]  # (n_masks * ny * nx,), 1 inside the pupil
    incoming: float  # light in the pupil, all masks together
    acceleration: Acceleration | None


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
        return cls(
            -bend * base, np.stack([weights.real, weights.imag]), _DARK / float(np.linalg.norm(determinants))
        )

    def solve(self, wave: NDArray, signal: NDArray, kind: Kind) -> tuple[NDArray, NDArray | None]:
        """A multiple of the field at every point, (k, 2, ny, nx), and where the system is singular, if it is."""
        power = square(wave)
        solved = turn(wave, power + signal[:, 0, ...], signal[:, 1, ...])
        return solved, None if kind.xp.min(power) > self.darkest else power <= self.darkest
