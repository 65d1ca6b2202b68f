"""Records of results: what a result was made from, and whether it is current."""

import hashlib
import json
import platform
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from . import notebook
from .project import Project

# The modules that the content of an executed notebook depends on.
RUNNER = [Path(__file__).with_name(name) for name in ("environment.py", "execute.py", "notebook.py")]


def digest(parts: Iterable[bytes]) -> str:
    """Return the sha256 of several byte strings; the place of their boundaries counts."""
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def digest_files(files: dict[str, Path]) -> str:
    """Return the sha256 of the names and the contents of files."""
    return digest(part for name in sorted(files) for part in (name.encode(), files[name].read_bytes()))


def key(project: Project, name: str) -> str:
    """Return a digest of everything that the result of a notebook with its defaults depends on."""
    cells = notebook.read(project.source(name)).cells
    inputs = [*project.depends_on(name), project.lock]
    files = {str(file.relative_to(project.root)): file for file in inputs if file.exists()}
    files |= {f"runner {file.name}": file for file in RUNNER}
    content = [[cell.cell_type, cell.source, cell.metadata] for cell in cells]
    own = [list(sys.version_info[:2]), content]
    return digest([json.dumps(own, sort_keys=True).encode(), digest_files(files).encode()])


def digest_result(executed: bytes, files: list[Path]) -> str:
    """Return a digest of an executed notebook and of the files that it published."""
    return digest([executed, digest_files({file.name: file for file in files}).encode()])


def read_record(project: Project, name: str) -> dict[str, Any]:
    """Return the record of the last run of a notebook; empty if its result is not whole."""
    result = project.executed / f"{name}.ipynb"
    try:
        record = json.loads(result.with_suffix(".json").read_bytes())
        content = digest_result(result.read_bytes(), project.published(name))
        return record if record["result"] == content and record["seconds"] >= 0 else {}
    except (OSError, ValueError, KeyError, TypeError):  # TypeError: it is JSON of another kind
        return {}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide what a notebook shows."""
    packages = {"NumPy": "numpy", "SciPy": "scipy", "Matplotlib": "matplotlib", "zwfs": "zwfs"}
    return {"Python": platform.python_version()} | {name: metadata.version(p) for name, p in packages.items()}


def commit(root: Path) -> tuple[str | None, bool | None]:
    """Return the commit of a working tree, and whether the tree has changes; None without a history.

    An untracked file is a change, too: it may be a notebook, or a module that a notebook imports.
    """

    def git(*command: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *command], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    with suppress(OSError, subprocess.CalledProcessError):
        # A copy without a history may lie within another repository.
        if Path(git("rev-parse", "--show-toplevel")) == root.resolve():
            return git("rev-parse", "HEAD"), bool(git("status", "--porcelain"))
    return None, None
