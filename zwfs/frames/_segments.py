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


class Segments:
    """Piston, tip and tilt of each segment, of unit rms; a gap ends where the next segment is nearer."""

    def __init__(self, numbers: NDArray[np.intp], oversampling: int) -> None:
        """Take the number of the segment of each pixel that lies in one, from 1 on, and 0 elsewhere."""
        self.lit = numbers > 0
        self.numbers = np.unique(numbers, return_inverse=True)[1].reshape(numbers.shape)  # without holes
        fine = np.kron(self.numbers, np.ones((oversampling,) * 2, int))
        nearest = ndimage.distance_transform_edt(fine == 0, return_distances=False, return_indices=True)
        own = fine[tuple(nearest)].ravel() - 1
        lit, count = fine.ravel() > 0, np.bincount(fine[fine > 0] - 1)
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
        light = np.maximum(pooled(model.light.start, model.oversampling), 0)
        numbers = np.where(light > _FULL, parts_of(np.where(light > _LIT, np.sqrt(light), 0)), 0)
        return cls(numbers, model.oversampling) if np.count_nonzero(np.unique(numbers)) > 1 else None

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
