"""Phases of many pairs of frames, and flags that say what is wrong with each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs._results import PhaseResult
from zwfs.frames._solver import MapPrior
from zwfs.frames.pipeline import Agreement, Measurement


class Flag(IntFlag):
    """What is wrong with a frame; flags add up.

    Attributes
    ----------
    LOST
        The mean light of a pupil is less than the noise of a dark pixel, or more than a fifth of the pupil is bad.
        The phase is NaN.
    BAD_PIXELS
        Pixels are NaN, infinite or saturated that are good in the calibration.
    SATURATED
        Some of these are saturated.
    INCONSISTENT
        The residual exceeds 2.5 times that of the calibration's frames, more in faint light, or the call's limit.
        With a fitted bench, it exceeds 1.4 times the noise: the frame is not the one that its phase predicts.
        Or the background has risen by more than 3 % of a clear frame and 5 standard errors.
    NOT_CONVERGED
        The iteration used all its steps.
    MOVED
        The images have moved on the camera since the calibration, by more than 0.1 pixel and 5 standard errors.
        With a fitted bench, also if a displacement explains what its prediction misses. With `follow`: such a
        displacement remains.

    Examples
    --------
    >>> from zwfs.frames.phases import Flag
    >>> [flag.name for flag in Flag(6)]
    ['BAD_PIXELS', 'SATURATED']
    """

    LOST = 1
    BAD_PIXELS = 2
    SATURATED = 4
    INCONSISTENT = 8
    NOT_CONVERGED = 16
    MOVED = 32


@dataclass(frozen=True, eq=False, repr=False)
class Phases(PhaseResult):
    """Phases of camera images; `...` is the batch of the exposures. For NumPy it is the array `phase`.

    Attributes
    ----------
    phase : ndarray of float32, shape (..., ny, nx), radian
        In (-pi, pi], NaN outside the pupil, at bad points, and everywhere if the frame is lost. With a smooth
        prior it is not wrapped, and bad points have the phase that their neighbours predict.
    filled : ndarray of float32, shape (..., ny, nx), radian
        The same with bad points filled with the phase of the nearest good one, and 0 outside the pupil. If the
        frame is lost, it is the phase of a flat wavefront.
    flux : ndarray of float32, shape (...)
        Light of the exposure relative to that of the calibration, as its own frames show it.
    n_bad, n_saturated : ndarray of int, shape (...)
        Pixels of both images that are bad here and good in the calibration, and those of them that are saturated.
    residual : ndarray of float32, shape (...)
        Rms difference of measured and modelled frames in the pupil; 1 = mean of a clear frame. With a fitted
        bench, that of counts and their prediction, away from edges. NaN if the frame is lost, or was not judged.
    displacement : ndarray of float32, shape (..., 2), pixels
        Rows and columns by which the pupil has moved since the calibration, from its rim on both images. It comes
        out at 0.5 to 1.2 times the true value. With `follow` it holds the shift that was undone and what remains,
        to 0.15 pixel. NaN if the frame is lost, or was not judged.
    background : ndarray of float32, shape (..., 2)
        Uniform light that both images have gained since the calibration; 1 = mean of a clear frame, with the light
        of this exposure. It is measured around the pupils, and not subtracted. NaN if the camera image shows too
        little there, if the frame is lost, or was not judged.
    n_iterations, n_unsolved, flags : ndarray of int, shape (...)
        Iterations, points whose equations had no unique solution, and the sum of `Flag`; 0 is a good frame.
    sigma : ndarray, shape (..., ny, nx), radian, or None
        With a smooth prior: error bar of each point. `Calibration.sigma` gives those of other phases.
    misfit : ndarray, shape (...), or None
        With a smooth prior: mean square of the residuals over the noise.
    priors : tuple of MapPrior
        With a smooth prior: rms (radian), exponent of the spectrum and outer scale (D) of each exposure, and the
        rms of its `jumps` (radian): pistons, tips and tilts of segments.
    measurement : Measurement or None
        Of `recover_phase` and `phase_of`: that of the pair, which `judge` and `write_phase` need.
    """

    phase: NDArray[np.float32]
    filled: NDArray[np.float32]
    flux: NDArray[np.float32]
    n_bad: NDArray[np.int64]
    n_saturated: NDArray[np.int64]
    residual: NDArray[np.float32]
    displacement: NDArray[np.float32]
    background: NDArray[np.float32]
    n_iterations: NDArray[np.int64]
    n_unsolved: NDArray[np.int64]
    flags: NDArray[np.int64]
    sigma: NDArray[np.float64] | None = None
    misfit: NDArray[np.float64] | None = None
    priors: tuple[MapPrior, ...] = ()
    measurement: Measurement | None = None

    def __repr__(self) -> str:
        return f"Phases(phase {self.phase.shape}, {np.count_nonzero(self.flags)} of {self.flags.size} flagged)"

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Whether each iteration ended within its steps, shape (...)."""
        return (self.flags & Flag.NOT_CONVERGED.value) == 0

    @cached_property
    def agreement(self) -> Agreement:
        """Agreement of the frames of `measurement` with those of the phase."""
        if self.measurement is None:
            raise ValueError("measurement = None: expected phases of `recover_phase` or `phase_of`")
        return self.measurement.agreement(self.phase)

    @classmethod
    def _joined(cls, parts: list[Phases], batch: tuple[int, ...]) -> Phases:
        """Join parts of a batch, with one axis each, and return them in its shape."""
        arrays: dict[str, Any] = {}
        for name, first in parts[0]._arrays():
            whole = np.concatenate([getattr(part, name) for part in parts]) if len(parts) > 1 else first
            arrays[name] = whole.reshape((*batch, *whole.shape[1:]))
        return cls(**arrays, priors=sum((part.priors for part in parts), ()))
