"""Iterative arcsine reconstruction from one pupil image."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs._arrays import Kind
from zwfs.lowrank import Operator, split_core
from zwfs.reconstructors.base import (
    Estimate,
    Reconstruction,
    Reconstructor,
    count,
    for_each,
    iterate,
    settings,
    steady,
    turn,
)
from zwfs.sensor import ZernikeSensor, square

_IN_LINE = 1e-6  # sine of the angle between a field and its reference wave below which they count as in line


class Arcsine(Reconstructor):
    """Phase from one mask: the two-wave interference is inverted, with a reference wave that is updated.

    A cosine has two inverses, one on each side of the phase of the reference wave. Taken at every point, in all
    iterations, is the side on which the starting phase lies of its own reference wave. For a dimple of +pi/2 and a
    flat start that covers about -pi/4 to 3 pi/4; a true phase beyond is folded back, which limits this method.
    The reference wave goes with the mean phase, so both are counted from the piston of the wavefront. A starting
    phase in line with that of its reference wave counts as ahead of it. The piston is that of `PhaseShifted`.
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
        super().__init__(settings(sensor, n_iterations, tolerance, amplitude))
        if sensor.n_masks != 1:
            raise ValueError(f"sensor has {sensor.n_masks} masks: expected one; PhaseShifted takes more")
        self._constants: dict[Kind, _Constants] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_constants": {}}  # made again where they are needed

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame; parameters, result and errors are those of `PhaseShifted`."""
        return iterate(self, frames, start, history)

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool, kind: Kind) -> dict[str, NDArray]:
        """Interference term of the frames, and the side of the reference wave to look on."""
        maps, constants = self.settings.maps(kind), self._of(kind)
        light = frames[:, 0, ...][(..., *self.sensor.window)]
        data = {"excess": (light - maps.amplitude**2) * constants.gain}
        if flat:
            start = constants.flat
            return data | {name: for_each(array, frames.shape[0], kind.xp) for name, array in start.items()}
        return data | _start(maps.field(phasor), constants.operator, constants.core, kind)

    def step(self, phasor: NDArray, data: dict[str, NDArray], kind: Kind) -> Estimate:
        """Reference wave of the estimate, then both parts of the field along it, times its modulus."""
        xp, maps, constants = kind.xp, self.settings.maps(kind), self._of(kind)
        wave = data.pop("wave", None)  # that of the start is known
        if wave is None:
            coefficients = constants.operator.split_project(maps.field(phasor))
            if self.settings.tolerance:
                coefficients = steady(coefficients, data, xp)
            wave = _wave(coefficients, constants.operator, constants.core)
        power = square(wave)
        along = data["excess"] - constants.gain * power
        across = power - along * along
        n_unsolved: NDArray[np.int64] | int = constants.n_dark
        if xp.min(across) < 0:
            beyond = across < 0
            n_unsolved = n_unsolved + count(beyond, kind)
            along = xp.where(beyond, xp.sign(along) * xp.sqrt(power), along)
            across = xp.where(beyond, kind.array(0.0), across)
        new = turn(wave, along, data["side"] * xp.sqrt(across))
        if constants.n_dark:
            new = xp.where(constants.dark, phasor, new)
            power = xp.where(constants.dark, kind.array(1.0), power)
        # Both parts together are as long as the wave that they multiply, so the modulus is its square.
        return Estimate(new, n_unsolved, power)

    def _of(self, kind: Kind) -> _Constants:
        """Constants for arrays of one kind; made once, then kept."""
        if kind not in self._constants:
            amplitude, sensor, exact = self.settings.amplitude, self.sensor, Kind.numpy()
            mask, core = sensor.pupil.inside, split_core(sensor.factors.core)
            lit = mask & (amplitude > 0)
            gain = np.where(lit, 1 / (2 * np.where(lit, amplitude, 1)), 0)
            dark = mask & ~lit
            maps = self.settings.maps(exact)
            flat = _start(maps.field(maps.flat), sensor.operator(exact), core, exact)
            self._constants[kind] = _Constants(
                sensor.operator(kind), kind.array(core), kind.array(gain), kind.flags(dark), int(dark.sum()),
                {name: kind.array(array) for name, array in flat.items()},
            )  # fmt: skip
        return self._constants[kind]


class _Constants(NamedTuple):
    """What all frames share, as arrays of one kind."""

    operator: Operator
    core: NDArray[np.floating]  # coefficients of the field (k, 2 r) to those of the wave
    gain: NDArray[np.floating]  # (ny, nx), 1 / (2 A); 0 where there is no light
    dark: NDArray[np.bool_]  # (ny, nx), no light inside the pupil: the phase stays what it was
    n_dark: int
    flat: dict[str, NDArray[np.floating]]  # what a flat wavefront gives to the steps, (1, ...)


def _start(psi: NDArray, operator: Operator, core: NDArray, kind: Kind) -> dict[str, NDArray]:
    """What a starting field gives to the steps: its coefficients and reference wave, and its side of that."""
    coefficients = operator.split_project(psi)
    wave = _wave(coefficients, operator, core)
    # The side is fixed once: later estimates may lie anywhere about their waves. A field in line with its wave
    # counts as ahead, and not as rounding has it.
    cross = wave[:, 0, ...] * psi[:, 1, ...] - wave[:, 1, ...] * psi[:, 0, ...]
    ahead = cross >= -_IN_LINE * kind.xp.sqrt(square(wave) * square(psi))
    side = kind.xp.where(ahead, kind.array(1.0), kind.array(-1.0))
    return {"tried": coefficients, "wave": wave, "side": side}


def _wave(coefficients: NDArray, operator: Operator, core: NDArray) -> NDArray:
    """Reference wave, (k, 2, ny, nx), of coefficients of the field, (k, 2 r)."""
    return operator.split_expand(coefficients @ core, in_window=True)[:, 0, ...]
