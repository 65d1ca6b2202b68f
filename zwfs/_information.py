"""Fisher information of frames about the field in the pupil, as a diagonal plus a matrix of low rank.

A change of the field psi by sum_c t_c x_c, with real unknowns x_c at every point of the pupil and tangents t_c,
changes the frame o_k = psi + V C_k U^T psi of mask k by

    dI_k = sum_c D_kc x_c + H_k y,    D_kc = 2 Re(conj(o_k) t_c),    y = K^T x,

where y holds the real and imaginary part of U^T (sum_c t_c x_c), and H_k = 2 [Re(conj(o_k) V C_k), -Im(...)]. With
weights W the information is diagonal but for a matrix of rank 4 r (`eq-information`):

    F = sum_k D_k^T W D_k + K B^T + B K^T + K M K^T,    B = sum_k D_k^T W H_k,    M = sum_k H_k^T W H_k.

The columns of K and B are smooth functions times maps. All their inner products are therefore those of pairs of
functions of y and pairs of functions of x, and no matrix of a size n_points x r is ever stored.

Shapes: k frame sets, c unknowns per point (1: phase; 2: phase and amplitude), maps (ny, nx) on the pupil and
(ny', nx') on the detector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind, per_kind
from zwfs._pickle import Immutable
from zwfs.lowrank import Factors
from zwfs.pupil import Pupil

_SMALLEST = 1e-12  # of the diagonal, relative to its mean: a point that no frame shows has no information


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Products of two functions f_i(y) g_j(x) of a grid, and sums over maps of their products.

    Attributes
    ----------
    along_y, along_x : array, shapes (a, ny) and (b, nx)
    pairs_y, pairs_x : array, shapes (a (a + 1) / 2, ny) and (b (b + 1) / 2, nx)
        Products of two functions of an axis.
    unfold_y, unfold_x : array, shapes (a * a, a (a + 1) / 2) and (b * b, b (b + 1) / 2)
        One where an ordered pair is that unordered pair.
    """

    along_y: NDArray
    along_x: NDArray
    pairs_y: NDArray
    pairs_x: NDArray
    unfold_y: NDArray
    unfold_x: NDArray

    @classmethod
    def of(cls, along_y: NDArray, along_x: NDArray, kind: Kind) -> _Pairs:
        (pairs_y, unfold_y), (pairs_x, unfold_x) = _products(along_y), _products(along_x)
        return cls(*map(kind.array, (along_y, along_x, pairs_y, pairs_x, unfold_y, unfold_x)))

    def project(self, maps: NDArray, xp: Any) -> NDArray:
        """Inner products of maps with all functions: (k, s, ny, nx) to (k, s, a * b)."""
        return xp.reshape(self.along_y @ maps @ self.along_x.T, (*maps.shape[:-2], -1))

    def expand(self, coefficients: NDArray, xp: Any) -> NDArray:
        """Sums of all functions: (k, s, a * b) to (k, s, ny, nx)."""
        a, b = self.along_y.shape[0], self.along_x.shape[0]
        return self.along_y.T @ xp.reshape(coefficients, (*coefficients.shape[:-1], a, b)) @ self.along_x

    def gram(self, weights: NDArray, xp: Any) -> NDArray:
        """Weighted inner products of all functions: (k, s, ny, nx) to (k, s, a * b, a * b)."""
        a, b = self.along_y.shape[0], self.along_x.shape[0]
        sums = self.unfold_y @ (self.pairs_y @ weights @ self.pairs_x.T) @ self.unfold_x.T
        sums = xp.permute_dims(xp.reshape(sums, (*weights.shape[:-2], a, a, b, b)), (0, 1, 2, 4, 3, 5))
        return xp.reshape(sums, (*weights.shape[:-2], a * b, a * b))

    def forms(self, matrices: NDArray, xp: Any) -> NDArray:
        """Quadratic forms of the functions at every point, the adjoint of `gram`: same shapes, other way round."""
        a, b = self.along_y.shape[0], self.along_x.shape[0]
        sums = xp.permute_dims(xp.reshape(matrices, (*matrices.shape[:-2], a, b, a, b)), (0, 1, 2, 4, 3, 5))
        sums = self.unfold_y.T @ xp.reshape(sums, (*matrices.shape[:-2], a * a, b * b)) @ self.unfold_x
        return self.pairs_y.T @ sums @ self.pairs_x


def _products(along: NDArray) -> tuple[NDArray, NDArray]:
    """Products of all pairs of functions, and the matrix that repeats unordered pairs as ordered ones."""
    first, second = np.triu_indices(len(along))
    unfold = np.zeros((len(along), len(along), first.size))
    unfold[first, second, np.arange(first.size)] = unfold[second, first, np.arange(first.size)] = 1
    return along[first] * along[second], unfold.reshape(-1, first.size)


class Response(Immutable):
    """Low-rank response of the frames of a sensor to its field, from which the information is made.

    Parameters
    ----------
    factors : Factors
        Of the sensor, or fewer of them for an approximation.
    window : (slice, slice)
        Rows and columns of the detector in which the grid of the pupil lies.
    pupil : Pupil
    """

    def __init__(self, factors: Factors, window: tuple[slice, slice], pupil: Pupil) -> None:
        self._factors, self._window, self._pupil = factors, window, pupil

    @per_kind
    def constants(self, kind: Kind) -> _Constants:
        """Arrays of one kind."""
        inner, outer = self._factors.pupil, self._factors.detector
        # The cores of dimples of one size are multiples of one another: combine masks whose cores are.
        cores = self._factors.core
        turns, strength, bases = np.linalg.svd(cores.reshape(len(cores), -1), full_matrices=False)
        n = max(1, int(np.count_nonzero(strength > 1e-13 * strength[0])))
        turns, bases = turns[:, :n], (strength[:n, np.newaxis] * bases[:n]).reshape(n, *cores.shape[1:])
        split = np.concatenate([np.block([[c.real, -c.imag], [c.imag, c.real]]) for c in bases])  # (n 2 q, 2 r)
        q, r = cores.shape[1:]
        # The functions of the detector, on the grid of the pupil, are sums of those of the pupil.
        cut = outer.cut(*self._window)
        to_y, to_x = cut.along_y @ inner.along_y.T, cut.along_x @ inner.along_x.T
        left = np.einsum("ia,jb,ijq->abq", to_y, to_x, outer.combine.reshape(len(to_y), len(to_x), q))
        left = left.reshape(-1, q)
        columns = np.zeros((2 + 2 * n, len(inner.combine), 4 * r))
        columns[0, :, :r] = columns[1, :, r : 2 * r] = inner.combine
        columns[2:, :, 2 * r :] = left @ split.reshape(2 * n, q, 2 * r)
        detector = outer.combine @ split.reshape(2 * n, q, 2 * r)
        return _Constants(
            kind, self._pupil, self._window,
            _Pairs.of(inner.along_y, inner.along_x, kind), _Pairs.of(outer.along_y, outer.along_x, kind),
            kind.array(columns.reshape(-1, 4 * r)), kind.array(detector.reshape(-1, 2 * r)),
            kind.array(turns.real), kind.array(turns.imag), kind.array(self._pupil.inside),
        )  # fmt: skip

    def information(self, tangents: NDArray, waves: NDArray, weights: NDArray | None) -> Information:
        """Information at a field.

        Parameters
        ----------
        tangents : array, shape (k, c, 2, ny, nx)
            Changes of the field per unit of the unknowns, as split fields; 0 outside the pupil.
        waves : array, shape (k, n_masks, 2, ny', nx')
            Fields on the detector.
        weights : array, shape (k, n_masks, ny', nx'), or None
            Inverse variances of the frames; 1 if left out.
        """
        return Information.of(self.constants(Kind.of(waves)), tangents, waves, weights)


@dataclass(frozen=True, eq=False)
class _Constants:
    kind: Kind
    pupil: Pupil
    window: tuple[slice, slice]
    inner: _Pairs
    outer: _Pairs
    columns: NDArray  # (s * a * b, 4 r), functions times maps to columns of K and B
    detector: NDArray  # (2 n * a' * b', 2 r), the same for H
    turn_real: NDArray  # (n_masks, n), parts of the factors of a mask's core
    turn_imag: NDArray
    stop: NDArray


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information F at a field, for k frame sets: see the head of this module.

    Attributes
    ----------
    constants : _Constants
    local : array, shape (k, c, c, ny, nx)
        Diagonal blocks sum_k D_k^T W D_k; outside the pupil the identity.
    sets : array, shape (k, s, c, ny, nx)
        Maps of the columns of K, then of B: real and imaginary part each.
    gram : array, shape (k, 2 r, 2 r)
        M.
    scale : array, shape (k, 1, 1)
        Mean of the diagonal of the phase in the pupil.
    """

    constants: _Constants
    local: NDArray
    sets: NDArray
    gram: NDArray
    scale: NDArray

    @classmethod
    def of(cls, constants: _Constants, tangents: NDArray, waves: NDArray, weights: NDArray | None) -> Information:
        """Compute the parts of the information."""
        kind, window, stop = constants.kind, constants.window, constants.stop
        xp = kind.xp
        real, imag = waves[:, :, 0, ...], waves[:, :, 1, ...]
        n = constants.turn_real.shape[1]
        along: list[NDArray] = []  # of dI_k per unit of the coefficients of each combination of cores
        for index in range(n):
            a, b = (t[:, index][:, np.newaxis, np.newaxis] for t in (constants.turn_real, constants.turn_imag))
            along += [2 * (a * real + b * imag), 2 * (a * imag - b * real)]
        weighted = along if weights is None else [weights * one for one in along]
        pairs = [xp.sum(s * t, axis=1) for i, s in enumerate(along) for t in weighted[i:]]
        gram = _congruent(constants.outer.gram(xp.stack(pairs, axis=1), xp), constants.detector, 2 * n, xp)
        real, imag = (part[(..., *window)][:, :, np.newaxis, ...] for part in (real, imag))
        local_change = 2 * (real * tangents[:, np.newaxis, :, 0, ...] + imag * tangents[:, np.newaxis, :, 1, ...])
        weighted_change = (
            local_change if weights is None
            else local_change * weights[(..., *window)][:, :, np.newaxis, ...]
        )  # fmt: skip
        c = tangents.shape[1]
        local = xp.empty((tangents.shape[0], c, c, *stop.shape), dtype=kind.dtype, device=kind.device)
        for i in range(c):
            for j in range(i, c):
                block = xp.sum(local_change[:, :, i, ...] * weighted_change[:, :, j, ...], axis=1)
                local[:, i, j, ...] = local[:, j, i, ...] = block
        mixed = [
            xp.sum(weighted_change * one[(..., *window)][:, :, np.newaxis, ...], axis=1) for one in along
        ]
        sets = xp.stack([tangents[:, :, 0, ...], tangents[:, :, 1, ...], *mixed], axis=1)
        scale = xp.sum(local[:, 0, 0, ...], axis=(-2, -1)) / constants.pupil.n_points
        scale = scale[:, np.newaxis, np.newaxis]
        for i in range(c):
            local[:, i, i, ...] += _SMALLEST * scale + (1 - stop) * scale
        return cls(constants, local, sets, gram, scale)

    def inverse(self, damping: NDArray | float = 0.0) -> Inverse:
        """Inverse of F with `damping`, (k, 1, 1), added to its diagonal, and the piston fixed.

        No frame shows the piston of the phase, F 1 = 0. A gauge of unit strength, 1 1^T scale / n_points, is added
        to F. It changes nothing else.
        """
        constants, kind, xp = self.constants, self.constants.kind, self.constants.kind.xp
        c = self.local.shape[1]
        if c == 1:
            local = 1 / (self.local[:, 0, 0, ...] + damping)
            local = local[:, np.newaxis, np.newaxis, ...]
        else:
            first, cross, second = self.local[:, 0, 0, ...] + damping, self.local[:, 0, 1, ...], self.local[:, 1, 1, ...]
            second = second + damping
            determinant = first * second - cross * cross
            rows = [[second, -cross], [-cross, first]]
            local = xp.stack([xp.stack([e / determinant for e in row], axis=1) for row in rows], axis=1)
        scaled = _apply(local, self.sets, xp)
        pairs = [
            xp.sum(self.sets[:, i, ...] * scaled[:, j, ...], axis=1)
            for i in range(self.sets.shape[1]) for j in range(i, self.sets.shape[1])
        ]  # fmt: skip
        rank = self.gram.shape[-1]
        capacitance = xp.empty((local.shape[0], 2 * rank + 1, 2 * rank + 1), dtype=kind.dtype, device=kind.device)
        capacitance[:, :-1, :-1] = _congruent(
            constants.inner.gram(xp.stack(pairs, axis=1), xp), constants.columns, self.sets.shape[1], xp
        )
        eye = kind.array(np.eye(rank))
        capacitance[:, :rank, rank:-1] += eye
        capacitance[:, rank:-1, :rank] += eye
        capacitance[:, rank:-1, rank:-1] -= self.gram
        gauge = xp.sqrt(self.scale / constants.pupil.n_points) * constants.stop
        piston = local[:, 0, ...] * gauge[:, np.newaxis, ...]
        cross = self._project(piston)
        capacitance[:, :-1, -1] = capacitance[:, -1, :-1] = cross
        capacitance[:, -1, -1] = 1 + xp.sum(gauge * piston[:, 0, ...], axis=(-2, -1))
        return Inverse(self, local, scaled, gauge, piston, capacitance)

    def onto(self, modes: NDArray) -> NDArray:
        """Information about the coefficients of modes, maps (m, ny, nx) of the phase: (k, m, m).

        There is no gauge: a mode that is a piston has no information.
        """
        constants, xp = self.constants, self.constants.kind.xp
        flat = xp.reshape(modes, (modes.shape[0], -1))
        local = xp.reshape(self.local[:, 0, 0, ...], (self.local.shape[0], 1, -1))
        n_sets, n = self.sets.shape[1], constants.columns.shape[0] // self.sets.shape[1]
        columns: Any = 0  # (k, m, 4 r), products of the columns of K and B with the modes
        for index in range(n_sets):
            products = constants.inner.project(modes * self.sets[:, index, 0, np.newaxis, ...], xp)
            columns = columns + products @ constants.columns[index * n : (index + 1) * n, :]
        rank = self.gram.shape[-1]
        inputs, mixed = columns[..., :rank], columns[..., rank:]
        cross = mixed @ xp.matrix_transpose(inputs)
        inputs = inputs @ self.gram @ xp.matrix_transpose(inputs)
        return (flat * local) @ flat.T + cross + xp.matrix_transpose(cross) + inputs

    def _project(self, scaled: NDArray) -> NDArray:
        """Products of the columns of K and B with unknowns: (k, c, ny, nx) to (k, 4 r)."""
        constants, xp = self.constants, self.constants.kind.xp
        maps = xp.sum(self.sets * scaled[:, np.newaxis, ...], axis=2)
        return xp.reshape(constants.inner.project(maps, xp), (maps.shape[0], -1)) @ constants.columns


@dataclass(frozen=True, eq=False)
class Inverse:
    """Inverse of a Fisher information, by Woodbury's identity (`eq-woodbury`)."""

    information: Information
    local: NDArray  # (k, c, c, ny, nx), inverse of the diagonal blocks
    scaled: NDArray  # (k, s, c, ny, nx), local times the maps of the columns
    gauge: NDArray  # (k, ny, nx), column of the gauge
    piston: NDArray  # (k, c, ny, nx), local times that
    capacitance: NDArray  # (k, 4 r + 1, 4 r + 1)

    def __matmul__(self, right: NDArray) -> NDArray:
        """Solve F x = right: both (k, c, ny, nx)."""
        info, xp = self.information, self.information.constants.kind.xp
        first = _apply(self.local, right[:, np.newaxis, ...], xp)[:, 0, ...]
        sides = xp.concat(
            [info._project(first), xp.sum(self.gauge * first[:, 0, ...], axis=(-2, -1))[:, np.newaxis]], axis=1
        )
        weights = xp.linalg.solve(self.capacitance, sides[..., np.newaxis])[..., 0]
        return first - self._expand(weights)

    def variance(self) -> NDArray:
        """Diagonal of F^-1 without the piston: (k, c, ny, nx); NaN-free, without meaning outside the pupil."""
        info, constants = self.information, self.information.constants
        xp, n_sets = constants.kind.xp, self.scaled.shape[1]
        inverse = xp.linalg.inv(self.capacitance)
        inner = constants.columns @ inverse[:, :-1, :-1] @ constants.columns.T
        n = constants.columns.shape[0] // n_sets
        inner = xp.permute_dims(xp.reshape(inner, (-1, n_sets, n, n_sets, n)), (0, 1, 3, 2, 4))
        pairs = [(i, j) for i in range(n_sets) for j in range(i, n_sets)]
        blocks = [inner[:, i, j, ...] * (1 if i == j else 2) for i, j in pairs]
        forms = constants.inner.forms(xp.stack([(b + xp.matrix_transpose(b)) / 2 for b in blocks], axis=1), xp)
        c = self.local.shape[1]
        variance = xp.stack([self.local[:, i, i, ...] for i in range(c)], axis=1)
        for index, (i, j) in enumerate(pairs):
            variance -= self.scaled[:, i, ...] * self.scaled[:, j, ...] * forms[:, index, ...][:, np.newaxis, ...]
        cross = self._expand(xp.concat([inverse[:, :-1, -1], 0 * inverse[:, :1, -1]], axis=1))
        variance -= (2 * cross + self.piston * inverse[:, -1:, -1:][..., np.newaxis]) * self.piston
        variance[:, 0, ...] -= 1 / (info.scale * constants.pupil.n_points)
        return variance

    def _expand(self, weights: NDArray) -> NDArray:
        """Sum of the columns, each times the inverse of the diagonal: (k, 4 r + 1) to (k, c, ny, nx)."""
        constants, n_sets = self.information.constants, self.scaled.shape[1]
        xp = constants.kind.xp
        coefficients = xp.reshape(weights[:, :-1] @ constants.columns.T, (weights.shape[0], n_sets, -1))
        maps = constants.inner.expand(coefficients, xp)
        total = xp.sum(self.scaled * maps[:, :, np.newaxis, ...], axis=1)
        return total + weights[:, -1][:, np.newaxis, np.newaxis, np.newaxis] * self.piston


def _apply(blocks: NDArray, maps: NDArray, xp: Any) -> NDArray:
    """Blocks of every point times unknowns: (k, c, c, ny, nx) and (k, s, c, ny, nx) to (k, s, c, ny, nx)."""
    if blocks.shape[1] == 1:
        return blocks * maps
    return xp.sum(blocks[:, np.newaxis, ...] * maps[:, :, np.newaxis, ...], axis=3)


def _congruent(pairs: NDArray, columns: NDArray, n_sets: int, xp: Any) -> NDArray:
    """Return columns^T Q columns for the unordered pairs of sets: (k, pairs, n, n) to (k, m, m)."""
    n, total = pairs.shape[-1], None
    for index, (i, j) in enumerate((i, j) for i in range(n_sets) for j in range(i, n_sets)):
        left, right = columns[i * n : (i + 1) * n, :], columns[j * n : (j + 1) * n, :]
        part = left.T @ pairs[:, index, ...] @ right
        part = part if i == j else part + xp.matrix_transpose(part)
        total = part if total is None else total + part
    return total
