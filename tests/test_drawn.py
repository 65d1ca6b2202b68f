"""The numbers of drawn figures, and drawings from SVG files."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from studies.kit.drawings import draw_layout
from studies.kit.drawn import drawn_columns

THREE = np.array([0.1, 0.2, 0.3])


@pytest.fixture(autouse=True)
def agg():
    plt.switch_backend("Agg")
    yield
    plt.close("all")


def columns_of(figure):
    return {name: values.tolist() for name, values in drawn_columns(figure).items()}


def test_curves_have_the_names_of_their_labels_and_share_their_places():
    figure, axes = plt.subplots()
    axes.plot(THREE, 2 * THREE, label="linear")
    axes.plot(THREE, 3 * THREE, label="_not in the legend")
    axes.plot(THREE, 9 * THREE)  # guides the eye
    axes.plot([0.1], [5], "o", label="point")
    axes.axhline(7, label="bound")
    axes.set(xlabel="diameter\n($\\lambda/D$)", ylabel="error (rad)", title="one panel")
    assert columns_of(figure) == {
        "diameter (lambda/D)": THREE.tolist(),
        "linear: error (rad)": (2 * THREE).tolist(),
        "not in the legend: error (rad)": (3 * THREE).tolist(),
        "diameter (lambda/D) (2)": [0.1],
        "point: error (rad)": [5],
        "bound: error (rad)": [7],
    }


def test_panels_have_the_labels_that_they_share():
    figure, panels = plt.subplots(1, 2, sharey=True)
    for axes, title in zip(panels, ("left", "right"), strict=True):
        axes.plot(THREE, THREE, label="a")
        axes.set(xlabel="x", title=title)
    panels[0].set_ylabel("y")
    assert [*columns_of(figure)] == ["x", "left: a: y", "right: a: y"]


def test_rows_with_names_are_places_of_bars():
    figure, axes = plt.subplots()
    axes.barh([0, 1], [3, 4], xerr=[0.5, 0.25])
    axes.set_yticks([0, 1], ["blur", "gaps"])
    axes.set(xlabel="gain (%)")
    expected = {"row": ["blur", "gaps"], "error bar: gain (%)": [0.5, 0.25], "gain (%)": [3, 4]}
    assert columns_of(figure) == expected


def test_bands_and_error_bars():
    figure, axes = plt.subplots()
    axes.fill_between(THREE, 0 * THREE, 2 * THREE, label="_range")
    axes.errorbar(THREE, THREE, 0.5 * THREE, label="mean")
    axes.set(xlabel="x", ylabel="y")
    drawn = drawn_columns(figure)
    expected = {"x": 1, "mean: y": 1, "mean: error bar: y": 0.5, "range: low: y": 0, "range: high: y": 2}
    assert [*drawn] == [*expected]
    for name, factor in expected.items():
        np.testing.assert_allclose(drawn[name], factor * THREE)


def test_pictures_have_a_row_for_each_point_that_is_shown():
    figure, panels = plt.subplots(1, 2)
    for axes, title, factor in zip(panels, ("input", "estimate"), (1, 2), strict=True):
        shown = axes.imshow(factor * np.array([[1.0, np.nan], [3.0, 4.0]]), vmin=0, vmax=8, origin="lower")
        axes.set(title=title, xticks=[], yticks=[])
    figure.colorbar(shown, ax=panels, label="phase (rad)")
    assert columns_of(figure) == {
        "x (pixel)": [0, 0, 1],
        "y (pixel)": [0, 1, 1],
        "input: phase (rad)": [1, 3, 4],
        "estimate: phase (rad)": [2, 6, 8],
    }


def test_a_mesh_has_the_middles_of_its_cells():
    figure, axes = plt.subplots()
    mesh = axes.pcolormesh([1, 2], [10, 20], [[1, 2], [3, 4]], shading="nearest")
    axes.set(xlabel="width", ylabel="height", title="map")
    figure.colorbar(mesh, label="cost")
    expected = {"width": [1, 2, 1, 2], "height": [10, 10, 20, 20], "map: cost": [1, 2, 3, 4]}
    assert columns_of(figure) == expected


def test_an_element_that_is_not_read_is_named(tmp_path):
    file = tmp_path / "layout.svg"
    file.write_text('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 90 90"><path d="M0,0"/></svg>')
    with pytest.raises(ValueError, match="<path> in a drawing: expected one of the simple elements"):
        draw_layout(str(file), str(file), {})


def test_a_panel_without_labels_has_all_its_curves():
    figure, axes = plt.subplots()
    axes.plot(THREE, THREE)
    axes.set(xlabel="x", ylabel="y")
    assert columns_of(figure) == {"x": THREE.tolist(), "y": THREE.tolist()}


def test_second_axes_have_columns():
    figure, axes = plt.subplots()
    axes.semilogx(THREE, THREE)
    axes.set(xlabel="input", ylabel="error")
    axes.secondary_xaxis("top", functions=(lambda x: x**2, np.sqrt)).set_xlabel("$D/r_0$")
    np.testing.assert_allclose(drawn_columns(figure)["D/r_0"], THREE**2)
