"""Simulated screens and frames of benches with errors, from which `LearnedReference` learns.

The frames are made in single precision, and in the pupil only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from zwfs import _check
from zwfs._arrays import Kind
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

_TOLERANCE = 1e-5  # of the reference waves, like the rounding of single precision
_BOX = 1.5  # D; the random screens repeat after this length
_STEEPEST, _FLATTEST = -4.0, -1.5  # exponents of their power spectral densities
_LARGEST_SCALES = 0.3, 10.0  # D, beyond which a spectrum is flat
_TILT = 0.5  # mean rms of the tilt that is added to a screen of an rms of 1
_LOWEST_CUT = 2.0  # cycles / D, where the spectrum of half of the screens may end
_N_DIAMETERS = 5  # of dimples between which one of another diameter is interpolated
LIMITS = {"leakage": (-0.2, 0.4), "flux_ratio": (0.2, 5.0), "diameter": (-0.5, 0.5), "phase_shift": (-1.0, 1.0),
           "amplitude": (0.0, 0.5), "blur": (0.0, 5.0)}  # fmt: skip


@dataclass(frozen=True)
class BenchErrors:
    """What a bench may do that its model does not know: each is a range, from which training draws evenly.

    A mask that is not centred needs no range: its offset is a tilt of the wavefront.

    One set of frames shows leakage and flux ratio best. A training of 20 000 screens at 0.2 to 1 rad rms and 3000
    photons or more reads diameter and phase shifts with a scatter of 0.03 lambda/D and 0.03 rad, and the variation
    of the amplitude hardly at all: average many sets.

    Parameters
    ----------
    leakage : (float, float)
        Fraction of the light of each of two images that belongs to the other one.
    flux_ratio : (float, float)
        Light of the first image over that of the second, with the mask out.
    diameter : (float, float), lambda/D
        To be added to that of the dimples.
    phase_shift : (float, float), radian
        To be added to the phase shift of each dimple, independently.
    amplitude : (float, float)
        Relative rms of a random smooth change of the amplitude.
    blur : (float, float), pixels rms
        Of the images, Gaussian.
    """

    leakage: tuple[float, float] = (0.0, 0.0)
    flux_ratio: tuple[float, float] = (1.0, 1.0)
    diameter: tuple[float, float] = (0.0, 0.0)
    phase_shift: tuple[float, float] = (0.0, 0.0)
    amplitude: tuple[float, float] = (0.0, 0.0)
    blur: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            ends = _check.pair(field.name, getattr(self, field.name), _check.number, *LIMITS[field.name])
            if ends[0] > ends[1]:
                raise ValueError(f"{field.name} = {ends}: expected a smallest and a largest value")
            object.__setattr__(self, field.name, ends)

    def ranges(self, n_masks: int) -> NDArray[np.float64]:
        """Ranges of all values, (n_values, 2): one for each field, and for `phase_shift` one for each mask."""
        counts = [n_masks if field.name == "phase_shift" else 1 for field in fields(self)]
        return np.repeat([getattr(self, field.name) for field in fields(self)], counts, axis=0)


class BenchValues(NamedTuple):
    """Errors of a bench, as `BenchErrors` names them; `...` is the batch of the frames."""

    leakage: NDArray[np.floating]
    flux_ratio: NDArray[np.floating]
    diameter: NDArray[np.floating]
    phase_shift: NDArray[np.floating]  # (..., n_masks)
    amplitude: NDArray[np.floating]
    blur: NDArray[np.floating]

    @classmethod
    def of(cls, values: NDArray) -> BenchValues:
        """Name values of shape (..., n_values)."""
        return cls(
            values[..., 0], values[..., 1], values[..., 2], values[..., 3:-2], values[..., -2], values[..., -1]
        )


class Light(NamedTuple):
    """Light of the frames."""

    photons: tuple[float, float]  # smallest and largest number, of an intensity of 1 in a pixel
    read_noise: float  # electrons rms


def dimples_of(sensor: ZernikeSensor) -> list[Dimple]:
    """Masks of a sensor, which must be dimples of one diameter."""
    dimples = [mask for mask in sensor.masks if type(mask) is Dimple and mask.diameter == sensor.masks[0].diameter]
    for index, mask in enumerate(sensor.masks):
        if mask not in dimples:
            raise ValueError(f"sensor: masks[{index}] = {mask!r}: expected dimples of one diameter")
    return dimples


class Simulation:
    """Frames of a sensor whose masks are dimples of one diameter, on benches with errors."""

    def __init__(self, sensor: ZernikeSensor, amplitude: NDArray, errors: BenchErrors, light: Light) -> None:
        self.pupil, self.errors, self.light = sensor.pupil, errors, light
        self.amplitude = amplitude.astype(np.float32)
        dimples = dimples_of(sensor)
        self.shifts = np.array([mask.phase for mask in dimples])
        self.strengths = np.array([mask.amplitude for mask in dimples])
        diameter, (low, high) = dimples[0].diameter, errors.diameter
        n_nodes = _N_DIAMETERS if high > low else 1
        nodes = np.cos(pi * (np.arange(n_nodes) + 0.5) / n_nodes)
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        diameters = diameter + self.middle + self.half * nodes
        discs = ZernikeSensor(self.pupil, *(Dimple(size, pi) for size in diameters), tolerance=_TOLERANCE)
        # A dimple of pi subtracts twice the wave of its disc. A polynomial of the diameter goes through all.
        cores = discs.factors.core.real / -2
        self.powers = np.linalg.solve(np.vander(nodes), cores.reshape(n_nodes, -1)).reshape(cores.shape)
        kind = Kind.numpy(np.float32)
        self.plane = discs.factors.pupil.to(kind)
        self.window = discs.factors.detector.cut(*discs.window).to(kind)
        self.n_values = len(errors.ranges(len(self.shifts)))
        self.nominal = self._disc(self.amplitude[np.newaxis].astype(np.complex64), 0.0)

    def frames(
        self, phases: NDArray, values: NDArray, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.complex64]]:
        """Frames (k, n_masks, ny, nx) and disc waves (k, ny, nx) of phases on benches of some values.

        The diameters and blurs of the values, (k, n_values), are those of the first bench.
        """
        bench, k = BenchValues.of(values.astype(np.float32)), len(phases)
        relative = random_screens(self.pupil, k, rng) if bench.amplitude.any() else np.zeros((), np.float32)
        field = (1 + bench.amplitude[:, np.newaxis, np.newaxis] * relative) * self.amplitude
        field = field * np.exp(1j * phases)
        disc = self._disc(field, float(bench.diameter[0]))
        factors = (self.strengths * np.exp(1j * (self.shifts + bench.phase_shift)) - 1).astype(np.complex64)
        frames = np.empty((k, len(self.shifts), *disc.shape[1:]), np.float32)
        for index in range(len(self.shifts)):
            wave = field + factors[:, index, np.newaxis, np.newaxis] * disc
            frames[:, index] = wave.real**2 + wave.imag**2
        return self._detected(frames, bench, rng), disc

    def first_look(self, flat: NDArray) -> NDArray[np.complex64]:
        """Disc waves (k, ny, nx) of the first solve of frames (k, n_masks, ny * nx), with a flat reference."""
        weights, power_weight = solution_weights(self.shifts, self.strengths)
        light, nominal = (self.amplitude**2).ravel(), self.nominal.ravel()
        power = np.abs(nominal) ** 2
        solved = (weights.astype(np.complex64) @ (flat - light)) - np.complex64(power_weight) * power
        if len(self.shifts) == 1:
            unseen = np.sqrt(np.maximum(light * power - np.abs(solved) ** 2, 0))
            solved += np.complex64(unseen_direction(self.shifts, self.strengths)) * unseen
        field = np.where(self.pupil.inside.ravel(), solved * nominal, 0)
        return self._disc(field.reshape(len(flat), *self.pupil.shape).astype(np.complex64), 0.0)

    def _disc(self, field: NDArray, change: float) -> NDArray[np.complex64]:
        """Waves of the disc of the dimples, whose diameter differs by a change, (k, ny, nx)."""
        place = (change - self.middle) / self.half if self.half else 0.0
        core = np.tensordot(np.vander([place], len(self.powers))[0], self.powers, 1).astype(np.float32)
        return self.window.expand_complex(self.plane.project_complex(field) @ core.T)

    def _detected(self, frames: NDArray, bench: BenchValues, rng: np.random.Generator) -> NDArray[np.float32]:
        """Frames with blur, leakage, unequal light and noise."""
        leakage = bench.leakage[:, np.newaxis, np.newaxis, np.newaxis]
        if leakage.any():
            frames = (1 - leakage) * frames + leakage * frames[:, ::-1]
        if bench.blur[0] > 0:
            along_y, along_x = (_blur_matrix(n, float(bench.blur[0])) for n in frames.shape[2:])
            frames = along_y @ frames @ along_x.T
        frames[:, 1:] /= bench.flux_ratio[:, np.newaxis, np.newaxis, np.newaxis]
        low, high = np.log(self.light.photons)
        photons = np.exp(rng.uniform(low, high, len(frames))).astype(np.float32)[:, None, None, None]
        variance = np.maximum(frames, 0) / photons + (np.float32(self.light.read_noise) / photons) ** 2
        noise = rng.standard_normal(frames.shape, dtype=np.float32)
        return np.where(self.pupil.inside, frames + np.sqrt(variance) * noise, 0)


def random_screens(
    pupil: Pupil, n_screens: int, rng: np.random.Generator, *, alike: bool = False
) -> NDArray[np.float32]:
    """Random screens of unit rms, (n_screens, ny, nx), of spectra from steep to flat; 0 outside the pupil.

    With `alike` all have one random spectrum.
    """
    shape = [fft.next_fast_len(int(_BOX * length)) for length in pupil.shape]
    frequency = np.hypot(*np.meshgrid(*(fft.fftfreq(n) * pupil.n_pixels for n in shape), indexing="ij"))
    screens = np.empty((n_screens + n_screens % 2, *pupil.shape), np.float32)
    for first in range(0, len(screens), 2):  # the real and the imaginary part are independent
        if not (first and alike):
            exponent, scale = rng.uniform(_STEEPEST, _FLATTEST), np.exp(rng.uniform(*np.log(_LARGEST_SCALES)))
            cut = np.exp(rng.uniform(*np.log((_LOWEST_CUT, pupil.n_pixels**2 / _LOWEST_CUT))))
            spectrum = ((frequency**2 + scale**-2) ** (exponent / 4) * (frequency < cut)).astype(np.float32)
        parts = rng.standard_normal((2, *shape), dtype=np.float32)
        field = fft.fft2(spectrum * (parts[0] + 1j * parts[1]))[: pupil.shape[0], : pupil.shape[1]]
        screens[first], screens[first + 1] = field.real, field.imag
    screens = screens[:n_screens] / screens[:n_screens, pupil.inside].std(axis=1)[:, np.newaxis, np.newaxis]
    # A periodic box makes too little tilt.
    tilts = rng.exponential(_TILT, (1 if alike else n_screens, 1)) * rng.standard_normal((n_screens, 2))
    screens += np.einsum(
        "kd,dyx->kyx", tilts.astype(np.float32), np.stack(np.broadcast_arrays(4 * pupil.y[:, None], 4 * pupil.x))
    )
    screens -= screens[:, pupil.inside].mean(axis=1)[:, np.newaxis, np.newaxis]
    screens /= screens[:, pupil.inside].std(axis=1)[:, np.newaxis, np.newaxis]
    return np.where(pupil.inside, screens, np.float32(0))


def solution_weights(
    shifts: NDArray, strengths: Sequence[float] | NDArray
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Weights p (..., n_masks) of the frames in u = psi conj(D), and the weight e (...) of |D|^2.

    With c = t - 1 of each dimple, I = A^2 + |c|^2 |D|^2 + 2 Re(conj(c) u). This is linear in the real and the
    imaginary part of u. Its least-squares solution is u = sum p (I - A^2) - e |D|^2 with e = sum p |c|^2. A single
    image shows only the part of u along c.
    """
    factors = strengths * np.exp(1j * shifts) - 1
    normal = np.linalg.pinv(2 * np.stack([factors.real, factors.imag], axis=-1))
    weights = normal[..., 0, :] + 1j * normal[..., 1, :]
    return weights, np.sum(weights * np.abs(factors) ** 2, axis=-1)


def unseen_direction(shifts: NDArray, strengths: Sequence[float] | NDArray) -> NDArray[np.complex128]:
    """Direction (...) of the part of u that a single image (shifts of shape (..., 1)) does not show.

    Its length follows from |u| = A |D|. Its sign is that of a flat wavefront, for which u is positive.
    """
    factor = (strengths * np.exp(1j * shifts) - 1)[..., 0]
    return -1j * factor / np.abs(factor) * np.where(factor.imag < 0, -1, 1)


def _blur_matrix(n: int, rms: float) -> NDArray[np.float32]:
    """Matrix of a Gaussian blur along one axis, whose ends are continued."""
    places = np.arange(n)
    kernel = np.exp(-0.5 * ((places[:, np.newaxis] - places) / rms) ** 2)
    return (kernel / kernel.sum(axis=1, keepdims=True)).astype(np.float32)
