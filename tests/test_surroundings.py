"""Variables of the environment and places that must not change what runs, nor how figures look."""

import os
import shutil
import subprocess
import sys

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from book._tools import run
from book._tools.execute import NotebookError
from book._tools.project import Project

from .conftest import ROOT

LOAD = """import os, sys, warnings
import matplotlib.pyplot as plt
import numpy
from studies.kit.results import publish
from studies.kit.style import use_style
use_style()
warnings.warn("no error")
print(plt.rcParams["figure.figsize"], numpy.__name__, sys.flags.optimize, sys.flags.hash_randomization)"""
DRAW = """figure, _ = plt.subplots(figsize=(2, 2))
publish(figure, "square")"""
PRINTED = "[6.4, 4.8] numpy 0 0\n"


@pytest.fixture
def hostile(tmp_path):
    """Variables that servers, module systems and users set, each of which would change or end a run."""
    folder = tmp_path / "hostile"
    startup = folder / "ipython" / "profile_default" / "startup"
    startup.mkdir(parents=True)
    for file in (folder / "startup.py", startup / "first.py"):
        file.write_text("import os\nos._exit(3)")
    (folder / "numpy.py").write_text("raise SystemExit('another NumPy')")
    (folder / "matplotlibrc").write_text("figure.figsize: 1, 1")
    return {
        "IPYTHONDIR": str(folder / "ipython"),
        "LC_ALL": "xx_YY.UTF-8",
        "MATPLOTLIBRC": str(folder / "matplotlibrc"),
        "MPLBACKEND": "agg",
        "PYTHONHASHSEED": "7",
        "PYTHONHOME": str(folder),
        "PYTHONOPTIMIZE": "2",
        "PYTHONPATH": str(folder),
        "PYTHONSTARTUP": str(folder / "startup.py"),
        "PYTHONWARNINGS": "error",
    }


def write(project, *cells, outputs=()):
    project.notebooks.mkdir(parents=True, exist_ok=True)
    if not (project.notebooks / "studies").exists():
        (project.notebooks / "studies").symlink_to(ROOT / "notebooks" / "studies")
    content = [new_markdown_cell("# One"), *(new_code_cell(cell, outputs=list(outputs)) for cell in cells)]
    nbformat.write(new_notebook(cells=content), project.source("one"))


def test_a_run_shows_its_figures_whatever_surrounds_it(hostile, tmp_path, monkeypatch):
    project = Project(tmp_path / "Übung")
    write(project, LOAD, DRAW)
    for name, value in hostile.items():
        monkeypatch.setenv(name, value)
    assert run.run(project, lambda text: None) == ["one"]
    load, draw = nbformat.read(project.executed / "one.ipynb", 4).cells[1:]
    assert [output.text for output in load.outputs if output.get("name") == "stdout"] == [PRINTED]
    assert ["image/png" in output.data for output in draw.outputs] == [True]


def test_a_run_without_the_picture_of_a_figure_has_failed(tmp_path):
    project = Project(tmp_path)
    write(project, LOAD, f"plt.switch_backend('agg')\n{DRAW}")
    with pytest.raises(
        NotebookError, match=r"one.ipynb failed in cell 3 of 3(.|\n)*no picture of square: expected"
    ):
        run.run(project, lambda text: None)
    assert not project.executed.exists()


def test_nbval_does_not_depend_on_the_environment(hostile, tmp_path):
    """The pytest that starts it has begun before its variables can be removed: those of Python end it."""
    project = Project(tmp_path / "copy")
    printed = new_output("stream", text=PRINTED)
    write(project, LOAD.replace('warnings.warn("no error")', ""), outputs=[printed])
    notebook = nbformat.read(project.source("one"), 4)
    notebook.cells[1].execution_count = 1
    nbformat.write(notebook, project.source("one"))
    shutil.copy(ROOT / "notebooks" / "conftest.py", project.notebooks)
    later = {name: value for name, value in hostile.items() if name not in ("PYTHONHOME", "PYTHONPATH")}
    later["PYTHONWARNINGS"] = "ignore"
    command = [sys.executable, "-m", "pytest", "--nbval", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=project.notebooks, env=os.environ | later, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr


def test_a_command_ignores_the_variables_of_python(hostile):
    begun = {name: value for name, value in hostile.items() if name != "PYTHONHOME"}  # with it no Python starts
    command = [sys.executable, "-m", "book._tools", "rerun", "1", "--list"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | begun, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "n_pixels" in done.stdout


def test_make_passes_no_variable_on_that_changes_a_result(hostile, tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\nenv\n")
    python.chmod(0o755)
    command = ["make", "--silent", "--old-file=.venv/.ready", "figures"]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | hostile, capture_output=True, text=True)
    passed = dict(line.split("=", 1) for line in done.stdout.splitlines() if "=" in line)
    names = set(hostile) - {"IPYTHONDIR", "LC_ALL"}
    assert (names & passed.keys(), passed["PYTHONUTF8"], passed["LC_ALL"]) == (set(), "1", "C.UTF-8")
