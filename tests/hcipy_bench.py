"""Camera frames of a bench that HCIPy simulates, on a grid that is finer than the pixels of the camera.

Apertures, modes, mask and relay are HCIPy's own. Blur and place of an image are SciPy's, and a pixel is the mean
of its samples. No optics here are those of the package, so that model and bench share no assumption.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from zwfs.frames.registration import Image

BORDER = 4  # pixels that are simulated around the camera


@dataclass(frozen=True)
class HcipyBench:
    """A pupil, two dimples and a camera; without arguments, an ideal one with a round pupil."""

    aperture: str = "disc"
    pixels: int = 56  # across the pupil
    side: int = 72  # across a frame
    fine: int = 4  # samples across a pixel
    diameter: float = 1.06
    shifts: tuple[float, float] = (np.pi / 2, -np.pi / 2)
    leakage: float = 0.0
    unmasked: float = 0.0
    focus: tuple[float, float] = (0.0, 0.0)  # D^2 / lambda
    blur: float = 0.0  # pixels rms
    offsets: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))  # rows, columns
    rotations: tuple[float, float] = (0.0, 0.0)  # degrees, from x to y
    magnifications: tuple[float, float] = (1.0, 1.0)
    fluxes: tuple[float, float] = (1.0, 1.0)
    amplitude_error: float = 0.0
    static: float = 0.0  # rad rms
    photons: float = 3e4
    read_noise: float = 5.0
    background: float = 100.0
    n_modes: int = 60

    @property
    def noise(self):
        """Noise of a pixel without light, counts rms."""
        return np.hypot(self.read_noise, np.sqrt(self.background))

    @property
    def reversed(self):
        """The bench with its two images exchanged."""
        pairs = ("shifts", "focus", "offsets", "rotations", "magnifications", "fluxes")
        return replace(self, **{name: getattr(self, name)[::-1] for name in pairs})

    @functools.cached_property
    def _size(self):
        return (self.side + 2 * BORDER) * self.fine

    @functools.cached_property
    def _grid(self):
        import hcipy

        return hcipy.make_pupil_grid(self._size, self._size / self.fine / self.pixels)

    @functools.cached_property
    def lit(self):
        """Transmission of the aperture on the fine grid."""
        return _aperture(self.aperture, self._size, self.pixels * self.fine)

    @functools.cached_property
    def amplitude(self):
        """Amplitude on the fine grid."""
        return self.lit * (1 + self.smooth(self.amplitude_error, seed=101, n_modes=20))

    def smooth(self, rms, seed, n_modes=None):
        """Random Zernike modes on the fine grid, whose coefficients fall with the radial order; 0 off the disc."""
        if not rms:
            return np.zeros((self._size, self._size))
        modes, orders = _modes(self._size, self.pixels * self.fine, n_modes or self.n_modes)
        screen = np.tensordot(np.random.default_rng(seed).normal(size=len(modes)) / orders, modes, 1)
        inside = self.lit > 0.5
        return np.where(modes[1] != 0, screen - screen[inside].mean(), 0) * rms / screen[inside].std()

    def segmented(self, rms, seed, tilts=True):
        """Random pistons, and tips and tilts of the same rms, of the segments on the fine grid; 0 off them."""
        numbers = _segments(self.aperture, self._size, self.pixels * self.fine)
        rng, phase = np.random.default_rng(seed), np.zeros(numbers.shape)
        places = np.indices(numbers.shape)
        inside = self.lit > 0.5
        for number in range(numbers.max() + 1):
            own = (numbers == number) & inside
            phase[own] = rng.normal()
            if tilts:
                slopes = places[:, own] - places[:, own].mean(axis=1, keepdims=True)
                phase[own] += np.sum(rng.normal(size=(2, 1)) * slopes / slopes.std(axis=1, keepdims=True), axis=0)
        return np.where(inside, phase - phase[inside].mean(), 0) * rms / phase[inside].std()

    @functools.cached_property
    def flat(self):
        """Phase without a command, fine grid, radian."""
        return self.smooth(self.static, seed=102, n_modes=20)

    def exposed(self, phase, masked):
        """Two images without noise of a phase on the fine grid, photons of a full pixel = 1."""
        import hcipy

        field = hcipy.Field((self.amplitude * np.exp(1j * (phase + self.flat))).ravel(), self._grid)
        waves = clear = [hcipy.Wavefront(field)] * 2
        if masked:
            waves = [self._optics[side].forward(waves[side]) for side in (0, 1)]
        power = self._relayed(waves)
        if masked:
            power = [(1 - self.leakage) * power[k] + self.leakage * power[1 - k] for k in (0, 1)]
        if masked and self.unmasked:
            passed = self._relayed(clear)
            power = [(1 - self.unmasked) * power[k] + self.unmasked * passed[k] for k in (0, 1)]
        return np.stack([self._recorded(image, side) for side, image in enumerate(power)])

    def _relayed(self, waves):
        """Intensities of two waves behind the relays."""
        import hcipy

        power = []
        for wave, distance in zip(waves, self.focus, strict=True):
            arrived = hcipy.FresnelPropagator(self._grid, distance).forward(wave) if distance else wave
            power.append(np.abs(np.asarray(arrived.electric_field).reshape(self._size, -1)) ** 2)
        return power

    @functools.cached_property
    def _optics(self):
        import hcipy

        return [hcipy.ZernikeWavefrontSensorOptics(self._grid, step, self.diameter, 256) for step in self.shifts]

    def _recorded(self, image, side):
        """A fine image on the camera."""
        image = ndimage.gaussian_filter(image, self.blur * self.fine, truncate=6) if self.blur else image
        offset, angle = np.array(self.offsets[side]), np.radians(self.rotations[side])
        scale = self.magnifications[side]
        if offset.any() or angle or scale != 1:
            inverse = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / scale
            middle = np.full(2, (self._size - 1) / 2)
            start = middle - inverse @ (middle + self.fine * offset)
            image = ndimage.affine_transform(image, inverse, start, order=5, mode="grid-constant") / scale**2
        return self.fluxes[side] * self.pixel_means(image)

    def pixel_means(self, image):
        """Mean of a fine map over each pixel of the camera."""
        blocks = image.reshape(self.side + 2 * BORDER, self.fine, -1, self.fine).mean(axis=(1, 3))
        return blocks[BORDER:-BORDER, BORDER:-BORDER]

    def on_pupil(self, image):
        """Mean over each pixel of the pupil's grid, which is as wide as the diameter."""
        margin = (self.side - self.pixels) // 2
        return self.pixel_means(image)[margin : margin + self.pixels, margin : margin + self.pixels]

    def counts(self, phase, seed, masked=True):
        """Two images with noise, less the background, counts."""
        rng = np.random.default_rng(seed)
        light = np.maximum(self.photons * self.exposed(phase, masked), 0) + self.background
        return rng.poisson(light) + rng.normal(0, self.read_noise, light.shape) - self.background

    @functools.cached_property
    def fully_lit(self):
        """Pixels of the pupil's grid that are fully lit."""
        blocks = self.lit.reshape(self.side + 2 * BORDER, self.fine, -1, self.fine).min(axis=(1, 3))
        margin = BORDER + (self.side - self.pixels) // 2
        return blocks[margin : margin + self.pixels, margin : margin + self.pixels] > 0.5

    def error(self, phase, truth):
        """Rms error over the fully lit pixels of a phase (pixels) for a true one (fine, without the flat)."""
        residual = np.exp(1j * (np.asarray(phase) - self.on_pupil(truth + self.flat)))[self.fully_lit]
        return np.angle(residual * np.conj(residual.mean())).std()

    def difference(self, phase, corner, truth):
        """Phase less a true one (fine, without the flat), without piston; NaN at pixels that are not fully lit.

        The phase is on the camera, and begins at a corner: row and column.
        """
        window = tuple(slice(first, first + len(phase)) for first in corner)
        lit = self.pixel_means(self.lit)[window] > 0.999
        residual = np.where(lit, np.exp(1j * (phase - self.pixel_means(truth + self.flat)[window])), np.nan)
        return np.angle(residual * np.conj(np.nanmean(residual)))

    def images(self, phase, seed, masked=True):
        """Two images of a camera as registration takes them."""
        return [Image(counts, np.zeros(counts.shape, bool)) for counts in self.counts(phase, seed, masked)]

    @property
    def truth(self):
        """True values of the numbers of a fit by their names, without flux and background."""
        out = {"diameter": self.diameter, "first": self.shifts[0], "second": self.shifts[1]}
        out |= {"leakage": self.leakage, "unmasked": self.unmasked, "blur": self.blur}
        for side in (0, 1):
            out[f"arm {side} focus"] = self.focus[side]
            out[f"arm {side} rotation"] = np.radians(self.rotations[side])
            out[f"arm {side} magnification"] = self.magnifications[side]
            for arm in (side, side + 2):
                out[f"arm {arm} row"], out[f"arm {arm} column"] = self.offsets[side]
        return out

    def pulls(self, fit):
        """Errors of a fit over its error bars, by name; a share or blur of 0 is left out, as it is a limit."""
        limits = "leakage", "unmasked", "blur"
        pairs = ((fit[name], value) for name, value in self.truth.items() if value or name not in limits)
        return {number.name: (number.value - value) / number.sigma for number, value in pairs}

    def recording(self, n_commands=4, rms=0.5, seed=1):
        """Frames of the flat and of smooth commands, clear frames, and the commands on the pupil's grid."""
        commands = [np.zeros((self._size, self._size))]
        commands += [self.smooth(rms, seed=200 + number, n_modes=14) for number in range(n_commands)]
        frames = np.stack([self.counts(command, (seed, number)) for number, command in enumerate(commands)])
        clear = self.counts(commands[0], (seed, 99), masked=False)
        return frames, clear, np.stack([self.on_pupil(command) for command in commands])


ERRORS = {
    "diameter": 1.10,
    "shifts": (1.50, -1.62),
    "leakage": 0.03,
    "focus": (6e-4, -4e-4),
    "blur": 0.6,
    "offsets": ((0.2, -0.1), (-0.15, 0.25)),
    "fluxes": (1.0, 0.95),
    "amplitude_error": 0.05,
    "static": 0.15,
}
TURNED = ERRORS | {"rotations": (0.0, 0.5), "magnifications": (1.0, 1.01)}
CASES = {
    "ideal": HcipyBench(),
    "disc": HcipyBench(**ERRORS),
    "turned VLT": HcipyBench("VLT", **TURNED),
    "hexagons": HcipyBench("hexagons", pixels=40, side=48, **ERRORS),
}


_HEXAGONS = 2, 0.19, 0.012, 1  # rings of segments, their width and gaps (D), and the first ring


@functools.cache
def _segments(name, size, across):
    """Number of the segment that is nearest to each point of the fine grid, from 0 on."""
    import hcipy

    grid = hcipy.make_pupil_grid(size, size / across)
    parts = {
        "Keck": lambda: hcipy.make_keck_aperture(normalized=True, return_segments=True),
        "hexagons": lambda: hcipy.make_hexagonal_segmented_aperture(*_HEXAGONS, return_segments=True),
    }[name]()[1]
    lit = np.array([np.asarray(part(grid)).reshape(size, size) > 0.5 for part in parts])
    nearest = ndimage.distance_transform_edt(~lit.any(axis=0), return_distances=False, return_indices=True)
    return lit.argmax(axis=0)[tuple(nearest)]


@functools.cache
def _aperture(name, size, across):
    import hcipy

    grid = hcipy.make_pupil_grid(size, size / across)
    aperture = {
        "disc": lambda: hcipy.make_circular_aperture(1),
        "VLT": lambda: hcipy.make_vlt_aperture(normalized=True),
        "LUVOIR": lambda: hcipy.make_luvoir_a_aperture(normalized=True),
        "GMT": lambda: hcipy.make_gmt_aperture(normalized=True),
        "Keck": lambda: hcipy.make_keck_aperture(normalized=True),
        "hexagons": lambda: hcipy.make_hexagonal_segmented_aperture(*_HEXAGONS),
    }[name]()
    return np.asarray(aperture(grid)).reshape(size, size)


@functools.cache
def _modes(size, across, n):
    """Zernike modes after the piston on the disc, and their radial orders."""
    import hcipy

    grid = hcipy.make_pupil_grid(size, size / across)
    modes = np.array([np.asarray(mode).reshape(size, size) for mode in hcipy.make_zernike_basis(n, 1, grid, 2)])
    return modes, np.array([hcipy.noll_to_zernike(number)[0] for number in range(2, n + 2)])
