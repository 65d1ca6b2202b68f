"""The live sensor: its script against zwfs, and its page, in a browser."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import zwfs
from book._ext import live

ROOT = Path(__file__).parent.parent
STATIC = ROOT / "book" / "_static"
MARKUP = re.search(r"```\{raw\} html\n(.*?)```", (ROOT / "book" / "live.md").read_text("utf-8"), re.DOTALL)[1]
# The simplest shifts, unequal ones, ones of one sign; wide and narrow dimples: rms, seed, diameter (lambda/D),
# shifts (pi), iterations.
SETTINGS = [
    (0.5, 7, 1.06, (0.5, -0.5), 10),
    (1.2, 3, 1.06, (0.5, -0.5), 25),
    (0.8, 50, 2.0, (0.5, -0.5), 8),
    (0.6, 11, 0.5, (0.7, -0.36), 12),
    (0.3, 1, 1.5, (0.5, 0.24), 10),
    (0.4, 24, 3.0, (0.5, -0.5), 4),
    (0.7, 9, 1.3, (1.0, -0.4), 6),
    (0.0, 2, 0.82, (0.5, -0.5), 1),
    (0.5, 5, 1.06, (0.5, -0.5), 0),
]


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(live.N_PIXELS)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, live.N_MODES)


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    """The page of the live sensor without the book around it, opened as a file."""
    book = tmp_path_factory.mktemp("site")
    static = book / "_static"
    shutil.copytree(STATIC, static)
    (static / Path(live.DATA).name).write_text(live.script(), "utf-8")
    (book / "book").mkdir()
    file = book / "book" / "live.html"
    file.write_text(f'<!doctype html><html lang="en"><meta charset="utf-8"><body>{MARKUP}</body></html>', "utf-8")
    page = browser.new_page(viewport={"width": 1000, "height": 800})
    page.said, page.asked = [], []
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    page.goto(file.as_uri())
    return page


COMPUTE = """settings => {
    const photons = settings.photons ?? Infinity;
    const made = window.zwfsLive.compute({ ...settings, photons });
    const plain = (value) => (ArrayBuffer.isView(value) ? [...value] : value);
    return { ...Object.fromEntries(Object.entries(made).map(([name, value]) => [name, plain(value)])),
             frames: made.frames.map(plain) };
}"""


@pytest.fixture
def compute(page, pupil):
    """Runs the script's model; maps come back as arrays."""

    def call(rms, seed, diameter, shifts, iterations, photons=None):
        shifts = [shift * np.pi for shift in shifts]
        made = page.evaluate(
            COMPUTE,
            {"rms": rms, "seed": seed, "diameter": diameter, "shifts": shifts, "iterations": iterations}
            | ({"photons": photons} if photons else {}),
        )
        maps = {name: np.array(made[name]).reshape(-1, *pupil.shape) for name in ("phase", "frames")}
        if not made["singular"]:
            maps |= {name: np.array(made[name]).reshape(pupil.shape) for name in ("estimate", "residual")}
        return made | maps

    return call


def sensor_of(pupil, diameter, shifts):
    return zwfs.ZernikeSensor(pupil, *(zwfs.Dimple(diameter, shift * np.pi) for shift in shifts))


@pytest.mark.parametrize(("rms", "seed", "diameter", "shifts", "iterations"), SETTINGS)
def test_script_agrees_with_zwfs(compute, pupil, modes, rms, seed, diameter, shifts, iterations):
    made = compute(rms, seed, diameter, shifts, iterations)
    phase = zwfs.power_law_screens(modes, rms, 1, seed=seed)[0] if rms else np.zeros(pupil.shape)
    sensor = sensor_of(pupil, diameter, shifts)
    frames = sensor.measure(phase)
    np.testing.assert_allclose(made["phase"][0], phase, atol=1e-5)
    np.testing.assert_allclose(made["frames"], frames, atol=1e-5)
    assert made["strehl"] == pytest.approx(zwfs.strehl(pupil, phase), abs=1e-5)

    history = np.zeros((1, *pupil.shape))
    if iterations:
        reconstruct = zwfs.PhaseShifted(sensor, n_iterations=iterations, tolerance=0.0)
        found = reconstruct(frames, history=True)
        history = found.history
        assert made["unsolved"] == found.n_unsolved
    inside = pupil.inside
    turn = np.angle(np.exp(1j * (made["estimate"] - history[-1])))
    np.testing.assert_allclose(turn[inside], 0, atol=1e-5)
    residual = zwfs.wrapped_residual(pupil, history[-1], phase)
    np.testing.assert_allclose(made["residual"][inside], residual[inside], atol=1e-5)
    np.testing.assert_allclose(made["errors"], zwfs.reconstruction_error(pupil, history, phase), atol=1e-5)


def test_noise_has_the_statistics_of_photons(compute, pupil):
    settings = (0.5, 7, 1.06, (0.5, -0.5), 5)
    clean = compute(*settings)["frames"]
    for photons in (3e4, 1e6):
        per_pixel = photons / pupil.n_points
        counts = compute(*settings, photons=photons)["frames"] * per_pixel
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        normal = (counts - clean * per_pixel) / np.sqrt(clean * per_pixel)
        # 8192 pixels: their mean and mean square have standard deviations of 0.011 and 0.016, or a bit more.
        assert abs(normal.mean()) < 0.06
        assert abs(np.mean(normal**2) - 1) < 0.09
    again = compute(*settings, photons=1e6)["frames"] * per_pixel
    np.testing.assert_array_equal(again, counts)


@pytest.mark.parametrize("shifts", [(0.5, 0.5), (0.5, 0.0), (1.0, -1.0), (0.0, 1.0)])
def test_singular_shifts_give_no_reconstruction(compute, pupil, shifts):
    made = compute(0.5, 7, 1.06, shifts, 10)
    assert made["singular"]
    assert made["estimate"] is None
    assert made["errors"] is None
    with pytest.raises(ValueError, match="determinant"):
        zwfs.PhaseShifted(sensor_of(pupil, 1.06, shifts))


def test_sliders_stay_in_the_range_of_the_data(page):
    limits = {
        name: [float(page.get_attribute(f"#live-{name}", end)) for end in ("min", "max")]
        for name in ("seed", "diameter")
    }
    assert limits == {"seed": [1, live.N_SEEDS], "diameter": list(live.DIAMETERS)}


def test_page_answers_the_keyboard_and_keeps_its_height(page):
    def seen(name):
        return page.inner_text(f"#live-{name}")

    height = page.evaluate("document.documentElement.scrollHeight")
    error = seen("error-rms")
    page.focus("#live-rms")
    page.keyboard.press("End")
    page.wait_for_function("document.getElementById('live-input-rms').textContent === '1.50 rad rms'")
    assert page.get_attribute("#live-rms", "aria-valuetext") == "1.50 rad"
    assert seen("error-rms") != error

    page.focus("#live-shift-b")
    page.keyboard.press("End")
    page.focus("#live-shift-a")
    page.keyboard.press("End")
    page.wait_for_selector("#live-error-rms:has-text('singular')")
    assert "Singular" in seen("says")
    page.wait_for_function("document.getElementById('live-announced').textContent.includes('singular')")
    assert "singular" in page.get_attribute("#live-found", "aria-label")
    assert page.evaluate("document.documentElement.scrollHeight") == height

    page.focus("#live-run")
    page.keyboard.press("Enter")
    page.wait_for_function("document.getElementById('live-seed').value === '9'")
    page.click("#live-reset")
    page.wait_for_function(f"document.getElementById('live-error-rms').textContent === '{error}'")
    assert page.input_value("#live-seed") == "7"


def test_page_says_nothing_and_asks_for_nothing_else(page):
    assert page.said == []
    assert {address.split(":")[0] for address in page.asked} == {"file"}
