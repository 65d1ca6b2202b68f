"""A FITS file that is written piece by piece: it appears when it is complete, and an interrupted run goes on.

The pieces go to their places in `.NAME.part`. A line of `.NAME.journal` follows each piece, with its checksum. The
next run with the same plan takes over the pieces whose checksums are right, and writes the others.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.frames._fits import card_value, fits_module

_BLOCK = 2880  # bytes: all parts of a FITS file are multiples of it
_FORMATS = {"i2": "I", "i4": "J", "i8": "K", "f4": "E", "f8": "D", "S": "A"}  # of the columns of a table

Cards = Sequence[tuple[str, Any, str]]


@dataclass
class Unit:
    """An image cube or a table of a FITS file, with one row for each exposure, or any other number.

    Attributes
    ----------
    name : str
        EXTNAME; none for the first unit.
    dtype : dtype
        Of an element, big-endian; that of a table has fields.
    shape : tuple of int
        Of a row of a cube; () for a table.
    n : int
        Number of rows.
    cards : sequence of (keyword, value, comment)
    units : mapping
        Units of the columns of a table.
    """

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    n: int
    cards: Cards
    units: Mapping[str, str]
    offset: int = 0  # of the data in the file

    @property
    def row(self) -> int:
        """Bytes of a row."""
        return self.dtype.itemsize * int(np.prod(self.shape, dtype=int))

    @property
    def size(self) -> int:
        """Bytes of the data, filled up to whole blocks."""
        return -(-self.n * self.row // _BLOCK) * _BLOCK

    def header(self) -> bytes:
        """Return the header: a change of a number does not change its length."""
        header = fits_module().Header()
        first = not self.name
        header["SIMPLE" if first else "XTENSION"] = True if first else "BINTABLE" if self.dtype.names else "IMAGE"
        table = self.dtype.names is not None
        axes = (self.row, self.n) if table else (*self.shape[::-1], self.n) if self.shape else ()
        header["BITPIX"] = 8 if table or not self.shape else -8 * self.dtype.itemsize
        header["NAXIS"] = len(axes)
        for index, length in enumerate(axes, 1):
            header[f"NAXIS{index}"] = length
        if first:
            header["EXTEND"] = True
        else:
            header["PCOUNT"], header["GCOUNT"] = 0, 1
            if table:
                header["TFIELDS"] = len(self.dtype.names or ())
            header["EXTNAME"] = self.name
        for index, name in enumerate(self.dtype.names or (), 1):
            base, shape = self.dtype[name].subdtype or (self.dtype[name], ())
            code = "S" if base.kind == "S" else base.str[1:]
            repeat = base.itemsize if code == "S" else int(np.prod(shape, dtype=int))
            header[f"TTYPE{index}"] = name
            header[f"TFORM{index}"] = f"{repeat}{_FORMATS[code]}"
            if name in self.units:
                header[f"TUNIT{index}"] = self.units[name]
        for key, value, comment in self.cards:
            header[key] = (card_value(value), comment) if comment else card_value(value)
        return header.tostring().encode("ascii")


class Part:
    """Partial file of an output, open for pieces.

    Parameters
    ----------
    output : Path
        Where the complete file will be.
    units : sequence of Unit
        All data have a fixed place from the start.
    plan : str
        All that decides the bytes of the output. A part of another plan is refused.
    restart : bool
        Whether to drop a part that an earlier run wrote.

    Raises
    ------
    ValueError
        If there is a part of another plan, or another process writes it.
    OSError
        If there is not enough space; the message names the file and the bytes.
    """

    def __init__(self, output: Path, units: Sequence[Unit], plan: str, restart: bool) -> None:
        self.output, self.units = output, units
        self._part = output.with_name(f".{output.name}.part")
        self._journal = output.with_name(f".{output.name}.journal")
        self._plan = hashlib.sha256(plan.encode()).hexdigest()
        offset = 0
        for unit in units:
            unit.offset = offset + len(unit.header())
            offset = unit.offset + unit.size
        self._size = offset
        with self._no_space():
            output.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._part, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            self._lock()
            self.done = {} if restart else self._earlier()
            self._noted = bool(self.done)
            if not self.done:
                self._begin()
        except BaseException:
            os.close(self._file)
            raise

    def write(self, unit: Unit, first: int, rows: NDArray) -> bytes:
        """Write rows of a unit to their place, and return their bytes."""
        content = np.ascontiguousarray(rows, unit.dtype).tobytes()
        self._write(content, unit.offset + first * unit.row)
        return content

    def read(self, unit: Unit, first: int, stop: int) -> NDArray:
        """Read rows of a unit."""
        content = os.pread(self._file, (stop - first) * unit.row, unit.offset + first * unit.row)
        return np.frombuffer(content, unit.dtype).reshape(-1, *unit.shape).copy()

    def note(self, first: int, stop: int, checksum: int) -> None:
        """Add a finished piece to the journal: rows of all units, and the checksum of their bytes."""
        with self._no_space(), self._journal.open("a", encoding="ascii") as file:
            file.write(f"{first} {stop} {checksum}\n")
        self._noted = True

    def finish(self) -> None:
        """Write the headers, and give the file its name."""
        for unit in self.units:
            header = unit.header()
            self._write(header, unit.offset - len(header))
        with self._no_space():
            os.fsync(self._file)
            os.replace(self._part, self.output)
        self._remove()

    def close(self) -> None:
        """Close the part; it is removed unless it holds a finished piece."""
        os.close(self._file)
        if not self._noted:
            self._remove()

    def _lock(self) -> None:
        with suppress(ImportError):  # there is no fcntl on Windows
            import fcntl

            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise ValueError(f"output = {str(self.output)!r} is being written by another process") from None

    def _earlier(self) -> dict[int, int]:
        """First and last but one row of the pieces of an earlier run that are whole."""
        try:
            plan, *lines = self._journal.read_text("ascii").splitlines()
        except (OSError, ValueError):
            return {}
        if plan != self._plan:
            raise ValueError(
                f"{self._part.name} is part of a run with other frames, another calibration or other settings: "
                "expected the same; restart to drop it, or choose another output"
            )
        done = {}
        for line in lines:
            with suppress(ValueError):  # the last line may be cut
                first, stop, checksum = map(int, line.split())
                if self._checksum(first, stop) == checksum:
                    done[first] = stop
        return done

    def _checksum(self, first: int, stop: int) -> int:
        checksum = 0
        for unit in self.units[:-1]:
            if unit.n:
                place = unit.offset + first * unit.row
                checksum = zlib.crc32(os.pread(self._file, (stop - first) * unit.row, place), checksum)
        return checksum

    def _begin(self) -> None:
        """Reserve the space, and write the headers and the first line of the journal."""
        try:
            with self._no_space():
                os.ftruncate(self._file, 0)
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(self._file, 0, self._size)
                else:
                    os.ftruncate(self._file, self._size)
                self._journal.write_text(f"{self._plan}\n", "ascii")
            for unit in self.units:
                header = unit.header()
                self._write(header, unit.offset - len(header))
        except BaseException:
            self._remove()
            raise

    def _remove(self) -> None:
        self._part.unlink(missing_ok=True)
        self._journal.unlink(missing_ok=True)

    def _write(self, content: bytes, place: int) -> None:
        view = memoryview(content)
        with self._no_space():
            while view:
                n = os.pwrite(self._file, view, place)
                view, place = view[n:], place + n

    @contextmanager
    def _no_space(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OSError(
                error.errno,
                f"output = {str(self.output)!r} cannot be written ({error.strerror}): expected "
                f"{getattr(self, '_size', 0)} bytes of free space in a folder that can be written",
            ) from None


def plan_of(**values: Any) -> str:
    """Return values as one string, which is the same for the same values."""
    return json.dumps(values, sort_keys=True, default=str)
