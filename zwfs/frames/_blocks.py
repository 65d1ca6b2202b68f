"""Images of FITS and NPY files, read here only: as blocks of numbers, which need not fit the memory."""

from __future__ import annotations

import gzip
import io
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._fits import FIRST_BYTES, fits_module

_GZIP, _NPY = b"\x1f\x8b", b"\x93NUMPY"  # first bytes of a file
_MOST_UNPACKED = 2**29  # bytes of a gzip file, which is unpacked in memory
# Types of the numbers of a FITS image, by BITPIX.
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
_KEYWORD = re.compile("[A-Z0-9_ -]*")  # of the standard, with the blanks of the convention HIERARCH


class FileError(ValueError):
    """A camera file is broken, too large, or holds no image; the message names the file."""


@dataclass(frozen=True)
class Block:
    """Numbers of one file that lie side by side: exposures of `per` images each.

    A value v of the file stands for v * scale + zero, and the value `blank` for no number.
    """

    path: Path
    name: str
    offset: int
    dtype: np.dtype
    full: tuple[int, ...]  # shape, as the file states it: (ny, nx), (n, ny, nx) or (n, per, ny, nx)
    packed: bool = False
    columns_first: bool = False
    scale: float = 1.0
    zero: float = 0.0
    blank: int | None = None
    per: int = 1
    header: dict[str, Any] = field(default_factory=dict, repr=False)  # values of the file's header; none for NPY

    @property
    def shape(self) -> tuple[int, ...]:
        return self.full[-2:]

    @property
    def n(self) -> int:
        """Number of exposures."""
        return prod(self.full[:-2]) // self.per

    @property
    def row(self) -> int:
        """Bytes of an exposure."""
        return self.per * prod(self.shape) * self.dtype.itemsize

    @property
    def numbers(self) -> tuple[str, float, float, int | None]:
        """Type of the numbers, and their meaning."""
        return self.dtype.str, self.scale, self.zero, self.blank

    @property
    def full_scale(self) -> float:
        """Largest value that the type of the numbers can hold; infinity for floats."""
        if self.dtype.kind not in "iu":
            return np.inf
        ends = np.iinfo(self.dtype).min, np.iinfo(self.dtype).max
        return max(float(end) * self.scale + self.zero for end in ends)

    def read(self, first: int, stop: int) -> NDArray:
        """Return some exposures, (stop - first, per, ny, nx): as they are, or scaled in float32 or float64."""
        with broken(f"{self.name}: it cannot be read"), self.path.open("rb") as file:
            data = self.take(unpacked(file, self.name) if self.packed else file, first, stop)
        if (self.scale, self.zero, self.blank) == (1, 0, None):
            return data
        return self.scaled(data, np.float32 if self.dtype.itemsize <= 2 else np.float64)

    def take(self, content: BinaryIO, first: int, stop: int) -> NDArray:
        """Return some exposures as they are, from the unpacked bytes of the file."""
        content.seek(self.offset + first * self.row)
        data = np.frombuffer(content.read((stop - first) * self.row), np.uint8)
        if data.size < (stop - first) * self.row:
            raise self.truncated(first + data.size // self.row)
        data, shape = data.view(self.dtype), (stop - first, self.per, *self.shape)
        return data.reshape(self.full, order="F").reshape(shape) if self.columns_first else data.reshape(shape)

    def scaled(self, data: NDArray, wide: Any) -> NDArray:
        """Return the values that numbers of the file stand for, NaN for none, as floats of a type."""
        with np.errstate(over="ignore", invalid="ignore"):  # what is too large for the type becomes infinite
            values = data.astype(wide) * self.scale + self.zero
        return values if self.blank is None else np.where(data == self.blank, np.nan, values)

    def truncated(self, n: int) -> FileError:
        return FileError(f"{self.name}: truncated: it ends in exposure {n} of {self.n} (counted from 0)")


@contextmanager
def broken(message: str) -> Iterator[None]:
    """Turn whatever a parser raises on broken bytes into one error that names the file; warnings are ignored.

    Two warnings of astropy become errors: that of an extension whose header is cut off, since astropy leaves out
    its image, and that of a wrong checksum.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="Error validating header|Datasum verification failed")
            yield
    except FileError:
        raise
    except Exception as error:  # astropy alone raises a dozen different ones
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FileError(f"{message}: {reason}") from error


def unpacked(file: BinaryIO, name: str, max_bytes: int = _MOST_UNPACKED) -> io.BytesIO:
    """Return the bytes of a FITS or NPY file, unpacked; never much more than `max_bytes` are in memory."""
    with broken(f"{name}: it cannot be read"):
        packed = file.read(len(_GZIP)) == _GZIP
        file.seek(0)
    size, content = os.fstat(file.fileno()).st_size, io.BytesIO()
    with broken(f"{name}: a broken gzip file" if packed else f"{name}: it cannot be read"):
        stream = gzip.GzipFile(fileobj=file) if packed else file
        while size <= max_bytes and (chunk := stream.read(2**20)):
            if not content.tell() and not chunk.startswith((_NPY, FIRST_BYTES)):
                break
            size = max(size, content.tell() + len(chunk))
            content.write(chunk)
    if size > max_bytes:
        larger = "unpacked, it is" if packed else "it is"
        raise FileError(f"{name}: {larger} larger than {max_bytes} bytes: expected at most max_bytes")
    content.seek(0)
    return content


def blocks_of(path: Path) -> list[Block]:
    with path.open("rb") as file:
        packed = file.read(len(_GZIP)) == _GZIP
        file.seek(0)
        return blocks_in(unpacked(file, path.name) if packed else file, path.resolve(), packed=packed)


def blocks_in(content: BinaryIO, path: Path, *, packed: bool = False, verify: bool = False) -> list[Block]:
    """Return the images in the unpacked bytes of a file.

    Only with `verify` are all bytes read, and their checksums compared with those of the header.
    """
    name, first = path.name, content.read(len(_NPY))
    size = content.seek(0, os.SEEK_END)
    content.seek(0)
    if first == _NPY:
        with broken(f"{name}: a broken NPY file"):
            blocks = [_npy(content, path, packed)]
    elif first and FIRST_BYTES.startswith(first):
        fits_module()  # without astropy this fails, and not the file
        with broken(f"{name}: a broken FITS file"):
            blocks = _fits(content, path, packed, verify)
    else:
        raise FileError(f"{name}: its first bytes are those of neither a FITS nor an NPY file")
    for block in blocks:
        if block.dtype.kind not in "biuf":
            raise FileError(f"{block.name}: its numbers are {block.dtype}: expected real ones")
        if len(block.full) > 1 and size < block.offset + block.n * block.row:
            raise block.truncated(max(size - block.offset, 0) // block.row)
    return blocks


def _npy(content: BinaryIO, path: Path, packed: bool) -> Block:
    """Return the block of an NPY file, which ends with its data."""
    version = np.lib.format.read_magic(content)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version}: expected 1.0 or 2.0")
    shape, columns_first, dtype = readers[version](content)
    if dtype.hasobject:
        raise ValueError("it holds objects of Python: expected numbers")
    block = Block(path, path.name, content.tell(), dtype, shape, packed, columns_first)
    surplus = content.seek(0, os.SEEK_END) - block.offset - prod(shape) * dtype.itemsize
    if min(shape, default=0) > 0 and surplus > 0:
        raise ValueError(f"{surplus} bytes follow the array of shape {shape}: expected none")
    return block


def _fits(content: BinaryIO, path: Path, packed: bool, verify: bool) -> list[Block]:
    """Return the blocks of a FITS file, with the header of its first unit and image."""
    fits, blocks, header = fits_module(), list[Block](), dict[str, Any]()
    # Not closed, since that would close `content`.
    units = fits.open(content, memmap=False, lazy_load_hdus=False, checksum=verify)
    for index, unit in enumerate(units):
        name = f"{path.name}[{index}]" if len(units) > 1 else path.name
        if isinstance(unit, fits.CompImageHDU):
            raise FileError(f"{name}: compressed: expected plain images; use funpack")
        if not unit.is_image or not unit.shape:
            continue
        cards = header_cards(unit.header)
        header = header or header_cards(units[0].header) | cards
        scaling = _check.number("BSCALE", cards.get("BSCALE", 1)), _check.number("BZERO", cards.get("BZERO", 0))
        blank = cards.get("BLANK") if cards["BITPIX"] > 0 else None
        blank = None if blank is None else _check.integer("BLANK", blank, -(2**63))
        offset, dtype = unit.fileinfo()["datLoc"], np.dtype(_TYPES[cards["BITPIX"]])
        blocks.append(
            Block(path, name, offset, dtype, tuple(unit.shape), packed, False, *scaling, blank, 1, header)
        )
    if not blocks:
        raise FileError(f"{path.name}: a FITS file without an image")
    return blocks


def header_cards(header: Any) -> dict[str, Any]:
    """Return the values of a FITS header by keyword; cards that do not follow the standard are left out."""
    values: dict[str, Any] = {}
    for card in header.cards:
        with suppress(fits_module().VerifyError):
            if _KEYWORD.fullmatch(card.keyword):
                values.setdefault(card.keyword, card.value)
    return values
