"""Pistons of the segments of a segmented mirror."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.metrics import without_piston


def segment_pistons(phase: ArrayLike, segments: NDArray, numbers: NDArray) -> NDArray[np.float64]:
    """Piston of each segment in a phase, see `BenchModel.pistons`: on a map of segment numbers (ny, nx).

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.bench.segments import segment_pistons
    >>> segments = np.array([[1, 1, 2, 2]])
    >>> segment_pistons(0.1 * segments, segments, np.array([1, 2])).round(3)
    array([0.1, 0.2])
    """
    phase = _check.real_array("phase", phase)
    segments = _check.integer_array("segments", segments)
    if segments.ndim != 2:
        raise ValueError(f"segments has shape {segments.shape}: expected (ny, nx)")
    numbers = _check.integer_array("numbers", numbers)
    if numbers.ndim != 1 or not numbers.size:
        raise ValueError(f"numbers has shape {numbers.shape}: expected (n_segments,), at least one")
    _check.maps("phase", phase, segments.shape, "the grid of the segments")
    on_segment = segments.ravel() > 0
    flat = phase.reshape(*phase.shape[:-2], -1)[..., on_segment]
    members = (segments.ravel()[on_segment] == numbers[:, np.newaxis]).astype(float)
    sums = np.where(np.isfinite(flat), np.exp(1j * np.nan_to_num(flat)), 0) @ members.T
    if not np.all(np.abs(sums) > 0):
        raise ValueError(
            "phase is NaN all over a segment, or segments lacks one of numbers: expected finite values"
        )
    return np.angle(sums)


def segment_residual(found: ArrayLike, commanded: ArrayLike) -> NDArray[np.float64]:
    """Difference of segment pistons on the circle, without their common piston.

    Parameters
    ----------
    found, commanded : array_like, shapes (..., n_segments) that broadcast, radian

    Returns
    -------
    ndarray, shape (..., n_segments), radian
        In (-pi, pi].

    Raises
    ------
    ValueError
        If there is no piston, or a value is not finite.

    Examples
    --------
    >>> from zwfs.bench.segments import segment_residual
    >>> segment_residual([0.1, 0.2, 0.3], [0.0, 0.1, 0.2]).round(6) + 0.0  # a common piston
    array([0., 0., 0.])
    """
    found, commanded = _check.real_array("found", found), _check.real_array("commanded", commanded)
    shape = _check.broadcast(found=found, commanded=commanded)
    if not shape or 0 in shape:
        raise ValueError(f"found and commanded have shape {shape}: expected (..., n_segments), at least one")
    _check.finite("found", found)
    _check.finite("commanded", commanded)
    return without_piston(found - commanded)
