"""Pairs of phase shifts, section 4.2 of the paper: which pairs work, and which have the least noise."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.tables import Table, Text
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes diameter rms n_screens exponent",
    n_quarter=(1, 50),
    n_iterations=(2, 10000),
)
QUICK = {"n_pixels": 32, "n_quarter": 5, "n_screens": 1}

HALF = np.pi / 2


@dataclass(frozen=True)
class PhaseNoise:
    """Error of the phase at each point of the pupil, (n_points,), with the reference waves held fixed."""

    photon: NDArray[np.float64]  # radian, for one photon per point and image
    bound: NDArray[np.float64]  # of Cramer and Rao, the same unit
    read: NDArray[np.float64]  # radian, for a read noise of 1, the intensity of the pupil


def phase_noise(sensor: ZernikeSensor, phase: NDArray) -> PhaseNoise:
    """Propagate noise of the frames to the phase, to first order, for a sensor of two masks."""
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
        photon = np.sqrt(np.sum(answer**2 * intensity, axis=0))
        read = np.sqrt(np.sum(answer**2, axis=0))
        bound = 1 / np.sqrt(np.sum(slope**2 / intensity, axis=0))
    return PhaseNoise(*(np.where(np.isnan(values), np.inf, values) for values in (photon, bound, read)))


def _sensor(pupil: Pupil, diameter: float, theta_a: float, theta_b: float) -> ZernikeSensor:
    """Sensor with two dimples of one diameter."""
    return ZernikeSensor(pupil, Dimple(diameter, theta_a), Dimple(diameter, theta_b))


@dataclass(frozen=True)
class PairMaps:
    """Error and noise for every pair of phase shifts; NaN where `PhaseShifted` refuses the pair."""

    angles: NDArray[np.float64]  # (n,), radian
    error: NDArray[np.float64]  # (n, n), without noise, radian rms
    flat: NDArray[np.float64]  # (n, n), noise of a flat wavefront, radian for one photon per point and image
    aberrated: NDArray[np.float64]  # (n, n), photon noise of the screens
    bound: NDArray[np.float64]  # (n, n), bound of the photon noise of the screens
    read: NDArray[np.float64]  # (n, n), read noise of a flat wavefront

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

    @property
    def zero_works(self) -> bool:
        """Whether some pair with a phase shift of 0 works."""
        return not self.singular[np.isclose(self.angles, 0)].all()

    def best(self, name: str) -> tuple[float, float, float]:
        """Pair (radian, the larger first) with the lowest value of the map `name`, and that value."""
        values = getattr(self, name)
        row, column = np.unravel_index(np.nanargmin(values), values.shape)
        angles = sorted((float(self.angles[row]), float(self.angles[column])), reverse=True)
        return angles[0], angles[1], float(values[row, column])

    def at(self, name: str, theta_a: float, theta_b: float) -> float:
        """Value of the map `name` at the pair that is closest to the given one (radian)."""
        row, column = (np.argmin(np.abs(self.angles - theta)) for theta in (theta_a, theta_b))
        return float(getattr(self, name)[row, column])


def pair_maps(
    pupil: Pupil, diameter: float, angles: NDArray, screens: NDArray, n_iterations: int = 25
) -> PairMaps:
    """Phase-shifted iteration and its noise for all pairs of phase shifts, the experiment of section 4.2."""
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
    aberrated = [phase_noise(sensor, screen) for screen in screens]
    photon, bound = (_rms(np.array([getattr(one, name) for one in aberrated])) for name in ("photon", "bound"))
    return error, _rms(flat.photon), photon, bound, _rms(flat.read)


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw_pairs(maps: PairMaps) -> Figure:
    """Error, and photon noise for a flat and for an aberrated wavefront, for all pairs of phase shifts."""
    figure, panels = plt.subplots(1, 3, figsize=(7, 3.6), sharey=True)
    half = (maps.angles[1] - maps.angles[0]) / 2
    ends = np.array([maps.angles[0] - half, maps.angles[-1] + half])
    noise = Normalize(0.5, 3)
    for axes, image, norm, title in (
        (panels[0], maps.error, LogNorm(1e-8, 1), "error, no noise"),
        (panels[1], maps.flat, noise, "photon noise, flat"),
        (panels[2], maps.aberrated, noise, "photon noise, aberrated"),
    ):
        axes.grid(False)
        axes.set_facecolor("#d0d0d0")
        axes.add_patch(Rectangle((-9, -9), 18, 18, fc="#d0d0d0", ec="#888888", hatch="//////", lw=0, zorder=0))
        shown = axes.imshow(image, cmap="cividis_r", norm=norm, extent=(*ends, *ends), zorder=1)
        angle = {"ticks": np.pi * np.linspace(-1, 1, 5), "labels": ("−π", "−π/2", "0", "π/2", "π")}
        axes.set_xticks(**angle)
        axes.set_yticks(**angle)
        axes.set(xlim=ends, ylim=ends)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(r"$\theta_a$ (rad)")
        axes.plot([-HALF, HALF], [HALF, -HALF], "o", mfc="none", mec="#000000", mew=1.5, ms=8, zorder=3)
        scale = r"rad rms" if axes is panels[0] else r"rad $\sqrt{\mathrm{photon}}$"
        more = "neither" if axes is panels[0] else "max"
        figure.colorbar(shown, ax=axes, location="bottom", label=scale, extend=more, aspect=16)
    for axes, name in zip(panels[1:], ("flat", "aberrated"), strict=True):
        theta_a, theta_b, _ = maps.best(name)
        axes.plot([theta_a, theta_b], [theta_b, theta_a], "*", mfc="#ffffff", mec="#000000", ms=12, zorder=4)
    panels[0].set_ylabel(r"$\theta_b$ (rad)")
    return figure


def best_table(maps: PairMaps, rms: float) -> Table:
    """Best pair of the maps for each kind of noise."""
    titles = {
        "flat": "photon noise, flat wavefront",
        "aberrated": f"photon noise, {rms:g} rad rms",
        "read": "read noise, flat wavefront",
        "bound": f"bound, photon noise, {rms:g} rad rms",
    }
    rows = []
    for name, title in titles.items():
        theta_a, theta_b, value = maps.best(name)
        usual = maps.at(name, HALF, -HALF)
        rows.append([title, f"{_pi(theta_a)}, {_pi(theta_b)}", value, usual, f"{1 - value / usual:.1%}"])
    return Table(["noise", "best pair", "value there", "at ±π/2", "gain"], rows)


def _pi(angle: float) -> str:
    return f"{angle / np.pi:.3g}π".replace("-", "−")


def findings(maps: PairMaps, rms: float) -> Text:
    """Sentences on the maps: which pairs work, and which are best."""
    worst, least = np.nanmax(maps.error), np.nanmin(maps.error)
    errors = f"between {least:.2g} and {worst:.2g}" if worst >= 1e-6 else "below 10⁻⁶"
    expected = np.array_equal(maps.singular, maps.forbidden)
    refused = f"{'' if expected else 'not only '}those with equal shifts or a shift of 0"
    best = {
        name: f"{_pair_text(maps, name)} ({_gain(maps, name):.0%} less noise than ±π/2)"
        for name in ("flat", "aberrated", "read")
    }
    read = f"the best pair is {best['read']}"
    if _gain(maps, "read") < 0.005:
        read = "no pair is better than ±π/2"
    return Text(
        f"**Without noise, the error of every pair that the iteration accepts is {errors} rad rms.** It refuses "
        f"{int(maps.singular.sum())} of the {maps.error.size} pairs of the map, {refused}. **With photon noise "
        f"the best pair is {best['flat']} on a flat wavefront, and {best['aberrated']} at {rms:g} rad rms.** "
        f"For read noise on a flat wavefront, {read}."
    )


def _gain(maps: PairMaps, name: str) -> float:
    """Noise that the best pair of a map saves, over the noise of the pair +-pi/2."""
    return 1 - maps.best(name)[2] / maps.at(name, HALF, -HALF)


def _pair_text(maps: PairMaps, name: str) -> str:
    """Best pair of a map in words."""
    theta_a, theta_b, _ = maps.best(name)
    return f"±{theta_a / np.pi:.2g}π" if np.isclose(theta_a, -theta_b) else f"({_pi(theta_a)}, {_pi(theta_b)})"


def numbers(maps: PairMaps) -> dict[str, float | str]:
    """Numbers of the claims of section 4.2 on pairs."""
    values: dict[str, float | str] = {
        "n_allowed": float((~maps.singular).sum()),
        "singular_as_expected": float(np.array_equal(maps.singular, maps.forbidden)),
        "zero_works": float(maps.zero_works),
        "error_max_allowed_pairs": float(np.nanmax(maps.error)),
        "best_pi": abs(maps.best("flat")[0]) / np.pi,
    }
    for name, suffix in (("flat", ""), ("aberrated", "_aberrated"), ("bound", "_bound"), ("read", "_read")):
        values[f"best_noise{suffix}"] = maps.best(name)[2]
        values[f"noise_at_half_pi{suffix}"] = maps.at(name, HALF, -HALF)
    return rounded(values, ".4g")
