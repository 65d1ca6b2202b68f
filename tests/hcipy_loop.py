"""A bench that HCIPy simulates for closed loops: mirror, wind, masks and detector are its own.

Both pupils lie side by side on one camera image. The grid is finer than the pixels.
"""

import functools

import numpy as np

PIXELS, SIDE, FINE = 48, 60, 2  # across the pupil, across an image, samples across a pixel
DARK, READ_NOISE = 20.0, 0.5  # electrons
SIZE = SIDE * FINE


@functools.cache
def grid():
    import hcipy

    return hcipy.make_pupil_grid(SIZE, SIDE / PIXELS)


class LoopBench:
    """A pupil with a mirror: "actuators" is 12 x 12, "segments" 36 hexagons with piston, tip and tilt."""

    def __init__(self, kind, shifts=(np.pi / 2, -np.pi / 2), static=0.05):
        import hcipy

        if kind == "actuators":
            self.aperture = hcipy.make_obstructed_circular_aperture(1, 0.2)(grid())
            influence = hcipy.make_gaussian_influence_functions(grid(), 12, 1 / 11, crosstalk=0.2)
            modes = np.array(
                [np.asarray(one.todense() if hasattr(one, "todense") else one).ravel() for one in influence]
            )
            peaks = np.sum(modes * (self.aperture > 0), axis=1)
            self.modes = modes[peaks > 0.1 * peaks.max()]
        else:
            flat_to_flat = 1 / 7.6
            aperture, parts = hcipy.make_hexagonal_segmented_aperture(
                3, flat_to_flat, 0.08 * flat_to_flat, 1, return_segments=True
            )
            self.aperture = hcipy.evaluate_supersampled(aperture, grid(), 4)
            rows = []
            for part in hcipy.evaluate_supersampled(parts, grid(), 4):
                lit = np.asarray(part)
                x, y = (coordinate - np.sum(lit * coordinate) / lit.sum() for coordinate in (grid().x, grid().y))
                rows += [1.0 * (lit > 0), 2 * x * (lit > 0) / flat_to_flat, 2 * y * (lit > 0) / flat_to_flat]
            self.modes = np.array(rows)
        self.amplitude = np.asarray(self.aperture)
        self.lit = self.amplitude > 0.5
        rng = np.random.default_rng(5)
        smooth = np.array(hcipy.make_zernike_basis(20, 1, grid(), 4)).T.reshape(-1, len(grid().x))
        if smooth.shape[0] != 20:
            smooth = smooth.T
        bump = rng.normal(size=20) @ smooth
        self.flat = static * bump / bump[self.lit].std()
        self.optics = [hcipy.ZernikeWavefrontSensorOptics(grid(), step, 1.06, 128) for step in shifts]
        self.fit = np.linalg.pinv(
            (self.modes[:, self.lit] - self.modes[:, self.lit].mean(axis=1, keepdims=True)).T, rcond=1e-3
        )

    @property
    def n_commands(self):
        return len(self.modes)

    def exposed(self, phase, masked=True):
        """Image without noise of a phase on the fine grid, 1 = a full pixel in a clear frame."""
        import hcipy

        field = hcipy.Field(self.amplitude * np.exp(1j * (phase + self.flat)), grid())
        wave = hcipy.Wavefront(field)
        powers = [one.forward(wave).intensity if masked else wave.intensity for one in self.optics]
        binned = [
            np.asarray(one).reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))
            / np.mean(np.asarray(wave.grid.weights))
            for one in powers
        ]
        return np.concatenate(binned, axis=1) * np.mean(np.asarray(wave.grid.weights))

    def counts(self, phase, photons, rng, masked=True):
        light = np.maximum(photons * self.exposed(phase, masked), 0)
        image = rng.poisson(light + DARK) + rng.normal(0, READ_NOISE, light.shape) + 100
        return np.clip(np.rint(image), 0, 65535).astype(np.uint16)

    def rms(self, phase):
        return phase[self.lit].std()
