"""Exposures on the grid of a calibration: their light, their phases with it, and their flags.

The mean light of a pupil behind the masks depends on the phase, by more than half. So the light of an exposure,
over that of the calibration, is the number with which the frames explain themselves best: their phase predicts as
much light as there is, and modelled frames differ little from measured ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs.frames.phases import Flag, Phases
from zwfs.frames.pipeline import MOST_BAD
from zwfs.reconstructors.base import Reconstructor

if TYPE_CHECKING:
    from zwfs.frames._grid import Grid
    from zwfs.frames._prediction import Prediction
    from zwfs.frames.calibration import Calibration

_DIM = 0.1  # of the light of the calibration: a frame with less is compared with its noise
_FAINT = 0.5  # of that light, from which down the noise of dark pixels counts
_LAMP = (
    0.85,
    1.7,
)  # light in the pupil, over that of the calibration's frames, that other phases can make of its lamp
_EXACT, _EXACT_OF_BENCH = 1e-3, 2.5e-3  # residuals of frames without noise
MOVED_BY, SURE = 0.1, 5.0  # pixels and standard errors, of a displacement
_STRAY = 0.03  # of a clear frame, by which the background may rise; errors of models reach half of that
_SAME_LIGHT = 0.01  # relative difference of the light of frames and of their model that means little
# Cost of an explanation that is good enough, and factor of the usual residual above which frames are inconsistent.
_ENOUGH = 2.25, 2.5
_ENOUGH_OF_BENCH = 1.96, 1.4  # where the noise is known
_PASSES = 4  # in which the light of the modelled frames gives the next light
_STEPS = 0.08, 0.08, 0.04, 0.02, 0.01  # relative changes of the light
_BETTER = 0.8  # of the cost: a smaller gain moves no light
_LOST, _BAD, _SATURATED, INCONSISTENT, _NOT_CONVERGED, MOVED = (
    flag.value for flag in Flag
)  # plain, and far quicker


class Trial(NamedTuple):
    """Phases of k exposures with a light."""

    light: NDArray[np.float64]  # (k,), relative to the calibration
    phase: NDArray[np.float32]  # (k, ny, nx), bad points filled
    frames: NDArray[np.float32]  # (k, 2, ny, nx), ideal frames
    n_iterations: NDArray[np.int64]  # (k,)
    converged: NDArray[np.bool_]  # (k,)
    n_unsolved: NDArray[np.int64]  # (k,)
    residual: NDArray[np.floating]  # (k,), NaN if not judged
    usual: NDArray[np.float64]  # (k,), of frames like those of the calibration
    ratio: NDArray[np.float64]  # (k,), light of the frames over that of their model
    cost: NDArray[np.float64]  # (k,), of both: 1 for frames like those of the calibration
    moved: NDArray[np.bool_]  # (k,), as the prediction of a bench shows it

    def improved(self, which: NDArray[np.intp], rival: Trial, factor: float = 1.0) -> NDArray[np.bool_]:
        """Take over those of some exposures that cost less than a part of what they cost here."""
        better = rival.cost < factor * self.cost[which]
        pairs: zip[tuple[NDArray, NDArray]] = zip(self, rival, strict=True)
        for mine, new in pairs:
            mine[which[better]] = new[better]
        return better


class Exposures:
    """k exposures, (k, n_images, ny_camera, nx_camera), and a method for their phases.

    A start of the iteration has the shape (k, ny, nx).
    """

    def __init__(
        self, calibration: Calibration, counts: NDArray, level: float, start: NDArray | None,
        method: Reconstructor | None, judge: bool, work: Grid | None = None, prediction: Prediction | None = None,
    ) -> None:  # fmt: skip
        self._of, self._work, k = calibration, work or calibration._work, len(counts)
        self._counts, self._level = counts, level
        self._start, self._method, self._judge = start, method, judge
        self._prediction = prediction if work else calibration._prediction
        self._enough, self._unusual = _ENOUGH_OF_BENCH if self._prediction and not method else _ENOUGH
        self._raw, self.good, self.n_bad, self.n_saturated = self._work.cleaned(counts, level, self._work.good)
        values = self._work.resampled(self._raw)
        self.n_good = np.maximum(np.count_nonzero(self.good, axis=(1, 2)), 1)
        sums = np.vecdot(values, self.good.reshape(k, 1, -1).astype(np.float32))
        flux = sums / (self.n_good[:, np.newaxis] * calibration.unit)
        self.relative, self.noise = flux.mean(axis=1) / calibration.light.mean(), self._dark_noise(counts, flux)
        self.lit = np.all((flux >= _DIM * calibration.light) | (flux > self.noise), axis=1)
        self.lit &= self.n_good >= (1 - MOST_BAD) * calibration.sensor.pupil.n_points
        flux = np.where(self.lit[:, np.newaxis], flux, calibration.light)
        if calibration.balance:
            values *= (flux.mean(axis=1, keepdims=True) / flux).astype(np.float32)[..., np.newaxis]
        values /= calibration.unit[:, np.newaxis].astype(np.float32)
        values = values.reshape(k, *calibration.offset.shape)
        self._ideal = self._work.weights[:, 0] * values[:, :1] + self._work.weights[:, 1] * values[:, 1:]

    def moved(self, index: int, shift: NDArray, start: NDArray | None = None) -> Exposures:
        """One exposure whose images have moved by rows and columns; a start replaces its own."""
        which = slice(index, index + 1)
        if self._start is not None and start is None:
            start = self._start[which]
        if self._method is not None and not self._method.iterative:
            start = None
        work = self._of._work.moved(self._of, shift)
        prediction = self._of._prediction and self._of._prediction.moved(work, shift)
        counts = self._counts[which]
        return Exposures(self._of, counts, self._level, start, self._method, True, work, prediction)

    def residuals(self, light: NDArray) -> NDArray[np.float64]:
        """Modelled less measured frames of one exposure in the pupil, with a light; NaN at bad points."""
        trial, inside = self._attempt(np.arange(1), light), self._of.sensor.pupil.inside
        missing = np.where(self.good[:, np.newaxis], self._work.modelled(trial.phase) - trial.frames, np.nan)
        return missing[0][:, inside].ravel().astype(float)

    def phases(self, light: NDArray | None, limit: float | None) -> Phases:
        """Phases with a known light, (k,), or that which explains the frames."""
        same = (self.relative > _LAMP[0]) & (self.relative < _LAMP[1]) | ~self.lit
        trial = self._attempt(np.arange(len(same)), np.where(same, 1.0, self.relative) if light is None else light)
        if light is None and self._judge:
            self._explain(trial)
        residual, displacement, moved, background, stray = self._compared(trial)
        limits = self._unusual * trial.usual if limit is None else limit
        flags = (
            _BAD * (self.n_bad > 0)
            + _SATURATED * (self.n_saturated > 0)
            + INCONSISTENT * (stray | (residual > limits))
        )
        flags += np.where(self.lit, _NOT_CONVERGED * (~trial.converged & (self._of.tolerance > 0)), _LOST)
        return Phases(
            phase=np.where(self.good & self.lit[:, np.newaxis, np.newaxis], trial.phase, np.float32(np.nan)),
            filled=trial.phase,
            flux=np.where(self.lit, trial.light, self.relative).astype(np.float32),
            n_bad=self.n_bad,
            n_saturated=self.n_saturated,
            residual=residual,
            displacement=displacement,
            background=background,
            n_iterations=trial.n_iterations,
            n_unsolved=trial.n_unsolved,
            flags=flags + MOVED * moved,
        )

    def _attempt(self, which: NDArray[np.intp], light: NDArray[np.float64]) -> Trial:
        """Phases of some exposures with a light."""
        work, good = self._work, self.good[which]
        frames: Any = (
            self._ideal[which] / light[:, np.newaxis, np.newaxis, np.newaxis].astype(np.float32) + work.offset
        )
        frames[~self.lit[which]] = work.flat_frames  # of a flat wavefront: they converge at once
        if self._method is None:
            np.maximum(frames, 0, out=frames)
        start, corrected = None if self._start is None else self._start[which], None
        solved = work.solve(frames, good, start, None if self._prediction else self._method)
        if self._prediction:
            corrected = self._prediction.corrected(self._raw[which], light, self.lit[which], good, solved)
            frames, solved = corrected.frames, corrected.solved
            if self._method:
                solved = work.solve(corrected.quiet, good, start, self._method)
        usual, (residual, ratio) = self._usual(light, self.noise[which]), np.full((2, len(which)), np.nan)
        moved = np.zeros(len(which), bool)
        if self._judge:
            residual, ratio = work.compared(solved.phase, frames, good)
        if self._judge and corrected and not self._method:  # counts are compared, not ideal frames
            residual, moved = corrected.residual, corrected.moved
            usual = np.maximum(corrected.noise, max(self._of.residual, _EXACT_OF_BENCH))
        ratio = ratio / self._of.light_ratio
        unsure = np.hypot(_SAME_LIGHT, 2 * usual / np.sqrt(self.n_good[which]))
        cost = np.where(self.lit[which], (residual / usual) ** 2 + ((ratio - 1) / unsure) ** 2, 0)
        return Trial(light, solved.phase, frames, *solved[1:], residual, usual, ratio, cost, moved)

    def _explain(self, best: Trial) -> None:
        """Improve the light of those exposures that their first light does not explain."""
        poor = np.flatnonzero(best.cost > self._enough)
        for _ in range(_PASSES):
            if not poor.size:
                return
            better = best.improved(poor, self._attempt(poor, best.light[poor] * best.ratio[poor]))
            poor = poor[better & (best.cost[poor] > self._enough)]
        poor = np.flatnonzero(best.cost > self._enough)
        for step in _STEPS:
            if not poor.size:
                return
            for factor in (1 - step, 1 + step):
                best.improved(poor, self._attempt(poor, best.light[poor] * factor), _BETTER)
            poor = poor[best.cost[poor] > self._enough]

    def _compared(self, trial: Trial) -> tuple[NDArray, ...]:
        """Residuals, displacements, flags of significant ones, backgrounds, and flags of significant ones.

        Numbers are NaN where an exposure is lost or not judged.
        """
        usual, work, k = self._of.displacements, self._work, len(self.lit)
        lit = slice(None) if self.lit.all() else self.lit  # a slice copies nothing
        residual, displacement, sigma, background = (
            np.full((k, *size), np.nan, np.float32) for size in ((), (2,), (2,), (2,))
        )
        stray = np.zeros(k, bool)
        if self._judge and self.lit.any():
            residual[lit], steady = trial.residual[lit], work.steady(trial.phase[lit])
            shift, sigma[lit] = work.displaced(steady, trial.frames[lit], self.good[lit])
            displacement[lit] = shift - (usual.mean(axis=0) if len(usual) else 0)
            unit = self._of.unit * trial.light[lit, np.newaxis]
            levels, errors = work.background(self._raw[lit], steady, unit)
            levels -= self._of.around
            background[lit] = levels.max(axis=0)
            stray[lit] = np.any(levels > np.maximum(_STRAY, SURE * errors), axis=(0, 2))
        scatter = usual.std(axis=0) if len(usual) else 0
        moved = np.abs(displacement) > np.maximum(MOVED_BY, SURE * np.hypot(sigma, scatter))
        return residual, displacement, trial.moved | moved.any(axis=1), background, stray

    def _dark_noise(self, counts: NDArray, flux: NDArray) -> NDArray[np.float64]:
        """Noise of dark pixels over `unit`, (k, 2), of exposures so faint that it counts; else 0."""
        noise, faint = np.zeros(flux.shape), np.flatnonzero(np.any(flux < _FAINT * self._of.light, axis=1))
        if faint.size:
            noise[faint] = self._work.noise(counts[faint]) / self._of.unit
        return noise

    def _usual(self, light: NDArray, noise: NDArray) -> NDArray[np.float64]:
        """Residual, (k,), that frames of the calibration would have with less light and with a noise, (k, 2)."""
        scale = np.maximum(light, 1e-9)
        own = max(self._of.residual, _EXACT) * np.sqrt(np.maximum(1 / scale, 1))
        return np.hypot(own, np.sqrt(np.mean(noise**2, axis=1)) / scale)
