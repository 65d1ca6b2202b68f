"""The phase-shifted iteration in a control loop: one frame set after the other, each from the phase before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs._lowrank import Plane
from zwfs.reconstructors._acceleration import Acceleration, light_form
from zwfs.reconstructors.base import FixedPoint
from zwfs.reconstructors.phase_shifted import PhaseShifted, SharedWave

_TINY = 1e-30  # added to a modulus, which may vanish


class Tracking:
    """Steps of an accelerated `PhaseShifted` with a start and a tolerance of 0, in single precision.

    Only for masks that share a wave B: the field then is a multiple of (|B|^2 + signal) B, see `PhaseShifted`. A
    complex map takes half the time of two real ones, and all arrays are used again.
    """

    @classmethod
    def of(cls, method: FixedPoint) -> Tracking | None:
        """Tracking by an iteration; None if it is another one."""
        if isinstance(method, PhaseShifted) and method._shared and method._acceleration:
            return cls(method, method._shared, method._acceleration)
        return None

    def __init__(self, method: PhaseShifted, shared: SharedWave, acceleration: Acceleration) -> None:
        sensor, settings = method.sensor, method.settings
        amplitude = settings.amplitude
        self._n_iterations, self._relaxation = settings.n_iterations, acceleration.relaxation
        self._pupil = _Plane(sensor.factors.pupil)
        self._detector = _Plane(sensor.factors.detector.cut(*sensor.window))
        self._core, self._weights = shared.core.astype(np.complex64), shared.weights.astype(np.float32)
        self._offset = np.outer(shared.weights.sum(axis=1), amplitude**2).astype(np.float32)
        n_points = sensor.pupil.n_points
        self._light = float(np.sum(amplitude**2)) / n_points
        self._lost = (light_form(sensor) / (sensor.n_masks * n_points)).astype(np.complex64)
        self._amplitude, self._modulus = amplitude.astype(np.float32), np.empty(amplitude.shape, np.float32)
        self._psi, self._signal = np.zeros((2, *amplitude.shape), np.complex64)
        self._parts = np.empty(self._offset.shape, np.float32)
        self._start = self._pupil.project(self._psi)

    def start(self, phase: NDArray[np.float32]) -> float:
        """Start from a phase; return the mean light of its frames in the pupil."""
        for part, function in ((self._psi.real, np.cos), (self._psi.imag, np.sin)):
            np.multiply(function(phase, out=self._modulus), self._amplitude, out=part)
        self._start = self._pupil.project(self._psi)
        return self._light - float(np.vdot(self._start, self._lost @ self._start).real)

    def __call__(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Phase of frames, (n_masks, ny, nx), from the start."""
        parts = np.dot(self._weights, frames.reshape(len(frames), -1), out=self._parts)
        parts -= self._offset
        self._signal.real, self._signal.imag = parts.reshape((2, *self._signal.shape))
        coefficients, before = self._start, None
        for iteration in range(self._n_iterations):
            if iteration:
                self._normalise()
                coefficients, before = self._secant(coefficients, self._pupil.project(self._psi), before)
            self._solve(self._core @ coefficients)
        return np.arctan2(self._psi.imag, self._psi.real)

    def _solve(self, coefficients: NDArray[np.complex64]) -> None:
        """Replace the field by that of a wave, but for its modulus. Of a dark wave, noise decides the phase."""
        wave = self._detector.expand(coefficients)
        np.conj(wave, out=self._psi)
        self._psi *= wave
        self._psi += self._signal
        self._psi *= wave

    def _normalise(self) -> None:
        """Give the field the amplitude of the pupil."""
        np.abs(self._psi, out=self._modulus)
        self._modulus += _TINY
        np.divide(self._amplitude, self._modulus, out=self._modulus)
        self._psi *= self._modulus

    def _secant(
        self, tried: NDArray, new: NDArray, before: tuple[NDArray, NDArray] | None
    ) -> tuple[NDArray, tuple[NDArray, NDArray]]:
        """Next coefficients, and those tried with their change: `Acceleration.next` for complex numbers."""
        ahead = np.vdot(new, tried)
        change = new * (ahead / (abs(ahead) + _TINY)) - tried
        following = tried + self._relaxation * change
        if before is not None:
            turn = change - before[1]
            size = np.vdot(turn, turn).real
            share = np.vdot(turn, change).real / size if size > 0 else 0.0
            following -= share * (tried - before[0] + self._relaxation * turn)
        return following, (tried, change)


class _Plane:
    """Functions of a plane for single complex maps: a real product with both parts side by side needs no copy."""

    def __init__(self, plane: Plane) -> None:
        self._along_y = plane.along_y.astype(np.float32)
        self._along_x, self._combine = plane.along_x.astype(np.complex64), plane.combine.astype(np.complex64)

    def project(self, maps: NDArray[np.complex64]) -> NDArray[np.complexfloating]:
        """Inner products: (ny, nx) to (r,)."""
        rows = (self._along_y @ maps.view(np.float32)).view(np.complex64)
        return (rows @ self._along_x.T).ravel() @ self._combine

    def expand(self, coefficients: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Map of coefficients: (r,) to (ny, nx)."""
        pairs = (self._combine @ coefficients).reshape(len(self._along_y), -1)
        return (self._along_y.T @ (pairs @ self._along_x).view(np.float32)).view(np.complex64)
