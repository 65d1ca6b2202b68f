"""Explicit Gauss-Newton matrix of a phase behind known optics, with which a fit needs few iterations.

The unknowns are the coefficients of the phase's spline where there is light. A coefficient changes the images near
its own place, and through the light of the dimple, which few numbers describe. Coefficients far apart do not share
a pixel, so one derivative gives the local changes of a whole comb of them. On a pupil with segments, the steps of
these are unknowns, too: here the coefficients include the means of the steps over the pixels, so that a step alone
is what a spline lacks at gaps.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, ndimage, sparse

from zwfs.frames._optics import pooled
from zwfs.frames._solver import PhaseMap, Point, growth_of

_MOST = 3000  # coefficients: with more, the factors take longer than conjugate gradients without them
_APART = 8  # pixels between the coefficients of a comb
_TOGETHER = 8  # combs that are applied at once: with more, the arrays exceed the cache
_FAINTEST = 1e-3  # part of the light of the dimple that counts, over the largest
_DAMPED = 1e-3, 1e-7  # part of each diagonal element, and of the largest, that is added to it
_UNSEEN = 1e-12  # added to all, for images without a good pixel
_PROBES = 16  # random vectors for a trace


class Explicit:
    """Gauss and Newton's matrix A of the coefficients at a point, without the prior."""

    def __init__(self, point: Point, lit: NDArray[np.bool_]) -> None:
        self._point, self.where = point, np.nonzero(lit)
        rows, columns = (one.astype(np.int32) for one in self.where)
        size = point.problem.phase_map.size
        # Place of each pair of coefficients in a map of covariances.
        self.pairs = (rows[:, None] - rows) % size * size + (columns[:, None] - columns) % size
        self._number = np.full(lit.shape, -1)
        self._number[lit] = np.arange(len(self.where[0]))
        segments = point.problem.phase_map.segments
        self.steps = segments.maps[:, lit].T if segments else np.zeros((len(rows), 0))
        edges = self._edges()
        near, into, along = self._near(edges), *self._dimple(edges)
        half = (near.T @ into + along.T @ (into.T @ into) / 2) @ along
        matrix = (near.T @ near).toarray() + half + half.T
        self.diagonal = np.diagonal(matrix).copy()
        matrix[np.diag_indices_from(matrix)] += _DAMPED[0] * self.diagonal + _DAMPED[1] * matrix.max() + _UNSEEN
        lower = linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
        self.log_determinant = 2 * float(np.sum(np.log(np.diagonal(lower))))
        self.inverse = linalg.lapack.dpotri(lower, lower=True)[0].T  # its upper triangle, row by row

    @classmethod
    def of(cls, point: Point) -> Explicit | None:
        """Matrix at a point, or None for a pupil of too many pixels."""
        lit = _lit(point.light, point.problem.camera.f)
        return cls(point, lit) if np.count_nonzero(lit) <= _MOST else None

    @staticmethod
    def suits(light: NDArray, f: int) -> bool:
        """Whether the pupil of a map of light has few enough pixels."""
        return bool(np.count_nonzero(_lit(light, f)) <= _MOST)

    def best(self, point: Point) -> NDArray[np.float64]:
        """Coefficients that explain the images best without a prior, to first order at a point nearby."""
        problem, phase_map, white = point.problem, point.problem.phase_map, point.problem.split(point.x)[0][0]
        slope = point.model.adjoint(problem.weights * point.residuals).phase
        gradient = (phase_map.along.T @ slope @ phase_map.along)[self.where]
        coefficients = phase_map.coefficients(white)[self.where]
        if phase_map.segments:
            steps = phase_map.steps(white) if phase_map.stepped else np.zeros(self.steps.shape[1])
            gradient = np.append(gradient, phase_map.segments.adjoint(slope) - self.steps.T @ gradient)
            coefficients = np.append(coefficients + self.steps @ steps, steps)
        return coefficients - linalg.blas.dsymv(1.0, self.inverse.T, gradient, lower=True)

    def _edges(self) -> NDArray[np.float64]:
        """What the spline of the means of each step lacks, (n_steps, n, n) on the fine grid."""
        phase_map, n_steps = self._point.problem.phase_map, self.steps.shape[1]
        if not phase_map.segments:
            return np.zeros((0, *self._point.phase.shape))
        coefficients = np.zeros((n_steps, phase_map.size, phase_map.size))
        coefficients[:, self.where[0], self.where[1]] = self.steps.T
        return phase_map.segments.fine(np.eye(n_steps)) - phase_map.along @ coefficients @ phase_map.along.T

    def _near(self, edges: NDArray) -> sparse.csr_array:
        """Change of the residuals with each coefficient and step, without the light of the dimple."""
        point, along = self._point, self._point.problem.phase_map.along
        model, zero, starts = point.matrix.model, np.zeros_like(point.phase), np.arange(_APART)
        combs = np.array([along[:, start : len(self._number) : _APART].sum(axis=1) for start in starts])
        fine = (combs[:, None, :, None] * combs[:, None, :]).reshape(-1, *zero.shape)
        parts = [model.apply(zero, zero, few, dimple=False) for few in np.split(fine, len(fine) // _TOGETHER)]
        changes = (point.problem.weights * np.concatenate(parts)).reshape(len(fine), -1)
        column = np.concatenate([self._owners(exposure.arm) for exposure in model.camera.exposures], axis=1)
        row = np.broadcast_to(np.arange(column.shape[1]), column.shape)
        seen = (column >= 0) & (changes != 0)
        size = column.shape[1], len(self.where[0])
        near = sparse.csr_array((changes[seen], (row[seen], column[seen])), size)
        if not len(edges):
            return near
        parts = [
            (point.problem.weights * model.apply(zero, zero, few, dimple=False)).reshape(len(few), -1)
            for few in np.array_split(edges, -(-len(edges) // _TOGETHER))
        ]
        changes = np.concatenate(parts).T
        changes[np.abs(changes) < _FAINTEST * np.abs(changes).max()] = 0
        return sparse.hstack([near, sparse.csr_array(changes)], format="csr")

    def _owners(self, arm: int) -> NDArray[np.intp]:
        """Number of the coefficient of each comb next to each pixel, (n_combs, n_pixels); -1 if it is dark."""
        n, starts = len(self._number), np.arange(_APART)[:, None]
        places = (one + (n - 1) / 2 for one in self._point.matrix.model.optics.splines[arm].places)
        row, column = (starts + _APART * np.rint((one - starts) / _APART).astype(int) for one in places)
        padded = np.pad(self._number, 1, constant_values=-1)
        row, column = (np.clip(one, -1, n) + 1 for one in (row, column))
        return padded[row[:, None], column].reshape(_APART**2, -1)

    def _dimple(self, edges: NDArray) -> tuple[NDArray, NDArray]:
        """Change of the residuals with the light of the dimple, and of that light with coefficients and steps."""
        problem, model = self._point.problem, self._point.matrix.model
        _, strength, basis = linalg.svd(np.concatenate([core[0] for core in model.optics.cores.values()]))
        basis = basis[: np.count_nonzero(strength > _FAINTEST * strength[0])]
        fields = model.camera.planes[0].expand(basis) * model.phase_slope
        along = problem.phase_map.along
        moved = (along.T @ fields @ along)[:, self.where[0], self.where[1]]
        if len(edges):
            moved = np.hstack([moved, fields.reshape(len(fields), -1) @ edges.reshape(len(edges), -1).T])
        images = problem.weights * model.of_dimple(np.concatenate([basis.conj(), 1j * basis.conj()]))
        return images.reshape(len(images), -1).T, np.concatenate([moved.real, moved.imag])


def _lit(light: NDArray, f: int) -> NDArray[np.bool_]:
    """Pixels whose coefficients are unknown, from the light on the fine grid."""
    return np.asarray(ndimage.binary_dilation(pooled(light, f) > 0.01))


class Posterior:
    """Gauss and Newton's matrix with a prior, I + B^T A B, where B takes white numbers to coefficients.

    Its inverse is I - B^T (A^-1 + B B^T)^-1 B.
    """

    def __init__(self, data: Explicit, prior: PhaseMap) -> None:
        self._data, self._prior, n_steps = data, prior, data.steps.shape[1]
        self._covariance = fft.irfft2(prior.spline**2, s=(prior.size,) * 2).take(data.pairs)
        if n_steps:
            self._covariance = np.pad(self._covariance, (0, n_steps))
            self._steps = prior.prior.jumps * np.concatenate([data.steps, np.eye(n_steps)])
            self._covariance += self._steps @ self._steps.T
        total = data.inverse + self._covariance
        self._factor = linalg.cho_factor(total.T, lower=True, overwrite_a=True, check_finite=False)
        self.log_determinant = data.log_determinant + 2 * float(np.sum(np.log(np.diagonal(self._factor[0]))))

    @cached_property
    def determined(self) -> float:
        """Number of white numbers that the images determine."""
        probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(self._covariance), _PROBES))
        return float(np.vdot(probes, self._solve(self._covariance @ probes))) / _PROBES

    def evidence(self, best: NDArray) -> tuple[float, tuple[float, ...]]:
        """Minus the logarithm of the evidence of the prior but for a constant, and the growths of its variances.

        `best` are the coefficients that explain the images best. With them, the least cost has a closed form.
        """
        v = self._solve(best)
        squares, determined = float(v @ self._covariance @ v), self.determined
        evidence = (float(best @ v) + self.log_determinant) / 2
        if not self._prior.stepped:
            return evidence, (growth_of(squares, determined),)
        jumped = float(np.sum((self._steps.T @ v) ** 2))
        fixed = float(np.sum(self._steps * self._solve(self._steps)))
        return evidence, (growth_of(squares - jumped, determined - fixed), growth_of(jumped, fixed))

    def inverse(self, r: NDArray) -> NDArray[np.float64]:
        """Inverse of the matrix times vectors."""
        return r - self._white(self._solve(self._coefficients(r).T).T)

    def scale(self, d: NDArray) -> NDArray[np.float64]:
        """Matrix of the damping times vectors."""
        return self._white(self._data.diagonal * self._coefficients(d))

    def _solve(self, right: NDArray) -> NDArray[np.float64]:
        return linalg.cho_solve(self._factor, right, check_finite=False)

    def _coefficients(self, white: NDArray) -> NDArray[np.float64]:
        rows, columns = self._data.where
        coefficients = self._prior.coefficients(white)[..., rows, columns]
        if not self._data.steps.shape[1]:
            return coefficients
        coefficients = np.pad(coefficients, [(0, 0)] * (white.ndim - 1) + [(0, self._data.steps.shape[1])])
        if self._prior.stepped:
            coefficients += white[..., self._prior.size**2 :] @ self._steps.T
        return coefficients

    def _white(self, coefficients: NDArray) -> NDArray[np.float64]:
        """Adjoint of `_coefficients`."""
        maps = np.zeros((*coefficients.shape[:-1], self._prior.size, self._prior.size))
        rows, columns = self._data.where
        maps[..., rows, columns] = coefficients[..., : len(rows)]
        white = self._prior.filtered(maps)
        return np.concatenate([white, coefficients @ self._steps], axis=-1) if self._prior.stepped else white
