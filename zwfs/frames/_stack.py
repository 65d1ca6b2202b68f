"""Images of many exposures on disk: FITS and NPY files are read in pieces, and need not fit the memory."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._fits import SCALING, TYPES, fits_module, full_scale, header_cards, open_fits
from zwfs.frames.files import _GZIP, _NPY, FileError, _broken, _content, _npy_header

_MOST_UNPACKED = 2**29  # bytes of a gzip file, which is unpacked in memory

# Label, shape, type of the numbers, offset and scaling.
_Image = tuple[str, tuple[int, ...], np.dtype, int, dict[str, Any]]


@dataclass(frozen=True)
class Block:
    """Numbers of one file that lie side by side: `n` exposures of `per` images each.

    A value v of the file stands for v * scale + zero, and the value `blank` for no number.
    """

    path: Path
    name: str
    offset: int
    dtype: np.dtype
    n: int
    per: int
    shape: tuple[int, int]
    packed: bool
    scale: float = 1.0
    zero: float = 0.0
    blank: int | None = None

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, shape (stop - first, per, ny, nx)."""
        count = self.per * prod(self.shape)
        with _broken(f"{self.name}: it cannot be read"), self.path.open("rb") as file:
            stream: BinaryIO = _content(file, self.name, _MOST_UNPACKED) if self.packed else file
            stream.seek(self.offset + first * count * self.dtype.itemsize)
            data = np.frombuffer(stream.read((stop - first) * count * self.dtype.itemsize), np.uint8)
        n_whole = data.size // (count * self.dtype.itemsize)
        if n_whole < stop - first:
            raise FileError(f"{self.name}: truncated: it ends in exposure {first + n_whole} (counted from 0)")
        data = data.view(self.dtype).reshape(-1, self.per, *self.shape)
        if (self.scale, self.zero, self.blank) == (1, 0, None):
            return data
        wide: Any = np.float32 if self.dtype.itemsize <= 2 else np.float64
        numbers = data.astype(wide) * self.scale + self.zero
        return numbers if self.blank is None else np.where(data == self.blank, np.nan, numbers)

    @property
    def numbers(self) -> tuple[str, float, float, int | None]:
        """Type of the numbers, and their meaning."""
        return self.dtype.str, self.scale, self.zero, self.blank

    @property
    def full_scale(self) -> float:
        """Largest value that the type of the numbers can hold; infinity for floats."""
        return full_scale(self.dtype, self.scale, self.zero)


@dataclass(frozen=True)
class Segment:
    """Exposures of a file, or of two files or extensions that hold one image of each exposure."""

    blocks: tuple[Block, ...]
    header: dict[str, Any] = field(repr=False)

    @property
    def name(self) -> str:
        """Of the first file."""
        return self.blocks[0].name

    @property
    def n(self) -> int:
        """Number of exposures."""
        return self.blocks[0].n

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, (stop - first, n_images, ny, nx)."""
        parts = [block.read(first, stop) for block in self.blocks]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


class Stack:
    """Exposures of all files, one after the other.

    Parameters
    ----------
    files : sequence of Path
        Each with the images of one exposure or more.
    second_files : sequence of Path
        As many, with the second image of each exposure, or none.
    n_images : int
        Images of an exposure, 1 or 2.
    shape : (int, int)
        Of an image.

    Raises
    ------
    FileNotFoundError
    FileError
        If a file is of another kind, broken, truncated, or holds images of another shape or number.
    """

    def __init__(
        self, files: Sequence[Path], second_files: Sequence[Path], n_images: int, shape: tuple[int, int]
    ) -> None:
        if second_files and (n_images == 1 or len(second_files) != len(files)):
            expected = "none, since an exposure of the calibration has one image" if n_images == 1 else len(files)
            raise ValueError(f"second_files holds {len(second_files)} files: expected {expected}")
        self.segments: list[Segment] = []
        for index, path in enumerate(files):
            units, header = _units(path, shape)
            seconds = _units(second_files[index], shape)[0] if second_files else []
            pairs = _exposures(units, seconds, n_images)
            self.segments += [Segment(blocks, header) for blocks in pairs]
        first = self.segments[0].blocks[0]
        for segment in self.segments:
            for block in segment.blocks:
                if block.numbers != first.numbers:
                    raise FileError(
                        f"{block.name}: its type, BSCALE, BZERO and BLANK are {block.numbers}: expected "
                        f"{first.numbers}, those of {first.name}"
                    )
        self._ends = list(accumulate(segment.n for segment in self.segments))

    @property
    def n(self) -> int:
        """Number of exposures."""
        return self._ends[-1]

    @property
    def header(self) -> dict[str, Any]:
        """Values of the header of the first file."""
        return self.segments[0].header

    @property
    def bytes_per_exposure(self) -> int:
        """Size of the images of an exposure."""
        return sum(block.per * prod(block.shape) * block.dtype.itemsize for block in self.segments[0].blocks)

    def places(self, first: int, stop: int) -> list[tuple[int, int, int]]:
        """Segments that hold some exposures, each with its first and its last but one exposure."""
        found, index = [], bisect_right(self._ends, first)
        while first < stop:
            start = self._ends[index] - self.segments[index].n
            end = min(stop, self._ends[index])
            found.append((index, first - start, end - start))
            first, index = end, index + 1
        return found

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, shape (stop - first, n_images, ny, nx)."""
        parts = [self.segments[index].read(start, end) for index, start, end in self.places(first, stop)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def state(self) -> list[tuple[str, int, int, int]]:
        """Path, exposures, size and time of change of all files: it differs once a file has changed."""
        blocks = [block for segment in self.segments for block in segment.blocks]
        stats = [os.stat(block.path) for block in blocks]
        return [
            (str(block.path), block.n, stat.st_size, stat.st_mtime_ns)
            for block, stat in zip(blocks, stats, strict=True)
        ]


def _exposures(units: list[Block], seconds: list[Block], n_images: int) -> list[tuple[Block, ...]]:
    """Blocks of each segment, from the image units of a file and of its second file."""
    if n_images == 1:
        return [(_of(unit, unit.n * unit.per, 1),) for unit in units]
    if seconds:
        pairs = list(zip(units, seconds, strict=False))
        if len(units) != len(seconds):
            raise FileError(f"{seconds[0].name}: {len(seconds)} images: expected {len(units)}, as {units[0].name}")
    elif len(units) == 2 and not any(unit.per == 2 or unit.n == 2 for unit in units):
        pairs = [(units[0], units[1])]  # an extension for each image
    else:
        for unit in units:
            if unit.per == 1 and unit.n != 2:
                raise FileError(
                    f"{unit.name}: shape {(unit.n, *unit.shape)}: expected {(unit.n, 2, *unit.shape)}, since an "
                    "exposure of the calibration has two images, or the second ones in an extension or a file"
                )
        return [(_of(unit, unit.n * unit.per // 2, 2),) for unit in units]
    for one, other in pairs:
        if (one.n * one.per, 1) != (other.n, other.per):
            counts = f"{other.n * other.per} second images for {one.n * one.per} first ones"
            raise FileError(f"{other.name}: {counts} in {one.name}: expected as many")
    return [(one, other) for one, other in pairs]


def _of(unit: Block, n: int, per: int) -> Block:
    return Block(**(vars(unit) | {"n": n, "per": per}))


def _units(path: Path, shape: tuple[int, int]) -> tuple[list[Block], dict[str, Any]]:
    """Image units of a file, which must be of a shape, and the values of its header."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    name, size = path.name, path.stat().st_size
    if not size:
        raise FileError(f"{name}: the file is empty: expected images")
    with path.open("rb") as file:
        packed = file.read(len(_GZIP)) == _GZIP
        file.seek(0)
        stream: BinaryIO = _content(file, name, _MOST_UNPACKED) if packed else file
        first = stream.read(len(_NPY))
        size = stream.seek(0, os.SEEK_END)
        stream.seek(0)
        header: dict[str, Any] = {}
        if first == _NPY:
            with _broken(f"{name}: a broken NPY file"):
                full, columns_first, dtype = _npy_header(stream)
            if columns_first and len(full) > 1:
                raise FileError(
                    f"{name}: its columns come first in the file: expected rows first, as np.save"
                    "(name, np.ascontiguousarray(images)) writes them"
                )
            found: list[_Image] = [(name, full, dtype, stream.tell(), {})]
        elif first.startswith(b"SIMPLE"):
            found, header = _fits_units(stream, name)
        else:
            raise FileError(f"{name}: its first bytes are those of neither a FITS nor an NPY file")
    blocks = []
    for label, full, dtype, offset, numbers in found:
        if dtype.kind not in "biuf":
            raise FileError(f"{label}: its numbers are {dtype}: expected real ones")
        if (
            len(full) not in (2, 3, 4)
            or min(full) < 1
            or full[-2:] != shape
            or (len(full) == 4 and full[1] not in (1, 2))
        ):
            raise FileError(f"{label}: its shape is {full}: expected images of {shape}, as in the calibration")
        n, per = (*full[:-2], 1, 1)[:2] if len(full) > 2 else (1, 1)
        whole = (size - offset) // (per * prod(shape) * dtype.itemsize)
        if whole < n:
            raise FileError(f"{label}: truncated: it ends in exposure {max(whole, 0)} of {n} (counted from 0)")
        blocks.append(Block(path.resolve(), label, offset, dtype, n, per, shape, packed, **numbers))
    return blocks, header


def _fits_units(stream: BinaryIO, name: str) -> tuple[list[_Image], dict[str, Any]]:
    """Images of a FITS file, and its header."""
    fits = fits_module()
    found: list[_Image] = []
    header: dict[str, Any] = {}
    with _broken(f"{name}: a broken FITS file"), open_fits(stream, lazy_load_hdus=False) as units:
        for index, unit in enumerate(units):
            if isinstance(unit, fits.CompImageHDU):
                raise FileError(f"{name}: extension {index} is compressed: expected plain images; use funpack")
            if not unit.is_image or not unit.shape:
                continue
            cards = header_cards(unit.header)
            scale, zero, blank = (cards.get(key, plain) for key, plain in SCALING.items())
            numbers = {
                "scale": _check.number("BSCALE", scale),
                "zero": _check.number("BZERO", zero),
                "blank": None,
            }
            if blank is not None and cards["BITPIX"] > 0:
                numbers["blank"] = _check.integer("BLANK", blank, -(2**63))
            label = f"{name}[{index}]" if len(units) > 1 else name
            header = header or header_cards(units[0].header) | cards
            offset = unit.fileinfo()["datLoc"]
            found.append((label, tuple(unit.shape), TYPES[cards["BITPIX"]], offset, numbers))
    if not found:
        raise FileError(f"{name}: a FITS file without an image")
    return found, header
