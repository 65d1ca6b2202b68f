"""A FITS file that is written piece by piece: it appears when it is complete, and an interrupted run goes on.

The scratch folder `.NAME.part` holds the pieces at their places in `data`, and a line with the checksum of each in
`journal`. The next run with the same plan takes over the pieces whose checksums are right, and writes the others.
"""

from __future__ import annotations

import errno
import hashlib
import json
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
        fits, rows = fits_module(), np.empty((0, *self.shape), self.dtype)
        if self.dtype.names:
            unit = fits.BinTableHDU(rows, name=self.name)
        elif self.name:
            unit = fits.ImageHDU(rows, name=self.name)
        else:
            unit = fits.PrimaryHDU(rows if self.shape else None)
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


class Scratch:
    """Scratch folder of an output, with a marker. Files in it are opened without following links.

    Parameters
    ----------
    output : Path

    Raises
    ------
    ValueError
        If something else has the name of the folder, or a file in it is a link: it could be data of the user.
    """

    def __init__(self, output: Path) -> None:
        self._output, self.path = output, scratch_of(output)
        new = not os.path.lexists(self.path)
        if new:
            self.path.mkdir(0o700)
        try:
            self.folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError as error:
            raise self._refusal(str(error.strerror)) from None
        self._files = [self.folder]
        try:
            self._check_marker(new)
        except BaseException:
            if new:
                self.remove()
            self.close()
            raise

    def open(self, name: str, flags: int) -> int:
        """Open a file of the folder until `close`, and return its descriptor."""
        reason = f"its file {name!r} is a link or a device"
        try:
            file = os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=self.folder)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise self._refusal(reason) from None
            raise
        self._files.append(file)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
            raise self._refusal(reason)
        return file

    def close(self) -> None:
        """Close all files."""
        while self._files:
            os.close(self._files.pop())

    def remove(self) -> None:
        """Remove the folder and our files."""
        for name in ("data", "journal", _MARKER):
            with suppress(FileNotFoundError):
                os.unlink(name, dir_fd=self.folder)
        with suppress(OSError):  # a file of somebody else remains
            self.path.rmdir()

    def _check_marker(self, new: bool) -> None:
        """Write the marker of a new folder, or check who owns the folder and what the marker says."""
        name = os.fsencode(self._output.name)
        if new:
            os.write(self.open(_MARKER, os.O_WRONLY | os.O_CREAT | os.O_EXCL), name)
        elif os.fstat(self.folder).st_uid != os.geteuid():
            raise self._refusal("it belongs to another user")
        elif _MARKER not in os.listdir(self.folder) or os.read(self.open(_MARKER, os.O_RDONLY), 999) != name:
            raise self._refusal(f"its file {_MARKER!r} does not hold the name of the output")

    def _refusal(self, reason: str) -> ValueError:
        return ValueError(
            f"output = {str(self._output)!r} needs the folder {self.path.name}, which is there and which zwfs did "
            f"not make ({reason}): expected no such file or folder; move it, or choose another output"
        )


class Part:
    """Partial file of an output, open for pieces.

    Parameters
    ----------
    output : Path
        Where the complete file will be.
    units : sequence of Unit
        All data have a fixed place from the start.
    pieces : sequence of (int, int)
        First row of each piece, and the first row after it.
    plan : str
        All that decides the bytes of the output. A part of another plan is refused.
    restart : bool
        Whether to drop a part that an earlier run wrote.

    Raises
    ------
    ValueError
        If there is a part of another plan, another process writes it, or `Scratch` refuses its folder.
    OSError
        If there is not enough space; the message names the file and the bytes.
    """

    def __init__(
        self, output: Path, units: Sequence[Unit], pieces: Sequence[tuple[int, int]], plan: str, restart: bool
    ) -> None:
        self.output, self.units, self.pieces = output, units, pieces
        self._plan = hashlib.sha256(plan.encode()).hexdigest().encode()
        offset = 0
        for unit in units:
            unit.offset = offset + len(unit.header())
            offset = unit.offset + unit.size
        self._size = offset
        with self._no_space():
            output.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Scratch(output)
        self._keep = True
        try:
            with self._no_space():
                self._file = self._scratch.open("data", os.O_RDWR | os.O_CREAT)
                self._lock()
                self._journal = self._scratch.open("journal", os.O_RDWR | os.O_CREAT | os.O_APPEND)
                self.done = {} if restart else self._earlier()
                self._keep = bool(self.done)
                self._begin()
        except BaseException:
            self.close()
            raise

    def write(self, unit: Unit, first: int, rows: NDArray) -> bytes:
        """Write rows of a unit to their place, and return their bytes."""
        content = np.ascontiguousarray(rows, unit.dtype).tobytes()
        with self._no_space():
            self._write(content, unit.offset + first * unit.row)
        return content

    def read(self, unit: Unit, first: int, stop: int) -> NDArray:
        """Read rows of a unit."""
        content = os.pread(self._file, (stop - first) * unit.row, unit.offset + first * unit.row)
        return np.frombuffer(content, unit.dtype).reshape(-1, *unit.shape).copy()

    def note(self, first: int, stop: int, checksum: int) -> None:
        """Add a finished piece to the journal: rows of all units, and the checksum of their bytes."""
        with self._no_space():
            os.write(self._journal, b"%d %d %d\n" % (first, stop, checksum))
        self._keep = True

    def finish(self) -> None:
        """Write the headers, and give the file its name."""
        with self._no_space():
            self._write_headers()
            os.fsync(self._file)
            os.replace("data", self.output, src_dir_fd=self._scratch.folder)
        self._keep = False

    def close(self) -> None:
        """Close the part; it is removed unless it holds a finished piece."""
        if not self._keep:
            self._scratch.remove()
        self._scratch.close()

    def _lock(self) -> None:
        import fcntl  # not on Windows, where calibrations work

        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"output = {str(self.output)!r} is being written by another process") from None

    def _earlier(self) -> dict[tuple[int, int], int]:
        """Checksums of the whole pieces of an earlier run."""
        plan, *lines = os.pread(self._journal, _LINE * (len(self.pieces) + 1), 0).split(b"\n")
        if not lines:  # the first line was not written to its end
            return {}
        if plan != self._plan:
            raise ValueError(
                f"{self._scratch.path.name} is part of a run with other frames, another calibration or other "
                "settings: expected the same; restart to drop it, or choose another output"
            )
        pieces, done = set(self.pieces), {}
        for line in lines[:-1]:  # the last one is empty, or cut
            with suppress(ValueError):
                first, stop, checksum = map(int, line.split())
                if (first, stop) in pieces and self._checksum(first, stop) == checksum:
                    done[first, stop] = checksum
        if n_damaged := len(lines) - 1 - len(done):
            warnings.warn(
                f"{self._scratch.path / 'journal'}: {n_damaged} of {len(lines) - 1} lines or the data that they "
                "describe are damaged: their frames are reconstructed again",
                stacklevel=4,
            )
        return done

    def _checksum(self, first: int, stop: int) -> int:
        checksum = 0
        for unit in self.units[:-1]:
            if unit.n:
                place = unit.offset + first * unit.row
                checksum = zlib.crc32(os.pread(self._file, (stop - first) * unit.row, place), checksum)
        return checksum

    def _begin(self) -> None:
        """Reserve the space, and write the headers and the journal of the pieces that are done."""
        if not self.done:
            os.ftruncate(self._file, 0)
        os.ftruncate(self._file, self._size)
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(self._file, 0, self._size)
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
                f"{self._size} bytes of free space in a folder that can be written",
            ) from None


def plan_of(**values: Any) -> str:
    """Return values as one string, which is the same for the same values."""
    return json.dumps(values, sort_keys=True, default=str)
