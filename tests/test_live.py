"""The live sensor: its scripts against zwfs, and its page, in a browser."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import zwfs
from book._ext import live
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
    (1.2, 3, 1.06, (0.5, -0.5), 25),
    (0.8, 50, 2.0, (0.5, -0.5), 8),
    (0.6, 11, 0.5, (0.7, -0.36), 12),
    (0.3, 1, 1.5, (0.5, 0.24), 10),
    (0.4, 24, 3.0, (0.5, -0.5), 4),
    (0.05, 9, 2.44, (0.5, -0.5), 5),
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
    const made = live.compute({ ...standard, ...settings });
    const found = (one) => one && {
        errors: one.errors,
        residual: rows(one.residual),
        phase: rows(one.estimate[0].map((re, k) => Math.atan2(one.estimate[1][k], re))),
    };
    return {
        phase: rows(made.phase), frames: made.frames.map(rows), focal: [...made.focal], strehl: made.strehl,
        linear: found(made.linear), arcsine: found(made.arcsine), shifted: found(made.shifted),
        accelerated: found(made.accelerated), likelihood: found(made.likelihood),
    };
}"""


@pytest.fixture
def compute(page, pupil):
    """Runs the model of the page; maps come back as arrays."""

    def call(rms, seed, diameter, shifts, iterations, **others):
        settings = {"rms": rms, "seed": seed, "diameter": diameter, "iterations": iterations}
        made = page.evaluate(COMPUTE, settings | {"shifts": [shift * np.pi for shift in shifts]} | others)
        for maps in (made, *(one for one in made.values() if isinstance(one, dict))):
            maps |= {name: np.array(maps[name]) for name in ("phase", "residual") if name in maps}
            maps |= {name: maps[name].reshape(pupil.shape) for name in ("phase", "residual") if name in maps}
        return made | {"frames": np.array(made["frames"]).reshape(-1, *pupil.shape)}

    return call


def sensor_of(pupil, diameter, shifts):
    return zwfs.ZernikeSensor(pupil, *(zwfs.Dimple(diameter, shift * np.pi) for shift in shifts))


def screen_of(modes, rms, seed):
    return zwfs.power_law_screens(modes, rms, 1, seed=seed)[0]


def assert_same_phase(pupil, found, expected, tolerance=1e-5):
    """Compare phases on the circle, without piston."""
    difference = pupil.gather(zwfs.wrapped_residual(pupil, found, expected))
    assert np.all(np.abs(difference) <= tolerance)


@pytest.mark.parametrize(("rms", "seed", "diameter", "shifts", "iterations"), SETTINGS)
def test_sensor_and_reconstructors_agree_with_zwfs(compute, pupil, modes, rms, seed, diameter, shifts, iterations):
    made = compute(rms, seed, diameter, shifts, iterations)
    phase = screen_of(modes, rms, seed)
    np.testing.assert_allclose(made["phase"], phase, atol=1e-5)
    np.testing.assert_allclose(made["frames"], sensor_of(pupil, diameter, shifts).measure(phase), atol=1e-5)
    assert made["strehl"] == pytest.approx(zwfs.strehl(pupil, phase), abs=1e-5)
    axis = 4 * (2 * np.arange(48) - 47) / 48
    focal = np.abs(focal_field(pupil, np.exp(1j * phase), axis, axis)) ** 2
    np.testing.assert_allclose(np.reshape(made["focal"], focal.shape), focal, atol=1e-5)
    one, both = sensor_of(pupil, diameter, shifts[:1]), sensor_of(pupil, diameter, shifts)
    histories = {"linear": zwfs.Linear(one, modes, poke=1e-4)(one.measure(phase)).phase[np.newaxis]}
    for name, method, sensor in (("arcsine", zwfs.Arcsine, one), ("shifted", zwfs.PhaseShifted, both)):
        histories[name] = np.zeros((1, *pupil.shape))
        if iterations:
            reconstruct = method(sensor, n_iterations=iterations, tolerance=0.0)
            histories[name] = reconstruct(sensor.measure(phase), history=True).history
    made["both"] = compute(rms, seed, diameter, shifts, 0, both=True)["linear"]
    histories["both"] = zwfs.Linear(both, modes, poke=1e-4)(both.measure(phase)).phase[np.newaxis]
    for name, history in histories.items():
        assert_same_phase(pupil, made[name]["phase"], history[-1])
        residual = zwfs.wrapped_residual(pupil, history[-1], phase)
        np.testing.assert_allclose(pupil.gather(made[name]["residual"]), pupil.gather(residual), atol=1e-5)
        errors = zwfs.reconstruction_error(pupil, history, phase)
        np.testing.assert_allclose(made[name]["errors"], errors, atol=1e-5)


@pytest.mark.parametrize(
    ("rms", "seed", "diameter", "shifts", "iterations", "tolerance"),
    [
        (1.2, 3, 1.06, (0.5, -0.5), 25, 1e-5),
        (3.0, 22, 1.06, (0.5, -0.5), 30, 1e-5),  # the plain iteration fails
        (0.3, 1, 1.5, (0.5, 0.24), 20, 1e-5),
        (0.8, 50, 2.0, (0.5, -0.5), 30, 1e-4),  # the weakest functions are rounded, and count as much as all
    ],
)
def test_accelerated_iteration_agrees_with_zwfs(
    compute, pupil, modes, rms, seed, diameter, shifts, iterations, tolerance
):
    phase = screen_of(modes, rms, seed)
    made = compute(rms, seed, diameter, shifts, iterations, accelerated=True)["accelerated"]
    options = {"n_iterations": iterations, "tolerance": 0.0, "accelerate": True}
    # The secant weighs all coefficients alike: the path depends on their number, the fixed point does not.
    exact = sensor_of(pupil, diameter, shifts)
    coarse = zwfs.ZernikeSensor(pupil, *exact.masks, tolerance=live.TOLERANCE)
    history = zwfs.PhaseShifted(coarse, **options)(exact.measure(phase), history=True).history
    np.testing.assert_allclose(made["errors"], zwfs.reconstruction_error(pupil, history, phase), atol=tolerance)
    assert_same_phase(pupil, made["phase"], zwfs.PhaseShifted(exact, **options)(exact.measure(phase)).phase)


@pytest.mark.parametrize(
    ("rms", "seed", "diameter", "shifts", "photons"),
    [
        (1.0, 7, 1.06, (0.5, -0.5), None),
        (2.0, 7, 1.06, (0.5, -0.5), None),
        (0.5, 11, 2.6, (0.5, -0.5), None),
        (0.4, 24, 3.0, (0.3, -0.68), None),
        (0.7, 9, 1.3, (0.4, -0.8), 3e5),
        (0.5, 7, 2.05, (0.33, -0.74), 3e4),
    ],
)
def test_maximum_likelihood_agrees_with_zwfs(compute, pupil, rms, seed, diameter, shifts, photons):
    noise = {} if photons is None else {"photons": photons}
    made = compute(rms, seed, diameter, shifts, 30, likelihood=True, **noise)
    sensor = sensor_of(pupil, diameter, shifts)
    result = zwfs.MaximumLikelihood(sensor, photons=photons)(made["frames"])
    if photons is None:
        assert_same_phase(pupil, made["likelihood"]["phase"], result.phase)
        return
    # Both stop at a step of a thousandth of the mean standard error: dark points are less certain.
    assert_same_phase(pupil, made["likelihood"]["phase"], result.phase, 0.1 * pupil.gather(result.sigma))
    assert zwfs.reconstruction_error(pupil, made["likelihood"]["phase"], result.phase) < 1e-5


@pytest.mark.parametrize(
    ("rms", "seed", "diameter", "shifts", "photons", "steps"),
    [
        (2.0, 7, 1.06, (0.5, -0.5), None, 2),
        (0.5, 3, 1.06, (0.5, -0.5), 3.0, 8),  # pixels without a photon, steps that raise the cost
        (1.2, 9, 1.3, (0.4, -0.8), 30.0, 9),
        (1.5, 1, 2.0, (0.65, -0.65), 310.0, 28),  # points that are reflected: compared at the end only
    ],
)
def test_steps_of_maximum_likelihood_are_those_of_zwfs(
    compute, pupil, modes, rms, seed, diameter, shifts, photons, steps
):
    noise = {} if photons is None else {"photons": photons}
    made = compute(rms, seed, diameter, shifts, 2 + steps, likelihood=True, **noise)
    # From the phase from which the page starts.
    sensor = sensor_of(pupil, diameter, shifts)
    start = compute(rms, seed, diameter, shifts, 2, likelihood=True, **noise)["likelihood"]["phase"]
    method = zwfs.MaximumLikelihood(sensor, photons=photons, n_starts=1, n_iterations=steps)
    result = method(made["frames"], np.where(pupil.inside, start, 0), history=True)
    assert zwfs.reconstruction_error(pupil, made["likelihood"]["phase"], result.phase) < 1e-3
    if steps < 28:
        errors = zwfs.reconstruction_error(pupil, result.history, screen_of(modes, rms, seed))
        np.testing.assert_allclose(made["likelihood"]["errors"][2:], errors, rtol=1e-3, atol=3e-5)


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


@pytest.mark.parametrize("photons", [4, 15])
def test_noise_of_few_photons_is_that_of_poisson(compute, photons):
    settings = (0.5, 7, 1.06, (0.5, -0.5), 0)
    mean = photons * compute(*settings)["frames"]
    counts = photons * compute(*settings, photons=photons)["frames"]
    some = (mean > 3) & (mean < 30)
    mean, counts = mean[some], counts[some]
    # The third central moment is the mean, and that of a normal distribution 0. The cube has a variance of
    # 15 mean^3 + 24 mean^2 + mean.
    error = np.sqrt(np.sum(15 * mean**3 + 24 * mean**2 + mean)) / mean.sum()
    assert error < 0.25
    assert abs(np.sum((counts - mean) ** 3) / mean.sum() - 1) < 3 * error


def is_refused(method, *arguments):
    try:
        method(*arguments)
    except ValueError:
        return True
    return False


SINGULAR = [(0.5, 0.5), (0.5, 0.0), (1.0, -1.0), (0.0, 1.0), (0.5 + 3e-7, 0.5), (1e-9 / np.pi, 0.5)]


@pytest.mark.parametrize("shifts", [*SINGULAR, (0.5 + 4e-6, 0.5), (1e-8 / np.pi, 0.5)])
def test_singular_shifts_are_refused_as_by_zwfs(compute, pupil, modes, shifts):
    made = compute(0.5, 7, 1.06, shifts, 1)
    refused = is_refused(zwfs.PhaseShifted, sensor_of(pupil, 1.06, shifts))
    assert (made["shifted"] is None) == refused == (shifts in SINGULAR)
    for n_images, both in ((1, False), (2, True)):
        solution = compute(0.5, 7, 1.06, shifts, 1, both=both)["linear"]
        refused = is_refused(zwfs.Linear, sensor_of(pupil, 1.06, shifts[:n_images]), modes)
        assert (solution is None) == refused


def test_maximum_likelihood_needs_one_dimple_that_changes_the_light(compute):
    for shift, solved in ((0.0, False), (0.02, True)):
        made = compute(0.3, 4, 1.06, (shift, -shift), 1, likelihood=True)
        assert (made["likelihood"] is not None) == solved


@pytest.mark.parametrize("diameter", [2.43014, 2.43017])
def test_linear_method_leaves_out_the_tilts_that_zwfs_leaves_out(compute, pupil, modes, diameter):
    made = compute(0.05, 9, diameter, (0.5, -0.5), 0)
    sensor, phase = sensor_of(pupil, diameter, (0.5,)), screen_of(modes, 0.05, 9)
    result = zwfs.Linear(sensor, modes, poke=1e-4)(sensor.measure(phase))
    [error] = made["linear"]["errors"]
    assert error == pytest.approx(zwfs.reconstruction_error(pupil, result.phase, phase), rel=0.01)


@pytest.mark.parametrize("shift", [1.0, 0.999])
def test_arcsine_takes_the_side_of_zwfs_where_waves_are_in_line(compute, pupil, modes, shift):
    made = compute(0.3, 6, 1.06, (shift, -0.5), 5)
    sensor, phase = sensor_of(pupil, 1.06, (shift,)), screen_of(modes, 0.3, 6)
    history = zwfs.Arcsine(sensor, n_iterations=5, tolerance=0.0)(sensor.measure(phase), history=True).history
    errors = zwfs.reconstruction_error(pupil, history, phase)
    np.testing.assert_allclose(made["arcsine"]["errors"], errors, atol=1e-5)


def photon_cost(pupil, diameter, theta, phases):
    """Photons of two dimples with opposite phase shifts, over those of an ideal sensor with the same error."""
    sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(diameter, theta), zwfs.Dimple(diameter, -theta), tolerance=1e-4)
    return 4 * np.nanmean(zwfs.cramer_rao(sensor, phases, photons=1 / 2) ** 2)


def test_costs_of_designs_are_those_of_the_bound(pupil, modes):
    table = live.designs()
    wavefronts = {"flat wavefront": np.zeros((1, *pupil.shape))} | {
        f"{rms:g} rad rms": screens_at(modes, rms, 6, 2024, task, -2.0) for task, rms in enumerate((0.5, 1.0))
    }
    places = [(0, 0), (6, 8), (16, 4)]
    theta = np.pi * np.array(table["shifts"])
    for x, y in places:
        for name, phases in wavefronts.items():
            cost = photon_cost(pupil, table["diameters"][x], theta[y], phases)
            np.testing.assert_allclose(table["costs"][name][x][y], cost, rtol=1e-5)


@pytest.mark.parametrize("name", live.designs()["costs"])
def test_contours_and_the_best_design_are_those_of_the_map(fresh, name):
    fresh.check(f"input[value='{name}']")
    table = live.designs()
    costs, contours = np.array(table["costs"][name]), table["contours"][name]
    logs = RegularGridInterpolator([np.arange(size) + 0.5 for size in costs.shape], np.log(costs))
    for label in contours["labels"]:
        x, y = label["place"]
        assert np.exp(logs((x, costs.shape[1] - y))) == pytest.approx(float(label["text"]), rel=0.05)
    assert fresh.locator("#live-costs span").all_inner_texts() == [label["text"] for label in contours["labels"]]
    column, row = np.unravel_index(costs.argmin(), costs.shape)
    place = re.findall(r"[\d.]+", fresh.get_attribute("path.live-best >> nth=0", "d"))
    assert [float(value) for value in place[:2]] == pytest.approx([column + 0.5, costs.shape[1] - row - 0.5])


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


def test_reset_brings_back_the_input_that_presets_keep(fresh):
    fresh.click("button:text-is('Few photons')")
    fresh.click("#live-reset")
    fresh.wait_for_function("location.hash === ''")
    fresh.click("button:text-is('OZIRIIS')")
    wait_for_address(fresh, "diameter=2.05")
    assert "rms" not in fresh.evaluate("location.hash")


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


def test_photons_between_the_designs_of_the_map_are_those_of_the_bound(fresh, modes, pupil):
    cost = photon_cost(pupil, 1.06, np.pi / 2, screens_at(modes, 1.0, 6, 2024, 1))
    fresh.check("input[value='1 rad rms']")
    fresh.wait_for_function(f"document.getElementById('live-design').textContent.includes(' {cost:.2f} times')")


def test_page_says_nothing_and_asks_for_nothing_else(page):
    assert page.said == []
    assert {address.split(":")[0] for address in page.asked} == {"file"}
