"""Figure 6: the errors of the bench, and numbers of the frames of a flat command."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.bench.model import Bench, BenchModel
from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table

UNITS = {
    "leakage": "of the light",
    "focus_difference": "D²/λ",
    "misregistration": "pixels",
    "blur": "pixels rms",
    "flux_imbalance": "of the mean flux",
    "dimple_error": "of the diameter",
    "static": "rad rms",
    "quilting": "rad rms",
    "photons": "photons in an image",
    "read_noise": "electrons rms",
    "background": "electrons in a pixel",
}


def errors(bench: Bench) -> Table:
    """Return the size of each error of the bench."""
    rows = [[name, float(getattr(bench, name)), unit] for name, unit in UNITS.items()]
    return Table(["error", "value", "unit"], rows)


def claims(model: BenchModel, frames: NDArray, clear_counts: NDArray) -> Table:
    """Glue and show numbers of normalised frames and of the counts of clear frames, (2, ny', nx') each."""
    on_segment = model.segments > 0
    first, second = frames[..., *model.shifted.window][:, on_segment]
    flux = clear_counts[..., *model.shifted.window][:, on_segment].mean(axis=1)
    outside = 1 - first.sum() / frames[0].sum()
    usable = len(model.numbers)
    glue_numbers({"usable_segments": usable, "light_outside": outside})
    return Table(
        ["what the images show", "value"],
        [
            ["usable segments", usable],
            ["light of a frame that lies outside the segments", f"{outside:.1%}"],
            ["flux of the first image over that of the second", float(flux[0] / flux[1])],
            ["correlation of the two frames inside", float(np.corrcoef(first, second)[0, 1])],
        ],
    )
