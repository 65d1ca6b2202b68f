"""The live sensor: its scripts against zwfs, and its page, in a browser."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import zwfs
from book._ext import live
from studies.design import Design, photon_costs
from studies.kit.setups import screens_at
from zwfs.masks import focal_field

from .conftest import ROOT, watch

STATIC = ROOT / "book" / "_static"
SOURCE = (ROOT / "book" / "live.md").read_text("utf-8")
MARKUP = "".join(re.findall(r"```\{raw\} html\n(.*?)```", SOURCE, re.DOTALL))
TRIES = "".join(re.findall(r"<button .*?</button>", SOURCE[SOURCE.index("## What to try") :]))
# The simplest shifts, unequal ones, ones of one sign; wide and narrow dimples: rms, seed, diameter (lambda/D),
# shifts (pi), iterations.
SETTINGS = [
    (1.0, 22, 1.06, (0.5, -0.5), 15),
    (0.8, 50, 2.0, (0.5, -0.5), 8),
    (0.6, 11, 0.5, (0.7, -0.36), 12),
    (0.3, 1, 1.5, (0.5, 0.24), 10),
    (0.4, 24, 3.0, (0.5, -0.5), 4),
    (0.0, 2, 0.82, (0.5, -0.5), 0),
]


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(live.N_PIXELS)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, live.N_MODES)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The page of the live sensor without the book around it."""
    book = tmp_path_factory.mktemp("site")
    static = book / "_static"
    shutil.copytree(STATIC, static)
    (static / Path(live.DATA).name).write_text(live.script(), "utf-8")
    (book / "book").mkdir()
    file = book / "book" / "live.html"
    body = f'<body class="bd-article">{TRIES}{MARKUP}</body>'
    file.write_text(f'<!doctype html><html lang="en"><meta charset="utf-8">{body}</html>', "utf-8")
    return file


@pytest.fixture(scope="module")
def page(browser, file):
    page = browser.new_page(viewport={"width": 1000, "height": 800})
    page.said, page.asked = watch(page)
    page.goto(file.as_uri())
    return page


@pytest.fixture
def fresh(page):
    """The page in its first state."""
    page.click("#live-play")
    page.click("button:text-is('The paper')")
    page.evaluate("window.zwfsLive.page.set({ rms: '1', seed: '22', 'per-point': '5.75' })")
    page.wait_for_function("location.hash === ''")
    wait_for_drawing(page)
    return page


def wait_for_drawing(page):
    """Wait until the page has been drawn again: what it says may be the same before and after."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


COMPUTE = """settings => {
    const live = window.zwfsLive;
    const rows = (map) => {
        const out = new Array(map.length);
        map.forEach((value, k) => { out[live.places[k]] = value; });
        return out;
    };
    const standard = { photons: Infinity, both: false, accelerated: false, likelihood: false };
    const state = live.compute({ ...standard, ...settings });
    const summary = (estimate) => estimate && {
        errors: estimate.errors,
        residual: rows(estimate.residual),
        phase: rows(estimate.estimate[0].map((re, k) => Math.atan2(estimate.estimate[1][k], re))),
    };
    return {
        phase: rows(state.phase), frames: state.frames.map(rows), focal: [...state.focal], strehl: state.strehl,
        linear: summary(state.linear), arcsine: summary(state.arcsine), shifted: summary(state.shifted),
        accelerated: summary(state.accelerated), likelihood: summary(state.likelihood),
    };
}"""


@pytest.fixture
def compute(page, pupil):
    """Runs the model of the page; maps come back as arrays."""

    def call(rms, seed, diameter, shifts, iterations, **others):
        settings = {"rms": rms, "seed": seed, "diameter": diameter, "iterations": iterations}
        state = page.evaluate(COMPUTE, settings | {"shifts": [shift * np.pi for shift in shifts]} | others)
        for maps in (state, *(value for value in state.values() if isinstance(value, dict))):
            maps |= {name: np.array(maps[name]) for name in ("phase", "residual") if name in maps}
            maps |= {name: maps[name].reshape(pupil.shape) for name in ("phase", "residual") if name in maps}
        return state | {"frames": np.array(state["frames"]).reshape(-1, *pupil.shape)}

    return call


def sensor_of(pupil, diameter, shifts):
    return zwfs.ZernikeSensor(pupil, *(zwfs.Dimple(diameter, shift * np.pi) for shift in shifts))


def screen_of(modes, rms, seed):
    return zwfs.power_law_screens(modes, rms, 1, seed=seed)[0]


def assert_same_phase(pupil, estimate, expected, tolerance=1e-5):
    """Compare phases on the circle, without piston."""
    difference = pupil.gather(zwfs.wrapped_residual(pupil, estimate, expected))
    assert np.all(np.abs(difference) <= tolerance)


@pytest.mark.parametrize(("rms", "seed", "diameter", "shifts", "iterations"), SETTINGS)
def test_sensor_and_reconstructors_agree_with_zwfs(compute, pupil, modes, rms, seed, diameter, shifts, iterations):
    state = compute(rms, seed, diameter, shifts, iterations)
    phase = screen_of(modes, rms, seed)
    np.testing.assert_allclose(state["phase"], phase, atol=1e-5)
    np.testing.assert_allclose(state["frames"], sensor_of(pupil, diameter, shifts).measure(phase), atol=1e-5)
    assert state["strehl"] == pytest.approx(zwfs.strehl(pupil, phase), abs=1e-5)
    axis = 4 * (2 * np.arange(48) - 47) / 48
    focal = np.abs(focal_field(pupil, np.exp(1j * phase), axis, axis)) ** 2
    np.testing.assert_allclose(np.reshape(state["focal"], focal.shape), focal, atol=1e-5)
    single, both = sensor_of(pupil, diameter, shifts[:1]), sensor_of(pupil, diameter, shifts)
    histories = {"linear": zwfs.Linear(single, modes, poke=1e-4)(single.measure(phase)).phase[np.newaxis]}
    for name, method, sensor in (("arcsine", zwfs.Arcsine, single), ("shifted", zwfs.PhaseShifted, both)):
        histories[name] = np.zeros((1, *pupil.shape))
        if iterations:
            reconstruct = method(sensor, n_iterations=iterations, tolerance=0.0)
            histories[name] = reconstruct(sensor.measure(phase), history=True).history
    state["both"] = compute(rms, seed, diameter, shifts, 0, both=True)["linear"]
    histories["both"] = zwfs.Linear(both, modes, poke=1e-4)(both.measure(phase)).phase[np.newaxis]
    for name, history in histories.items():
        assert_same_phase(pupil, state[name]["phase"], history[-1])
        residual = zwfs.wrapped_residual(pupil, history[-1], phase)
        np.testing.assert_allclose(pupil.gather(state[name]["residual"]), pupil.gather(residual), atol=1e-5)
        errors = zwfs.reconstruction_error(pupil, history, phase)
        np.testing.assert_allclose(state[name]["errors"], errors, atol=1e-5)


@pytest.mark.parametrize(
    ("rms", "seed", "diameter", "shifts", "iterations", "tolerance"),
    [
        (3.0, 22, 1.06, (0.5, -0.5), 30, 1e-5),  # the plain iteration fails
        (0.3, 1, 1.5, (0.5, 0.24), 20, 1e-5),
        (0.8, 50, 2.0, (0.5, -0.5), 30, 1e-4),  # the weakest functions are rounded, and count as much as all
    ],
)
def test_accelerated_iteration_agrees_with_zwfs(
    compute, pupil, modes, rms, seed, diameter, shifts, iterations, tolerance
):
    phase = screen_of(modes, rms, seed)
    state = compute(rms, seed, diameter, shifts, iterations, accelerated=True)["accelerated"]
    options = {"n_iterations": iterations, "tolerance": 0.0, "accelerate": True}
    # The secant weighs all coefficients alike: the path depends on their number, the fixed point does not.
    exact = sensor_of(pupil, diameter, shifts)
    coarse = zwfs.ZernikeSensor(pupil, *exact.masks, tolerance=live.TOLERANCE)
    history = zwfs.PhaseShifted(coarse, **options)(exact.measure(phase), history=True).history
    np.testing.assert_allclose(state["errors"], zwfs.reconstruction_error(pupil, history, phase), atol=tolerance)
    assert_same_phase(pupil, state["phase"], zwfs.PhaseShifted(exact, **options)(exact.measure(phase)).phase)


@pytest.mark.parametrize(
    ("rms", "seed", "diameter", "shifts", "photons"),
    [
        (2.0, 7, 1.06, (0.5, -0.5), None),
        (0.4, 24, 3.0, (0.3, -0.68), None),
        (0.5, 7, 2.05, (0.33, -0.74), 3e4),
    ],
)
def test_maximum_likelihood_agrees_with_zwfs(compute, pupil, rms, seed, diameter, shifts, photons):
    noise = {} if photons is None else {"photons": photons}
    state = compute(rms, seed, diameter, shifts, 30, likelihood=True, **noise)
    sensor = sensor_of(pupil, diameter, shifts)
    result = zwfs.MaximumLikelihood(sensor, photons=photons)(state["frames"])
    if photons is None:
        assert_same_phase(pupil, state["likelihood"]["phase"], result.phase)
        return
    # Both stop at a step of a thousandth of the mean standard error: dark points are less certain.
    assert_same_phase(pupil, state["likelihood"]["phase"], result.phase, 0.1 * pupil.gather(result.sigma))
    assert zwfs.reconstruction_error(pupil, state["likelihood"]["phase"], result.phase) < 1e-5


def test_noise_has_the_statistics_of_photons(compute, pupil):
    settings = (0.5, 7, 1.06, (0.5, -0.5), 5)
    clean = compute(*settings)["frames"]
    for photons in (10, 300):
        counts = compute(*settings, photons=photons)["frames"] * photons
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        normal = (counts - clean * photons) / np.sqrt(clean * photons)
        # 8192 pixels: their mean and mean square have standard deviations of 0.011 and 0.016, or a bit more.
        assert abs(normal.mean()) < 0.06
        assert abs(np.mean(normal**2) - 1) < 0.09
    again = compute(*settings, photons=photons)["frames"] * photons
    np.testing.assert_array_equal(again, counts)


def is_refused(method, *arguments):
    try:
        method(*arguments)
    except ValueError:
        return True
    return False


SINGULAR = [(0.5, 0.5), (0.5, 0.0), (1.0, -1.0), (0.0, 1.0), (0.5 + 3e-7, 0.5), (1e-9 / np.pi, 0.5)]


@pytest.mark.parametrize("shifts", [*SINGULAR, (0.5 + 4e-6, 0.5), (1e-8 / np.pi, 0.5)])
def test_singular_shifts_are_refused_as_by_zwfs(compute, pupil, modes, shifts):
    state = compute(0.5, 7, 1.06, shifts, 1)
    refused = is_refused(zwfs.PhaseShifted, sensor_of(pupil, 1.06, shifts))
    assert (state["shifted"] is None) == refused == (shifts in SINGULAR)
    for n_images, both in ((1, False), (2, True)):
        solution = compute(0.5, 7, 1.06, shifts, 1, both=both)["linear"]
        refused = is_refused(zwfs.Linear, sensor_of(pupil, 1.06, shifts[:n_images]), modes)
        assert (solution is None) == refused


@pytest.mark.parametrize("shift", [1.0, 0.999])
def test_arcsine_takes_the_side_of_zwfs_where_waves_are_in_line(compute, pupil, modes, shift):
    state = compute(0.3, 6, 1.06, (shift, -0.5), 5)
    sensor, phase = sensor_of(pupil, 1.06, (shift,)), screen_of(modes, 0.3, 6)
    history = zwfs.Arcsine(sensor, n_iterations=5, tolerance=0.0)(sensor.measure(phase), history=True).history
    errors = zwfs.reconstruction_error(pupil, history, phase)
    np.testing.assert_allclose(state["arcsine"]["errors"], errors, atol=1e-5)


def test_designs_are_those_of_the_notebook(pupil, modes):
    table = live.designs()
    wavefronts = {"flat wavefront": np.zeros((1, *pupil.shape))} | {
        f"{rms:g} rad rms": screens_at(modes, rms, 6, 2024, task, -2.0) for task, rms in enumerate((0.5, 1.0))
    }
    places = [(0, 0), (6, 8), (16, 4)]
    theta = np.pi * np.array(table["shifts"])
    chosen = [Design("", table["diameters"][x], theta[y], -theta[y]) for x, y in places]
    for name, costs in photon_costs(pupil, chosen, wavefronts).items():
        np.testing.assert_allclose([table["costs"][name][x][y] for x, y in places], costs, rtol=1e-5)


def wait_for_address(page, *parts):
    for part in parts:
        page.wait_for_function("part => location.hash.includes(part)", arg=part)


@pytest.mark.parametrize(
    ("preset", "expected", "named"),
    [
        ("The paper", "✗✗✓", "phase-shifted"),
        ("Keck", "✗✗✓", "max. likelihood"),
        ("OZIRIIS", "✗✗✓", "max. likelihood"),
        ("All-round", "✗✗✓", "accelerated"),
        ("Large dimple", "✗✗✗", "phase-shifted"),
        ("Out of range", "✗✗✗", "phase-shifted"),
        ("A large input", "✗✗✗", "phase-shifted"),
        ("The same, accelerated", "✗✗✓", "accelerated"),
        ("The same with maximum likelihood", "✗✗✓", "max. likelihood"),
        ("A small input", "✗✓✓", "phase-shifted"),
        ("The same, linear from both images", "✓✓✓", "phase-shifted"),
    ],
)
def test_presets_and_buttons_set_the_sensor_up(fresh, preset, expected, named):
    fresh.click(f"button:text-is('{preset}')")
    if fresh.inner_text("#live-play") == "■ Stop":
        fresh.click("#live-play")
        fresh.evaluate("window.zwfsLive.page.set({ iterations: '30' })")
    wait_for_drawing(fresh)
    assert [fresh.inner_text(f"#live-verdict-{place}")[0] for place in range(3)] == [*expected]
    assert fresh.inner_text("#live-name-2") == named


def test_next_leads_through_all_that_there_is_to_try_and_begins_again(fresh):
    names = re.findall(r"<button .*?>(.*?)</button>", TRIES)
    first, *others = names
    fresh.click(f"button:text-is('{first}')")
    for name in others:
        assert fresh.inner_text("#live-next") == f"Next: {name}"
        fresh.click("#live-next")
        assert fresh.inner_text("#live-tried").startswith(f"{name}: ")
    assert fresh.inner_text("#live-next") == f"Again: {first}"
    fresh.click("#live-next")
    assert fresh.inner_text("#live-next") == f"Next: {others[0]}"


def test_designs_keep_the_input_and_the_address_follows_them(fresh):
    fresh.evaluate("window.zwfsLive.page.set({ rms: '0.3', seed: '5', 'per-point': '3' })")
    fresh.click("button:text-is('Keck')")
    wait_for_address(fresh, "rms=0.3", "seed=5", "per-point=3", "diameter=2.4")
    assert fresh.get_attribute("button:text-is('Keck')", "aria-pressed") == "true"
    fresh.click("#live-play")
    fresh.wait_for_function("/iterations=[1-9](&|$)/.test(location.hash)")  # while it plays


def test_the_state_is_in_the_address(fresh, browser, file):
    state = {"rms": "0.73", "diameter": "1.5", "shift-b": "-0.25", "likelihood": "1"}
    fresh.evaluate("state => window.zwfsLive.page.set(state)", state)
    wait_for_address(fresh, "rms=0.73", "diameter=1.5", "shift-b=-0.25", "likelihood=1")
    assert "seed" not in fresh.url
    shared = browser.new_page()
    shared.goto(fresh.url)
    same = "window.zwfsLive.page.settings()"
    assert shared.evaluate(f"JSON.stringify({same})") == fresh.evaluate(f"JSON.stringify({same})")
    assert shared.inner_text("#live-says") == fresh.inner_text("#live-says")
    # A new address sets the sliders, within their range. That of a heading does not.
    for text, rms in (("#rms=0.2", 0.2), ("#rms=7&seed=x", 4)):
        shared.evaluate("text => { location.hash = text; }", text)
        shared.wait_for_function(f"rms => {same}.rms === rms", arg=rms)
        assert shared.evaluate(f"{same}.seed") == 22
    # Nor does a link to a heading take the settings out of the address.
    shared.evaluate("location.hash = '#what-to-try'")
    wait_for_address(shared, "rms=4")
    assert shared.evaluate(f"{same}.rms") == 4
    # Addresses of an earlier version counted the photons of all 3228 points.
    shared.evaluate("location.hash = '#photons=6'")
    shared.wait_for_function(f"Math.abs({same}.photons - 1e6 / 3228) < 0.03 * {same}.photons")
    shared.close()


def test_page_answers_the_keyboard_and_keeps_its_height(fresh):
    height = fresh.evaluate("document.documentElement.scrollHeight")
    fresh.focus("#live-rms")
    fresh.keyboard.press("End")
    fresh.wait_for_function("document.getElementById('live-says').textContent.includes('4.00 rad rms')")
    assert fresh.get_attribute("#live-rms", "aria-valuetext") == "4.00 rad"

    fresh.focus("#live-shift-b")
    fresh.keyboard.press("End")
    fresh.focus("#live-shift-a")
    fresh.keyboard.press("End")
    fresh.wait_for_selector("#live-verdict-2:has-text('ambiguous')")
    fresh.wait_for_function("document.getElementById('live-announced').textContent.includes('no unique solution')")
    assert "no unique solution" in fresh.get_attribute("#live-found-2", "aria-label")

    fresh.focus("#live-likelihood")
    fresh.keyboard.press("Space")
    fresh.wait_for_function("document.getElementById('live-name-2').textContent === 'max. likelihood'")
    assert fresh.evaluate("document.documentElement.scrollHeight") == height


def test_a_design_is_chosen_by_mouse_and_by_keyboard(fresh):
    design = "document.getElementById('live-design').textContent"
    fresh.click("#live-next")
    assert fresh.inner_text("#live-tried")
    box = fresh.locator("#live-designs").bounding_box()
    # The map has 23 diameters from 0.8 lambda/D on, and 14 shifts from 0.3 pi on, upwards.
    place = {"x": box["width"] * 8.5 / 23, "y": box["height"] * (1 - 8.5 / 14)}
    fresh.click("#live-designs", position=place)
    fresh.wait_for_function(f"{design}.startsWith('1.60 λ/D, 0.70π')")
    assert not fresh.inner_text("#live-tried")  # the comment was on another sensor
    fresh.focus("#live-designs")
    fresh.keyboard.press("ArrowRight")
    fresh.keyboard.press("ArrowDown")
    fresh.wait_for_function(f"{design}.startsWith('1.70 λ/D, 0.65π and −0.65π: ')")
    wait_for_address(fresh, "diameter=1.7", "shift-a=0.65", "shift-b=-0.65")
    assert "1.70" in fresh.get_attribute("#live-designs", "aria-label")
    cost = live.designs()["costs"]["flat wavefront"][9][7]
    fresh.check("input[value='flat wavefront']")
    fresh.wait_for_function(f"{design}.includes('{cost:.2f} times')")


def test_page_says_nothing_and_asks_for_nothing_else(page):
    assert page.said == []
    assert {address.split(":")[0] for address in page.asked} == {"file"}
