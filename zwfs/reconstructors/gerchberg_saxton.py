"""Gerchberg-Saxton reconstruction, section 3.2 of the paper."""

from __future__ import annotations

from numpy.typing import ArrayLike, NDArray

from zwfs._arrays import Kind
from zwfs.reconstructors.base import Estimate, Reconstruction, Reconstructor, iterate, settings, unit
from zwfs.sensor import ZernikeSensor


class GerchbergSaxton(Reconstructor):
    """Phase by going to and fro between the planes, with the measured amplitude put in at each.

    One iteration propagates the estimate through every mask, puts the square root of the measured frames in the
    place of the modelled amplitude, back-propagates, adds the fields of all masks, and puts A_in in the place of
    the amplitude in the pupil.

    The detector plane is that of the sensor. Light that leaves it is taken as 0 on the way back, which biases the
    phase: give the sensor an `extent` of 2 D or more. On a detector as wide as the pupil the iteration improves a
    few times and then diverges.

    The piston stays near that of the start: with the estimate psi, the measured amplitude a and the modelled field
    o = A psi of each mask, <psi, next> = sum a |o|, which is real and positive.

    Parameters
    ----------
    sensor : ZernikeSensor
        With any number of masks.
    n_iterations, tolerance, amplitude
        As for `PhaseShifted`.

    References
    ----------
    Chambouleyron et al. 2024, section 3.2, equations (14) and (15); Gerchberg & Saxton 1972.
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
    ) -> None:
        super().__init__(settings(sensor, n_iterations, tolerance, amplitude))

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame set; parameters, result and errors are those of `PhaseShifted`."""
        return iterate(self, frames, start, history)

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool, kind: Kind) -> dict[str, NDArray]:
        """Measured amplitude on the detector."""
        return {"amplitude": kind.xp.sqrt(frames)}

    def step(self, phasor: NDArray, data: dict[str, NDArray], kind: Kind) -> Estimate:
        """To the detector and back."""
        sensor = self.sensor
        maps = self.settings.maps(kind)
        waves = sensor.propagate_split(maps.field(phasor))
        # A modelled field of 0 has no phase: such a pixel adds nothing on the way back.
        return Estimate(sensor.adjoint_split(unit(waves, data["amplitude"], kind.xp)))
