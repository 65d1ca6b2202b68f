"""Images of many exposures on disk: FITS and NPY files are read in pieces, and need not fit the memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._blocks import Block, FileError, blocks_of


class Stack:
    """Exposures of all files, one after the other, each of n_images (1 or 2) of a shape.

    A segment is a block with exposures, or two blocks that hold one image of each exposure. There are as many
    second files, with the second image of each exposure, as files, or none. Raises FileNotFoundError, or FileError
    if a file is of another kind, broken, truncated, or holds other images.
    """

    def __init__(
        self, files: Sequence[Path], second_files: Sequence[Path], n_images: int, shape: tuple[int, int]
    ) -> None:
        if second_files and (n_images == 1 or len(second_files) != len(files)):
            expected = "none, since an exposure of the calibration has one image" if n_images == 1 else len(files)
            raise ValueError(f"second_files holds {len(second_files)} files: expected {expected}")
        self.segments: list[tuple[Block, ...]] = []
        for index, path in enumerate(files):
            units = _units(path, shape)
            seconds = _units(second_files[index], shape) if second_files else []
            self.segments += _exposures(units, seconds, n_images)
        self.firsts = [segment[0] for segment in self.segments]
        first = self.firsts[0]
        for block in chain(*self.segments):
            if block.numbers != first.numbers:
                raise FileError(
                    f"{block.name}: its type, BSCALE, BZERO and BLANK are {block.numbers}: expected "
                    f"{first.numbers}, those of {first.name}"
                )
        self.header, self.bytes_per_exposure = first.header, sum(block.row for block in self.segments[0])
        lengths = np.array([block.n for block in self.firsts])
        self.ends = np.cumsum(lengths)
        self.starts, self.n = self.ends - lengths, int(self.ends[-1])

    @property
    def saturation(self) -> float:
        """Level at which pixels are saturated, as the first file states it or as its type allows."""
        known, first = "SATURATE" in self.header, self.firsts[0]
        level = self.header["SATURATE"] if known else first.full_scale
        name = f"{first.name}: {'SATURATE' if known else 'largest number of its type'}"
        return level if level == np.inf else _check.number(name, level, 0, open_low=True)

    def places(self, first: int, stop: int) -> list[list[int]]:
        """Segments that hold some exposures, each with its first exposure and the one after its last."""
        last = np.searchsorted(self.ends, stop - 1, "right")
        some = np.arange(np.searchsorted(self.ends, first, "right"), last + 1)
        low, high = np.maximum(first, self.starts[some]), np.minimum(stop, self.ends[some])
        return np.transpose([some, low - self.starts[some], high - self.starts[some]]).tolist()

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, shape (stop - first, n_images, ny, nx)."""
        parts = []
        for index, start, end in self.places(first, stop):
            images = [block.read(start, end) for block in self.segments[index]]
            parts.append(images[0] if len(images) == 1 else np.concatenate(images, axis=1))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def state(self) -> list[tuple[str, int, int, int]]:
        """Path, exposures, size and time of change of all files: it differs once a file has changed."""
        found = [(block, os.stat(block.path)) for block in chain(*self.segments)]
        return [(str(block.path), block.n, stat.st_size, stat.st_mtime_ns) for block, stat in found]


def _exposures(units: list[Block], seconds: list[Block], n_images: int) -> list[tuple[Block, ...]]:
    """Blocks of each segment, from the image units of a file and of its second file."""
    if n_images == 1:
        return [(replace(unit, per=1),) for unit in units]
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
        return [(replace(unit, per=2),) for unit in units]
    for one, other in pairs:
        if (one.n * one.per, 1) != (other.n, other.per):
            counts = f"{other.n * other.per} second images for {one.n * one.per} first ones"
            raise FileError(f"{other.name}: {counts} in {one.name}: expected as many")
    return [(one, other) for one, other in pairs]


def _units(path: Path, shape: tuple[int, int]) -> list[Block]:
    """Image units of a file, which must be of a shape."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    units = []
    for block in blocks_of(path):
        n_axes, per = len(block.full), block.full[1] if len(block.full) == 4 else 1
        if n_axes not in (2, 3, 4) or min(block.full) < 1 or block.shape != shape or per not in (1, 2):
            raise FileError(
                f"{block.name}: its shape is {block.full}: expected images of {shape}, as in the calibration"
            )
        if block.columns_first:
            raise FileError(
                f"{block.name}: its columns come first in the file: expected rows first, as np.save"
                "(name, np.ascontiguousarray(images)) writes them"
            )
        units.append(replace(block, per=per))
    return units
