"""Pairs of phase shifts: columns of the figures, tables of the pairs, and the numbers of the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table, small
from zwfs.paper.phase_shifts import DrawnNoise, PairMaps

HALF = np.pi / 2


def _pi(angle: float) -> str:
    return f"{angle / np.pi:.3g}π".replace("-", "−")


def _half(maps: PairMaps) -> tuple[int, int]:
    """Place of the pair of +-pi/2 in the maps."""
    return int(np.argmin(abs(maps.angles - HALF))), int(np.argmin(abs(maps.angles + HALF)))


def _zero_works(maps: PairMaps) -> bool:
    """Whether some pair with a phase shift of 0 works."""
    return not maps.singular[np.isclose(maps.angles, 0)].all()


def map_columns(maps: PairMaps) -> dict[str, NDArray]:
    """Columns of the maps of all pairs."""
    return {
        "theta a (rad)": np.repeat(maps.angles, maps.angles.size),
        "theta b (rad)": np.tile(maps.angles, maps.angles.size),
        "error (rad rms)": maps.error.ravel(),
        "photon noise, flat (rad sqrt(photon))": maps.flat.ravel(),
        "photon noise, screens (rad sqrt(photon))": maps.aberrated.ravel(),
    }


def allowed(maps: PairMaps) -> Table:
    """Pairs that work without noise, and their errors."""
    worst, least = np.nanmax(maps.error), np.nanmin(maps.error)
    return Table(
        ["pairs of the map", "measured"],
        [
            ["all, in either order", maps.error.size],
            ["refused by PhaseShifted", int(maps.singular.sum())],
            [
                "these are those with equal shifts mod 2π or a shift of 0",
                bool(np.array_equal(maps.singular, maps.forbidden)),
            ],
            ["largest error of the others (rad rms)", small(worst)],
            ["largest over smallest error of these, less 1", small(worst / least - 1)],
            ["some pair with a shift of 0 works", _zero_works(maps)],
        ],
    )


def close(rows: NDArray) -> Table:
    """Pairs that are nearly equal, see `zwfs.paper.phase_shifts.close_pairs`."""
    return Table(
        ["θa − θb (rad)", "error without noise (rad rms)", "photon noise (rad √photon)"],
        [[f"{gap:g}", small(error), f"{noise:.3g}"] for gap, error, noise in rows],
    )


def cut_columns(angles: NDArray, noise: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of the noise of the pairs (theta, -theta), over that of +-pi/2."""
    middle = int(np.argmin(abs(angles - HALF)))
    return {
        "theta (rad)": angles,
        **{f"{name}, over that of pi/2": values / values[middle] for name, values in noise.items()},
    }


def drawn(rows: Sequence[DrawnNoise]) -> Table:
    """Predicted noise next to that of draws."""
    return Table(
        ["pair", "noise", "predicted (rad √photon)", "drawn", "standard error"],
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


def best(maps: PairMaps, rms: float) -> Table:
    """Best pair of the maps for each kind of noise."""
    titles = {
        "flat": "photon noise, flat wavefront",
        "aberrated": f"photon noise, {rms:g} rad rms",
        "read": "read noise, flat wavefront",
        "bound": "bound, photon noise, flat wavefront",
    }
    rows = []
    for name, title in titles.items():
        theta_a, theta_b, value = maps.best(name)
        usual = float(getattr(maps, name)[_half(maps)])
        rows.append([title, f"{_pi(theta_a)}, {_pi(theta_b)}", value, usual, f"{1 - value / usual:.1%}"])
    return Table(["noise", "best pair", "value there", "at ±π/2", "gain"], rows)


def claims(maps: PairMaps, angles: NDArray, noise: Mapping[str, NDArray], rows: Sequence[DrawnNoise]) -> Table:
    """Glue the numbers of the claims of section 4.2 on pairs, and show them."""
    expected, zero_works = bool(np.array_equal(maps.singular, maps.forbidden)), _zero_works(maps)
    numbers = {
        "n_pairs": maps.error.size,
        "n_singular": maps.singular.sum(),
        "n_allowed": (~maps.singular).sum(),
        "singular_as_expected": int(expected),
        "zero_works": int(zero_works),
        "error_max_allowed_pairs": np.nanmax(maps.error),
    }
    for name, suffix in (("flat", ""), ("aberrated", "_aberrated"), ("read", "_read")):
        theta_a, theta_b, value = maps.best(name)
        numbers |= {
            f"best_theta_a{suffix}": theta_a,
            f"best_theta_b{suffix}": theta_b,
            f"best_noise{suffix}": value,
            f"noise_at_half_pi{suffix}": getattr(maps, name)[_half(maps)],
        }
        numbers[f"best_pi{suffix}"] = abs(theta_a) / np.pi
    place = tuple(abs(maps.angles - numbers[name]).argmin() for name in ("best_theta_a", "best_theta_b"))
    numbers |= {
        "gain_flat": 1 - numbers["best_noise"] / numbers["noise_at_half_pi"],
        "photons_saved_flat": 1 - (numbers["best_noise"] / numbers["noise_at_half_pi"]) ** 2,
        "gain_aberrated": 1 - numbers["best_noise_aberrated"] / numbers["noise_at_half_pi_aberrated"],
        "gain_moved": 1 - maps.aberrated[place] / numbers["noise_at_half_pi_aberrated"],
    }
    numbers["cut_best_theta_flat"] = angles[np.argmin(noise["photon noise, flat wavefront"])]
    numbers["drawn_difference"] = max(abs(row.drawn / row.expected - 1) for row in rows)
    glue_numbers(numbers, ".4g")
    return Table(
        ["claim", "what was looked at", "measured"],
        [
            ["14", "all pairs work but those with equal shifts or a 0", expected],
            ["14", "(0, π) is the only other exception", zero_works],
            ["15", "best pair, photon noise", f"±{_pi(maps.best('flat')[0])}"],
            ["15", "best pair, read noise", f"±{_pi(maps.best('read')[0])}"],
        ],
    )
