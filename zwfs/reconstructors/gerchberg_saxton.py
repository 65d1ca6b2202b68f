"""Gerchberg-Saxton reconstruction, section 3.2 of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zwfs._propagator import Propagator, unit
from zwfs.reconstructors.base import Estimate, FixedPoint, State


class GerchbergSaxton(FixedPoint):
    """Phase by going to and fro between the planes, with the measured amplitude put in at each.

    One iteration propagates the estimate through every mask, replaces the modelled amplitude by the square root of
    the measured frames, back-propagates, adds the fields of all masks, and replaces the amplitude in the pupil by
    A_in.

    The detector plane is that of the sensor. Light beyond it is taken as 0 on the way back, which biases the
    phase: give the sensor an `extent` of 2 D or more. On a detector as wide as the pupil the phase improves in the
    first iterations and then diverges.

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

    def begin(self, frames: NDArray, phasor: NDArray | None, constants: Propagator) -> _State:
        """Return the measured amplitude on the detector."""
        return _State(constants.kind.xp.sqrt(frames))

    def step(self, phasor: NDArray, state: _State, constants: Propagator) -> Estimate:
        """Propagate to the detector and back."""
        waves = constants.propagate(constants.field(phasor))
        # A modelled field of 0 has no phase: such a pixel adds nothing on the way back.
        return Estimate(constants.adjoint(unit(waves, state.amplitude, constants.kind.xp)))


@dataclass
class _State(State):
    amplitude: NDArray[np.floating]  # (k, n_masks, ny', nx'), measured
