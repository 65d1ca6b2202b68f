"""A FITS file that is written piece by piece: it appears when it is complete, and an interrupted run goes on.

The scratch file `.NAME.part` is the output with the finished pieces at their places, then their checksums, and
then the plan. The next run with the same plan takes over the pieces whose checksums are right.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.frames._fits import FIRST_BYTES, fits_module, set_cards

_BLOCK = 2880  # bytes: all parts of a FITS file are multiples of it
_CREATOR = b"CREATOR = 'zwfs "  # header card of an output
_MARK = np.dtype("<u8")  # 0, or the checksum of a finished piece + 1

Cards = Sequence[tuple[str, Any, str]]


@dataclass
class Unit:
    """An image cube or a table of a FITS file with n rows; the fields of a table are those of its type."""

    name: str  # EXTNAME; none for the first unit
    dtype: np.dtype  # big-endian
    shape: tuple[int, ...]  # of a row of a cube; () for a table
    n: int
    cards: Cards
    units: Mapping[str, str]  # of the columns of a table
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
        fits, rows = fits_module(), np.empty((0, *self.shape), self.dtype)
        if self.dtype.names:
            unit = fits.BinTableHDU(rows, name=self.name)
        else:
            unit = (
                fits.ImageHDU(rows, name=self.name) if self.name else fits.PrimaryHDU(rows if self.shape else None)
            )
        if axes := unit.header["NAXIS"]:
            unit.header[f"NAXIS{axes}"] = self.n
        for index, name in enumerate(self.dtype.names or (), 1):
            if name in self.units:
                unit.header[f"TUNIT{index}"] = self.units[name]
        set_cards(unit.header, self.cards)
        return unit.header.tostring().encode("ascii")


def scratch_of(output: Path) -> Path:
    """Return the path of the scratch file of an output: fixed, so that the next run finds it."""
    return output.with_name(f".{output.name}.part")


class Part:
    """Partial file of an output, with the pieces (first row, and the first row after it) that it gets.

    A piece has rows of all units but the last and those that are empty. The plan is all that decides the bytes of
    the output.

    Raises ValueError if there is a part of another plan, another process writes it, or something else has the name
    of the scratch file: it could be data of the user. OSError if there is not enough space.
    """

    def __init__(
        self, output: Path, units: Sequence[Unit], pieces: Sequence[tuple[int, int]], plan: str, restart: bool
    ) -> None:
        self.output, self.units, self.pieces, self.path = output, units, list(pieces), scratch_of(output)
        self._plan, self._keep, self._size = hashlib.sha256(plan.encode()).digest(), True, 0
        for unit in units:
            unit.offset = self._size + len(unit.header())
            self._size = unit.offset + unit.size
        with self._no_space():
            output.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._open()
            try:
                self._lock()
                self.done = set() if restart else self._earlier()
                self._keep = bool(self.done)
                self._begin()
            except BaseException:
                self.close()
                raise

    def write(self, unit: Unit, first: int, rows: NDArray) -> None:
        with self._no_space():
            self._write(np.ascontiguousarray(rows, unit.dtype).tobytes(), unit.offset + first * unit.row)

    def read(self, unit: Unit, first: int, stop: int) -> NDArray:
        return np.frombuffer(self._read(unit, first, stop), unit.dtype).reshape(-1, *unit.shape).copy()

    def note(self, first: int, stop: int) -> None:
        """Mark a piece, whose rows are written, as finished."""
        place = self._size + self.pieces.index((first, stop)) * _MARK.itemsize
        with self._no_space():
            self._write(np.array(self._checksum(first, stop) + 1, _MARK).tobytes(), place)
        self._keep = True

    def finish(self) -> None:
        """Write the headers, and give the file its name."""
        with self._no_space():
            self._write_headers()
            os.ftruncate(self._file, self._size)
            os.fsync(self._file)
            os.replace(self.path, self.output)
        self._keep = True

    def close(self) -> None:
        """Close the part, and remove it unless it holds a finished piece."""
        if not self._keep:
            self.path.unlink(missing_ok=True)
        os.close(self._file)

    def _open(self) -> int:
        """Open the scratch file, without following a link. An earlier one begins as an output does."""
        reason = "it is a link, a folder or a device"
        try:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        except OSError as error:
            raise self._refusal(reason) from None if error.errno in (errno.ELOOP, errno.EISDIR) else error
        status, start = os.fstat(file), b""
        if stat.S_ISREG(status.st_mode) and status.st_nlink == 1:
            start = os.pread(file, _BLOCK, 0)
            reason = "it is no part of an output"
            if status.st_uid != os.geteuid():
                reason = "it belongs to another user"
            elif not start or (start.startswith(FIRST_BYTES) and _CREATOR in start):
                return file
        os.close(file)
        raise self._refusal(reason)

    def _refusal(self, reason: str) -> ValueError:
        return ValueError(
            f"output = {str(self.output)!r} needs the file {self.path.name}, which is there and which zwfs did "
            f"not make ({reason}): expected no such file; move it, or choose another output"
        )

    def _lock(self) -> None:
        import fcntl  # not on Windows, where calibrations work

        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"output = {str(self.output)!r} is being written by another process") from None

    def _earlier(self) -> set[tuple[int, int]]:
        """Pieces that an earlier run has finished."""
        held = os.fstat(self._file).st_size
        plan = os.pread(self._file, len(self._plan), max(0, held - len(self._plan)))
        if not plan.strip(b"\0 "):  # it was stopped before it had a plan
            return set()
        if plan != self._plan:
            raise ValueError(
                f"{self.path.name} is part of a run with other frames, another calibration or other settings: "
                "expected the same; restart to drop it, or choose another output"
            )
        marks = np.frombuffer(os.pread(self._file, len(self.pieces) * _MARK.itemsize, self._size), _MARK).tolist()
        finished = [(piece, mark - 1) for piece, mark in zip(self.pieces, marks, strict=True) if mark]
        done = {piece for piece, checksum in finished if self._checksum(*piece) == checksum}
        if n_damaged := len(finished) - len(done):
            warnings.warn(
                f"{self.path}: {n_damaged} of {len(finished)} finished pieces are damaged: their frames are "
                "reconstructed again",
                stacklevel=4,
            )
        return done

    def _read(self, unit: Unit, first: int, stop: int) -> bytes:
        return os.pread(self._file, (stop - first) * unit.row, unit.offset + first * unit.row)

    def _checksum(self, first: int, stop: int) -> int:
        checksum = 0
        for unit in self.units[:-1]:
            if unit.n:
                checksum = zlib.crc32(self._read(unit, first, stop), checksum)
        return checksum

    def _begin(self) -> None:
        """Write the headers, reserve the space, and write the marks and the plan."""
        if not self.done:
            os.ftruncate(self._file, 0)
        self._write_headers()
        whole = self._size + len(self.pieces) * _MARK.itemsize + len(self._plan)
        os.ftruncate(self._file, whole)
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(self._file, 0, whole)
        marks = [self._checksum(*piece) + 1 if piece in self.done else 0 for piece in self.pieces]
        self._write(np.array(marks, _MARK).tobytes() + self._plan, self._size)

    def _write_headers(self) -> None:
        for unit in self.units:
            header = unit.header()
            self._write(header, unit.offset - len(header))

    def _write(self, content: bytes, place: int) -> None:
        view = memoryview(content)
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
                f"output = {str(self.output)!r} cannot be written ({error.strerror}): expected {self._size} bytes "
                "of free space in a folder that can be written",
            ) from None
