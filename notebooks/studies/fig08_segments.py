"""Figure 8: the errors of the segments of one screen."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from studies.kit.bench import check_bench
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.style import ALONE, LOOKS, show_phase
from zwfs.bench import Bench

LIMITS = parameter_limits("rms exponent n_iterations", n_pixels=(32, 1024), bench=bench_fields("n_pixels"))
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68}
_SHOWN = 0.95  # of the errors lie within the scale of their maps
_FOLDED = -1.0  # rad, well below the branch point of one image


def draw_segment_errors(bench: Bench, commanded: NDArray, errors: Mapping[str, NDArray]) -> Figure:
    """Figure 8: error of the piston of each segment, as points and as maps, and the commands."""
    pistons = {"commanded": commanded} | {f"error, {LOOKS[name].name}": values for name, values in errors.items()}
    maps = {
        title: np.where(bench.segments > 0, bench.commanded_phase(values), np.nan)
        for title, values in pistons.items()
    }
    figure, panels = plt.subplot_mosaic(
        [["points"] * len(maps), list(maps)], figsize=(7, 5.6), height_ratios=[1, 1.3]
    )
    points = panels["points"]
    figure.set_layout_engine("constrained", hspace=0.08)  # between the label of an axis and titles
    for name, values in errors.items():
        look = LOOKS[name]
        rms = np.sqrt(np.mean(values**2))
        label = f"{look.label}: {rms:.2f} rad rms"
        points.plot(bench.numbers, values, look.marker, color=look.color, ms=5, label=label, alpha=0.9)
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    panels["commanded"].set_gid(ALONE)
    several = np.abs(np.concatenate(list(errors.values())))
    for title, image in maps.items():
        alone = title == "commanded"
        # The errors have a scale of their own; the largest ones are beyond it.
        limit = np.nanmax(np.abs(image)) if alone else np.quantile(several, _SHOWN)
        shown = show_phase(panels[title], image, limit)
        panels[title].set_title(title, fontsize=10)
        if alone:
            figure.colorbar(shown, ax=panels[title], location="bottom", label="piston (rad)", aspect=12)
    both = [panels[title] for title in maps if title != "commanded"]
    bar = figure.colorbar(shown, ax=both, location="bottom", extend="both", label="error (rad)", aspect=24)
    bar.locator = MaxNLocator(5)
    return figure


def numbers(errors: Mapping[str, NDArray], commanded: NDArray) -> dict[str, float | str]:
    """Numbers for the text: input, rms of the errors of both methods; arrays are (n_segments,), rad."""
    linear, shifted = errors["Linear"], errors["PhaseShifted"]
    folded = commanded < _FOLDED
    share = np.abs(linear[folded] / commanded[folded]) if folded.any() else np.array([np.nan])
    return rounded(
        {
            "input": commanded.std(),
            "linear_at_08": linear.std(),
            "shifted_at_08": shifted.std(),
            "folded_least": share.min(),
            "folded_most": share.max(),
        }
    )
