"""A killed build of the book: nothing half-written replaces a result, and the next build gives the same bytes.

The next build is made in another folder: no byte depends on the place.
"""

import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from .conftest import ROOT, heed_signals, wait_until

NOT_COPIED = shutil.ignore_patterns(".*", "_build", "build", "__pycache__", "*.egg-info")
PAGES = ["notebooks/fig02_vector_sensor", "book/glossary"]
LARGE = [f"book._ext.{name}" for name in ("claims", "live", "performance")]  # need other pages


@pytest.fixture
def small_book(tmp_path):
    """A copy of the repository with a quick notebook and two pages."""
    root = Path(shutil.copytree(ROOT, tmp_path / "copy", ignore=NOT_COPIED, symlinks=True))
    for file in (*root.glob("notebooks/*.ipynb"), *root.glob("book/*.md")):
        if file.relative_to(root).with_suffix("").as_posix() not in PAGES:
            file.unlink()
    (root / "book" / "index.md").write_text("# A small book\n\nOne quick notebook.\n", "utf-8")
    toc = {"format": "jb-book", "root": "book/index", "chapters": [{"file": page} for page in PAGES]}
    (root / "_toc.yml").write_text(yaml.safe_dump(toc), "utf-8")
    config = yaml.safe_load((root / "_config.yml").read_text("utf-8"))
    sphinx = config["sphinx"]["config"]
    sphinx["extensions"] = [name for name in sphinx["extensions"] if name not in LARGE]
    sphinx["suppress_warnings"] = ["bibtex", "myst", "ref", "toc"]  # links to pages that are left out
    (root / "_config.yml").write_text(yaml.safe_dump(config), "utf-8")
    return root


def start(root):
    command = [sys.executable, "-m", "book._tools", "book"]
    place = {"cwd": root, "env": os.environ | {"PYTHONPATH": str(root)}, "start_new_session": True}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, preexec_fn=heed_signals, **place, **pipes)


def build(root):
    process = start(root)
    said = process.communicate()[0]
    assert process.returncode == 0, said


def results(root):
    """Bytes of the pages and of the notebooks; records hold the seconds of a run and are no result."""
    files = (file for part in ("html", "notebooks") for file in (root / "_build" / part).rglob("*"))
    contents = {file.relative_to(root).as_posix(): file.read_bytes() for file in files if file.is_file()}
    return {name: content for name, content in contents.items() if not name.endswith("sensor.json")}


def processes(root):
    """Processes that work in a folder."""
    ids = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            if Path(os.readlink(place / "cwd")).is_relative_to(root):
                ids.append(place.name)
    return ids


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_a_killed_build_leaves_the_earlier_book_and_the_next_one_gives_the_same_bytes(small_book):
    build(small_book)
    expected = results(small_book)
    page = small_book / "book" / "index.md"
    text = page.read_text("utf-8")
    for phase in ("running-*", "building-*/*/html/*.html"):
        page.write_text(f"{text}\nIt has changed.\n", "utf-8")
        if phase == "running-*":
            shutil.rmtree(small_book / "_build" / "notebooks")
        process = start(small_book)
        try:
            wait_until(lambda: any((small_book / "_build").glob(phase)) or process.poll() is not None, 600)  # noqa: B023
            assert process.poll() is None, process.communicate()[0]
        finally:
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
        wait_until(lambda: not processes(small_book), 60)
        pages = {name: content for name, content in expected.items() if "/html/" in name}
        assert {name: content for name, content in results(small_book).items() if "/html/" in name} == pages, phase
    page.write_text(text, "utf-8")
    moved = small_book.rename(small_book.with_name("another folder"))
    build(moved)
    assert results(moved) == expected
    assert not list((moved / "_build").glob("*ing-*"))
