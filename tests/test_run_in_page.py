"""Python in the pages of the built book, in a browser, against the same cells in this Python."""

import csv
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from zwfs.bench import Bench

from .conftest import ROOT, code_of, serving, watch

HTML = ROOT / "_build" / "html"
PYODIDE = os.environ.get("ZWFS_PYODIDE", "")
MINUTE = 60_000  # milliseconds
SMALL = {
    "n_pixels": 40,
    "n_screens": 2,
    "step": 0.5,
    "step_fine": 0.3,
    "n_screens_few": 2,
    "more_iterations": [50],
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (HTML / "_static" / "run").is_dir(), reason="the book is not built: make book"),
    pytest.mark.skipif(not PYODIDE, reason="ZWFS_PYODIDE names no folder with Pyodide"),
]

# Runs the cells of a notebook up to a figure, with the driver of the page but in this Python.
NATIVE = """
import json, sys
from book._ext import driver
driver.prepare(lambda *_: None)
about, given, figure = json.loads(sys.argv[1])
cells = about["notebook"]["cells"]
defaults = next(cell["source"] for cell in cells if "parameters" in cell["metadata"].get("tags", ()))
assert driver.begin(about["name"], defaults, json.dumps(given)) == ""
for cell in cells[: about["figures"][figure] + 1]:
    if cell["cell_type"] == "code" and "parameters" not in cell["metadata"].get("tags", ()):
        shown = json.loads(driver.cell(cell["source"]))
        assert "error" not in shown, shown
print(driver.draw(figure, "csv").decode())
"""


def settings(name):
    """Data that a script of the book defines."""
    return json.loads(
        (HTML / "_static" / "run" / f"{name}.js").read_text("utf-8").partition(" = ")[2].rstrip(";\n")
    )


def native(name, values, figure, folder=ROOT):
    """Return the columns that a notebook publishes with these parameters, computed here; files are in a folder."""
    parameters = {key: json.dumps(value) for key, value in values.items()}
    command = [sys.executable, "-c", NATIVE, json.dumps([settings(name), parameters, figure])]
    paths = os.pathsep.join([str(ROOT), str(ROOT / "notebooks")])
    done = subprocess.run(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return columns(done.stdout)


def columns(text):
    """Return the columns of a CSV file by their headers: numbers where all are numbers."""
    header, *rows = csv.reader(io.StringIO(text.strip()))
    arrays = {}
    for name, column in zip(header, zip(*rows, strict=True), strict=True):
        try:
            arrays[name] = np.array([cell for cell in column if cell], float)  # others are longer
        except ValueError:
            arrays[name] = np.array(column)
    return arrays


@pytest.fixture(scope="module")
def book():
    with serving(HTML) as url:
        yield url


class Page:
    """A page of the book with its form; Pyodide comes from the folder of the tests instead of its public place."""

    def __init__(self, browser, url, damaged="", **options):
        self.context = browser.new_context(**options)
        self.place = settings("settings")["place"]
        self.damaged = damaged
        self.context.route(f"{self.place}**", self.serve)
        self.page = self.context.new_page()
        self.page.set_default_timeout(2 * MINUTE)
        self.said, self.asked = watch(self.page)
        self.context.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(url)
        self.status = self.page.locator(".run-details [role=status]")

    def serve(self, route):
        name = route.request.url.rpartition("/")[2]
        if not Path(PYODIDE, name).exists():  # astropy is not in the folder of the tests
            route.abort()
            return
        body = Path(PYODIDE, name).read_bytes()
        kind = "application/wasm" if name.endswith(".wasm") else "application/octet-stream"
        body = body[:-1] + bytes([body[-1] ^ 1]) if name == self.damaged else body
        route.fulfill(body=body, headers={"content-type": kind, "access-control-allow-origin": "*"})

    def open(self):
        self.page.evaluate(
            "document.querySelectorAll('.run-details, .run-mapping').forEach(one => one.open = true)"
        )

    def fill(self, **values):
        """Fill fields of the form; a mapping is filled field by field."""
        self.open()
        for name, value in values.items():
            if isinstance(value, dict):
                self.fill(**{f"{name}.{key}": item for key, item in value.items()})
                continue
            field = self.page.locator(f'[name="{name}"]')
            if field.evaluate("one => one.tagName") == "SELECT":
                field.select_option(value)
            else:
                field.fill(str(value).strip("[]"))

    def run(self, button=".run-details button[type=submit]"):
        """Press a button, wait until Python is idle, and return what the page says."""
        self.open()
        self.page.click(button)
        self.page.wait_for_function("document.querySelector('.run-details progress').hidden")
        return self.status.inner_text()

    def columns(self):
        """Return the columns of the CSV file that the page offers, once it does."""
        link = self.page.locator(".run-files a", has_text=re.compile("^CSV$"))
        with self.page.expect_download() as started:
            link.click()
        return columns(Path(started.value.path()).read_text("utf-8"))


@pytest.fixture
def opened(browser, book):
    """Opens pages of the book."""
    pages = []

    def open_(name, **options):
        pages.append(Page(browser, book + name, **options))
        return pages[-1]

    yield open_
    for page in pages:
        page.context.close()


@pytest.fixture(scope="module")
def figure4(browser, book):
    """The page of Figure 4 with small parameters, for several tests: its Python starts once."""
    page = Page(browser, f"{book}notebooks/fig04_dimple_diameter.html")
    page.fill(**SMALL)
    yield page
    page.context.close()


def assert_equal_columns(actual, expected, tolerance=1e-9):
    assert list(actual) == list(expected)
    for name, column in expected.items():
        if column.dtype.kind == "f":
            np.testing.assert_allclose(actual[name], column, rtol=tolerance, atol=tolerance, err_msg=name)
        else:
            assert list(actual[name]) == list(column)


@pytest.mark.parametrize(
    ("name", "figure", "values", "tolerance"),
    [
        # An iteration that fails is chaotic: it takes another path after rounding.
        ("fig03_dynamic_range", "fig03_dynamic_range", {"n_pixels": 32, "n_modes": 50, "rms_max": 0.3, "n_rms": 2,
         "rms_fine": [], "rms_beyond": [], "n_screens": 1, "noise": {"photons": 1e10}}, 1e-6),
        ("fig09_bench_linearity", "fig09_bench_linearity", {"n_pixels": 40, "rms_max": 0.4, "n_rms": 2,
         "n_screens": 1}, 1e-6),
        ("beyond_range", "beyond_range", {"n_pixels": 32, "n_modes": 50, "inputs": [0.1, 0.5], "n_screens": 1,
         "inputs_noiseless": [], "photons": [1e4, 1e10], "n_screens_many": 1, "photons_shown": 1e4,
         "diameters": [1.0]}, 1e-6),
    ],
)  # fmt: skip
def test_figures_of_the_page_are_those_of_this_python(opened, name, figure, values, tolerance):
    page = opened(f"notebooks/{name}.html")
    page.fill(**values)
    assert page.run().startswith("Done"), page.said
    assert_equal_columns(page.columns(), native(name, values, figure), tolerance)


def test_figure_4_is_that_of_this_python_and_all_else_of_the_page_is_left_alone(figure4):
    assert not [url for url in figure4.asked if not url.startswith("http://127.0.0.1")], "before the click"
    assert figure4.run().startswith("Done"), figure4.said
    place = figure4.page.locator("figure.variants-fig04_dimple_diameter")
    assert place.locator(".run-mark").inner_text().startswith("Your parameters: n_pixels = 40")
    assert not place.locator(".run-book").first.is_visible()
    picture = place.locator(".run-yours .only-light img")
    assert picture.evaluate("one => one.naturalWidth") > 1000
    assert_equal_columns(figure4.columns(), native("fig04_dimple_diameter", SMALL, "fig04_dimple_diameter"), 1e-6)
    later = [url for url in figure4.asked if not url.startswith(("http://127.0.0.1", "blob:", "data:"))]
    assert later
    assert all(url.startswith(figure4.place) for url in later)
    figure4.page.click(".run-switch")
    assert place.locator(".run-book").first.is_visible()
    assert not picture.is_visible()
    assert figure4.said == []


def test_the_time_left_is_that_of_all_sweeps(opened):
    page = opened("notebooks/beyond_range.html")
    page.page.evaluate("""() => {
      window.told = [];
      const status = document.querySelector(".run-details [role=status]");
      const bar = document.querySelector(".run-details progress");
      const tell = () => told.push([performance.now() / 1000, status.textContent, bar.value]);
      new MutationObserver(tell).observe(status, { childList: true });
    }""")
    page.open()
    page.page.get_by_role("button", name="Quick values").click()
    assert page.run().startswith("Done"), page.said
    told = [(at, text, share) for at, text, share in page.page.evaluate("told") if text.startswith("Cell")]
    lefts = [float(left[1]) for _, text, _ in told if (left := re.search(r"about (\d+) s left$", text))]
    seconds = told[-1][0] - told[0][0]
    assert len(lefts) > 5, told
    assert lefts[-1] < max(2, seconds / 5) < sum(lefts[:3]), told  # the machine may be busy in between
    shares = [share for *_, share in told]
    assert shares == sorted(shares)
    assert shares[-1] > 0.8


@pytest.mark.parametrize(
    "values", [{"n_screens": "1e3"}, {"more_iterations": "[0]"}, {"pupil": {"kind": "elt"}, "n_pixels": "16"}]
)
def test_bad_values_are_refused_with_the_message_of_a_rerun(figure4, values):
    assignments = [
        f"{key}={json.dumps(value) if isinstance(value, dict) else value}" for key, value in values.items()
    ]
    options = [option for assignment in assignments for option in ("-p", assignment)]
    command = [sys.executable, "-m", "book._tools", "rerun", "fig04_dimple_diameter", *options]
    rerun = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert rerun.returncode == 2
    figure4.page.get_by_role("button", name="Values of the book").click()
    figure4.fill(**values)
    assert f"rerun: {figure4.run()}\n" == rerun.stderr
    assert "Traceback" not in figure4.page.content()


def test_a_run_can_be_stopped_and_repeated_and_its_address_shared(figure4):
    page = figure4.page
    page.get_by_role("button", name="Values of the book").click()
    figure4.fill(**SMALL, seed=7)
    url = page.evaluate("location.href")
    page.click(".run-details button[type=submit]")
    page.wait_for_function("document.querySelector('.run-details [role=status]').textContent.startsWith('Cell')")
    page.get_by_role("button", name="Stop").click()
    page.wait_for_function("document.querySelector('.run-details progress').hidden")
    assert figure4.status.inner_text().startswith("Stopped")
    page.goto("about:blank")
    page.goto(url)
    assert page.locator("[name=seed]").input_value() == "7"
    assert page.locator("[name=more_iterations]").input_value() == "50"
    command = page.locator(".run-command code").inner_text()
    assert "-p seed=7" in command
    assert "-p more_iterations=[50]" in command.replace("'", "")
    assert figure4.run().startswith("Done")


def test_six_runs_leave_no_memory_behind_and_an_example_runs_in_the_same_python(figure4):
    page = figure4.page
    coarse = {"step": 2, "step_fine": 0.3, "diameter_max": 3.5, "more_iterations": [10], "n_iterations": 5}
    figure4.fill(n_pixels=24, n_screens=1, n_screens_few=1, **coarse)
    sizes, objects = [], []
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    page.locator(".run-example button", has_text="Edit").first.click()
    edited = page.locator("textarea").first
    code = "print(10**10, pyodide_js._module.HEAPU8.length, len(gc.get_objects()), gc.collect())"
    edited.fill(f"import gc, pyodide_js\n{code}")
    for _ in range(6):
        assert figure4.run().startswith("Done")
        page.locator(".run-example button", has_text="Run").first.click()
        page.wait_for_function("/^10000000000 /.test(document.querySelector('.run-said').textContent)")
        _, size, number, _ = map(int, page.locator(".run-said").first.inner_text().split())
        sizes.append(size)
        objects.append(number)
    assert sizes[-1] <= sizes[2] * 1.25  # memory grows in steps of a fifth, of which one may come late
    assert objects[-1] <= objects[2] * 1.05


def test_the_example_of_the_front_page_gives_the_numbers_of_this_python(opened):
    page = opened("book/index.html").page
    [code] = code_of("index.md")
    code += "\nprint(repr(float(np.nansum(estimate.phase**2))))"
    page.get_by_role("button", name="Edit").click()
    page.locator("textarea").fill(code)
    page.get_by_role("button", name="Run", exact=True).click()
    page.wait_for_function("/\\d\\s*$/.test(document.querySelector('.run-said').textContent)")
    expected = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    *lines, number = page.locator(".run-said").inner_text().strip().split("\n")
    *said, value = expected.strip().split("\n")
    assert lines == said
    assert float(number) == pytest.approx(float(value), rel=1e-9)


def test_a_reconstructor_of_the_reader_runs_next_to_the_others(opened):
    page = opened("book/your_reconstructor.html").page
    page.get_by_role("button", name="Run", exact=True).click()
    said = page.locator(".run-said")
    page.wait_for_function("/FlatReference[ .\\d]+$/.test(document.querySelector('.run-said').textContent.trim())")
    assert said.inner_text().split() == page.locator(".highlight-text pre").inner_text().split()


def test_own_frames_in_npy_are_reconstructed_and_stay_on_this_computer(opened, tmp_path):
    bench = Bench(n_pixels=48)
    kinds = {
        "frame_files": bench.frames(seed=1),
        "pupil_files": bench.clear_frames(seed=2),
        "dark_files": bench.dark(seed=3),
    }
    for name, pair in kinds.items():
        np.save(tmp_path / f"{name}.npy", np.concatenate(pair, axis=-1))
    values = {"wavelength": 635.0, "diameter": 1.06, "phase_shifts": [1.5708, -1.5708], "gain": 1.0, "fitted": []}
    page = opened("notebooks/own_frames.html")
    page.fill(**values)
    for name in kinds:
        field = page.page.get_by_label(f"{name}, from this computer")
        field.set_input_files(tmp_path / f"{name}.npy")
    assert page.run().startswith("Done"), page.said
    files = {name: [f"{name}.npy"] for name in kinds}
    # The page rounds otherwise, in single precision: some 1e-6 rad, mostly of piston, which no image shows.
    assert_equal_columns(page.columns(), native("own_frames", values | files, "own_phase", tmp_path), 1e-5)
    assert not [
        url for url in page.asked if not url.startswith(("http://127.0.0.1", "blob:", "data:", page.place))
    ]


def test_figures_and_sentences_of_a_page_follow_and_results_of_the_book_are_marked_until_then(opened):
    page = opened("notebooks/zernike_sensor.html")
    page.fill(height=0.9, n_pixels=40)
    assert page.run().startswith("Done"), page.said
    book = page.page.get_by_text("The pixel has a phase of −1.20 rad")
    mark = "one => getComputedStyle(one.closest('.cell_output, .book-parameters'), '::before').content"
    assert "Result of the book" in book.evaluate(mark)
    page.page.get_by_role("button", name="Compute the rest of the page").click()
    page.page.wait_for_function("document.querySelectorAll('figure .run-yours').length >= 3")
    page.page.wait_for_function("document.querySelector('.run-details progress').hidden")
    assert page.page.evaluate("document.documentElement.dataset.run") == "changed"
    assert page.page.get_by_text(re.compile(r"The pixel has a phase of −0\.(8[5-9]|9[0-5]) rad")).is_visible()
    assert not book.is_visible()
    assert "Result of the book" in page.page.locator(".book-parameters p").first.evaluate(mark)
    page.page.get_by_role("button", name="Values of the book").click()
    assert page.page.evaluate("document.documentElement.dataset.run") == ""
    assert book.is_visible()
    assert page.page.locator(".run-yours:visible").count() == 0


@pytest.mark.parametrize("name", ["pyodide.asm.js", "pyodide.asm.wasm", "pyodide-lock.json", "numpy"])
def test_a_damaged_download_is_refused(opened, name):
    file = next(path.name for path in Path(PYODIDE).iterdir() if path.name.startswith(name))
    page = opened("notebooks/fig01_sensor_layout.html", damaged=file)
    assert file in page.run()
    assert page.page.locator(".run-yours").count() == 0


def test_a_page_from_the_disk_runs_too(browser):
    page = Page(browser, (HTML / "notebooks" / "fig01_sensor_layout.html").as_uri(), color_scheme="dark")
    page.fill(n_pixels=32)
    assert page.run().startswith("Done"), page.said
    assert page.page.locator(".run-yours .only-dark img").is_visible()
    page.context.close()
