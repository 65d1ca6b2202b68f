"""Images of many exposures on disk: FITS and NPY files are read in pieces, and need not fit the memory."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.frames._blocks import Block, FileError, blocks_of


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
        return sum(block.row for block in self.segments[0].blocks)

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


def _units(path: Path, shape: tuple[int, int]) -> tuple[list[Block], dict[str, Any]]:
    """Image units of a file, which must be of a shape, and the values of its header."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    blocks, header = blocks_of(path)
    units = []
    for block in blocks:
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
    return units, header
