"""Compare every installed file with the record of its package: the last step of the set-up."""

import csv
import hashlib
import sys
import sysconfig
from base64 import urlsafe_b64encode
from collections.abc import Iterator
from pathlib import Path

# Without the cache of uv, which may hold the same damage.
REPAIR = "rm -rf .venv && UV_NO_CACHE=1 make .venv/.ready"


def damaged(record: Path) -> Iterator[Path]:
    """Yield the files of a package that are missing or differ from its record; compiled files have no hash."""
    rows = list(csv.reader(record.read_text("utf-8").splitlines())) if record.is_file() else []
    if [f"{record.parent.name}/RECORD", "", ""] not in rows:  # it lists itself, too
        yield record
    for path, digest, _ in (row for row in rows if len(row) == 3):
        file = record.parents[1] / path
        if digest and not (file.is_file() and hash_of(file, digest) == digest):
            yield file


def hash_of(file: Path, digest: str) -> str:
    """Return the hash of a file in the form and with the algorithm of a given one, such as ``sha256=...``."""
    algorithm = digest.partition("=")[0]
    with file.open("rb") as stream:
        value = hashlib.file_digest(stream, algorithm).digest()
    return f"{algorithm}={urlsafe_b64encode(value).rstrip(b'=').decode()}"


packages = Path(sysconfig.get_path("purelib")).glob("*.dist-info")
if found := [file for package in packages for file in damaged(package / "RECORD")]:
    sys.exit(f"the environment is damaged ({len(found)} files, such as {found[0]}). To repair it: {REPAIR}")
