"""What all results can do: save themselves, draw themselves, and say in one line what they are."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from zwfs import _check
from zwfs._system import path_of, write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_KINDS = (".fits", ".npz")
_PLAIN = bool | int | float | str
_SIDE = 3.6  # inches, of a panel


class Result:
    """Base of results: dataclasses whose fields are arrays and plain values.

    A subclass names in `panels` what `plot` draws, in this order: fields that are maps, or methods that draw on
    axes.
    """

    panels: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Name of a field and its label with the unit."""

    def __post_init__(self) -> None:
        _check.declared(self)

    def __repr__(self) -> str:
        parts = (f"{name}{value.shape}" for name, value in self._arrays() if value.ndim)
        return f"{type(self).__name__}({', '.join(parts)})"

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write all arrays and plain values as FITS or NPZ, in one step.

        A FITS file holds an image for each array, with its name, and the plain values as cards of the first
        header. An NPZ file holds the arrays by name, and one more, `values`: the plain values as JSON text. What
        is None is left out.

        Parameters
        ----------
        path : str or Path
            Its ending, .fits or .npz, decides the format.
        overwrite : bool
            Whether the file may exist.

        Raises
        ------
        FileExistsError, ImportError, TypeError, ValueError
            If the file exists, astropy is needed and missing, or the path has another ending.
        """
        path = path_of("path", path)
        if path.suffix not in _KINDS:
            raise ValueError(f"path = {str(path)!r}: expected a name that ends with {' or '.join(_KINDS)}")
        if path.exists() and not _check.flag("overwrite", overwrite):
            raise FileExistsError(f"path = {str(path)!r} exists: expected a new name, or overwrite=True")
        arrays, values = dict(self._arrays()), dict(self._values())
        write_file(path, _fits(arrays, values) if path.suffix == ".fits" else npz_bytes(arrays, values))

    def plot(self) -> Figure:
        """Draw the result.

        Returns
        -------
        matplotlib.figure.Figure
            Of a batch, the first item.
        """
        from matplotlib.figure import Figure

        fields_of = ((getattr(self, name, None), label) for name, label in self.panels)
        panels = [(values, label) for values, label in fields_of if values is not None]
        figure = Figure((_SIDE * 1.35 * len(panels), _SIDE))
        figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.05)
        for axes, (values, label) in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
            _draw(axes, np.asarray(values), label)
        return figure

    def _arrays(self) -> Iterator[tuple[str, NDArray]]:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if hasattr(value, "shape") and hasattr(value, "dtype"):
                yield field.name, np.asarray(value)

    def _values(self) -> Iterator[tuple[str, bool | int | float | str]]:
        for field in fields(self):  # type: ignore[arg-type]
            yield from _plain(field.name, getattr(self, field.name))


class PhaseResult(Result, NDArrayOperatorsMixin):
    """Base of results that are a phase: in arithmetic and for NumPy they are the array `phase`."""

    phase: NDArray[Any]
    panels = (("phase", "phase (rad)"), ("sigma", "standard error (rad)"))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        return np.array(self.phase, dtype=dtype, copy=True if copy is None else copy)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **settings: Any) -> Any:
        arrays = [value.phase if isinstance(value, PhaseResult) else value for value in inputs]
        return getattr(ufunc, method)(*arrays, **settings)

    def __getitem__(self, index: Any) -> Any:
        return self.phase[index]


def _plain(name: str, value: Any) -> Iterator[tuple[str, bool | int | float | str]]:
    """Numbers, flags and texts in a field, by their names. Arrays and other objects are skipped."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, _PLAIN):
        yield name, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _plain(f"{name} {key}", item)
    elif is_dataclass(value) or hasattr(value, "_fields"):
        keys = value._fields if hasattr(value, "_fields") else [field.name for field in fields(value)]
        for key in keys:
            yield from _plain(f"{name} {key}", getattr(value, key))
    elif isinstance(value, Sequence):
        for index, item in enumerate(value):
            yield from _plain(f"{name} {index}", item)


def npz_bytes(arrays: dict[str, NDArray], values: dict[str, Any]) -> bytes:
    """Content of an NPZ file of arrays by name, and of plain values as JSON text under `values`."""
    stream = io.BytesIO()
    np.savez_compressed(stream, values=np.array(json.dumps(values)), **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _fits(arrays: dict[str, NDArray], values: dict[str, Any]) -> bytes:
    from zwfs.frames._fits import fits_content

    names = iter(arrays)
    first = next(names)
    cards = [
        ("EXTNAME", first.upper(), ""),
        *((f"HIERARCH {name.upper()}", value, "") for name, value in values.items()),
    ]
    others = [(_image(arrays[name]), name.upper(), ()) for name in names]
    return fits_content((_image(arrays[first]), "", cards), *others)


def _image(array: NDArray) -> NDArray:
    """Array of a type that FITS knows."""
    return array.astype(np.uint8) if array.dtype == bool else array


def _draw(axes: Axes, values: NDArray, label: str) -> None:
    """Draw a curve, or the first map of a batch."""
    if values.ndim < 2:
        axes.plot(np.arange(1, values.size + 1), np.atleast_2d(values.T).T, "o")
        axes.set(xlabel="number", ylabel=label)
        axes.locator_params("x", integer=True)
        return
    image = values.reshape(-1, *values.shape[-2:])[0]
    largest = float(np.nanmax(np.abs(image), initial=0)) or 1.0
    signed = bool(np.nanmin(image, initial=0) < 0)
    limits: dict[str, Any] = {
        "vmin": -largest if signed else 0,
        "vmax": largest,
        "cmap": "RdBu_r" if signed else "cividis",
    }
    drawn = axes.imshow(image, origin="lower", interpolation="nearest", **limits)
    axes.set(xlabel="column (pixel)", ylabel="row (pixel)")
    axes.figure.colorbar(drawn, ax=axes, label=label)
