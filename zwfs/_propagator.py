"""The model that sensors and reconstructors compute with: split fields of one kind of arrays.

`propagator` returns the model of a sensor. `pupil_maps`, `amplitude_maps` and `warn_of_degrees` check input;
nothing else here does.

A split field has shape (..., 2, ny, nx): the real part, then the imaginary part. It is 0 outside the pupil. A
phasor is exp(i phase) as a split field. `k` is the number of frame sets in a batch.

With several wavelengths, a split field has two parts for each of them: (..., 2 n_wavelengths, ny, nx). The root of
the weight of a wavelength is a factor of its field, so an intensity is the sum of the squares of all parts
(`Channels`).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import reduce
from math import prod, sqrt
from operator import add
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, added, any_array, holds, per_kind, read_only
from zwfs._lowrank import Factors, Operator
from zwfs.pupil import Pupil

_DEGREES = 20.0  # radian rms; no phase map reaches it, the same map in degrees soon does
_RANGE = 1e30  # of the light in the pupil, and of its inverse: its square is a number in single precision, too
_VANISHING = 1e-30  # modulus, or its square, of a field that counts as 0


class Channels(NamedTuple):
    """Wavelengths of a sensor: each has the field sqrt(weight) amplitude exp(i ratio phase).

    Attributes
    ----------
    ratios : tuple of float
        Reference wavelength over wavelength: a phase is an optical path, so it scales with the ratio.
    weights : tuple of float
        Share of the light; their sum is 1.
    """

    ratios: tuple[float, ...] = (1.0,)
    weights: tuple[float, ...] = (1.0,)


ONE_WAVELENGTH = Channels()


class SensorParts(Protocol):
    """Parts of a sensor from which its model is made."""

    @property
    def pupil(self) -> Pupil: ...
    @property
    def factors(self) -> Factors: ...
    @property
    def window(self) -> tuple[slice, slice]: ...
    @property
    def channels(self) -> Channels: ...


@dataclass(frozen=True, eq=False)
class Propagator:
    """Propagation through a sensor, and the maps of its pupil, for arrays of one kind.

    Maps have shape (ny, nx); those of NumPy are read-only.
    """

    kind: Kind  # of real arrays
    pupil: Pupil
    operator: Operator
    window: tuple[slice, slice]  # where the grid of the pupil lies on the detector
    inside: NDArray[np.bool_]  # whether a point lies inside the pupil
    stop: NDArray[np.floating]  # 1 inside, 0 outside
    no_data: NDArray[np.floating]  # 0 inside, NaN outside: added to a map that people look at
    amplitude: NDArray[np.floating]  # of the incoming field, 0 outside
    flat: NDArray[np.floating]  # (1, 2, ny, nx), phasor of a flat wavefront
    channels: Channels

    @classmethod
    def of(cls, sensor: SensorParts, kind: Kind) -> Propagator:
        """Convert the factors of a sensor and the maps of its pupil."""
        pupil = sensor.pupil
        stop = read_only(kind.array(pupil.inside))
        model = cls(
            kind,
            pupil,
            Operator(sensor.factors, sensor.window, kind),
            sensor.window,
            inside=read_only(kind.flags(pupil.inside)),
            stop=stop,
            no_data=read_only(kind.array(np.where(pupil.inside, 0, np.nan))),
            amplitude=stop,
            flat=read_only(kind.xp.stack((stop, kind.xp.zeros_like(stop)))[np.newaxis, ...]),
            channels=sensor.channels,
        )
        return model.with_amplitude(pupil.amplitude)

    def with_amplitude(self, amplitude: NDArray[np.float64]) -> Propagator:
        """Return the same model for another amplitude of the incoming field, an array of NumPy, (ny, nx)."""
        uniform = np.array_equal(amplitude, self.pupil.inside)
        return replace(self, amplitude=self.stop if uniform else read_only(self.kind.array(amplitude)))

    def field(self, phasor: NDArray) -> NDArray:
        """Field of a phasor, (k, 2, ny, nx); for a uniform amplitude the phasor itself."""
        return phasor if self.amplitude is self.stop else phasor * self.amplitude

    def incoming(self, phase: NDArray, amplitude: NDArray | None = None) -> NDArray:
        """Field of a phase, (k, ny, nx), at every wavelength: (k, 2 n_wavelengths, ny, nx)."""
        amplitude = self.amplitude if amplitude is None else amplitude
        if self.channels == ONE_WAVELENGTH:
            return split(phase, amplitude)
        parts = [split(s * phase, w**0.5 * amplitude) for s, w in zip(*self.channels, strict=True)]
        return self.kind.xp.concat(parts, axis=1)

    def reference(self, psi: NDArray) -> NDArray:
        """Reference waves on the grid of the pupil: (k, 2, ny, nx) to (k, n_masks, 2, ny, nx)."""
        return self.operator.split_reference(psi, in_window=True)

    def propagate(self, psi: NDArray) -> NDArray:
        """Fields on the detector: (k, 2, ny, nx) to (k, n_masks, 2, ny', nx')."""
        return added(self.operator.split_reference(psi), psi[:, np.newaxis, ...], self.window)

    def adjoint(self, waves: NDArray) -> NDArray:
        """Adjoint of `propagate`: (k, n_masks, 2, ny', nx') to (k, 2, ny, nx)."""
        psi = self.operator.split_adjoint(waves)
        psi += self.kind.xp.sum(waves[(..., *self.window)], axis=1)
        psi *= self.stop
        return psi

    def mismatch(self, phase: NDArray, light: NDArray) -> NDArray:
        """Squared difference between modelled and measured frames, summed over masks and points of the pupil.

        The phase is 0 outside the pupil, (k, ny, nx). The frames are cut to the grid of the pupil,
        (k, n_masks, ny, nx). The result has shape (k,).
        """
        psi = self.incoming(phase)
        difference = (square(self.reference(psi) + psi[:, np.newaxis, ...]) - light) * self.stop
        difference = self.kind.xp.reshape(difference, (psi.shape[0], -1))
        return self.kind.xp.vecdot(difference, difference)


@per_kind
def propagator(sensor: SensorParts, kind: Kind) -> Propagator:
    """Return the model of a sensor for arrays of one kind."""
    return Propagator.of(sensor, kind)


def pupil_maps(name: str, maps: ArrayLike, sensor: SensorParts) -> tuple[NDArray[np.floating], tuple[int, ...]]:
    """Return checked real maps, (k, ny, nx) with 0 outside the pupil, and the shape of their batch."""
    shape = sensor.pupil.shape
    maps = _check.real_any(name, maps)
    _check.trailing_shape(name, maps, shape, "the shape of the pupil")
    batch = tuple(maps.shape[:-2])
    if not prod(batch):
        raise ValueError(f"{name} has shape {tuple(maps.shape)}: expected at least one map")
    kind = Kind.of(maps)
    clean = kind.xp.where(propagator(sensor, kind).inside, maps, kind.array(0.0))
    _check.moderate(name, clean, " inside the pupil")
    return kind.xp.reshape(clean, (-1, *shape)), batch


def amplitude_maps(
    amplitude: ArrayLike | None, sensor: SensorParts, kind: Kind
) -> tuple[NDArray[np.floating], tuple[int, ...]]:
    """Return checked amplitudes, (k, ny, nx) with 0 outside, and the shape of their batch; None: the pupil's."""
    if amplitude is None:
        return propagator(sensor, kind).amplitude[np.newaxis, ...], ()
    maps, batch = pupil_maps("amplitude", amplitude, sensor)
    _check.non_negative("amplitude", maps)
    xp = Kind.of(maps).xp
    if not holds(xp.all(xp.any(maps > 0, axis=(-2, -1)))):
        raise ValueError("amplitude is 0 everywhere in the pupil: expected some light")
    with np.errstate(over="ignore"):
        maps = _check.in_kind("amplitude", maps, kind)
    _check.moderate("amplitude", maps)
    return maps, batch


def amplitude_map(amplitude: ArrayLike | None, sensor: SensorParts) -> NDArray[np.float64]:
    """Return one checked amplitude, (ny, nx) with 0 outside, of a moderate brightness; None: the pupil's."""
    maps, batch = amplitude_maps(amplitude, sensor, Kind.numpy())
    if batch:
        raise ValueError(f"amplitude has shape {(*batch, *sensor.pupil.shape)}: expected {sensor.pupil.shape}")
    light = float(np.sum(maps[0] * maps[0]))
    if not 1 / _RANGE < light < _RANGE:
        raise ValueError(f"amplitude: its squares add up to {light:.3g}: expected {1 / _RANGE:g} to {_RANGE:g}")
    return maps[0]


def warn_of_degrees(phase: NDArray, pupil: Pupil, stacklevel: int) -> None:
    """Warn if the rms of a phase, (k, ny, nx) with 0 outside the pupil, is too large for one in radian."""
    xp, axes = any_array(phase)[1], (-2, -1)
    mean = xp.sum(phase, axis=axes) / pupil.n_points
    squares = xp.max(xp.sum(phase * phase, axis=axes) / pupil.n_points - mean * mean)
    if not holds(squares <= _DEGREES**2):
        warnings.warn(
            f"phase has an rms of {sqrt(squares):.4g}: expected radian, less than {_DEGREES:g} rms; is it in "
            "degrees?",
            UserWarning,
            stacklevel=stacklevel,
        )


def split(phase: NDArray, amplitude: NDArray) -> NDArray:
    """Field amplitude * exp(i phase): (k, ny, nx) to (k, 2, ny, nx)."""
    xp = any_array(phase)[1]
    return xp.stack([xp.cos(phase) * amplitude, xp.sin(phase) * amplitude], axis=1)


def square(waves: NDArray) -> NDArray:
    """Squared modulus, summed over the wavelengths: (..., 2 n_wavelengths, ny, nx) to (..., ny, nx)."""
    parts = (waves[..., part, :, :] for part in range(waves.shape[-3]))
    return reduce(add, (part * part for part in parts))


def parts_sum(products: NDArray) -> NDArray:
    """Sum over the parts of a split field: (..., n_parts, ny, nx) to (..., ny, nx)."""
    return reduce(add, (products[..., part, :, :] for part in range(products.shape[-3])))


def along_phase(psi: NDArray, ratios: tuple[float, ...], xp: Any) -> NDArray:
    """Change of a split field per radian of the phase, i ratio psi at each wavelength: the shape of `psi`."""
    parts: list[NDArray] = []
    for index, ratio in enumerate(ratios):
        real, imag = psi[:, 2 * index, ...], psi[:, 2 * index + 1, ...]
        parts += [-imag, real] if ratio == 1 else [-ratio * imag, ratio * real]
    return xp.stack(parts, axis=1)


def modulus_of(field: NDArray, xp: Any) -> NDArray:
    """Modulus: (..., 2, ny, nx) to (..., ny, nx); a number above 0 where the field vanishes."""
    power = square(field)
    power += _VANISHING
    return xp.sqrt(power)


def angle(field: NDArray, xp: Any) -> NDArray:
    """Phase: (..., 2, ny, nx) to (..., ny, nx)."""
    return xp.atan2(field[..., 1, :, :], field[..., 0, :, :])


def turn(wave: NDArray, along: NDArray, across: NDArray) -> NDArray:
    """Product (along + i across) wave, of two maps (k, ny, nx) and a wave (k, 2, ny, nx)."""
    turned = along[:, np.newaxis, ...] * wave
    ahead = across[:, np.newaxis, ...] * wave
    turned[:, 0, ...] -= ahead[:, 1, ...]
    turned[:, 1, ...] += ahead[:, 0, ...]
    return turned


def unit(field: NDArray, modulus: NDArray, xp: Any, before: NDArray | None = None) -> NDArray:
    """Field with another modulus, (..., ny, nx); 0 where the field vanishes. The array of `field` is reused.

    `before` is the modulus of `field`, if that is known.
    """
    before = modulus_of(field, xp) if before is None else before + _VANISHING
    field *= (modulus / before)[..., np.newaxis, :, :]
    return field


def count(points: NDArray[np.bool_], kind: Kind) -> NDArray[np.int64]:
    """Number of points that are true in each map: (k, ny, nx) to (k,)."""
    if kind.xp is np:  # along an axis NumPy turns all of them into integers first
        return np.array([np.count_nonzero(flags) for flags in points])
    return kind.xp.sum(kind.xp.astype(points, kind.xp.int64), axis=(-2, -1))


def with_piston_of(before: NDArray, new: NDArray, xp: Any) -> NDArray:
    """Coefficients (k, 2 r) turned by the constant phase that brings them nearest to those before.

    The frames do not depend on a piston, and one iteration F obeys F(exp(i a) psi) = exp(i a) F(psi) for any a. It
    therefore may settle at F(psi) = exp(i w) psi: where no phase explains the frames, because of noise or a wrong
    model, each iteration adds the piston w. The angle that makes <before, new> real and positive removes w and
    changes nothing else. A fixed gauge, such as a real mean field, would fail where the mean field vanishes.
    """
    rank = new.shape[-1] // 2
    real, imag = new[:, :rank], new[:, rank:]
    across = xp.vecdot(before[:, :rank], imag) - xp.vecdot(before[:, rank:], real)
    ahead = xp.atan2(across, xp.vecdot(before, new))[:, np.newaxis]
    return xp.cos(ahead) * new + xp.sin(ahead) * xp.concat([imag, -real], axis=-1)
