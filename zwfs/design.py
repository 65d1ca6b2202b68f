"""How many photons a measurement needs, with which dimples, and with which method."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.masks import Dimple
from zwfs.metrics import wrapped_residual
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.reconstructors import Linear, MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

_FIRST = 1.4, 0.7 * np.pi  # dimples with which the search begins: lambda/D, radian
_DIGITS = np.array([0.01, 0.01 * np.pi])  # of the best dimples
_N_SEARCH, _N_BOUND = 5, 15  # screens of that search, and of a bound
_N_SCREENS, _N_NUMBERS = 40, 1000  # least screens of a simulation, and least coefficients of modes
_MODES_OF_PIXELS = 200  # of the screens if all pixels are estimated
_ROUGH, _CLOSE = 0.1, 0.03  # tolerances of the error, relative
_MOST_TRIALS, _MOST_LIGHT = 5, 1000  # of a search for the light, and its end over its start
_LEAST_PHOTONS = 100.0  # in an image: with fewer, some images would be dark
_LARGEST_STEP = math.log(10)  # from the light of a trial to that of the next one
_SLOPES = -1.0, -0.25  # of the error against the light, both in logarithms; photon noise alone: -0.5


@dataclass(frozen=True, eq=False, repr=False)
class SensorDesign:
    """Answer of `design_sensor`.

    Attributes
    ----------
    method : str
        Simplest method of `errors_nm` that has the wanted error, or "none" if no light is enough for any.
    diameter : float, lambda/D
        Of both dimples.
    phase_shift : float, radian
        Of the first dimple; the second one has the opposite.
    photons_per_exposure : float
        Photons on the detector in an exposure: those of all pupil points, in both images. Infinite if no light is
        enough.
    photons_per_point : float
        Photons per pupil point and image, `Detector.photons`.
    photons_per_second : float, optional
        Photons that reach the telescope, before the losses of the throughput.
    magnitude : float, optional
        Of the faintest star that gives them.
    errors_nm : dict of str to float, nm rms
        Mean error of each method over the simulated screens at that light, the simplest first. If no light is
        enough, at the light of the smallest error that was tried.
    bound_nm : float, nm rms
        Cramer-Rao bound at the same light.
    sensor : ZernikeSensor
        With the two dimples.
    screens : ndarray, shape (n_screens, ny, nx), radian
        Phases of the simulation.
    modes : ndarray, shape (n_modes, ny, nx), optional
        Modes that are estimated, of unit rms; None stands for all pixels.
    """

    method: str
    diameter: float
    phase_shift: float
    photons_per_exposure: float
    photons_per_point: float
    photons_per_second: float | None
    magnitude: float | None
    errors_nm: dict[str, float]
    bound_nm: float
    sensor: ZernikeSensor
    screens: NDArray[np.floating]
    modes: NDArray[np.float64] | None

    def __repr__(self) -> str:
        dimples = f"{self.diameter:.2f} lambda/D, +-{self.phase_shift / np.pi:.2f} pi"
        if self.method == "none":
            return f"SensorDesign({dimples}: no light is enough, {min(self.errors_nm.values()):.2g} nm at best)"
        photons = f"{self.photons_per_exposure:.3g} photons per exposure"
        return f"SensorDesign({dimples}, {self.method}, {photons}: {self.errors_nm[self.method]:.2g} nm)"


def design_sensor(
    error_nm: float,
    input_nm: float,
    wavelength_m: float,
    *,
    n_modes: int | None = None,
    n_pixels: int = 32,
    read_noise: float = 0.0,
    frame_rate_hz: float | None = None,
    throughput: float = 1.0,
    diameter_m: float | None = None,
    zero_point: float | None = None,
    diameters: tuple[float, float] = (0.8, 2.0),
    phase_shifts: tuple[float, float] = (0.3 * math.pi, 0.7 * math.pi),
    n_screens: int | None = None,
    seed: int = 0,
) -> SensorDesign:
    """Photons that a wanted error takes, with the best pair of dimples and the simplest method that has it.

    The dimples are those of the smallest bound (`cramer_rao`) on screens of the input. The bound also gives a
    first number of photons. At this light the methods of `method_errors` are simulated. The light is changed until
    the best of them has the wanted error to 3 %, but each image gets at least 100 photons. If a thousand times as
    much is not enough, no light is. The model of the sensor is known exactly: errors of a bench are not included.

    Parameters
    ----------
    error_nm : float, nm rms
        Wanted error of the modes, or of the pixels: rms over the pupil, mean over screens. From a millionth to a
        tenth of the wavelength.
    input_nm : float, nm rms
        Wavefront error of the screens, at most the wavelength; 0 for a flat wavefront. The screens are those of
        `power_law_screens` with an exponent of -2, made of the estimated modes, or of 200 modes for pixels.
    wavelength_m : float, m
    n_modes : int, optional
        Zernike modes that are estimated, from tip and tilt on; every pixel if left out.
    n_pixels : int
        Pixels across the image of the pupil, from 8 to 64. For modes, they matter if there is read noise.
    read_noise : float, electrons rms / pixel
    frame_rate_hz : float, Hz, optional
        Exposures in a second; both images are taken at once.
    throughput : float
        Detected photons over those that reach the telescope, in (0, 1].
    diameter_m : float, m, optional
        Of the telescope, without obstruction.
    zero_point : float, photons / s / m^2, optional
        Light of a star of magnitude 0 in the band of the sensor.
    diameters : (float, float), lambda/D
        Smallest and largest diameter of the dimples. Near 2.44 lambda/D the sensor hardly sees tilts of a flat
        wavefront.
    phase_shifts : (float, float), radian
        Smallest and largest phase shift of the first dimple. Close to pi the two images are nearly the same, and
        the methods fail on large inputs although the bound is small.
    n_screens : int, optional
        Screens of the simulation; if left out, 40, or more for less than 25 modes, whose error varies more.
    seed : int
        Of the screens and of the noise.

    Returns
    -------
    SensorDesign

    Raises
    ------
    ValueError
        If there is a zero point without a frame rate or a diameter of the telescope.

    Examples
    --------
    >>> import zwfs
    >>> answer = zwfs.design_sensor(5, 0, 635e-9, n_modes=50)
    >>> f"{answer.diameter:.1f} lambda/D, {answer.phase_shift / 3.14159:.1f} pi, {answer.method}"
    '1.3 lambda/D, 0.7 pi, Linear'
    >>> round(answer.photons_per_exposure, -2), round(answer.bound_nm, 1)
    (6000.0, 5.0)
    """
    nm = 2e-9 * np.pi / _check.number("wavelength_m", wavelength_m, 1e-10, 1e-2)  # radian
    wavelength_nm = 2 * np.pi / nm
    error = nm * _check.number("error_nm", error_nm, 1e-6 * wavelength_nm, 0.1 * wavelength_nm)
    rms = nm * _check.number("input_nm", input_nm, 0, wavelength_nm)
    read_noise = _check.number("read_noise", read_noise, 0, 1e6)
    limits = _limits("diameters", diameters, 0.1, 8), _limits("phase_shifts", phase_shifts, 0.01, 3.13)
    rate, magnitude = _one_photon(frame_rate_hz, throughput, diameter_m, zero_point)
    pupil = Pupil.circular(_check.integer("n_pixels", n_pixels, 8, 64))
    modes = None if n_modes is None else zernike_basis(pupil, n_modes, orthonormal=True)
    basis = zernike_basis(pupil, min(_MODES_OF_PIXELS, pupil.n_points // 4)) if modes is None else modes
    n_all = max(_N_SCREENS, _N_NUMBERS // len(basis)) if n_screens is None else n_screens
    screens = power_law_screens(basis, rms, n_all, seed=_check.integer("seed", seed, 0))
    question = _Question(pupil, modes, screens, error, read_noise, seed)
    low, high = np.transpose(limits)
    answer = question.answer(low, high)
    if not answer.is_enough:  # with smaller dimples the methods converge on larger inputs
        answer = question.answer(low, np.clip(_FIRST, low, high))
    light = answer.light if answer.is_enough else math.inf
    total = light * answer.sensor.n_masks * pupil.n_points
    accepted = (1 + _CLOSE) * max(error, min(answer.errors.values()))
    simplest = next(name for name, value in answer.errors.items() if value <= accepted)
    return SensorDesign(
        method=simplest if answer.is_enough else "none",
        diameter=answer.diameter,
        phase_shift=answer.shift,
        photons_per_exposure=total,
        photons_per_point=light,
        photons_per_second=None if rate is None else total * rate,
        magnitude=None if magnitude is None else magnitude - 2.5 * math.log10(total),
        errors_nm={name: value / nm for name, value in answer.errors.items()},
        bound_nm=question.bound(answer.sensor, answer.light, n_all) / nm,
        sensor=answer.sensor,
        screens=screens,
        modes=modes,
    )


def method_errors(
    sensor: ZernikeSensor,
    screens: ArrayLike,
    *,
    photons: float,
    read_noise: float = 0.0,
    modes: ArrayLike | None = None,
    seed: int | np.random.Generator | np.random.SeedSequence | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Errors of three methods on the same simulated exposures.

    The methods are `Linear`, `PhaseShifted` with acceleration, and `MaximumLikelihood` with at most two starts.
    With modes, the first and the last one estimate their coefficients, and the error of each is that of the modes
    in its phase. Without, they estimate the phase of every pixel.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks or more.
    screens : array_like, shape (n_screens, ny, nx), radian
    photons : float
        Photons per pupil point and image, `Detector.photons`.
    read_noise : float, electrons rms / pixel
    modes : array_like, shape (n_modes, ny, nx), optional
    seed : int, Generator or SeedSequence, optional
        Of the noise.

    Returns
    -------
    dict of str to ndarray, shape (n_screens,), radian rms
        By the name of the class, the simplest method first.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.4, 0.7 * np.pi), zwfs.Dimple(1.4, -0.7 * np.pi))
    >>> modes = zwfs.zernike_basis(pupil, 10)
    >>> screens = zwfs.power_law_screens(modes, 0.8, 5, seed=1)
    >>> errors = zwfs.design.method_errors(sensor, screens, photons=100, modes=modes, seed=1)
    >>> {name: round(float(np.mean(error)), 2) for name, error in errors.items()}
    {'Linear': 0.34, 'PhaseShifted': 0.01, 'MaximumLikelihood': 0.01}
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    pupil = sensor.pupil
    truth = pupil.scatter(_check.values_inside("screens", screens, pupil), fill=0)
    camera = Detector(_check.number("photons", photons, 1e-12, 1e18), read_noise)
    frames = camera.normalise(camera.expose(sensor.measure(truth), seed))
    pixels = pupil.scatter(np.eye(pupil.n_points), fill=0)
    methods = (
        Linear(sensor, pixels if modes is None else modes),
        PhaseShifted(sensor, accelerate=True),
        MaximumLikelihood(sensor, modes=modes, photons=photons, read_noise=read_noise, n_starts=2),
    )
    residuals = (pupil.gather(wrapped_residual(pupil, method(frames).phase, truth)) for method in methods)
    axes = None if modes is None else np.linalg.qr(pupil.gather(np.asarray(modes)).T)[0]
    return {
        type(method).__name__: np.linalg.norm(residual if axes is None else residual @ axes, axis=-1)
        / math.sqrt(pupil.n_points)
        for method, residual in zip(methods, residuals, strict=True)
    }


class _Answer(NamedTuple):
    """Dimples, and the light of the trial whose best method is closest to the wanted error."""

    diameter: float
    shift: float
    sensor: ZernikeSensor
    light: float  # photons per point and image
    errors: dict[str, float]  # of the methods, radian rms, means over screens
    is_enough: bool


class _Question(NamedTuple):
    """What is to be measured, in radian."""

    pupil: Pupil
    modes: NDArray[np.float64] | None
    screens: NDArray[np.floating]
    error: float
    read_noise: float
    seed: int

    def answer(self, low: NDArray, high: NDArray) -> _Answer:
        """Dimples of the smallest bound, with a diameter and a phase shift between two limits, and their light."""
        best, light = np.clip(_FIRST, low, high), 1.0
        for _ in range(2 if self.read_noise else 1):  # without read noise, the best dimples are those of any light
            light = self._light(_sensor(self.pupil, best), light)
            best = self._best_dimples(low, high, light)
        sensor = _sensor(self.pupil, best)
        light = self._light(sensor, light)
        for tolerance, n_used in ((_ROUGH, math.ceil(len(self.screens) / 5)), (_CLOSE, len(self.screens))):
            light, errors = self._trial(sensor, light, tolerance, n_used)
            is_enough = min(errors.values()) <= (1 + _ROUGH) * self.error
            if not is_enough:
                break
        return _Answer(float(best[0]), float(best[1]), sensor, light, errors, is_enough)

    def bound(self, sensor: ZernikeSensor, light: float, n_screens: int = _N_BOUND) -> float:
        """Cramer-Rao bound for photons per point and image, mean over the first screens."""
        screens = self.screens[:n_screens]
        sigma = cramer_rao(sensor, screens, photons=light, read_noise=self.read_noise, modes=self.modes)
        squares = np.nanmean(sigma**2, axis=(-2, -1)) if self.modes is None else np.sum(sigma**2, axis=-1)
        return float(np.mean(np.sqrt(squares)))

    def _best_dimples(self, low: NDArray, high: NDArray, light: float) -> NDArray[np.float64]:
        """Diameter and phase shift of the smallest bound."""
        first, step = np.clip(_FIRST, low, high), (high - low) / 4
        corners = first + np.array([[0, 0], [1, 0], [0, 1]]) * np.where(first + step > high, -step, step)
        search = minimize(
            lambda dimples: math.log(self.bound(_sensor(self.pupil, dimples, 1e-4), light, _N_SEARCH)),
            first,
            method="Nelder-Mead",
            bounds=np.transpose([low, high]),
            options={"initial_simplex": corners, "xatol": 0.02, "fatol": 0.002},
        )
        return np.clip(np.round(search.x / _DIGITS) * _DIGITS, low, high)

    def _light(self, sensor: ZernikeSensor, light: float) -> float:
        """Photons per point and image at which the bound is the wanted error."""
        # The bound falls with the light to the power of -1/2 or, where read noise prevails, -1.
        power, n_steps = (4 / 3, 10) if self.read_noise else (2, 1)
        for _ in range(n_steps):
            light *= (self.bound(sensor, light) / self.error) ** power
        return light

    def _trial(
        self, sensor: ZernikeSensor, light: float, tolerance: float, n_screens: int
    ) -> tuple[float, dict[str, float]]:
        """Light at which the best method is closest to the wanted error, by secant steps in logarithms."""
        trials: list[tuple[float, float, dict[str, float]]] = []
        least, screens = _LEAST_PHOTONS / self.pupil.n_points, self.screens[:n_screens]
        light = max(light, least)
        most = light * _MOST_LIGHT
        while len(trials) < _MOST_TRIALS and light <= most:
            simulated = method_errors(
                sensor, screens, photons=light, read_noise=self.read_noise, modes=self.modes, seed=self.seed + 1
            )
            errors = {name: float(np.mean(values)) for name, values in simulated.items()}
            excess = math.log(min(errors.values()) / self.error)
            trials.append((excess, math.log(light), errors))
            if abs(excess) < tolerance or (excess < 0 and light == least):
                break
            slope = -0.5
            if len(trials) > 1:
                (y0, x0, _), (y1, x1, _) = trials[-2:]
                slope = np.clip((y1 - y0) / (x1 - x0), *_SLOPES)
            light = max(least, light * math.exp(np.clip(-excess / slope, -_LARGEST_STEP, _LARGEST_STEP)))
        _, closest, errors = min(trials, key=lambda trial: abs(trial[0]))
        return math.exp(closest), errors


def _sensor(pupil: Pupil, dimples: NDArray, tolerance: float = 1e-10) -> ZernikeSensor:
    diameter, shift = dimples
    return ZernikeSensor(pupil, Dimple(diameter, shift), Dimple(diameter, -shift), tolerance=tolerance)


def _limits(name: str, value: tuple[float, float], low: float, high: float) -> tuple[float, float]:
    """Return two numbers, the smaller one first."""
    first, last = _check.pair(name, value, _check.number, low, high)
    if first > last:
        raise ValueError(f"{name} = {_check.shown(value)}: expected the smaller one first")
    return first, last


def _one_photon(
    frame_rate_hz: float | None, throughput: float, diameter_m: float | None, zero_point: float | None
) -> tuple[float | None, float | None]:
    """Photons per second at the telescope, and the magnitude, for one photon in an exposure."""
    throughput = _check.number("throughput", throughput, 0, 1, open_low=True)
    named = {"frame_rate_hz": frame_rate_hz, "diameter_m": diameter_m, "zero_point": zero_point}
    values = {name: _check.number(name, value, 1e-18, 1e18) for name, value in named.items() if value is not None}
    rate = values["frame_rate_hz"] / throughput if "frame_rate_hz" in values else None
    if "zero_point" not in values:
        return rate, None
    if rate is None or len(values) < len(named):
        raise ValueError(f"zero_point = {_check.shown(zero_point)}: expected frame_rate_hz and diameter_m, too")
    area = math.pi / 4 * values["diameter_m"] ** 2
    return rate, -2.5 * math.log10(rate / (area * values["zero_point"]))
