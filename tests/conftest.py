import functools
import inspect
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import nbformat
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

import zwfs
from zwfs.bench import Bench, BenchModel

ROOT = Path(__file__).parent.parent
os.environ.pop("ZWFS_SWEEPS", None)  # a test computes, and reads no stored results


EXAMPLES = ROOT / "tests" / "examples"  # of CONTRIBUTING


def code_of(page, language="python"):
    """Blocks of code of a page of the book."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "book" / page).read_text("utf-8"), re.S)


def needs_modes(method):
    """Whether a reconstructor cannot be made without modes."""
    modes = inspect.signature(method).parameters.get("modes")
    return modes is not None and modes.default is inspect.Parameter.empty


# On a busy machine examples are slow; this is not a failure.
BUSY = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("zwfs", derandomize=True, max_examples=15, **BUSY)
settings.register_profile("fuzz", max_examples=1000, print_blob=True, **BUSY)
settings.load_profile("zwfs")


# Fixtures that start kernels, clusters, set-ups or a browser, build a book, calibrate a bench or need real frames.
SLOW = {
    "browser",
    "calibrated",
    "clone",
    "cluster",
    "foreign_cluster",
    "plain_book",
    "real",
    "seal",
    "template",
}


def pytest_collection_modifyitems(items):
    for item in items:
        if SLOW & set(item.fixturenames):
            item.add_marker(pytest.mark.slow)


def heed_signals():
    """Restore in a child the signals that a shell in the background (SIGINT) and nohup (SIGHUP) ignore."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def start_tool(root, *arguments, **streams):
    """Start a command of the book on another project."""
    code = (
        "import pathlib, sys; from book._tools.__main__ import main; from book._tools.project import Project;"
        f"sys.exit(main(sys.argv[1:], Project(pathlib.Path({str(root)!r}))))"
    )
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.Popen(command, cwd=ROOT, preexec_fn=heed_signals, **streams)


@contextmanager
def serving(folder):
    """Serve a folder on this computer, and return its address."""
    handler = functools.partial(SimpleHTTPRequestHandler, directory=folder)
    handler.func.log_message = lambda *_: None
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def glued(path, **values):
    """Write a notebook that has glued these values, and printed something."""
    outputs = [
        nbformat.v4.new_output(
            "display_data",
            {"application/papermill.record/text/plain": repr(value)},
            metadata={"scrapbook": {"name": name}},
        )
        for name, value in values.items()
    ]
    cell = nbformat.v4.new_code_cell("", outputs=[*outputs, nbformat.v4.new_output("stream", text="")])
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)


def wait_until(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)


def alive(pid):
    try:
        os.kill(pid, 0)
        return not Path("/proc").exists() or "Z (zombie)" not in Path(f"/proc/{pid}/status").read_text()
    except (ProcessLookupError, FileNotFoundError):
        return False


def pair(pupil, diameter=1.06, shifts=(np.pi / 2, -np.pi / 2), **options):
    """Sensor with a dimple for each phase shift."""
    return zwfs.ZernikeSensor(pupil, *(zwfs.Dimple(diameter, shift) for shift in shifts), **options)


@pytest.fixture(scope="session")
def pupil():
    return zwfs.Pupil.circular(40)


@pytest.fixture(scope="session")
def modes(pupil):
    return zwfs.zernike_basis(pupil, 30)


@pytest.fixture(scope="session")
def screens(modes):
    """Makes n screens of a given rms."""

    def make(rms, n_screens=3, seed=1):
        return zwfs.power_law_screens(modes, rms, n_screens, seed=seed)

    return make


@pytest.fixture(scope="session")
def classic(pupil):
    return zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2))


@pytest.fixture(scope="session")
def shifted(pupil):
    return pair(pupil)


SMALL = {"n_pixels": 68, "gap": 0.02, "stop": 0.8}  # of a bench: half its camera, 11 pixels of margin


def ideal_bench(**changes):
    return Bench.ideal(**{**SMALL, **changes})


@pytest.fixture(scope="session")
def perfect():
    return ideal_bench()


@pytest.fixture(scope="session")
def model(perfect):
    return BenchModel.from_images(perfect)


@pytest.fixture(scope="session")
def rough_pupil():
    """Uneven amplitude on an image that is no square, with the axis off its middle."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:34, :40]
    image = rng.uniform(0.5, 1.5, x.shape) * (np.hypot(x - 20.3, y - 16) < 15)
    return zwfs.Pupil.from_amplitude(image, n_pixels=31.4, center=(16, 20.3))


@pytest.fixture(scope="session")
def complex_field():
    """Makes white complex fields on a pupil."""

    def make(pupil, *batch, seed=0):
        rng = np.random.default_rng(seed)
        return rng.normal(size=(*batch, *pupil.shape)) + 1j * rng.normal(size=(*batch, *pupil.shape))

    return make


def watch(page):
    """The errors and warnings of a page of the browser, and every address that it asks for."""
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    return said, asked


def find_chromium():
    """Return the path of a Chromium: the one in ``ZWFS_CHROMIUM``, else that of the system."""
    named = os.environ.get("ZWFS_CHROMIUM")
    programs = [named] if named else ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"]
    return next(filter(None, map(shutil.which, programs)), None)


@pytest.fixture(scope="module")
def browser():
    """A Chromium, driven by Playwright; it is closed with the module, whose event loop others could not share."""
    from playwright.sync_api import sync_playwright

    program = find_chromium()
    if program is None:
        missing = "no Chromium: install one, or name it in ZWFS_CHROMIUM"
        (pytest.fail if os.environ.get("ZWFS_REQUIRE_BROWSER") else pytest.skip)(missing)
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield chromium
        chromium.close()
