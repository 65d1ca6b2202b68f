"""Iterative arcsine reconstruction from one pupil image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind, for_each, per_kind
from zwfs._lowrank import split_core
from zwfs._propagator import Propagator, count, square, turn, with_piston_of
from zwfs.reconstructors.base import Estimate, FixedPoint, State

_IN_LINE = 1e-6  # sine of the angle between a field and its reference wave below which they count as in line


class Arcsine(FixedPoint):
    """Phase from one mask: the two-wave interference is inverted, with a reference wave that is updated.

    A cosine has two inverses, one on each side of the phase of the reference wave. At each
    point the starting phase decides the side, and all iterations keep it. For a dimple of +pi/2 and a flat start
    this side covers about -pi/4 to 3 pi/4, counted from the piston of the wavefront. A true phase outside this
    range is folded back into it, which limits this method. A starting phase in line with its reference wave counts
    as ahead of it. The piston is held as by `PhaseShifted`. Cosines beyond +-1 are taken as +-1 and counted.

    Parameters
    ----------
    sensor : ZernikeSensor
        With one mask.
    n_iterations, tolerance, amplitude
        As for `PhaseShifted`.

    References
    ----------
    Chambouleyron et al. 2024, equation (6); Steeves et al. 2020; Haffert 2024; `eq-branch` of the book.
    """

    n_masks = 1, 1

    def begin(self, frames: NDArray, phasor: NDArray | None, constants: _Constants) -> _State:
        """Return the interference term of the frames, and the side of the reference wave on which phases lie."""
        model = constants.model
        light = frames[:, 0, ...][(..., *model.window)]
        excess = (light - model.amplitude**2) * constants.gain
        start = constants.flat if phasor is None else _start(model.field(phasor), model, constants.core)
        return _State(excess, *(for_each(array, frames.shape[0], model.kind.xp) for array in start))

    def step(self, phasor: NDArray, state: _State, constants: _Constants) -> Estimate:
        """Compute the reference wave of the estimate, then both parts of the field along it, times its modulus."""
        model = constants.model
        kind, xp = model.kind, model.kind.xp
        wave, state.wave = state.wave, None  # that of the start is known
        if wave is None:
            coefficients = model.operator.split_project(model.field(phasor))
            if self.settings.tolerance:
                coefficients = state.tried = with_piston_of(state.tried, coefficients, xp)
            wave = _wave(coefficients, model, constants.core)
        power = square(wave)
        along = state.excess - constants.gain * power
        across = power - along * along
        n_unsolved: NDArray[np.int64] | int = constants.n_dark
        if xp.min(across) < 0:
            beyond = across < 0
            n_unsolved = n_unsolved + count(beyond, kind)
            along = xp.where(beyond, xp.sign(along) * xp.sqrt(power), along)
            across = xp.where(beyond, kind.array(0.0), across)
        new = turn(wave, along, state.side * xp.sqrt(across))
        if constants.n_dark:
            new = xp.where(constants.dark, phasor, new)
            power = xp.where(constants.dark, kind.array(1.0), power)
        # Both parts together are as long as the wave that they multiply, so the modulus is its square.
        return Estimate(new, n_unsolved, power)

    @per_kind
    def constants(self, kind: Kind) -> _Constants:
        """Arrays of one kind that all frames share."""
        exact, inside, amplitude = Kind.numpy(), self.sensor.pupil.inside, self.settings.amplitude
        model, core = self.settings.model(exact), split_core(self.sensor.factors.core)
        lit = inside & (amplitude > 0)
        gain = np.where(lit, 1 / (2 * np.where(lit, amplitude, 1)), 0)
        dark = inside & ~lit
        coefficients, wave, side = _start(model.field(model.flat), model, core)
        return _Constants(
            model=self.settings.model(kind),
            core=kind.array(core),
            gain=kind.array(gain),
            dark=kind.flags(dark),
            n_dark=int(dark.sum()),
            flat=(kind.array(coefficients), kind.array(wave), kind.array(side)),
        )


@dataclass
class _State(State):
    excess: NDArray[np.floating]  # (k, ny, nx), (I - A^2) / (2 A)
    tried: NDArray[np.floating]  # (k, 2 r), coefficients of the field from which the last step started
    wave: NDArray[np.floating] | None  # (k, 2, ny, nx), reference wave of the first step
    side: NDArray[np.floating]  # (k, ny, nx), of the reference wave: 1 ahead of it, -1 behind


class _Constants(NamedTuple):
    model: Propagator
    core: NDArray[np.floating]  # coefficients of the field (k, 2 r) to those of the wave
    gain: NDArray[np.floating]  # (ny, nx), 1 / (2 A); 0 where there is no light
    dark: NDArray[np.bool_]  # (ny, nx), no light inside the pupil: the phase stays as it was
    n_dark: int
    flat: tuple[NDArray, NDArray, NDArray]  # `_start` of a flat wavefront, (1, ...)


def _start(psi: NDArray, model: Propagator, core: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Coefficients of a starting field, its reference wave, and the side of the wave on which the phase lies."""
    coefficients = model.operator.split_project(psi)
    wave = _wave(coefficients, model, core)
    # The side is fixed once: later estimates may lie anywhere about their waves. A field in line with its wave
    # counts as ahead, whatever its rounding error.
    cross = wave[:, 0, ...] * psi[:, 1, ...] - wave[:, 1, ...] * psi[:, 0, ...]
    ahead = cross >= -_IN_LINE * model.kind.xp.sqrt(square(wave) * square(psi))
    side = model.kind.xp.where(ahead, model.kind.array(1.0), model.kind.array(-1.0))
    return coefficients, wave, side


def _wave(coefficients: NDArray, model: Propagator, core: NDArray) -> NDArray:
    """Reference wave, (k, 2, ny, nx), of coefficients of the field, (k, 2 r)."""
    return model.operator.split_expand(coefficients @ core, in_window=True)[:, 0, ...]
