"""The pipeline, on notebooks of a few lines in folders of their own."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import build
import nbformat
import pages
import pytest
import runner
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from PIL import Image
from runner import NotebookError, Project

from zwfs._files import write_file

BOOK = Path(runner.__file__).parent


def write(project, name, *cells, parameters="n = 2  # pixels\nwidth = 1.5  # metre"):
    tagged = new_code_cell(parameters, metadata={"tags": ["parameters"]})
    notebook = new_notebook(cells=[new_markdown_cell(f"# {name}"), tagged, *map(new_code_cell, cells)])
    project.notebooks.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, project.notebooks / f"{name}.ipynb")


def leave(name, text):
    """Write a cell that leaves a file among the results."""
    return f"import os, pathlib\n(pathlib.Path(os.environ['ZWFS_RESULTS']) / '{name}').write_text('{text}');"


def png_of(value):
    file = io.BytesIO()
    Image.new("RGB", (40, 30), (value, value, value)).save(file, "png")
    return file.getvalue()


def run(project, **options):
    said = []
    return runner.run(project, say=said.append, **options), said


def results(project):
    return {file.name: file.read_bytes() for file in sorted(project.executed.glob("*.ipynb"))}


def printed(project, name):
    notebook = runner.read(project.executed / f"{name}.ipynb")
    return "".join(o.text for c in notebook.cells if c.cell_type == "code" for o in c.outputs if "text" in o)


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
    write(project, "first", "print(n * width)", noisy)
    write(project, "second", "%config InlineBackend.figure_formats = ['svg']", picture, "{n}")
    write(project, "third", leave("numbers.csv", "1"))
    (project.root / "environment").mkdir()
    (project.root / "environment" / "requirements.lock").write_text("numpy==2\n")
    run(project)
    return project


@pytest.fixture
def ran(template, tmp_path):
    """A copy of that project, to be changed."""
    return Project(shutil.copytree(template.root, tmp_path / "copy"))


def test_two_runs_give_identical_bytes(ran):
    before = results(ran)
    shutil.rmtree(ran.executed)
    assert run(ran)[0]
    assert results(ran) == before
    assert len(before) == 3


def test_unchanged_notebooks_are_not_run_again(ran):
    assert run(ran) == ([], ["notebooks: 0 run, 3 unchanged"])


def test_refreshed_notebooks_are_current_and_agree(ran):
    names = [f"notebooks/{name}.ipynb" for name in ("first", "second", "third")]
    assert build.refresh(ran) == names
    assert build.refresh(ran) == []
    assert run(ran)[0] == []
    assert build.check_notebook(ran, "first") == build.check_notebook(ran, "second") == []


def test_front_figure_is_refreshed_and_checked(ran, monkeypatch):
    picture = ran.executed / "third.files" / "third.png"
    write_file(picture, png_of(255))
    monkeypatch.setattr(build, "FRONT_FIGURE", "third")
    assert build.check_front(ran) == ["book/_static/front.png is not there: make figures"]
    assert "book/_static/front.png" in build.refresh(ran)
    assert build.check_front(ran) == []
    write_file(picture, png_of(250))
    assert build.check_front(ran) == [
        "book/_static/front.png: the pictures differ by 4.33 of 255 rms, and 0.5 is allowed"
    ]


def test_committed_notebook_without_outputs_is_refused(ran):
    found = build.check_notebook(ran, "first")
    assert "notebooks/first.ipynb: no cell has any output" in found
    assert "notebooks/first.ipynb: cell 2 was never run: it has no execution count" in found


@pytest.mark.parametrize(
    ("change", "stale"),
    [
        (lambda p: (p.root / "zwfs" / "__init__.py").write_text("gain = 2\n"), {"first", "second", "third"}),
        (lambda p: (p.root / "zwfs" / "more.py").write_text(""), {"first", "second", "third"}),
        (
            lambda p: (p.root / "environment" / "requirements.lock").write_text("numpy==3\n"),
            {"first", "second", "third"},
        ),
        (lambda p: write(p, "first", "print(n)"), {"first"}),
        (lambda p: (p.executed / "first.ipynb").write_text("half of a noteb"), {"first"}),
        (lambda p: (p.executed / "first.json").unlink(), {"first"}),
        (lambda p: p.files("third")[0].unlink(), {"third"}),
        (lambda p: p.files("third")[0].write_text("2"), {"third"}),
    ],
)
def test_what_changed_is_stale(ran, change, stale):
    change(ran)
    keys = {name: runner.key(ran, name, {}) for name in ("first", "second", "third")}
    assert {name for name in keys if runner._record(ran, name).get("key") != keys[name]} == stale


def test_parameters_are_part_of_the_key(ran):
    assert runner.key(ran, "first", {"n": 3}) != runner.key(ran, "first", {})


def test_failure_is_named_and_leaves_earlier_results(ran):
    before = results(ran)
    write(ran, "first", "print(n)", "\nlight = 0\nraise ValueError('no light')", "print('never')")
    with pytest.raises(NotebookError) as caught:
        run(ran)
    message = str(caught.value)
    assert "notebooks/first.ipynb failed in cell 4 of 5" in message
    assert "the cell begins: light = 0" in message
    assert "parameters in force: n = 2, width = 1.5" in message
    assert message.endswith("ValueError: no light")
    assert results(ran) == before
    assert sorted(os.listdir(ran.build)) == ["notebooks"]


def test_failure_leaves_the_files_of_the_earlier_run(ran):
    write(ran, "third", leave("numbers.csv", "2"), "raise ValueError")
    with pytest.raises(NotebookError):
        run(ran)
    assert [file.read_text() for file in ran.files("third")] == ["1"]


def test_new_files_replace_the_old_ones(ran):
    write(ran, "third", leave("others.csv", "2"))
    run(ran)
    assert [file.name for file in ran.files("third")] == ["others.csv"]
    assert ran.files("first") == []


def test_dead_kernel_is_named(project):
    write(project, "dies", "import os\nos._exit(3)")
    with pytest.raises(NotebookError, match=r"notebooks/dies.ipynb failed in cell 3 of 3"):
        run(project)
    assert results(project) == {}


INTERRUPTIBLE = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # in the background SIGINT is ignored


def start_sleeping_run(project):
    """Start a run in a process, wait until the notebook sleeps, and return the process and the kernel's id."""
    pid = project.notebooks / "pid"
    write(
        project,
        "sleeps",
        f"import os, pathlib, time\npathlib.Path({str(pid)!r}).write_text(str(os.getpid()))",
        "time.sleep(99)",
    )
    code = (
        f"import pathlib, runner, signal; {INTERRUPTIBLE}; runner.end_cleanly_on_signals();"
        f"runner.run(runner.Project(pathlib.Path({str(project.root)!r})))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(BOOK)}, stderr=subprocess.DEVNULL
    )
    wait_until(lambda: pid.exists() and pid.read_text(), seconds=60)
    return process, int(pid.read_text())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_leaves_no_kernel_and_no_pieces(project, number):
    process, kernel = start_sleeping_run(project)
    process.send_signal(number)
    assert process.wait(20) != 0
    assert list(project.build.iterdir()) == []
    wait_until(lambda: not alive(kernel), seconds=20)


def test_killed_run_leaves_no_kernel_and_the_next_run_removes_its_pieces(project):
    process, kernel = start_sleeping_run(project)
    process.kill()
    process.wait()
    assert [folder.name.startswith("running-") for folder in project.build.iterdir()] == [True]
    wait_until(lambda: not alive(kernel), seconds=20)
    write(project, "sleeps", "n")
    run(project)
    assert [folder.name for folder in project.build.iterdir()] == ["notebooks"]


def test_scratch_folder_of_a_living_process_and_foreign_folders_stay(tmp_path):
    (tmp_path / "running-of-somebody-else").mkdir()
    with runner.scratch_folder(tmp_path, "running-") as first, runner.scratch_folder(tmp_path, "running-"):
        assert first.is_dir()
    assert [folder.name for folder in tmp_path.iterdir()] == ["running-of-somebody-else"]


def wait_until(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return (
        "Z (zombie)" not in (Path("/proc") / str(pid) / "status").read_text() if Path("/proc").exists() else True
    )


def test_result_of_a_notebook_that_was_edited_meanwhile_is_not_current(project):
    edit = "p.write_text(p.read_text().replace('# edited', '# later'))"
    write(project, "edited", f"import pathlib\np = pathlib.Path('edited.ipynb')\n{edit}")
    assert run(project)[0] == ["edited"]
    assert runner._record(project, "edited")["key"] is None


def test_normal_form_keeps_glued_values_and_drops_times():
    glued = {"application/papermill.record/text/plain": "1.5"}
    output = nbformat.v4.new_output("display_data", data=glued, metadata={"scrapbook": {"name": "x"}})
    cell = new_code_cell("glue('x', 1.5)", outputs=[output], metadata={"tags": [], "papermill": {"duration": 1}})
    notebook = new_notebook(
        cells=[cell], metadata={"papermill": {}, "language_info": {"name": "python", "version": "3.11"}}
    )
    normal = runner.normalise(notebook)
    assert normal.cells[0].outputs == [output]
    assert normal.cells[0].metadata == {}
    assert "papermill" not in normal.metadata
    assert normal.metadata.language_info == {"name": "python"}
    assert runner.to_bytes(normal).endswith(b"}\n")
    assert runner.to_bytes(runner.normalise(normal)) == runner.to_bytes(normal)


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
        "title: small\nonly_build_toc_files: true\nexecute:\n  execute_notebooks: 'off'\n"
        f"sphinx:\n  local_extensions:\n    cards: {BOOK / '_ext'}\n"
    )
    return ran


def test_the_book_shows_the_run_and_not_what_the_sources_store(small_book):
    assert not any(
        "outputs" in cell and cell.outputs for cell in runner.read(small_book.notebooks / "first.ipynb").cells
    )
    assert pages.build_book(small_book)
    page = (small_book.build / "html" / "notebooks" / "first.html").read_text("utf-8")
    assert printed(small_book, "first").split("\n")[0] in page


def test_a_figure_offers_the_files_of_its_run(small_book):
    publish = "def publish(*_): pass\npublish(None, 'numbers', {})\n" + leave("numbers.csv", "2")
    write(small_book, "first", publish)
    run(small_book)
    assert pages.build_book(small_book)
    assert [file.read_text() for file in (small_book.build / "html" / "_downloads").rglob("numbers.csv")] == ["2"]


def test_link_to_a_file_that_is_not_published_fails(small_book):
    page = small_book.root / "book" / "index.md"
    page.write_text("# A book\n\n{download}`data <../_build/notebooks/third.files/numbers.csv>`\n")
    assert pages.build_book(small_book)
    assert list((small_book.build / "html" / "_downloads").rglob("numbers.csv"))
    page.write_text("# A book\n\n{download}`data <../_build/notebooks/third.files/missing.csv>`\n")
    with pytest.raises(pages.BookError, match=r"not readable.*missing.csv"):
        pages.build_book(small_book)


def test_book_is_built_once_and_a_failure_leaves_it(small_book):
    assert pages.build_book(small_book)
    page = small_book.build / "html" / "book" / "index.html"
    before = page.read_bytes()
    assert not pages.build_book(small_book)
    (small_book.root / "book" / "index.md").write_text("# A book\n\n{doc}`nowhere`\n")
    with pytest.raises(pages.BookError, match=r"book/index.md:3: WARNING: unknown document"):
        pages.build_book(small_book)
    assert page.read_bytes() == before
    assert sorted(os.listdir(small_book.build)) == ["html", "notebooks"]


def test_book_is_built_again_after_a_failure(small_book):
    """Even if the change is taken back: the book that is there may lack a part."""
    index = small_book.root / "book" / "index.md"
    pages.build_book(small_book)
    before = index.read_text()
    index.write_text("# A book\n\n{doc}`nowhere`\n")
    with pytest.raises(pages.BookError):
        pages.build_book(small_book)
    index.write_text(before)
    assert pages.build_book(small_book)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root: (root / "book" / "new.md").write_text("# New\n"), "book/new.md is not listed in _toc.yml"),
        (
            lambda root: (root / "notebooks" / "second.ipynb").unlink(),
            "_toc.yml lists notebooks/second, which is no",
        ),
        (
            lambda root: write(Project(root), "new", "n"),
            "notebooks/new.ipynb is not listed in _toc.yml",
        ),
    ],
)
def test_contents_that_do_not_match_the_pages_are_refused(small_book, change, message):
    change(small_book.root)
    with pytest.raises(pages.BookError, match=message):
        pages.build_book(small_book)


def test_pdf_is_made_where_there_is_a_browser(small_book, monkeypatch):
    (small_book.root / "book" / "print.css").write_text("")
    monkeypatch.setattr(pages.printing, "print_book", lambda *_: b"%PDF")
    for browser in (None, "a browser"):
        monkeypatch.setattr(pages.printing, "find_chromium", lambda browser=browser: browser)
        assert pages.build_book(small_book)
        assert (small_book.build / "html" / pages.printing.NAME).exists() == bool(browser)
        assert not pages.build_book(small_book)


def test_record_says_what_a_result_was_made_from(ran):
    record = json.loads((ran.executed / "first.json").read_text())
    assert record["key"] == runner.key(ran, "first", {})
    assert record["seconds"] > 0
    assert {"Python", "NumPy", "SciPy", "Matplotlib", "zwfs"} == set(record["versions"])
