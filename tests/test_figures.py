import json
import pickle
from dataclasses import replace
from importlib import import_module
from itertools import combinations
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb, to_rgba_array
from matplotlib.text import Text

import zwfs
from studies import bandwidth, decision, phase_amplitude, zernike_sensor
from studies.bandwidth import BandCurves
from studies.beyond_range import NoiseCurves
from studies.calibration import Errors, Measured
from studies.dark_zone import IDEAL, Drift, DriftCurves
from studies.design import PUBLISHED, DesignMap
from studies.fig04_dimple_diameter import Contraction
from studies.kit import grids
from studies.kit.bench import BenchCurves
from studies.kit.curves import Limit
from studies.kit.experiments import DiameterCurves, linearity_curves
from studies.kit.grids import Grid
from studies.kit.style import ALONE, DARK_PHASE_MAP, LOOKS, OTHER_STYLES, show_phase, use_style
from studies.kit.variants import dark_color, variants
from studies.phase_amplitude import AmplitudeCurves
from studies.phase_shift_pairs import DrawnNoise, PairMaps
from studies.photon_noise import EXPECTED, ErrorBars, PhotonCurves
from studies.reconstructors import draw_convergence
from studies.zernike_sensor import lowest_pixel
from zwfs.bench.model import Bench
from zwfs.frames.phases import Phases
from zwfs.frames.pipeline import Measurement, Optics
from zwfs.frames.refine import Step
from zwfs.frames.registration import Circle, Image, RegisteredFrames


@pytest.fixture(autouse=True)
def style():
    plt.switch_backend("Agg")
    with plt.rc_context():
        use_style()
        yield
    plt.close("all")


@pytest.fixture(scope="module")
def curves(classic, shifted, modes):
    methods = {"Linear": zwfs.Linear(classic, modes), "PhaseShifted": zwfs.PhaseShifted(shifted)}
    return linearity_curves(methods, modes, np.array([0.0, 0.05, 0.1, 0.3]), 2)


def test_every_method_has_a_look_of_its_own():
    for method in zwfs.RECONSTRUCTORS:
        assert LOOKS[method.__name__].label
    for part in ("color", "marker", "label"):
        assert len({getattr(look, part) for look in LOOKS.values()}) == len(LOOKS)


def figure_functions():
    """Every function of the studies that draws a figure."""
    studies = Path(__file__).parents[1] / "notebooks" / "studies"
    modules = [import_module(f"studies.{file.stem}") for file in studies.glob("[a-z]*.py")]
    return {
        name: function
        for module in (*modules, grids)
        for name, function in vars(module).items()
        if name.startswith("draw_") and function.__module__ == module.__name__
    }


@pytest.fixture(scope="module")
def drawn_methods(curves, pupil, classic, shifted):
    """Return the arguments of every figure function, and the methods that it then draws."""
    two, three = ["Linear", "PhaseShifted"], np.linspace(0.5, 1.5, 3)
    shifted_only = {"PhaseShifted"}
    phase = np.where(pupil.inside, np.add.outer(pupil.y, pupil.x), np.nan)
    frames = np.ones((2, *pupil.shape))
    pistons = np.linspace(-1, 1, 24).reshape(2, 3, 4)
    trial = DiameterCurves(np.full(3, 0.5), dict.fromkeys(LOOKS, np.full((3, 3), 0.1)), three)
    lines = {f"curve {i}": three for i in range(4)}
    reasons = Contraction(three, three, np.full((3, 2), 0.5), {1.0: 0.5}, lines)
    bench_curves = BenchCurves(np.array([0.5, 1]), pistons, dict.fromkeys(two, 0.1 * pistons))
    five = ["Linear", "Arcsine", "GerchbergSaxton", "GradientDescent", "PhaseShifted"]
    compared = ["PhaseShifted", "PhaseShiftedAccelerated", "MaximumLikelihood"]
    trials = DiameterCurves(np.full(3, 0.5), dict.fromkeys(compared, np.full((3, 3), 0.1)), three)
    both_kinds = trials.errors | {"MaximumLikelihoodModes": np.full((3, 3), 0.1)}
    ranges = [NoiseCurves(three, both_kinds, n, three) for n in (0.0, 1e4)]
    saxton = zwfs.GerchbergSaxton(shifted)
    bad = np.zeros(frames.shape, bool)
    bad[:, 10, 10] = True
    image, circle = Image(frames[0], bad[0]), Circle(11.5, 11.5, float(pupil.n_pixels))
    recording = RegisteredFrames((image, image), (image, image), (circle, circle), np.zeros((4, 2)))
    measurement = Measurement(
        recording, Optics(), frames, pupil, 0 * phase, bad, 0, np.ones(2), np.zeros(4), (1.0, 1.0)
    )
    whole, real = np.array(0), np.array(0.0)
    numbers = real, whole, whole, real, np.zeros(2), whole, whole, whole
    found = Phases(phase, phase, *numbers, measurement=measurement)
    varied = AmplitudeCurves(three, dict.fromkeys(phase_amplitude.WAYS, np.full((3, 2), 0.1)), {}, three)
    drift, pair, falling = Drift(np.ones((6, 2, 2)), 10.0, 500.0), np.ones(6), np.array([20.0, 10.0])
    held = DriftCurves(
        drift, {"pair": pair, IDEAL: pair}, [1e2, 1e4], {"pair": falling}, [0.1, 0.5], {1e3: falling}
    )
    sliced = Grid({"x": np.arange(2), "screen": np.zeros(2), "error": np.ones(2)}, ("x",))
    widths = replace(curves, errors={"narrow": curves.errors["Linear"]} | curves.errors)
    faint = PhotonCurves(
        three, three, dict.fromkeys(LOOKS, np.ones((3, 3, 2))), np.full((3, 3, 2), 2.0), np.eye(3)
    )
    designs = DesignMap(three, three, {"flat": np.add.outer(three, three) + 0.5})
    step = Step("outlines", found, np.ones(2), np.zeros(2))
    banded = BandCurves(three, dict.fromkeys(bandwidth.WAYS, three[:, np.newaxis]), {}, three, 1.0)
    triple = zwfs.ZernikeSensor(pupil, *shifted.masks, zwfs.Dimple(1, 0))
    both = zwfs.MaximumLikelihood(triple, amplitude="unknown")(triple.measure(phase))
    bench = Bench(n_pixels=60)
    commands = np.linspace(-1, 1, bench.n_segments)
    calibrated = Errors(three, [[Measured(0.2, 0.1, 0.3, 0.1, 0.7, 1.0, True)]] * 3)
    decided = decision.Row("perfect model", decision.Situation(0.5, 1.0), ("one", "two"), (0.2, 0.1))
    looped = replace(decided, bench="", closed=(1, 2), n_loops=2)
    return {
        "draw_slice": ((sliced, "error", "x"), ()),
        "draw_sensor_layout": ((classic, phase), ()),
        "draw_vector_sensor": ((shifted, phase), ()),
        "draw_bench_layout": ((bench, commands, bench.frames(commands, seed=1), 635.0), ()),
        "draw_steps": ((pupil, phase, frames, dict.fromkeys([*two, "Arcsine"], phase)), ()),
        "draw_linearity": ((curves, dict.fromkeys(two, Limit(0.2, 0.01)), 0.05, 0.4), two),
        "draw_saxton_widths": (({"narrow": saxton}, widths, 0.05), ["Linear", "GerchbergSaxton"]),
        "draw_convergence": (({name: {0.2: np.full((3, 8), 0.1)} for name in LOOKS},), LOOKS),
        "draw_estimates": ((pupil, phase, dict.fromkeys(two, phase)), ()),
        "draw_sensor_steps": ((shifted, phase, lowest_pixel(shifted, phase)), ()),
        "draw_pixel_phasors": ((lowest_pixel(shifted, phase),), ()),
        "draw_one_or_two_images": ((pupil, phase, dict.fromkeys(two, phase)), ()),
        "draw_approximation": ((three, lines, lines), ()),
        "draw_dimple_diameter": (({25: trial, 100: trial}, 0.05, 2.2), shifted_only),
        "draw_diameter_methods": ((dict.fromkeys(LOOKS, trial), 0.05, 2.2), LOOKS),
        "draw_diameter_reasons": ((reasons, 2.2), shifted_only),
        "draw_dimples": ((trials, {"tilt": np.ones((3, 2))}, 0.05), ["PhaseShifted", "MaximumLikelihood"]),
        "draw_range": ((ranges, 1e4, 0.05), ["PhaseShifted", "MaximumLikelihood"]),
        "draw_model_errors": (({"dimple": trials}, ranges[1], 0.05), ()),
        "draw_pairs": ((PairMaps(three, *np.full((5, 3, 3), 1.0)),), ()),
        "draw_pair_noise": ((three, lines, [DrawnNoise(1.0, -1.0, "curve 0", 1.0, 1.0, 0.1)]), ()),
        "draw_photon_noise": ((faint,), LOOKS),
        "draw_error_bars": (([ErrorBars(k, EXPECTED, 1.0) for k in (1, 2, 0.5)],), ["MaximumLikelihood"]),
        "draw_design_maps": ((designs, PUBLISHED, {"flat": three}), ()),
        "draw_band_errors": (({(0.1, False): banded, (0.1, True): banded},), [*shifted_only, "MaximumLikelihood"]),
        "draw_held_drift": ((held,), ()),
        "draw_amplitude_errors": (({"dips": varied},), [*shifted_only, "MaximumLikelihood"]),
        "draw_phase_and_amplitude": ((pupil, 0 * pupil.amplitude, pupil.amplitude, both), ()),
        "draw_reference_intensities": ((frames, frames), ()),
        "draw_measured_and_modelled": ((frames, 0.9 * frames, phase), ()),
        "draw_segment_errors": ((bench, commands, dict.fromkeys(two, commands)), two),
        "draw_bench_linearity": ((BenchCurves(np.array([0.5, 1]), pistons, dict.fromkeys(five, pistons)),), five),
        "draw_comparison": (([decided], [looped]), ()),
        "draw_budget": ((dict.fromkeys(["none", "blur"], bench_curves), "PhaseShifted"), shifted_only),
        "draw_calibration_errors": ((calibrated, three), shifted_only),
        "draw_explained": ((found,), ()),
        "draw_phase_map": ((found, 635.0), ()),
        "draw_gains": (([step] * 2, [0.1, 0.2]), ()),
        "draw_signs": ((measurement,), ()),
    }


def colours(figure):
    """Colours of lines, areas, marks and text; pictures and colour scales have those of a colour map."""
    found = set()
    for artist in figure.findobj(lambda artist: getattr(artist, "get_array", lambda: None)() is None):
        for part in ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"):
            if hasattr(artist, f"get_{part}"):
                found |= {to_hex(color).upper() for color in to_rgba_array(getattr(artist, f"get_{part}")())}
    return found


def test_every_figure_is_tested_for_its_colours(drawn_methods):
    assert set(drawn_methods) == set(figure_functions())


# Drawn here with more methods than in the book.
CROWDED = "draw_diameter_methods", "draw_convergence", "draw_photon_noise"


@pytest.mark.slow
@pytest.mark.parametrize("name", figure_functions())
def test_variants_are_dark_or_fit_a_phone(name, drawn_methods):
    use_style()
    figure = figure_functions()[name](*drawn_methods[name][0])
    numbers = plt.get_fignums()
    for kind, variant in variants(figure).items():
        drawn = painted(variant)
        assert (drawn[0, 0, :3].max() < 60) == ("dark" in kind)
        assert (variant.get_size_inches()[0] < 4) == ("narrow" in kind)
        if kind == "narrow":
            assert not cut_off(variant)
        for text in variant.findobj(lambda one: isinstance(one, Text) and one.get_bbox_patch()):
            assert contrast(text.get_color(), text.get_bbox_patch().get_fc()) > 4.5, text.get_text()
    assert plt.get_fignums() == numbers
    painted(figure)
    assert name in CROWDED or not cut_off(figure)


@pytest.mark.parametrize("name", ["draw_sensor_layout", "draw_pairs", "draw_convergence"])
def test_figure_stays_as_its_variants_are_made(name, drawn_methods):
    use_style()
    figure = figure_functions()[name](*drawn_methods[name][0])
    before = pixels(figure)
    assert len(variants(figure)) > 1
    assert np.array_equal(pixels(figure), before)


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


def test_opposite_phases_of_a_dark_figure_are_equally_light():
    phases = np.linspace(0, 1, 9)
    lightness = [[lab(DARK_PHASE_MAP(0.5 + sign * one / 2), "normal")[0] for one in phases] for sign in (-1, 1)]
    np.testing.assert_allclose(*lightness, atol=3)
    assert np.all(np.diff(lightness) > 0)


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


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("name", ["draw_sensor_layout", "draw_vector_sensor", "draw_bench_layout"])
def test_texts_of_a_scene_stay_inside_and_apart(name, narrow, drawn_methods):
    use_style(vector=True)
    figure = figure_functions()[name](*drawn_methods[name][0])
    if narrow:
        figure = variants(figure)["narrow"]
    FigureCanvasAgg(figure).draw()
    boxes = [(text.get_text(), text.get_window_extent()) for text in figure.axes[0].texts]
    others = [axes.bbox for axes in figure.axes[1:] if axes.images]
    for index, (text, box) in enumerate(boxes):
        assert all(figure.bbox.contains(*corner) for corner in box.corners()), text
        others_of_text = [*others, *(one for _, one in boxes[index + 1 :])]
        assert not [one for one in others_of_text if box.shrunk(0.98, 0.9).overlaps(one)], text


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


@pytest.mark.parametrize("name", figure_functions())
def test_colours_of_methods_stand_for_nothing_else(name, drawn_methods, monkeypatch):
    """With methods in other colours, no artist has the colour of a method; black is also the colour of ink."""
    arguments, methods = drawn_methods[name]
    usual = {look.color: method for method, look in LOOKS.items() if look.color != "#000000"}
    other = {method: f"#0{index}0{index}0{index}" for index, method in enumerate(LOOKS, start=1)}
    for method, color in other.items():
        monkeypatch.setitem(LOOKS, method, replace(LOOKS[method], color=color))
    shown = colours(figure_functions()[name](*arguments))
    assert {usual[color] for color in shown & set(usual)} == set()
    assert {method for method, color in other.items() if color in shown} == set(methods)


def test_notebooks_draw_no_colour_of_a_method():
    notebooks = (Path(__file__).parent.parent / "notebooks").glob("*.ipynb")
    cells = (cell for file in notebooks for cell in json.loads(file.read_bytes())["cells"])
    source = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code").upper()
    assert not [look.color for look in LOOKS.values() if look.color in source]


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
    low, high = sorted([0.2126, 0.7152, 0.0722] @ linear_rgb(one) for one in (color, ground))
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
    figure = draw_convergence({name: {0.2: np.ones((3, 2))} for name in names})
    assert {line.get_color() for line in figure.axes[0].lines} >= {LOOKS[name].color for name in names}
