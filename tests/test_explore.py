"""Interactive versions of figures: their data, their script in a browser, and the built book."""

import csv
import shutil

import numpy as np
import pytest

from book._ext import explore
from studies.kit.style import LOOKS

from .conftest import ROOT
from .test_browser import HTML, address, outside, settle, watch

CURVES, MAP, GRID = "fig03_dynamic_range", explore.MAP, "photon_noise"
PAGES = {name: "fig04_dimple_diameter" if name == "fig04_methods" else name for name in (*explore.FIGURES, MAP)}
INPUTS = np.linspace(0, 1, 11)
DIAMETERS, SHIFTS = (one.ravel() for one in np.meshgrid([1.0, 1.5, 2.0], [1.0, 2.0], indexing="ij"))
COLUMNS = {
    CURVES: {
        "input (rad rms)": INPUTS,
        "PhaseShifted: mean error (rad rms)": 1e-6 * INPUTS,
        "PhaseShifted: standard deviation (rad rms)": 2e-6 * INPUTS,
        "Linear: mean error (rad rms)": [*0.6 * INPUTS[:-1] ** 2, np.nan],
        "GradientDescentPoints: mean error (rad rms)": 0.1 * INPUTS,
    },
    MAP: {
        "diameter (lambda/D)": DIAMETERS,
        "phase shift (rad)": SHIFTS,
        "photons, ideal 1, flat wavefront": [3, 2, 1.5, 1.25, 4, 5],
        "photons, ideal 1, 1 rad rms": [3, 2, 1.125, 2, 4, 5],
    },
    GRID: {
        "input (rad rms)": np.repeat([0.05, 1], 3),
        "photons per point": np.tile([10, 100, 1000], 2),
        "bound: error (rad rms)": [0.1, 0.03, 0.01] * 2,
        "Arcsine: error (rad rms)": [0.125, 0.03, 0.01, 0.6, 0.6, 0.6],
    },
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A CSV file for each kind of figure."""
    folder = tmp_path_factory.mktemp("files")
    for name, columns in COLUMNS.items():
        with (folder / f"{name}.csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([columns, *zip(*columns.values(), strict=True)])
    return folder


def test_curves_have_the_looks_and_the_values_of_the_figure(files):
    drawn = explore.drawing(CURVES, files / f"{CURVES}.csv")
    names = "Linear", "GradientDescentPoints", "PhaseShifted"
    assert [(entry["name"], entry["light"]) for entry in drawn["legend"]] == [
        (LOOKS[name].label, LOOKS[name].color) for name in names
    ]
    assert [len(entry["dash"]) for entry in drawn["legend"]] == [0, 2, 2]
    assert [entry["shown"] for entry in drawn["legend"]] == [True, False, True]
    error, ratio = drawn["panels"]
    shifted = error["curves"][2]
    assert shifted["y"] == pytest.approx(1e-6 * INPUTS)
    assert shifted["low"] == [0] * 11
    assert shifted["high"] == pytest.approx(3e-6 * INPUTS)
    assert error["curves"][0]["x"] == pytest.approx(INPUTS[:-1]), "a missing value is not drawn"
    assert ratio["curves"][2]["x"] == pytest.approx(INPUTS[1:]), "a logarithmic axis shows no zero"
    assert ratio["curves"][2]["y"] == pytest.approx([1e-6] * 10)


def test_each_input_has_its_panels(files):
    panels = explore.drawing(GRID, files / f"{GRID}.csv")["panels"]
    assert [panel["title"] for panel in panels] == ["input 0.05 rad rms"] * 2 + ["input 1 rad rms"] * 2
    assert panels[1]["curves"][0]["y"] == [1, 1, 1]
    assert panels[2]["curves"][1]["y"] == [0.6, 0.6, 0.6]


def test_the_maps_mark_the_best_design(files):
    panels = explore.drawing(MAP, files / "design.csv")["panels"]
    assert [panel["title"] for panel in panels] == ["flat wavefront", "1 rad rms"]
    assert [panel["curves"][-1]["x"] for panel in panels] == [[1.5], [1.5]]
    assert [panel["curves"][-1]["y"][0] * np.pi for panel in panels] == pytest.approx([2, 1])


# In a browser


@pytest.fixture(scope="module")
def site(files):
    """A page with a button for each figure, without the book around it."""
    static = files / "site" / "_static"
    shutil.copytree(ROOT / "book" / "_static", static)
    explore.write(static / "explore", files.glob("*.csv"))
    buttons = "".join(line for name in COLUMNS for line in explore.button(name) if line.startswith("<"))
    head = '<meta charset="utf-8"><title>Figures</title><link rel="stylesheet" href="_static/explore.css">'
    script = '<script defer src="_static/explore.js"></script>'
    page = static.parent / "page.html"
    page.write_text(f'<!doctype html><html lang="en" data-theme="light">{head}{buttons}{script}</html>', "utf-8")
    return page


@pytest.fixture
def opened(browser, site):
    """Opens the interactive version of a figure; returns its page, its box, and what the page said and asked."""
    pages = []

    def open_figure(figure, width=1280):
        page = browser.new_page(viewport={"width": width, "height": 900})
        pages.append(page)
        said, asked = watch(page)
        page.goto(site.as_uri())
        return page, click(page, figure), said, asked

    yield open_figure
    for page in pages:
        page.close()


def click(page, figure):
    """Open a figure; return its box when all panels are drawn."""
    page.locator(f"[data-explore={figure}]").click()
    box = page.locator(".explore-box:visible")
    box.locator(".explore-tools").wait_for()
    page.wait_for_function("box => box.dataset.drawn", arg=box.element_handle())
    page.wait_for_timeout(300)
    return box


def point_at(page, box, x, y, panel=0):
    """Move the mouse to a point of the axes; return the text of the tooltips."""
    box.locator(".explore-panels > div").nth(panel).scroll_into_view_if_needed()
    place = box.evaluate(
        """(box, [x, y, panel]) => {
            const { frame, canvas } = box.views[panel];
            const corner = canvas.el.getBoundingClientRect();
            return [corner.x + frame.x_scale.compute(x), corner.y + frame.y_scale.compute(y)];
        }""",
        [x, y, panel],
    )
    page.mouse.move(place[0] + 30, place[1] - 30)
    page.mouse.move(*place, steps=4)
    page.wait_for_timeout(200)
    return " ".join(page.locator(".bk-tooltip-content:visible").all_inner_texts()).split()


def test_nothing_is_loaded_before_the_click(browser, site):
    page = browser.new_page()
    said, asked = watch(page)
    page.goto(site.as_uri())
    assert [url.rpartition("/")[2] for url in asked] == ["page.html", "explore.css", "explore.js"]
    click(page, CURVES)
    assert {url.rpartition("/")[2] for url in asked[3:]} == {
        *(file.name for file in explore.LIBRARY),
        f"{CURVES}.js",
    }
    assert said == outside(asked) == []
    page.close()


def test_hover_shows_the_values_of_a_point(opened):
    page, box, said, _ = opened(CURVES)
    shown = point_at(page, box, 0.8, 0.6 * 0.8**2)
    assert {"linear", "0.8", "0.384"} <= set(shown)
    assert {"linear", "0.8", "0.48"} <= set(point_at(page, box, 0.8, 0.48, panel=1))
    assert said == []


def test_hover_shows_the_values_on_logarithmic_axes(opened):
    page, box, *_ = opened(GRID)
    assert {"arcsine", "100", "0.6"} <= set(point_at(page, box, 100, 0.6, panel=2))
    assert {"bound", "1000", "0.01"} <= set(point_at(page, box, 1000, 0.01, panel=2)), "it has no marker"


def test_hover_shows_the_cost_of_a_design(opened):
    page, box, *_ = opened(MAP)
    assert "1.5" in point_at(page, box, 1.5, 1 / np.pi)
    assert "1.125" in point_at(page, box, 1.5, 1.1 / np.pi, panel=1)


def test_an_entry_of_the_legend_hides_its_curve(opened):
    page, box, *_ = opened(CURVES)
    place = 0.8, 0.6 * 0.8**2
    entry = box.get_by_role("button", name=LOOKS["Linear"].label)
    assert "linear" in point_at(page, box, *place)
    entry.click()
    assert entry.get_attribute("aria-pressed") == "false"
    assert point_at(page, box, *place) == []
    entry.click()
    assert "linear" in point_at(page, box, *place)


def test_drag_zooms_and_reset_returns(opened):
    page, box, *_ = opened(CURVES)
    ends = "box => [box.views[0].model.x_range.start, box.views[0].model.x_range.end]"
    panel = box.locator(".explore-panels > div").first
    panel.scroll_into_view_if_needed()
    before, area = box.evaluate(ends), panel.bounding_box()
    page.mouse.move(area["x"] + 0.4 * area["width"], area["y"] + 0.3 * area["height"])
    page.mouse.down()
    page.mouse.move(area["x"] + 0.7 * area["width"], area["y"] + 0.6 * area["height"], steps=5)
    page.mouse.up()
    page.wait_for_timeout(300)
    zoomed = np.ptp(box.evaluate(ends))
    assert zoomed < 0.5 * np.ptp(before)
    box.get_by_role("button", name="Zoom out").click()
    assert np.ptp(box.evaluate(ends)) == pytest.approx(2 * zoomed)
    box.get_by_role("button", name="Reset zoom").click()
    page.wait_for_timeout(300)
    assert box.evaluate(ends) == pytest.approx(before)


def test_the_table_has_every_value_and_axe_finds_no_serious_fault(opened):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page, box, *_ = opened(GRID, width=390)
    assert page.evaluate("document.documentElement.scrollWidth - window.innerWidth") <= 0
    box.locator("summary").click()
    assert box.locator("tbody tr").count() == 6
    assert box.locator("tbody tr").nth(3).inner_text().split() == ["1", "10", "0.1", "0.6"]
    found = axe.run(page, context=".explore-box", options={"resultTypes": ["violations"]}).response["violations"]
    assert [fault["id"] for fault in found if fault["impact"] in ("serious", "critical")] == []


@pytest.mark.slow
@pytest.mark.skipif(not (HTML / explore.FOLDER).is_dir(), reason="the book has no CSV files: make book")
@pytest.mark.parametrize("mode", ["light", "dark"])
@pytest.mark.parametrize("figure", PAGES)
def test_the_book_shows_each_figure_in_silence(browser, figure, mode):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page = browser.new_page(viewport={"width": 1280, "height": 900}, color_scheme=mode)
    said, asked = watch(page)
    page.goto(address(f"notebooks/{PAGES[figure]}.html"))
    settle(page)
    click(page, figure)
    assert said == outside(asked) == []
    found = axe.run(page, context=".explore-box", options={"resultTypes": ["violations"]}).response["violations"]
    assert [fault["id"] for fault in found if fault["impact"] in ("serious", "critical")] == []
    page.close()
