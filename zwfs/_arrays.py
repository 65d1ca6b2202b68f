"""Arrays of NumPy, and of any other library that follows the Python array API standard.

Code for such arrays asks an array for its `Kind`, calls the functions of the namespace `xp`, and keeps one copy of
its constants for each kind, see `per_kind`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar

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
        """Integers for use with arrays of this kind."""
        return self.xp.asarray(values, dtype=self.xp.int64, device=self.device)


Owner = TypeVar("Owner")
Constants = TypeVar("Constants")
KEPT = "_kept"  # attribute that holds the results of methods decorated with `per_kind`


def per_kind(make: Callable[[Owner, Kind], Constants]) -> Callable[[Owner, Kind], Constants]:
    """Decorate a method of a kind of arrays: its result is computed once for each kind, then kept in the object.

    This is for constants as arrays of that kind. `zwfs._pickle.Immutable` keeps them out of pickles.
    """

    @wraps(make)
    def kept(owner: Owner, kind: Kind) -> Constants:
        results = owner.__dict__.setdefault(KEPT, {})
        try:
            return results[make, kind]
        except KeyError:
            return results.setdefault((make, kind), make(owner, kind))

    return kept


def any_array(value: Any) -> tuple[Any, Any]:
    """Return an array and its namespace. What does not follow the standard becomes an array of NumPy."""
    if not isinstance(value, np.ndarray | np.generic) and array_api_compat.is_array_api_obj(value):
        return value, array_api_compat.array_namespace(value)
    array = np.asarray(value)  # subclasses become plain arrays
    if not array.dtype.isnative:  # as in FITS files
        array = array.astype(array.dtype.newbyteorder("="))
    return array, np


def read_only(array: Any) -> Any:
    """View of an array of NumPy that cannot be written to; anything else as it is."""
    if isinstance(array, np.ndarray):
        array = array.view()
        array.flags.writeable = False
    return array


def for_each(array: Any, k: int, xp: Any) -> Any:
    """Return an array that all frame sets share, (1, ...), as a view of shape (k, ...)."""
    return xp.broadcast_to(array, (k, *array.shape[1:]))


def product(real: Any, maps: Any, xp: Any) -> Any:
    """Matrix product of real numbers with large maps, real or complex."""
    if xp is np and real.dtype != maps.dtype:  # parts side by side: half the time of a product of complex numbers
        return (real @ maps.view(real.dtype)).view(maps.dtype)
    return real @ maps
