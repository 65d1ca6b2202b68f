"""Faults that a build of the book must survive: `make torture`, or `python -m tests.torture umask kills` for two.

They test the promise of `book/_tools/scratch.py`: whatever ends a build, nothing half-written replaces a result,
and the next build gives the same bytes as an undisturbed one. Every case builds a small book, two quick notebooks
and two pages, in a copy of the repository without its history. The variable KILLS is the number of kills.
"""

from __future__ import annotations

import hashlib
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path

import yaml

from .conftest import heed_signals
from .mutants import NOT_COPIED, ROOT

SEED = 16
PATIENCE = 1800  # seconds for one build
PAGES = ["notebooks/at_a_glance", "notebooks/fig02_vector_sensor", "book/glossary"]
LARGE = [f"book._ext.{name}" for name in ("claims", "explore", "live", "performance")]  # need other pages
BUILD = [sys.executable, "-m", "book._tools", "book"]
MEGABYTE = 2**20


class FaultError(Exception):
    """Defect that a case shows."""


class ImpossibleError(Exception):
    """Reason why a case cannot be tried on this machine."""


def reduce(root: Path) -> Path:
    """Turn a copy of the repository into a small book."""
    for file in (*root.glob("notebooks/*.ipynb"), *root.glob("book/*.md")):
        if file.relative_to(root).with_suffix("").as_posix() not in PAGES:
            file.unlink()
    (root / "book" / "index.md").write_text("# A small book\n\nTwo quick notebooks.\n", "utf-8")
    toc = {"format": "jb-book", "root": "book/index", "chapters": [{"file": page} for page in PAGES]}
    (root / "_toc.yml").write_text(yaml.safe_dump(toc), "utf-8")
    config = yaml.safe_load((root / "_config.yml").read_text("utf-8"))
    sphinx = config["sphinx"]["config"]
    sphinx["extensions"] = [name for name in sphinx["extensions"] if name not in LARGE]
    sphinx["suppress_warnings"] = ["bibtex", "myst", "ref", "toc"]  # links to pages that are left out
    (root / "_config.yml").write_text(yaml.safe_dump(config), "utf-8")
    return root


def small_book(folder: Path) -> Path:
    """Copy the repository to a folder and reduce it."""
    shutil.copytree(ROOT, folder, ignore=NOT_COPIED, symlinks=True)
    return reduce(folder)


@contextmanager
def building(
    root: Path, command: list[str] = BUILD, prepare: Callable[[], object] = heed_signals, **variables: str
) -> Iterator[tuple[subprocess.Popen[str], Callable[[], str]]]:
    """Start a build in a group of processes, which ends with the block; give it and a function for its output."""
    place = {} if command[0] == "make" else {"PYTHONPATH": str(root)}  # make installs the package
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONDONTWRITEBYTECODE", "MAKEFLAGS")}
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(
            command, cwd=root, env=environment | place | variables, text=True,
            stdout=log, stderr=log, start_new_session=True, preexec_fn=prepare,
        )  # fmt: skip
        try:
            yield process, lambda: log.seek(0) * 0 or log.read()
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def build(root: Path, *arguments: object, status: int = 0, **variables: str) -> str:
    """Build to the end and return the output; fail on another exit status."""
    with building(root, *arguments, **variables) as (process, output):
        if process.wait(PATIENCE) != status:
            raise FaultError(f"exit status {process.returncode}, expected {status}: {output()[-1000:]}")
        return output()


def files(folder: Path) -> dict[str, str]:
    """Return a digest of each file, by name; records hold the seconds of a run and count as no result."""
    every = {file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("*")) if file.is_file()}
    results = {name: file for name, file in every.items() if Path(name).parent != Path() or "json" not in name}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in results.items()}


def results(root: Path) -> dict[str, dict[str, str]]:
    return {name: files(root / "_build" / name) for name in ("html", "notebooks")}


@cache
def undisturbed(folder: Path) -> tuple[dict[str, dict[str, str]], float]:
    """Results of a build that nobody disturbs, and its seconds with compiled modules."""
    root = small_book(folder / "undisturbed")
    build(root)
    expected = results(root)
    shutil.rmtree(root / "_build")
    begin = time.monotonic()
    build(root)
    if results(root) != expected:
        raise FaultError("two undisturbed builds differ")
    return expected, time.monotonic() - begin


def compare(root: Path, folder: Path) -> None:
    """Require the bytes of an undisturbed build, and nothing else in the folder of results."""
    for part, expected in undisturbed(folder)[0].items():
        got = results(root)[part]
        if wrong := sorted(name for name in expected.keys() | got if expected.get(name) != got.get(name)):
            raise FaultError(f"_build/{part} differs in {len(wrong)} files: {', '.join(wrong[:5])}")
    if rest := scratch(root):
        raise FaultError(f"unfinished results stayed: {rest}")


def scratch(root: Path) -> list[str]:
    return [path.name for path in (root / "_build").glob("*ing-*")]


def processes(root: Path) -> list[str]:
    """Return the processes that work in a folder."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            if Path(os.readlink(place / "cwd")).is_relative_to(root):
                found.append((place / "cmdline").read_text().replace("\0", " ")[:120])
    return found


def kills(folder: Path) -> str:
    (expected, seconds), root = undisturbed(folder), small_book(folder / "kills")
    asked, draw, hit = int(os.environ.get("KILLS") or 20), random.Random(SEED), 0
    signals, completed = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL), 0
    while hit < asked:
        earlier, number = set(scratch(root)), signals[hit % len(signals)]
        with building(root) as (process, output):
            try:
                process.wait(draw.uniform(0.02, 1) * seconds)
            except subprocess.TimeoutExpired:
                # A terminal sends Ctrl-C to all processes, another program ends this one only.
                (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
                process.wait(PATIENCE)
                hit, said = hit + 1, output()
                where = f"kill {hit}, {number.name}"
                pieces = set() if number == signal.SIGKILL else set(scratch(root)) - earlier
                if "Traceback" in said or pieces:
                    raise FaultError(f"{where}: {pieces or ''} {said[-1000:]}") from None
        if (root / "_build" / "html").exists() and files(root / "_build" / "html") != expected["html"]:
            raise FaultError(f"{where}: _build/html is not whole")
        if process.returncode == 0:  # begin again, so that later kills hit the notebooks, too
            compare(root, folder)
            completed += 1
            shutil.rmtree(root / "_build")
    build(root)
    compare(root, folder)
    end = time.monotonic() + 60
    while (left := processes(root)) and time.monotonic() < end:
        time.sleep(1)
    if left:
        raise FaultError(f"processes stayed: {left}")
    return f"{hit} kills, {completed + 1} builds completed between and after them"


def full_disk(folder: Path) -> str:
    root = small_book(folder / "disk")
    place = root / "_build"
    place.mkdir()
    sizes = [1, 4, 16]  # fails in the notebooks, in Sphinx, and at its end
    mounted = not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1g", "none", place], capture_output=True
    ).returncode
    try:
        for size in sizes if mounted else (0.02, 0.5):
            limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (int(size * MEGABYTE),) * 2)
            if mounted:
                subprocess.run(["mount", "-o", f"remount,size={size}m", place], check=True)
            said = build(root, BUILD, heed_signals if mounted else limit, status=1)
            if ("No space left" if mounted else "File too large") not in said or len(said.splitlines()) > 30:
                raise FaultError(f"{size} MB: no clear message: {said[-3000:]}")
            if scratch(root) or (place / "html").exists():
                raise FaultError(f"{size} MB: unfinished results stayed")
        if mounted:
            subprocess.run(["mount", "-o", "remount,size=1g", place], check=True)
        build(root)
        compare(root, folder)
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", place], check=True)
    return f"tmpfs of {sizes} MB" if mounted else "ulimit -f, because mounting is not permitted here"


def two_builds(folder: Path) -> str:
    root = small_book(folder / "two")
    with building(root) as (one, output), building(root) as (other, other_output):
        statuses = [process.wait(PATIENCE) for process in (one, other)]
        said = output() + other_output()
    if any(statuses) or said.count("waiting for its end") != 1:
        raise FaultError(f"exit statuses {statuses}, expected one build that waits: {said[-1000:]}")
    compare(root, folder)
    return "the second waits"


def umask(folder: Path) -> str:
    root = small_book(folder / "umask")
    build(root, BUILD, partial(os.umask, 0o077))
    compare(root, folder)
    return "077"


def odd_path(folder: Path) -> str:
    root = small_book(folder / "straße mit Leerzeichen 光")
    build(root, ["make", "book", f"PYTHON={sys._base_executable}"])
    compare(root, folder)
    return "make book, set-up included"


def tarball(folder: Path) -> str:
    if not (ROOT / ".git").exists():
        raise ImpossibleError("no history to archive")
    archive = folder / "zwfs.tar"
    subprocess.run(["git", "-C", ROOT, "archive", "--output", archive, "HEAD"], check=True)
    shutil.unpack_archive(archive, folder / "tarball", filter="data")
    build(reduce(folder / "tarball"))
    compare(folder / "tarball", folder)
    return "git archive HEAD"


def no_network(folder: Path) -> str:
    root = small_book(folder / "network")
    isolated = ["unshare", "--map-root-user", "--net", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    if permitted := not subprocess.run([*isolated, "true"], capture_output=True).returncode:
        build(root, [*isolated, *BUILD])
    else:
        build(root, http_proxy="http://127.0.0.1:9", https_proxy="http://127.0.0.1:9")
    compare(root, folder)
    return "unshare --net" if permitted else "a dead proxy only, because unshare --net is not permitted here"


CASES = {case.__name__: case for case in (two_builds, full_disk, umask, tarball, no_network, odd_path, kills)}


def main(names: list[str]) -> int:
    """Try some cases, or all; return 1 if one failed."""
    if unknown := set(names) - CASES.keys():
        raise SystemExit(f"torture: {', '.join(sorted(unknown))}: expected some of {', '.join(CASES)}")
    failures = 0
    with tempfile.TemporaryDirectory() as name:
        for case in names or CASES:
            begin = time.monotonic()
            try:
                said = f"passed ({CASES[case](Path(name).resolve())})"
            except ImpossibleError as reason:
                said = f"not possible here ({reason})"
            except (FaultError, OSError, subprocess.SubprocessError) as reason:
                said, failures = f"failed ({reason})", failures + 1
            print(f"{case}: {said}, {time.monotonic() - begin:.0f} s", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
