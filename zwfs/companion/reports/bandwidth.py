"""Bandwidth: errors next to the bound, the table, and the numbers of the text."""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.bandwidth import WAYS, BandCurves

TABLED = 0.05, 0.10, 0.25
"""Bandwidths in the table."""

_SHORT = {
    "PhaseShifted, ignored": "shifted",
    "MaximumLikelihood, ignored": "ignored",
    "MaximumLikelihood, known": "known",
}


def columns(curves: Mapping[tuple[float, bool], BandCurves]) -> dict[str, NDArray]:
    """Columns of the errors and the bound."""
    result = {}
    for (rms, chromatic), one in curves.items():
        kind = f"{rms:g} rad rms, {_kind(chromatic)}"
        result["bandwidth"] = one.bandwidths
        result[f"{kind}: bound (rad rms)"] = one.bound
        result |= {f"{kind}: {way}: error (rad rms)": one.error[way] for way in WAYS}
        result |= {f"{kind}: {way}: error without noise (rad rms)": bias for way, bias in one.bias.items()}
    return result


def costs(curves: Mapping[tuple[float, bool], BandCurves]) -> Table:
    """Error without noise of the reconstructors that ignore the bandwidth, over the input."""
    header = ["input, shifts", *(f"{_method(way)}, {width:.0%}" for way in _ignorant(curves) for width in TABLED)]
    rows = [
        [
            f"{rms:g} rad, {_kind(chromatic)}",
            *(f"{one.bias[way][one.at(width)] / rms:.2%}" for way in one.bias for width in TABLED),
        ]
        for (rms, chromatic), one in curves.items()
    ]
    return Table(header, rows)


def numbers(curves: Mapping[tuple[float, bool], BandCurves]) -> None:
    """Glue errors over the bound, errors without noise over the input, and photons at which the two are equal.

    Names: the way, the place of the input, the kind of the phase shift, and the bandwidth in percent.
    """
    inputs = sorted({rms for rms, _ in curves})
    found: dict[str, float] = {}
    for (rms, chromatic), one in curves.items():
        kind = f"{inputs.index(rms)}_{_kind(chromatic)}"
        for width in TABLED:
            place, end = one.at(width), f"{kind}_{100 * width:.0f}"
            found |= {f"{_SHORT[way]}_{end}": one.error[way][place] / one.bound[place] for way in WAYS}
            found |= {f"share_{_SHORT[way]}_{end}": bias[place] / rms for way, bias in one.bias.items()}
            found |= {f"photons_{_SHORT[way]}_{end}": one.equal_photons(way)[place] for way in one.bias}
    for width in TABLED:
        shares = [one.bias[_SHIFTED][one.at(width)] / rms for (rms, _), one in curves.items()]
        found |= {f"least_{100 * width:.0f}": min(shares), f"most_{100 * width:.0f}": max(shares)}
    found["known_most"] = max((one.error[_KNOWN] / one.bound).max() for one in curves.values())
    found["bound_least"] = min((one.bound / one.bound[one.at(0)]).min() for one in curves.values())
    found["bound_most"] = max((one.bound / one.bound[one.at(0)]).max() for one in curves.values())
    glue_numbers(found, ".3g")


_SHIFTED, _KNOWN = "PhaseShifted, ignored", "MaximumLikelihood, known"


def _ignorant(curves: Mapping[tuple[float, bool], BandCurves]) -> list[str]:
    return list(next(iter(curves.values())).bias)


def _method(way: str) -> str:
    return {"shifted": "phase-shifted", "ignored": "max. lik."}[_SHORT[way]]


def _kind(chromatic: bool) -> str:
    return "chromatic" if chromatic else "achromatic"
