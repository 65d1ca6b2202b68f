"""Errors of the phases of a calibration's own frames, and the variance that they add to that of noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import nnls

from zwfs._images import nearest_good
from zwfs.frames._states import aligned, unknown_in, with_neighbours
from zwfs.sensor import ZernikeSensor

_GROWTH = 2, 4  # powers of slopes with which squares of errors grow: those of points, and of modes
_AROUND = 5  # pixels over which squares of errors have a median
_ODD = 9  # square of an error over that of its neighbours: such a point is worse than they are
_SHARED = 4  # states that the mean of all modes counts for


def unexplained(phase: NDArray, commands: NDArray) -> NDArray[np.float32]:
    """Phases of states less their commands and their common flat, (n_states, ny, nx), radian.

    They are 0 where a phase is NaN, and at pixels of the outline whose command may be a mean with unknown ones.
    """
    unknown = unknown_in(commands)
    if unknown.any():
        unknown = with_neighbours(unknown)
    waves = np.nan_to_num(np.exp(1j * (phase.astype(float) - np.nan_to_num(commands))))
    waves = aligned(np.where(unknown, 0, waves))
    errors = np.angle(waves * waves.mean(axis=0).conj()) * math.sqrt(len(waves) / (len(waves) - 1))
    return errors.astype(np.float32)


def sideways(
    sensor: ZernikeSensor, phase: NDArray, frames: NDArray, good: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Phases (ny, nx) that stand for the errors of a single state, whose phase is not known.

    A phase explains one of two frames. What remains is a difference across the direction in which a phase changes
    them. The errors along that direction, which are not seen, are taken to be of the same size.
    """
    if sensor.n_masks == 1:
        return np.zeros(phase.shape, np.float32)  # one frame is explained by nearly any phase
    chequered = 1e-3 * (-1.0) ** np.indices(phase.shape).sum(axis=0)  # which no reference wave sees
    modelled, changed = (sensor.measure(phase + step)[(..., *sensor.window)] for step in (0, chequered))
    missing, slope = frames - modelled, (changed - modelled) / chequered
    strength = np.sum(slope**2, axis=0)
    across = missing[0] * slope[1] - missing[1] * slope[0]
    return np.where(good, across / np.maximum(strength, 0.1 * np.median(strength[good])), 0).astype(np.float32)


def slopes_of(phases: NDArray, good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rms difference of phases (k, ny, nx) at neighbouring good points, (k,), radian."""
    waves, parts = np.exp(1j * phases), []
    for axis in (0, 1):
        both = np.moveaxis(good, axis, 0)
        parts.append(np.diff(np.moveaxis(waves, axis + 1, 1), axis=1)[:, both[1:] & both[:-1]])
    return np.sqrt(np.mean(np.abs(np.concatenate(parts, axis=1)) ** 2, axis=1))


class Excess(NamedTuple):
    """Variance of phases less that of their noise: a constant, and a factor of a power of the slope.

    Beyond the mean slope of the states all of it grows: few states hardly tell the constant from the growth.
    """

    constant: NDArray[np.float64]
    growing: NDArray[np.float64]
    power: int
    slope: float  # mean of the states

    @classmethod
    def of(cls, errors: NDArray, noise: NDArray, slopes: NDArray, good: NDArray[np.bool_], modal: bool) -> Excess:
        """Excess of errors of states (n, ...), of points or of modes, over a variance.

        States are few: a point has the median of its neighbours, and a mode is averaged with all modes. The states
        say how variances grow with the slope.
        """
        n, squares, power = len(slopes), errors**2, _GROWTH[modal]
        if not n:
            return cls(0 * noise, 0 * noise, power, math.inf)
        mean = squares.mean(axis=0) - noise
        if modal:
            mean = (n * mean + _SHARED * mean.mean()) / (n + _SHARED)
        else:
            own = nearest_good(squares.mean(axis=0), good)
            near = ndimage.median_filter(own, _AROUND) / (1 - 2 / (9 * n)) ** 3  # median of chi-square to its mean
            mean = np.where(own > _ODD * near, own, near) - noise
            squares, noise = squares[:, good], noise[good]
        powers = np.stack([np.ones(n), slopes**power], axis=1)
        totals = np.maximum(squares.mean(axis=1) - noise.mean(), 0)
        shares = nnls(powers, totals)[0] if n > 2 else np.array([1.0, 0.0])
        constant, growing = shares / max(np.mean(powers @ shares), 1e-30)
        mean = np.maximum(mean, 0)
        return cls(constant * mean, growing * mean, power, float(np.mean(slopes**power) ** (1 / power)))

    def at(self, phase: NDArray, good: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Excess at a phase (ny, nx)."""
        slope = slopes_of(phase[np.newaxis], good)[0]
        reached = min(slope, self.slope)
        return (self.constant + self.growing * reached**self.power) * (slope / reached) ** self.power
