"""Cost of a wide band: reconstructors that ignore the bandwidth, and one that knows it. Not in the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.companion import sweeps
from zwfs.metrics import reconstruction_error
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors import MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

_WAVELENGTHS = 9  # of the simulated light
_KNOWN_WAVELENGTHS = 3  # of the reconstructor that knows the band: fewer, since it has no exact model of the light
_TOLERANCE = 1e-4  # of the sensor of the bound, which it changes by less than 1e-3

WAYS = {
    "PhaseShifted, ignored": "PhaseShifted",
    "MaximumLikelihood, ignored": "MaximumLikelihood",
    "MaximumLikelihood, known": "MaximumLikelihood",
}
"""Method of each way to reconstruct frames of a band, by its name; the bandwidth is ignored or known."""

IGNORANT = tuple(way for way in WAYS if way.endswith("ignored"))


@dataclass(frozen=True)
class BandCurves:
    """Errors against the bandwidth.

    Attributes
    ----------
    bandwidths : ndarray, shape (n,)
        Full width over the central wavelength.
    error : dict of ndarray, shape (n,), radian rms
        Of each way, with photon noise: the rms over points and screens.
    bias : dict of ndarray, shape (n,), radian rms
        The same without noise, of the ways that ignore the bandwidth.
    bound : ndarray, shape (n,), radian rms
        Cramer-Rao bound in the band.
    photons : float
        Of each point and frame.
    """

    bandwidths: NDArray[np.float64]
    error: dict[str, NDArray[np.float64]]
    bias: dict[str, NDArray[np.float64]]
    bound: NDArray[np.float64]
    photons: float

    def at(self, bandwidth: float) -> int:
        """Place of the bandwidth that is nearest."""
        bandwidth = _check.number("bandwidth", bandwidth)
        return int(np.argmin(np.abs(self.bandwidths - bandwidth)))

    def equal_photons(self, way: str) -> NDArray[np.float64]:
        """Photons of each point and frame for which the bias of a way is as large as the bound, (n,)."""
        _check.choice("way", way, self.bias)
        bias = np.maximum(self.bias[way], np.finfo(float).tiny)
        return self.photons * (self.bound / bias) ** 2


def band_curves(
    sensor: ZernikeSensor,
    screens: ArrayLike,
    bandwidths: ArrayLike,
    photons: float,
    *,
    chromatic: bool = False,
    seed: int = 0,
) -> BandCurves:
    """Reconstruct frames of a flat spectrum, with and without photon noise.

    The light is simulated with 9 wavelengths. The reconstructor that knows the band uses 3. A bandwidth is a task
    of the sweep "bandwidth", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    sensor : ZernikeSensor
        At the central wavelength, with two masks or more.
    screens : array_like, shape (n_screens, ny, nx), radian
        At the central wavelength.
    bandwidths : array_like, shape (n,)
        Full width over the central wavelength, in [0, 1].
    photons : float
        That an intensity of 1 puts into a pixel of each frame.
    chromatic : bool
        Whether the phase shifts are those of an etched depth.
    seed : int
        Of the noise, the same at all bandwidths.

    Returns
    -------
    BandCurves

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    screens = _check.screens("screens", screens, sensor.pupil)
    widths = _check.real_map("bandwidths", bandwidths, 1)
    if widths.min() < 0 or widths.max() > 1:
        raise ValueError(f"bandwidths = {_check.shown(widths.tolist())}: expected values in [0, 1]")
    photons = _check.number("photons", photons, 0, open_low=True)
    chromatic = _check.flag("chromatic", chromatic)
    seed = _check.integer_seed("seed", seed)
    rows = sweeps.run(
        _row, widths.tolist(), sensor, np.where(sensor.pupil.inside, screens, 0), photons, chromatic, seed,
        name="bandwidth",
    )  # fmt: skip
    return BandCurves(
        widths,
        {way: np.array([error[way] for error, _, _ in rows]) for way in WAYS},
        {way: np.array([bias[way] for _, bias, _ in rows]) for way in IGNORANT},
        np.array([bound for _, _, bound in rows]),
        photons,
    )


def _row(
    bandwidth: float, sensor: ZernikeSensor, screens: NDArray, photons: float, chromatic: bool, seed: int
) -> tuple[dict[str, float], dict[str, float], float]:
    """Errors with and without noise, and the bound, at one bandwidth."""
    light = PolychromaticSensor.flat_band(sensor, bandwidth, _WAVELENGTHS, chromatic=chromatic)
    known = PolychromaticSensor.flat_band(sensor, bandwidth, _KNOWN_WAVELENGTHS, chromatic=chromatic)
    methods = {
        "PhaseShifted, ignored": PhaseShifted(sensor, n_iterations=100, accelerate=True),
        "MaximumLikelihood, ignored": MaximumLikelihood(sensor, photons=photons, n_starts=1),
        "MaximumLikelihood, known": MaximumLikelihood(known, photons=photons, n_starts=1),
    }
    clean = light.measure(screens)
    noisy = np.random.default_rng(seed).poisson(photons * clean) / photons
    error, bias = (
        {way: _rms(reconstruction_error(sensor.pupil, methods[way](frames).phase, screens)) for way in ways}
        for ways, frames in ((WAYS, noisy), (IGNORANT, clean))
    )
    rough = PolychromaticSensor.flat_band(
        sensor.with_tolerance(_TOLERANCE), bandwidth, _KNOWN_WAVELENGTHS, chromatic=chromatic
    )
    return error, bias, _rms(sensor.pupil.gather(cramer_rao(rough, screens, photons=photons)))


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
