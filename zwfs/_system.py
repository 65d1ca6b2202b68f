"""The machine: files that are written whole or not at all, and threads.

With one thread of BLAS, results do not depend on the number of cores.
"""

from __future__ import annotations

import os
import secrets
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from zwfs import _check

_LONGEST = 255  # bytes of the name of a file or a folder


def write_file(path: Path, content: bytes) -> None:
    """Write a file, and its folder if need be, in one step: whoever looks sees the old one or all of the new.

    Raises
    ------
    OSError
        With the name of the file, also where a disk is full.
    """
    _check.instance("path", path, Path)
    _check.instance("content", content, bytes)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with partial.open("xb") as file:
            file.write(content)
        os.replace(partial, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def path_of(name: str, value: Any) -> Path:
    """Path that the operating system accepts."""
    try:
        path = Path(value)
        longest = max((len(os.fsencode(part)) for part in path.parts), default=0)
        if value != "" and b"\0" not in os.fsencode(path) and longest <= _LONGEST:
            return path
    except TypeError:
        raise TypeError(f"{name} = {_check.shown(value)}: expected a str or a Path") from None
    except UnicodeEncodeError:
        pass
    raise ValueError(f"{name} = {_check.shown(str(value))}: expected the name of a file")


def paths_of(name: str, values: Any) -> list[Path]:
    """Paths that the operating system accepts, from a sequence of them."""
    _check.sequence(name, values, expected="a sequence of paths")
    return [path_of(f"{name}[{index}]", path) for index, path in enumerate(values)]


def is_there(path: Path) -> bool:
    """Whether there is anything under a path, a link that leads nowhere included."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def one_thread() -> AbstractContextManager[Any]:
    """Limit BLAS to one thread if threadpoolctl is installed."""
    if not find_spec("threadpoolctl"):
        return nullcontext()
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)
