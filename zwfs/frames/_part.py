"""A FITS file that is written piece by piece: it appears when it is complete, and an interrupted run goes on.

The scratch folder `.NAME.part` holds the pieces at their places in `data`, and a line with the checksum of each in
`journal`. The next run with the same plan takes over the pieces whose checksums are right, and writes the others.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.frames._fits import fits_module, set_cards

_BLOCK = 2880  # bytes: all parts of a FITS file are multiples of it
_LINE = 80  # bytes that no line of a journal exceeds
_MARKER = "output"  # file of a scratch folder that holds the name of the output

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
    """Return the path of the scratch folder of an output: fixed, so that the next run finds it."""
    return output.with_name(f".{output.name}.part")


class Part:
    """Partial file of an output, with the pieces (first row, and the first row after it) that it gets.

    A piece has rows of all units but the last and those that are empty. Files in the folder are opened without
    following links. The plan is all that decides the bytes of the output.

    Raises ValueError if there is a part of another plan, another process writes it, or something else has the name
    of the folder: it could be data of the user. OSError if there is not enough space.
    """

    def __init__(
        self, output: Path, units: Sequence[Unit], pieces: Sequence[tuple[int, int]], plan: str, restart: bool
    ) -> None:
        self.output, self.units, self.pieces, self.path = output, units, pieces, scratch_of(output)
        self._plan = hashlib.sha256(plan.encode()).hexdigest().encode()
        self._size, self._files, self._keep = 0, list[int](), True
        for unit in units:
            unit.offset = self._size + len(unit.header())
            self._size = unit.offset + unit.size
        try:
            with self._no_space():
                output.parent.mkdir(parents=True, exist_ok=True)
                self._enter()
                self._data = self._open("data", os.O_RDWR | os.O_CREAT)
                self._lock()
                self._journal = self._open("journal", os.O_RDWR | os.O_CREAT | os.O_APPEND)
                self.done = {} if restart else self._earlier()
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
        """Add a finished piece, whose rows are written, to the journal."""
        with self._no_space():
            os.write(self._journal, b"%d %d %d\n" % (first, stop, self._checksum(first, stop)))
        self._keep = True

    def finish(self) -> None:
        """Write the headers, and give the file its name."""
        with self._no_space():
            self._write_headers()
            os.fsync(self._data)
            os.replace("data", self.output, src_dir_fd=self._folder)
        self._keep = False

    def close(self) -> None:
        """Close the part; its folder is removed unless it holds a finished piece, or is not ours."""
        if not self._keep:
            for name in ("data", "journal", _MARKER):
                with suppress(FileNotFoundError):
                    os.unlink(name, dir_fd=self._folder)
            with suppress(OSError):  # a file of somebody else remains
                self.path.rmdir()
        while self._files:
            os.close(self._files.pop())

    def _enter(self) -> None:
        """Open the folder. A new one gets a marker; that of an earlier one must name the output."""
        new, name = not os.path.lexists(self.path), os.fsencode(self.output.name)
        if new:
            self.path.mkdir(0o700)
        try:
            self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError as error:
            raise self._refusal(str(error.strerror)) from None
        self._files.append(self._folder)
        self._keep = not new
        if new:
            os.write(self._open(_MARKER, os.O_WRONLY | os.O_CREAT | os.O_EXCL), name)
        elif os.fstat(self._folder).st_uid != os.geteuid():
            raise self._refusal("it belongs to another user")
        elif _MARKER not in os.listdir(self._folder) or os.read(self._open(_MARKER, os.O_RDONLY), 999) != name:
            raise self._refusal(f"its file {_MARKER!r} does not hold the name of the output")

    def _open(self, name: str, flags: int) -> int:
        """Open a file of the folder until `close`, and return its descriptor."""
        reason = f"its file {name!r} is a link or a device"
        try:
            file = os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=self._folder)
        except OSError as error:
            raise self._refusal(reason) from None if error.errno == errno.ELOOP else error
        self._files.append(file)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
            raise self._refusal(reason)
        return file

    def _refusal(self, reason: str) -> ValueError:
        return ValueError(
            f"output = {str(self.output)!r} needs the folder {self.path.name}, which is there and which zwfs did "
            f"not make ({reason}): expected no such file or folder; move it, or choose another output"
        )

    def _lock(self) -> None:
        import fcntl  # not on Windows, where calibrations work

        try:
            fcntl.flock(self._data, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"output = {str(self.output)!r} is being written by another process") from None

    def _earlier(self) -> dict[tuple[int, int], int]:
        """Checksums of the whole pieces of an earlier run."""
        plan, *lines = os.pread(self._journal, _LINE * (len(self.pieces) + 1), 0).split(b"\n")
        if not lines:  # the first line was not written to its end
            return {}
        if plan != self._plan:
            raise ValueError(
                f"{self.path.name} is part of a run with other frames, another calibration or other settings: "
                "expected the same; restart to drop it, or choose another output"
            )
        pieces, done = set(self.pieces), {}
        for line in lines[:-1]:  # the last one is empty, or cut
            with suppress(ValueError):
                first, stop, checksum = map(int, line.split())
                if (first, stop) in pieces and self._checksum(first, stop) == checksum:
                    done[first, stop] = checksum
        if n_damaged := len(lines) - 1 - len(done):
            warnings.warn(
                f"{self.path / 'journal'}: {n_damaged} of {len(lines) - 1} lines or the data that they describe "
                "are damaged: their frames are reconstructed again",
                stacklevel=4,
            )
        return done

    def _read(self, unit: Unit, first: int, stop: int) -> bytes:
        return os.pread(self._data, (stop - first) * unit.row, unit.offset + first * unit.row)

    def _checksum(self, first: int, stop: int) -> int:
        checksum = 0
        for unit in self.units[:-1]:
            if unit.n:
                checksum = zlib.crc32(self._read(unit, first, stop), checksum)
        return checksum

    def _begin(self) -> None:
        """Reserve the space, and write the headers and the journal of the pieces that are done."""
        if not self.done:
            os.ftruncate(self._data, 0)
        os.ftruncate(self._data, self._size)
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(self._data, 0, self._size)
        os.ftruncate(self._journal, 0)
        rows = (b"%d %d %d\n" % (*piece, checksum) for piece, checksum in self.done.items())
        os.write(self._journal, b"".join((self._plan + b"\n", *rows)))
        self._write_headers()

    def _write_headers(self) -> None:
        for unit in self.units:
            header = unit.header()
            self._write(header, unit.offset - len(header))

    def _write(self, content: bytes, place: int) -> None:
        view = memoryview(content)
        while view:
            n = os.pwrite(self._data, view, place)
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
