import pickle
from dataclasses import replace
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb, to_rgba_array
from matplotlib.text import Text

import zwfs
from studies import zernike_sensor
from studies.kit.style import ALONE, LOOKS, OTHER_STYLES, show_phase, use_style
from studies.kit.variants import dark_color, variants

from .test_truth import CASES, run


@pytest.fixture(autouse=True)
def style():
    plt.switch_backend("Agg")
    with plt.rc_context():
        use_style()
        yield
    plt.close("all")


def test_every_method_has_a_look_of_its_own():
    for method in zwfs.RECONSTRUCTORS:
        assert LOOKS[method.__name__].label
    for part in ("color", "marker", "label"):
        assert len({getattr(look, part) for look in LOOKS.values()}) == len(LOOKS)


def colours(figure):
    """Colours of lines, areas, marks and text; pictures and colour scales have those of a colour map."""
    shown = set()
    for artist in figure.findobj(lambda artist: getattr(artist, "get_array", lambda: None)() is None):
        for part in ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"):
            if hasattr(artist, f"get_{part}"):
                shown |= {to_hex(color).upper() for color in to_rgba_array(getattr(artist, f"get_{part}")())}
    return shown


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore")  # of small parameters
def test_figures_of_a_notebook_suit_dark_pages_and_phones_and_mean_methods_by_their_colours(name, monkeypatch):
    """Each method gets a colour that differs slightly from its own, so its usual colour must not appear."""
    usual = {look.color for look in LOOKS.values()} - {"#000000"}  # black is also the colour of ink
    for method, look in LOOKS.items():
        monkeypatch.setitem(LOOKS, method, replace(look, color=f"#{int(look.color[1:], 16) ^ 1:06X}"))
    _, figures = run(name, CASES[name][0], monkeypatch)
    assert figures
    for figure in figures:
        assert not colours(figure) & usual
        for kind, variant in variants(figure).items():
            corner = painted(variant)[0, 0, :3]
            assert (corner.max() < 60) == ("dark" in kind)
            assert (variant.get_size_inches()[0] < 4) == ("narrow" in kind)
            assert kind != "narrow" or not cut_off(variant)
            for text in variant.findobj(lambda artist: isinstance(artist, Text) and artist.get_bbox_patch()):
                assert contrast(text.get_color(), text.get_bbox_patch().get_fc()) > 4.5, text.get_text()


def test_pictures_with_titles_stay_in_the_order_of_reading_on_a_phone():
    figure, panels = plt.subplots(2, 3)
    for number, axes in enumerate(panels.flat):
        show_phase(axes, np.zeros((2, 2)), 1.0).axes.set_title(f"{number}")
    panels[0, 0].set_gid(ALONE)
    boxes = panel_boxes(variants(figure)["narrow"])
    lines = {top for _, top, _ in boxes.values()}
    rows = [sorted(name for name, (_, top, _) in boxes.items() if top == line) for line in sorted(lines)]
    assert rows[::-1] == [["0"], ["1", "2"], ["3", "4"], ["5"]]
    assert len({width for *_, width in boxes.values()}) == 1


def panel_boxes(figure):
    """Left end, upper end and width of each panel by its title, in pixels."""
    FigureCanvasAgg(figure).draw()
    boxes = {axes.get_title(): axes.get_window_extent() for axes in figure.axes}
    return {name: tuple(round(value) for value in (box.x0, box.y1, box.width)) for name, box in boxes.items()}


def test_phases_of_a_dark_figure_are_dark_at_zero():
    figure, axes = plt.subplots()
    figure.colorbar(show_phase(axes, np.zeros((2, 2)), 1.0))
    dark = variants(figure)["dark"]
    assert pixels(figure)[200, 200, :3].min() > 200
    assert pixels(dark)[200, 200, :3].max() < 60
    bar = dark.axes[1].collections[-1]
    assert bar.get_cmap() == dark.axes[0].images[0].get_cmap()


def cut_off(figure):
    """Titles, labels and entries of legends that do not fit into a painted figure, by more than a pixel."""
    texts = [text for legend in figure.legends for text in legend.get_texts()]
    for axes in figure.axes:
        texts += [axes.title, axes.xaxis.label, axes.yaxis.label]
    texts = [text for text in texts if text.get_text()]
    boxes = [text.get_window_extent() for text in texts]
    page = figure.bbox.padded(1)
    corners = [box.corners() for box in boxes]
    inside = [all(page.contains(*corner) for corner in four) for four in corners]
    return [text for text, fits in zip(texts, inside, strict=True) if not fits]


def painted(figure):
    """Draw a figure: (ny, nx, 4), 0 to 255."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def pixels(figure):
    """Draw a copy of a figure: (ny, nx, 4), 0 to 255."""
    figure = pickle.loads(pickle.dumps(figure))
    plt.close(figure)
    return painted(figure)


def test_colours_of_a_dark_figure_can_be_read():
    light = [look.color for look in LOOKS.values()] + [style["color"] for style in OTHER_STYLES]
    colors = [dark_color(color) for color in (*light, *(color for _, color, _ in zernike_sensor.IMAGES))]
    assert min(lab(color, "normal")[0] for color in colors) > 53  # a contrast of 4.5 with the ground


# Linear RGB as it looks without one kind of cones (Machado, Oliveira and Fernandes 2009, severity 1).
VISION = {
    "normal": np.eye(3),
    "without red": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "without green": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    "without blue": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
}  # fmt: skip


def linear_rgb(color):
    rgb = np.array(to_rgb(color))
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def contrast(color, ground):
    """Contrast of two colours, 1 to 21 (WCAG 2.1); letters need 4.5."""
    low, high = sorted([0.2126, 0.7152, 0.0722] @ linear_rgb(tone) for tone in (color, ground))
    return (high + 0.05) / (low + 0.05)


def lab(color, vision):
    """CIE L*a*b* coordinates; their distance is about 2 where a difference just shows."""
    light = np.clip(VISION[vision] @ linear_rgb(color), 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ light / to_xyz.sum(axis=1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_colours_that_share_a_figure_differ_for_every_reader(vision):
    palettes = {
        "methods": [look.color for look in LOOKS.values()],
        "other curves": [style["color"] for style in OTHER_STYLES],
    }
    palettes["dark"] = [dark_color(color) for color in palettes["methods"]]
    for name, colors in palettes.items():
        points = [lab(color, vision) for color in colors]
        least = min(np.linalg.norm(a - b) for a, b in combinations(points, 2))
        assert least > (10 if name == "dark" else 15), name


def test_methods_of_a_reader_get_looks_of_their_own(monkeypatch):
    names = ["WhiteMagic", "Luck"]
    for name in names:
        monkeypatch.setitem(LOOKS, name, None)  # taken out again at the end
        del LOOKS[name]
    assert [LOOKS[name].label for name in names] == ["white magic", "luck"]
    for part in ("color", "marker"):
        assert len({getattr(look, part) for look in LOOKS.values()}) == len(LOOKS)
    for vision in VISION:
        points = [lab(look.color, vision) for look in LOOKS.values()]
        assert min(np.linalg.norm(a - b) for a, b in combinations(points, 2)) > 15
