"""The same physics by other means: the exact kernel of the dimple, HCIPy and prysm."""

import numpy as np
from scipy.signal import fftconvolve
from scipy.special import j1


def airy(diameter, x, y):
    """Kernel of a dimple without its factor exp(i theta) - 1, `eq-airy-kernel`."""
    r = np.hypot(x, y)
    far = np.where(r > 0, r, 1)
    return np.where(r > 0, diameter / 2 * j1(np.pi * diameter * far) / far, np.pi * diameter**2 / 4)


def exact_ellipse(pupil, width, height, turned, field):
    """Reference wave of an ellipse (lambda/D) that takes the light away, turned by an angle (radian) from x to y.

    The kernel is the Fourier transform of the ellipse: that of a disc of diameter 1, stretched.
    """
    y, x = (np.arange(-(n - 1), n) / pupil.n_pixels for n in pupil.shape)
    wave = np.exp(-1j * turned) * (x + 1j * y[:, np.newaxis])  # real and imaginary along the axes of the ellipse
    kernel = width * height * airy(1.0, width * wave.real, height * wave.imag)
    return -fftconvolve(kernel, np.where(pupil.inside, field, 0), mode="valid") / pupil.n_pixels**2


def exact_reference(pupil, dimple, field, margin=0):
    """Reference wave by the exact kernel, on a detector `margin` pixels wider than the pupil on each side.

    The kernel depends on the displacement only, which is why a convolution does it.
    """
    y, x = (np.arange(-(n + margin - 1), n + margin) / pupil.n_pixels for n in pupil.shape)
    kernel = airy(dimple.diameter, x, y[:, np.newaxis])
    change = dimple.amplitude * np.exp(1j * dimple.phase) - 1
    return change * fftconvolve(kernel, np.where(pupil.inside, field, 0), mode="valid") / pupil.n_pixels**2


def exact_frame(pupil, dimple, phase):
    """Intensity by the exact kernel, on the grid of the pupil."""
    field = pupil.amplitude * np.exp(1j * phase)
    return np.abs(field + exact_reference(pupil, dimple, field)) ** 2


class HcipySensor:
    """HCIPy's Zernike sensor, one for each dimple, on the grid and with the amplitude of `pupil`."""

    def __init__(self, pupil, *dimples, num_pix=128):
        import hcipy

        self._hcipy = hcipy
        self.pupil = pupil
        self.grid = hcipy.make_pupil_grid(pupil.shape[0], pupil.shape[0] / pupil.n_pixels)
        self.optics = [
            hcipy.ZernikeWavefrontSensorOptics(self.grid, dimple.phase, dimple.diameter, num_pix)
            for dimple in dimples
        ]

    def wavefront(self, field):
        """Field in the form that the optics of HCIPy accept."""
        return self._hcipy.Wavefront(self._hcipy.Field(field.ravel(), self.grid))

    def propagate(self, field):
        """Field behind each dimple, shape (n_masks, ny, nx)."""
        incoming = self.wavefront(field)
        return np.stack([optics.forward(incoming).electric_field.reshape(field.shape) for optics in self.optics])

    def measure(self, phase):
        """Frames, shape (n_masks, ny, nx)."""
        return np.abs(self.propagate(self.pupil.amplitude * np.exp(1j * phase))) ** 2


def prysm_propagation(n_pixels, mask, n_samples):
    """Function from a field, shape (n, n), to the field behind the mask, by the matrix transforms of prysm.

    This is Soummer's semi-analytical propagation, as prysm does it for a coronagraph. Both its transforms are
    inverse ones, so they turn the pupil upside down. Its `babinet` subtracts the turned wave from the field as it
    was, which is right for even fields only. The wave is turned back here. A grid with an even number of samples
    gets one more row and column: about its middle sample it then turns into itself.
    """
    import prysm.propagation

    # With D = 1 mm, this focal length (mm) and this wavelength (micrometre) one lambda/D is a micrometre.
    length, wavelength, spacing = 1000.0, 1e-3, mask.diameter / n_samples
    u = (np.arange(n_samples + 2) - (n_samples + 2) // 2) * spacing
    u, v = -u, -u[:, np.newaxis]
    change = np.where(np.hypot(u, v) <= mask.diameter / 2, mask.transmission(u + 0 * v, v + 0 * u) - 1, 0)

    def run(field):
        n = len(field)
        odd = np.pad(field, (0, 1 - n % 2))
        wavefront = prysm.propagation.Wavefront(odd, wavelength, 1 / n_pixels)
        wave = wavefront.to_fpm_and_back(length, change, spacing).data[::-1, ::-1]
        return field + wave[:n, :n]

    return run
