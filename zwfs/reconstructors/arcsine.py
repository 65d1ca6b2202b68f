"""Iterative arcsine reconstruction from one pupil image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs.reconstructors._common import Reconstruction, count, iterate, settings, unit
from zwfs.sensor import ZernikeSensor, square


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
        amplitude, mask = self.settings.amplitude, sensor.pupil.mask
        # Where there is no light inside the pupil the field comes out as 0, and the phase stays what it was.
        self._dark = mask & (amplitude == 0)
        self._gain = np.where(self._dark, 0, 1 / (2 * np.where(amplitude > 0, amplitude, 1)))

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame; parameters, result and errors are those of `PhaseShifted`."""
        return iterate(self, frames, start, history)

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool) -> dict[str, NDArray]:
        """Intensity less that of the incoming light, and the side of the reference wave to look on."""
        maps = self.settings.maps(phasor.dtype)
        psi = maps.field(phasor)
        wave = self._reference(psi)
        # The side is fixed once: the piston of the estimate, which no intensity shows, may drift past the wave.
        ahead = wave[:, 0] * psi[:, 1] - wave[:, 1] * psi[:, 0] >= 0
        return {
            "excess": frames[:, 0][(..., *self.settings.sensor.window)] - maps.amplitude**2,
            "side": np.where(self._dark, 0, np.where(ahead, 1, -1)).astype(phasor.dtype),
        }

    def step(self, phasor: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Reference wave of the estimate, then both parts of the field along it, times its modulus."""
        wave = self._reference(self.settings.maps(phasor.dtype).field(phasor))
        power = square(wave)
        along = (data["excess"] - power) * self._gain.astype(phasor.dtype, copy=False)
        across = power - along**2
        n_unsolved = count((across < 0) & self.settings.sensor.pupil.mask)
        across = data["side"] * np.sqrt(np.maximum(across, 0))
        new = along[:, np.newaxis] * wave
        new[:, 0] -= across * wave[:, 1]
        new[:, 1] += across * wave[:, 0]
        return unit(new, phasor, self.settings.maps(phasor.dtype).inside), n_unsolved + np.count_nonzero(
            self._dark
        )

    def _reference(self, psi: NDArray) -> NDArray:
        return self.settings.sensor.operator(psi.dtype).split_reference(psi, in_window=True)[:, 0]
