"""Fewer iterations to the same fixed point: `eq-lost`, `eq-dimming` and `eq-secant` of the book."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind
from zwfs.lowrank import split_core
from zwfs.reconstructors.base import with_piston_of
from zwfs.sensor import ZernikeSensor

_DIMMEST = 0.01  # least light that frames are taken to miss, relative to those of a flat wavefront
_MOST = 0.5  # of a small tilt that an iteration is taken to leave: a relaxation beyond 2 makes other errors grow


@dataclass(frozen=True, eq=False)
class Acceleration:
    """What the coefficients of the reference waves are made of, from one iteration to the next.

    Attributes
    ----------
    form : array, shape (2 r, 2 r)
        Quadratic form of the coefficients: light that all masks together take out of the pupil.
    lost : float
        That light for a flat wavefront.
    relaxation : float
        By which the change of an iteration is multiplied.
    """

    form: NDArray[np.floating]
    lost: float
    relaxation: float

    @classmethod
    def of(cls, sensor: ZernikeSensor, flat: NDArray[np.float64], left: float) -> Acceleration:
        """From the coefficients of a flat wavefront, (1, 2 r), and what an iteration leaves of a small tilt."""
        pupil, core = sensor.factors.pupil, sensor.factors.core
        window = sensor.factors.detector.cut(*sensor.window)
        inside = sensor.pupil.inside.astype(float)
        # With r = K b the light changes by |r|^2 + 2 Re(conj(r) psi), summed over the pupil: a form of b.
        cross = window.products(pupil, np.ones_like(inside))
        power = window.products(window, inside)
        turned = core.conj().transpose(0, 2, 1)
        gained = turned @ cross + (turned @ cross).conj().transpose(0, 2, 1) + turned @ power @ core
        form = -split_core(gained.sum(axis=0, keepdims=True))
        # An iteration multiplies a small tilt by `left`: with this relaxation none of it remains.
        relaxation = 1 / (1 - min(max(left, 0.0), _MOST))
        return cls(form, float(np.vecdot(flat @ form, flat)[0]), relaxation)

    def to(self, kind: Kind) -> Acceleration:
        """The same for arrays of another kind."""
        return Acceleration(kind.array(self.form), self.lost, self.relaxation)

    def missing(self, light: NDArray, xp: Any) -> NDArray:
        """Light that is lost in frames, (k,), kept between what flat and strongly aberrated wavefronts lose."""
        return xp.minimum(xp.maximum(light, _DIMMEST * self.lost), self.lost)

    def taken(self, coefficients: NDArray, xp: Any) -> NDArray:
        """Light (k,) that the reference waves of coefficients (k, 2 r) take out of the pupil."""
        return xp.vecdot(coefficients @ self.form, coefficients)

    def extrapolate(self, found: NDArray, data: dict[str, NDArray], xp: Any) -> NDArray:
        """Next coefficients (k, 2 r) from those that an iteration found; what is remembered is kept in `data`."""
        tried = data.get("tried")
        if tried is None:
            data["tried"] = found
            return found
        if "lost" in data:  # a new start, and no point on the line of the secant
            lost = data.pop("lost")
            new = tried + self.relaxation * (found - tried)
            data["tried"] = new * dimming(lost, xp.maximum(self.taken(new, xp), _DIMMEST * lost), xp)
            return data["tried"]
        # A piston that turns in each iteration would be a change that never ends, which the secant magnifies.
        change = with_piston_of(tried, found, xp) - tried
        new = tried + self.relaxation * change
        if "change" in data:
            turn = change - data["change"]
            size = xp.vecdot(turn, turn)
            share = xp.vecdot(turn, change) / xp.where(size > 0, size, 1.0)
            new -= share[:, np.newaxis] * (tried - data["before"] + self.relaxation * turn)
        data.update(tried=new, before=tried, change=change)
        return new


def dimming(lost: NDArray, taken: NDArray | float, xp: Any) -> NDArray:
    """Factor (k, 1) by which reference waves that take out some light (k,) take out what is lost, (k,)."""
    return xp.sqrt(lost / taken)[:, np.newaxis]
