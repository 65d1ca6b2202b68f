"""Figure of the bandwidth: errors of reconstructors that ignore it or know it."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

from zwfs.paper.bandwidth import WAYS, BandCurves
from zwfs.plots.style import LOOKS

_LINES = {"ignored": ("-", None), "known": ("--", "white")}


def band_errors(curves: Mapping[tuple[float, bool], BandCurves]) -> Figure:
    """Error of each way over the bound, against the bandwidth: one panel for each input and kind of phase shift.

    Parameters
    ----------
    curves : mapping of (float, bool) to BandCurves
        By the wavefront error (rad rms), and whether the phase shifts are chromatic.
    """
    n_columns = len({chromatic for _, chromatic in curves})
    n_rows = len(curves) // n_columns
    figure, panels = plt.subplots(
        n_rows, n_columns, figsize=(7, 1.2 + 2.5 * n_rows), sharex=True, sharey=True, squeeze=False
    )
    for axes, ((rms, chromatic), one) in zip(panels.flat, curves.items(), strict=True):
        axes.axhline(1, color="#999999", lw=5, solid_capstyle="round", label="bound in the band", zorder=0)
        for name, method in WAYS.items():
            look, way = LOOKS[method], name.rpartition(" ")[2]
            line, face = _LINES[way]
            axes.plot(
                100 * one.bandwidths, one.error[name] / one.bound, label=f"{look.name}, bandwidth {way}",
                color=look.color, marker=look.marker, linestyle=line, markerfacecolor=face, ms=6,
            )  # fmt: skip
        axes.set_title(f"{rms:g} rad rms, {'chromatic' if chromatic else 'achromatic'} shifts", fontsize=10)
        axes.set(yscale="log")
    panels[0, 0].yaxis.set_major_locator(FixedLocator([1, 1.5, 2, 3, 5, 10]))
    panels[0, 0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
    panels[0, 0].yaxis.set_minor_formatter(NullFormatter())
    for axes in panels[-1]:
        axes.set_xlabel("bandwidth (%)")
    for axes in panels[:, 0]:
        axes.set_ylabel("error / bound")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
