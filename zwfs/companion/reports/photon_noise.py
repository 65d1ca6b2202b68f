"""Photon noise: the ratios to the bound, the error bars, and the numbers of the text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.photon_noise import EXPECTED, SIGMAS, ErrorBars, PhotonCurves

TABLED = "MaximumLikelihood", "PhaseShifted"


def columns(curves: PhotonCurves) -> dict[str, NDArray]:
    """Columns of the errors and the bound."""
    size = curves.rms.size, curves.photons.size
    grid = {
        "input (rad rms)": np.repeat(curves.rms, size[1]),
        "photons per point": np.tile(curves.photons, size[0]),
        "bound: error (rad rms)": curves.bound.ravel(),
    }
    return grid | {f"{name}: error (rad rms)": curves.error(name).ravel() for name in curves.errors}


def bar_columns(rows: Sequence[ErrorBars]) -> dict[str, NDArray]:
    """Columns of the shares of the points within error bars."""
    shares = {f"share, {row.assumed:g} times the photons assumed": row.within for row in rows}
    return {"standard errors": SIGMAS, "share, Gaussian errors": EXPECTED} | shares


def ratios(curves: Mapping[float, PhotonCurves]) -> Table:
    """Error over the bound of two methods, by the diameter of the dimples."""
    photons = next(iter(curves.values())).photons
    return Table(
        ["dimple, input", *(f"{value:g}" for value in photons)],
        [
            [f"{diameter:g} λ/D, {rms:g} rad rms", *cells]
            for diameter, one in curves.items()
            for rms, cells in zip(one.rms, _cells(*map(one.ratio, TABLED)), strict=True)
        ],
    )


def _cells(first: NDArray, second: NDArray) -> list[list[str]]:
    """Pairs of numbers, on one line each."""
    rows = zip(first, second, strict=True)
    return [[f"{a:.2f}/{b:.2f}" for a, b in zip(*row, strict=True)] for row in rows]


def numbers(curves: PhotonCurves, rows: Sequence[ErrorBars]) -> None:
    """Glue the numbers of the text."""
    bright = curves.photons >= min(100, curves.photons.max())
    half, one = (int(np.argmin(np.abs(curves.rms - value))) for value in (0.5, 1.0))
    likely, shifted = (curves.ratio(name)[:, bright] for name in TABLED)
    right = next((row for row in rows if row.assumed == 1), rows[0])
    wrong = max(rows, key=lambda row: row.assumed)
    low = min(rows, key=lambda row: row.assumed)
    place = int(np.argmin(np.abs(SIGMAS - 1)))
    glue_numbers(
        {
            "likely_excess": np.max(likely) - 1,
            "shifted_ratio": shifted[half].mean(),
            "shifted_photons": np.mean(shifted[half] ** 2) - 1,
            "arcsine_floor": curves.error("Arcsine")[half, -1],
            "saxton_floor": curves.error("GerchbergSaxton")[half, -1],
            "saxton_model_floor": curves.error("GerchbergSaxtonModel")[half, -1],
            "bound_at_100": curves.bound[half, int(np.argmin(np.abs(curves.photons - 100)))],
            "bound_growth": (curves.bound[one] / curves.bound[0]).mean(),
            "within_low": curves.within[:, bright].min(),
            "within_high": curves.within[:, bright].max(),
            "within_right": right.within[place],
            "within_wrong": wrong.within[place],
            "within_modest": low.within[place],
            "chi2_wrong": wrong.chi2,
            "chi2_modest": low.chi2,
            "consistent_right": right.consistent,
            "consistent_wrong": wrong.consistent,
            "consistent_modest": low.consistent,
        }
    )
