"""Iterative phase-shifted reconstruction, section 3.1 of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, for_each, per_kind
from zwfs._lowrank import split_core
from zwfs._propagator import Propagator, count, square, turn, with_piston_of
from zwfs.reconstructors._acceleration import Acceleration, Path, dimming
from zwfs.reconstructors.base import Estimate, FixedPoint, Solution
from zwfs.sensor import ZernikeSensor

_PARALLEL = 1e-6  # sine of the angle between two reference waves below which they count as parallel
_DARK = 1e-9  # amplitude of a reference wave, in units of the mean of the pupil, below which it counts as absent
_SMALL_TILT = 1e-3  # radian per D, for measuring the speed of convergence


class PhaseShifted(FixedPoint):
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
        method. The paper does neither. Frames that do not converge, such as frames of a wrong unit, are iterated
        without acceleration, too; the result is the phase that explains them better. With a tolerance of 0 they
        are not. Where the frames contradict each other, the two iterations may converge to different phases: with
        one image 20 % too bright, a dimple of 1.06 lambda/D and up to 1.2 rad rms, the accelerated phase was more
        than 10 % worse in 3 of 3600 simulated cases, and more than 10 % better in 22, all above 0.9 rad rms.

    Raises
    ------
    ValueError
        If for a flat wavefront the determinant of equation (10) vanishes everywhere: masks that are the same to a
        phase shift of 0 mod 2 pi, or the pair (0, pi).

    References
    ----------
    Chambouleyron et al. 2024, section 3.1, equations (9) and (10); `eq-linear-system`, `eq-many-masks` and
    `eq-shared-wave` of the book, `eq-dimming` and `eq-secant` for the acceleration.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    >>> truth = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 20), 0.05, 1, seed=1)[0]
    >>> estimate = zwfs.PhaseShifted(sensor)(sensor.measure(truth))
    >>> float(zwfs.reconstruction_error(pupil, estimate.phase, truth)) < 1e-5
    True
    >>> bool(estimate.converged)
    True
    """

    n_masks = 2, math.inf

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
        accelerate: bool = False,
    ) -> None:
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=amplitude)
        accelerate = _check.flag("accelerate", accelerate)
        self._pairs = tuple(combinations(range(sensor.n_masks), 2))
        self._refuse_equal_masks()
        self._shared = SharedWave.of(sensor.factors.core)
        self._plain: PhaseShifted | None = None
        self._acceleration: Acceleration | None = None
        if accelerate:
            self._plain = PhaseShifted(
                sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=self.settings.amplitude
            )
            self._acceleration = self._accelerated()

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Iterate; where the accelerated iteration did not converge, try the plain one, too."""
        solution = super().solve(frames, start, history)
        if self._plain is None or not self.settings.tolerance:
            return solution
        kind = Kind.of(frames)
        failed = [index for index in range(frames.shape[0]) if not solution.converged[index]]
        if failed:
            places = kind.integers(failed)
            frames = kind.xp.take(frames, places, axis=0)
            start = None if start is None else kind.xp.take(start, places, axis=0)
            plain = self._plain.solve(frames, start, history)
            light = frames[(..., *self.sensor.window)]
            accelerated = self.settings.residual(kind.xp.take(solution.phase, places, axis=0), light)
            better = self.settings.residual(plain.phase, light) < accelerated
            for index, place in enumerate(failed):
                if better[index]:
                    solution.put(place, plain.at(index))
        return solution

    def begin(self, frames: NDArray, phasor: NDArray | None, constants: _Constants) -> _State:
        """Return the part of the linear system that only depends on the frames, and the waves of a flat start."""
        model, acceleration = constants.model, constants.acceleration
        xp, light, k = model.kind.xp, frames[(..., *model.window)], frames.shape[0]
        if self._shared is None:
            measured = light - constants.offset
        else:
            mixed = constants.weights @ xp.reshape(light, (*light.shape[:2], -1))
            measured = xp.reshape(mixed, (k, *constants.offset.shape)) - constants.offset
        if phasor is not None:
            return _State(measured)
        if acceleration is None or not acceleration.lost > 0:
            return _State(measured, for_each(constants.flat_waves, k, xp), tried=for_each(constants.flat, k, xp))
        lost = constants.incoming - xp.reshape(light, (k, -1)) @ constants.inside
        lost = acceleration.missing(lost, xp)
        factor = dimming(lost, acceleration.lost, xp)
        waves = constants.flat_waves * factor[..., np.newaxis, np.newaxis, np.newaxis]
        return _State(measured, waves, tried=constants.flat * factor, lost=lost)

    def step(self, phasor: NDArray, state: _State, constants: _Constants) -> Estimate:
        """Compute the reference waves of the estimate, then solve the linear system of every point."""
        model = constants.model
        kind, operator = model.kind, model.operator
        waves, state.waves = state.waves, None  # those of a flat start are known
        if waves is None:
            coefficients = operator.split_project(model.field(phasor))
            if constants.acceleration is not None:
                coefficients = constants.acceleration.next(coefficients, state, kind.xp)
            elif self.settings.tolerance:
                if state.tried is not None:
                    coefficients = with_piston_of(state.tried, coefficients, kind.xp)
                state.tried = coefficients
            waves = operator.split_expand(coefficients @ constants.core, in_window=True)
        if self._shared is None:
            solved, singular = self._solve(waves, state.measured, kind)
        else:
            solved, singular = self._shared.solve(waves[:, 0, ...], state.measured, kind)
        if singular is None:
            return Estimate(solved)
        solved = kind.xp.where(singular[:, np.newaxis, ...], phasor, solved)
        return Estimate(solved, count(singular & model.inside, kind))

    @per_kind
    def constants(self, kind: Kind) -> _Constants:
        """Arrays of one kind that all frames share."""
        exact = self.settings.model(Kind.numpy())
        if self._shared is None:
            cores, weights, offset = self.sensor.factors.core, np.ones((1, 1)), exact.amplitude**2
        else:
            cores, weights = self._shared.core[np.newaxis], self._shared.weights
            offset = weights.sum(axis=1)[:, np.newaxis, np.newaxis] * exact.amplitude**2
        core = split_core(cores)
        flat = exact.operator.split_project(exact.field(exact.flat))
        flat_waves = exact.operator.split_expand(flat @ core, in_window=True)
        inside = np.tile(exact.stop.ravel(), self.sensor.n_masks)
        return _Constants(
            model=self.settings.model(kind),
            core=kind.array(core),
            weights=kind.array(weights),
            offset=kind.array(offset),
            flat=kind.array(flat),
            flat_waves=kind.array(flat_waves),
            inside=kind.array(inside),
            incoming=self.sensor.n_masks * self.settings.light,
            acceleration=self._acceleration and self._acceleration.to(kind),
        )

    def _accelerated(self) -> Acceleration:
        """Measure how much of a small tilt is missing after one plain step."""
        sensor, amplitude, exact = self.sensor, self.settings.amplitude, self.settings.model(Kind.numpy())
        x = sensor.pupil.gather(np.broadcast_to(sensor.pupil.x, sensor.pupil.shape))
        tilt = _SMALL_TILT * (x - x.mean())  # without the piston, which no frame shows
        frames = sensor.measure(sensor.pupil.scatter(tilt), amplitude)
        one_step = PhaseShifted(sensor, n_iterations=1, tolerance=0.0, amplitude=amplitude)
        estimate = sensor.pupil.gather(one_step(frames).phase)
        flat = exact.operator.split_project(exact.field(exact.flat))
        return Acceleration.of(sensor, flat, 1 - float(estimate @ tilt / (tilt @ tilt)))

    def _solve(self, waves: NDArray, excess: NDArray, kind: Kind) -> tuple[NDArray, NDArray | None]:
        """Return the field at every point, and where the determinant vanishes, if anywhere.

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
        # Weak waves would give a solution so small that it would count as 0.
        solved /= xp.where(singular, kind.array(1.0), strength)[:, np.newaxis, ...]
        return solved, singular if xp.any(singular) else None

    def _refuse_equal_masks(self) -> None:
        sensor, exact = self.sensor, self.settings.model(Kind.numpy())
        waves = exact.reference(exact.field(exact.flat))
        _, singular = self._solve(waves, np.zeros((1, sensor.n_masks, *sensor.pupil.shape)), exact.kind)
        if singular is not None and singular[0][sensor.pupil.inside].all():
            raise ValueError(
                "sensor: the determinant sin(phi_ref_b - phi_ref_a) of equation (10) is 0 at every point for "
                "its masks: expected phase shifts that differ by other than 0 mod 2 pi, none of them 0, and "
                "dimples that are large enough to make a reference wave"
            )


@dataclass
class _State(Path):
    measured: NDArray[np.floating]  # (k, 2, ny, nx), signal; (k, n_masks, ny, nx), I - A^2, without shared wave
    waves: NDArray[np.floating] | None = None  # (k, n, 2, ny, nx), reference waves of the first step


class _Constants(NamedTuple):
    model: Propagator
    core: NDArray[np.floating]  # coefficients of the field (k, 2 r) to those of the waves
    weights: NDArray[np.floating]  # (2, n_masks), of the intensities in the signal
    offset: NDArray[np.floating]  # (2, ny, nx), the signal of the incoming light; (ny, nx) without shared wave
    flat: NDArray[np.floating]  # (1, 2 r), coefficients of a flat wavefront
    flat_waves: NDArray[np.floating]  # (1, n, 2, ny, nx), its reference waves
    inside: NDArray[np.floating]  # (n_masks * ny * nx,), 1 inside the pupil
    incoming: float  # light in the pupil, all masks together
    acceleration: Acceleration | None


@dataclass(frozen=True, eq=False)
class SharedWave:
    """Wave B of which the reference waves of all dimples of one size are multiples.

    The linear system of every point then is the same, and its solution is psi conj(B) = |B|^2 + signal, with a
    signal that the frames give once and for all (`eq-shared-wave`).
    """

    core: NDArray[np.complex128]  # (q, r), from coefficients of the field to those of B
    weights: NDArray[np.float64]  # (2, n_masks), of the intensities in both parts of the signal
    darkest: float  # |B|^2 at and below which the system counts as singular

    @classmethod
    def of(cls, cores: NDArray[np.complex128]) -> SharedWave | None:
        """Return the wave that masks of these cores share, (n_masks, q, r); None if they share none.

        Let R be the strongest reference wave, and r_k = t_k R that of mask k. With u = psi conj(R) its equation
        2 Re(conj(r_k) psi) = I_k - A^2 - |r_k|^2 becomes 2 Re(conj(t_k) u) = I_k - A^2 - |t_k|^2 |R|^2. This is
        linear in the real and imaginary part of u, with the same matrix M = 2 (Re t, Im t) at every point. With
        its pseudo-inverse as a complex row, p = (1, i) pinv(M), the least-squares solution is
        u = sum_k p_k (I_k - A^2) - c |R|^2, where c = sum_k p_k |t_k|^2. Multiplied by -conj(c), with B = -c R, it
        is psi conj(B) = |B|^2 + sum_k w_k (I_k - A^2), where w_k = -conj(c) p_k.
        """
        base = cores[np.argmax(np.linalg.norm(cores, axis=(-2, -1)))]
        t = np.sum(base.conj() * cores, axis=(-2, -1)) / np.linalg.norm(base) ** 2
        rest = cores - t[:, np.newaxis, np.newaxis] * base
        if np.linalg.norm(rest) > 1e-12 * np.linalg.norm(base):
            return None
        p = np.array([1, 1j]) @ np.linalg.pinv(2 * np.stack([t.real, t.imag], axis=1))
        c = p @ np.abs(t) ** 2
        if abs(c) < _PARALLEL:
            return None
        w = -c.conj() * p
        in_units_of_b = -t / c  # r_k / B, so a determinant of two masks is |B|^2 times that of these factors
        determinants = [(a.conj() * b).imag for a, b in combinations(in_units_of_b, 2)]
        return cls(-c * base, np.stack([w.real, w.imag]), _DARK / float(np.linalg.norm(determinants)))

    def solve(self, wave: NDArray, signal: NDArray, kind: Kind) -> tuple[NDArray, NDArray | None]:
        """Return a multiple of the field at every point, (k, 2, ny, nx), and where the system is singular."""
        power = square(wave)
        solved = turn(wave, power + signal[:, 0, ...], signal[:, 1, ...])
        return solved, None if kind.xp.min(power) > self.darkest else power <= self.darkest
