"""Camera images of a vector sensor simulated by HCIPy; the second image may be moved, turned or larger."""

import functools

import numpy as np
from scipy import ndimage

from zwfs import Pupil, power_law_screens, zernike_basis
from zwfs.frames.registration import Image

PIXELS, SIDE, FINE = 100, 148, 4  # across the pupil, across an image; samples across a camera pixel
PHOTONS, READ_NOISE, DARK = 2e4, 5.0, 100.0
CASES = {
    "ideal": {},
    "shifted": {"shift": (0.4, -0.7)},
    "rotated by 1.5 degrees": {"rotation": 1.5},
    "2 % larger": {"magnification": 1.02},
    "everything": {"shift": (0.4, -0.7), "rotation": 1.5, "magnification": 1.02, "flux": 0.8},
}


@functools.cache
def fine_images(rms=0.5):
    """Phase, frames of phase steps +pi/2 and -pi/2, and the clear frame, with four samples across a pixel."""
    import hcipy

    size = SIDE * FINE
    grid = hcipy.make_pupil_grid(size, SIDE / PIXELS)
    aperture = np.asarray(hcipy.make_vlt_aperture(normalized=True)(grid)).reshape(size, size)
    disc = Pupil.circular(PIXELS * FINE)
    [screen] = power_law_screens(zernike_basis(disc, 60), rms, 1, -2, seed=1)
    phase = np.pad(np.nan_to_num(screen), (size - PIXELS * FINE) // 2)
    field = hcipy.Field((aperture * np.exp(1j * phase)).ravel(), grid)
    sensor = hcipy.VectorZernikeWavefrontSensorOptics(grid, phase_step=np.pi / 2, phase_dot_diameter=1.06)
    jones = np.asarray(sensor.forward(hcipy.Wavefront(field, input_stokes_vector=(1, 0, 0, 0))).electric_field)
    # Both circular polarisations of the incoming light: one sees +pi/2, the other -pi/2.
    waves = np.einsum("oip,si->sop", jones, np.array([[1, 1j], [1, -1j]]) / np.sqrt(2))
    frames = np.sum(np.abs(waves) ** 2, axis=1).reshape(2, size, size)
    return phase, frames, aperture**2


def on_camera(fine, shift=(0.0, 0.0), rotation=0.0, magnification=1.0):
    """A fine image on camera pixels, its pupil moved (pixels), turned (degrees, x to y) and magnified."""
    sine, cosine = np.sin(np.radians(rotation)), np.cos(np.radians(rotation))
    inverse = np.array([[cosine, -sine], [sine, cosine]]) / magnification
    middle = np.full(2, (len(fine) - 1) / 2)
    offset = middle - inverse @ (middle + FINE * np.array(shift))
    moved = ndimage.affine_transform(fine, inverse, offset, order=3, mode="nearest")
    return _blocks(moved / magnification**2).mean(axis=(1, 3))


def recorded(seed=1, flux=1.0, **moved):
    """Two frames and two clear frames with their noise; the second of each is moved and has another flux."""
    _, frames, clear = fine_images()
    rng = np.random.default_rng(seed)
    images = []
    for fine in (*frames, clear, clear):
        second = len(images) % 2 == 1
        light = np.maximum(on_camera(fine, **(moved if second else {})), 0) * PHOTONS * (flux if second else 1)
        counts = rng.poisson(light) + rng.normal(DARK, READ_NOISE, light.shape)
        images.append(Image(counts, np.zeros(counts.shape, bool), f"image {len(images) + 1}"))
    return images[:2], images[2:]


def phase_difference(phases):
    """Measured phase less the true one, without piston, (ny, nx); NaN at pixels that are not fully lit."""
    phase, _, clear = fine_images()
    registered = phases.measurement.registered
    window = tuple(slice(first, first + registered.n_pixels) for first in registered.corner)
    lit = (_blocks(clear).min(axis=(1, 3)) > 0.5)[window]
    residual = np.where(lit, np.exp(1j * (phases.phase - on_camera(phase)[window])), np.nan)
    return np.angle(residual * np.conj(np.nanmean(residual)))


def phase_error(phases):
    """Rms error of a measured phase at the camera pixels that are fully lit, radian."""
    return np.nanstd(phase_difference(phases))


def _blocks(fine):
    """Fine image as (rows, samples, columns, samples)."""
    pixels = len(fine) // FINE
    return fine.reshape(pixels, FINE, pixels, FINE)
