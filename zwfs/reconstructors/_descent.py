"""Descent of a maximum-likelihood fit from one start: damped steps, and points that leave local minima."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind
from zwfs._information import Response
from zwfs._likelihood import Noise, tangents
from zwfs._propagator import Propagator, parts_sum, square
from zwfs.reconstructors._fit import Fit, Hessian, Misfit
from zwfs.reconstructors._unknowns import Points, PointsAndAmplitude, Position
from zwfs.reconstructors.base import Settings

_DAMPING = 1e-3  # of the first step, relative to the mean of the information's diagonal
_LEAST_CUT = 0.1  # of the damping after a good step
_GROWTH = 2.0  # of the damping after a first step that raises the cost
_NOTHING = 1e-300  # keeps quotients finite
_NEGLIGIBLE = 1e-3  # of the mean standard error: a smaller step is the last one
_REFLECTIONS = 3  # largest number of times that points of one start are reflected


@dataclass(frozen=True, eq=False)
class Descent:
    """Levenberg-Marquardt steps to the most likely unknowns.

    Attributes
    ----------
    settings : Settings
    unknowns : Points
        Or another kind of unknowns.
    noise : Noise
    response : Response
        Of the sensor, or a coarser one: only the Hessian uses it.
    """

    settings: Settings
    unknowns: Points
    noise: Noise
    response: Response

    @property
    def misfit(self) -> Misfit:
        """How well fits explain the frames."""
        return Misfit(self.noise, self.unknowns.n_unknowns)

    def run(self, frames: NDArray, start: NDArray, history: bool) -> Fit:
        """Take steps from one start. Frame sets that are done leave, so no result depends on the others."""
        kind, n_iterations = Kind.of(frames), self.settings.n_iterations
        xp = kind.xp
        fit = self._begin(frames, start)
        places, ended, path = kind.integers(np.arange(frames.shape[0])), [], [self.unknowns.phase(fit)]
        for iteration in range(1, n_iterations + 1):
            self._step(fit)
            if iteration < n_iterations and xp.any(fit.converged):
                self._reflect(fit)
            if history:
                path.append(self.unknowns.phase(fit))
            n_done = int(xp.count_nonzero(fit.converged))
            if iteration == n_iterations or n_done == places.shape[0]:
                break
            if n_done:
                ended.append((places[fit.converged], fit.at(fit.converged)))
                places, fit = places[~fit.converged], fit.at(~fit.converged)
        if history:
            fit.history = xp.stack(path + path[-1:] * (n_iterations + 1 - len(path)), axis=1)
        ended.append((places, fit))
        order = xp.argsort(xp.concat([numbers for numbers, _ in ended]))
        return Fit.joined([part for _, part in ended], xp).at(order)

    def _begin(self, frames: NDArray, start: NDArray) -> Fit:
        """Return the fit at a starting phase, (k, ny, nx)."""
        kind, k = Kind.of(frames), frames.shape[0]
        fit = self._at(self.unknowns.begin(start, frames, self._model(frames)), frames)
        fit.damping, fit.growth = kind.zeros(k) + _DAMPING, kind.zeros(k) + _GROWTH
        fit.n_iterations = fit.n_reflections = kind.integers([0] * k)
        fit.n_starts = kind.integers([1] * k)
        fit.converged = kind.flags(np.zeros(k, bool))
        return fit

    def _at(self, position: Position, frames: NDArray) -> Fit:
        """Return the model of the frames at a position, and its cost."""
        waves = self._model(frames).propagate(position.psi)
        light = square(waves)
        cost = self.noise.deviance(light, frames) + self.unknowns.prior_cost(position.coefficients)
        return Fit(
            frames=frames,
            psi=position.psi,
            waves=waves,
            light=light,
            cost=cost,
            coefficients=position.coefficients,
            phase=position.phase,
        )

    def _step(self, fit: Fit) -> None:
        """Try a step (`eq-step`) on every frame set; take it where the cost falls.

        The next step is about the square of this one. Where that square is within the tolerance, the next step is
        taken at once with the same Hessian. It costs less than a new Hessian, and mostly confirms the solution.

        The damping follows Nielsen 1999: it falls the more, the better the quadratic model predicted the cost.
        """
        xp = Kind.of(fit.psi).xp
        information = self.response.information(self._tangents(fit), fit.waves, self.noise.weights(fit.light))
        hessian = self.unknowns.hessian(information, fit.damping)
        cost = fit.cost
        better, promised, size = self._try(fit, hessian, xp.ones_like(fit.converged))
        ratio = (cost - fit.cost) / (promised + _NOTHING)
        cut = xp.clip(1 - (2 * ratio - 1) ** 3, _LEAST_CUT, None)
        fit.damping = fit.damping * xp.where(better, cut, fit.growth)
        fit.growth = xp.where(better, xp.full_like(fit.growth, _GROWTH), 2 * fit.growth)
        last = xp.full_like(size, self.settings.tolerance)
        if self.noise.photons is not None:
            last = xp.maximum(last, _NEGLIGIBLE / xp.sqrt(hessian.scale))
        near = (size > last) & (size * size <= last)
        if xp.any(near):
            size = xp.where(near, self._try(fit, hessian, near)[2], size)
        fit.converged = size <= last
        fit.n_iterations = fit.n_iterations + 1

    def _try(
        self, fit: Fit, hessian: Hessian, active: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray, NDArray]:
        """Take a step on active frame sets, (k,), where the cost falls.

        Returns
        -------
        better : array of bool, shape (k,)
            Whether the cost falls.
        promised : array, shape (k,)
            Fall of the cost that the quadratic model promises.
        size : array, shape (k,), radian rms
            Length of the step.
        """
        model = self._model(fit.psi)
        xp, change = model.kind.xp, self._tangents(fit)
        step = self.unknowns.step(fit, hessian, self._gradient(fit, change), change, model)
        trial = self._at(step.position, fit.frames)
        better = active & (trial.cost < fit.cost)
        fit.take(better, trial, xp)
        size = xp.sqrt(xp.sum(step.maps * step.maps, axis=(1, 2, 3)) / model.pupil.n_points)
        return better, step.promised, size

    def _gradient(self, fit: Fit, change: NDArray) -> NDArray:
        """Half the gradient of the cost for changes of the field (k, c, 2, ny, nx): (k, c, ny, nx)."""
        weights, difference = self.noise.weights(fit.light), fit.light - fit.frames
        weighted = difference if weights is None else weights * difference
        back = self._model(fit.psi).adjoint(fit.waves * weighted[:, :, np.newaxis, ...])
        return 2 * parts_sum(change * back[:, np.newaxis, ...])

    def _tangents(self, fit: Fit) -> NDArray:
        """Change of the field per unit of the unknowns, (k, c, 2 n_wavelengths, ny, nx)."""
        model, amplitude = self._model(fit.psi), isinstance(self.unknowns, PointsAndAmplitude)
        return tangents(fit.psi, model.stop, amplitude, model.kind.xp, model.channels.ratios)

    def _model(self, maps: NDArray) -> Propagator:
        return self.settings.model(Kind.of(maps))

    def _reflect(self, fit: Fit) -> None:
        """Try to leave local minima of single points, where frame sets have converged.

        The intensity of a point depends on the angle between its field psi and the reference wave r of a mask. Its
        reflection at r gives the same intensity behind this mask (`eq-reflection`). A point may have converged to
        the wrong one of the two, mostly where a frame is dark. With the reference waves held, each point takes the
        reflection that makes its frames most likely. Frame sets whose cost falls by this continue. In a band of
        light the reflections of the wavelengths differ. There a point may be 2 pi off, and the two phases at that
        distance take their place.
        """
        least_gain = self.unknowns.least_gain
        if least_gain is None:
            return
        xp = Kind.of(fit.psi).xp
        stopped = fit.converged & (fit.n_reflections < _REFLECTIONS)
        if self.noise.photons is None:
            stopped = stopped & ~self.misfit.explained(fit)
        if not xp.any(stopped):
            return
        part = fit.at(stopped)
        gain = least_gain * self.misfit.noise_variance(part)
        trial = self._at(self._best_points(part, gain[:, np.newaxis, np.newaxis]), part.frames)
        better = trial.cost < part.cost - gain
        part.take(better, trial, xp)
        part.converged = ~better
        part.damping = xp.where(better, xp.full_like(part.damping, _DAMPING), part.damping)
        part.n_reflections = part.n_reflections + 1
        fit.put(stopped, part)

    def _best_points(self, fit: Fit, gain: NDArray) -> Position:
        """Return the position in which points take an alternative that is more likely by `gain`."""
        model = self._model(fit.psi)
        xp, window = model.kind.xp, model.window
        frames = fit.frames[(..., *window)]
        references = fit.waves[(..., *window)] - fit.psi[:, np.newaxis, ...]
        least, psi, phase = self.noise.terms(fit.light[(..., *window)], frames), fit.psi, fit.phase
        for trial in self.unknowns.alternatives(fit, references, model):
            terms = self.noise.terms(square(trial.psi[:, np.newaxis, ...] + references), frames)
            better = terms < least - gain
            psi = xp.where(better[:, np.newaxis, ...], trial.psi, psi)
            phase = None if trial.phase is None else xp.where(better, trial.phase, phase)
            least = xp.where(better, terms, least)
        return Position(psi, phase=phase)
