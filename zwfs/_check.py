"""Checks of arguments: each error names the argument, its value and what was expected."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from zwfs._arrays import Kind, any_array, holds, is_array, is_jax, read_only

_STRONGEST = 1e15  # value of a mode, and of its inverse: squares summed over a pupil fit in single precision
LARGEST = 1e38  # number in a map: the square of its sum is far from the range of a float


def instance(name: str, value: Any, *kinds: type) -> None:
    """Require that `value` is of one of the classes."""
    if not isinstance(value, kinds):
        expected = " or a ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"{name} is a {type(value).__name__}: expected a {expected}")


def declared(instance: Any) -> None:
    """Require that the fields of a dataclass are of the kinds that its annotations state."""
    of: Any = type(instance)
    for name, kind in _annotations(of).items():
        value = getattr(instance, name)
        if not _is_of(value, kind):
            held = f"has dtype {value.dtype}" if isinstance(value, np.ndarray) else f"= {shown(value)}"
            raise TypeError(f"{name} {held}: expected {_readable(kind)}")


@cache
def _annotations(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _is_of(value: Any, kind: Any) -> bool:
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return True
    if origin in (Union, UnionType):
        return any(_is_of(value, part) for part in parts)
    if origin is np.ndarray:
        [number] = get_args(parts[1])
        plain = isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray)
        return plain and _same_kind(value.dtype, number)
    if origin is tuple:
        return isinstance(value, tuple) and (
            all(_is_of(item, parts[0]) for item in value)
            if parts[-1] is Ellipsis
            else len(value) == len(parts) and all(map(_is_of, value, parts))
        )
    if origin is dict:
        return isinstance(value, dict) and all(
            _is_of(item, part) for pair in value.items() for item, part in zip(pair, parts, strict=True)
        )
    if kind in (bool, int, float):
        plain = value.item() if isinstance(value, np.generic) else value
        return isinstance(plain, kind if kind is not float else int | float) and (
            kind is bool or not isinstance(plain, bool)
        )
    return isinstance(value, origin or kind)


def _same_kind(dtype: np.dtype, number: Any) -> bool:
    """Whether numbers of a type are of the kind of another: of any size."""
    kinds = np.bool_, np.integer, np.floating, np.complexfloating
    return dtype.kind != "m" and all(np.issubdtype(dtype, kind) for kind in kinds if np.issubdtype(number, kind))


def _readable(kind: Any) -> str:
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return " or ".join(_readable(part) for part in get_args(kind))
    if origin is np.ndarray:
        [number] = get_args(get_args(kind)[1])
        return f"an array of {getattr(number, '__name__', 'number')}"
    if kind is NoneType:
        return "None"
    return f"a {(origin or kind).__name__}"


def sequence(name: str, values: Any, kind: type = object, expected: str = "") -> None:
    """Require a sequence of objects of a class; a string is none."""
    listed = isinstance(values, Sequence) and not isinstance(values, str | bytes)
    if not listed or not all(isinstance(item, kind) for item in values):
        raise TypeError(f"{name} = {shown(values)}: expected {expected or f'a sequence of {kind.__name__}s'}")


def choice(name: str, value: Any, names: dict[str, Any] | list[str] | tuple[str, ...]) -> None:
    """Require that `value` is one of the names in `known`."""
    if not isinstance(value, str) or value not in names:
        raise ValueError(f"{name} = {shown(value)}: expected one of {list(names)}")


def sensor_of(name: str, reconstructor: Any) -> Any:
    """Return the sensor of a reconstructor: anything with a `sensor` that can be called on frames."""
    sensor = getattr(reconstructor, "sensor", None)
    if sensor is None or not callable(reconstructor):
        kind = type(reconstructor).__name__
        raise TypeError(f"{name} is a {kind}: expected a reconstructor, such as PhaseShifted(sensor)")
    return sensor


_INT64 = 2**63 - 1  # largest integer that an array holds
_MOST_NUMBERS = 2**30  # in a result: 8 GiB
_NO_NUMBERS = bool, np.bool_, np.timedelta64  # though Python counts them among the integers


def shown(value: Any) -> str:
    """Return the representation of `value` in one line of at most 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # Python refuses to print integers of more than 4300 digits; other objects raise anything
        return f"a {type(value).__name__} that cannot be printed"
    return text if len(text) <= 80 else f"{text[:77]}..."


def integer(name: str, value: Any, low: int, high: float = _INT64) -> int:
    """Return `value` as an int between `low` and `high`."""
    if isinstance(value, _NO_NUMBERS) or not isinstance(value, Integral):
        whole = isinstance(value, float) and value.is_integer()
        raise TypeError(f"{name} = {shown(value)}: expected an integer{f', as in {int(value)}' if whole else ''}")
    if not low <= int(value) <= high:
        one_sided = int(value) < low and high in (_INT64, math.inf)
        expected = f"at least {low}" if one_sided else f"an integer in [{low}, {high}]"
        raise ValueError(f"{name} = {shown(int(value))}: expected {expected}")
    return int(value)


def count(name: str, value: Any, size: int) -> int:
    """Return the number of maps in a result, of so many numbers each, as an int from 1 on."""
    most = max(1, _MOST_NUMBERS // size)
    number_of = integer(name, value, 1)
    if number_of > most:
        raise ValueError(f"{name} = {number_of}: expected at most {most}, which take 8 GiB")
    return number_of


def generator(name: str, seed: Any) -> np.random.Generator:
    """Return the generator of a seed: an integer of at least 0, a SeedSequence, a Generator, or None for any."""
    if seed is None or isinstance(seed, np.random.Generator | np.random.SeedSequence):
        return np.random.default_rng(seed)
    if not isinstance(seed, Integral):
        raise TypeError(f"{name} is a {type(seed).__name__}: expected an integer, a SeedSequence or a Generator")
    return np.random.default_rng(integer(name, seed, 0, math.inf))


def flag(name: str, value: Any) -> bool:
    """Return `value` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} = {shown(value)}: expected True or False")
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
    if isinstance(value, _NO_NUMBERS) or not isinstance(value, Real):
        raise TypeError(f"{name} = {shown(value)}: expected a real number")
    try:
        plain = float(value)
    except OverflowError:  # an integer or a fraction beyond the range of a float
        plain = math.inf
    too_low = plain <= low if open_low else plain < low
    too_high = plain >= high if open_high else plain > high
    if not math.isfinite(plain) or too_low or too_high:
        opening, closing = "(" if open_low else "[", ")" if open_high else "]"
        raise ValueError(
            f"{name} = {shown(value)}: expected a finite number in {opening}{low:g}, {high:g}{closing}"
        )
    return plain


def number_or_inf(name: str, value: Any, *, open_low: bool = False) -> float:
    """Return a number of at least 0, or infinity."""
    is_inf = isinstance(value, float) and value == math.inf
    return value if is_inf else number(name, value, 0, LARGEST, open_low=open_low)


def wavelength(value: Any) -> float:
    """Return a wavelength, of gamma rays to radio waves in any unit from nm to m."""
    return number("wavelength", value, 1e-12, 1e12)


def callback(name: str, value: Any) -> Callable[..., Any]:
    """Return a function that reports progress; None is one that does nothing."""
    if value is not None and not callable(value):
        raise TypeError(f"{name} = {shown(value)}: expected a function, or None")
    return value or (lambda *_: None)


def number_field(owner: Any, name: str, low: float = -math.inf, high: float = math.inf, **ends: bool) -> None:
    """Check a number among the fields of a frozen dataclass, see `number`, and keep it as a float."""
    object.__setattr__(owner, name, number(name, getattr(owner, name), low, high, **ends))


def integer_field(owner: Any, name: str, low: int, high: float = _INT64) -> None:
    """Check an integer among the fields of a frozen dataclass, see `integer`, and keep it as an int."""
    object.__setattr__(owner, name, integer(name, getattr(owner, name), low, high))


def plain_array(name: str, value: Any) -> NDArray:
    """Return `value` as an array of NumPy of any dtype."""
    return _converted(name, value, np.asarray)


def real_frame(name: str, value: Any, shape: tuple[int, ...]) -> NDArray:
    """Return `value` as an array of real numbers of any type of NumPy, for a call that may not take long."""
    array = value if isinstance(value, np.ndarray) else plain_array(name, value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} has dtype {array.dtype}: expected real numbers")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: expected {shape}")
    return array


def destination(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an array for results in single precision: `value`, or a new one for None."""
    if value is None:
        return np.empty(shape, np.float32)
    if not isinstance(value, np.ndarray) or value.dtype != np.float32 or not value.flags.c_contiguous:
        raise TypeError(f"{name} is {shown(value)}: expected an array of float32")
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}: expected {shape}")
    return value


def real_array(name: str, value: Any) -> NDArray:
    """Return `value` as a float32 or float64 array of NumPy; other real numbers become float64."""
    return real_any(name, plain_array(name, value))


def integer_array(name: str, value: Any) -> NDArray[np.integer]:
    """Return `value` as an array of integers of NumPy."""
    array = plain_array(name, value)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} has dtype {array.dtype}: expected integers")
    return array


def real_any(name: str, value: Any) -> NDArray:
    """Return `value` as a float32 or float64 array; those of a library of the array API stay there."""
    array, xp = _of_any_library(name, value)
    if array.dtype in (xp.float32, xp.float64):
        return array
    if xp.isdtype(array.dtype, "complex floating"):
        raise TypeError(f"{name} is complex ({array.dtype}): expected real numbers")
    if not xp.isdtype(array.dtype, ("real floating", "integral")):
        raise TypeError(f"{name} has dtype {array.dtype}: expected real numbers")
    return xp.astype(array, xp.float64)


def array_of(name: str, value: Any, kind: str, shape: tuple[int | str, ...] | None = None) -> None:
    """Require an array of any library, of a kind of numbers as the array API names it, and of a shape.

    A name in the shape, such as "n_modes", stands for any length.
    """
    if isinstance(value, np.generic) or not is_array(value):
        raise TypeError(f"{name} is a {type(value).__name__}: expected an array")
    array, xp = _of_any_library(name, value)
    if not xp.isdtype(array.dtype, kind):
        raise TypeError(f"{name} has dtype {array.dtype}: expected {kind}")
    if shape is not None:
        expected_shape = [
            length if isinstance(n, str) else n for n, length in zip(shape, array.shape, strict=False)
        ]
        if len(shape) != array.ndim or expected_shape != list(array.shape):
            expected = str(shape).replace("'", "")
            raise ValueError(f"{name} has shape {tuple(array.shape)}: expected {expected}")


def complex_array(name: str, value: Any) -> NDArray:
    """Return `value` as a complex64 or complex128 array of NumPy."""
    return complex_any(name, plain_array(name, value))


def complex_any(name: str, value: Any) -> NDArray:
    """Return `value` as a complex64 or complex128 array; those of a library of the array API stay there."""
    array, xp = _of_any_library(name, value)
    if array.dtype in (xp.complex64, xp.complex128):
        return array
    if xp.isdtype(array.dtype, "complex floating"):
        return xp.astype(array, xp.complex128)
    array = real_any(name, array)
    return xp.astype(array, xp.result_type(array.dtype, xp.complex64))


def in_kind(name: str, array: Any, kind: Kind) -> NDArray:
    """Return real numbers as an array of the kind that goes with it."""
    return _converted(name, array, kind.array)


def pair(name: str, value: Any, check: Callable[..., Any], *limits: float) -> tuple[Any, Any]:
    """Return a sequence of two numbers, each of which passes a check such as `number`."""
    if not isinstance(value, Sequence | np.ndarray) or getattr(value, "ndim", 1) == 0 or len(value) != 2:
        raise ValueError(f"{name} = {shown(value)}: expected two numbers")
    return tuple(check(f"{name}[{index}]", item, *limits) for index, item in enumerate(value))


def real_map(name: str, value: Any, n_axes: int = 2) -> NDArray:
    """Return `value` as float64 with so many axes, none of them empty, and numbers of at most `LARGEST`."""
    array = real_array(name, value).astype(np.float64, copy=False)
    if array.ndim != n_axes or not array.size:
        expected = "a list of at least one number" if n_axes == 1 else f"{n_axes} axes, none of them empty"
        raise ValueError(f"{name} has shape {array.shape}: expected {expected}")
    finite(name, array)
    if np.abs(array).max() > LARGEST:
        raise ValueError(f"{name} reaches {np.abs(array).max():.3g}: expected at most {LARGEST:g}")
    return array


def flag_map(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return `value` as an array of bool of a shape."""
    array = _converted(name, value, np.asarray)
    if array.dtype != bool:
        raise TypeError(f"{name} has dtype {array.dtype}: expected bool")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: expected {shape}")
    return array


def no_gradient(name: str, value: Any) -> None:
    """Refuse an array through which a gradient is to pass."""
    if is_jax(value):
        raise TypeError(
            f"{name} is an array of JAX: expected np.asarray({name}), outside of jax.jit, jax.grad and jax.vmap, "
            "because a reconstructor has no gradient"
        )
    if getattr(value, "requires_grad", False):
        raise TypeError(
            f"{name} requires a gradient: expected {name}.detach(), because a reconstructor has no gradient"
        )


def _of_any_library(name: str, value: Any) -> tuple[Any, Any]:
    """Return an array and its namespace; those of JAX, which cannot be changed in place, are refused."""
    if is_jax(value):
        raise TypeError(
            f"{name} is an array of JAX: expected np.asarray({name}); only `measure` of a sensor takes arrays of "
            "JAX, with gradients"
        )
    array, xp = _converted(name, value, any_array)
    if xp is np and array.dtype.kind == "V":  # which xp.isdtype does not know
        raise TypeError(
            f"{name} is a table, of dtype {shown(array.dtype)}: expected numbers, as one of its columns"
        )
    return array, xp


def _converted(name: str, value: Any, make: Callable[[Any], Any]) -> Any:
    """Make an array of `value`, which must hold nothing that it would lose: masked values, or a unit."""
    if np.ma.is_masked(value):
        raise ValueError(
            f"{name} is a masked array, {np.ma.count_masked(value)} values of which are masked: expected plain "
            "numbers; fill them first"
        )
    if getattr(value, "unit", None) is not None:
        raise TypeError(
            f"{name} carries the unit {value.unit}: expected plain numbers in the unit that is documented"
        )
    try:
        return make(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        reason = str(error).partition("\n")[0]
        raise TypeError(
            f"{name} is a {type(value).__name__} that cannot become an array here ({reason})"
        ) from error


def trailing_shape(name: str, array: Any, shape: tuple[int, ...], meaning: str) -> None:
    """Require that the last axes of `array` are `shape`; `meaning` says what they stand for."""
    if tuple(array.shape[-len(shape) :]) != shape or array.ndim < len(shape):
        expected = ", ".join(str(n) for n in shape)
        raise ValueError(f"{name} has shape {tuple(array.shape)}: expected (..., {expected}), {meaning}")


def maps(name: str, array: Any, shape: tuple[int, int], meaning: str = "the shape of the pupil") -> None:
    """Require at least one map of a shape."""
    trailing_shape(name, array, shape, meaning)
    if 0 in array.shape:
        raise ValueError(f"{name} has shape {tuple(array.shape)}: expected at least one map")


def broadcast(**arrays: Any) -> tuple[int, ...]:
    """Return the shape to which all arrays broadcast."""
    shapes = [np.shape(array) for array in arrays.values()]
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        *first, last = arrays
        names, listed = f"{', '.join(first)} and {last}", " and ".join(map(str, shapes))
        raise ValueError(f"{names} have shapes {listed}: expected ones that broadcast") from None


def values_inside(name: str, array: Any, pupil: Any) -> NDArray:
    """Return the values of real maps inside a pupil, (..., ny, nx) to (..., n_points), finite and at least one."""
    array = real_array(name, array)
    maps(name, array, pupil.shape)
    values = pupil.gather(array)
    moderate(name, values, " inside the pupil")
    return values


def modes(name: str, value: Any, pupil: Any, *, distinct: bool = False) -> NDArray[np.float64]:
    """Return modes, (n_modes, ny, nx), at the points of a pupil: (n_modes, n_points), read-only.

    If they are to be `distinct`, no mode may be a combination of others.
    """
    array = real_array(name, value)
    if array.ndim != 3 or not len(array):
        raise ValueError(f"{name} has shape {array.shape}: expected (n_modes, ny, nx)")
    values = values_inside(name, array, pupil).astype(np.float64)
    if len(values) > values.shape[1]:
        raise ValueError(
            f"{name}: {len(values)} of them, expected at most the {values.shape[1]} points of the pupil"
        )
    largest = np.abs(values).max()
    if not 1 / _STRONGEST <= largest <= _STRONGEST:
        raise ValueError(
            f"{name} reaches {largest:.3g} in the pupil: expected between {1 / _STRONGEST:g} and {_STRONGEST:g}"
        )
    if distinct:
        independent(name, values)
    return read_only(values)


def independent(name: str, values: NDArray, where: str = "") -> None:
    """Require that no mode, (n_modes, n_points), is a combination of others."""
    unit = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-300)
    strength = np.linalg.eigvalsh(unit @ unit.T)
    rank = int(np.count_nonzero(strength > 1e-14 * strength[-1]))
    if rank < len(values):
        raise ValueError(f"{name}: {rank} of {len(values)} are linearly independent{where}: expected all of them")


def map_inside(name: str, array: Any, pupil: Any) -> NDArray:
    """Return one real map, (ny, nx), that is finite inside a pupil."""
    array = real_array(name, array)
    if array.shape != pupil.shape:
        raise ValueError(f"{name} has shape {array.shape}: expected {pupil.shape}")
    finite(name, pupil.gather(array), " inside the pupil")
    return array


def finite(name: str, array: Any, where: str = "") -> None:
    """Require that every number of `array` is finite."""
    xp = any_array(array)[1]
    # A sum is finite only if all its terms are, and costs a tenth of the full test.
    with np.errstate(over="ignore", invalid="ignore"):
        if holds(xp.isfinite(xp.sum(array))):
            return
    bad = math.prod(array.shape) - int(xp.count_nonzero(xp.isfinite(array)))
    if bad:
        raise ValueError(f"{name} holds {bad} NaN or infinite values{where}: expected finite numbers")


def non_negative(name: str, array: Any) -> None:
    """Require that no number of `array` is below 0."""
    lowest = any_array(array)[1].min(array) if 0 not in array.shape else np.zeros(())
    if not holds(~(lowest < 0)):
        raise ValueError(f"{name} reaches down to {float(lowest):.6g}: expected no negative values")


def radian(name: str, value: Any) -> float:
    """Return an angle as a float; more than a full turn is nearly surely in degrees."""
    angle = number(name, value)
    if abs(angle) > 6.3:  # 2 pi, rounded up
        raise ValueError(f"{name} = {shown(value)}: expected radian, from -2 pi to 2 pi; is it in degrees?")
    return angle


def items(name: str, values: Any, expected: str) -> Iterable[Any]:
    """Return `values`, which must be a list or something else to iterate over, but no string."""
    if isinstance(values, str | bytes) or not isinstance(values, Iterable) or getattr(values, "ndim", 1) == 0:
        raise TypeError(f"{name} = {shown(values)}: expected {expected}")
    return values


def breaks(name: str, values: Any, diameter: float) -> tuple[Any, ...]:
    """Return the checked breaks of a mask, circles in order; outlines are checked where they are used."""
    listed = list(items(name, values, "diameters, such as (1.0,), or functions of the angle"))
    circles = sorted(
        number(f"{name}[{index}]", value, 0, diameter, open_low=True, open_high=True)
        for index, value in enumerate(listed)
        if not callable(value)
    )
    return (*circles, *filter(callable, listed))


def any_numbers(name: str, value: Any) -> NDArray:
    """Return `value` as an array of NumPy of bools, integers, real or complex numbers; the dtype is kept."""
    array = _converted(name, value, np.asarray)
    if array.dtype.kind not in "biufc":
        raise TypeError(f"{name} has dtype {array.dtype}: expected numbers")
    return array


def moderate(name: str, array: Any, where: str = "") -> None:
    """Require numbers that are finite, and whose squares, which are intensities, add up to something finite."""
    xp = any_array(array)[1]
    flat = xp.reshape(array, (-1,))
    with np.errstate(over="ignore", invalid="ignore"):
        if holds(xp.isfinite(flat @ flat)):
            return
    finite(name, array, where)
    largest = float(xp.max(xp.abs(array)))
    raise ValueError(f"{name} reaches a modulus of {largest:.3g}{where}: expected values whose squares are finite")
