import warnings

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest

import zwfs
from studies.fig01_sensor_layout import draw_sensor_layout
from studies.fig02_vector_sensor import draw_vector_sensor
from studies.fig05_seal_bench import draw_bench_layout
from studies.kit.style import use_style
from zwfs.bench.model import Bench, segment_screens


@pytest.fixture(autouse=True)
def style():
    with plt.rc_context():
        use_style(vector=True)
        yield
    plt.close("all")


@pytest.fixture(scope="module")
def phase(screens):
    return screens(0.5, 1, seed=3)[0]


@pytest.fixture(scope="module")
def bench():
    return Bench(n_pixels=60)


@pytest.fixture(scope="module")
def pistons(bench):
    return segment_screens(bench, 0.5, 1, seed=4)[0]


@pytest.fixture(scope="module")
def frames(bench, pistons):
    return bench.frames(pistons, seed=1)


@pytest.fixture(params=["sensor_layout", "vector_sensor", "bench_layout"])
def draw(request, classic, shifted, phase, bench, pistons, frames):
    calls = {
        "sensor_layout": lambda: draw_sensor_layout(classic, phase),
        "vector_sensor": lambda: draw_vector_sensor(shifted, phase),
        "bench_layout": lambda: draw_bench_layout(bench, pistons, frames, 635.0),
    }
    return calls[request.param]


def pictures(figure):
    """Data of each picture, with NaN where nothing is drawn."""
    return [np.ma.filled(image.get_array(), np.nan) for axes in figure.axes for image in axes.images]


def holds(figure, expected):
    return sum(
        picture.shape == expected.shape and np.array_equal(picture, expected, equal_nan=True)
        for picture in pictures(figure)
    )


def test_texts_stay_inside_and_apart(draw):
    figure = draw()
    figure.canvas.draw()
    scene = figure.axes[0]
    boxes = [(text.get_text(), text.get_window_extent()) for text in scene.texts]
    for text, box in boxes:
        assert figure.bbox.contains(box.x0, box.y0), text
        assert figure.bbox.contains(box.x1, box.y1), text
    for index, (text, box) in enumerate(boxes):
        assert not [other for other, more in boxes[index + 1 :] if box.shrunk(0.98, 0.9).overlaps(more)], text
        for axes in figure.axes[1:]:
            if axes.images:
                assert not box.shrunk(0.98, 0.9).overlaps(axes.bbox), text


def test_pictures_are_upright_and_sharp(draw):
    for axes in draw().axes:
        for image in axes.images:
            assert image.origin == "lower"
            assert image.get_interpolation() == "none"


def test_sensor_layout_shows_what_is_computed(classic, pupil, phase):
    figure = draw_sensor_layout(classic, phase)
    field = pupil.amplitude * np.exp(1j * phase)
    assert holds(figure, np.where(pupil.inside, phase, np.nan)) == 1
    assert holds(figure, np.abs(classic.propagate(field)[0]) ** 2) == 2
    assert holds(figure, np.abs(classic.reference_wave(field)[0]) ** 2) == 1
    total, incoming, reference, interference = pictures(figure)[3:7]
    assert np.abs(total - incoming - reference - interference).max() < 1e-12


def test_vector_sensor_shows_the_frames_in_both_rows(shifted, pupil, phase):
    figure = draw_vector_sensor(shifted, phase)
    for frame in shifted.measure(phase):
        assert holds(figure, frame) == 2
    assert holds(figure, np.where(pupil.inside, phase, np.nan)) == 2


def test_vector_sensor_shows_both_masks(shifted, phase):
    shown = pictures(draw_vector_sensor(shifted, phase))
    for mask in shifted.masks:
        maps = [picture for picture in shown if np.nanmax(picture) == np.nanmin(picture) == mask.phase]
        assert len(maps) == 2
        # The field of view is 4.4 lambda/D wide.
        area = np.isfinite(maps[0]).mean() * (4.4 * 161 / 160) ** 2
        assert area == pytest.approx(np.pi / 4 * mask.diameter**2, rel=0.03)


def test_bench_layout_shows_the_camera_and_the_wavelength(bench, pistons, frames):
    figure = draw_bench_layout(bench, pistons, frames, 850.0)
    assert "850 nm" in [text.get_text() for text in figure.axes[0].texts]
    for frame in frames:
        assert holds(figure, frame) == 1
    flat = Bench.ideal(n_pixels=60, quilting=bench.quilting).frames()[0]
    assert holds(figure, flat) == 1


def test_bench_layout_shows_the_segments(bench, pistons, frames):
    figure = draw_bench_layout(bench, pistons, frames, 635.0)
    commanded = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    assert holds(figure, commanded) == 1
    pupil = zwfs.Pupil.from_segments(bench.segments)
    assert holds(figure, pupil.amplitude**2) == 1
    # The missing segment is at the top right: up is the last row.
    full = zwfs.Pupil.hexagonal(60, bench.n_rings, bench.gap, (), bench.stop)
    row, column = np.nonzero(full.inside & ~pupil.inside)
    assert row.mean() > 40
    assert column.mean() > 35


def test_bench_layout_of_flat_segments(bench, frames):
    figure = draw_bench_layout(bench, np.zeros(bench.n_segments), frames, 635.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.canvas.draw()
