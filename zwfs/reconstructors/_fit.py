"""State of a maximum-likelihood fit, and the arithmetic of its starts and steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind
from zwfs._information import Inverse
from zwfs._propagator import Propagator, split, square

_NOTHING = 1e-300  # keeps quotients finite
_RIDGE = 1e-6  # of the normal equations at points whose reference waves vanish
_NEAR, _NEAR_SIGMAS = 1.0, 5.0  # radian and sigmas: largest distance from a fit without wrong multiples of 2 pi
_SURE, _OUTLIER = 0.7, 3.5  # radian and sigmas: largest error of a prediction at which a point joins a fit
_VAGUE = 1.0  # radian, error of a phase that says nothing
_LEAST_ERROR = 0.05  # radian, of a phase
_STEEPER = 1.5  # mean square slope in units of the wrapped one
_MOST_ROUNDS = 100  # in which all points join
_LEAST_SLOPE = 1e-6  # of a mode, squared, relative to the largest
_ANY_PISTON = 100.0  # radian


@dataclass
class Fit:
    """State of the fits of k frame sets."""

    frames: NDArray[np.floating]  # (k, n_masks, ny', nx'), measured
    psi: NDArray[np.floating]  # (k, 2 n_wavelengths, ny, nx), field in the pupil
    waves: NDArray[np.floating]  # (k, n_masks, 2 n_wavelengths, ny', nx'), its fields on the detector
    light: NDArray[np.floating]  # (k, n_masks, ny', nx'), their intensity
    cost: NDArray[np.floating]  # (k,), twice the negative logarithm of the likelihood and of the prior
    coefficients: NDArray[np.floating] | None = None  # (k, m), of the modes
    phase: NDArray[np.floating] | None = None  # (k, ny, nx), in a band of light: not wrapped
    damping: Any = None  # (k,), relative to the mean of the diagonal of the information
    growth: Any = None  # (k,), of the damping after a step that raises the cost
    n_iterations: Any = None  # (k,)
    converged: Any = None  # (k,)
    n_starts: Any = None  # (k,)
    n_reflections: Any = None  # (k,)
    history: NDArray[np.floating] | None = None  # (k, n_iterations + 1, ny, nx)

    def at(self, which: NDArray) -> Fit:
        """Return the fits of some frame sets, by their places or by flags."""
        return Fit(**{name: array[which] for name, array in self._arrays()})

    def take(self, where: NDArray[np.bool_], other: Fit, xp: Any) -> None:
        """Replace the arrays by those that other fits of the same frame sets have, where flags (k,) are True."""
        for name, array in other._arrays():
            if not xp.all(where):
                flags = xp.reshape(where, (-1, *(1,) * (array.ndim - 1)))
                array = xp.where(flags, array, getattr(self, name))
            setattr(self, name, array)

    def put(self, which: NDArray[np.bool_], part: Fit) -> None:
        """Write the fits of some frame sets to their places."""
        for name, array in part._arrays():
            whole = getattr(self, name)
            whole = Kind.of(whole).xp.asarray(whole, copy=True)
            whole[which] = array
            setattr(self, name, whole)

    @classmethod
    def joined(cls, fits: list[Fit], xp: Any) -> Fit:
        """Return the fits of several batches as those of one."""
        if len(fits) == 1:
            return fits[0]
        return cls(**{name: xp.concat([getattr(fit, name) for fit in fits]) for name, _ in fits[0]._arrays()})

    def _arrays(self) -> list[tuple[str, Any]]:
        return [(name, array) for name, array in vars(self).items() if array is not None]


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
        return cls(inside, radius, pairs, basis.T.copy(), turn, flat, inverse, np.linalg.pinv(slopes, rcond=1e-10))

    def fit(self, phase: NDArray, kind: Kind, sigma: NDArray | None = None) -> NDArray:
        """Coefficients of phases, (k, ny, nx), with standard errors sigma, 0 if left out: (k, m).

        Three fits follow each other until all points are near one: least squares on the phase as it is, least
        squares on wrapped differences, and the fit that grows. If none is near, as where the modes cannot
        represent the phase, the best one counts.
        """
        xp, k, inside = kind.xp, phase.shape[0], kind.flags(self.inside.ravel())
        points = xp.reshape(phase, (k, -1))[:, inside]
        errors = 0 * points if sigma is None else xp.reshape(sigma, (k, -1))[:, inside]
        slopes = self._wrapped_slopes(phase, kind)
        direct, sloped = points @ kind.array(self.inverse), self.sloped(phase, kind)
        rows = []
        for i in range(k):
            one = points[i, ...], errors[i, ...]
            best, (near, match) = direct[i, ...], self._quality(direct[i, ...], *one, kind)
            for grow in (False, True):
                if near:
                    break
                other = self._grown(*one, slopes[i, ...], kind) if grow else sloped[i, ...]
                near, matched = self._quality(other, *one, kind)
                if matched > match:
                    best, match = other, matched
            rows.append(best)
        return xp.stack(rows)

    def direct(self, phase: NDArray, kind: Kind) -> tuple[NDArray, NDArray[np.bool_]]:
        """Least squares on phases as they are, (k, m), and whether all points are near it, (k,)."""
        points = kind.xp.reshape(phase, (phase.shape[0], -1))[:, kind.flags(self.inside.ravel())]
        coefficients = points @ kind.array(self.inverse)
        error = 0 * points[0, ...] + _NEAR / _NEAR_SIGMAS
        near = [self._quality(coefficients[i, ...], points[i, ...], error, kind)[0] for i in range(phase.shape[0])]
        return coefficients, kind.flags(np.array(near))

    def sloped(self, phase: NDArray, kind: Kind) -> NDArray:
        """Least squares on wrapped differences of neighbours, (k, m)."""
        return self._wrapped_slopes(phase, kind) @ kind.array(self.from_slopes)

    def _wrapped_slopes(self, phase: NDArray, kind: Kind) -> NDArray:
        """Differences of neighbours, (k, n_pairs), in (-pi, pi]."""
        along = phase[:, 1:, :] - phase[:, :-1, :], phase[:, :, 1:] - phase[:, :, :-1]
        flat = (kind.xp.reshape(one, (phase.shape[0], -1)) for one in along)
        some = [one[:, kind.flags(pairs.ravel())] for one, pairs in zip(flat, self.pairs, strict=True)]
        return wrapped(kind.xp.concat(some, axis=1), kind.xp)

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
        some = sigma <= max(_VAGUE, float(xp.min(sigma)))
        basis, rest, noise = kind.array(self.basis)[some], phase[some], sigma[some] ** 2 + _LEAST_ERROR**2
        fewest = 1 + rest.shape[0] // _MOST_ROUNDS
        information = kind.array(np.eye(self.basis.shape[1]))
        first = xp.argmin(sigma[some] + _LEAST_ERROR * kind.array(self.radius)[some])
        right, join = 0 * information[0, ...], kind.integers(np.arange(rest.shape[0])) == first
        known = rest  # of points that join: the first of them as they are
        while rest.shape[0]:
            weighted = basis[join] * (prior / noise[join])[:, np.newaxis]
            information = information + weighted.T @ basis[join]
            right = right + known[join] @ weighted
            basis, rest, noise = basis[~join], rest[~join], noise[~join]
            covariance = xp.linalg.inv(information)
            predicted = basis @ (covariance @ right)
            variance = prior * xp.sum((basis @ covariance) * basis, axis=1)
            error = wrapped(rest - predicted, xp)
            known = predicted + error
            join = (variance < _SURE**2) & (error**2 < _OUTLIER**2 * (variance + noise))
            if rest.shape[0] and xp.count_nonzero(join) < fewest:
                doubt = variance + error**2
                join = doubt <= xp.sort(doubt)[min(fewest, doubt.shape[0]) - 1]
        return kind.array(self.turn) @ (covariance @ right)[:-1]


def wrapped(phase: NDArray, xp: Any) -> NDArray:
    """Phase without its multiples of 2 pi, in (-pi, pi]."""
    return xp.atan2(xp.sin(phase), xp.cos(phase))


class Hessian(NamedTuple):
    """Damped information of k frame sets."""

    scale: NDArray  # (k,), mean over the pupil of the information about the phase
    damping: NDArray  # (k, 1, 1), added to the diagonal
    inverse: Inverse | NDArray  # for points; for modes the damped matrices themselves, (k, m, m)


def points_step(hessian: Hessian, gradient: NDArray) -> tuple[NDArray, NDArray]:
    """Step at every point, (k, c, ny, nx), and the fall of the cost that it promises, (k,)."""
    xp = Kind.of(gradient).xp
    slopes = [gradient[:, c, ...] for c in range(gradient.shape[1])]
    step = -xp.stack(hessian.inverse @ slopes, axis=1)
    promised = hessian.damping[..., np.newaxis] * step - gradient
    return step, xp.sum(step * promised, axis=(1, 2, 3))


def linear_field(frames: NDArray, psi: NDArray, model: Propagator) -> NDArray:
    """Field that explains the frames best if the reference waves are those of another field, (k, 2, ny, nx).

    With reference waves r_k the frames I_k = P + 2 Re(conj(r_k) psi) + |r_k|^2 are linear in P = |psi|^2 and psi
    (`eq-linear-field`). Three different masks or more determine both.
    """
    xp, light = model.kind.xp, frames[(..., *model.window)]
    waves = model.reference(psi)
    rows = xp.stack([1 + 0 * light, 2 * waves[:, :, 0, ...], 2 * waves[:, :, 1, ...]], axis=1)
    rows = xp.permute_dims(rows, (0, 3, 4, 1, 2))  # (k, ny, nx, 3, n_masks)
    right = xp.permute_dims(light - square(waves), (0, 2, 3, 1))[..., np.newaxis]
    normal = rows @ xp.matrix_transpose(rows) + _RIDGE * model.kind.array(np.eye(3))
    solved = xp.linalg.solve(normal, rows @ right)[..., 0]
    modulus = xp.sqrt(xp.clip(solved[..., 0], 0, None))
    return split(xp.atan2(solved[..., 2], solved[..., 1]), modulus) * model.stop


def reflected(psi: NDArray, reference: NDArray) -> NDArray:
    """Field (k, 2, ny, nx) reflected at the direction of another, r^2 conj(psi) / |r|^2."""
    xp = Kind.of(psi).xp
    real, imag = reference[:, 0, ...], reference[:, 1, ...]
    power = real * real + imag * imag + _NOTHING
    cos, sin = (real * real - imag * imag) / power, 2 * real * imag / power
    return xp.stack(
        [cos * psi[:, 0, ...] + sin * psi[:, 1, ...], sin * psi[:, 0, ...] - cos * psi[:, 1, ...]], axis=1
    )


def turned(psi: NDArray, by: NDArray, xp: Any) -> NDArray:
    """Field (k, 2, ny, nx) turned by about a phase (k, ny, nx), for small ones exactly by it.

    The factor (1 + i x / 2) / (1 - i x / 2) has modulus 1 and the argument 2 arctan(x / 2) = x - x^3 / 12 + ... It
    costs less than exp(i x), and shortens steps that are too long for the quadratic model.
    """
    real, imag = psi[:, 0, ...], psi[:, 1, ...]
    half = 0.5 * by
    sin = by / (1 + half * half)
    cos = 1 - half * sin
    return xp.stack([cos * real - sin * imag, sin * real + cos * imag], axis=1)
