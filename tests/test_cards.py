"""The cards under the figures, and their links."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from book._ext import cards
from book._tools.project import Project

ROOT = Path(__file__).parent.parent


def test_the_commit_is_that_of_this_folder_alone(tmp_path):
    def git(*command):
        names = ("-c", "user.name=Nobody", "-c", "user.email=nobody@example.org")
        return subprocess.run(["git", "-C", tmp_path, *names, *command], capture_output=True, check=True).stdout

    assert cards.commit(tmp_path) == "not known"
    git("init")
    git("commit", "--allow-empty", "--message", "First")
    head = git("rev-parse", "HEAD").decode()[:12]
    assert cards.commit(tmp_path) == f"`{head}`"
    # The commit does not hold all that the book is made from.
    (tmp_path / "new.ipynb").touch()
    assert cards.commit(tmp_path) == f"`{head}`, with changes"
    (tmp_path / "within").mkdir()
    assert cards.commit(tmp_path / "within") == "not known"


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("fig01_sensor_layout", "from studies import fig01_sensor_layout as s; from studies.kit import variants"),
        ("calibration", "from studies import calibration as s; assert len(s.Recording.read().frames) == 5"),
    ],
)
def test_a_notebook_is_downloaded_with_its_studies_and_their_data(tmp_path, name, code):
    folder, source = tmp_path / "unpacked", ROOT / "notebooks" / f"{name}.ipynb"
    archive = cards.archive(Project(ROOT), source)
    assert archive == cards.archive(Project(ROOT), source)
    (tmp_path / "one.zip").write_bytes(archive)
    shutil.unpack_archive(tmp_path / "one.zip", folder)
    assert (folder / source.name).read_bytes() == source.read_bytes()
    assert not (folder / "studies" / "fig09_bench_linearity.py").exists()
    assert bool(list(folder.rglob("*.npz"))) == (name == "calibration")
    run = [sys.executable, "-c", f"{code}; print(s.__file__)"]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).is_relative_to(tmp_path)
