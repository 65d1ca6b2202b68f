"""Pairs of phase shifts, section 4.2 of the paper: their errors without noise, and their noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import Table, small
from zwfs.detector import Detector
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes diameter rms n_screens exponent",
    n_quarter=(1, 50),
    n_iterations=(2, 10000),
    photons=(1.0, 1e12),
    n_draws=(2, 10000),
)
QUICK = {"n_pixels": 32, "n_quarter": 5, "n_screens": 1}

HALF = np.pi / 2
DRAWN = (
    *((theta * np.pi, -theta * np.pi) for theta in (0.5, 0.8)),
    (HALF, -1.0),
    (np.pi, HALF),
    *((theta * np.pi, -theta * np.pi) for theta in (0.25, 0.65)),
)
"""Pairs for which the predicted noise is compared with drawn noise, radian."""


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


def noise_of_pairs(
    pupil: Pupil, diameter: float, angles: Sequence[float], wavefronts: Mapping[str, NDArray]
) -> dict[str, NDArray[np.float64]]:
    """Predicted noise of pairs (theta, -theta): photon noise for each wavefront, and read noise for the first."""
    first = next(iter(wavefronts))
    names = [*(f"photon noise, {name}" for name in wavefronts), f"read noise, {first}"]
    noise = {name: np.empty(len(angles)) for name in names}
    for index, theta in enumerate(angles):
        sensor = _sensor(pupil, diameter, theta, -theta)
        for name, phases in wavefronts.items():
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
    wavefronts: Mapping[str, NDArray],
    photons: float,
    n_draws: int,
    *,
    seed: int = 0,
) -> list[DrawnNoise]:
    """Photon noise of the pairs of `DRAWN`, predicted and drawn; see `noise_of_pairs` and `drawn_noise`."""
    rows = []
    for theta_a, theta_b in DRAWN:
        sensor = _sensor(pupil, diameter, theta_a, theta_b)
        for name, phases in wavefronts.items():
            draws = np.array(
                [drawn_noise(sensor, phase, photons, n_draws, seed + i) for i, phase in enumerate(phases)]
            )
            expected = _rms(np.array([phase_noise(sensor, phase).photon for phase in phases]))
            error = float(np.linalg.norm(draws[:, 1]) / len(phases))
            rows.append(DrawnNoise(theta_a, theta_b, f"photon noise, {name}", expected, _rms(draws[:, 0]), error))
    return rows


def close_pairs(
    pupil: Pupil, diameter: float, gaps: Sequence[float], screens: NDArray, n_iterations: int = 25
) -> NDArray[np.float64]:
    """Error and photon noise of pairs that are nearly equal: pi/2, and pi/2 less a gap (radian)."""
    rows = []
    for gap in gaps:
        sensor = _sensor(pupil, diameter, HALF, HALF - gap)
        phase = PhaseShifted(sensor, n_iterations=n_iterations)(sensor.measure(screens)).phase
        noise = _rms(phase_noise(sensor, np.zeros(pupil.shape)).photon)
        rows.append((gap, reconstruction_error(pupil, phase, screens).mean(), noise))
    return np.array(rows)


def _sensor(pupil: Pupil, diameter: float, theta_a: float, theta_b: float) -> ZernikeSensor:
    """Sensor with two dimples of one diameter."""
    return ZernikeSensor(pupil, Dimple(diameter, theta_a), Dimple(diameter, theta_b))


def drawn_noise(
    sensor: ZernikeSensor, phase: NDArray, photons: float, n_draws: int, seed: int = 0
) -> tuple[float, float]:
    """Photon noise of the phase-shifted iteration on frames with drawn noise, and its standard error."""
    camera = Detector(photons)
    frames = np.repeat(sensor.measure(phase)[np.newaxis], n_draws, axis=0)
    estimate = PhaseShifted(sensor)(camera.normalise(camera.expose(frames, seed)))
    power = photons * reconstruction_error(sensor.pupil, estimate.phase, phase) ** 2
    noise = float(np.sqrt(power.mean()))
    return noise, float(power.std(ddof=1) / np.sqrt(n_draws) / (2 * noise))


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


def draw_pair_noise(angles: NDArray, noise: Mapping[str, NDArray], rows: Sequence[DrawnNoise]) -> Figure:
    """Noise of the pairs (theta, -theta) against theta, relative to its value at pi/2."""
    figure, axes = plt.subplots(figsize=(7, 4.2))
    middle = int(np.argmin(np.abs(angles - np.pi / 2)))
    for (name, values), style in zip(noise.items(), OTHER_STYLES, strict=False):
        shade, scale = style["color"], values[middle]
        axes.plot(angles, values / scale, lw=1.8, label=name, **style | {"marker": "none"})
        least = int(np.argmin(values))
        axes.plot(angles[least], values[least] / scale, "*", color=shade, ms=12)
        if drawn := [row for row in rows if row.name == name and row.theta_a == -row.theta_b]:
            theta, value, error = np.array([(row.theta_a, row.drawn, row.error) for row in drawn]).T
            style = {"fmt": "o", "mfc": "none", "color": shade, "ms": 6, "capsize": 3}
            axes.errorbar(theta, value / scale, error / scale, label=f"_{name}, simulated", **style)
    axes.axhline(1, color="#555555", lw=1)
    axes.axvline(HALF, color="#555555", lw=1)
    axes.set_xticks(np.pi * np.linspace(0, 1, 5), ("0", "π/4", "π/2", "3π/4", "π"))
    axes.set(xlabel=r"$\theta$ of the pair $(\theta, -\theta)$ (rad)", ylabel="noise / noise at ±π/2")
    axes.set(xlim=(0, np.pi), ylim=(0.6, 2))
    axes.legend(loc="lower left", fontsize=9)
    return figure


def allowed_table(maps: PairMaps) -> Table:
    """Pairs that work without noise, and their errors."""
    worst, least = np.nanmax(maps.error), np.nanmin(maps.error)
    return Table(
        ["pairs of the map", "measured"],
        [
            ["all, in either order", maps.error.size],
            ["refused by PhaseShifted", int(maps.singular.sum())],
            [
                "refused: exactly those with equal shifts mod 2π or a shift of 0",
                bool(np.array_equal(maps.singular, maps.forbidden)),
            ],
            ["largest error of the others (rad rms)", small(worst)],
            ["largest error of the others over the smallest, minus 1", small(worst / least - 1)],
            ["some pair with a shift of 0 works", maps.zero_works],
        ],
    )


def close_table(rows: NDArray) -> Table:
    """Errors and noise of pairs that are nearly equal, see `close_pairs`."""
    return Table(
        ["θa − θb (rad)", "error without noise (rad rms)", "photon noise (rad √photon)"],
        [[f"{gap:g}", small(error), f"{noise:.3g}"] for gap, error, noise in rows],
    )


def drawn_table(rows: Sequence[DrawnNoise]) -> Table:
    """Predicted noise next to that of draws."""
    return Table(
        ["pair", "noise", "predicted (rad √photon)", "simulated", "standard error"],
        [
            [
                f"{_pi(row.theta_a)}, {_pi(row.theta_b)}",
                row.name,
                f"{row.expected:.4g}",
                f"{row.drawn:.4g}",
                f"{row.error:.1g}",
            ]
            for row in rows
        ],
    )


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


def gain_errors(maps: PairMaps, pupil: Pupil, diameter: float, screens: NDArray) -> dict[str, float]:
    """Standard errors over the screens of the gains of the best pairs for the screens, see `numbers`."""
    usual = [phase_noise(_sensor(pupil, diameter, HALF, -HALF), screen) for screen in screens]
    found = {}
    for name, field in (("aberrated", "photon"), ("bound", "bound")):
        sensor = _sensor(pupil, diameter, *maps.best(name)[:2])
        best = [phase_noise(sensor, screen) for screen in screens]
        ratios = [_rms(getattr(a, field)) / _rms(getattr(b, field)) for a, b in zip(best, usual, strict=True)]
        found[f"gain_{name}_error"] = float(np.std(ratios) / np.sqrt(len(ratios)))
    return found


def numbers(maps: PairMaps, rows: Sequence[DrawnNoise], errors: Mapping[str, float]) -> dict[str, float | str]:
    """Numbers of the claims of section 4.2 on pairs; `errors` from `gain_errors`."""
    found = dict(errors) | {
        "n_allowed": (~maps.singular).sum(),
        "singular_as_expected": np.array_equal(maps.singular, maps.forbidden),
        "zero_works": maps.zero_works,
        "error_max_allowed_pairs": np.nanmax(maps.error),
    }
    for name, suffix in (("flat", ""), ("aberrated", "_aberrated"), ("bound", "_bound"), ("read", "_read")):
        theta_a, _, value = maps.best(name)
        found |= {
            f"best_noise{suffix}": value,
            f"noise_at_half_pi{suffix}": maps.at(name, HALF, -HALF),
            f"best_pi{suffix}": abs(theta_a) / np.pi,
        }
    found |= {
        "gain_flat": 1 - found["best_noise"] / found["noise_at_half_pi"],
        "photons_saved_flat": 1 - (found["best_noise"] / found["noise_at_half_pi"]) ** 2,
        "gain_aberrated": 1 - found["best_noise_aberrated"] / found["noise_at_half_pi_aberrated"],
        "gain_bound": 1 - found["best_noise_bound"] / found["noise_at_half_pi_bound"],
        "drawn_difference": max(abs(row.drawn / row.expected - 1) for row in rows),
    }
    return rounded(found, ".4g")
