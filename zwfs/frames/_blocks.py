"""Formats of camera files: arrays of images, which need not fit the memory, read by astropy and NumPy.

A further format is one class more in `_FORMATS`. All sizes that a file claims are checked before a number is read.
"""

from __future__ import annotations

import gzip
import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames._fits import FIRST_BYTES, fits_module, header_cards

_GZIP = b"\x1f\x8b"  # first bytes of a packed file
MOST_BYTES = 2**29  # of an image, of a packed file, which is unpacked in memory, and of a compressed tile
_DEFLATE = 1032  # bytes to which a byte of a gzip file can unpack, at most
_UNIT = re.compile(r"(.+)\[([^][]+)\]")  # name of a file, and one of its units
# Names of units that hold something else than frames.
_COMPANION = re.compile("DARK|BIAS|FLAT|SKY|MASK|BAD|BPM|DQ|QUAL|HOT|ERR|SIGMA|NOISE|VAR|STAT|WEIGHT|GAIN|BACK")
_OWN = ("EXTNAME", "BSCALE", "BZERO", "BLANK")  # cards of a unit that say nothing of the others

Source = Path | bytes  # a file, or the unpacked bytes of a packed one


class FileError(ValueError):
    """A camera file is broken, too large, or holds no image; the message names the file."""


@dataclass(frozen=True)
class Images:
    """Array of images in a file; each format is a class that opens files and reads sections."""

    first_bytes: ClassVar[bytes]  # of a file of the format
    path: Path
    name: str  # for messages; with the unit where a file has several
    full: tuple[int, ...]  # shape of the array
    dtype: np.dtype  # of a section, native
    full_scale: float  # largest value that the type of the file's numbers can hold; infinity for floats
    header: dict[str, Any] = field(default_factory=dict, repr=False)
    unit: int = 0  # of the file

    @property
    def title(self) -> str:
        """Name of the unit."""
        return str(self.header.get("EXTNAME", "")).strip().upper()

    @classmethod
    def open(cls, path: Path, source: Source, verify: bool) -> list[Self]:
        """Return the arrays of a file, after a check of their sizes; with `verify` also of checksums."""
        raise NotImplementedError

    def section(self, first: int, stop: int) -> NDArray:
        """Return a part of the first axis, or all of an array of two axes: native numbers, NaN for none."""
        raise NotImplementedError


class NpyImages(Images):
    """Array of an NPY file."""

    first_bytes = b"\x93NUMPY"

    @classmethod
    def open(cls, path: Path, source: Source, verify: bool) -> list[Self]:
        with broken(f"{path.name}: a broken NPY file"):
            array, surplus = cls._array(source)
            if surplus > 0 and array.size:
                raise ValueError(f"{surplus} bytes follow the array of shape {array.shape}: expected none")
        if array.dtype.kind not in "biuf":
            raise FileError(f"{path.name}: its numbers are {array.dtype}: expected real ones")
        highest = float(np.iinfo(array.dtype).max) if array.dtype.kind in "iu" else np.inf
        return [cls(path, path.name, array.shape, array.dtype.newbyteorder("="), highest)]

    def section(self, first: int, stop: int) -> NDArray:
        with broken(f"{self.name}: it cannot be read"):
            array, _ = self._array(_source(self.path))
            return np.array(array[first:stop] if array.ndim > 2 else array, self.dtype, order="C")

    @staticmethod
    def _array(source: Source) -> tuple[NDArray, int]:
        """Array, mapped from the disk unless it was packed, and the number of bytes after it."""
        if isinstance(source, bytes):
            stream = io.BytesIO(source)
            array = np.load(stream, allow_pickle=False)
            return array, len(source) - stream.tell()
        mapped: Any = np.load(source, mmap_mode="r", allow_pickle=False)
        return mapped, _size(source) - mapped.offset - mapped.nbytes


class FitsImages(Images):
    """Array of an image unit of a FITS file, which may be compressed."""

    first_bytes = FIRST_BYTES

    @classmethod
    def open(cls, path: Path, source: Source, verify: bool) -> list[Self]:
        fits_module()  # without astropy this fails, and not the file
        arrays, verify = [], verify and _size(source) <= MOST_BYTES
        whole = {"lazy_load_hdus": False, "checksum": verify}
        with broken(f"{path.name}: a broken FITS file"), _units(source, **whole) as units:
            primary = header_cards(units[0].header)
            for key in _OWN:
                primary.pop(key, None)
            for index, unit in enumerate(units):
                if unit.is_image and unit.shape:
                    name = f"{path.name}[{index}]" if len(units) > 1 else path.name
                    _check_size(source, unit, index, name)
                    cards, full = header_cards(unit.header), tuple(unit.shape)
                    numbers = cls._numbers(unit, cards)
                    arrays.append(cls(path, name, full, *numbers, primary | cards, index))
        if not arrays:
            raise FileError(f"{path.name}: a FITS file without an image")
        return arrays

    @staticmethod
    def _numbers(unit: Any, cards: dict[str, Any]) -> tuple[np.dtype, float]:
        """Type of the numbers of a section, and the largest number that an integer of the file stands for."""
        bits, highest = unit.header["BITPIX"], np.inf
        scale = _check.number("BSCALE", cards.get("BSCALE", 1))
        zero = _check.number("BZERO", cards.get("BZERO", 0))
        if bits > 0:
            type_ = np.iinfo("u1" if bits == 8 else f"i{bits // 8}")
            highest = max(float(end) * scale + zero for end in (type_.min, type_.max))
            if "BLANK" in cards:
                _check.integer("BLANK", cards["BLANK"], -(2**63))
                return np.dtype(np.float32 if bits <= 16 else np.float64), highest
        first = unit.section[(slice(0, 1),) * len(unit.shape)] if min(unit.shape) > 0 else np.empty(0)
        return first.dtype.newbyteorder("="), highest

    def section(self, first: int, stop: int) -> NDArray:
        # An unsigned integer has no value for a blank: with a blank, the numbers are floats.
        settings = {"uint": self.dtype.kind != "f"}
        with broken(f"{self.name}: it cannot be read"), _units(_source(self.path), **settings) as units:
            section = units[self.unit].section
            values = (section[first:stop] if len(self.full) > 2 else section[:]).astype(self.dtype, copy=False)
        if self.header.get("BLANK") == 0 < self.header["BITPIX"]:  # which astropy overlooks
            values[values == self.header.get("BZERO", 0)] = np.nan
        return values


_FORMATS: tuple[type[Images], ...] = (NpyImages, FitsImages)


@contextmanager
def _units(source: Source, **settings: Any) -> Iterator[Any]:
    """Units of a FITS file."""
    with (
        io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as file,
        fits_module().open(file, memmap=False, **settings) as units,
    ):
        yield units


def _check_size(source: Source, unit: Any, index: int, name: str) -> None:
    """Require that the data of a unit are in the file, and that no compressed tile is a bomb."""
    if (tiles := getattr(unit, "tile_shape", None)) is not None:
        with _units(source, disable_image_compression=True) as tables:
            table = tables[index]
            _check_size(source, table, index, name)
            n_tiles = prod(-(-n // size) for n, size in zip(unit.shape, tiles, strict=True))
            if table.header["NAXIS2"] != n_tiles:
                raise ValueError(f"{table.header['NAXIS2']} compressed tiles: expected {n_tiles}")
            most = 8 * prod(map(min, unit.shape, tiles))
            packed = str(table.header["ZCMPTYPE"]).startswith("GZIP")
            for column in {"GZIP_COMPRESSED_DATA", "COMPRESSED_DATA" * packed} & set(table.columns.names):
                most = max(most, _DEFLATE * int(table.data.view(np.ndarray)[column][..., 0].max(initial=0)))
            if most > MOST_BYTES:
                raise ValueError(f"a compressed tile may unpack to {most} bytes: expected at most {MOST_BYTES}")
    else:
        held = max(_size(source) - unit.fileinfo()["datLoc"], 0)
        if unit.size > held:
            raise FileError(f"{name}: truncated: it holds {held} of the {unit.size} bytes that its header claims")


def _size(source: Source) -> int:
    return len(source) if isinstance(source, bytes) else source.stat().st_size


def blocks_of(path: Path, max_bytes: int = MOST_BYTES, *, verify: bool = False) -> list[Images]:
    """Return the arrays of a file, without those whose names say that they hold something else than frames.

    Brackets behind the name of a file choose one of its units by number or name: `frame.fits[DARK]`.
    """
    file, unit = file_and_unit(path)
    if not file.is_file():
        where = "" if file.is_absolute() else f" in {Path.cwd()}"
        raise FileNotFoundError(f"{path}: no such file{where}")
    source = _source(file, max_bytes)
    with broken(f"{file.name}: it cannot be read"), file.open("rb") as stream:
        start = (source if isinstance(source, bytes) else stream.read(len(FIRST_BYTES)))[: len(FIRST_BYTES)]
    for kind in _FORMATS:
        if start and start.startswith(kind.first_bytes[: len(start)]):
            return _chosen(kind.open(file.resolve(), source, verify), unit)
    raise FileError(f"{file.name}: its first bytes are those of neither a FITS nor an NPY file")


def file_and_unit(path: Path) -> tuple[Path, str]:
    """Return the path of a file, and the number or name of the unit that brackets behind it choose, if any."""
    parts = None if path.exists() else _UNIT.fullmatch(path.name)
    return (path.with_name(parts[1]), parts[2].strip().upper()) if parts else (path, "")


def _chosen(arrays: list[Images], unit: str) -> list[Images]:
    """The array of a unit; without one, those of frames, which must be of one shape and type."""
    if unit:
        chosen = [array for array in arrays if unit in (array.title, str(array.unit))]
        if len(chosen) != 1:
            raise ambiguous(arrays, f" and {len(chosen)} of them are {unit!r}")
        return chosen
    frames = [array for array in arrays if not _COMPANION.search(array.title)] or arrays
    if len({(array.full[-2:], array.dtype) for array in frames}) > 1:
        raise ambiguous(frames)
    return frames


def ambiguous(arrays: list[Images], reason: str = "") -> FileError:
    """Error for a file with several units of which none is chosen."""
    name = arrays[0].path.name
    units = ", ".join(f"[{one.unit}] {one.title} {one.full} {one.dtype}".replace("  ", " ") for one in arrays)
    return FileError(
        f"{name}: it has {len(arrays)} image units, {units}{reason}: expected one; choose it by its number or "
        f"name, as '{name}[{arrays[0].unit}]', or set n_images if all are exposures"
    )


def _source(path: Path, max_bytes: int = MOST_BYTES) -> Source:
    """Bytes of a packed file, of which never many more than `max_bytes` are in memory, or the path of another."""
    with broken(f"{path.name}: it cannot be read"), path.open("rb") as file:
        if file.read(len(_GZIP)) != _GZIP:
            return path
        file.seek(0)
        content, known = io.BytesIO(), tuple(kind.first_bytes for kind in _FORMATS)
        with broken(f"{path.name}: a broken gzip file"), gzip.GzipFile(fileobj=file) as stream:
            while content.tell() <= max_bytes and (chunk := stream.read(2**20)):
                if not content.tell() and not chunk.startswith(known):
                    break
                content.write(chunk)
    if content.tell() > max_bytes:
        raise FileError(f"{path.name}: unpacked, it is larger than {max_bytes} bytes: expected at most max_bytes")
    return content.getvalue()


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
