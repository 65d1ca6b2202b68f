"""Light of exposures, and their phases with it.

The mean light of a pupil behind the masks depends on the phase, by more than half. So the light of an exposure,
over that of the calibration, is the number with which the frames explain themselves best: their phase predicts as
much light as there is, and modelled frames differ little from measured ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_ENOUGH = 2.25  # cost of an explanation that is good enough
_PASSES = 4  # in which the light of the modelled frames gives the next light
_STEPS = 0.08, 0.08, 0.04, 0.02, 0.01  # relative changes of the light
_BETTER = 0.8  # of the cost: a smaller gain moves no light


class Trial(NamedTuple):
    """Phases of k exposures with a light."""

    light: NDArray[np.float64]  # (k,), relative to the calibration
    phase: NDArray[np.float32]  # (k, ny, nx), bad points filled
    frames: NDArray[np.float32]  # (k, 2, ny, nx), ideal frames
    n_iterations: NDArray[np.int64]  # (k,)
    converged: NDArray[np.bool_]  # (k,)
    n_unsolved: NDArray[np.int64]  # (k,)
    residual: NDArray[np.float32]  # (k,), NaN if not judged
    ratio: NDArray[np.float64]  # (k,), light of the frames over that of their model
    cost: NDArray[np.float64]  # (k,), of both: 1 for frames like those of the calibration

    def improved(self, which: NDArray[np.intp], other: Trial, factor: float = 1.0) -> NDArray[np.bool_]:
        """Take over those of some exposures that cost less than a part of what they cost here."""
        better = other.cost < factor * self.cost[which]
        pairs: zip[tuple[NDArray, NDArray]] = zip(self, other, strict=True)
        for mine, new in pairs:
            mine[which[better]] = new[better]
        return better


Attempt = Callable[[NDArray[np.intp], NDArray[np.float64]], Trial]
"""Phases of some exposures with a light."""


def explained(attempt: Attempt, best: Trial) -> Trial:
    """Improve the light of those exposures that their first light does not explain."""
    poor = np.flatnonzero(best.cost > _ENOUGH)
    for _ in range(_PASSES):
        if not poor.size:
            return best
        better = best.improved(poor, attempt(poor, best.light[poor] * best.ratio[poor]))
        poor = poor[better & (best.cost[poor] > _ENOUGH)]
    poor = np.flatnonzero(best.cost > _ENOUGH)
    for step in _STEPS:
        if not poor.size:
            break
        for factor in (1 - step, 1 + step):
            best.improved(poor, attempt(poor, best.light[poor] * factor), _BETTER)
        poor = poor[best.cost[poor] > _ENOUGH]
    return best
