"""Folders for unfinished results: they vanish on every kind of end, and finished results move in one step."""

import fcntl
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = ".zwfs-lock"  # the process that uses a scratch folder holds a lock on this file in it


def end_cleanly_on_signals() -> None:
    """Treat SIGTERM and SIGHUP like Ctrl-C; a signal that the caller's shell ignores stays ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Wait until no other command holds a folder, and hold it; it is created if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    place = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print("another command builds this book: waiting for its end", file=sys.stderr, flush=True)
                fcntl.flock(place, fcntl.LOCK_EX)
        yield
    finally:
        os.close(place)


@contextmanager
def scratch_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """Create a folder for unfinished results and remove it at the end; remove those of killed processes first."""
    parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(parent)
    with tempfile.TemporaryDirectory(dir=parent, prefix=prefix) as name:
        new = Path(name) / f"{LOCK}.new"
        with new.open("w") as file:
            with suppress(OSError):  # a file system without locks: nobody can remove the folder either
                fcntl.flock(file, fcntl.LOCK_EX)
            new.rename(new.with_name(LOCK))  # whoever sees the lock file finds it locked
            yield Path(name)


def remove_abandoned(parent: Path) -> None:
    """Remove the scratch folders of killed processes, of any command.

    The system releases a lock when the process that holds it ends, in whatever way. A folder whose lock is free
    therefore belongs to no running process. Folders without a lock file are not touched.
    """
    for lock in parent.glob(f"*/{LOCK}"):
        with suppress(OSError), lock.open("r") as file:  # another process holds the lock or has just removed it
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)


def swap(new: Path, current: Path, earlier: Path) -> None:
    """Put a new folder in the place of the current one; restore the current one on failure."""
    try:
        if current.exists():
            current.rename(earlier)
        new.rename(current)
    except BaseException:
        if earlier.exists() and not current.exists():
            earlier.rename(current)
        raise
