"""Arrays of NumPy and of any other library that follows the Python array API, and the objects that own them.

Code for such arrays asks an array for its `Kind`, calls the functions of the namespace `xp`, and keeps one copy of
its constants for each kind, see `per_kind`. `Immutable` is the base of objects whose arrays are read-only.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, NamedTuple, NoReturn, TypeVar

import array_api_compat
import numpy as np
from numpy.typing import NDArray


class Kind(NamedTuple):
    """Library, precision and device of an array."""

    xp: Any
    dtype: Any
    device: Any

    @classmethod
    def of(cls, array: Any) -> Kind:
        """Kind of an array."""
        if isinstance(array, np.ndarray):
            return cls(np, array.dtype, None)
        return cls(array_api_compat.array_namespace(array), array.dtype, array_api_compat.device(array))

    @classmethod
    def numpy(cls, dtype: Any = np.float64) -> Kind:
        """Kind of the arrays of NumPy."""
        return cls(np, np.dtype(dtype), None)

    @property
    def real(self) -> Kind:
        """Kind of the real parts of complex arrays."""
        dtype = self.xp.float32 if self.dtype == self.xp.complex64 else self.xp.float64
        return Kind(self.xp, np.dtype(dtype) if self.xp is np else dtype, self.device)

    @property
    def on_host(self) -> bool:
        """Whether such arrays lie in the memory of the processor."""
        return self.device is None or "cpu" in str(self.device).lower()

    def array(self, values: Any) -> Any:
        """Real numbers as an array of this kind; no other library shares the memory of an array of NumPy."""
        if self.xp is not np and isinstance(values, np.ndarray):
            values = values.copy()
        if self.xp is not np and hasattr(values, "requires_grad"):  # asarray of PyTorch would warn of a gradient
            return values.to(dtype=self.dtype, device=self.device)
        return self.xp.asarray(values, dtype=self.dtype, device=self.device)

    def flags(self, values: NDArray[np.bool_]) -> Any:
        """Truth values for use with arrays of this kind; memory is shared with NumPy as by `array`."""
        if self.xp is not np:
            values = values.copy()
        return self.xp.asarray(values, dtype=self.xp.bool, device=self.device)

    def zeros(self, *shape: int) -> Any:
        """Zeros."""
        return self.xp.zeros(shape, dtype=self.dtype, device=self.device)

    def integers(self, values: Any) -> Any:
        """Integers for use as indices of arrays of this kind; those of NumPy have 32 bits in a browser."""
        return self.xp.asarray(values, dtype=getattr(self.xp, "intp", self.xp.int64), device=self.device)


Owner = TypeVar("Owner")
Constants = TypeVar("Constants")
_KEPT = "_kept"  # attribute that holds the results of methods decorated with `per_kind`
_OPEN = "_open"  # attribute of an object while its constructor runs


def per_kind(make: Callable[[Owner, Kind], Constants]) -> Callable[[Owner, Kind], Constants]:
    """Decorate a method of a kind of arrays: its result is computed once for each kind, then kept in the object.

    This is for constants as arrays of that kind. `Immutable` keeps them out of pickles.
    """

    @wraps(make)
    def cached(owner: Owner, kind: Kind) -> Constants:
        results = owner.__dict__.setdefault(_KEPT, {})
        try:
            return results[make, kind]
        except KeyError:
            return results.setdefault((make, kind), make(owner, kind))

    return cached


def is_array(value: Any) -> bool:
    """Whether a value is an array or a number of a library that follows the standard."""
    return bool(array_api_compat.is_array_api_obj(value))


def any_array(value: Any) -> tuple[Any, Any]:
    """Return an array and its namespace. What does not follow the standard becomes an array of NumPy."""
    if not isinstance(value, np.ndarray | np.generic) and is_array(value):
        return value, array_api_compat.array_namespace(value)
    array = np.asarray(value)  # subclasses become plain arrays
    if not array.dtype.isnative:  # as in FITS files
        array = array.astype(array.dtype.newbyteorder("="))
    return array, np


def is_jax(array: Any) -> bool:
    """Whether an array belongs to JAX, in or outside of its transformations."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(array, jax.Array)


def holds(test: Any) -> bool:
    """Whether a test of an array holds; True inside `torch.vmap`, where values cannot be tested."""
    try:
        return bool(test)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return True


def added(array: Any, values: Any, where: tuple[slice, ...]) -> Any:
    """Add values to a part of an array, whose memory is reused if its library can change it."""
    if is_jax(array):
        return array.at[(..., *where)].add(values)
    array[(..., *where)] += values
    return array


def read_only(array: Any) -> Any:
    """View of an array of NumPy that cannot be written to; anything else as it is."""
    if isinstance(array, np.ndarray):
        array = array.view()
        array.flags.writeable = False
    return array


def for_each(array: Any, k: int, xp: Any) -> Any:
    """Return an array that all frame sets share, (1, ...), as a view of shape (k, ...)."""
    return xp.broadcast_to(array, (k, *array.shape[1:]))


def is_complex(array: Any, xp: Any) -> bool:
    """Whether the numbers of an array are complex."""
    return array.dtype.kind == "c" if xp is np else xp.isdtype(array.dtype, "complex floating")


def parted(values: Any, axis: int, xp: Any) -> Any:
    """Real and imaginary parts of complex numbers, along a new axis."""
    return xp.stack([xp.real(values), xp.imag(values)], axis=axis)


def joined(parts: Any, axis: int) -> Any:
    """Complex numbers of real and imaginary parts along an axis, which is negative: undo `parted`."""
    rest = (slice(None),) * (-1 - axis)
    numbers = 1j * parts[(..., 1, *rest)]
    numbers += parts[(..., 0, *rest)]
    return numbers


def product(real: Any, maps: Any, xp: Any) -> Any:
    """Matrix product of real numbers with large complex maps."""
    if xp is not np:
        return joined(real @ parted(maps, -3, xp), -3)
    pairs = real @ np.ascontiguousarray(maps).view(maps.real.dtype)  # parts side by side, without a copy
    return pairs.view(np.result_type(pairs.dtype, np.complex64))


class Immutable:
    """Object that cannot be changed once it is made: its arrays are read-only, here and after a pickle.

    A pickle holds neither cached properties nor constants per kind of arrays. They are cheap to compute again, and
    the pickle of an object does not depend on its use.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__init__" not in vars(cls):
            return
        construct: Callable[..., None] = cls.__init__

        @wraps(construct)
        def closing(self: Immutable, *arguments: Any, **named: Any) -> None:
            if _OPEN in vars(self):  # called by the constructor of a subclass, which may set more
                return construct(self, *arguments, **named)
            vars(self)[_OPEN] = True
            try:
                construct(self, *arguments, **named)
            finally:
                del vars(self)[_OPEN]

        cls.__init__ = closing  # type: ignore[assignment, method-assign]

    def __setattr__(self, name: str, value: Any) -> None:
        if _OPEN not in vars(self):
            self._refuse(name)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        self._refuse(name)

    def _refuse(self, name: str) -> NoReturn:
        raise AttributeError(f"{name}: a {type(self).__name__} cannot be changed; make another one")

    def __getstate__(self) -> dict[str, Any]:
        kind = type(self)
        return {
            name: value
            for name, value in self.__dict__.items()
            if name != _KEPT and not isinstance(getattr(kind, name, None), cached_property)
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: read_only(value) for name, value in state.items()})
