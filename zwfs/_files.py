"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from zwfs import _check


def write_file(path: Path, content: bytes) -> None:
    """Write a file, and its folder if need be, in one step: whoever looks sees the old one or all of the new."""
    _check.instance("path", path, Path)
    _check.instance("content", content, bytes)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
