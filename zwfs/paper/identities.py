"""The equations of section 2 as the paper prints them, to test them by; no sensor or reconstructor needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.masks import Mask
from zwfs.metrics import reconstruction_error, strehl
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

# Fields have the phases of the equations as their arguments: psi = sqrt(I) exp(i phi).


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
        Nodes along a radius; around the axis there are twice as many.

    Returns
    -------
    ndarray of complex, shape (ny, nx)
        In the plane of the detector, on the grid of the pupil.
    """
    light = _light(pupil, mask, field) / pupil.n_pixels**2
    nodes, weights = np.polynomial.legendre.leggauss(_check.integer("n_samples", n_samples, 2))
    radius = (nodes + 1) * mask.diameter / 4
    angles = np.arange(2 * n_samples) * np.pi / n_samples
    u, v = np.outer(radius, np.cos(angles)).ravel(), np.outer(radius, np.sin(angles)).ravel()
    area = np.outer(weights * radius * mask.diameter / 4, np.full(angles.size, np.pi / n_samples)).ravel()
    waves_x, waves_y = np.exp(2j * np.pi * np.outer(u, pupil.x)), np.exp(2j * np.pi * np.outer(v, pupil.y))
    spectrum = np.einsum("ky,yx,kx->k", waves_y.conj(), light, waves_x.conj(), optimize=True)
    return (waves_y.T * (area * (mask.transmission(u, v) - 1) * spectrum)) @ waves_x


def quotient(frame: NDArray, incoming: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Cosine of the phase between two waves, as equations (6) and (9) take it from the intensity.

    Parameters
    ----------
    frame : ndarray
        Intensity.
    incoming, reference : ndarray
        Amplitude or field of each wave; only the modulus counts.
    """
    frame = _check.real_array("frame", frame)
    frame, incoming, reference = _arrays(frame=frame, incoming=incoming, reference=reference)
    _lit(incoming=incoming, reference=reference)
    incoming, reference = np.abs(incoming), np.abs(reference)
    return (frame - reference**2 - incoming**2) / (2 * reference * incoming)


def arccosine_phase(
    frame: NDArray, amplitude: NDArray, reference: NDArray, sign: int = -1
) -> NDArray[np.floating]:
    """Equation (6): phase from one frame and its reference wave.

    Parameters
    ----------
    frame, amplitude : ndarray, shape (..., n)
        Intensity, and the amplitude of the incoming field, at points of the pupil.
    reference : ndarray of complex, shape (..., n)
    sign : int
        Of the arccosine: -1 for a dimple of positive phase, see `eq-branch` of the book.

    Returns
    -------
    ndarray, shape (..., n), radian
        Cosines beyond +-1 count as +-1.
    """
    if _check.integer("sign", sign, -1, 1) == 0:
        raise ValueError("sign = 0: expected 1 or -1")
    frame, amplitude, reference = _arrays(frame=frame, amplitude=amplitude, reference=reference)
    _lit(amplitude=amplitude, reference=reference)
    return np.angle(reference) + sign * np.arccos(np.clip(quotient(frame, amplitude, reference), -1, 1))


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
    c = quotient(frames, amplitude, references)
    a, b = np.moveaxis(np.angle(references), -2, 0)
    determinant = matrix_determinant(references[..., 0, :], references[..., 1, :])
    if not determinant.all():
        raise ValueError("references have the same phase at some points: expected two different ones at each")
    cosine = (np.sin(b) * c[..., 0, :] - np.sin(a) * c[..., 1, :]) / determinant
    sine = (np.cos(a) * c[..., 1, :] - np.cos(b) * c[..., 0, :]) / determinant
    return np.arctan2(sine, cosine)


@dataclass(frozen=True)
class ApproximationErrors:
    """How wrong an approximate reference wave is; means over the screens.

    Attributes
    ----------
    phase : float, radian rms
        Of the first mask's wave, without piston, which no frame depends on.
    amplitude, wave : float
        Of its amplitude, and of the wave as a whole but for a piston, relative (rms).
    one_image, two_images : float, radian rms
        Of the phase that one step finds with it, by equation (6) and by equation (9).
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
    _check.instance("sensor", sensor, ZernikeSensor)
    if sensor.n_masks != 2:
        raise ValueError(f"sensor has {sensor.n_masks} masks: expected two")
    pupil, power = sensor.pupil, _check.number("power", power, 0, 10)
    screens = pupil.scatter(_check.values_inside("screens", screens, pupil).reshape(-1, pupil.n_points), fill=0)
    amplitude = pupil.gather(pupil.amplitude)
    frames = pupil.gather(sensor.measure(screens))
    field = pupil.field(screens)
    true = pupil.gather(sensor.reference_wave(field))
    flat = pupil.gather(sensor.reference_wave(pupil.amplitude))
    guess = strehl(pupil, screens)[:, np.newaxis, np.newaxis] ** power * flat
    first, first_guess = true[:, 0], guess[:, 0]

    def phase_error(found: NDArray, truth: NDArray) -> float:
        return float(reconstruction_error(pupil, pupil.scatter(found), truth).mean())

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


def _arrays(**values: NDArray) -> list[NDArray]:
    """Arrays of finite numbers, real or complex, whose shapes broadcast."""
    arrays = {}
    for name, value in values.items():
        array = _check.plain_array(name, value)
        check = _check.complex_array if array.dtype.kind == "c" else _check.real_array
        arrays[name] = check(name, array)
        _check.finite(name, arrays[name])
    _check.broadcast(**arrays)
    return list(arrays.values())


def _lit(**waves: NDArray) -> None:
    """Require waves that vanish nowhere."""
    for name, wave in waves.items():
        if not wave.all():
            raise ValueError(f"{name} is 0 at {np.count_nonzero(wave == 0)} points: expected light at every point")


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
