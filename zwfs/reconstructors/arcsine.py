"""Iterative arcsine reconstruction from one pupil image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs.reconstructors._common import Reconstruction, iterate, settings
from zwfs.sensor import ZernikeSensor, split, square


class Arcsine:
    """Phase from one mask: the two-wave interference is inverted, with a reference wave that is updated.

    A cosine has two inverses, one on each side of the phase of the reference wave. Taken at every point, in all
    iterations, is the side on which the starting phase lies of its own reference wave. For a dimple of +pi/2 and a
    flat start that covers about -pi/4 to 3 pi/4; a true phase beyond is folded back, which limits this method.
    The reference wave goes with the mean phase, so both are counted from the piston of the wavefront.
    Cosines beyond +-1 are taken as +-1 and counted.

    Parameters
    ----------
    sensor : ZernikeSensor
        With one mask.
    n_iterations, tolerance, amplitude
        As for `PhaseShifted`.

    Raises
    ------
    ValueError
        If the sensor has more than one mask, or an argument is out of range.

    References
    ----------
    Chambouleyron et al. 2024, equation (6); Steeves et al. 2020; Haffert 2024; `eq-branch` of the book.
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
    ) -> None:
        self.settings = settings(sensor, n_iterations, tolerance, amplitude)
        if sensor.n_masks != 1:
            raise ValueError(f"sensor has {sensor.n_masks} masks: expected one; PhaseShifted takes more")

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame; parameters, result and errors are those of `PhaseShifted`."""
        return iterate(self, frames, start, history)

    def prepare(self, frames: NDArray, amplitude: NDArray, start: NDArray) -> dict[str, NDArray]:
        """Intensity less that of the incoming light, and the side of the reference wave to look on."""
        sensor = self.settings.sensor
        psi = split(start, amplitude)
        wave = sensor.operator(start.dtype).split_reference(psi, in_window=True)[:, 0]
        # The side is fixed once: the piston of the estimate, which no intensity shows, may drift past the wave.
        ahead = wave[:, 0] * psi[:, 1] - wave[:, 1] * psi[:, 0] >= 0
        return {
            "excess": frames[:, 0][(..., *sensor.window)] - amplitude**2,
            "side": np.where(ahead, 1, -1).astype(start.dtype),
        }

    def step(self, phasor: NDArray, amplitude: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Reference wave of the estimate, then the cosine of the angle to it at every point."""
        pupil = self.settings.sensor.pupil
        wave = self.settings.sensor.operator(phasor.dtype).split_reference(phasor * amplitude, in_window=True)[
            :, 0
        ]
        power = square(wave)
        contrast = 2 * amplitude * np.sqrt(power)
        solvable = contrast > 0
        cosine = np.divide(data["excess"] - power, contrast, out=np.full_like(power, 2.0), where=solvable)
        n_unsolved = np.count_nonzero((np.abs(cosine) > 1) & pupil.mask, axis=(-2, -1))
        cosine = np.clip(cosine, -1, 1)
        sine = data["side"] * np.sqrt(1 - cosine**2)
        # exp(i phase) = exp(i phi_ref) (cosine + i sine)
        direction = np.divide(
            wave, np.sqrt(power)[:, np.newaxis], out=phasor.copy(), where=solvable[:, np.newaxis]
        )
        new = np.stack(
            [direction[:, 0] * cosine - direction[:, 1] * sine, direction[:, 1] * cosine + direction[:, 0] * sine],
            axis=1,
        )
        return np.where(solvable[:, np.newaxis], new, phasor), n_unsolved
