"""Phase and amplitude: errors next to the bound, and the numbers of the text."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.metrics import wrapped_residual
from zwfs.paper.phase_amplitude import WAYS, AmplitudeCurves
from zwfs.plots import LOOKS
from zwfs.pupil import Pupil
from zwfs.reconstructors import LikelihoodReconstruction

_SHORT = {"PhaseShifted": "shifted", "MaximumLikelihood": "likely"}  # in the names of glued numbers

TABLED = 0.05, 0.2
"""Variations of the amplitude in the table."""


def columns(curves: Mapping[str, AmplitudeCurves]) -> dict[str, NDArray]:
    """Columns of the errors and the bound."""
    columns = {}
    for kind, one in curves.items():
        columns["variation of the amplitude"] = one.variations
        columns[f"{kind}: bound (rad rms)"] = one.bound
        columns |= {f"{kind}: {way}: error (rad rms)": one.error(way) for way in WAYS}
    return columns


def map_columns(
    pupil: Pupil, phase: NDArray, amplitude: NDArray, estimate: LikelihoodReconstruction
) -> dict[str, NDArray]:
    """Columns of the maps, one row for each point of the pupil."""
    places = {"x (D)": pupil.points[:, 0], "y (D)": pupil.points[:, 1]}
    truth = {"phase (rad)": pupil.gather(phase), "amplitude": pupil.gather(amplitude)}
    columns = places | truth
    for name, (error, sigma) in _example(pupil, phase, amplitude, estimate).items():
        columns |= {f"error of the {name}": error, f"standard error of the {name}": sigma}
    return columns


def _example(
    pupil: Pupil, phase: NDArray, amplitude: NDArray, estimate: LikelihoodReconstruction
) -> dict[str, tuple[NDArray, NDArray]]:
    """Error and standard error of each point, by quantity."""
    maps = {
        "phase": (wrapped_residual(pupil, estimate.phase, phase), estimate.sigma),
        "amplitude": (np.asarray(estimate.amplitude) - amplitude, np.asarray(estimate.sigma_amplitude)),
    }
    return {name: (pupil.gather(error), pupil.gather(sigma)) for name, (error, sigma) in maps.items()}


def costs(curves: Mapping[str, AmplitudeCurves]) -> Table:
    """Return the error over the bound, and the share of consistent frame sets, of each way."""
    places = [(one, one.at(value), f"{kind}, {value:.0%}") for kind, one in curves.items() for value in TABLED]
    rows = []
    for name, way in WAYS.items():
        ratios = [f"{one.error(name)[place] / one.bound[place]:.2f}" for one, place, _ in places]
        known = [one.consistent[name][place] for one, place, _ in places if name in one.consistent]
        consistent = f"{np.mean(known):.0%}" if known else "not tested"
        rows.append([LOOKS[way.method].name, way.amplitude, *ratios, consistent])
    return Table(["method", "amplitude", *(title for _, _, title in places), "consistent"], rows)


def numbers(
    curves: Mapping[str, AmplitudeCurves],
    pupil: Pupil,
    phase: NDArray,
    amplitude: NDArray,
    estimate: LikelihoodReconstruction,
    rms: float,
    photons: float,
) -> None:
    """Glue the settings of the text, ratios to the bound, shares of consistent frame sets, and the example."""
    found: dict[str, float] = {"rms": rms, "photons": photons}
    ratios = {(name, kind): one.error(name) / one.bound for kind, one in curves.items() for name in WAYS}
    for (name, kind), ratio in ratios.items():
        way = f"{_SHORT[WAYS[name].method]}_{WAYS[name].amplitude}_{kind}"
        found |= {f"{way}_{100 * value:.0f}": ratio[curves[kind].at(value)] for value in (0, *TABLED)}
    best = np.concatenate([ratios["MaximumLikelihood, estimated", kind] for kind in curves])
    found |= {"estimated_lowest": best.min(), "estimated_highest": best.max()}
    for name in next(iter(curves.values())).consistent:
        shares = {
            value: np.mean([one.consistent[name][one.at(value)] for one in curves.values()])
            for value in (0, *TABLED)
        }
        word = f"consistent_{WAYS[name].amplitude}"
        found |= {f"{word}_0": shares.pop(0), word: np.mean(list(shares.values()))}
    for name, (error, sigma) in _example(pupil, phase, amplitude, estimate).items():
        found |= {f"example_{name}": np.sqrt(np.mean(error**2)), f"within_{name}": np.mean(np.abs(error) < sigma)}
    found["example_chi2"] = float(estimate.chi2)
    glue_numbers(found, ".4g")
