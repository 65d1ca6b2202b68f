"""Segments of a pupil, whose pistons, tips and tilts make a phase jump at gaps."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from zwfs._images import nearest_good, parts_of
from zwfs.frames._optics import pooled

if TYPE_CHECKING:
    from zwfs.frames._fit import FrameModel

_FULL = 0.7  # least light of a pixel that lies in one segment
_LIT = 0.1  # least light of a pixel of the pupil
_LEAST_GAP = 0.3  # light that a gap takes from pixels, below which its line is not looked for
_SHORTEST = 6  # pixels next to a gap, with fewer of which its line is not looked for


class Segments:
    """Piston, tip and tilt of each segment, of unit rms."""

    def __init__(self, numbers: NDArray[np.intp], fine: NDArray[np.intp]) -> None:
        """Take the number of the segment of each pixel that lies in one, from 1 on, and 0 elsewhere.

        `fine` has the number of the segment of each point of the fine grid.
        """
        self.numbers, self.lit, oversampling = numbers, numbers > 0, len(fine) // len(numbers)
        lit, own = np.kron(self.lit, np.ones((oversampling,) * 2, bool)).ravel(), fine.ravel() - 1
        count = np.bincount(own[lit])
        columns = [np.ones(own.shape)]
        for place in np.indices(fine.shape, float).reshape(2, -1):
            place = place - (np.bincount(own[lit], place[lit]) / count)[own]
            spread = np.sqrt(np.bincount(own[lit], place[lit] ** 2) / count)
            columns.append(place / np.maximum(spread, 0.5)[own])  # one point wide, a segment has no slope
        rows, places = np.repeat(np.arange(own.size), 3), np.stack([3 * own + k for k in range(3)], axis=1)
        shape = own.size, 3 * len(count)
        self.matrix = sparse.csr_array((np.stack(columns, axis=1).ravel(), (rows, places.ravel())), shape)
        side = len(fine)
        self.maps = pooled(self.matrix.T.toarray().reshape(-1, side, side), oversampling)

    @classmethod
    def of(cls, model: FrameModel) -> Segments | None:
        """Segments between which the light of a fit falls, or None for one whole pupil."""
        light, f = np.maximum(pooled(model.light.start, model.oversampling), 0), model.oversampling
        parts = parts_of(np.where(light > _LIT, np.sqrt(light), 0))
        full = (light > _FULL) | ~np.isin(parts, parts[light > _FULL])
        numbers = np.where(full, parts, 0)
        return cls(numbers, _divided(parts, light, nearest_parts(numbers, f))) if parts.max() > 1 else None

    @property
    def n_steps(self) -> int:
        """Number of pistons, tips and tilts."""
        return len(self.maps)

    def fine(self, steps: NDArray) -> NDArray[np.float64]:
        """Steps (..., n_steps) to a phase on the fine grid."""
        side = math.isqrt(len(self.matrix.indptr) - 1)
        return (self.matrix @ steps.reshape(-1, self.n_steps).T).T.reshape(*steps.shape[:-1], side, side)

    def adjoint(self, fine: NDArray) -> NDArray[np.float64]:
        """Adjoint of `fine`."""
        flat = fine.reshape(-1, fine.shape[-2] * fine.shape[-1])
        return (self.matrix.T @ flat.T).T.reshape(*fine.shape[:-2], self.n_steps)

    def means(self, steps: NDArray) -> NDArray[np.float64]:
        """Steps (..., n_steps) to the means of a phase over the pixels."""
        return np.tensordot(steps, self.maps, 1)

    @cached_property
    def _inverse(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.pinv(self.maps[:, self.lit], rcond=1e-6), float)

    def fitted(self, phase: NDArray) -> NDArray[np.float64]:
        """Steps, radian, of the segments that are nearest to a phase (n, n)."""
        return phase[self.lit] @ self._inverse

    def continued(self, phase: NDArray) -> NDArray[np.float64]:
        """Phase (n, n) with that of the nearest pixel outside all segments."""
        return nearest_good(phase, self.lit)


def nearest_parts(numbers: NDArray[np.intp], oversampling: int) -> NDArray[np.intp]:
    """Number of the nearest segment of each point of the fine grid."""
    fine = np.kron(numbers, np.ones((oversampling,) * 2, int))
    nearest = ndimage.distance_transform_edt(fine == 0, return_distances=False, return_indices=True)
    return np.asarray(fine[tuple(nearest)])


def _divided(parts: NDArray[np.intp], light: NDArray, fine: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number of the segment of each fine point, where straight gaps part neighbours.

    Of two neighbours, the line of the gap goes through the light that pixels next to it lack.
    """
    out, f = fine.copy(), len(fine) // len(parts)
    around = np.stack([np.roll(parts, (down, right), (0, 1)) for down in (-1, 0, 1) for right in (-1, 0, 1)])
    low, high = around.min(axis=0), around.max(axis=0)
    between = (low > 0) & (low < high) & np.all((around == low) | (around == high), axis=0)
    lack = np.maximum(ndimage.median_filter(light, 5) - light, 0)
    rows, columns = (np.indices(fine.shape) + 0.5) / f - 0.5
    for first, second in np.unique(np.stack([low[between], high[between]], axis=1), axis=0):
        gap = between & (low == first) & (high == second)
        if lack[gap].sum() < _LEAST_GAP or np.count_nonzero(gap) < _SHORTEST:
            continue
        places = np.argwhere(gap)
        middle = np.average(places, axis=0, weights=lack[gap])
        across = np.linalg.eigh(np.cov(places.T, aweights=lack[gap]))[1][:, 0]
        side = (rows - middle[0]) * across[0] + (columns - middle[1]) * across[1]
        near = ndimage.binary_dilation(np.kron(gap, np.ones((f, f))) > 0) & ((fine == first) | (fine == second))
        sign = np.sign(side[fine == second].mean())
        out[near] = np.where(sign * side[near] > 0, second, first)
    return out
