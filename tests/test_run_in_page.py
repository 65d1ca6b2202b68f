"""Python in the pages of the built book, in a browser, against the same cells in this Python."""

import csv
import functools
import io
import json
import os
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from .conftest import watch

ROOT = Path(__file__).parent.parent
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
        shown = json.loads(driver.cell(cell["source"], "[]"))
        assert "error" not in shown, shown
print(driver.draw(figure, "csv").decode())
"""


def settings(name):
    """Data that a script of the book defines."""
    return json.loads(
        (HTML / "_static" / "run" / f"{name}.js").read_text("utf-8").partition(" = ")[2].rstrip(";\n")
    )


def native(name, values, figure):
    """Return the columns that a notebook publishes with these parameters, computed here."""
    given = {key: json.dumps(value) for key, value in values.items()}
    command = [sys.executable, "-c", NATIVE, json.dumps([settings(name), given, figure])]
    paths = os.pathsep.join([str(ROOT), str(ROOT / "notebooks")])
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return columns(done.stdout)


def columns(text):
    """Return the columns of a CSV file by their headers: numbers where all are numbers."""
    header, *rows = csv.reader(io.StringIO(text.strip()))
    made = {}
    for name, column in zip(header, zip(*rows, strict=True), strict=True):
        try:
            made[name] = np.array(column, float)
        except ValueError:
            made[name] = np.array(column)
    return made


@pytest.fixture(scope="module")
def book():
    """The built book on a server of this computer."""
    handler = functools.partial(SimpleHTTPRequestHandler, directory=HTML)
    handler.func.log_message = lambda *_: None
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


class Page:
    """A page of the book with its form; Pyodide comes from the folder of the tests instead of its public place."""

    def __init__(self, browser, address, damaged="", **options):
        self.context = browser.new_context(**options)
        self.place = settings("settings")["place"]
        self.damaged = damaged
        self.context.route(f"{self.place}**", self.serve)
        self.page = self.context.new_page()
        self.page.set_default_timeout(4 * MINUTE)
        self.said, self.asked = watch(self.page)
        self.context.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)
        self.status = self.page.locator(".run-details [role=status]")

    def serve(self, route):
        name = route.request.url.rpartition("/")[2]
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
                self.fill(**{f"{name}.{key}": one for key, one in value.items()})
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
        link = self.page.locator(".run-files a", has_text="CSV")
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
    for one in pages:
        one.context.close()


@pytest.fixture(scope="module")
def figure4(browser, book):
    """The page of Figure 4 with small parameters, for several tests: its Python starts once."""
    page = Page(browser, f"{book}notebooks/fig04_dimple_diameter.html")
    page.fill(**SMALL)
    yield page
    page.context.close()


def assert_equal_columns(found, expected, tolerance=1e-9):
    assert list(found) == list(expected)
    for name, column in expected.items():
        if column.dtype.kind == "f":
            np.testing.assert_allclose(found[name], column, rtol=tolerance, atol=tolerance, err_msg=name)
        else:
            assert list(found[name]) == list(column)


def test_the_figure_of_the_page_is_that_of_this_python(figure4):
    asked = set(figure4.asked)
    assert not [one for one in asked if not one.startswith("http://127.0.0.1")], "before the click"
    assert figure4.run().startswith("Done"), figure4.said
    place = figure4.page.locator("figure.variants-fig04_dimple_diameter")
    assert place.locator(".run-mark").inner_text().startswith("Your parameters: n_pixels = 40")
    assert not place.locator("img.run-book, .run-book").first.is_visible()
    picture = place.locator(".run-yours .only-light img")
    assert picture.evaluate("one => one.naturalWidth") > 1000
    assert_equal_columns(figure4.columns(), native("fig04_dimple_diameter", SMALL, "fig04_dimple_diameter"), 1e-6)
    later = {one for one in figure4.asked if not one.startswith(("http://127.0.0.1", "blob:", "data:"))}
    assert later
    assert all(one.startswith(figure4.place) for one in later)
    figure4.page.click(".run-switch")
    assert place.locator(".run-book").first.is_visible()
    assert not picture.is_visible()
