"""Phases that are known up to multiples of 2 pi: a map without jumps, and a fit of modes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from zwfs._arrays import Kind

_NOTHING = 1e-300  # keeps quotients finite
_NEAR, _NEAR_SIGMAS = 1.0, 5.0  # radian and sigmas: largest distance from a fit without wrong multiples of 2 pi
_SURE, _OUTLIER = 0.7, 3.5  # radian and sigmas: largest error of a prediction at which a point joins a fit
_VAGUE = 1.0  # radian, error of a phase that says nothing
_LEAST_ERROR = 0.05  # radian, of a phase
_STEEPER = 1.5  # mean square slope in units of the wrapped one
_MOST_ROUNDS = 100  # in which all points join
_LEAST_SLOPE = 1e-6  # of a mode, squared, relative to the largest
_ANY_PISTON = 100.0  # radian


def unwrapped(phase: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Phase without jumps of 2 pi between neighbours inside, by least squares."""
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(np.count_nonzero(inside))
    rows, right = [], []
    for axis in (0, 1):
        first, second = (np.moveaxis(number, axis, 0)[cut] for cut in (slice(None, -1), slice(1, None)))
        values = np.moveaxis(phase, axis, 0)
        both = (first >= 0) & (second >= 0)
        rows.append(np.stack([first[both], second[both]], axis=1))
        right.append(np.angle(np.exp(1j * np.diff(values, axis=0)))[both])
    pairs, step = np.concatenate(rows), np.concatenate(right)
    k = np.arange(len(pairs))
    size = (len(pairs), int(number.max()) + 1)
    slope = sparse.csr_array((np.tile([-1.0, 1.0], len(pairs)), (np.repeat(k, 2), pairs.ravel())), size)
    normal = (slope.T @ slope + 1e-9 * sparse.eye_array(size[1])).tocsc()
    smooth = splu(normal).solve(slope.T @ step)
    out = phase.copy()
    difference = smooth - phase[inside]
    difference -= np.median(difference)
    out[inside] += 2 * np.pi * np.rint(difference / (2 * np.pi))
    return out


class Unwrapping(NamedTuple):
    """Fit of modes to phases that are known up to multiples of 2 pi (`eq-unwrap`).

    Neighbours may differ by more than pi, as at the rim of large screens. The fit therefore grows from the most
    certain point: a point joins, with the multiple of 2 pi nearest to its prediction, once the points before
    predict it to a fraction of a turn. At the beginning the slopes are equally probable everywhere in the pupil.
    """

    inside: NDArray[np.bool_]
    radius: NDArray[np.float64]  # (n_points,), distance from the mean point, in units of the largest side
    pairs: tuple[NDArray[np.bool_], NDArray[np.bool_]]  # whether a point and the next along y, or x, are inside
    basis: NDArray[np.float64]  # (n_points, m + 1), modes of a mean square slope of 1 / m, and a piston
    turn: NDArray[np.float64]  # (m, m), from their coefficients to those of the modes
    modes: NDArray[np.float64]  # (m, n_points)
    inverse: NDArray[np.float64]  # (n_points, m), least squares on the modes and a piston
    from_slopes: NDArray[np.float64]  # (n_pairs, m), least squares on differences of neighbours

    @classmethod
    def of(cls, inside: NDArray[np.bool_], modes: NDArray[np.float64]) -> Unwrapping:
        pairs = inside[1:] & inside[:-1], inside[:, 1:] & inside[:, :-1]
        slopes = np.concatenate([np.diff(modes, axis=1)[:, pairs[0]], np.diff(modes, axis=2)[:, pairs[1]]], axis=1)
        values, vectors = np.linalg.eigh(slopes @ slopes.T * len(modes) / max(slopes.shape[1], 1))
        turn = vectors / np.sqrt(np.maximum(values, _LEAST_SLOPE * values[-1] + _NOTHING))
        flat, piston = modes[:, inside], np.ones((1, np.count_nonzero(inside)))
        basis = np.concatenate([turn.T @ flat, _ANY_PISTON * piston])
        inverse = np.linalg.pinv(np.concatenate([flat, piston]), rcond=1e-10)[:, :-1]
        places = np.argwhere(inside)
        radius = np.linalg.norm(places - places.mean(axis=0), axis=1) / max(inside.shape)
        return cls(
            inside=inside,
            radius=radius,
            pairs=pairs,
            basis=basis.T.copy(),
            turn=turn,
            modes=flat,
            inverse=inverse,
            from_slopes=np.linalg.pinv(slopes, rcond=1e-10),
        )

    def fit(self, phase: NDArray, kind: Kind, sigma: NDArray | None = None) -> NDArray:
        """Coefficients of phases, (k, ny, nx), with standard errors sigma, 0 if left out: (k, m).

        Three fits follow each other until all points are near one: least squares on the phase as it is, least
        squares on wrapped differences, and the fit that grows. If none is near, as where the modes cannot
        represent the phase, the best one counts.
        """
        xp, k, inside = kind.xp, phase.shape[0], kind.flags(self.inside.ravel())
        points = xp.reshape(phase, (k, -1))[:, inside]
        errors = xp.zeros_like(points) if sigma is None else xp.reshape(sigma, (k, -1))[:, inside]
        slopes = self._wrapped_slopes(phase, kind)
        direct, sloped = points @ kind.array(self.inverse), self.sloped(phase, kind)
        rows = []
        for i in range(k):
            measured = points[i, ...], errors[i, ...]
            best, (near, match) = direct[i, ...], self._quality(direct[i, ...], *measured, kind)
            for grow in (False, True):
                if near:
                    break
                trial = self._grown(*measured, slopes[i, ...], kind) if grow else sloped[i, ...]
                near, matched = self._quality(trial, *measured, kind)
                if matched > match:
                    best, match = trial, matched
            rows.append(best)
        return xp.stack(rows)

    def direct(self, phase: NDArray, kind: Kind) -> tuple[NDArray, NDArray[np.bool_]]:
        """Least squares on phases as they are, (k, m), and whether all points are near it, (k,)."""
        points = kind.xp.reshape(phase, (phase.shape[0], -1))[:, kind.flags(self.inside.ravel())]
        coefficients = points @ kind.array(self.inverse)
        error = kind.xp.full_like(points[0, ...], _NEAR / _NEAR_SIGMAS)
        near = [self._quality(coefficients[i, ...], points[i, ...], error, kind)[0] for i in range(phase.shape[0])]
        return coefficients, kind.flags(np.array(near))

    def sloped(self, phase: NDArray, kind: Kind) -> NDArray:
        """Least squares on wrapped differences of neighbours, (k, m)."""
        return self._wrapped_slopes(phase, kind) @ kind.array(self.from_slopes)

    def _wrapped_slopes(self, phase: NDArray, kind: Kind) -> NDArray:
        """Differences of neighbours, (k, n_pairs), in (-pi, pi]."""
        along = phase[:, 1:, :] - phase[:, :-1, :], phase[:, :, 1:] - phase[:, :, :-1]
        flat = (kind.xp.reshape(steps, (phase.shape[0], -1)) for steps in along)
        inside = [steps[:, kind.flags(pairs.ravel())] for steps, pairs in zip(flat, self.pairs, strict=True)]
        return wrapped(kind.xp.concat(inside, axis=1), kind.xp)

    def _quality(self, coefficients: NDArray, phase: NDArray, sigma: NDArray, kind: Kind) -> tuple[bool, float]:
        """Whether all points are near the fit, but for multiples of 2 pi and a piston, and how many agree."""
        xp, rest = kind.xp, phase - coefficients @ kind.array(self.modes)
        weights = 1 / (sigma**2 + _LEAST_ERROR**2)
        real, imag = xp.vecdot(weights, xp.cos(rest)), xp.vecdot(weights, xp.sin(rest))
        apart = xp.abs(wrapped(rest - xp.atan2(imag, real), xp))
        near = float(xp.max(apart)) < _NEAR and float(xp.max(apart**2 * weights)) < _NEAR_SIGMAS**2
        return near, float(xp.hypot(real, imag))

    def _grown(self, phase: NDArray, sigma: NDArray, slopes: NDArray, kind: Kind) -> NDArray:
        """Coefficients, (m,), of one phase, (n_points,)."""
        xp = kind.xp
        steepness = float(xp.sum(slopes**2)) / max(slopes.shape[0], 1)
        prior = _STEEPER * steepness + _LEAST_ERROR**2  # variance of a coefficient of the basis
        certain = sigma <= max(_VAGUE, float(xp.min(sigma)))
        basis, rest, noise = kind.array(self.basis)[certain], phase[certain], sigma[certain] ** 2 + _LEAST_ERROR**2
        fewest = 1 + rest.shape[0] // _MOST_ROUNDS
        information = kind.array(np.eye(self.basis.shape[1]))
        first = xp.argmin(sigma[certain] + _LEAST_ERROR * kind.array(self.radius)[certain])
        weighted_sum, join = kind.zeros(information.shape[0]), kind.integers(np.arange(rest.shape[0])) == first
        unwrapped = rest  # of points that join: the first of them as they are
        while rest.shape[0]:
            weighted = basis[join] * (prior / noise[join])[:, np.newaxis]
            information = information + weighted.T @ basis[join]
            weighted_sum = weighted_sum + unwrapped[join] @ weighted
            basis, rest, noise = basis[~join], rest[~join], noise[~join]
            covariance = xp.linalg.inv(information)
            predicted = basis @ (covariance @ weighted_sum)
            variance = prior * xp.sum((basis @ covariance) * basis, axis=1)
            error = wrapped(rest - predicted, xp)
            unwrapped = predicted + error
            join = (variance < _SURE**2) & (error**2 < _OUTLIER**2 * (variance + noise))
            if rest.shape[0] and xp.count_nonzero(join) < fewest:
                doubt = variance + error**2
                join = doubt <= xp.sort(doubt)[min(fewest, doubt.shape[0]) - 1]
        return kind.array(self.turn) @ (covariance @ weighted_sum)[:-1]


def wrapped(phase: NDArray, xp: Any) -> NDArray:
    """Phase without its multiples of 2 pi, in (-pi, pi]."""
    return xp.atan2(xp.sin(phase), xp.cos(phase))
