"""Tables and glued numbers of the notebooks: one module for each notebook, with the same stem."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray


def middle_rows(pairs: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return columns for `publish`: the middle row of both images of each named pair, (2, ny, nx)."""
    _, ny, nx = next(iter(pairs.values())).shape
    rows = {f"{name}, image {i + 1}": pair[i, ny // 2] for name, pair in pairs.items() for i in range(2)}
    return {"column (pixel)": np.arange(nx)} | rows
