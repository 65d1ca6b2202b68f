"""Unknowns of a maximum-likelihood fit: where each kind of them starts, how it steps, and what it may have missed.

A kind of unknowns is a class with the methods of `Points`, the simplest one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Immutable, Kind, read_only
from zwfs._information import Information
from zwfs._propagator import Propagator, angle
from zwfs._unwrapping import Unwrapping
from zwfs.modes import zernike_basis
from zwfs.pupil import Pupil
from zwfs.reconstructors._fit import Fit, Hessian, linear_field, reflected, turned

_UNWRAPPED_MODES = 40  # of the smooth part of a phase that is known up to multiples of 2 pi
_LINEAR_ITERATIONS = 5  # of the start of an unknown amplitude


class Position(NamedTuple):
    """Where k fits stand: their fields, and those unknowns that a field does not hold."""

    psi: NDArray[np.floating]  # (k, 2 n_wavelengths, ny, nx)
    coefficients: NDArray[np.floating] | None = None  # (k, m)
    phase: NDArray[np.floating] | None = None  # (k, ny, nx), not wrapped


class Proposal(NamedTuple):
    """Step that k fits may take."""

    position: Position
    maps: NDArray[np.floating]  # (k, c, ny, nx), change of the phase and of the amplitude
    promised: NDArray[np.floating]  # (k,), fall of the cost in the quadratic model


class Points(Immutable):
    """Phase of every point at one wavelength: the field holds it, up to multiples of 2 pi."""

    least_gain: float | None = 0.01  # of twice the log-likelihood, from which on an alternative of a point counts

    def __init__(self, n_points: int) -> None:
        self.n_unknowns = n_points - 1  # no frame shows the piston

    def begin(self, start: NDArray, frames: NDArray, model: Propagator) -> Position:
        """Return the position of a starting phase, (k, ny, nx)."""
        return Position(model.incoming(start))

    def hessian(self, information: Information, damping: NDArray) -> Hessian:
        """Damp the information; the damping, (k,), is relative to the mean of the diagonal."""
        absolute = damping[:, np.newaxis, np.newaxis] * information.scale
        return Hessian(information.scale[:, 0, 0], absolute, information.inverse(absolute))

    def step(self, fit: Fit, hessian: Hessian, gradient: NDArray, change: NDArray, model: Propagator) -> Proposal:
        """Propose the step for the gradient, (k, c, ny, nx), and the changes of the field per unit of it."""
        xp = model.kind.xp
        slopes = [gradient[:, c, ...] for c in range(gradient.shape[1])]
        maps = -xp.stack(hessian.inverse @ slopes, axis=1)
        promised = xp.sum(maps * (hessian.damping[..., np.newaxis] * maps - gradient), axis=(1, 2, 3))
        return Proposal(self._moved(fit, maps, change, model), maps, promised)

    def prior_cost(self, coefficients: NDArray | None) -> NDArray | float:
        """Part of the cost that does not depend on the frames, (k,)."""
        return 0.0

    def phase(self, fit: Fit) -> NDArray:
        """Phase of fits, (k, ny, nx)."""
        return angle(fit.psi, Kind.of(fit.psi).xp)

    def alternatives(self, fit: Fit, references: NDArray, model: Propagator) -> Iterator[Position]:
        """Positions whose points may be more likely: the reflections at the reference wave of each mask."""
        for mask in range(references.shape[1]):
            yield Position(reflected(fit.psi, references[:, mask, ...]))

    def unwrapped(self, phase: NDArray) -> NDArray:
        """Phase (k, ny, nx) of the first iterations, with the multiples of 2 pi that count."""
        return phase

    def _moved(self, fit: Fit, maps: NDArray, change: NDArray, model: Propagator) -> Position:
        return Position(turned(fit.psi, maps[:, 0, ...], model.kind.xp))


class PointsAndAmplitude(Points):
    """Phase and amplitude of every point: the field holds both."""

    least_gain = None

    def __init__(self, n_points: int) -> None:
        self.n_unknowns = 2 * n_points - 1

    def begin(self, start: NDArray, frames: NDArray, model: Propagator) -> Position:
        """Return the field that a few linear iterations make of a starting phase, (k, ny, nx)."""
        psi = model.incoming(start)
        for _ in range(_LINEAR_ITERATIONS):
            psi = linear_field(frames, psi, model)
        return Position(psi)

    def _moved(self, fit: Fit, maps: NDArray, change: NDArray, model: Propagator) -> Position:
        return Position(fit.psi + model.kind.xp.sum(change * maps[:, :, np.newaxis, ...], axis=1))


class BandPoints(Points):
    """Phase of every point in light of several wavelengths: multiples of 2 pi count, so it is not wrapped."""

    least_gain = 10.0  # of a turn by 2 pi: a smooth phase is more probable

    def __init__(self, pupil: Pupil) -> None:
        super().__init__(pupil.n_points)
        smooth = zernike_basis(pupil, min(_UNWRAPPED_MODES, pupil.n_points - 1))
        self._smooth = read_only(np.where(pupil.inside, smooth, 0))
        self._unwrapping = Unwrapping.of(pupil.inside, self._smooth)

    def begin(self, start: NDArray, frames: NDArray, model: Propagator) -> Position:
        """Return the position of a starting phase, (k, ny, nx)."""
        return Position(model.incoming(start), phase=start)

    def phase(self, fit: Fit) -> NDArray:
        """Phase of fits, (k, ny, nx)."""
        assert fit.phase is not None
        return fit.phase

    def alternatives(self, fit: Fit, references: NDArray, model: Propagator) -> Iterator[Position]:
        """Positions 2 pi away: the reflections of the wavelengths differ."""
        for turn in (2 * np.pi, -2 * np.pi):
            phase = self.phase(fit) + turn
            yield Position(model.incoming(phase), phase=phase)

    def unwrapped(self, phase: NDArray) -> NDArray:
        """Phase (k, ny, nx) with the multiples of 2 pi that bring it nearest to a smooth one."""
        kind = Kind.of(phase)
        flat = kind.xp.reshape(kind.array(self._smooth), (self._smooth.shape[0], -1))
        smooth = kind.xp.reshape(self._unwrapping.sloped(phase, kind) @ flat, phase.shape)
        return phase - 2 * np.pi * kind.xp.round((phase - smooth) / (2 * np.pi))

    def _moved(self, fit: Fit, maps: NDArray, change: NDArray, model: Propagator) -> Position:
        phase = self.phase(fit) + 2 * model.kind.xp.atan(maps[:, 0, ...] / 2)  # the angle of `turned`
        return Position(model.incoming(phase), phase=phase)


class Modes(Points):
    """Coefficients of modes of the phase, and what is known of them before the measurement."""

    least_gain = None

    def __init__(
        self, inside: NDArray[np.bool_], modes: NDArray[np.float64], precision: NDArray[np.float64] | None
    ) -> None:
        self.n_unknowns = len(modes)
        self.modes, self.precision = modes, precision
        self.unwrapping = Unwrapping.of(inside, modes)

    def begin(self, start: NDArray, frames: NDArray, model: Propagator) -> Position:
        """Return the fit of the modes to a starting phase, (k, ny, nx)."""
        coefficients = self.unwrapping.fit(start, model.kind)
        return Position(model.incoming(self.sum(coefficients)), coefficients)

    def hessian(self, information: Information, damping: NDArray) -> Hessian:
        """Damp the information about the coefficients, that of the prior included."""
        kind = information.constants.kind
        modes = kind.array(self.modes)
        matrix = information.onto(modes)
        if self.precision is not None:
            matrix = matrix + kind.array(self.precision)
        eye = kind.array(np.eye(modes.shape[0]))
        absolute = (damping * kind.xp.sum(matrix * eye, axis=(1, 2)) / modes.shape[0])[:, np.newaxis, np.newaxis]
        return Hessian(information.scale[:, 0, 0], absolute, matrix + absolute * eye)

    def step(self, fit: Fit, hessian: Hessian, gradient: NDArray, change: NDArray, model: Propagator) -> Proposal:
        """Propose the step of the coefficients for the gradient of the phase, (k, 1, ny, nx)."""
        assert fit.coefficients is not None
        kind = model.kind
        xp, modes = kind.xp, kind.array(self.modes)
        slope = xp.reshape(gradient, (gradient.shape[0], -1)) @ xp.reshape(modes, (modes.shape[0], -1)).T
        if self.precision is not None:
            slope = slope + fit.coefficients @ kind.array(self.precision)
        jump = -xp.linalg.solve(hessian.inverse, slope[..., np.newaxis])[..., 0]
        promised = xp.vecdot(jump, hessian.damping[:, 0, ...] * jump - slope)
        coefficients = fit.coefficients + jump
        position = Position(model.incoming(self.sum(coefficients)), coefficients)
        return Proposal(position, self.sum(jump)[:, np.newaxis, ...], promised)

    def prior_cost(self, coefficients: NDArray | None) -> NDArray | float:
        """Twice the negative logarithm of the prior, (k,)."""
        if self.precision is None:
            return 0.0
        kind: Any = Kind.of(coefficients)
        return kind.xp.vecdot(coefficients @ kind.array(self.precision), coefficients)

    def phase(self, fit: Fit) -> NDArray:
        """Phase of fits, (k, ny, nx)."""
        assert fit.coefficients is not None
        return self.sum(fit.coefficients)

    def sum(self, coefficients: NDArray) -> NDArray:
        """Phase of coefficients: (k, m) to (k, ny, nx)."""
        kind = Kind.of(coefficients)
        modes = kind.array(self.modes)
        flat = coefficients @ kind.xp.reshape(modes, (modes.shape[0], -1))
        return kind.xp.reshape(flat, (-1, *modes.shape[1:]))
