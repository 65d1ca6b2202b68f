"""Errors of several reconstructors against one input of an experiment, and where a curve rises above a limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs.metrics import dynamic_range


@dataclass(frozen=True)
class ErrorCurves:
    """Errors of several reconstructors on random screens."""

    rms: NDArray[np.floating]  # (n_rms,), radian rms
    errors: dict[str, NDArray[np.float64]]  # (n_rms, n_screens) by name, radian rms

    def mean(self, name: str) -> NDArray[np.float64]:
        """Mean error over the screens, shape (n,), radian rms."""
        return self.errors[name].mean(axis=1)

    def std(self, name: str) -> NDArray[np.float64]:
        """Standard deviation of the error over the screens, shape (n,), radian rms."""
        return self.errors[name].std(axis=1)

    def dynamic_range(self, name: str, threshold: float = 0.05) -> float:
        """Input at which the mean error exceeds `threshold` times the input; see `zwfs.dynamic_range`."""
        return dynamic_range(self.rms, self.mean(name), threshold)

    def recovered(self, name: str, threshold: float = 0.05) -> NDArray[np.float64]:
        """Fraction of the screens with an error of at most `threshold` times the input, shape (n,)."""
        return np.mean(self.errors[name] <= threshold * self.rms[:, np.newaxis], axis=1)

    def columns(self) -> dict[str, NDArray[np.floating]]:
        """Input, and mean and standard deviation of every reconstructor, as columns for `publish`."""
        columns = {"input (rad rms)": self.rms}
        for name in self.errors:
            columns[f"{name}: mean error (rad rms)"] = self.mean(name)
            columns[f"{name}: standard deviation (rad rms)"] = self.std(name)
        return columns


def crossing(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Return where a positive curve, sampled at increasing x, rises above a limit for the first time."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    above = np.flatnonzero(y > limit)
    if not above.size:
        return np.inf
    last = above[0]
    if last == 0:
        return float(x[0])
    low, high = np.log(y[last - 1 : last + 1])
    return float(x[last - 1] + (np.log(limit) - low) / (high - low) * (x[last] - x[last - 1]))
