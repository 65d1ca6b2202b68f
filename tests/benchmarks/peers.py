"""The same tasks done by zwfs, HCIPy, pyZELDA and prysm, with the error of each against the exact kernel.

Every contestant has the circular pupil of the paper, 100 pixels across, and its dimple. Times are compared in
`tests.benchmarks.test_peers`; nothing is timed here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial

import hcipy
import numpy as np
from pyzelda import zelda, ztools

from zwfs import Dimple, Pupil, ZernikeSensor, power_law_screens, zernike_basis

from ..reference import HcipySensor, exact_frame, prysm_propagation

DIAMETER = 1.06
PLUS, MINUS = Dimple(DIAMETER, np.pi / 2), Dimple(DIAMETER, -np.pi / 2)
SAMPLES = (32, 64, 128, 256, 512, 1024)  # across the dimple, for the packages that sample the focal plane
PYZELDA_SAMPLES = 300  # written into its code
WAVELENGTH = 1e-6  # m; pyZELDA wants physical lengths


@dataclass(frozen=True)
class Contestant:
    """One package with one setting, at one task: `run` does it, and `error` judges what `run` gave."""

    task: str
    package: str
    setting: str
    default: bool  # whether the setting is the package's own
    run: Callable[[], np.ndarray]
    error: Callable[[np.ndarray], float]

    @property
    def name(self):
        return f"{self.package}, {self.setting}"


def prepared(make):
    """Result of `make`, set up at the first call."""
    once = cache(make)
    return lambda: once()()


class Field:
    """The pupil and the screen that all contestants are given."""

    def __init__(self):
        self.pupil = Pupil.circular(100)
        self.screen = power_law_screens(zernike_basis(self.pupil, 200), 0.8, 1, seed=1)[0]
        self.frame = exact_frame(self.pupil, PLUS, self.screen)
        self.frames = np.stack([exact_frame(self.pupil, dimple, self.screen) for dimple in (PLUS, MINUS)])

    def contestants(self):
        return [*self.images(), *self.image_pairs()]

    def images(self):
        """One frame of a classic sensor."""
        task, error = "one frame", lambda frame: self._worst(frame - self.frame)
        for tolerance in (1e-2, 1e-4, 1e-6, 1e-10, 1e-14):
            run = prepared(partial(self._zwfs, tolerance, PLUS))
            yield Contestant(task, "zwfs", f"tolerance {tolerance:.0e}", tolerance == 1e-10, run, error)
        for n in SAMPLES:
            yield Contestant(task, "HCIPy", f"{n} samples", n == 128, prepared(partial(self._hcipy, n)), error)
            yield Contestant(task, "prysm", f"{n} samples", n == 128, prepared(partial(self._prysm, n)), error)
        yield Contestant(
            task, "pyZELDA", f"{PYZELDA_SAMPLES} samples", True, self._pyzelda_frame,
            lambda frame: self._worst(frame - exact_frame(self.pupil, self._pyzelda_dimple, self.screen)),
        )  # fmt: skip

    def image_pairs(self):
        """Both frames of a phase-shifted sensor."""
        task, error = "two frames", lambda frames: self._worst(frames - self.frames)
        run = prepared(partial(self._zwfs, 1e-10, PLUS, MINUS))
        yield Contestant(task, "zwfs", "tolerance 1e-10", True, run, error)
        for n in SAMPLES:
            run = prepared(partial(self._hcipy_vector, n))
            yield Contestant(task, "HCIPy, vector", f"{n} samples", n == 128, run, error)

    def _worst(self, difference):
        return float(np.abs(difference)[..., self.pupil.inside].max())

    def _zwfs(self, tolerance, *dimples):
        sensor = ZernikeSensor(self.pupil, *dimples, tolerance=tolerance)
        return lambda: sensor.measure(self.screen).squeeze()

    def _hcipy(self, n_samples):
        sensor = HcipySensor(self.pupil, PLUS, num_pix=n_samples)
        return lambda: sensor.measure(self.screen)[0]

    def _hcipy_vector(self, n_samples):
        """Light that is linearly polarised: both circular polarisations in equal parts, one in each frame."""
        grid = hcipy.make_pupil_grid(self.pupil.shape[0], self.pupil.shape[0] / self.pupil.n_pixels)
        optics = hcipy.VectorZernikeWavefrontSensorOptics(
            grid, phase_step=np.pi / 2, phase_dot_diameter=DIAMETER, num_pix=n_samples
        )

        def run():
            field = hcipy.Field((self.pupil.amplitude * np.exp(1j * self.screen)).ravel(), grid)
            behind = optics.forward(hcipy.Wavefront(field, input_stokes_vector=(1, 1, 0, 0)))
            return np.stack([behind.I - behind.V, behind.I + behind.V]).reshape(self.frames.shape)

        return run

    def _prysm(self, n_samples):
        propagate = prysm_propagation(self.pupil.n_pixels, PLUS, n_samples)
        return lambda: np.abs(propagate(self.pupil.amplitude * np.exp(1j * self.screen))) ** 2

    @cached_property
    def _pyzelda(self):
        """Its sensor of fused silica, with the depth and the width of the same dimple."""
        depth = WAVELENGTH / 4 / (ztools.refractive_index(WAVELENGTH, "fused_silica") - 1)
        return zelda.Sensor(
            "CLASSIC", mask_Fratio=65.0, mask_depth=depth, mask_diameter=DIAMETER * 65.0 * WAVELENGTH,
            pupil_diameter=self.pupil.n_pixels, silent=True,
            pupil_telescope=True, pupil_function=lambda _: self.pupil.inside.astype(float),
        )  # fmt: skip

    @cached_property
    def _pyzelda_dimple(self):
        return Dimple(self._pyzelda.mask_relative_size(WAVELENGTH), self._pyzelda.mask_phase_shift(WAVELENGTH))

    def _pyzelda_frame(self):
        return self._pyzelda.propagate_opd_map(self.screen * WAVELENGTH / (2 * np.pi), WAVELENGTH)
