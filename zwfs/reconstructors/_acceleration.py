"""Fewer iterations to the same fixed point: `eq-lost`, `eq-dimming` and `eq-secant` of the book."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind
from zwfs._lowrank import split_core
from zwfs._propagator import with_piston_of
from zwfs.reconstructors.base import State
from zwfs.sensor import ZernikeSensor

_DIMMEST = 0.01  # least light that frames are taken to miss, relative to those of a flat wavefront
_MOST = 0.5  # largest remainder of a small tilt: a relaxation beyond 2 makes other errors grow


@dataclass(kw_only=True)
class Path(State):
    """Points that an iteration has passed: coefficients of the field, (k, 2 r)."""

    tried: NDArray[np.floating] | None = None  # from which the last step started
    before: NDArray[np.floating] | None = None  # from which the step before that started
    change: NDArray[np.floating] | None = None  # by that step
    lost: NDArray[np.floating] | None = None  # (k,), light that the frames miss, before the second step only


@dataclass(frozen=True, eq=False)
class Acceleration:
    """Extrapolation of the coefficients of the reference waves from one iteration to the next."""

    form: NDArray[np.floating]  # (2 r, 2 r), light that all masks together take out of the pupil
    lost: float  # that light for a flat wavefront
    relaxation: float  # factor of the change by an iteration

    @classmethod
    def of(cls, sensor: ZernikeSensor, flat: NDArray[np.float64], remainder: float) -> Acceleration:
        """Compute it from the coefficients of a flat wavefront, (1, 2 r), and the remainder of a small tilt.

        The remainder is the fraction of a small tilt that is still missing after one iteration.
        """
        form = split_core(light_form(sensor)[np.newaxis])
        # An iteration multiplies a small tilt by the remainder: with this relaxation none of it remains.
        relaxation = 1 / (1 - min(max(remainder, 0.0), _MOST))
        return cls(form, float(np.vecdot(flat @ form, flat)[0]), relaxation)

    def to(self, kind: Kind) -> Acceleration:
        """The same for arrays of another kind."""
        return Acceleration(kind.array(self.form), self.lost, self.relaxation)

    def missing(self, light: NDArray, xp: Any) -> NDArray:
        """Light that is lost in frames, (k,), kept between what flat and strongly aberrated wavefronts lose."""
        return xp.minimum(xp.maximum(light, _DIMMEST * self.lost), self.lost)

    def light_taken(self, coefficients: NDArray, xp: Any) -> NDArray:
        """Light (k,) that the reference waves of coefficients (k, 2 r) take out of the pupil."""
        return xp.vecdot(coefficients @ self.form, coefficients)

    def next(self, new: NDArray, path: Path, xp: Any) -> NDArray:
        """Return the coefficients (k, 2 r) for the next step, from those of the last estimate; the path grows."""
        tried = path.tried
        if tried is None:  # the start of a caller, which is not changed
            path.tried = new
        elif path.lost is not None:  # the second step from a flat start, whose first one was dimmed
            relaxed = tried + self.relaxation * (new - tried)
            dimmed = xp.maximum(self.light_taken(relaxed, xp), _DIMMEST * path.lost)
            path.tried, path.lost = relaxed * dimming(path.lost, dimmed, xp), None
        else:
            # A piston that turns in each iteration would be a change that never ends, which the secant magnifies.
            path.tried = self._secant(tried, with_piston_of(tried, new, xp) - tried, path, xp)
        return path.tried

    def _secant(self, x: NDArray, f: NDArray, path: Path, xp: Any) -> NDArray:
        """Return the next point of the path from the last one and from its change by an iteration.

        This is Anderson's method of depth 1. An iteration changes the last point x by f, and changed the point x'
        before it by f'. On the line x - s (x - x') the change is about f - s (f - f'). It is smallest for
        s = <f - f', f> / |f - f'|^2. The next point is that point of the line, plus the relaxed change there.
        """
        new = x + self.relaxation * f
        if path.before is not None and path.change is not None:
            turn = f - path.change
            size = xp.vecdot(turn, turn)
            share = xp.vecdot(turn, f) / xp.where(size > 0, size, 1.0)
            new -= share[:, np.newaxis] * (x - path.before + self.relaxation * turn)
        path.before, path.change = x, f
        return new


def light_form(sensor: ZernikeSensor) -> NDArray[np.complex128]:
    """Matrix (r, r) of the light that all masks take out of the pupil, from the coefficients of the field."""
    pupil, core = sensor.factors.pupil, sensor.factors.core
    window = sensor.factors.detector.cut(*sensor.window)
    inside = sensor.pupil.inside.astype(float)
    # With r = K b the light changes by |r|^2 + 2 Re(conj(r) psi), summed over the pupil: a form of b.
    cross = window.products(pupil, np.ones_like(inside))
    power = window.products(window, inside)
    turned = core.conj().transpose(0, 2, 1)
    gained = turned @ cross + (turned @ cross).conj().transpose(0, 2, 1) + turned @ power @ core
    return -gained.sum(axis=0)


def dimming(lost: NDArray, light_taken: NDArray | float, xp: Any) -> NDArray:
    """Factor (k, 1) by which reference waves that take out some light (k,) take out the lost light (k,)."""
    return xp.sqrt(lost / light_taken)[:, np.newaxis]
