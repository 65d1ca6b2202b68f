"""Fisher information of frames about the field in the pupil, as a diagonal plus a matrix of low rank.

A change of the field psi by sum_c t_c x_c, with real unknowns x_c at every point of the pupil and tangents t_c,
changes the frame |o_k|^2, o_k = psi + V C_k U^T psi, of mask k by (`eq-jacobian`)

    dI_k = sum_c D_kc x_c + H_k y,    D_kc = 2 Re(conj(o_k) t_c),    y = K^T x,

where y holds the real and imaginary part of U^T (sum_c t_c x_c), and H_k = 2 [Re(conj(o_k) V C_k), -Im(...)]. With
weights W the information is diagonal but for a matrix of rank 4 r (`eq-information`):

    F = sum_k D_k^T W D_k + K B^T + B K^T + K M K^T,    B = sum_k D_k^T W H_k,    M = sum_k H_k^T W H_k.

With several wavelengths every sum over fields is one over wavelengths, too: H_k, K and B get columns for each, so
that the rank is 4 r n_wavelengths.

The columns of K and B are smooth functions times maps. All their inner products are therefore those of pairs of
functions of y and pairs of functions of x, and no matrix of a size n_points x r is ever stored.

Shapes: k frame sets, c unknowns per point (1: phase; 2: phase and amplitude), maps (ny, nx) on the pupil and
(ny', nx') on the detector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add, mul
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Immutable, Kind, per_kind
from zwfs._lowrank import Factors
from zwfs._propagator import SensorParts
from zwfs.pupil import Pupil

_SMALLEST = 1e-12  # of the diagonal, relative to its mean: a point that no frame shows has no information


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Products of two functions f_i(y) g_j(x) of a grid, and sums over maps of their products."""

    along_y: NDArray  # (a, ny)
    along_x: NDArray  # (b, nx)
    pairs_y: NDArray  # (a (a + 1) / 2, ny), products of two functions of the axis
    pairs_x: NDArray  # (b (b + 1) / 2, nx)
    unfold_y: NDArray  # (a * a, a (a + 1) / 2), one where an ordered pair is that unordered pair
    unfold_x: NDArray  # (b * b, b (b + 1) / 2)

    @classmethod
    def of(cls, along_y: NDArray, along_x: NDArray, kind: Kind) -> _Pairs:
        (pairs_y, unfold_y), (pairs_x, unfold_x) = _products(along_y), _products(along_x)
        return cls(*map(kind.array, (along_y, along_x, pairs_y, pairs_x, unfold_y, unfold_x)))

    def project(self, maps: NDArray, xp: Any) -> NDArray:
        """Inner products of maps with all functions: (..., ny, nx) to (..., a * b)."""
        return xp.reshape(self.along_y @ maps @ self.along_x.T, (*maps.shape[:-2], -1))

    def expand(self, coefficients: NDArray, xp: Any) -> NDArray:
        """Sums of all functions: (..., a * b) to (..., ny, nx)."""
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


@dataclass(frozen=True, eq=False)
class _Columns:
    """Sets of columns, (n, m) each, of which a set has zeros outside of a span: only the span is stored."""

    blocks: list[NDArray]  # (n, width of the span)
    spans: list[slice]
    size: int  # m

    @classmethod
    def of(cls, sets: NDArray, kind: Kind) -> _Columns:
        """Sets of columns from an array (s, n, m)."""
        used = [np.flatnonzero(np.any(columns, axis=0)) for columns in sets]
        spans = [slice(int(places.min(initial=0)), int(places.max(initial=-1)) + 1) for places in used]
        blocks = [
            kind.array(np.ascontiguousarray(columns[:, span])) for columns, span in zip(sets, spans, strict=True)
        ]
        return cls(blocks, spans, sets.shape[-1])

    def products(self, coefficients: Sequence[NDArray], kind: Kind) -> NDArray:
        """Sum over the sets of coefficients times columns: (..., n) for each set to (..., m)."""
        total = kind.zeros(*coefficients[0].shape[:-1], self.size)
        for factors, block, span in zip(coefficients, self.blocks, self.spans, strict=True):
            total[..., span] += factors @ block
        return total

    def congruent(self, pairs: NDArray, kind: Kind) -> NDArray:
        """X^T Q X of columns X for all pairs of sets: Q of (k, pairs, n, n) to (k, m, m)."""
        total = kind.zeros(pairs.shape[0], self.size, self.size)
        for index, (i, j) in enumerate(_pairs_of(len(self.blocks))):
            part = self.blocks[i].T @ pairs[:, index, ...] @ self.blocks[j]
            total[:, self.spans[i], self.spans[j]] += part
            if i != j:
                total[:, self.spans[j], self.spans[i]] += kind.xp.matrix_transpose(part)
        return total


class Response(Immutable):
    """Low-rank response of the frames of a sensor to its field, from which the information is made.

    Parameters
    ----------
    factors : Factors
        Of the sensor, or fewer of them for an approximation.
    window : (slice, slice)
        Rows and columns of the detector in which the grid of the pupil lies.
    pupil : Pupil
    ratios : tuple of float
        Reference wavelength over each wavelength.
    """

    def __init__(
        self, factors: Factors, window: tuple[slice, slice], pupil: Pupil, ratios: tuple[float, ...] = (1.0,)
    ) -> None:
        self._factors, self._window, self._pupil, self._ratios = factors, window, pupil, ratios

    @classmethod
    def of(cls, sensor: SensorParts) -> Response:
        """Response of a sensor."""
        return cls(sensor.factors, sensor.window, sensor.pupil, sensor.channels.ratios)

    @per_kind
    def constants(self, kind: Kind) -> _Constants:
        """Arrays of one kind."""
        inner, outer = self._factors.pupil, self._factors.detector
        q, r = self._factors.core.shape[-2:]
        cores = self._factors.core.reshape(-1, len(self._ratios), q, r)
        turns, bases = zip(*(_bases(cores[:, index]) for index in range(len(self._ratios))), strict=True)
        n_inputs = 2 * r * len(self._ratios)
        split = _side_by_side([base.reshape(-1, q, 2 * r) for base in bases])  # (n_sets, q, n_inputs)
        # The functions of the detector, on the grid of the pupil, are sums of those of the pupil.
        cut = outer.cut(*self._window)
        to_y, to_x = cut.along_y @ inner.along_y.T, cut.along_x @ inner.along_x.T
        to_inner = np.einsum("ia,jb,ijq->abq", to_y, to_x, outer.combine.reshape(len(to_y), len(to_x), q))
        to_inner = to_inner.reshape(-1, q)
        n_parts = 2 * len(self._ratios)
        columns = np.zeros((n_parts + len(split), len(inner.combine), 2 * n_inputs))
        columns[:n_parts, :, :n_inputs] = _side_by_side([inner.combine[np.newaxis]] * n_parts)
        columns[n_parts:, :, n_inputs:] = to_inner @ split
        return _Constants(
            kind=kind,
            n_points=self._pupil.n_points,
            window=self._window,
            ratios=self._ratios,
            stop=kind.array(self._pupil.inside),
            outside=kind.array(np.where(self._pupil.inside, _SMALLEST, 1.0)),
            inner=_Pairs.of(inner.along_y, inner.along_x, kind),
            outer=_Pairs.of(outer.along_y, outer.along_x, kind),
            columns=_Columns.of(columns, kind),
            detector=_Columns.of(outer.combine @ split, kind),
            turns=turns,
        )

    def information(self, tangents: NDArray, waves: NDArray, weights: NDArray | None) -> Information:
        """Information at a field.

        Parameters
        ----------
        tangents : array, shape (k, c, 2 n_wavelengths, ny, nx)
            Changes of the field per unit of the unknowns, as split fields; 0 outside the pupil.
        waves : array, shape (k, n_masks, 2 n_wavelengths, ny', nx')
            Fields on the detector.
        weights : array, shape (k, n_masks, ny', nx'), or None
            Inverse variances of the frames; 1 if left out.
        """
        return Information.of(self.constants(Kind.of(waves)), tangents, waves, weights)


@dataclass(frozen=True, eq=False)
class _Constants:
    kind: Kind
    n_points: int
    window: tuple[slice, slice]
    ratios: tuple[float, ...]  # reference wavelength over each wavelength
    stop: NDArray  # (ny, nx), 1 in the pupil
    outside: NDArray  # (ny, nx), 1 outside, and the smallest share of information inside
    inner: _Pairs
    outer: _Pairs
    columns: _Columns  # s sets, (a * b, 4 r n_wavelengths): functions times maps to columns of K and B
    detector: _Columns  # n_sets, (a' * b', 2 r n_wavelengths), the same for H
    turns: tuple[NDArray[np.complex128], ...]  # (n_masks, n) for each wavelength: factors of the cores of a mask


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information F at a field, for k frame sets: see the head of this module.

    Maps have shape (k, ny, nx). Lists of maps have one entry for each unknown of a point.
    """

    constants: _Constants
    local: list[list[NDArray]]  # diagonal blocks sum_k D_k^T W D_k; outside the pupil multiples of 1
    sets: list[list[NDArray]]  # factors of the columns of K, then of B: real and imaginary part
    gram: NDArray  # (k, 2 r n_wavelengths, 2 r n_wavelengths), M
    scale: NDArray  # (k, 1, 1), mean over the pupil of the diagonal for the phase

    @classmethod
    def of(cls, constants: _Constants, tangents: NDArray, waves: NDArray, weights: NDArray | None) -> Information:
        """Sum the contributions of all masks."""
        xp, window, n_unknowns = constants.kind.xp, constants.window, tangents.shape[1]
        unknowns = range(n_unknowns)
        parts = [[tangents[:, c, part, ...] for c in unknowns] for part in range(tangents.shape[2])]
        pairs: list[Any] = []
        local: list[Any] = []
        mixed: list[Any] = []
        for mask in range(waves.shape[1]):
            wave = waves[:, mask, ...]
            # dI per unit of the real and imaginary part of a coefficient: 2 Re and -2 Im of conj(o) times the turn
            along = [
                (2 * t.real) * wave[:, 2 * index, ...] + (2 * t.imag) * wave[:, 2 * index + 1, ...]
                for index, turns in enumerate(constants.turns) for turn in turns[mask] for t in (turn, turn * 1j)
            ]  # fmt: skip
            n_sets = len(along)
            weight: Any = None if weights is None else weights[:, mask, ...]
            weighted = along if weight is None else [weight * slope for slope in along]
            inside = 2 * wave[(..., *window)]
            change = [
                reduce(add, (inside[:, part, ...] * tangent[c] for part, tangent in enumerate(parts)))
                for c in unknowns
            ]
            heavy = change if weight is None else [weight[(..., *window)] * slope for slope in change]
            _accumulate(pairs, [along[i] * weighted[j] for i, j in _pairs_of(n_sets)])
            _accumulate(local, [change[i] * heavy[j] for i in unknowns for j in unknowns])
            _accumulate(mixed, [along[s][(..., *window)] * heavy[c] for s in range(n_sets) for c in unknowns])
        gram = constants.detector.congruent(constants.outer.gram(xp.stack(pairs, axis=1), xp), constants.kind)
        scale = xp.sum(local[0], axis=(-2, -1))[:, np.newaxis, np.newaxis] / constants.n_points
        blocks = [local[c * n_unknowns : (c + 1) * n_unknowns] for c in unknowns]
        for c in unknowns:
            blocks[c][c] += scale * constants.outside
        sets = [*parts, *(mixed[s * n_unknowns : (s + 1) * n_unknowns] for s in range(n_sets))]
        return cls(constants, blocks, sets, gram, scale)

    def inverse(self, damping: NDArray | float = 0.0) -> Inverse:
        """Inverse of F with `damping`, (k, 1, 1), added to its diagonal, and the piston fixed.

        No frame shows the piston of the phase, F 1 = 0 (`eq-gauge`). A gauge, 1 1^T scale / n_points, is added to
        F. It gives the piston as much information as a point has on average, and changes nothing else.
        """
        constants, xp = self.constants, self.constants.kind.xp
        local = _inverse_blocks(self.local, damping)
        scaled = [_times(local, maps) for maps in self.sets]
        pairs = [_dot(self.sets[i], scaled[j]) for i, j in _pairs_of(len(self.sets))]
        products = constants.inner.gram(xp.stack(pairs, axis=1), xp)
        capacitance = constants.columns.congruent(products, constants.kind)
        rank = self.gram.shape[-1]
        eye = constants.kind.array(np.eye(rank))
        capacitance[:, :rank, rank:] += eye
        capacitance[:, rank:, :rank] += eye
        capacitance[:, rank:, rank:] -= self.gram
        gauge = xp.sqrt(self.scale / constants.n_points) * constants.stop
        piston = [block * gauge for block in local[0]]
        cross = self._project(piston)[..., np.newaxis]
        corner = 1 + xp.sum(gauge * piston[0], axis=(-2, -1))[:, np.newaxis, np.newaxis]
        capacitance = xp.concat(
            [xp.concat([capacitance, cross], axis=2), xp.concat([xp.matrix_transpose(cross), corner], axis=2)],
            axis=1,
        )
        return Inverse(self, local, scaled, gauge, piston, capacitance)

    def onto(self, modes: NDArray) -> NDArray:
        """Information about the coefficients of modes of the phase, maps (m, ny, nx): (k, m, m).

        There is no gauge: a mode that is a piston has no information.
        """
        constants, xp = self.constants, self.constants.kind.xp
        flat = xp.reshape(modes, (modes.shape[0], -1))
        local = xp.reshape(self.local[0][0], (self.gram.shape[0], 1, -1))
        products = [constants.inner.project(modes * maps[0][:, np.newaxis, ...], xp) for maps in self.sets]
        columns = constants.columns.products(products, constants.kind)  # (k, m, 4 r), of K and B with the modes
        rank = self.gram.shape[-1]
        inputs, mixed = columns[..., :rank], columns[..., rank:]
        cross = mixed @ xp.matrix_transpose(inputs)
        inputs = inputs @ self.gram @ xp.matrix_transpose(inputs)
        return (flat * local) @ flat.T + cross + xp.matrix_transpose(cross) + inputs

    def _project(self, unknowns: list[NDArray]) -> NDArray:
        """Products of the columns of K and B with maps of the unknowns: (k, 4 r)."""
        constants = self.constants
        products = [constants.inner.project(_dot(maps, unknowns), constants.kind.xp) for maps in self.sets]
        return constants.columns.products(products, constants.kind)


@dataclass(frozen=True, eq=False)
class Inverse:
    """Inverse of a Fisher information, by Woodbury's identity (`eq-woodbury`)."""

    information: Information
    local: list[list[NDArray]]  # inverse of the diagonal blocks
    scaled: list[list[NDArray]]  # that times the maps of the columns
    gauge: NDArray  # (k, ny, nx), column of the gauge
    piston: list[NDArray]  # local times that
    capacitance: NDArray  # (k, 4 r + 1, 4 r + 1)

    def __matmul__(self, right: list[NDArray]) -> list[NDArray]:
        """Solve F x = right: lists of maps."""
        info, xp = self.information, self.information.constants.kind.xp
        first = _times(self.local, right)
        piston = xp.sum(self.gauge * first[0], axis=(-2, -1))[:, np.newaxis]
        sides = xp.concat([info._project(first), piston], axis=1)
        weights = xp.linalg.solve(self.capacitance, sides[..., np.newaxis])[..., 0]
        return [local - shared for local, shared in zip(first, self._expand(weights), strict=True)]

    def variance(self) -> list[NDArray]:
        """Diagonal of F^-1 without the piston: a list of maps, without meaning outside the pupil."""
        info, constants = self.information, self.information.constants
        xp, columns = constants.kind.xp, constants.columns
        inverse = xp.linalg.inv(self.capacitance)
        forms = []
        for i, j in _pairs_of(len(columns.blocks)):
            block = columns.blocks[i] @ inverse[:, columns.spans[i], columns.spans[j]] @ columns.blocks[j].T
            forms.append(block if i == j else block + xp.matrix_transpose(block))  # a form of a symmetric matrix
        maps = constants.inner.forms(xp.stack(forms, axis=1), xp)
        cross = self._expand(xp.concat([inverse[:, :-1, -1], xp.zeros_like(inverse[:, :1, -1])], axis=1))
        variance = []
        for c, (own, crossed) in enumerate(zip(self.piston, cross, strict=True)):
            total = self.local[c][c] - own * (2 * crossed + inverse[:, -1:, -1:] * own)
            for index, (i, j) in enumerate(_pairs_of(len(columns.blocks))):
                total = total - self.scaled[i][c] * self.scaled[j][c] * maps[:, index, ...]
            variance.append(total)
        variance[0] = variance[0] - 1 / (info.scale * constants.n_points)
        # Where the frames show nothing, rounding decides even the sign.
        return [xp.where(values >= 0, values, constants.kind.array(np.inf)) for values in variance]

    def _expand(self, weights: NDArray) -> list[NDArray]:
        """Sum of the columns times the inverse of the diagonal: (k, 4 r + 1) to a list of maps."""
        constants = self.information.constants
        total = [weights[:, -1:, np.newaxis] * column for column in self.piston]
        for maps, block, span in zip(self.scaled, constants.columns.blocks, constants.columns.spans, strict=True):
            wave = constants.inner.expand(weights[:, span] @ block.T, constants.kind.xp)
            _accumulate(total, [values * wave for values in maps])
        return total


def _bases(cores: NDArray[np.complex128]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Factors (n_masks, n) and split cores (n, 2, q, 2 r) whose combinations are the cores of all masks.

    The cores of dimples of one size are multiples of one another, so n is 1 for them.
    """
    turns, strength, bases = np.linalg.svd(cores.reshape(len(cores), -1), full_matrices=False)
    n = max(1, int(np.count_nonzero(strength > 1e-13 * strength[0])))
    bases = (strength[:n, np.newaxis] * bases[:n]).reshape(n, *cores.shape[1:])
    split = np.stack(
        [np.concatenate([bases.real, -bases.imag], axis=2), np.concatenate([bases.imag, bases.real], axis=2)],
        axis=1,
    )
    return turns[:, :n], split


def _side_by_side(blocks: Sequence[NDArray]) -> NDArray:
    """Stack p blocks (s, m, n) along the first axis, and give each its own n of the p n columns; the rest is 0."""
    n = blocks[0].shape[-1]
    result = np.zeros((sum(map(len, blocks)), blocks[0].shape[1], n * len(blocks)))
    first = 0
    for index, block in enumerate(blocks):
        result[first : first + len(block), :, index * n : (index + 1) * n] = block
        first += len(block)
    return result


def _pairs_of(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def _dot(first: list[NDArray], second: list[NDArray]) -> NDArray:
    """Sum over the unknowns of a point."""
    return reduce(add, map(mul, first, second))


def _accumulate(totals: list[Any], terms: list[Any]) -> None:
    """Add terms to totals in place; the first terms become the totals."""
    if not totals:
        totals += terms
        return
    for total, term in zip(totals, terms, strict=True):
        total += term


def _times(blocks: list[list[NDArray]], maps: list[NDArray]) -> list[NDArray]:
    """Blocks of every point times the unknowns."""
    return [_dot(row, maps) for row in blocks]


def _inverse_blocks(blocks: list[list[NDArray]], damping: NDArray | float) -> list[list[NDArray]]:
    """Inverse of the symmetric blocks of every point, of one or two unknowns, with `damping` on the diagonal."""
    first = blocks[0][0] + damping
    if len(blocks) == 1:
        return [[1 / first]]
    second, cross = blocks[1][1] + damping, blocks[0][1]
    determinant = first * second - cross * cross
    return [[second / determinant, -cross / determinant], [-cross / determinant, first / determinant]]
