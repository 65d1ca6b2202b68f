"""Reconstruction by gradient descent, section 3.3 of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._propagator import along_phase, parts_sum, square
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors.base import Reconstructor, Solution, check_frames
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult


class GradientDescent(Reconstructor):
    """Phase whose modelled frames differ least from the measured ones.

    The cost is half the mean over the detector of the squared difference: its minimum is that of the 2-norm in
    the paper, but it is smooth there, where a norm has a kink that spoils the steps of the optimiser. The gradient
    comes from back-propagation through the sensor; `scipy.optimize.minimize` takes the steps (L-BFGS-B).

    From a flat start, descent on modes ends in local minima from about 0.8 rad rms on: a patch at the rim lands a
    whole 2 pi off. The phase of a few phase-shifted iterations is a safer start: call
    `descent(frames, start=PhaseShifted(sensor, n_iterations=5)(frames).phase)`. The modes are added to the start,
    which need not be a sum of modes; descent keeps the part of its error that no mode represents.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
        With any number of masks.
    modes : array_like, shape (n_modes, ny, nx), optional
        Modes whose coefficients are sought; the phases of all points of the pupil if left out.
    n_iterations, tolerance, amplitude
        As for `PhaseShifted`.

    References
    ----------
    Chambouleyron et al. 2024, section 3.3, equation (16); `eq-gradient` of the book.
    """

    polychromatic = True

    def __init__(
        self,
        sensor: ZernikeSensor | PolychromaticSensor,
        modes: ArrayLike | None = None,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
    ) -> None:
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=amplitude)
        self.modes = None if modes is None else _check.modes("modes", modes, sensor.pupil)

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Descend from the start, frame set by frame set."""
        pupil, n_iterations, k = self.sensor.pupil, self.settings.n_iterations, len(frames)
        phase = np.zeros((k, *pupil.shape), frames.dtype) if start is None else start
        n_used = np.zeros(k, int)
        converged = np.zeros(k, bool)
        record = np.empty((k, n_iterations + 1, *pupil.shape), frames.dtype) if history else None
        for index, frame in enumerate(frames):
            path, converged[index] = self._descend(frame[np.newaxis], pupil.gather(phase[index]))
            n_used[index] = len(path) - 1
            phase[index] = pupil.scatter(path[-1], fill=0)
            if record is not None:
                path += [path[-1]] * (n_iterations + 1 - len(path))
                record[index] = pupil.scatter(np.array(path), fill=0)
        return Solution(phase, n_used, converged, np.zeros(k, int), record)

    def cost(self, phase: NDArray, frames: NDArray) -> tuple[float, NDArray]:
        """Cost of a phase and its gradient.

        Parameters
        ----------
        phase : ndarray, shape (n_points,), radian
            Values at the points of the pupil.
        frames : ndarray, shape (n_masks, ny', nx') or (1, n_masks, ny', nx')

        Returns
        -------
        cost : float
        gradient : ndarray, shape (n_points,), 1 / radian
        """
        frames, batch = check_frames(self.sensor, _check.real_array("frames", frames), light=self._light)
        if batch not in ((), (1,)):
            raise ValueError(f"frames has a batch of {batch}: expected one set of frames")
        phase, expected = _check.real_array("phase", phase), (self.sensor.pupil.n_points,)
        if phase.shape != expected:
            raise ValueError(f"phase has shape {phase.shape}: expected {expected}, the points of the pupil")
        _check.finite("phase", phase)
        return self._cost(phase, frames)

    def _cost(self, phase: NDArray, frames: NDArray) -> tuple[float, NDArray]:
        pupil, model = self.sensor.pupil, self.settings.model(Kind.of(frames))
        psi = model.incoming(pupil.scatter(phase.astype(frames.dtype), fill=0)[np.newaxis])
        waves = model.propagate(psi)
        mismatch = square(waves) - frames
        if self.sensor.recorded is not None:
            mismatch *= self.sensor.recorded
        back = model.adjoint(waves * mismatch[:, :, np.newaxis])
        gradient = 2 * parts_sum(along_phase(psi, model.channels.ratios, np) * back)[0] / mismatch.size
        return float(np.vdot(mismatch, mismatch)) / (2 * mismatch.size), pupil.gather(gradient)

    def _descend(self, frames: NDArray, start: NDArray) -> tuple[list[NDArray], bool]:
        """Phases at the points of the pupil after each iteration, and whether the last change was small."""
        from scipy.optimize import minimize  # takes three times as long to import as the rest of the package

        config = self.settings
        n_points = config.sensor.pupil.n_points
        path = [start]
        latest = np.array(np.nan), start  # the steps follow the last phase of which the cost was computed

        def phase(x: NDArray) -> NDArray:
            nonlocal latest
            if not np.array_equal(x, latest[0]):
                latest = x.copy(), start + (x if self.modes is None else x @ self.modes)
            return latest[1]

        def value(x: NDArray) -> tuple[float, NDArray]:
            cost, gradient = self._cost(phase(x), frames)
            return cost, np.asarray(gradient if self.modes is None else self.modes @ gradient, np.float64)

        def follow(intermediate_result: OptimizeResult) -> None:  # SciPy goes by this name
            path.append(phase(intermediate_result.x))
            if _rms(path[-1] - path[-2]) <= config.tolerance:
                raise StopIteration

        n = n_points if self.modes is None else len(self.modes)
        result = minimize(
            value, np.zeros(n), jac=True, method="L-BFGS-B", callback=follow,
            options={"maxiter": config.n_iterations, "ftol": 0.0, "gtol": 0.0},
        )  # fmt: skip
        # Status 0: the gradient is exactly 0. No step at all: none leads down, as at a start that is the solution.
        stuck = result.status == 0 or len(path) == 1
        return path, stuck or _rms(path[-1] - path[-2]) <= config.tolerance


def _rms(values: NDArray) -> float:
    return float(np.sqrt(values @ values / values.size))
