import inspect
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import zwfs
from zwfs import figures, figures_bench
from zwfs.bench_trials import BenchCurves
from zwfs.experiments import linearity_curves
from zwfs.variations import DiameterCurve


@pytest.fixture(autouse=True)
def style():
    plt.switch_backend("Agg")
    with plt.rc_context():
        figures.use_style()
        yield
    plt.close("all")


@pytest.fixture(scope="module")
def curves(classic, shifted, modes):
    methods = {"Linear": zwfs.Linear(classic, modes), "PhaseShifted": zwfs.PhaseShifted(shifted)}
    return linearity_curves(methods, modes, np.array([0.0, 0.05, 0.1, 0.3]), 2)


def drawn(axes, look):
    return next(line for line in axes.lines if line.get_color() == look.color and len(line.get_xdata()) > 1)


def test_every_method_has_a_look_of_its_own():
    assert {method.__name__ for method in zwfs.RECONSTRUCTORS} <= set(figures.LOOKS)
    for part in ("color", "marker", "label"):
        assert len({getattr(look, part) for look in figures.LOOKS.values()}) == len(figures.LOOKS)


def test_colours_of_methods_stand_for_nothing_else():
    """Whoever draws a method asks LOOKS for its colour; black is also the colour of ink."""
    source = inspect.getsource(figures) + inspect.getsource(figures_bench)
    notebooks = (Path(__file__).parent.parent / "notebooks").glob("*.ipynb")
    cells = (cell for file in notebooks for cell in json.loads(file.read_bytes())["cells"])
    source += "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    methods = {look.color for look in figures.LOOKS.values()} - {"#000000"}
    assert {color: source.upper().count(color) for color in methods} == dict.fromkeys(methods, 1)
    others = {part: {style[part] for style in figures.OTHER_STYLES} for part in ("color", "marker")}
    for part, values in others.items():
        assert len(values) == len(figures.OTHER_STYLES)
        assert not values & {getattr(look, part) for look in figures.LOOKS.values()}


def test_a_method_looks_the_same_in_every_figure(curves):
    trials = {name: DiameterCurve(np.array([1.0, 2]), np.full((2, 3), 0.1)) for name in figures.LOOKS}
    steps = {name: {0.2: np.geomspace(1, 1e-6, 8) * np.ones((3, 8))} for name in figures.LOOKS}
    two = ["Linear", "PhaseShifted"]
    pistons = np.linspace(-1, 1, 24).reshape(2, 3, 4)
    bench = BenchCurves(np.array([0.5, 1]), pistons, dict.fromkeys(two, 0.1 * pistons))
    segments = figures_bench.segment_errors(np.arange(4), dict.fromkeys(two, pistons[0, 0]), {"map": np.eye(4)})
    shown = [
        (figures.linearity(curves, 0.05, two, rms_max=0.4), two),
        (figures.convergence(steps), list(figures.LOOKS)),
        (figures.diameter_methods(trials, 0.5, 0.05, 2.2), list(figures.LOOKS)),
        (figures_bench.bench_linearity(bench, two), two),
        (segments, two),
    ]
    for figure, names in shown:
        for look in map(figures.LOOKS.get, names):
            lines = [line for axes in figure.axes for line in axes.lines]
            found = {(line.get_color(), line.get_marker()) for line in lines if look.label in line.get_label()}
            assert found == {(look.color, look.marker)}


def test_linearity_draws_the_means_and_marks_where_they_leave(curves):
    figure = figures.linearity(curves, 0.05, ["Linear", "PhaseShifted"], rms_max=0.2)
    plain, ratio = figure.axes
    look = figures.LOOKS["Linear"]
    np.testing.assert_allclose(drawn(plain, look).get_ydata(), curves.mean("Linear")[:3])
    np.testing.assert_allclose(drawn(ratio, look).get_ydata(), curves.mean("Linear")[1:3] / curves.rms[1:3])
    marks = [line.get_xdata()[0] for line in ratio.lines if len(line.get_xdata()) == 1]
    assert marks == [pytest.approx(curves.dynamic_range("Linear", 0.05))]


def test_estimates_show_what_they_were_given(pupil, screens):
    truth = screens(0.5, 1)[0]
    found = {"Linear": np.where(pupil.mask, truth / 2, np.nan)}
    figure = figures.estimates(pupil, truth, found, found)
    shown = [np.ma.filled(axes.images[0].get_array(), np.nan) for axes in figure.axes if axes.images]
    np.testing.assert_array_equal(shown[1], found["Linear"])


def test_convergence_has_a_panel_for_each_input():
    errors = {"Linear": {0.2: np.ones((3, 2))}, "PhaseShifted": {0.2: np.geomspace(1, 1e-6, 8) * np.ones((3, 8))}}
    figure = figures.convergence(errors)
    line = drawn(figure.axes[0], figures.LOOKS["PhaseShifted"])
    np.testing.assert_allclose(line.get_ydata(), np.geomspace(1, 1e-6, 8))


def test_an_unknown_method_is_named():
    with pytest.raises(ValueError, match=r"methods = \['Magic'\]: expected some of"):
        figures.convergence({"Magic": {0.2: np.ones((3, 2))}})
