"""A notebook re-run with other parameters: what is refused, what is left, and that nothing is left half-done."""

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import declared
import nbformat
import pytest
import rerun
import runner
from declared import ParameterError
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from runner import NotebookError, Project

ROOT = Path(__file__).parent.parent

DEFAULTS = (
    "n = 2  # pixels across\nwidth = 1.5  # of the slit, rad\nsteps = [1, 2]  # tried, in turn\nseed = 7  # of it"
)
LIMITS = """from zwfs.parameters import check_parameters
check_parameters(globals(), n=(1, 9), width=(0.0, 4.0), steps=[(0, 9), ...], seed=(0, 99))"""
LEAVE = """import os, pathlib
folder = pathlib.Path(os.environ["ZWFS_RESULTS"])
_ = (folder / "numbers.csv").write_text(f"{n},{width}")"""
GLUE = "from myst_nb import glue\nglue('product', n * width, display=False)"
PICTURE = """%config InlineBackend.figure_formats = ['svg']
import matplotlib.pyplot as plt
_ = plt.plot([1, 2])"""
WORK = """import json, os, time
with open(os.environ["ZWFS_PROGRESS"], "a") as file:
    for done in (1, 2, 3):
        print("no progress", file=file)
        print(json.dumps({"name": "curves", "done": done, "total": 3}), file=file, flush=True)
        time.sleep(0.8)"""


def write(project, name, *cells):
    tagged = [
        new_code_cell("%matplotlib inline"),
        new_markdown_cell(f"# Title of {name}\n\nWith $a^2$."),
        new_code_cell(DEFAULTS, metadata={"tags": ["parameters"]}),
        new_code_cell(LIMITS, metadata={"tags": ["remove-cell"]}),
    ]
    project.notebooks.mkdir(exist_ok=True)
    nbformat.write(new_notebook(cells=[*tagged, *cells]), project.notebooks / f"{name}.ipynb")


def make_project(root):
    project = Project(root)
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
    return Project(shutil.copytree(template.root, tmp_path / "copy"))


def result(project):
    [folder] = (project.build / "rerun").iterdir()
    return folder


def refused(project, *arguments):
    with pytest.raises(ParameterError) as caught:
        rerun.rerun(project, list(arguments))
    assert not project.build.exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["3"], "no notebook makes Figure 3: expected one of 1, 2"),
        (["fig01_smal"], "unknown notebook 'fig01_smal': did you mean 'fig01_small'?"),
        (["1", "-p", "wdth=2"], "unknown parameter 'wdth': did you mean 'width'?"),
        (["1", "-p", "zzz=2"], "unknown parameter 'zzz': expected one of n, width, steps, seed"),
        (["1", "-p", "n=1e0"], "n = 1.0: expected an integer, as in 1"),
        (["1", "-p", "n=2.0"], "n = 2.0: expected an integer, as in 2"),
        (["1", "-p", "n=true"], "n = True: expected an integer"),
        (["1", "-p", 'n="2"'], "n = '2': expected an integer"),
        (["1", "-p", "n="], "n = None: expected an integer"),
        (["1", "-p", "n=10"], "n = 10: expected an integer in [1, 9]"),
        (["1", "-p", "width=false"], "width = False: expected a real number"),
        (["1", "-p", "width=.nan"], "width = nan: expected a finite number in [0, 4]"),
        (["1", "-p", "width=-.inf"], "width = -inf: expected a finite number in [0, 4]"),
        (["1", "-p", "steps=[1, 10]"], "steps[1] = 10: expected an integer in [0, 9]"),
        (["1", "-p", "steps=1"], "steps = 1: expected a list"),
        (["1", "-p", "steps=[1,"], "-p steps=[1,: expected the node content"),
        (["1", "-p", "n"], "-p n: expected name=value"),
        (["1", "-p", "n=1", "-p", "n=2"], "-p n=2: 'n' is given twice"),
        (["-p", "n=1"], "name a figure"),
        (["1", "-f", "nowhere.yaml"], "-f nowhere.yaml: No such file"),
        (["1", "--output", "no/such/folder"], "is not a folder"),
        (["1", "--unknown"], "unrecognized arguments: --unknown"),
    ],
)
def test_bad_requests_are_refused_before_anything_runs(project, arguments, message):
    assert message in refused(project, *arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("n: [1\n", "mine.yaml, line 2: "),
        ("- n\n- 2\n", "expected a mapping of names to values"),
        ("", "expected a mapping of names to values"),
        ("1: 2", "expected a mapping of names to values"),
        ("n: 2\nn: 3\n", "'n' is given twice"),
        ("n: !!python/object/apply:os.getpid []", "could not determine a constructor"),
        ("n: 20", "n = 20: expected an integer in [1, 9]"),
    ],
)
def test_bad_files_are_refused(project, text, message):
    file = project.root / "mine.yaml"
    file.write_text(text)
    assert message in refused(project, "1", "-f", str(file))


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 1e-3), ("1e3", 1000.0), ("010", 10), ("yes", "yes"), ("1:30", "1:30"), ("-.5", -0.5), ("~", None)],
)
def test_values_are_read_as_people_mean_them(text, value):
    found = declared.load(text, "here")
    assert found == value
    assert type(found) is type(value)


def test_command_line_wins_over_the_file(project, monkeypatch):
    made = []
    monkeypatch.setattr(rerun, "make", lambda project, name, changed, known, folder: made.append(changed) or 1.0)
    (project.root / "mine.yaml").write_text("n: 5\nwidth: 2\n")
    rerun.rerun(project, ["fig01_small", "-f", str(project.root / "mine.yaml"), "-p", "n=6"])
    rerun.rerun(project, ["fig01", "-p", "width=1.5", "-p", "steps=[]"])
    assert made == [{"n": 6, "width": 2.0}, {"steps": []}]


@pytest.mark.parametrize(
    ("value", "message"), [('!!int "abc"', "invalid literal for int"), ("1" * 5000, "Exceeds the limit")]
)
def test_numbers_that_are_none_are_refused(project, value, message):
    assert message in refused(project, "1", "-p", f"n={value}")


def test_one_file_of_parameters_is_taken(project):
    assert "-f a.yaml -f b.yaml: expected one file" in refused(project, "1", "-f", "a.yaml", "-f", "b.yaml")


def test_files_that_parameters_name_count_by_what_is_in_them(project, tmp_path):
    (project.notebooks / "beside.npy").write_bytes(b"one")
    (tmp_path / "far.npy").write_bytes(b"one")
    given = {
        "files": ["beside.npy", str(tmp_path / "far.npy")],
        "other": ["x" * 5000, "no\0file", "nowhere.npy", ""],
    }
    keys = [runner.key(project, "fig01_small", given)]
    for file in (project.notebooks / "beside.npy", tmp_path / "far.npy", project.notebooks / "nowhere.npy"):
        file.write_bytes(b"two")
        keys.append(runner.key(project, "fig01_small", given))
    assert len(set(keys)) == 4
    assert runner.key(project, "fig01_small", given) == keys[-1]


def test_lists_tell_titles_and_parameters(project, capsys):
    rerun.rerun(project, [])
    assert re.search(r"^1 +fig01_small +Title of fig01_small$", capsys.readouterr().out, re.MULTILINE)
    rerun.rerun(project, ["1", "--list"])
    told = capsys.readouterr().out
    assert re.search(r"^n +int +2 +1 to 9 +pixels across$", told, re.MULTILINE)
    assert re.search(r"^width +float +1.5 +0 to 4 +rad +of the slit$", told, re.MULTILINE)
    assert re.search(r"^steps +list of int +\[1, 2\] +0 to 9 +tried, in turn$", told, re.MULTILINE)


def test_names_of_folders_tell_parameters_and_differ():
    one, two = ({"width": 2.0, "n": n} for n in (1, 2))
    assert rerun.folder_name("fig", {}) == "fig-defaults"
    assert rerun.folder_name("fig", one).startswith("fig-width=2.0-n=1-")
    assert rerun.folder_name("fig", one) != rerun.folder_name("fig", two)
    long = {"words": [f"../{index} $x" for index in range(99)]}
    assert re.fullmatch(r"[\w.=,+-]{1,90}", rerun.folder_name("fig", long))


def test_folder_holds_all_that_was_made(ran):
    folder = result(ran)
    record = json.loads((folder / "record.json").read_text())
    files = {"fig01_small.html", "fig01_small.ipynb", "numbers.csv"}
    assert {file.name for file in folder.iterdir()} == {*files, "record.json"}
    assert (folder / "numbers.csv").read_text() == "2,3.0"
    assert record["parameters"] == {"n": 2, "width": 3.0, "steps": [1, 2], "seed": 7}
    assert (record["changed"], record["seed"], record["commit"]) == ({"width": 3.0}, 7, None)
    assert record["key"] == runner.key(ran, "fig01_small", {"width": 3.0})
    assert {"Python", "NumPy", "SciPy", "Matplotlib", "zwfs"} <= set(record["versions"])
    assert set(record["files"]) == files
    assert os.listdir(ran.build) == ["rerun"]
    notebook = runner.read(folder / "fig01_small.ipynb")
    assert notebook.cells[2].source.endswith("| `width` | `3.0` | `1.5` | rad | of the slit |")


def test_page_has_everything_in_it(ran):
    html = (result(ran) / "fig01_small.html").read_text()
    text = re.sub(r"<script>.*?</script>|<style>.*?</style>", "", html, flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?!data:|#|numbers\.csv")[^"]*"', text)
    plain = re.sub(r"<[^>]*>", "", text)
    assert "The product is 6.00, see (1) and the other." in plain
    assert "run with other parameters" in plain
    assert "A straight line." in plain
    assert 'src="data:image/svg+xml;base64,' in text
    assert 'href="numbers.csv"' in text
    assert "check_parameters" not in plain


def test_page_opens_without_network_and_complaint(ran, browser):
    page_file = result(ran) / "fig01_small.html"
    requests, complaints = [], []
    page = browser.new_page()
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(page_file.as_uri())
    page.wait_for_selector("mjx-container svg")
    widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    page.close()
    assert [url for url in requests if not url.startswith("data:")] == [page_file.as_uri()]
    assert complaints == []
    assert widths
    assert all(widths)


def test_second_run_is_served_unless_something_changed(ran, monkeypatch, capsys):
    made = []
    monkeypatch.setattr(rerun, "make", lambda *arguments: made.append(arguments[2]) or 1.0)
    rerun.rerun(ran, ["1", "-p", "width=3.0"])
    assert made == []
    assert "unchanged" in capsys.readouterr().out
    rerun.rerun(ran, ["1", "-p", "width=3", "--force"])
    rerun.rerun(ran, ["1", "-p", "width=2"])
    (result(ran) / "numbers.csv").write_text("edited")
    rerun.rerun(ran, ["1", "-p", "width=3"])
    assert made == [{"width": 3.0}, {"width": 2.0}, {"width": 3.0}]


def test_folders_of_others_are_not_overwritten(ran):
    (ran.root / "mine").mkdir()
    (ran.root / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ParameterError, match="holds no result of fig01_small"):
        rerun.rerun(ran, ["1", "--force", "--output", str(ran.root / "mine")])
    with pytest.raises(ParameterError, match="holds no result of fig02_works"):
        rerun.rerun(ran, ["2", "--force", "--output", str(result(ran))])
    (result(ran) / "notes.txt").write_text("x")
    with pytest.raises(ParameterError, match=r"holds files that rerun did not make, as notes.txt"):
        rerun.rerun(ran, ["1", "-p", "width=3", "--force"])


def test_failure_is_named_and_leaves_nothing(ran):
    before = {file: file.read_bytes() for file in result(ran).iterdir()}
    write(ran, "fig01_small", new_code_cell("light = 0\nraise ValueError('no light')"))
    with pytest.raises(NotebookError) as caught:
        rerun.rerun(ran, ["1", "-p", "width=3"])
    assert "notebooks/fig01_small.ipynb failed in cell 6 of 6" in str(caught.value)
    assert "the cell begins: light = 0" in str(caught.value)
    assert "width = 3.0" in str(caught.value)
    assert {file: file.read_bytes() for file in result(ran).iterdir()} == before
    assert os.listdir(ran.build) == ["rerun"]


def run_command(project, *arguments):
    """Start the command on a project in a terminal of its own."""
    code = f"import sys, pathlib, rerun\nrerun.__file__ = {str(project.root / 'book' / 'rerun.py')!r}\n"
    code += "sys.exit(rerun.main())"
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(ours, (24, 120))
    environment = os.environ | {"PYTHONPATH": str(ROOT / "book")}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], env=environment, stdout=theirs, stderr=theirs
    )
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


def test_progress_within_a_cell_is_shown(project):
    process, terminal = run_command(project, "2")
    said = heard(terminal)
    assert process.wait(60) == 0
    assert re.search(r"fig02_works:.*cell 5/5, curves [123]/3", said)
    assert "open " in said


def test_interruption_leaves_nothing(project):
    write(project, "fig02_works", new_code_cell("import time\nopen('begun', 'w').close()\ntime.sleep(99)"))
    process, terminal = run_command(project, "2")
    end = time.monotonic() + 60
    while not (project.notebooks / "begun").exists():
        assert time.monotonic() < end, "it did not begin"
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    assert "interrupted: nothing was written" in heard(terminal)
    assert process.wait(20) == 1
    assert list(project.build.iterdir()) == []


def test_command_line_ends_with_2_and_one_line():
    command = [sys.executable, str(ROOT / "book" / "rerun.py"), "3", "-p", "n_screen=5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "rerun: unknown parameter 'n_screen': did you mean 'n_screens'?\n"
    assert done.stdout == ""


@pytest.mark.slow
def test_real_figure_with_other_parameters(tmp_path):
    target = tmp_path / "figure"
    project = Project(ROOT)
    rerun.rerun(project, ["1", "-p", "rms=0.3", "-p", "n_pixels=40", "--output", str(target)])
    assert {f"fig01_sensor_layout.{kind}" for kind in ("html", "ipynb", "png", "pdf", "csv")} < set(
        os.listdir(target)
    )
    assert len((target / "fig01_sensor_layout.csv").read_text().splitlines()) == 41
    plain = re.sub(
        r"<script>.*?</script>|<[^>]*>", "", (target / "fig01_sensor_layout.html").read_text(), flags=re.S
    )
    assert "Figure 1 of the paper. Top" in plain
    assert "reference wave (3), so" in plain


FEW = ["n_pixels=16", "n_screens=1"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("figure", "parameters"),
    [
        # Neither the inputs that the text quotes, nor the pairs of phase shifts that the figure points out.
        ("identities", ["inputs=[4.0]", "n_modes=1", "n_shifts=5"]),
        # Every method fails at every diameter.
        ("4", ["n_screens_few=1", "rms=4", "n_iterations=1", "more_iterations=[1]", "step=2"]),
    ],
)
def test_pages_of_unusual_parameters_have_no_gaps(tmp_path, capsys, figure, parameters):
    values = [text for value in FEW + parameters for text in ("-p", value)]
    rerun.rerun(Project(ROOT), [figure, *values, "--output", str(tmp_path / "figure")])
    assert capsys.readouterr().err == ""
