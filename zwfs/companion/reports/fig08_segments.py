"""Figure 8: the errors of the segments of one screen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.plots import LOOKS


def claims(numbers: NDArray, errors: Mapping[str, NDArray]) -> Table:
    """Glue and show the error of each reconstructor, (n_segments,) in radian, over the segments' `numbers`."""
    linear, shifted = errors["Linear"], errors["PhaseShifted"]
    glue_numbers({"linear_at_08": linear.std(), "shifted_at_08": shifted.std()})
    glue_numbers({"linear_worst": np.abs(linear).max(), "shifted_worst": np.abs(shifted).max()})
    rows = []
    for name, values in errors.items():
        worst = np.abs(values).argmax()
        rows.append([LOOKS[name].name, float(values.std()), float(np.abs(values[worst])), int(numbers[worst])])
    return Table(["reconstructor", "error (rad rms)", "largest error (rad)", "segment"], rows)
