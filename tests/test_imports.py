"""What a notebook depends on, as `make book` computes it."""

import ast
import json
import os
import re
import subprocess
import sys

import pytest
from nbformat.v4 import new_code_cell, new_notebook, writes

from book._tools import imports, record
from book._tools.project import Project

from .conftest import ROOT

BOOK = Project(ROOT)
NAMES = [path.stem for path in BOOK.sources()]
# Together they load most of the package.
TRIED = ("calibration", "decision", "fig03_dynamic_range", "bench", "own_frames", "reconstructors")
# Runs the imports of each notebook in a separate process, which has already imported Matplotlib and SciPy.
LOADED = """
import json, os, sys
import matplotlib.pyplot, scipy.fft, scipy.linalg, scipy.ndimage, scipy.optimize, scipy.special
for name, code in json.load(sys.stdin).items():
    if child := os.fork():
        os.waitpid(child, 0)
    else:
        exec(code, {})
        files = [getattr(module, "__file__", None) or "" for module in sys.modules.values()]
        print(json.dumps([name, files]), flush=True)
        os._exit(0)
"""


def imports_of(notebook):
    """Return the imports of a notebook, and its uses of the package as a whole."""
    tree = ast.parse(imports.code_of(notebook))
    lines = [ast.unparse(node) for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    return "\n".join([*lines, *filter(re.compile(r"zwfs[.\w]+").fullmatch, map(ast.unparse, used))])


@pytest.fixture(scope="module")
def needs():
    """Files that each notebook of the book depends on."""
    return {name: BOOK.depends_on(name) for name in NAMES}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_what_a_notebook_loads_is_among_what_it_depends_on(needs):
    code = {name: imports_of(BOOK.source(name)) for name in TRIED}
    where = {"cwd": BOOK.notebooks, "input": json.dumps(code), "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", LOADED], **where)
    loaded = dict(map(json.loads, done.stdout.splitlines()))
    assert loaded.keys() == code.keys(), done.stderr
    own = {str(file) for file in BOOK.modules()}
    for name, files in loaded.items():
        assert own & set(files) <= set(map(str, needs[name])), name
        assert len(own & set(files)) > 10, name


@pytest.mark.parametrize(
    ("changed", "count"),
    [
        ("zwfs/frames/__main__.py", 0),
        ("notebooks/studies/design.py", 1),
        ("notebooks/studies/kit/style.py", len(NAMES)),
        ("zwfs/sensor.py", len(NAMES)),
    ],
)
def test_an_edit_runs_the_notebooks_that_import_the_file(needs, changed, count):
    assert sum(ROOT / changed in files for files in needs.values()) == count


FILES = {
    "zwfs/__init__.py": """
from typing import TYPE_CHECKING
from zwfs import _lazy
if TYPE_CHECKING:
    from zwfs.pupil import Pupil
    from zwfs.frames import judge
else:
    __getattr__, __dir__ = _lazy.offer(__name__)
""",
    "zwfs/_lazy.py": "",
    "zwfs/pupil.py": "class Pupil: pass",
    "zwfs/sensor.py": "def read():\n    import zwfs.frames.files as files\n    return files.read()",
    "zwfs/frames/__init__.py": "",
    "zwfs/frames/files.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import zwfs.sensor",
    "notebooks/studies/__init__.py": "",
    "notebooks/studies/one.py": "from pathlib import Path\nfrom zwfs.pupil import Pupil\ntable = 'shared.csv'",
    "notebooks/studies/one.npz": "",
    "notebooks/studies/shared.csv": "",
    "notebooks/own.py": "",
}
INIT = {"zwfs/__init__.py", "zwfs/_lazy.py"}
PUPIL = INIT | {"zwfs/pupil.py"}
FILES_OF_FRAMES = INIT | {"zwfs/frames/__init__.py", "zwfs/frames/files.py"}


@pytest.fixture
def small(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return Project(tmp_path)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["import numpy"], set()),
        (["from zwfs import Pupil"], PUPIL),
        (["import zwfs as z", "print(z.Pupil)"], PUPIL),  # used in another cell
        (["import zwfs\nzwfs.__version__"], INIT),
        (["from zwfs.sensor import read"], FILES_OF_FRAMES | {"zwfs/sensor.py"}),
        (
            ["def late():\n    from studies import one as study"],
            PUPIL | {f"notebooks/studies/{name}" for name in ("__init__.py", "one.py", "one.npz", "shared.csv")},
        ),
        (["%matplotlib inline\nif colab:\n    !pip install zwfs"], set()),
    ],
)
def test_imports_of_every_kind_are_followed_and_an_edit_of_such_a_file_changes_the_key(small, cells, expected):
    notebook = new_notebook(cells=[new_code_cell(cell) for cell in cells])
    small.source("chapter").write_text(writes(notebook))
    needed = {file.relative_to(small.root).as_posix() for file in small.depends_on("chapter")}
    assert needed == expected
    before = record.key(small, "chapter")
    for name, text in FILES.items():
        (small.root / name).write_text(f"{text}\n# changed")
        assert (record.key(small, "chapter") != before) == (name in expected), name
        (small.root / name).write_text(text)
    assert record.key(small, "chapter") == before
