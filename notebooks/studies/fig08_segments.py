"""Figure 8: the errors of the segments of one screen."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.bench import check_bench
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.style import ALONE, LOOKS, show_phase
from zwfs.bench import Bench

LIMITS = parameter_limits("rms exponent n_iterations", n_pixels=(32, 1024), bench=bench_fields("n_pixels"))
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68}


def draw_segment_errors(bench: Bench, commanded: NDArray, errors: Mapping[str, NDArray]) -> Figure:
    """Figure 8: error of the piston of each segment, as points and as maps, and the commands."""
    pistons = {"commanded": commanded} | {f"error,\n{LOOKS[name].name}": values for name, values in errors.items()}
    maps = {
        title: np.where(bench.segments > 0, bench.commanded_phase(values), np.nan)
        for title, values in pistons.items()
    }
    figure, panels = plt.subplot_mosaic(
        [["points"] * len(maps), list(maps)], figsize=(7, 5.2), height_ratios=[1, 1]
    )
    points = panels["points"]
    for name, values in errors.items():
        look = LOOKS[name]
        rms = np.sqrt(np.mean(values**2))
        label = f"{look.label}: {rms:.2f} rad rms"
        points.plot(bench.numbers, values, look.marker, color=look.color, ms=5, label=label, alpha=0.9)
    points.axhline(0, color="#555555", lw=1)
    points.set(xlabel="segment number", ylabel="error of the piston (rad)")
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    limit = max(np.nanmax(np.abs(image)) for image in maps.values())
    panels["commanded"].set_gid(ALONE)
    for title, image in maps.items():
        shown = show_phase(panels[title], image, limit)
        panels[title].set_title(title, fontsize=10)
    figure.colorbar(shown, ax=[panels[title] for title in maps], label="phase (rad)", shrink=0.8, aspect=16)
    return figure


def error_columns(bench: Bench, commanded: NDArray, errors: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Command and errors of each segment."""
    columns = {"segment": bench.numbers, "commanded (rad)": commanded}
    return columns | {f"error, {name} (rad)": values for name, values in errors.items()}


def numbers(errors: Mapping[str, NDArray]) -> dict[str, float | str]:
    """Numbers for the text: rms and largest error of both methods; `errors` are (n_segments,) each, rad."""
    linear, shifted = errors["Linear"], errors["PhaseShifted"]
    return rounded(
        {
            "linear_at_08": linear.std(),
            "shifted_at_08": shifted.std(),
            "linear_worst": np.abs(linear).max(),
            "shifted_worst": np.abs(shifted).max(),
        }
    )
