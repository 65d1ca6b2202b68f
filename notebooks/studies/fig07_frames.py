"""Figure 7: agreement of modelled frames with measured ones, and of the phase with the commands."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.bench import ARMS, check_bench
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.style import show_intensity, show_phase
from studies.kit.tables import Table
from zwfs import Reconstruction
from zwfs.bench import BenchModel

LIMITS = parameter_limits("rms exponent n_iterations", n_pixels=(32, 1024), bench=bench_fields("n_pixels"))
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68}


def correlations(model: BenchModel, measured: NDArray, modelled: NDArray) -> list[float]:
    """Correlation of measured and modelled frames inside the pupil, for each image; (2, ny', nx') each."""
    inside = model.shifted.pupil.inside
    pairs = zip(measured[..., *model.shifted.window], modelled[..., *model.shifted.window], strict=True)
    return [float(np.corrcoef(one[inside], other[inside])[0, 1]) for one, other in pairs]


def draw_measured_and_modelled(measured: NDArray, modelled: NDArray, phase: NDArray) -> Figure:
    """Figure 7: frames, the frames that the reconstructed phase makes in the model, and their difference."""
    figure, panels = plt.subplot_mosaic(
        [["m0", "f0", "d0", "phase"], ["m1", "f1", "d1", "phase"]], figsize=(7, 4.1), width_ratios=[1, 1, 1, 1.4]
    )
    top = np.quantile(np.stack([measured, modelled]), 0.999)
    for row, (arm, frame, model) in enumerate(zip(ARMS, measured, modelled, strict=True)):
        image = show_intensity(panels[f"m{row}"], frame, top)
        show_intensity(panels[f"f{row}"], model, top)
        difference = show_phase(panels[f"d{row}"], frame - model, top / 4)
        panels[f"m{row}"].set_ylabel(f"image {arm}")
    for key, title in (
        ("m0", "measured"),
        ("f0", "modelled"),
        ("d0", "difference"),
        ("phase", "reconstructed\nphase"),
    ):
        panels[key].set_title(title, fontsize=10)
    found = show_phase(panels["phase"], phase, np.nanmax(np.abs(phase)))
    bars: dict[str, Any] = {"location": "bottom", "aspect": 25, "shrink": 0.85}
    figure.colorbar(image, ax=[panels[key] for key in ("m0", "f0", "m1", "f1")], label="intensity", **bars)
    figure.colorbar(difference, ax=[panels["d0"], panels["d1"]], label="intensity", extend="both", **bars)
    figure.colorbar(found, ax=panels["phase"], label="phase (rad)", **bars)
    return figure


def agreement_table(correlation: list[float], estimate: Reconstruction, error: NDArray) -> Table:
    """Agreement of the frames, and of the segments; `error` is (n_segments,), rad."""
    return Table(
        ["quantity", "value"],
        [
            ["correlation of measured and modelled, first image", correlation[0]],
            ["correlation of measured and modelled, second image", correlation[1]],
            ["rms difference of the frames (mean intensity of the pupil)", float(estimate.residual)],
            ["error of the segments (rad rms)", float(error.std())],
            ["points without a unique solution", int(estimate.n_unsolved)],
        ],
    )


def numbers(correlation: list[float], error: NDArray, commanded: NDArray) -> dict[str, float | str]:
    """Numbers for the text: input, correlation of the second image, and error as a share of the input."""
    share = error.std() / commanded.std() if commanded.any() else np.nan
    text = f"{share:.0%} of the input" if commanded.any() else f"{error.std():.2g} rad rms at a flat command"
    return rounded({"input": commanded.std(), "correlation_second": correlation[1]}) | {"error_text": text}
