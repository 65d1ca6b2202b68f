"""The examples that CONTRIBUTING names, added to copies of the repository: a figure and a reconstructor."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys

import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from book._tools.project import Project
from book._tools.run import manifest
from studies.kit.tables import two_digits

from .conftest import EXAMPLES, ROOT

FOLDERS = ("book", "environment", "notebooks", "tests", "zwfs")


@pytest.fixture
def copy(tmp_path):
    """A copy of the repository, without results."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.png"))
    for file in (*ROOT.glob("*.toml"), *ROOT.glob("*.yml"), ROOT / "CITATION.cff"):
        shutil.copy(file, tmp_path)
    return Project(tmp_path)


def run(project, *command):
    """Run Python in a copy, with the modules of the copy."""
    path = os.pathsep.join(str(project.root / name) for name in ("", "notebooks", "book/_ext"))
    place = {"cwd": project.root, "env": os.environ | {"PYTHONPATH": path}}
    done = subprocess.run([sys.executable, *command], **place, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    return done.stdout


def cells(text):
    """Cells of a notebook that is written with ``# %%``."""
    for cell in re.split(r"^# %%", text, flags=re.M)[1:]:
        head, source = cell.split("\n", 1)
        source = source.strip("\n")
        if "[markdown]" in head:
            yield new_markdown_cell(re.sub("^# ?", "", source, flags=re.M))
        else:
            tags = json.loads(head.partition("tags=")[2] or "[]")
            yield new_code_cell(source, metadata={"tags": tags})


@pytest.mark.slow
def test_a_new_figure_is_a_study_a_notebook_and_a_line(copy):
    shutil.copy(EXAMPLES / "strehl_loss.py", copy.notebooks / "studies")
    written = (EXAMPLES / "strehl_loss_cells.py").read_text("utf-8")
    nbformat.write(new_notebook(cells=[*cells(written)]), copy.source("strehl_loss"))
    contents = copy.root / "_toc.yml"
    place = "      - file: notebooks/fig04_dimple_diameter\n"
    contents.write_text(contents.read_text().replace(place, f"      - file: notebooks/strehl_loss\n{place}"))
    # `make figures` lists it for checkers.
    assert b"- file: notebooks/strehl_loss.ipynb\n  comment: How fast does the Strehl" in manifest(copy)
    run(copy, "-m", "book._tools", "rerun", "strehl_loss", "-p", "n_screens=2", "--output", "result")
    result = copy.root / "result"
    table = list(csv.DictReader((result / "strehl_loss.csv").read_text().splitlines()))
    lowest = float(table[-1]["Strehl ratio"])
    assert lowest == pytest.approx(np.exp(-1), abs=0.1)
    assert (result / "strehl_loss.png").exists()
    text = re.sub("<[^>]*>", "", (result / "strehl_loss.html").read_text())
    assert f"At 1 rad rms, the Strehl ratio is {two_digits(lowest)}." in text
    for folder in ("notebooks/studies", "notebooks/strehl_loss.ipynb"):
        run(copy, "-m", "ruff", "check", folder)
        run(copy, "-m", "ruff", "format", "--check", folder)


@pytest.mark.slow
def test_a_new_reconstructor_is_a_file_and_an_entry(copy):
    """It is in Figure 3, on the API page, and passes all tests of reconstructors."""
    path = "zwfs/reconstructors/wirtinger_flow.py"
    shutil.copy(EXAMPLES / "wirtinger_flow.py", copy.root / path)
    with (copy.root / "zwfs/reconstructors/_list.py").open("a") as listed:
        listed.write("\nfrom zwfs.reconstructors.wirtinger_flow import WirtingerFlow\n")
        listed.write("RECONSTRUCTORS = tuple(dict.fromkeys((*RECONSTRUCTORS, WirtingerFlow)))\n")
    run(copy, "-c", FIGURE_3)
    tested = [f"tests/test_{name}.py" for name in ("reconstructors", "bad_input", "figures", "sensor")]
    options = "-q", "-n", "0", "-p", "no:cacheprovider", "-k", "WirtingerFlow or look or can_be_changed"
    passed = run(copy, "-m", "pytest", *options, *tested)
    assert int(re.search(r"(\d+) passed", passed)[1]) > 20
    run(copy, "-m", "ruff", "check", path)
    run(copy, "-m", "ruff", "format", "--check", path)


FIGURE_3 = """
import api, numpy as np, zwfs
from studies.fig03_dynamic_range import draw_linearity
from studies.kit.experiments import linearity_curves
from studies.kit.methods import own_reconstructors, paper_reconstructors
from studies.kit.style import LOOKS
from zwfs.reconstructors import RECONSTRUCTORS
from zwfs.reconstructors.wirtinger_flow import WirtingerFlow
pupil = zwfs.Pupil.circular(40)
modes = zwfs.zernike_basis(pupil, 30)
methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2, n_iterations=30)
methods |= own_reconstructors([], methods, modes)
assert type(methods["WirtingerFlow"]) is WirtingerFlow and methods["WirtingerFlow"].settings.n_iterations == 30
assert own_reconstructors(["zwfs:WirtingerFlow"], methods, modes).keys() == {"WirtingerFlow"}
curves = linearity_curves(methods, modes, [0.3], 2)
assert curves.mean("WirtingerFlow")[0] < 0.01
draw_linearity(curves, 0.05, 0.3)
assert WirtingerFlow in RECONSTRUCTORS and WirtingerFlow.__module__ in api.modules()
assert LOOKS["WirtingerFlow"].label == "wirtinger flow"
"""


def test_contributing_is_short_and_names_files_that_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    assert len(text.splitlines()) <= 200
    named = re.findall(r"`((?:book|environment|notebooks|tests|zwfs)/[\w./-]+)`", text)
    assert len(named) > 20
    assert [name for name in named if not (ROOT / name).exists() and "NAME" not in name] == []
