"""Checks of what a caller hands in: each names the argument, its value and what was expected."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray


def integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Return `value` as an int between `low` and `high`."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral):
        whole = isinstance(value, float) and value.is_integer()
        raise TypeError(f"{name} = {value!r}: expected an integer{f', as in {int(value)}' if whole else ''}")
    if not low <= value <= high:
        expected = f"at least {low}" if high == math.inf else f"an integer in [{low}, {high}]"
        raise ValueError(f"{name} = {value}: expected {expected}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} = {value!r}: expected True or False")
    return bool(value)


def number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    open_low: bool = False,
    open_high: bool = False,
) -> float:
    """Return `value` as a finite float between `low` and `high`; an open end excludes the bound."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise TypeError(f"{name} = {value!r}: expected a real number")
    too_low = value <= low if open_low else value < low
    too_high = value >= high if open_high else value > high
    if not math.isfinite(value) or too_low or too_high:
        left, right = "(" if open_low else "[", ")" if open_high else "]"
        raise ValueError(f"{name} = {value!r}: expected a finite number in {left}{low:g}, {high:g}{right}")
    return float(value)


def real_array(name: str, value: Any) -> NDArray:
    """Return `value` as a float32 or float64 array; integers become float64."""
    array = np.asarray(value)
    if array.dtype.kind == "c":
        raise TypeError(f"{name} is complex ({array.dtype}): expected real numbers")
    return _floating(name, array)


def complex_array(name: str, value: Any) -> NDArray:
    """Return `value` as a complex64 or complex128 array."""
    array = np.asarray(value)
    if array.dtype.kind == "c":
        return array if array.dtype in (np.complex64, np.complex128) else array.astype(np.complex128)
    array = _floating(name, array)
    return array.astype(np.result_type(array.dtype, np.complex64))


def _floating(name: str, array: NDArray) -> NDArray:
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} has dtype {array.dtype}: expected real numbers")
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def trailing_shape(name: str, array: NDArray, shape: tuple[int, ...], meaning: str) -> None:
    """Require that the last axes of `array` are `shape`; `meaning` says what they stand for."""
    if array.shape[-len(shape) :] != shape or array.ndim < len(shape):
        expected = ", ".join(str(n) for n in shape)
        raise ValueError(f"{name} has shape {array.shape}: expected (..., {expected}), {meaning}")


def finite(name: str, array: NDArray, where: str = "") -> None:
    """Require that every number of `array` is finite."""
    # A sum is finite only if all its terms are, and costs a tenth of the full test.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(array.sum()):
            return
    bad = array.size - np.count_nonzero(np.isfinite(array))
    if bad:
        raise ValueError(f"{name} holds {bad} NaN or infinite values{where}: expected finite numbers")


def non_negative(name: str, array: NDArray, hint: str = "") -> None:
    """Require that no number of `array` is below 0."""
    lowest = array.min()
    if lowest < 0:
        raise ValueError(f"{name} reaches down to {lowest:.6g}: expected no negative values{hint}")
