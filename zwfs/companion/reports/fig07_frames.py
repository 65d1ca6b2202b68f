"""Figure 7: how well modelled frames agree with measured ones, and the phase with the commands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.bench.model import BenchModel
from zwfs.bench.segments import segment_residual
from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.reconstructors.base import Reconstruction


def claims(
    model: BenchModel, commanded: NDArray, measured: NDArray, modelled: NDArray, estimate: Reconstruction
) -> Table:
    """Glue and show the correlation of the frames, (2, ny', nx') each, and the error of the segments."""
    pairs = zip(measured[..., *model.shifted.window], modelled[..., *model.shifted.window], strict=True)
    inside = model.shifted.pupil.inside
    first, second = (float(np.corrcoef(one[inside], other[inside])[0, 1]) for one, other in pairs)
    error = segment_residual(model.pistons(estimate.phase), commanded)
    share = error.std() / commanded.std() if commanded.any() else np.nan
    glue_numbers({"correlation_first": first, "correlation_second": second, "error_share": share})
    return Table(
        ["quantity", "value"],
        [
            ["correlation of measured and modelled, first image", first],
            ["correlation of measured and modelled, second image", second],
            ["rms difference of the frames (mean intensity of the pupil)", float(estimate.residual)],
            ["error of the segments (rad rms)", float(error.std())],
            ["points without a unique solution", int(estimate.n_unsolved)],
        ],
    )
