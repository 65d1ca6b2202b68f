"""Wirtinger flow: steps along the gradient of the mismatch of the frames."""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from zwfs.reconstructors.base import Estimate, FixedPoint, State


@dataclass
class Frames(State):
    """Frames that are still iterated, (k, n_masks, ny', nx'); those that have converged leave."""

    measured: NDArray


class WirtingerFlow(FixedPoint):
    """Phase from any number of masks, by steps along the gradient of the mismatch of the frames.

    A step replaces the field psi by psi - A^H((|A psi|^2 - I) A psi) / (n a^2), where A propagates to the detector
    behind n masks, I are the frames, and a^2 is the mean intensity in the pupil. Of the result, only the phase is
    kept. The true phase is a fixed point.

    References
    ----------
    Candes, Li & Soltanolkotabi 2015, IEEE Trans. Inf. Theory 61, 1985.
    """

    def begin(self, frames: NDArray, phasor: NDArray | None, constants: Any) -> Frames:
        """Return the frames: a state holds all that belongs to single frame sets."""
        return Frames(frames)

    def step(self, phasor: NDArray, state: Frames, constants: Any) -> Estimate:
        """Take one step. Fields are split: real and imaginary part lie on the third axis from the end."""
        xp, psi = constants.kind.xp, constants.field(phasor)
        waves = constants.propagate(psi)
        excess = xp.sum(waves**2, axis=-3) - state.measured
        gradient = constants.adjoint(excess[:, :, None, ...] * waves)
        intensity = self.settings.light / self.sensor.pupil.n_points
        return Estimate(psi - gradient / (self.sensor.n_masks * intensity))
