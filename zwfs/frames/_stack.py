"""Exposures of camera files, which need not fit the memory: which axis of an array counts them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._blocks import MOST_BYTES, FileError, Images, ambiguous, blocks_of

_NUMBER = re.compile("[0-9]")  # in which the names of units that belong together may differ


class Segment(NamedTuple):
    """Exposures of n_images (1 or 2) in an array of a file, or with one image of each in each of two arrays."""

    arrays: tuple[Images, ...]
    n_images: int

    @property
    def step(self) -> int:
        """Places of the first axis that an exposure takes."""
        return self.n_images // len(self.arrays) if len(self.arrays[0].full) < 4 else 1

    @property
    def n(self) -> int:
        full = self.arrays[0].full
        return (full[0] if len(full) > 2 else 1) // self.step

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, shape (stop - first, n_images, ny, nx)."""
        places = first * self.step, stop * self.step
        images = [array.section(*places).reshape(stop - first, -1, *array.full[-2:]) for array in self.arrays]
        return images[0] if len(images) == 1 else np.concatenate(images, axis=1)


def segments_of(
    path: Path, n_images: int | None = None, second: Path | None = None, *, verify: bool = False,
    max_bytes: int = MOST_BYTES,
) -> list[Segment]:  # fmt: skip
    """Exposures of a file.

    An array (ny, nx) is one exposure, (n, ny, nx) are n of one image each, and (n, 2, ny, nx) n of two images. An
    array (2, ny, nx) holds two exposures, or the two images of one if `n_images` is 2. Two arrays hold one image
    of each exposure: those of two files, or the two units of a file unless `n_images` is 1.
    """
    arrays = blocks_of(path, max_bytes, verify=verify)
    seconds = blocks_of(second) if second else []
    for array in (*arrays, *seconds):
        full, size = array.full, 8 * prod(array.full[-2:])
        if len(full) not in (2, 3, 4) or min(full) < 1 or (len(full) == 4 and full[1] > 2):
            raise FileError(f"{array.name}: its shape is {full}: expected (ny, nx), (n, ny, nx) or (n, 2, ny, nx)")
        if size > MOST_BYTES:
            raise FileError(
                f"{array.name}: its shape is {full}, {size} bytes for an image: expected at most {MOST_BYTES}"
            )
    if n_images is None and len({_NUMBER.sub("", array.title) for array in arrays}) > 1:
        raise ambiguous(arrays)
    if not second and len(arrays) == 2 and n_images != 1 and not any(map(_has_pairs, arrays)):
        arrays, seconds = arrays[:1], arrays[1:]
    if not seconds:
        if len(arrays) > 2 and n_images is None:
            raise ambiguous(arrays)
        pairs = [_has_pairs(array) or (n_images == 2 and array.full[:-2] == (2,)) for array in arrays]
        if len(set(pairs)) > 1:
            raise ambiguous(arrays)
        return [Segment((array,), 1 + pair) for array, pair in zip(arrays, pairs, strict=True)]
    if len(arrays) != len(seconds):
        raise FileError(f"{seconds[0].name}: {len(seconds)} units: expected {len(arrays)}, as {arrays[0].name}")
    segments = [Segment(both, 2) for both in zip(arrays, seconds, strict=True)]
    for (first, other), _ in segments:
        if first.full != other.full or _has_pairs(first):
            raise FileError(
                f"{other.name}: its shape is {other.full}, and {first.full} that of the first images in "
                f"{first.name}: expected as many second images as first ones"
            )
    return segments


def _has_pairs(array: Images) -> bool:
    return len(array.full) == 4 and array.full[1] == 2


class Stack:
    """Exposures of all files, one after the other, each of n_images (1 or 2) of a shape.

    There are as many second files, with the second image of each exposure, as files, or none. Raises
    FileNotFoundError, or FileError if a file is of another kind, broken, truncated, or holds other images.
    """

    def __init__(
        self, files: Sequence[Path], second_files: Sequence[Path], n_images: int, shape: tuple[int, int]
    ) -> None:
        if second_files and (n_images == 1 or len(second_files) != len(files)):
            expected = "none, since an exposure of the calibration has one image" if n_images == 1 else len(files)
            raise ValueError(f"second_files holds {len(second_files)} files: expected {expected}")
        self.segments: list[Segment] = []
        for index, path in enumerate(files):
            self.segments += segments_of(path, n_images, second_files[index] if second_files else None)
        self.firsts = [segment.arrays[0] for segment in self.segments]
        first = self.firsts[0]
        for segment in self.segments:
            for array in segment.arrays:
                if array.full[-2:] != shape or segment.n_images != n_images:
                    expected = f"(n, {'2, ' * (n_images - 1)}{shape[0]}, {shape[1]}), as in the calibration"
                    addition = ", or the second images in an extension or a file" * (n_images - 1)
                    raise FileError(f"{array.name}: its shape is {array.full}: expected {expected}{addition}")
                if array.dtype != first.dtype:
                    raise FileError(
                        f"{array.name}: its numbers are {array.dtype}: expected {first.dtype}, as in {first.name}"
                    )
        self.header = first.header
        self.bytes_per_exposure = n_images * prod(shape) * first.dtype.itemsize
        self.lengths = np.array([segment.n for segment in self.segments])
        self.ends = np.cumsum(self.lengths)
        self.starts, self.n = self.ends - self.lengths, int(self.ends[-1])

    @property
    def saturation(self) -> float:
        """Level at which pixels are saturated, as the first file states it or as its type allows."""
        stated, first = "SATURATE" in self.header, self.firsts[0]
        level = self.header["SATURATE"] if stated else first.full_scale
        name = f"{first.name}: {'SATURATE' if stated else 'largest number of its type'}"
        return level if level == np.inf else _check.number(name, level, 0, open_low=True)

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, shape (stop - first, n_images, ny, nx)."""
        begin, end = np.searchsorted(self.ends, (first, stop - 1), "right")
        parts = []
        for index in range(begin, end + 1):
            start, segment = self.starts[index], self.segments[index]
            parts.append(segment.read(max(first - start, 0), min(stop - start, segment.n)))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def state(self) -> list[tuple[str, str, int, int, int]]:
        """Path, name, exposures, size and time of change of all files: it differs once a file has changed."""
        states = [(segment.n, array, os.stat(array.path)) for segment in self.segments for array in segment.arrays]
        return [(str(array.path), array.name, n, stat.st_size, stat.st_mtime_ns) for n, array, stat in states]
