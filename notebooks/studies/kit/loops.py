"""Results of closed loops: the best gain of each method, and one image compared with two, screen by screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.kit.style import LOOKS

ONE_IMAGE = "Linear", "Arcsine"
TWO_IMAGES = "LinearTwo", "PhaseShifted", "MaximumLikelihood"
ALIKE = 1.05
"""Ratio of errors up to which the simpler one of two methods is named."""
_NAMES = {"Linear": "linear, one image", "LinearTwo": "linear, two images"}


@dataclass(frozen=True)
class TunedLoops:
    """Loops of all methods for one input and one star, each with its best gain."""

    start: float  # wavefront error at the start, radian rms
    photons: float  # per point, step and image of two; one image gets the light of both
    gains: Mapping[str, float]
    chosen: Mapping[str, float]  # residual with that gain on the screens that chose it, radian rms
    settled: Mapping[str, NDArray]  # (n_screens,) residual on new screens, radian rms

    def closed(self, method: str) -> NDArray[np.bool_]:
        """Whether each loop settled below half of the error at its start, shape (n_screens,)."""
        return self.settled[method] < self.start / 2


def typical(settled: NDArray) -> float:
    """Geometric mean of residuals, which counts loops that diverged without ignoring the others."""
    return float(np.exp(np.mean(np.log(settled))))


def two_digits(error: float) -> str:
    """Error with two significant digits, trailing zeros included."""
    return f"{error:#.2g}".rstrip(".")


def paired_ratio(first: NDArray, second: NDArray) -> tuple[float, float, float]:
    """Ratio of two errors, screen by screen: geometric mean, and this less and plus twice its standard error."""
    logs = np.log(first / second)
    error = 2 * logs.std(ddof=1) / np.sqrt(logs.size) if logs.size > 1 else np.inf
    middle, low, high = np.exp([logs.mean(), logs.mean() - error, logs.mean() + error])
    return float(middle), float(low), float(high)


@dataclass(frozen=True)
class BestMethods:
    """Best method with one and with two images, for one input and one star."""

    loops: TunedLoops
    one: str
    two: str
    ratio: float  # residual with two images over that with one, geometric mean over the screens
    low: float  # the ratio less and plus twice its standard error
    high: float

    @classmethod
    def of(cls, loops: TunedLoops, one: str, two: str) -> BestMethods:
        """Compare two methods screen by screen."""
        return cls(loops, one, two, *paired_ratio(loops.settled[two], loops.settled[one]))

    @property
    def best(self) -> str | None:
        """Best method, None if the two differ by less than twice the standard error or `ALIKE`."""
        if max(self.ratio, 1 / self.ratio) <= ALIKE:
            return None
        return self.two if self.high < 1 else self.one if self.low > 1 else None


def one_over_two(row: Any) -> str:
    """Error with one image over that with two, and in brackets two standard errors either way."""
    if np.isinf(row.high):
        return f"{1 / row.ratio:.2g} (one loop)"
    low, high = 1 / row.high, 1 / row.low
    digits = 0 if row.ratio <= 0.1 else 2 if high - low < 0.2 else 1
    return f"{1 / row.ratio:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def method_name(method: str) -> str:
    """Name of a method for readers, with the number of its images."""
    if method in _NAMES:  # `LOOKS` would add a look for a name that it does not know
        return _NAMES[method]
    return f"{LOOKS[method].name}, {'one image' if method in ONE_IMAGE else 'two images'}"


def short_name(method: str) -> str:
    """Name of a method without the number of its images."""
    return method_name(method).partition(",")[0]
