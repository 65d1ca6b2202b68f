"""The identities of section 2: their errors, which are bounded below by the rounding of the arithmetic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.paper.identities import ApproximationErrors, DimplePairs

QUOTED = {0.1: "01", 0.3: "03", 0.5: "05"}  # inputs whose errors the text shows, and the ends of the glued names
BEST, LITERAL = "amplitude × √S", "intensity × √S"

Curves = Mapping[str, Sequence[float]]
Errors = Mapping[str, Sequence[ApproximationErrors]]


def two_waves(errors: Mapping[str, tuple[float, float]], resolution: float) -> Table:
    """Return the largest errors for each mask."""
    rows = [[name, *(_text(value, resolution) for value in pair)] for name, pair in errors.items()]
    return Table(["mask", "two-wave formula, largest error", "model, largest error"], rows)


def approximation(inputs: Sequence[float], errors: Errors) -> tuple[Curves, Curves]:
    """Return curves of the errors of the reference wave, and of one step with it over the input."""

    def over_input(values: list[float]) -> list[float]:
        return [value / rms for value, rms in zip(values, inputs, strict=True)]

    wave = {"phase (rad rms)": [one.phase for one in errors[BEST]]}
    wave |= {name: [one.amplitude for one in errors[name]] for name in (BEST, LITERAL)}
    steps = {name: over_input([one.two_images for one in some]) for name, some in errors.items()}
    steps[f"{BEST}, one image"] = over_input([one.one_image for one in errors[BEST]])
    return wave, steps


def columns(inputs: Sequence[float], wave: Curves, steps: Curves) -> dict[str, Sequence[float]]:
    """Return the columns to publish."""
    return (
        {"input (rad rms)": inputs}
        | {f"reference wave: {name}": values for name, values in wave.items()}
        | {f"phase over input: {name}": values for name, values in steps.items()}
    )


def at_quoted(columns: Mapping[str, Sequence[float]]) -> Table:
    """Return the errors at the quoted inputs."""
    (_, inputs), *curves = columns.items()
    shown = [inputs.index(value) for value in QUOTED]
    header = ["", *(f"at {value:g} rad rms" for value in QUOTED)]
    return Table(header, [[name, *(float(values[i]) for i in shown)] for name, values in curves], digits=2)


def pair_columns(pairs: DimplePairs) -> dict[str, NDArray]:
    """Return the columns to publish."""
    return {
        "theta_a (rad)": pairs.shifts[:, 0],
        "theta_b (rad)": pairs.shifts[:, 1],
        "|det M|": pairs.determinant,
        "determinant with the waves' strength": pairs.strength,
    }


def true_waves(errors: Mapping[str, NDArray], resolution: float) -> Table:
    """Return the largest and the rms errors of phases from the true reference waves."""
    rows = [
        [name, _text(values, resolution), _text(np.sqrt(np.mean(values**2)), resolution)]
        for name, values in errors.items()
    ]
    return Table(["phase from", "largest error (rad)", "error (rad rms)"], rows)


def claims(
    wave_errors: Mapping[str, tuple[float, float]],
    inputs: Sequence[float],
    approximate: Errors,
    pairs: DimplePairs,
    true_wave: Mapping[str, NDArray],
    largest_phase: float,
    resolution: float,
) -> None:
    """Glue the numbers that the claims of section 2 rest on."""
    best_pair = int(np.argmax(pairs.determinant.round(9)))
    two_images, one_step, one_image = true_wave.values()
    errors: dict[str, ArrayLike] = {
        "dimple_two_wave_error": wave_errors["dimple"][0],
        "patch_two_wave_error": wave_errors["patch"][0],
        "patch_model_error": wave_errors["patch"][1],
        "determinant_error": pairs.sine_error,
        "half_difference_error": pairs.half_error,
        "diversity_at_0": pairs.determinant[pairs.difference < 1e-9],
        "true_wave_error": two_images,
        "one_step_error": one_step,
    }
    numbers = {name: _at_least(error, resolution) for name, error in errors.items()} | {
        "pairs_off_by_pi": pairs.off_by_pi,
        "largest_diversity": pairs.determinant[best_pair],
        "best_difference": pairs.difference[best_pair],
        "largest_phase": largest_phase,
        "one_image_error": np.sqrt(np.mean(one_image**2)),
    }
    for value, ending in QUOTED.items():
        right, literal = (approximate[name][inputs.index(value)] for name in (BEST, LITERAL))
        numbers |= {
            f"wave_error_{ending}": right.wave,
            f"wave_phase_error_{ending}": right.phase,
            f"wave_amplitude_error_{ending}": right.amplitude,
            f"step_error_{ending}": right.two_images,
            f"literal_amplitude_error_{ending}": literal.amplitude,
            f"literal_step_error_{ending}": literal.two_images,
        }
    glue_numbers(numbers, ".5g")


def _at_least(errors: ArrayLike, resolution: float) -> float:
    """Largest error, or the resolution, below which errors are rounding."""
    return max(float(np.max(errors)), resolution)


def _text(errors: ArrayLike, resolution: float) -> str:
    error = _at_least(errors, resolution)
    return f"<{error:.0e}" if error <= resolution else f"{error:.2g}"
