"""A bench that HCIPy simulates for closed loops: mirror, wind, masks and optics are its own.

Both pupils lie side by side on one camera image. The grid is finer than the pixels.
"""

import functools

import numpy as np

from zwfs.frames import Calibration
from zwfs.frames.pipeline import Optics, reduce_frames
from zwfs.frames.registration import Image, register_frames

PIXELS, SIDE, FINE = 48, 60, 2  # across the pupil, across an image, samples across a pixel
SIZE = SIDE * FINE
BIAS, DARK, READ_NOISE = 100.0, 20.0, 0.5  # counts and electrons
SHIFTS = (np.pi / 2, -np.pi / 2)
FLAT_TO_FLAT = 1 / 7.6  # of a segment, D


@functools.cache
def _grid():
    import hcipy

    return hcipy.make_pupil_grid(SIZE, SIDE / PIXELS)


def _actuators():
    """Amplitude and influence functions of 12 x 12 actuators on a pupil with a central obscuration."""
    import hcipy

    amplitude = np.asarray(hcipy.make_obstructed_circular_aperture(1, 0.2)(_grid()))
    influence = hcipy.make_gaussian_influence_functions(_grid(), 12, 1 / 11, crosstalk=0.2)
    modes = np.array([np.asarray(mode).ravel() for mode in influence])
    light = modes @ (amplitude > 0)
    return amplitude, modes[light > 0.2 * light.max()]


def _segments():
    """Amplitude and modes of 36 hexagons: piston, and a tip and a tilt of about 1 rad at their rims."""
    import hcipy

    gap = 0.08 * FLAT_TO_FLAT
    whole, parts = hcipy.make_hexagonal_segmented_aperture(3, FLAT_TO_FLAT, gap, 1, return_segments=True)
    amplitude = np.asarray(hcipy.evaluate_supersampled(whole, _grid(), 4))
    modes = []
    for part in hcipy.evaluate_supersampled(parts, _grid(), 4):
        lit = np.asarray(part)
        modes.append(np.where(lit > 0, 1.0, 0.0))
        for coordinate in (_grid().x, _grid().y):
            slope = np.asarray(coordinate) - lit @ coordinate / lit.sum()
            modes.append(np.where(lit > 0, 2 * slope / FLAT_TO_FLAT, 0.0))
    return amplitude, np.array(modes)


class LoopBench:
    """A pupil with a mirror: "actuators" are 12 x 12, "segments" 36 hexagons with piston, tip and tilt.

    Phases are flat arrays on the fine grid, radian.
    """

    def __init__(self, kind, static=0.05):
        import hcipy

        self.amplitude, self.modes = {"actuators": _actuators, "segments": _segments}[kind]()
        self.n_commands, self.lit = len(self.modes), self.amplitude > 0.5
        zernikes = np.array([np.asarray(mode) for mode in hcipy.make_zernike_basis(20, 1, _grid(), 4)])
        bumps = np.random.default_rng(5).normal(size=20) @ zernikes
        self.static = static * bumps / bumps[self.lit].std()
        self._optics = [hcipy.ZernikeWavefrontSensorOptics(_grid(), shift, 1.06, 128) for shift in SHIFTS]
        inside = self.modes[:, self.lit]
        self._fit = np.linalg.pinv((inside - inside.mean(axis=1, keepdims=True)).T, rcond=1e-3)

    def rms(self, phase):
        return phase[self.lit].std()

    def wind(self, rms, speed, seed=3):
        """Phases at a time: a screen that moves, of an rms at the start (radian); speed in D / s."""
        import hcipy

        strength = hcipy.Cn_squared_from_fried_parameter(0.15, 1)
        layer = hcipy.InfiniteAtmosphericLayer(_grid(), strength, 2, speed, seed=seed)
        scale = rms / self.rms(np.asarray(layer.phase_for(1)))

        def at(time):
            layer.evolve_until(time)
            return scale * np.asarray(layer.phase_for(1))

        return at

    def exposed(self, phase, masked=True):
        """Image without noise, 1 = a full pixel of a clear frame."""
        import hcipy

        field = hcipy.Field(self.amplitude * np.exp(1j * (phase + self.static)), _grid())
        wave = hcipy.Wavefront(field)
        waves = [optics.forward(wave) if masked else wave for optics in self._optics]
        fine = [np.asarray(behind.intensity).reshape(SIDE, FINE, SIDE, FINE) for behind in waves]
        return np.concatenate([image.mean(axis=(1, 3)) for image in fine], axis=1)

    def counts(self, phase, photons, rng, masked=True):
        """Camera image of 16 bits."""
        light = np.maximum(photons * self.exposed(phase, masked), 0)
        image = rng.poisson(light + DARK) + rng.normal(BIAS, READ_NOISE, light.shape)
        return np.clip(np.rint(image), 0, 65535).astype(np.uint16)

    def calibration(self, photons, seed=1):
        """Calibration from means of four frames and four clear frames of the mirror at rest."""
        rng, dark = np.random.default_rng(seed), np.full((SIDE, 2 * SIDE), BIAS + DARK)
        frame, clear = (
            np.mean([self.counts(np.zeros(SIZE**2), photons, rng, masked) for _ in range(4)], axis=0) - dark
            for masked in (True, False)
        )
        images = [Image(counts, np.zeros(counts.shape, bool), dark=dark) for counts in (frame, clear)]
        measurement = reduce_frames(register_frames(images[:1], images[1:]), Optics(1.06, SHIFTS))
        return Calibration.of(measurement, saturation=65535.0)

    def pokes(self, size, photons, seed=2):
        """Frames of the flat mirror, and of each command pushed and pulled."""
        rng = np.random.default_rng(seed)
        flat = np.stack([self.counts(np.zeros(SIZE**2), photons, rng) for _ in range(10)])
        pairs = ([self.counts(sign * size * mode, photons, rng) for mode in self.modes] for sign in (1, -1))
        return flat, *map(np.stack, pairs)

    def perfect_estimate(self, photons):
        """Commands that fit a known wavefront, with the noise of the best linear estimate from a frame."""
        still, step = self.exposed(np.zeros(SIZE**2)).ravel(), 1e-3
        signals = [
            [(image := self.exposed(sign * step * mode).ravel()) / image.sum() for mode in self.modes]
            for sign in (1, -1)
        ]
        responses = (np.array(signals[0]) - signals[1]) / (2 * step)
        scatter = {}
        for light in (photons, photons / 100):
            variance = (light * still + DARK + READ_NOISE**2) / (light * still.sum()) ** 2
            values, vectors = np.linalg.eigh(responses / variance @ responses.T)
            shown = values > 1e-4 * values[-1]
            scatter[light] = vectors[:, shown] / np.sqrt(values[shown])

        def estimate(phase, light, rng):
            return self._fit @ phase[self.lit] + scatter[light] @ rng.normal(size=scatter[light].shape[1])

        return estimate
