"""The equations of section 2 as the paper prints them, to test them by; no sensor or reconstructor needs them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.masks import Dimple, Mask
from zwfs.metrics import reconstruction_error, strehl
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

# Fields have the phases of the equations as their arguments: psi = sqrt(I) exp(i phi).

_STRONGEST = 1e30  # wave or frame, and inverse of a wave: their squares and products are numbers
_MOST_SAMPLES = 256  # half a gigabyte for 100 pixels

# Of the Strehl ratio, with which the common approximation scales the amplitude of the reference wave.
POWERS = {"amplitude × √S": 0.5, "intensity × √S": 0.25, "not scaled": 0.0}


def two_waves(incoming: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Right-hand side of equation (5): intensity of two interfering waves.

    Parameters
    ----------
    incoming, reference : ndarray of complex, shapes that broadcast
    """
    incoming, reference = _arrays(incoming=incoming, reference=reference)
    i_in, i_ref = np.abs(incoming) ** 2, np.abs(reference) ** 2
    return i_ref + i_in + 2 * np.sqrt(i_ref * i_in) * np.cos(np.angle(incoming) - np.angle(reference))


def fourier_waves(pupil: Pupil, mask: Mask, field: NDArray, padding: int = 8) -> tuple[NDArray, NDArray, NDArray]:
    """Equations (1) and (4) word by word, by Fourier transforms of a padded pupil.

    The mask is sampled at the points of the transform, so its edge is as coarse as they are: the result is exact
    for that coarse mask.

    Parameters
    ----------
    pupil : Pupil
    mask : Dimple, Patch or any Mask
    field : ndarray of complex, shape (ny, nx)
        In the pupil.
    padding : int
        Samples for each lambda/D.

    Returns
    -------
    outgoing, incoming, reference : ndarray of complex, shape (n, n)
        On a square of `padding` pupil diameters.
    """
    light = _light(pupil, mask, field)
    n = round(_check.integer("padding", padding, 2) * pupil.n_pixels)
    incoming = np.zeros((n, n), complex)
    incoming[: pupil.shape[0], : pupil.shape[1]] = light
    u = np.fft.fftfreq(n, 1 / pupil.n_pixels)
    v = u[:, np.newaxis]
    patch = np.hypot(u, v) <= mask.diameter / 2
    transmission = np.where(patch, mask.transmission(u + 0 * v, v + 0 * u), 1)
    spectrum = np.fft.fft2(incoming)
    return np.fft.ifft2(spectrum * transmission), incoming, np.fft.ifft2(spectrum * (transmission - 1))


def direct_reference_wave(pupil: Pupil, mask: Mask, field: NDArray, n_samples: int = 24) -> NDArray[np.complex128]:
    """Equation (4) as a sum over the patch, node by node: exact for a smooth patch, and slow.

    Parameters
    ----------
    pupil : Pupil
    mask : Dimple, Patch or any Mask
    field : ndarray of complex, shape (ny, nx)
    n_samples : int
        Nodes along a radius, at most 256; around the axis there are twice as many.

    Returns
    -------
    ndarray of complex, shape (ny, nx)
        In the plane of the detector, on the grid of the pupil.
    """
    light = _light(pupil, mask, field) / pupil.n_pixels**2
    nodes, weights = np.polynomial.legendre.leggauss(_check.integer("n_samples", n_samples, 2, _MOST_SAMPLES))
    radius = (nodes + 1) * mask.diameter / 4
    angles = np.arange(2 * n_samples) * np.pi / n_samples
    u, v = np.outer(radius, np.cos(angles)).ravel(), np.outer(radius, np.sin(angles)).ravel()
    area = np.outer(weights * radius * mask.diameter / 4, np.full(angles.size, np.pi / n_samples)).ravel()
    waves_x, waves_y = np.exp(2j * np.pi * np.outer(u, pupil.x)), np.exp(2j * np.pi * np.outer(v, pupil.y))
    spectrum = np.einsum("ky,yx,kx->k", waves_y.conj(), light, waves_x.conj(), optimize=True)
    return (waves_y.T * (area * (mask.transmission(u, v) - 1) * spectrum)) @ waves_x


def two_wave_errors(pupil: Pupil, mask: Mask, field: NDArray) -> tuple[float, float]:
    """Largest error of equation (5), and largest difference of the low-rank model from `direct_reference_wave`.

    Parameters
    ----------
    pupil : Pupil
    mask : Dimple, Patch or any Mask
    field : ndarray of complex, shape (ny, nx)
    """
    outgoing, incoming, reference = fourier_waves(pupil, mask, field)
    intensity_error = np.abs(outgoing) ** 2 - two_waves(incoming, reference)
    low_rank = ZernikeSensor(pupil, mask, tolerance=1e-14).reference_wave(field)[0]
    model_error = low_rank - direct_reference_wave(pupil, mask, field)
    return float(np.abs(intensity_error).max()), float(np.abs(model_error).max())


def arccosine_phase(frame: NDArray, amplitude: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Equation (6): phase from one frame and its reference wave.

    Parameters
    ----------
    frame, amplitude : ndarray, shape (..., n)
        Intensity, and the amplitude of the incoming field, at points of the pupil.
    reference : ndarray of complex, shape (..., n)
        Of a dimple of positive phase, which decides the sign of the arccosine, see `eq-branch` of the book.

    Returns
    -------
    ndarray, shape (..., n), radian
        Cosines beyond +-1 count as +-1.
    """
    frame = _check.real_array("frame", frame)
    frame, amplitude, reference = _arrays(frame=frame, amplitude=amplitude, reference=reference)
    _lit(amplitude=amplitude, reference=reference)
    return np.angle(reference) - np.arccos(np.clip(_cosine(frame, amplitude, reference), -1, 1))


def matrix_determinant(first: NDArray, second: NDArray) -> NDArray[np.floating]:
    """Determinant of the matrix M of equation (9), from its elements.

    Parameters
    ----------
    first, second : ndarray of complex, shapes that broadcast
        Reference waves of both masks.
    """
    first, second = _arrays(first=first, second=second)
    a, b = np.angle(first), np.angle(second)
    return np.cos(a) * np.sin(b) - np.sin(a) * np.cos(b)


def pair_phase(frames: NDArray, amplitude: NDArray, references: NDArray) -> NDArray[np.floating]:
    """Equation (9): phase from two frames and their reference waves.

    Parameters
    ----------
    frames : ndarray, shape (..., 2, n)
        Intensity at points of the pupil.
    amplitude : ndarray, shape (n,)
    references : ndarray of complex, shape (..., 2, n)

    Returns
    -------
    ndarray, shape (..., n), radian
    """
    frames = _check.real_array("frames", frames)
    frames, amplitude, references = _arrays(frames=frames, amplitude=amplitude, references=references)
    _lit(amplitude=amplitude, references=references)
    for name, values in (("frames", frames), ("references", references)):
        if values.ndim < 2 or values.shape[-2] != 2:
            raise ValueError(f"{name} has shape {values.shape}: expected (..., 2, n)")
    c = _cosine(frames, amplitude, references)
    a, b = np.moveaxis(np.angle(references), -2, 0)
    determinant = matrix_determinant(references[..., 0, :], references[..., 1, :])
    if not determinant.all():
        raise ValueError("references have the same phase at some points: expected two different ones at each")
    cosine = (np.sin(b) * c[..., 0, :] - np.sin(a) * c[..., 1, :]) / determinant
    sine = (np.cos(a) * c[..., 1, :] - np.cos(b) * c[..., 0, :]) / determinant
    return np.arctan2(sine, cosine)


@dataclass(frozen=True)
class ApproximationErrors:
    """Errors of an approximate reference wave; means over the screens.

    Attributes
    ----------
    phase : float, radian rms
        Of the first mask's wave, without piston, which no frame depends on.
    amplitude, wave : float
        Relative rms error of its amplitude, and of the whole wave without its piston.
    one_image, two_images : float, radian rms
        Of the phase after one step with it, by equation (6) and by equation (9).
    """

    phase: float
    amplitude: float
    wave: float
    one_image: float
    two_images: float


def approximation_errors(sensor: ZernikeSensor, screens: NDArray, power: float = 0.5) -> ApproximationErrors:
    """Test the common approximation: the wave of a flat wavefront, scaled with a power of the Strehl ratio S.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks, the phase of the first one in (0, pi].
    screens : ndarray, shape (n_screens, ny, nx), radian
    power : float
        The amplitude of the wave is multiplied by S to this power: 1/2 is right for a small mask, 1/4 what section
        2.1 prints, 0 leaves it alone.

    References
    ----------
    Chambouleyron et al. 2024, section 2.1.
    """
    screens = _screens(sensor, screens)
    power = _check.number("power", power, 0, 10)
    pupil = sensor.pupil
    amplitude = pupil.gather(pupil.amplitude)
    frames = pupil.gather(sensor.measure(screens))
    field = pupil.field(screens)
    true = pupil.gather(sensor.reference_wave(field))
    flat = pupil.gather(sensor.reference_wave(pupil.amplitude))
    guess = strehl(pupil, screens)[:, np.newaxis, np.newaxis] ** power * flat
    first, first_guess = true[:, 0], guess[:, 0]

    def phase_error(phase: NDArray, truth: NDArray) -> float:
        return float(reconstruction_error(pupil, pupil.scatter(phase), truth).mean())

    def relative(gap: NDArray) -> float:
        return float(np.mean(np.linalg.norm(gap, axis=-1) / np.linalg.norm(first, axis=-1)))

    overlap = np.mean(first * first_guess.conj(), axis=-1, keepdims=True)
    return ApproximationErrors(
        phase=phase_error(np.angle(first_guess), pupil.scatter(np.angle(first))),
        amplitude=relative(np.abs(first_guess) - np.abs(first)),
        wave=relative(first_guess * overlap / np.abs(overlap) - first),
        one_image=phase_error(arccosine_phase(frames[:, 0], amplitude, first_guess), screens),
        two_images=phase_error(pair_phase(frames, amplitude, guess), screens),
    )


def approximation_curves(
    sensor: ZernikeSensor, screens: NDArray, inputs: Sequence[float]
) -> dict[str, list[ApproximationErrors]]:
    """Errors of the common approximation with each of `POWERS`, for screens of 1 rad rms scaled to each input."""
    inputs = _check.real_map("inputs", inputs, 1).tolist()
    screens = _check.real_array("screens", screens)
    return {
        name: [approximation_errors(sensor, value * screens, power) for value in inputs]
        for name, power in POWERS.items()
    }


@dataclass(frozen=True)
class DimplePairs:
    """Determinants of all pairs of phase shifts on a grid round the circle; means over the pupil.

    Attributes
    ----------
    shifts : ndarray, shape (n_pairs, 2), radian
        Phase shifts a and b of each pair.
    difference : ndarray, shape (n_pairs,), radian
        Of the phase shifts, b less a, in [0, 2 pi).
    determinant : ndarray, shape (n_pairs,)
        Modulus of that of equation (9).
    strength : ndarray, shape (n_pairs,)
        Modulus of the determinant with the strength of both waves, over 4 |beta|^2.
    off_by_pi : float
        Fraction of points and pairs at which the phases of the waves differ by pi more or less than half the
        difference.
    sine_error, half_error : float
        Largest errors of the two forms of the determinant: the sine of the difference of the waves' phases, and
        this difference as half the one of the phase shifts, modulo pi.
    """

    shifts: NDArray[np.float64]
    difference: NDArray[np.float64]
    determinant: NDArray[np.float64]
    strength: NDArray[np.float64]
    off_by_pi: float
    sine_error: float
    half_error: float


def dimple_pairs(pupil: Pupil, diameter: float, n_shifts: int, field: NDArray) -> DimplePairs:
    """Take the determinant of every pair of dimples of `n_shifts` phase shifts, at every point of the pupil.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    n_shifts : int
        Phase shifts on the circle; that of 0 is left out, because it has no reference wave.
    field : ndarray of complex, shape (ny, nx)
    """
    _check.instance("pupil", pupil, Pupil)
    diameter = _check.number("diameter", diameter, 0.01, pupil.n_pixels)
    n_shifts = _check.integer("n_shifts", n_shifts, 2)
    shifts = 2 * np.pi * np.arange(n_shifts) / n_shifts - np.pi
    shifts = shifts[np.abs(shifts) > 1e-9]
    sensor = ZernikeSensor(pupil, *(Dimple(diameter, theta) for theta in shifts))
    waves = pupil.gather(sensor.reference_wave(field))
    beta = waves[0] / (np.exp(1j * shifts[0]) - 1)
    pairs = list(product(range(len(shifts)), repeat=2))
    size, strength, off_by_pi, sine_error, half_error = np.empty((5, len(pairs)))
    for index, (a, b) in enumerate(pairs):
        determinant = matrix_determinant(waves[a], waves[b])
        between = np.angle(waves[b]) - np.angle(waves[a])
        beyond_half = between - (shifts[b] - shifts[a]) / 2
        size[index] = np.abs(determinant).mean()
        strength[index] = np.abs((waves[a].conj() * waves[b]).imag / np.abs(beta) ** 2).mean()
        off_by_pi[index] = np.mean(np.cos(beyond_half) < 0)
        sine_error[index] = np.abs(determinant - np.sin(between)).max()
        half_error[index] = np.abs(np.sin(beyond_half)).max()
    both = shifts[pairs]
    difference = (both[:, 1] - both[:, 0]) % (2 * np.pi)
    return DimplePairs(
        both, difference, size, strength, float(off_by_pi.mean()), float(sine_error.max()), float(half_error.max())
    )


def true_wave_errors(sensor: ZernikeSensor, screens: NDArray) -> dict[str, NDArray[np.float64]]:
    """Absolute errors of the phase at each point, from two frames and from one, with the true reference waves.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks, the phase of the first one in (0, pi].
    screens : ndarray, shape (n_screens, ny, nx), radian

    Returns
    -------
    dict of ndarray, shape (n_screens, n_points), radian
        By equation (9), by one iteration that starts at the truth, and by equation (6).
    """
    screens = _screens(sensor, screens)
    pupil = sensor.pupil
    amplitude, truth = pupil.gather(pupil.amplitude), pupil.gather(screens)
    frames = sensor.measure(screens)
    inside, waves = pupil.gather(frames), pupil.gather(sensor.reference_wave(pupil.field(screens)))
    one_step = PhaseShifted(sensor, n_iterations=1)(frames, start=screens)
    phases = {
        "two images, equation (9)": pair_phase(inside, amplitude, waves),
        "two images, one iteration": pupil.gather(one_step.phase),
        "one image, equation (6)": arccosine_phase(inside[:, 0], amplitude, waves[:, 0]),
    }
    return {name: np.abs(np.angle(np.exp(1j * (phase - truth)))) for name, phase in phases.items()}


def _screens(sensor: ZernikeSensor, screens: NDArray) -> NDArray:
    """Check a sensor with two masks, and screens on its pupil."""
    _check.instance("sensor", sensor, ZernikeSensor)
    if sensor.n_masks != 2:
        raise ValueError(f"sensor has {sensor.n_masks} masks: expected two")
    pupil = sensor.pupil
    return pupil.scatter(_check.values_inside("screens", screens, pupil).reshape(-1, pupil.n_points), fill=0)


def _cosine(frame: NDArray, amplitude: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Cosine of the phase between two waves, as equations (6) and (9) take it from the intensity."""
    amplitude, reference = np.abs(amplitude), np.abs(reference)
    return (frame - reference**2 - amplitude**2) / (2 * reference * amplitude)


def _arrays(**values: NDArray) -> list[NDArray]:
    """Arrays of finite numbers, real or complex, whose shapes broadcast."""
    arrays = {}
    for name, value in values.items():
        array = _check.plain_array(name, value)
        check = _check.complex_array if array.dtype.kind == "c" else _check.real_array
        arrays[name] = check(name, array)
        _check.finite(name, arrays[name])
        if np.abs(arrays[name]).max(initial=0) > _STRONGEST:
            raise ValueError(f"{name} reaches {np.abs(arrays[name]).max():.3g}: expected at most {_STRONGEST:g}")
    _check.broadcast(**arrays)
    return list(arrays.values())


def _lit(**waves: NDArray) -> None:
    """Require waves that vanish nowhere."""
    for name, wave in waves.items():
        dark = np.count_nonzero(np.abs(wave) < 1 / _STRONGEST)
        if dark:
            raise ValueError(f"{name} is 0 at {dark} points: expected light at every point")


def _light(pupil: Pupil, mask: Mask, field: NDArray) -> NDArray[np.complexfloating]:
    """Field in the pupil, 0 outside."""
    _check.instance("pupil", pupil, Pupil)
    if isinstance(mask, type) or not hasattr(mask, "transmission"):
        raise TypeError(f"mask is a {type(mask).__name__}: expected a Dimple or a Patch")
    field = _check.complex_array("field", field)
    if field.shape != pupil.shape:
        raise ValueError(f"field has shape {field.shape}: expected {pupil.shape}")
    light = np.where(pupil.inside, field, 0)
    _check.finite("field", light, " inside the pupil")
    return light
