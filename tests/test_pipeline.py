"""The commands of the book, on notebooks of a few lines."""

import json
import os
import re
import shutil
import subprocess
import sys

import joblib
import nbformat
import pytest
import yaml
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from book._tools import book, execute, record, run, scratch
from book._tools.__main__ import main
from book._tools.execute import NotebookError
from book._tools.project import Project
from tests.conftest import ROOT
from zwfs._system import write_file

ALL = {"first", "second", "third"}  # notebooks of the template


def write(project, name, *cells, parameters="n = 2  # pixels\nwidth = 1.5  # metre"):
    tagged = new_code_cell(parameters, metadata={"tags": ["parameters"]})
    content = new_notebook(cells=[new_markdown_cell(f"# {name}"), tagged, *map(new_code_cell, cells)])
    project.notebooks.mkdir(parents=True, exist_ok=True)
    nbformat.write(content, project.notebooks / f"{name}.ipynb")


def publish(name, text):
    """The source of a cell that publishes a file."""
    return f"import os, pathlib\n(pathlib.Path(os.environ['ZWFS_RESULTS']) / '{name}').write_text('{text}');"


def run_all(project):
    said = []
    return run.run(project, say=said.append), said


def results(project):
    return {file.name: file.read_bytes() for file in sorted(project.executed.glob("*.ipynb"))}


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A project whose three notebooks were run."""
    project = Project(tmp_path_factory.mktemp("template"))
    (project.root / "zwfs").mkdir()
    (project.root / "zwfs" / "__init__.py").write_text("gain = 1\n")
    noisy = "import sys, time\nfor i in range(3):\n    print(i, flush=True)\n    time.sleep(0.05)"
    picture = (
        "import matplotlib.pyplot as plt\nplt.rcParams['svg.hashsalt'] = 'fixed'\nplt.plot([1, 2])\nplt.show()"
    )
    write(project, "first", "def later():\n    import zwfs\n    return zwfs.gain", "print(n * width)", noisy)
    write(project, "second", "%config InlineBackend.figure_formats = ['svg']", picture, "{n}")
    write(project, "third", publish("numbers.csv", "1"))
    (project.root / "environment").mkdir()
    (project.root / "environment" / "requirements.lock").write_text("numpy==2\n")
    (project.root / "codecheck.yml").write_text("manifest:\n- file: notebooks/zero.ipynb\ncertificate: 2026-001\n")
    run_all(project)
    return project


@pytest.fixture
def ran(template, tmp_path):
    """A copy of that project, to be changed."""
    return Project(shutil.copytree(template.root, tmp_path / "copy"))


def test_two_runs_give_identical_bytes(ran):
    before = results(ran)
    shutil.rmtree(ran.executed)
    assert run_all(ran)[0]
    assert results(ran) == before
    assert len(before) == 3


def test_only_what_changed_runs_again(ran):
    for text in ("2", "3"):
        write(ran, "third", publish("numbers.csv", text))
        made, said = run_all(ran)
        assert (made, said[-1]) == (["third"], "notebooks: 1 run, 2 unchanged")
        assert ran.published("third")[0].read_text() == text
    (ran.executed / "first.ipynb").write_text("half of a noteb")
    assert run_all(ran)[0] == ["first"]


def test_the_start_says_how_long_the_longest_come_first_and_the_rest_is_said_now_and_then(ran, monkeypatch):
    (ran.root / "book" / "_tools").mkdir(parents=True)
    (ran.root / run.SECONDS).write_text(json.dumps({"second": 300, "third": 1}))
    shutil.rmtree(ran.executed)
    begun, said = [], []
    monkeypatch.setattr(run, "execute", lambda runs, finished, say: begun.extend(one.name for one in runs))
    monkeypatch.setattr(joblib, "cpu_count", lambda: 4)
    run.run(ran, said.append)
    assert begun == ["second", "first", "third"]
    assert said == ["running 3 of 3 notebooks, about 5 min on 4 free cores", "notebooks: 3 run, 0 unchanged"]
    monkeypatch.undo()
    monkeypatch.setattr(execute, "SILENCE", 0.3)
    (ran.root / run.SECONDS).write_text(json.dumps({"second": 300, "third": 1000, "first": 2}))
    assert any(re.fullmatch(r"[012]/3 notebooks: .*cell \d/\d.*", line) for line in run_all(ran)[1])
    assert all(0 < record.read_record(ran, name)["seconds"] < 60 for name in ALL)
    run.refresh(ran)
    stored = json.loads((ran.root / run.SECONDS).read_text())
    assert stored["third"] < 60


def test_refreshed_notebooks_are_current(ran, monkeypatch):
    monkeypatch.setattr(run, "FRONT_FIGURE", "third")
    picture = ran.executed / "third.files" / "third.png"
    write_file(picture, b"a picture")
    files = [f"notebooks/{name}.ipynb" for name in ("first", "second", "third")]
    assert run.refresh(ran) == [*files, "book/_static/front.png", "codecheck.yml", run.SECONDS]
    assert json.loads((ran.root / run.SECONDS).read_text()).keys() == ALL
    check = yaml.safe_load((ran.root / "codecheck.yml").read_text())
    assert [one["file"] for one in check["manifest"]] == [*files, "book/_static/front.png"]
    assert check["certificate"] == "2026-001"
    assert (ran.root / "book" / "_static" / "front.png").read_bytes() == b"a picture"
    assert run.refresh(ran) == []
    picture.unlink()
    assert run_all(ran)[0] == []


@pytest.mark.parametrize(
    ("change", "stale"),
    [
        (lambda p: (p.root / "zwfs" / "__init__.py").write_text("gain = 2\n"), {"first"}),
        (lambda p: (p.root / "environment" / "requirements.lock").write_text("numpy==3\n"), ALL),
        (lambda p: write(p, "first", "print(n)"), {"first"}),
        (lambda p: (p.executed / "first.ipynb").write_text("half of a noteb"), {"first"}),
        (lambda p: (p.executed / "first.json").unlink(), {"first"}),
        (lambda p: p.published("third")[0].unlink(), {"third"}),
        (lambda p: p.published("third")[0].write_text("2"), {"third"}),
    ],
)
def test_what_changed_is_stale(ran, change, stale):
    change(ran)
    keys = {name: record.key(ran, name) for name in ALL}
    assert {name for name in keys if record.read_record(ran, name).get("key") != keys[name]} == stale


def test_failure_is_named_and_leaves_earlier_results(ran):
    before = results(ran)
    write(ran, "first", publish("a.csv", "1"), "\nlight = 0\nraise ValueError('no light')", "print('never')")
    with pytest.raises(NotebookError) as caught:
        run_all(ran)
    message = str(caught.value)
    assert "notebooks/first.ipynb failed in cell 4 of 5" in message
    assert "the cell begins: light = 0" in message
    assert "parameters in force: n = 2, width = 1.5" in message
    assert message.endswith("ValueError: no light")
    assert results(ran) == before
    assert ran.published("first") == []
    assert sorted(os.listdir(ran.build)) == ["notebooks"]


@pytest.mark.slow
def test_dead_kernel_is_named(project):
    write(project, "dies", "import os\nos._exit(3)")
    with pytest.raises(NotebookError, match=r"notebooks/dies.ipynb failed in cell 3 of 3"):
        run_all(project)
    assert results(project) == {}


def test_second_command_waits_for_the_first(tmp_path):
    code = (
        "import pathlib; from book._tools.scratch import one_at_a_time\n"
        f"with one_at_a_time(pathlib.Path({str(tmp_path)!r})): print('has begun')"
    )
    with scratch.one_at_a_time(tmp_path):
        second = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=-1, stderr=-1, text=True)
        assert "waiting for its end" in second.stderr.readline()
        assert second.poll() is None
    assert second.communicate(timeout=20)[0] == "has begun\n"
    assert list(tmp_path.iterdir()) == []


def test_every_command_removes_the_scratch_folders_of_killed_ones(project, monkeypatch):
    killed = project.build / "rerunning-x"
    killed.mkdir(parents=True)
    (killed / scratch.LOCK).touch()
    monkeypatch.setattr(book, "book", lambda project: None)
    assert main(["book"], project) == 0
    assert list(project.build.iterdir()) == []


@pytest.mark.parametrize("content", ["[1]", '"x"', "1", "null", '{"result": 1}', "{"])
def test_damaged_record_is_no_record(ran, content):
    whole = json.loads((ran.executed / "first.json").read_text())
    for damaged in (content, json.dumps(whole | {"seconds": "x"}), json.dumps([whole])):
        (ran.executed / "first.json").write_text(damaged)
        assert record.read_record(ran, "first") == {}


@pytest.mark.slow
def test_result_of_a_notebook_that_was_edited_meanwhile_is_not_current(project):
    edit = "p.write_text(p.read_text().replace('# edited', '# later'))"
    write(project, "edited", f"import pathlib\np = pathlib.Path('edited.ipynb')\n{edit}")
    assert run_all(project)[0] == ["edited"]
    assert record.read_record(project, "edited")["key"] is None


@pytest.fixture
def small_book(ran):
    """A book of one page and one notebook."""
    (ran.root / "book").mkdir()
    (ran.root / "book" / "index.md").write_text("# A book\n\n$a = b$, {doc}`/notebooks/first`\n")
    (ran.root / "_toc.yml").write_text(
        "format: jb-book\nroot: book/index\nchapters:\n"
        + "".join(f"- file: notebooks/{name}\n" for name in ("first", "second", "third"))
    )
    (ran.root / "_config.yml").write_text(
        "title: small\nexclude_patterns: [_build]\nexecute:\n  execute_notebooks: 'off'\n"
        f"sphinx:\n  local_extensions:\n    book._ext.cards: {ROOT}\n"
    )
    return ran


def test_the_book_shows_runs_and_offers_their_files_and_links_must_work(small_book):
    shown = "from IPython.display import SVG\ndef publish(*_): return SVG('<svg/>')\npublish(None, 'numbers', {})"
    write(small_book, "first", shown, publish("numbers.csv", "2"))
    run_all(small_book)
    index = small_book.root / "book" / "index.md"
    index.write_text("# A book\n\n{download}`data <../_build/notebooks/third.files/numbers.csv>`\n")
    assert book.build(small_book)
    html = small_book.build / "html"
    assert {file.read_text() for file in (html / "_downloads").rglob("numbers.csv")} == {"1", "2"}
    # The source has no outputs: those of the page come from the run.
    assert "<svg" in (html / "notebooks" / "second.html").read_text("utf-8") or list(html.rglob("_images/*.svg"))
    index.write_text("# A book\n\n{doc}`nowhere` {download}`data <../_build/notebooks/third.files/missing.csv>`\n")
    (small_book.root / "book" / "new.md").write_text("# New\n")
    with pytest.raises(book.BookError) as caught:
        book.build(small_book)
    assert "book/index.md:3: WARNING: unknown document" in str(caught.value)
    assert "book/new.md: WARNING: document isn't included in any toctree" in str(caught.value)
    assert "missing.csv" in str(caught.value)


# In place of Jupyter Book: it copies the front page, or fails with a warning.
FAKE = f"""#!{sys.executable}
import pathlib, sys
index = pathlib.Path("book/index.md").read_text()
if "nowhere" in index:
    sys.exit("book/index.md:3: WARNING: unknown document")
output = pathlib.Path(sys.argv[sys.argv.index("--path-output") + 1], "_build", "html")
output.mkdir(parents=True)
(output / "index.html").write_text(index)
"""


@pytest.fixture
def fake_book(small_book, monkeypatch, tmp_path):
    program = tmp_path / "jupyter-book"
    program.write_text(FAKE)
    program.chmod(0o755)
    monkeypatch.setattr(book, "JUPYTER_BOOK", program)
    return small_book


def test_book_is_built_once_and_after_each_change_and_a_failure_keeps_it(fake_book):
    index = fake_book.root / "book" / "index.md"
    before = index.read_text()
    assert book.build(fake_book)
    assert not book.build(fake_book)
    index.write_text("{doc}`nowhere`")
    with pytest.raises(book.BookError, match=r"book/index.md:3: WARNING: unknown document"):
        book.build(fake_book)
    assert (fake_book.build / "html" / "index.html").read_text() == before
    assert sorted(os.listdir(fake_book.build)) == ["html", "notebooks"]
    # The pages are built again even if the change is undone: they may lack a part.
    index.write_text(before)
    assert book.build(fake_book)
    for change in (
        lambda: index.write_text("# Another\n"),
        lambda: (fake_book.executed / "first.ipynb").write_text("another run"),
        lambda: write(fake_book, "first", "another"),
    ):
        change()
        assert book.build(fake_book)
