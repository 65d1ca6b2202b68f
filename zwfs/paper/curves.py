"""Errors of several reconstructors against one input of an experiment, and where a curve rises above a limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.metrics import dynamic_range


@dataclass(frozen=True)
class ErrorCurves:
    """Errors of several reconstructors on random screens.

    Attributes
    ----------
    rms : ndarray, shape (n,), radian rms
        Input: wavefront error of the screens.
    errors : dict of ndarray, shape (n, n_screens), radian rms
        Error of each reconstructor on each screen.
    """

    rms: NDArray[np.floating]
    errors: dict[str, NDArray[np.float64]]

    def mean(self, name: str) -> NDArray[np.float64]:
        """Mean error over the screens, shape (n,), radian rms."""
        _check.choice("name", name, self.errors)
        return self.errors[name].mean(axis=1)

    def std(self, name: str) -> NDArray[np.float64]:
        """Standard deviation of the error over the screens, shape (n,), radian rms."""
        _check.choice("name", name, self.errors)
        return self.errors[name].std(axis=1)

    def dynamic_range(self, name: str, threshold: float = 0.05) -> float:
        """Input at which the mean error exceeds `threshold` times the input; see `zwfs.dynamic_range`."""
        return dynamic_range(self.rms, self.mean(name), threshold)

    def recovered(self, name: str, threshold: float = 0.05) -> NDArray[np.float64]:
        """Fraction of the screens with an error of at most `threshold` times the input, shape (n,)."""
        _check.choice("name", name, self.errors)
        threshold = _check.number("threshold", threshold, 0)
        return np.mean(self.errors[name] <= threshold * self.rms[:, np.newaxis], axis=1)

    def columns(self) -> dict[str, NDArray[np.floating]]:
        """Input, and mean and standard deviation of every reconstructor, as columns for `publish`."""
        columns = {"input (rad rms)": self.rms}
        for name in self.errors:
            columns[f"{name}: mean error (rad rms)"] = self.mean(name)
            columns[f"{name}: standard deviation (rad rms)"] = self.std(name)
        return columns


def crossing(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Return where a sampled positive curve rises above a limit for the first time.

    Parameters
    ----------
    x : array_like, shape (n,)
        Increasing.
    y : array_like, shape (n,)
        Positive; its logarithm is interpolated linearly.
    limit : float
        In the unit of `y`.

    Returns
    -------
    float
        In the unit of `x`; `x[0]` if the curve starts above the limit, infinity if it never gets there.

    Raises
    ------
    ValueError
        If the shapes differ, `x` does not increase or is not finite, or a value of `y` is not positive and finite.
    """
    x, y = _check.real_array("x", x), _check.real_array("y", y)
    if x.ndim != 1 or x.shape != y.shape or not x.size:
        raise ValueError(f"x and y have shapes {x.shape} and {y.shape}: expected the same (n,)")
    limit = _check.number("limit", limit, 0, open_low=True)
    _check.finite("x", x)
    _check.finite("y", y)
    if np.any(np.diff(x) <= 0) or np.any(y <= 0):
        raise ValueError("x, y: expected increasing x and positive y")
    above = np.flatnonzero(y > limit)
    if not above.size:
        return np.inf
    last = above[0]
    if last == 0:
        return float(x[0])
    low, high = np.log(y[last - 1 : last + 1])
    return float(x[last - 1] + (np.log(limit) - low) / (high - low) * (x[last] - x[last - 1]))
