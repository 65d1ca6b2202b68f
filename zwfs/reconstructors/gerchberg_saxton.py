"""Gerchberg-Saxton reconstruction, section 3.2 of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._propagator import Propagator, modulus_of, unit
from zwfs.reconstructors.base import Estimate, FixedPoint, State
from zwfs.sensor import ZernikeSensor


class GerchbergSaxton(FixedPoint):
    """Phase from alternating propagation between the pupil and the detector, with the measured amplitude in each.

    One iteration propagates the estimate psi through every mask, o = A psi, replaces the modelled amplitude |o| by
    the square root a of the measured frames, back-propagates, adds the fields of all masks, and replaces the
    amplitude in the pupil by A_in. Two variants differ in the field where nothing is measured, which is beyond the
    detector and in the light that a mask absorbs.

    With "zero", the paper's way, this field counts as 0: next = A^H (a o / |o|). The true phase is no fixed point.
    The phase has a bias that grows with the light that misses the detector. Give the sensor an `extent` of 2 D or
    more: on a detector as wide as the pupil the iteration diverges.

    With "model", this field is the modelled one: next = n psi + A^H (a o / |o| - o), with n masks. The true phase
    is a fixed point on a detector of any width, with masks of any transmission. No iteration increases the sum of
    (a - |o|)^2 over the detector. The cost is that of "zero".

    The root needs frames without negative values: those that noise causes are raised to 0, which biases faint
    frames.

    The piston stays near that of the start, since <psi, next> is real and positive.

    Parameters
    ----------
    sensor : ZernikeSensor
        With any number of masks.
    n_iterations, tolerance, amplitude
        As for `PhaseShifted`.
    unmeasured : {"zero", "model"}
        Field where nothing is measured; "model" for a sensor with pixels that are not `recorded`.

    References
    ----------
    Chambouleyron et al. 2024, section 3.2, equations (14) and (15); Gerchberg & Saxton 1972;
    `eq-unmeasured` of the book for "model".
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
        unmeasured: str = "zero",
    ) -> None:
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=amplitude)
        _check.choice("unmeasured", unmeasured, ["zero", "model"])
        if unmeasured == "zero" and sensor.recorded is not None:
            raise ValueError(
                "unmeasured = 'zero': expected 'model', since not all pixels of the sensor are recorded"
            )
        self.unmeasured = unmeasured

    def begin(self, frames: NDArray, phasor: NDArray | None, constants: Propagator) -> _State:
        """Return the measured amplitude on the detector."""
        xp = constants.kind.xp
        return _State(xp.sqrt(xp.clip(frames, 0, None)))

    def step(self, phasor: NDArray, state: _State, constants: Propagator) -> Estimate:
        """Propagate to the detector and back."""
        xp, psi = constants.kind.xp, constants.field(phasor)
        waves = constants.propagate(psi)
        # A modelled field of 0 has no phase: such a pixel adds nothing on the way back.
        if self.unmeasured == "zero":
            return Estimate(constants.adjoint(unit(waves, state.amplitude, xp)))
        modelled = modulus_of(waves, xp)
        missing = state.amplitude - modelled
        if self.sensor.recorded is not None:
            missing = missing * constants.kind.array(self.sensor.recorded)
        back = constants.adjoint(unit(waves, missing, xp, modelled))
        back += self.sensor.n_masks * psi
        return Estimate(back)


@dataclass
class _State(State):
    amplitude: NDArray[np.floating]  # (k, n_masks, ny', nx'), measured
