"""Images that have moved since the calibration: by how much, and their phases on a grid that moves with them.

Two images hold two numbers for the phase of each point, so images at a wrong place leave residuals that no phase
explains. Their slopes, each with the phase solved again, give the displacement that makes them least. For images
that are less than half a pixel away it is exact to 0.15 pixel. The rim of the pupil shows the way to there.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._exposures import INCONSISTENT, MOVED, MOVED_BY, SURE, Exposures
from zwfs.frames.phases import Phases

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

_ROUNDS = 3  # in which images are moved back
_FARTHEST = 3.0  # pixels by which they are moved back at most
_STEP = 0.25  # pixels, of the slopes
# Of the residual without a shift. Errors of the model pretend shifts of up to 0.15 pixel, which lower it less.
_BETTER = 0.8


def checked_follow(follow: bool, calibration: Calibration) -> bool:
    """Require an option that the images of a calibration allow."""
    if _check.flag("follow", follow) and calibration.optics.single:
        raise ValueError("follow = True with one phase shift: expected two, as one image fits anywhere")
    return follow


def followed(exposures: Exposures, light: NDArray | None, limit: float | None) -> Phases:
    """Phases as `Exposures.phases` returns them, with images moved back whose displacement is significant."""
    phases = exposures.phases(light, limit)
    doubtful = np.any(np.abs(phases.displacement) > MOVED_BY, axis=1) | (phases.flags & (INCONSISTENT | MOVED) > 0)
    if not doubtful.any():
        return phases
    parts = []
    for index in range(len(doubtful)):
        which = slice(index, index + 1)
        arrays: dict[str, Any] = {name: values[which] for name, values in phases._arrays()}
        part, lamp = replace(phases, **arrays), None if light is None else light[which]
        parts.append(_one_followed(exposures, index, part, lamp, limit) if doubtful[index] else part)
    return Phases._joined(parts, doubtful.shape)


def _one_followed(
    exposures: Exposures, index: int, first: Phases, light: NDArray | None, limit: float | None
) -> Phases:
    """Phases of an exposure, from those without a shift."""
    phases, shift, sizes = first, np.zeros(2), []
    for n_left in reversed(range(_ROUNDS + 1)):
        missing, sigma, size = _remaining(exposures, index, phases, shift)
        sizes.append(size)
        steps = [missing] * _significant(missing, sigma) + [phases.displacement[0]]
        places = [shift + step for step in steps if np.abs(step).max() > MOVED_BY]
        places = [place for place in places if np.abs(place).max() <= _FARTHEST]
        if not (places and n_left):
            break
        rivals = [exposures.moved(index, place).phases(light, limit) for place in places]
        best = int(np.argmin([np.nan_to_num(rival.residual[0], nan=np.inf) for rival in rivals]))
        if not rivals[best].residual[0] < phases.residual[0]:
            break
        phases, shift = rivals[best], places[best]
    total, moved = shift + missing, _significant(missing, sigma)
    if sizes[-1] > _BETTER * sizes[0]:
        phases, moved = first, bool(first.flags[0] & MOVED) and _significant(total, sigma)
    flags = phases.flags & ~MOVED | MOVED * moved
    return replace(phases, displacement=total.astype(np.float32)[np.newaxis], flags=flags)


def _significant(displacement: NDArray, sigma: NDArray) -> bool:
    return bool(np.any(np.abs(displacement) > np.maximum(MOVED_BY, SURE * sigma)))


def _remaining(
    exposures: Exposures, index: int, phases: Phases, shift: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Displacement of an exposure in addition to a shift, (2,), its standard error, and the rms residual."""
    changes = np.array([(0, 0), (_STEP, 0), (-_STEP, 0), (0, _STEP), (0, -_STEP)])
    residuals = np.stack(
        [exposures.moved(index, shift + change, phases.filled).residuals(phases.flux) for change in changes]
    )
    residuals = residuals[:, np.isfinite(residuals).all(axis=0)]
    slopes = (residuals[1::2] - residuals[2::2]) / (2 * _STEP)
    inverse = np.linalg.pinv(slopes @ slopes.T, hermitian=True)
    step = -inverse @ (slopes @ residuals[0])
    unexplained = residuals[0] + step @ slopes
    rms = math.sqrt(np.mean(residuals[0] ** 2))
    return step, np.sqrt(np.diagonal(inverse) * np.mean(unexplained**2)), rms
