"""Pairs of phase shifts, section 4.2 of the paper: their errors without noise, and their noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.companion import sweeps
from zwfs.detector import Detector
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

DRAWN = (
    *((theta * np.pi, -theta * np.pi) for theta in (0.5, 0.8)),
    (np.pi / 2, -1.0),
    (np.pi, np.pi / 2),
    *((theta * np.pi, -theta * np.pi) for theta in (0.25, 0.65)),
)
"""Pairs for which the predicted noise is compared with drawn noise, radian."""


@dataclass(frozen=True)
class PhaseNoise:
    """Error of the phase at each point of the pupil, with the reference waves held fixed.

    Attributes
    ----------
    photon : ndarray, shape (n_points,), radian sqrt(photon)
        Standard deviation for one photon per point, divided equally between the masks, when the linear system of
        two frames is solved as `PhaseShifted` does; divide by the root of the number of photons per point.
    bound : ndarray, shape (n_points,), radian sqrt(photon)
        Least one for any unbiased estimate that knows the amplitude (Cramer-Rao).
    read : ndarray, shape (n_points,), radian
        As `photon`, for noise of standard deviation 1 in every pixel of both frames, where 1 is the mean intensity
        of each mask's image of the pupil with the mask taken out.
    """

    photon: NDArray[np.float64]
    bound: NDArray[np.float64]
    read: NDArray[np.float64]


def phase_noise(sensor: ZernikeSensor, phase: ArrayLike) -> PhaseNoise:
    """Propagate noise of the frames to the phase, to first order, for a sensor of two masks.

    With r_k the reference waves, held fixed, psi = 2i (s_b r_a - s_a r_b) / D with D = 4 Im(conj(r_a) r_b), so
    the noise of a pixel's two intensities moves its phase by Im(conj(psi) dpsi/dI_k) / |psi|^2 each. The
    information of both frames is the sum of (dI_k/dphi)^2 / I_k times half the photons. That the reference waves
    are made from the estimate concerns a dozen numbers among thousands of pixels and is left out.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks and a detector of 1 D.
    phase : array_like, shape (ny, nx), radian
        True phase.

    Returns
    -------
    PhaseNoise
        Infinite where the system is singular.

    Raises
    ------
    ValueError
        If the sensor has not two masks, its detector is wider than the pupil, or the phase has another shape.

    References
    ----------
    Chambouleyron et al. 2024, sections 2.2 and 4.2; `eq-linear-system` of the book.
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    if sensor.n_masks != 2 or sensor.detector_shape != sensor.pupil.shape:
        raise ValueError(f"sensor = {_check.shown(sensor)}: expected two masks and an extent of 1")
    phase = _check.map_inside("phase", phase, sensor.pupil)
    field = sensor.pupil.field(phase)
    psi = sensor.pupil.gather(field)
    waves = sensor.pupil.gather(sensor.reference_wave(field))
    intensity = np.abs(psi + waves) ** 2
    slope = 2 * np.real(waves.conj() * 1j * psi)
    determinant = 4 * np.imag(waves[0].conj() * waves[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        # d psi / d s_a = -2i r_b / D, d psi / d s_b = 2i r_a / D
        gain = 2j * np.stack([-waves[1], waves[0]]) / determinant
        answer = np.imag(psi.conj() * gain) / np.abs(psi) ** 2
        photon = np.sqrt(2 * np.sum(answer**2 * intensity, axis=0))
        read = np.sqrt(np.sum(answer**2, axis=0))
        bound = 1 / np.sqrt(np.sum(slope**2 / intensity, axis=0) / 2)
    return PhaseNoise(*(np.where(np.isnan(values), np.inf, values) for values in (photon, bound, read)))


def noise_of_pairs(
    pupil: Pupil, diameter: float, angles: ArrayLike, wavefronts: Mapping[str, ArrayLike]
) -> dict[str, NDArray[np.float64]]:
    """Predicted noise of pairs (theta, -theta): photon noise for each wavefront, and read noise for the first.

    The wavefronts are screens (n_screens, ny, nx) in radian, by name. Returns the rms over pupil and screens of
    `PhaseNoise`, by the name of the noise, for each theta.
    """
    angles = _check.real_map("angles", angles, 1)
    screens = _check_wavefronts(pupil, wavefronts)
    first = next(iter(screens))
    names = [*(f"photon noise, {name}" for name in screens), f"read noise, {first}"]
    noise = {name: np.empty(angles.size) for name in names}
    for index, theta in enumerate(angles.tolist()):
        sensor = _sensor(pupil, diameter, theta, -theta)
        for name, phases in screens.items():
            noises = [phase_noise(sensor, phase) for phase in phases]
            noise[f"photon noise, {name}"][index] = _rms(np.array([one.photon for one in noises]))
            if name == first:
                noise[f"read noise, {name}"][index] = _rms(np.array([one.read for one in noises]))
    return noise


class DrawnNoise(NamedTuple):
    """Photon noise of a pair of phase shifts, radian sqrt(photon): predicted, drawn, and standard error."""

    theta_a: float
    theta_b: float
    name: str
    expected: float
    drawn: float
    error: float


def compare_noise(
    pupil: Pupil,
    diameter: float,
    wavefronts: Mapping[str, ArrayLike],
    photons: float,
    n_draws: int,
    *,
    seed: int = 0,
) -> list[DrawnNoise]:
    """Photon noise of the pairs of `DRAWN`, predicted and drawn; see `noise_of_pairs` and `drawn_noise`."""
    screens, seed = _check_wavefronts(pupil, wavefronts), _check.integer_seed("seed", seed)
    rows = []
    for theta_a, theta_b in DRAWN:
        sensor = _sensor(pupil, diameter, theta_a, theta_b)
        for name, phases in screens.items():
            draws = np.array(
                [drawn_noise(sensor, phase, photons, n_draws, seed + i) for i, phase in enumerate(phases)]
            )
            expected = _rms(np.array([phase_noise(sensor, phase).photon for phase in phases]))
            error = float(np.linalg.norm(draws[:, 1]) / len(phases))
            rows.append(DrawnNoise(theta_a, theta_b, f"photon noise, {name}", expected, _rms(draws[:, 0]), error))
    return rows


def close_pairs(
    pupil: Pupil, diameter: float, gaps: ArrayLike, screens: NDArray, n_iterations: int = 25
) -> NDArray[np.float64]:
    """Error and photon noise of pairs that are nearly equal: pi/2, and pi/2 less a gap (radian).

    Returns rows (n, 3): gap, mean error on the screens without noise (radian rms), and photon noise for a flat
    wavefront (radian sqrt(photon)).
    """
    _check.instance("pupil", pupil, Pupil)
    gaps = _check.real_map("gaps", gaps, 1)
    if not np.all((gaps >= 1e-6) & (gaps <= 1)):
        raise ValueError(f"gaps = {_check.shown(gaps)}: expected a list of values between 1e-6 and 1 radian")
    screens = _check.screens("screens", screens, pupil)
    rows = []
    for gap in gaps.tolist():
        sensor = _sensor(pupil, diameter, np.pi / 2, np.pi / 2 - gap)
        phase = PhaseShifted(sensor, n_iterations=n_iterations)(sensor.measure(screens)).phase
        noise = _rms(phase_noise(sensor, np.zeros(pupil.shape)).photon)
        rows.append((gap, reconstruction_error(pupil, phase, screens).mean(), noise))
    return np.array(rows)


def _sensor(pupil: Pupil, diameter: float, theta_a: float, theta_b: float) -> ZernikeSensor:
    """Sensor with two dimples of one diameter."""
    diameter = _check.number("diameter", diameter, 0.01, pupil.n_pixels)
    return ZernikeSensor(pupil, Dimple(diameter, theta_a), Dimple(diameter, theta_b))


def _check_wavefronts(pupil: Pupil, wavefronts: Mapping[str, ArrayLike]) -> dict[str, NDArray[np.floating]]:
    """Return screens by name, (n_screens, ny, nx) each."""
    _check.instance("pupil", pupil, Pupil)
    _check.instance("wavefronts", wavefronts, Mapping)
    if not wavefronts:
        raise ValueError("wavefronts is empty: expected at least one")
    return {name: _check.screens(f"wavefronts[{name!r}]", screens, pupil) for name, screens in wavefronts.items()}


def drawn_noise(
    sensor: ZernikeSensor,
    phase: ArrayLike,
    photons: float,
    n_draws: int,
    seed: int | np.random.Generator | np.random.SeedSequence | None = 0,
) -> tuple[float, float]:
    """Photon noise of the phase-shifted iteration, from frames with drawn noise, to compare with `phase_noise`.

    Parameters
    ----------
    sensor : ZernikeSensor
        With two masks or more, between which the light is divided equally.
    phase : array_like, shape (ny, nx), radian
        True phase.
    photons : float, photons
        Per point of the pupil and frame set, at least 1; many, as the comparison is to first order.
    n_draws : int
        At least 2.
    seed : int, Generator or SeedSequence, optional

    Returns
    -------
    noise, error : float, radian sqrt(photon)
        Rms over the points and draws, and its standard error.

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    phase = _check.map_inside("phase", phase, sensor.pupil)
    photons = _check.number("photons", photons, 1)
    n_draws = _check.integer("n_draws", n_draws, 2)
    rng = _check.generator("seed", seed)
    camera = Detector(sensor.pupil, photons * sensor.pupil.n_points / sensor.n_masks)
    frames = np.repeat(sensor.measure(phase)[np.newaxis], n_draws, axis=0)
    estimate = PhaseShifted(sensor)(camera.normalise(camera.expose(frames, rng)))
    power = photons * reconstruction_error(sensor.pupil, estimate.phase, phase) ** 2
    noise = float(np.sqrt(power.mean()))
    return noise, float(power.std(ddof=1) / np.sqrt(n_draws) / (2 * noise))


@dataclass(frozen=True)
class PairMaps:
    """Error and noise for every pair of phase shifts; NaN where `PhaseShifted` refuses the pair.

    Attributes
    ----------
    angles : ndarray, shape (n,), radian
        Phase shifts of either mask.
    error : ndarray, shape (n, n), radian rms
        Mean error of the iteration on frames without noise.
    flat, aberrated : ndarray, shape (n, n), radian sqrt(photon)
        `PhaseNoise.photon`, rms over the pupil, for a flat wavefront and, rms over the screens too, for these.
    bound : ndarray, shape (n, n), radian sqrt(photon)
        `PhaseNoise.bound` for a flat wavefront, rms over the pupil.
    read : ndarray, shape (n, n), radian
        `PhaseNoise.read` for a flat wavefront, rms over the pupil.
    """

    angles: NDArray[np.float64]
    error: NDArray[np.float64]
    flat: NDArray[np.float64]
    aberrated: NDArray[np.float64]
    bound: NDArray[np.float64]
    read: NDArray[np.float64]

    @property
    def singular(self) -> NDArray[np.bool_]:
        """Pairs that were refused, shape (n, n)."""
        return np.isnan(self.error)

    @property
    def forbidden(self) -> NDArray[np.bool_]:
        """Pairs that the determinant excludes, equal mod 2 pi or one of them 0 mod 2 pi; shape (n, n)."""
        turn = np.exp(1j * self.angles)
        none = np.abs(turn - 1) < 1e-9
        return (np.abs(turn[:, np.newaxis] - turn) < 1e-9) | none[:, np.newaxis] | none

    def best(self, name: str) -> tuple[float, float, float]:
        """Pair (radian, the larger first) with the lowest value of the map `name`, and that value."""
        _check.choice("name", name, ("error", "flat", "aberrated", "bound", "read"))
        values = getattr(self, name)
        row, column = np.unravel_index(np.nanargmin(values), values.shape)
        angles = sorted((float(self.angles[row]), float(self.angles[column])), reverse=True)
        return angles[0], angles[1], float(values[row, column])


def pair_maps(
    pupil: Pupil, diameter: float, angles: ArrayLike, screens: NDArray, n_iterations: int = 25
) -> PairMaps:
    """Phase-shifted iteration and its noise for all pairs of phase shifts, the experiment of section 4.2.

    A pair is a task of the sweep "pair_maps", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    angles : array_like, shape (n,), radian
    screens : ndarray, shape (n_screens, ny, nx), radian
    n_iterations : int

    Returns
    -------
    PairMaps
        Symmetric: the order of the masks does not matter, so each pair is computed once.

    Raises
    ------
    ValueError
        If there are no screens or no angles.

    References
    ----------
    Chambouleyron et al. 2024, section 4.2.
    """
    _check.instance("pupil", pupil, Pupil)
    diameter = _check.number("diameter", diameter, 0, pupil.n_pixels, open_low=True)
    angles = _check.real_map("angles", angles, 1)
    screens = _check.screens("screens", screens, pupil)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    maps = np.full((5, angles.size, angles.size), np.nan)
    below = np.tril_indices(angles.size, -1)
    pairs = zip(*(angles[side].tolist() for side in below), strict=True)
    values = sweeps.run(_pair, pairs, pupil, diameter, screens, n_iterations, name="pair_maps")
    maps[:, *below] = maps[:, *below[::-1]] = np.reshape(values, (-1, 5)).T
    return PairMaps(angles, *maps)


def _pair(
    pair: tuple[float, float], pupil: Pupil, diameter: float, screens: NDArray, n_iterations: int
) -> tuple[float, ...]:
    """Error and the four noises of one pair, NaN if it is refused."""
    sensor = _sensor(pupil, diameter, *pair)
    try:
        method = PhaseShifted(sensor, n_iterations=n_iterations)
    except ValueError:
        return (np.nan,) * 5
    error = reconstruction_error(sensor.pupil, method(sensor.measure(screens)).phase, screens).mean()
    flat = phase_noise(sensor, np.zeros(sensor.pupil.shape))
    aberrated = np.array([phase_noise(sensor, screen).photon for screen in screens])
    return error, _rms(flat.photon), _rms(aberrated), _rms(flat.bound), _rms(flat.read)


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
