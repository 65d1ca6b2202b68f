"""The first chapter: one pixel, the phases that explain its images, and the slider that moves its phase."""

import json
import re
import shutil

import numpy as np
import pytest

from studies.zernike_sensor import Pixel, bump_and_pit, explorer, lowest_pixel

from .conftest import ROOT, watch

STATIC = ROOT / "book" / "_static"


@pytest.fixture(scope="module")
def phase(pupil):
    return bump_and_pit(pupil, 1.2)


@pytest.fixture(scope="module")
def pixel(shifted, phase):
    return lowest_pixel(shifted, phase)


def test_bump_and_pit_have_equal_heights_and_no_mean(pupil, phase):
    inside = pupil.gather(phase)
    assert inside.mean() == pytest.approx(0, abs=1e-12)
    assert inside.max() == pytest.approx(-inside.min())
    assert 1.1 < inside.max() < 1.2


def test_pixel_has_the_intensities_of_the_sensor_and_each_image_allows_a_second_phase(shifted, phase, pixel):
    measured = shifted.measure(phase)[:, pixel.row, pixel.column]
    assert pixel.phase == pytest.approx(phase[shifted.pupil.inside].min())
    same = pixel.intensities(pixel.phase)
    np.testing.assert_allclose(same, measured, rtol=1e-12)
    mirrored = pixel.intensities(pixel.mirrored)
    np.testing.assert_allclose(np.diag(mirrored), same, rtol=1e-12)
    assert np.abs(np.diag(mirrored[::-1]) - same[::-1]).min() > 0.5


@pytest.fixture
def page(browser, pixel, tmp_path):
    """The slider alone on a page, as narrow as a phone."""
    shutil.copy(STATIC / "phasor.js", tmp_path)
    shutil.copy(STATIC / "phasor.css", tmp_path)
    head = '<meta charset="utf-8"><link rel="stylesheet" href="phasor.css"><script defer src="phasor.js"></script>'
    box = explorer(pixel).data
    (tmp_path / "page.html").write_text(f"<!doctype html><html lang='en'>{head}<body>{box}</body></html>", "utf-8")
    page = browser.new_page(viewport={"width": 390, "height": 800})
    page.said, _ = watch(page)
    page.goto((tmp_path / "page.html").as_uri())
    yield page
    page.close()


def angles(page):
    text = page.locator("#phasor .phasor-says").inner_text().replace("−", "-")
    return [float(number) for number in re.findall(r"[+-]\d\.\d\d", text)]


def test_slider_states_the_phases_that_each_image_allows(page, pixel):
    for phase in (-2.5, pixel.phase, 0.0, 1.3, 3.0):
        page.locator("#phasor input").fill(f"{phase:.2f}")
        moved = Pixel(pixel.row, pixel.column, float(f"{phase:.2f}"), pixel.waves)
        expected = moved.phase, moved.mirrored[0], moved.phase, moved.mirrored[1], moved.phase
        assert angles(page) == pytest.approx(expected, abs=0.011)
    assert page.said == []


def test_a_phase_that_is_its_own_mirror_image_is_the_only_one(page, pixel):
    for k, wave in enumerate(pixel.waves):
        page.locator("#phasor input").fill(f"{np.angle(wave):.2f}")
        says = page.locator("#phasor .phasor-says").inner_text()
        assert re.findall(r"Image (\d) allows \S+ rad only", says) == [f"{k + 1}"]


def drawn(page, selector, count):
    """Points of the paths in a drawing that have `count` of them, as complex numbers, upwards: (n, count)."""
    paths = page.eval_on_selector_all(f"{selector} path", "all => all.map(one => one.getAttribute('d'))")
    numbers = [np.array(re.findall(r"-?[\d.]+", path), float) for path in paths]
    return np.array([[1, -1j] @ one.reshape(-1, 2).T for one in numbers if one.size == 2 * count])


def circles(page, selector):
    """Centres of the circles in a drawing, as complex numbers, upwards, and their radii."""
    places = "all => all.map(one => ['cx', 'cy', 'r'].map(name => Number(one.getAttribute(name))))"
    x, y, radii = np.transpose(page.eval_on_selector_all(f"{selector} circle", places))
    return x - 1j * y, radii


@pytest.mark.parametrize("angle", [-2.5, 1.3])
def test_arrows_are_the_waves_of_the_pixel(page, pixel, angle):
    page.locator("#phasor input").fill(str(angle))
    for k, wave in enumerate(pixel.waves):
        ends = wave + np.exp([1j * (2 * np.angle(wave) - angle), 1j * angle])  # both of the same intensity
        places, radii = circles(page, f"#phasor-{k + 1}")
        unit = radii[0]
        assert unit > 20
        np.testing.assert_allclose(places / unit, [wave, 0, *ends], atol=1e-3)
        assert radii[1] / unit == pytest.approx(abs(ends[1]), abs=1e-3)
        shafts, heads = (drawn(page, f"#phasor-{k + 1}", count) / unit for count in (2, 3))
        np.testing.assert_allclose(shafts, [[0, wave], *([wave, end] for end in ends)], atol=1e-3)
        heads = np.delete(heads, 1, axis=0)  # the cross at no light
        wings = (heads[:, ::2] - heads[:, 1:2]) / (shafts[:, :1] - shafts[:, 1:])
        assert np.all(wings.real > 0), "they point backwards"
        np.testing.assert_allclose(wings.sum(axis=1).imag, 0, atol=0.01)
        assert np.all(np.abs(wings.imag) > 0.01)


@pytest.mark.parametrize("angle", [-2.5, 1.3])
def test_curves_are_the_intensities_of_the_pixel(page, pixel, angle):
    page.locator("#phasor input").fill(str(angle))
    curves, marks = drawn(page, "#phasor-curves", 121), circles(page, "#phasor-curves")[0]
    width, height = curves[0, -1].real, 190
    angles = np.linspace(-np.pi, np.pi, 121)
    intensities = [np.abs(wave + np.exp(1j * angles)) ** 2 for wave in pixel.waves]
    unit = (height + curves[0, 0].imag) / intensities[0][0]
    assert 0 < unit < height / np.max(intensities)

    def at(phase, intensity):
        return width * (phase / np.pi + 1) / 2 + 1j * (unit * intensity - height)

    for k, wave in enumerate(pixel.waves):
        np.testing.assert_allclose(curves[k], at(angles, intensities[k]), atol=0.1)
        other = np.angle(np.exp(1j * (2 * np.angle(wave) - angle)))
        level = abs(wave + np.exp(1j * angle)) ** 2
        np.testing.assert_allclose(marks[2 * k : 2 * k + 2], at(np.array([other, angle]), level), atol=0.1)


def test_slider_obeys_the_keyboard_and_fits_a_phone(page, pixel):
    page.locator("#phasor input").focus()
    page.keyboard.press("ArrowRight")
    assert angles(page)[0] == pytest.approx(round(pixel.phase, 2) + 0.01)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    sizes = page.eval_on_selector_all("#phasor text", "all => all.map(one => one.getBoundingClientRect().height)")
    assert min(sizes) > 12


def test_box_is_hidden_without_a_script(pixel):
    text = explorer(pixel).data
    assert " hidden>" in text
    waves = json.loads(re.search(r'data-waves="([^"]+)"', text)[1])
    np.testing.assert_allclose([complex(*wave) for wave in waves], pixel.waves, atol=1e-4)
