"""A notebook re-run with other parameters: refusals, results, and interruptions."""

import json
import os
import pty
import re
import shlex
import shutil
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from book._tools import declared, rerun
from book._tools.__main__ import main
from book._tools.declared import ParameterError
from book._tools.notebook import read
from book._tools.project import Project
from tests.conftest import ROOT, alive, heed_signals, start_tool, wait_until, watch

DEFAULTS = (
    "n = 2  # pixels across\nwidth = 1.5  # of the slit, rad\nsteps = [1, 2]  # tried, in turn\nseed = 7  # of it"
)
LIMITS = """from studies.kit.parameters import check_parameters
check_parameters(globals(), n=(1, 9), width=(0.0, 4.0), steps=[(0, 9), ...], seed=(0, 99))"""
LEAVE = """import os, pathlib
folder = pathlib.Path(os.environ["ZWFS_RESULTS"])
_ = (folder / "numbers.csv").write_text(f"{n},{width}")"""
GLUE = "from myst_nb import glue\nglue('product', n * width, display=False)"
PICTURE = """%config InlineBackend.figure_formats = ['svg']
import matplotlib.pyplot as plt
_ = plt.plot([1, 2])"""
SLEEP = """import os, pathlib, time
pathlib.Path("begun").write_text(str(os.getpid()))
time.sleep(99)"""
WORK = """import json, os, time
with open(os.environ["ZWFS_PROGRESS"], "a") as file:
    for done in (1, 2, 3):
        print("no progress", file=file)
        print(json.dumps({"name": "curves", "done": done, "total": 3}), file=file, flush=True)
        time.sleep(0.8)"""


def write(project, name, *cells, defaults=DEFAULTS, limits=LIMITS):
    tagged = [
        new_code_cell("%matplotlib inline"),
        new_markdown_cell(f"# Title of {name}\n\nWith $a^2$."),
        new_code_cell(defaults, metadata={"tags": ["parameters"]}),
        new_code_cell(limits, metadata={"tags": ["remove-cell"]}),
    ]
    nbformat.write(new_notebook(cells=[*tagged, *cells]), project.notebooks / f"{name}.ipynb")


def make_project(root):
    project = Project(root)
    project.notebooks.mkdir(parents=True)
    (project.notebooks / "studies").symlink_to(ROOT / "notebooks" / "studies")
    shutil.copyfile(ROOT / "_config.yml", root / "_config.yml")
    (root / "_toc.yml").write_text(
        "format: jb-book\nroot: book/index\nchapters:\n"
        "- file: notebooks/fig01_small\n- file: notebooks/fig02_works\n"
    )
    (root / "book").mkdir()
    (root / "book" / "index.md").write_text("# A book\n\n$$a = b$$ (eq-first)\n")
    figure = {"mystnb": {"figure": {"caption": "A straight line.", "name": "fig-line"}}}
    write(
        project,
        "fig01_small",
        new_code_cell(LEAVE),
        new_code_cell(PICTURE, metadata=figure),
        new_code_cell(GLUE, metadata={"tags": ["hide-input"]}),
        new_markdown_cell(
            "The product is {glue:text}`product:.2f`, see {eq}`eq-first` and [the other](fig02_works.ipynb).\n\n"
            "{download}`data <downloads/numbers.csv>`"
        ),
        new_markdown_cell("## With the book's parameters\n\nA slit.", metadata={"tags": ["book-parameters"]}),
    )
    write(project, "fig02_works", new_code_cell(WORK))
    return project


@pytest.fixture
def project(tmp_path):
    return make_project(tmp_path)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A project whose first notebook was run with another width."""
    project = make_project(tmp_path_factory.mktemp("template"))
    rerun.rerun(project, ["1", "-p", "width=3"])
    return project


@pytest.fixture
def ran(template, tmp_path):
    return Project(shutil.copytree(template.root, tmp_path / "copy", symlinks=True))


def result(project):
    [folder] = (project.build / "rerun").iterdir()
    return folder


def refused(project, *arguments):
    begin = time.process_time()
    with pytest.raises(ParameterError) as caught:
        rerun.rerun(project, list(arguments))
    assert time.process_time() - begin < 2
    assert not project.build.exists()
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500
    return str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["3"], "no notebook makes Figure 3: expected one of 1, 2"),
        (["fig01_smal"], "unknown notebook 'fig01_smal': did you mean 'fig01_small'?"),
        (["1", "-p", "wdth=2"], "unknown parameter 'wdth': did you mean 'width'?"),
        (["1", "-p", "steps=[1, 10]"], "steps[1] = 10: expected an integer in [0, 9]"),
        (["1", "-p", "steps=[1,"], "-p steps=[1,: expected the node content"),
        (["1", "-p", "n"], "-p n: expected name=value"),
        (["1", "-p", "n=1", "-p", "n=2"], "-p n=2: 'n' is given twice"),
        (["1", "-p", f"n={'1' * 5000}"], "Exceeds the limit"),
        (["1", "-p", "n=\x1b[31m"], "special characters are not allowed"),
        (["-p", "n=1"], "name a figure"),
        (["1", "-f", "nowhere.yaml"], "-f nowhere.yaml: No such file"),
        (["1", "--output", "no/such/folder"], "is not a folder"),
        (["--line=1 -p n=10"], "n = 10: expected an integer in [1, 9]"),
        (["1", "-p", "width.kind=3"], "unknown parameter 'width.kind': did you mean 'width'?"),
    ],
)
def test_bad_requests_are_refused_before_anything_runs(project, arguments, message):
    assert message in refused(project, *arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("n: [1\n", "mine.yaml, line 2: "),
        ("- n\n- 2\n", "expected a mapping of names to values"),
        ("width: 1\n\nn: 2\nn: 3\n", 'mine.yaml, line 4: found duplicate key "n"'),
        ("n: !!python/object/apply:os.getpid []", "could not determine a constructor for the tag"),
        ("n: 1\n---\nn: 2", "expected a single document"),
    ],
)
def test_bad_files_are_refused(project, text, message):
    file = project.root / "mine.yaml"
    file.write_text(text)
    assert message in refused(project, "1", "-f", str(file))


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 1e-3), ("1e3", 1000.0), ("010", 10), ("yes", "yes"), ("-.5", -0.5)],
)
def test_values_are_read_as_people_mean_them(text, value):
    loaded = declared.load(text, "here")
    assert (loaded, type(loaded)) == (value, type(value))


def test_command_line_wins_over_the_file(project, monkeypatch):
    changes = []
    monkeypatch.setattr(rerun, "make", lambda project, name, changed, *rest: changes.append(changed) or 1.0)
    (project.root / "mine.yaml").write_text("n: 5\nwidth: 2\n")
    rerun.rerun(project, ["fig01_small", "-f", str(project.root / "mine.yaml"), "-p", "n=6"])
    rerun.rerun(project, ["fig01", "-p", "width=1.5", "-p", "steps=[]"])
    assert changes == [{"n": 6, "width": 2.0}, {"steps": []}]


def test_a_field_of_a_parameter_is_set_by_the_name_that_the_list_shows():
    parameters = declared.parameters(read(ROOT / "notebooks" / "fig03_dynamic_range.ipynb"))

    def changed(*texts, **values):
        return declared.accept(declared.joined(values | declared.assignments(list(texts)), parameters), parameters)

    assert changed("pupil.kind=vlt") == {"pupil": {"kind": "vlt"}}
    both = {"kind": "vlt", "obstruction": 0.2}
    assert changed("pupil.obstruction=0.2", pupil={"kind": "vlt", "obstruction": 0.1}) == {"pupil": both}
    assert changed("pupil={kind: vlt}", "pupil.obstruction=0.2") == {"pupil": both}
    assert changed("pupil.kind=circular") == {}
    for text, message in {"pupil.knd=vlt": "pupil.knd", "pupil.kind=moon": "pupil.kind = 'moon'"}.items():
        with pytest.raises(ParameterError, match=message):
            changed(text)


def test_the_recorded_command_gives_the_same_parameters():
    parameters = {"files": ["\U0001d54f.fits", "a 'b' \"c\""], "n": 3}
    options = shlex.split(rerun.command("fig", parameters).removeprefix(f"{rerun.COMMAND} fig"))
    assert declared.assignments([text for text in options if text != "-p"]) == parameters


def test_folder_holds_all_that_was_made(ran):
    folder = result(ran)
    about = json.loads((folder / "record.json").read_text())
    files = {"fig01_small.html", "fig01_small.ipynb", "numbers.csv"}
    assert {file.name for file in folder.iterdir()} == {*files, "record.json"}
    assert (folder / "numbers.csv").read_text() == "2,3.0"
    assert about["parameters"] == {"n": 2, "width": 3.0, "steps": [1, 2], "seed": 7}
    assert (about["changed"], about["seed"], about["commit"]) == ({"width": 3.0}, 7, None)
    assert {"Python", "NumPy", "SciPy", "Matplotlib", "zwfs"} <= set(about["versions"])
    assert set(about["files"]) == files
    assert os.listdir(ran.build) == ["rerun"]
    notebook = read(folder / "fig01_small.ipynb")
    assert notebook.cells[2].source.endswith("| `width` | `3.0` | `1.5` | rad | of the slit |")
    assert not any("With the book's parameters" in cell.source for cell in notebook.cells)


def test_page_has_everything_in_it(ran):
    html = (result(ran) / "fig01_small.html").read_text()
    text = re.sub(r"<script>.*?</script>|<style>.*?</style>", "", html, flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?!data:|#|numbers\.csv")[^"]*"', text)
    plain = re.sub(r"<[^>]*>", "", text)
    assert "The product is 6.00, see (1) and the other." in plain
    assert "The parameters of this page are not those of the book." in plain
    assert "A straight line." in plain
    assert 'src="data:image/svg+xml;base64,' in text
    assert 'href="numbers.csv"' in text
    assert "check_parameters" not in plain


def test_folders_of_others_are_not_overwritten(ran):
    (ran.root / "mine").mkdir()
    (ran.root / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ParameterError, match="holds no result of fig01_small"):
        rerun.rerun(ran, ["1", "--output", str(ran.root / "mine")])
    with pytest.raises(ParameterError, match="holds no result of fig02_works"):
        rerun.rerun(ran, ["2", "--output", str(result(ran))])
    (result(ran) / "notes.txt").write_text("x")
    with pytest.raises(ParameterError, match=r"notes.txt"):
        rerun.rerun(ran, ["1", "-p", "width=3"])


def run_command(project, *arguments):
    """Start the command on a project in a terminal of its own."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(ours, (24, 120))
    process = start_tool(project.root, "rerun", *arguments, stdout=theirs, stderr=theirs)
    os.close(theirs)
    return process, ours


def heard(terminal):
    """Return what a terminal shows until it is closed."""
    said = b""
    try:
        while piece := os.read(terminal, 4096):
            said += piece
    except OSError:
        pass  # so it ends on Linux
    os.close(terminal)
    return said.decode()


@pytest.mark.slow
def test_progress_within_a_cell_is_shown(project):
    process, terminal = run_command(project, "2")
    said = heard(terminal)
    assert process.wait(60) == 0
    assert re.search(r"fig02_works:.*cell 5/5, curves [123]/3", said)
    assert "open " in said


def start_sleeping_run(project):
    """Start the command, and return it and its terminal when its notebook sleeps."""
    write(project, "fig02_works", new_code_cell(SLEEP))
    process, terminal = run_command(project, "2")
    begun = project.notebooks / "begun"
    wait_until(lambda: begun.exists() and begun.read_text(), seconds=240)
    return process, terminal


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_leaves_nothing(project, number):
    process, terminal = start_sleeping_run(project)
    kernel = int((project.notebooks / "begun").read_text())
    process.send_signal(number)
    assert number != signal.SIGINT or "interrupted" in heard(terminal)
    assert process.wait(20) != 0
    wait_until(lambda: not alive(kernel), seconds=20)
    assert list(project.build.iterdir()) == []


@pytest.mark.slow
def test_a_killed_rerun_leaves_no_kernel_and_the_next_one_removes_its_pieces(project):
    process, terminal = start_sleeping_run(project)
    process.kill()
    process.wait()
    os.close(terminal)
    assert [folder.name.startswith("rerunning-") for folder in project.build.iterdir()] == [True]
    pid = int((project.notebooks / "begun").read_text())
    wait_until(lambda: not alive(pid), seconds=20)
    write(project, "fig02_works", new_code_cell("light = 1"))
    rerun.rerun(project, ["2"])
    assert os.listdir(project.build) == ["rerun"]


def test_interruption_while_the_program_is_loaded_needs_no_traceback():
    command = [sys.executable, "-X", "importtime", "-m", "book._tools", "rerun", "--list"]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, preexec_fn=heed_signals)
    while "argparse" not in process.stderr.readline():  # one of the first, and NumPy is still to come
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=20)[1].splitlines()
    assert [line for line in errors if not line.startswith("import time:")] == ["interrupted"]
    assert process.returncode == 1


def test_command_line_ends_with_2_and_one_line(capsys):
    assert main(["rerun", "3", "-p", "n_screen=5"]) == 2
    message = "rerun: unknown parameter 'n_screen': did you mean 'n_screens'?\n"
    assert capsys.readouterr() == ("", message)


def test_a_missing_file_is_found_before_the_notebook_starts(capsys, monkeypatch):
    monkeypatch.setattr(rerun, "make", lambda *arguments: pytest.fail("the notebook was started"))
    assert main(["rerun", "own_frames", "-p", "frame_files=[nowhere.fits]"]) == 2
    assert capsys.readouterr().err == "rerun: frame_files: nowhere.fits: no such file\n"


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder in which nobody can write")
def test_folders_that_cannot_be_written_are_refused_in_one_line(project, capsys):
    def refusal(*arguments):
        assert main(["rerun", *arguments], project) == 1
        [line] = capsys.readouterr().err.splitlines()
        return line

    assert "/proc/" in refusal("1", "--output", "/proc/result")
    assert "File name too long" in refusal("1", "--output", "x" * 300)
    project.build.write_text("no folder")
    assert str(project.build) in refusal("1")


@pytest.mark.parametrize("name", ["ARGS", "FIGURE"])
@pytest.mark.parametrize(
    "text",
    ["$(touch x)", "$$(touch x)", "$(shell touch x)", "`touch x`", "; touch x", '\'"$HOME" > x', "a # b", "a\nb"],
)
def test_make_evaluates_no_argument(tmp_path, name, text):
    shutil.copy(ROOT / "Makefile", tmp_path)
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\nprintf '%s\\0' \"$@\"\n")
    python.chmod(0o755)
    command = ["make", "--silent", "--old-file=.venv/.ready", "rerun"]
    expected = f"--line= {text}" if name == "ARGS" else f"--line={text} "
    for arguments, environment in (([f"{name}={text}"], {}), ([], {name: text})):
        done = subprocess.run(
            [*command, *arguments], cwd=tmp_path, env=os.environ | environment, capture_output=True, text=True
        )
        assert done.stderr == ""
        assert done.stdout.split("\0")[:4] == ["-m", "book._tools", "rerun", expected]
        assert sorted(os.listdir(tmp_path)) == [".venv", "Makefile"]


HOSTILE = {
    "script": "<script>document.title=666</script>",
    "link": "[x](javascript:document.title=666)",
    "image": "![a](/etc/passwd) _b_ ~~d~~",
    "bars": "a|b\\|c\\",
    "row": "a | b\n\n# A heading\n\n```{note}\n```\n",
    "code": "`` ` ` <b>bold</b> | $x$ {math}`y` *z* &lt;",
    "end": "</code></td></table></style><svg onload=document.title=666>",
}
SHOWN = """from studies.kit.tables import Table
Table(["name", *names], [[name, *[""] * len(names)] for name in names])"""


def test_odd_names_are_shown_as_they_are(project, browser):
    names = [*HOSTILE.values()]
    limits = "from studies.kit.parameters import check_parameters\ncheck_parameters(globals(), names=[str, ...])"
    write(project, "fig02_works", new_code_cell(SHOWN), defaults="names = []  # of files", limits=limits)
    rerun.rerun(project, ["2", "-p", f"names={json.dumps(names)}"])
    file = result(project) / "fig02_works.html"
    page = browser.new_page()
    _, asked = watch(page)
    page.goto(file.as_uri())
    page.wait_for_load_state("networkidle")
    page.wait_for_selector("math")
    assert [url for url in asked if not url.startswith("data:")] == [file.as_uri()]
    assert page.title() == "Title of fig02_works"
    for cells in ("th", "td:first-child"):
        shown = page.locator(f".cell_output {cells}").all_inner_texts()
        assert shown[-len(names) :] == [name.replace("\n", r"\n") for name in names]
    told = page.locator("main > section > table td:nth-child(2), blockquote ~ table td:nth-child(2)").first
    assert json.loads(told.inner_text()) == names
    page.close()


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        (["os:system"], "path = 'os:system': expected the class of a reconstructor, got <built-in"),
        (["nope:X"], "path = 'nope:X': expected a module that can be imported (ModuleNotFoundError: "),
        (["zwfs:Pupil"], "path = 'zwfs:Pupil': expected the class of a reconstructor"),
        (["zwfs:Nobody"], "path = 'zwfs:Nobody': expected the class of a reconstructor, got None"),
        (["zwfs:Linear"], "path = 'zwfs:Linear': expected a name other than Linear, Arcsine"),
        (["own:Own", "own:Own"], "path = 'own:Own': expected a name other than Linear, "),
        (["broken:Own"], "expected a module that can be imported (SyntaxError: "),
        (["leaves:Own"], "expected a module that can be imported (SystemExit: 0)"),
    ],
)
def test_classes_that_cannot_be_used_are_refused_before_the_notebook_starts(project, monkeypatch, paths, message):
    own_project(project)
    monkeypatch.setattr(rerun, "make", lambda *arguments: pytest.fail("the notebook was started"))
    assert message in refused(project, "2", "-p", f"reconstructors={json.dumps(paths)}")


def own_project(project):
    modules = {
        "own": "class Own:\n    def __call__(self, frames): ...",
        "broken": "class Own(:",
        "leaves": "print('accepted')\nimport sys; sys.exit(0)",
    }
    limits = (
        "from studies.kit.parameters import check_parameters\n"
        "check_parameters(globals(), reconstructors=[str, ...])"
    )
    code = "from importlib import import_module\n_ = [import_module(one.split(':')[0]) for one in reconstructors]"
    cells = new_code_cell(code), new_code_cell("light = 1")
    write(project, "fig02_works", *cells, defaults="reconstructors = []  # of a reader", limits=limits)
    for name, source in modules.items():
        (project.notebooks / f"{name}.py").write_text(source)


@pytest.mark.parametrize("content", ["[1]", "[]", '"x"', "3", "null", '{"files": [[1]]}', "{", '{"made_by": []}'])
def test_damaged_record_of_a_result_is_refused(project, content):
    folder = project.root / "folder"
    folder.mkdir()
    (folder / rerun.RECORD).write_text(content)
    with pytest.raises(ParameterError, match="holds no result of fig02_works"):
        rerun.rerun(project, ["2", "--output", str(folder)])


@pytest.mark.slow
def test_incomplete_notebooks_are_not_stored(project, capsys):
    own_project(project)
    assert main(["rerun", "2", "-p", "reconstructors=[own:Own]"], project) == 0
    assert len(os.listdir(project.build / "rerun")) == 1
    before = {file: file.read_bytes() for file in result(project).iterdir()}
    write(project, "fig02_works", new_code_cell("import sys\nsys.exit()"))  # its last cell
    assert main(["rerun", "2"], project) == 1
    assert "RuntimeError: the cell ended Python" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in result(project).iterdir()} == before
