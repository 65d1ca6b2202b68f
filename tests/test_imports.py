"""The static import graph: what a notebook depends on, and that it never misses code that runs."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from IPython.core.inputtransformer2 import TransformerManager

from book._tools import record
from book._tools.imports import Graph
from book._tools.notebook import read
from book._tools.project import Project

ROOT = Path(__file__).parent.parent
REAL = Project(ROOT)

PACKAGE = {
    "__init__": "from typing import TYPE_CHECKING\nfrom pkg.a import f\nfrom pkg.b import same\n"
    "if TYPE_CHECKING:\n    from pkg import c as c\nhere = 1\n",
    "a": "from __future__ import annotations\nx = 1\ndef f(): from . import c; return c.y",
    "b": "def same(): 'See pkg.d:g and python -m pkg.d.'",
    "c": "y = 2",
    "d": "def g(): pass",
    "same": "",
    "act/__init__": "from pkg.act import quiet",
    "act/quiet": "z = 3",
    "run/__init__": "",
    "run/__main__": "from pkg.d import g",
}


@pytest.fixture
def project(tmp_path):
    for name, text in PACKAGE.items():
        file = tmp_path / "pkg" / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "own.py").write_text("import pkg.b as other")
    return Project(tmp_path)


def files(project, source, *texts):
    found = Graph(project.notebooks, project.root).files(source, texts)
    return {file.stem if "pkg" not in file.parts else module(project, file) for file in found}


def module(project, file):
    return file.relative_to(project.root / "pkg").with_suffix("").as_posix()


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import numpy as np", set()),
        ("from pkg.b import same", {"b"}),
        ("from pkg import f", {"a", "c"}),  # and what a function of its module imports
        ("import pkg\npkg.f()", {"a", "c"}),
        ("import pkg.b", {"b"}),
        ("def work():\n    from pkg import d\n    return d.g()", {"d"}),
        ("from pkg import same", {"b", "same"}),  # a function and a module of one name
        ("from pkg import act\nact.quiet.z", {"act/quiet"}),
        ("from pkg.act import *", {"act/__init__", "act/quiet"}),
        ("import pkg.a as m\ndef g():\n    import pkg.d as m", {"a", "c", "d"}),
        ("import own", {"own", "b"}),  # a file next to the notebook
        ("load('pkg.d:g')", {"d"}),
        ("import_module('pkg.c')", {"c"}),
        ("os.system('python -m pkg.run file')", {"run/__init__", "run/__main__", "d"}),
        ("'''pkg.d:g'''", set()),  # a text for readers
        ("from pkg import here", {"__init__", "a", "b", "c"}),
        ("import pkg\ngetattr(pkg, name)", {*PACKAGE}),
    ],
)
def test_what_code_depends_on(project, source, expected):
    assert files(project, source) == expected


def test_parameters_may_name_a_module(project):
    assert files(project, "", "own:Method", "pkg.c:y", "no.module:x", "pkg.b") == {"own", "b", "c"}


def test_a_module_that_acts_when_it_is_imported_counts_for_all(project):
    (project.root / "pkg" / "act" / "quiet.py").write_text("import pkg.d\nsetting['colour'] = pkg.d.g")
    assert files(project, "from pkg import b") == {"b", "act/quiet", "d"}


def test_an_init_that_imports_computed_names_counts_all_its_modules(project):
    (project.root / "pkg" / "act" / "__init__.py").write_text("one = import_module(f'{__name__}.quiet').z")
    assert files(project, "from pkg.act import one") == {"act/__init__", "act/quiet"}


def test_code_that_cannot_be_read_depends_on_the_whole_package(tmp_path):
    shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks", ignore=shutil.ignore_patterns("fig*", "*.toml"))
    shutil.copytree(ROOT / "zwfs", tmp_path / "zwfs", ignore=shutil.ignore_patterns("__pycache__"))
    project = Project(tmp_path)
    before = record.key(project, "bandwidth", {})
    (tmp_path / "zwfs" / "units.py").write_text("def (")
    broken = record.key(project, "bandwidth", {})
    (tmp_path / "zwfs" / "bench" / "model.py").write_text("")
    assert len({before, broken, record.key(project, "bandwidth", {})}) == 3


@pytest.mark.slow
def test_a_default_in_the_bench_concerns_only_the_notebooks_of_the_bench(tmp_path):
    for name in ("notebooks", "zwfs", "environment"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    project, names = Project(tmp_path), [path.stem for path in REAL.sources()]
    before = {name: record.key(project, name, {}) for name in names}
    model = tmp_path / "zwfs" / "bench" / "model.py"
    text = model.read_text()
    model.write_text(text.replace("blur: float = ", "blur: float = 1 + "))
    assert model.read_text() != text
    changed = {name for name in names if record.key(project, name, {}) != before[name]}
    bench = {"calibration", "error_budget", "own_frames"} | {name for name in names if "_bench" in name}
    assert bench <= changed
    assert changed <= bench | {name for name in names if name.startswith("fig") and name[3:5] not in ("03", "04")}
    model.write_text(text)
    assert {name: record.key(project, name, {}) for name in names} == before


TRACE = """
import importlib, json, os, pkgutil, sys, tempfile, zwfs
for module in pkgutil.walk_packages(zwfs.__path__, "zwfs."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
os.environ["ZWFS_RESULTS"] = tempfile.mkdtemp()
source, ran = sys.stdin.read(), set()
sys.setprofile(lambda frame, event, _: ran.add(frame.f_code.co_filename))
exec(compile(source, "notebook", "exec"), {"__name__": "__main__"})
sys.setprofile(None)
package = os.path.dirname(zwfs.__file__) + os.sep
print(json.dumps(sorted(file for file in ran if file.startswith(package))))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zernike_sensor", "fig06_reference"])
def test_no_file_that_runs_is_missed(name, tmp_path):
    """With all modules imported before, every function that a notebook calls lies in a file that it depends on."""
    cells = [cell.source for cell in read(REAL.source(name)).cells if cell.cell_type == "code"]
    code = "\n".join(TransformerManager().transform_cell(cell) for cell in cells)
    code = "\n".join(line for line in code.splitlines() if "get_ipython" not in line or line[:1] == " ")
    found = {str(file) for file in Graph(REAL.notebooks, ROOT).files(code)}
    done = subprocess.run(
        [sys.executable, "-c", TRACE], input=code, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    ran = {str(Path(file)) for file in json.loads(done.stdout.splitlines()[-1])}
    assert len(ran) > 5
    assert ran <= found
