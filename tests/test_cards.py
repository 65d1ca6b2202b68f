"""The cards under the figures, and their links."""

import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from book._ext import cards
from book._tools.project import Project

ROOT = Path(__file__).parent.parent


@pytest.fixture
def carded():
    """Writes a notebook of code cells, the first with the parameters, and returns its cells with cards."""

    def make(name, *sources, links=(), versions="not recorded", commit="not known"):
        cells = [nbformat.v4.new_code_cell(source) for source in sources]
        cells[0].metadata["tags"] = ["parameters"]
        kernel = {"name": "python3", "language": "python", "display_name": "Python 3"}
        notebook = nbformat.v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})
        cards.add_cards(notebook, name, dict(links), versions, commit)
        return notebook.cells

    return make


def test_a_card_says_how_a_figure_was_made(carded):
    cells = carded(
        "fig03_range",
        "rms = 0.5  # input, rad rms\nseed = 3",
        'publish(figure, "fig03_range")',
        "x = 1",
        links={"fig03_range.png": "../run/fig03_range.png"},
        versions="Python 3.12.1",
        commit="`abc`",
    )
    assert [cell.cell_type for cell in cells] == ["code", "code", "markdown", "code", "markdown"]
    assert all(text in cells[-1].source for text in ("`abc`", "Python 3.12.1"))
    said = ["<../run/fig03_range.png>", 'href="../_downloads/fig03_range.zip"']
    said += ['<div class="run-form" data-figure="fig03_range">']
    assert not [text for text in said if text not in cells[2].source]
    assert "CSV" not in cells[2].source, "there is no such file"


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
