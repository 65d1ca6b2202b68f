"""Errors of several reconstructors against one input of an experiment, and where a curve rises above a limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from studies.kit.results import screen_errors
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

    def screens(self) -> dict[str, NDArray]:
        """Input and errors of every single screen, as columns for `publish`."""
        return screen_errors("input (rad rms)", self.rms, self.errors)


class Limit(NamedTuple):
    """Input or diameter at which a mean error exceeds a threshold, and its standard error (NaN: not known)."""

    value: float
    error: float = np.nan

    def __str__(self) -> str:
        if not self.error > 0:  # NaN, or 0 from a single screen
            return f"about {self.value:.2g}"
        digits = max(0, -int(f"{self.error:.0e}"[-3:]))  # one digit of the error
        return f"{self.value:.{digits}f} ± {self.error:.{digits}f}"

    def over(self, other: Limit) -> Limit:
        """Ratio to an independent limit; NaN if that is not known."""
        if not 0 < other.value < np.inf:
            return Limit(np.nan)
        ratio = self.value / other.value
        return Limit(ratio, float(np.hypot(self.error, ratio * other.error) / other.value))


def percent(share: float) -> str:
    """Share as text without needless digits."""
    return f"{100 * share:.3g} %"


def fitted_limit(x: ArrayLike, ratio: NDArray, threshold: float, seed: Any = 0, n_draws: int = 1000) -> Limit:
    """Limit at which the mean over the screens of a ratio, (n, n_screens), rises through a threshold.

    A cubic is fitted to the square root of the mean: if few screens fail, its noise is the same at all inputs.
    The standard error is that of draws of the screens with replacement.
    """
    x, n_screens = np.asarray(x, float), ratio.shape[1]
    shares = np.random.default_rng(seed).multinomial(n_screens, np.full(n_screens, 1 / n_screens), n_draws)
    means = np.column_stack([ratio.mean(axis=1), ratio @ shares.T / n_screens])
    middle, half = (x[-1] + x[0]) / 2, (x[-1] - x[0]) / 2
    cubics = np.polyfit((x - middle) / half, np.sqrt(means), 3)
    steps = np.linspace(-1, 1, 2001)
    below = np.vander(steps, 4) @ cubics <= np.sqrt(threshold)
    # The first step above the threshold; the last input if all are below, and the first if all are above.
    places = middle + half * steps[np.where(below.all(axis=0), -1, np.argmin(below, axis=0))]
    return Limit(float(places[0]), float(places[1:].std()))


def refined_limit(
    ratios: Callable[[NDArray], NDArray], start: float, threshold: float, *, width: float, seed: Any = 0
) -> Limit:
    """Limit near `start`, from `ratios` of error to input, (5, n_screens), at five places close to it."""
    middle = start
    for _ in range(4):
        x = middle * np.linspace(1 - width, 1 + width, 5)
        limit = fitted_limit(x, ratios(x), threshold, seed)
        if abs(limit.value / middle - 1) < 0.99 * width:
            return limit
        middle = limit.value
    return Limit(start)


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
