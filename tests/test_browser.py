"""The built book in a real browser, opened from the file system, as wide as a screen and as a phone."""

import json
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import pytest

from .conftest import ROOT, watch

HTML = ROOT / "_build" / "html"
WIDTHS = (1280, 390)
PAGES = sorted(
    file.relative_to(HTML).as_posix()
    for file in HTML.rglob("*.html")
    if file.relative_to(HTML).parts[0] != "_static"
    and 'http-equiv="refresh"' not in file.read_text("utf-8").lower()
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book"),
]

# What moved without being asked to, by the measure of web.dev/cls.
SHIFTS = """
window.moved = 0;
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.moved += entry.value;
}).observe({ type: "layout-shift", buffered: true });
"""


def address(name):
    return (HTML / name).as_uri()


def outside(asked):
    return [url for url in asked if not url.startswith(("file:", "data:", "blob:"))]


def settle(page):
    """Wait until the letters are there."""
    page.evaluate("() => document.fonts.ready.then(() => null)")


@pytest.fixture(scope="module", params=WIDTHS)
def window(request, browser):
    context = browser.new_context(viewport={"width": request.param, "height": 900}, color_scheme="light")
    context.add_init_script(SHIFTS)
    yield context
    context.close()


@pytest.fixture(scope="module", params=PAGES)
def opened(request, window):
    """A page, and what it said, asked and moved while it was loaded."""
    page = window.new_page()
    said, asked = watch(page)
    page.goto(address(request.param))
    settle(page)
    moved = page.evaluate("window.moved")
    loaded = SimpleNamespace(page=page, said=list(said), asked=list(asked), moved=moved)
    # What is folded is looked at too, and nothing while it changes its colour.
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    page.evaluate("document.querySelectorAll('img').forEach(one => one.loading = 'eager')")
    page.wait_for_function("[...document.images].every(one => one.complete)")
    page.add_style_tag(content="* { animation: none !important; transition: none !important }")
    yield loaded
    page.close()


@pytest.fixture
def page(browser):
    """A fresh window, wide, with the front page."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    page = context.new_page()
    page.goto(address("book/index.html"))
    yield page
    context.close()


def test_says_nothing_and_asks_nobody(opened):
    assert opened.said == []
    assert opened.asked
    assert outside(opened.asked) == []


def test_opening_a_page_loads_little(opened):
    files = {Path(unquote(urlsplit(url).path)) for url in opened.asked if url.startswith("file:")}
    assert sum(file.stat().st_size for file in files) <= 1.25e6  # 1.2 MB in a window of 1280 x 720 pixels


def test_equations_are_rendered(opened):
    page = opened.page
    written = page.locator(".math").count()
    sizes = page.eval_on_selector_all(".math math", "all => all.map(one => one.getBoundingClientRect().width)")
    assert len(sizes) == written
    assert all(sizes)


def test_pictures_are_shown_and_figures_can_be_read(opened):
    page = opened.page
    pictures = page.eval_on_selector_all(
        "article img",
        """all => all.filter(one => !one.closest(".only-dark")).map(one => {
            const { width, height } = one.getBoundingClientRect();
            return { name: one.currentSrc, width, height, ratio: one.naturalWidth / one.naturalHeight,
                wide: one.closest(".wide-figure") !== null && !one.closest(LARGE_LETTERS) };
        })""".replace("LARGE_LETTERS", json.dumps("#front-picture, #fig-at-a-glance")),
    )
    for picture in pictures:
        assert picture["height"] > 0, picture
        assert picture["width"] / picture["height"] == pytest.approx(picture["ratio"], rel=0.02), picture
        # Type of 9 points on a figure of 9 inches is then 8 pixels tall. Drawings have larger letters.
        narrow = ".narrow" in picture["name"]
        least = 480 if picture["name"].endswith(".svg") else 576
        assert not picture["wide"] or narrow or picture["width"] >= least, picture


def test_the_page_does_not_scroll_sideways(opened):
    page = opened.page
    assert page.evaluate("document.documentElement.scrollWidth - window.innerWidth") <= 0
    cut = page.eval_on_selector_all(
        "article table",
        """all => all.filter(one => one.getBoundingClientRect().right > window.innerWidth
            && getComputedStyle(one.parentElement).overflowX !== "auto").length""",
    )
    assert cut == 0


def test_hardly_anything_moves_while_it_loads(opened):
    assert opened.moved < 0.05  # half of what is called good


def test_axe_finds_no_serious_fault(opened):
    """In light colours as wide as a screen, and in dark ones as wide as a phone."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page = opened.page
    mode = "dark" if page.viewport_size["width"] < max(WIDTHS) else "light"
    page.emulate_media(color_scheme=mode)
    page.wait_for_function("mode => document.documentElement.dataset.theme === mode", arg=mode)
    violations = axe.run(page, options={"resultTypes": ["violations"]}).response["violations"]
    faults = [
        f"{fault['id']}: {node['html'][:120]}: {node['failureSummary']}"
        for fault in violations
        if fault["impact"] in ("serious", "critical")
        for node in fault["nodes"]
    ]
    assert faults == []


def test_search_finds_a_chapter_before_the_api(page):
    said, asked = watch(page)
    page.goto(f"{address('search.html')}?q=Gerchberg")
    results = page.locator("#search-results li a")
    results.first.wait_for()
    page.locator(".search-summary", has_text="found").wait_for()
    links = [link.get_attribute("href") for link in results.all()]
    api = ["book/api" in link for link in links]
    assert 0 < sum(api) < len(api)
    assert api == sorted(api)
    results.first.click()
    page.wait_for_url(lambda url: "search.html" not in url)
    assert "Gerchberg" in page.locator("article").inner_text()
    assert said == outside(asked) == []


@pytest.mark.parametrize(
    ("asked", "target"),
    [
        ("PhaseShifted", "book/api_reconstructors.html#zwfs.PhaseShifted"),
        ("zernike_basis", "book/api_sensor.html#zwfs.zernike_basis"),
        ("what limits two images", "notebooks/zernike_sensor.html#what-limits-two-images"),
        ("how the answer is found", "notebooks/design.html#how-the-answer-is-found"),
        ("phase shifts", "notebooks/phase_shift_pairs.html"),
    ],
)
def test_search_leads_from_a_name_to_its_entry_and_from_a_heading_to_its_section(page, asked, target):
    page.goto(f"{address('search.html')}?q={asked}")
    page.locator(".search-summary", has_text="found").wait_for()
    assert target in page.locator("#search-results li a").first.get_attribute("href")


def test_keyboard_alone_reads_switches_and_searches(page):
    focus = "document.activeElement"
    page.keyboard.press("Tab")
    assert page.evaluate(f"{focus}.textContent") == "Skip to main content"
    page.keyboard.press("Enter")
    assert page.url.endswith("#main-content")
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate(f"{focus}.matches('.theme-switch-button')"):
            break
    assert page.evaluate(f"getComputedStyle({focus}).outlineStyle") == "solid"
    before = page.evaluate("document.documentElement.dataset.mode")
    page.keyboard.press("Enter")
    assert page.evaluate("document.documentElement.dataset.mode") != before
    page.keyboard.press("Control+k")
    page.keyboard.type("Gerchberg")
    page.keyboard.press("Enter")
    page.wait_for_url("**/search.html?q=Gerchberg")


def test_first_tap_on_a_word_defines_it_and_the_second_opens_the_glossary(browser):
    context = browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(address("notebooks/zernike_sensor.html"))
    settle(page)
    word = page.locator("a[data-definition]").first
    word.tap()
    shown = word.evaluate("one => getComputedStyle(one, '::after').content")
    assert word.get_attribute("data-definition")[:20] in shown
    assert page.url.endswith("zernike_sensor.html")
    word.tap()
    page.wait_for_url("**/book/glossary.html#*")
    context.close()
