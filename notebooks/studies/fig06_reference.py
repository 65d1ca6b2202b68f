"""Figure 6: the images of a flat command, and the errors of the bench."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.bench import ARMS, UNITS, check_bench
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.style import show_intensity
from studies.kit.tables import Table
from zwfs.bench import Bench

LIMITS = parameter_limits(n_pixels=(32, 1024), bench=bench_fields("n_pixels"))
CHECK_TOGETHER = check_bench


def draw_reference_intensities(frames: NDArray, clear_frames: NDArray) -> Figure:
    """Figure 6: the two images of a flat command, mask in, and the clear frames, (2, ny, nx) each."""
    figure, panels = plt.subplots(1, 4, figsize=(7, 3.1))
    for pair, images, label in ((panels[:2], frames, "mask in"), (panels[2:], clear_frames, "mask out")):
        top = np.quantile(images, 0.9995)
        for axes, image, arm in zip(pair, images, ARMS, strict=True):
            shown = show_intensity(axes, image, top)
            axes.set_title(f"{label},\nimage {arm}", fontsize=10)
        figure.colorbar(shown, ax=pair, label="intensity", location="bottom", shrink=0.7, aspect=30)
    return figure


def error_table(bench: Bench) -> Table:
    """Size of each error of the bench."""
    rows = [[name, float(getattr(bench, name)), unit] for name, unit in UNITS.items()]
    return Table(["error", "value", "unit"], rows)
