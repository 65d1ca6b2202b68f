import numpy as np
import pytest

from zwfs import Pupil


@pytest.mark.parametrize("n", [7, 8])
def test_coordinates_are_pixel_centres_in_diameters(n):
    pupil = Pupil.circular(n)
    centres = (np.arange(n) - (n - 1) / 2) / n
    np.testing.assert_allclose(pupil.x, centres, atol=1e-15)
    np.testing.assert_allclose(pupil.y, centres, atol=1e-15)
    rows, columns = np.nonzero(pupil.inside)
    np.testing.assert_array_equal(pupil.points, np.stack([pupil.x[columns], pupil.y[rows]], axis=-1))
    moved = Pupil.from_amplitude(np.ones((4, 6)), n_pixels=5.5, center=(1, 2.5))
    np.testing.assert_allclose(moved.y, (np.arange(4) - 1) / 5.5)
    np.testing.assert_allclose(moved.x, (np.arange(6) - 2.5) / 5.5)


@pytest.mark.parametrize("n", [16, 25, 100])
def test_disc_holds_the_centres_within_half_a_diameter(n):
    pupil = Pupil.circular(n)
    radius = np.hypot(pupil.x, pupil.y[:, np.newaxis])
    np.testing.assert_array_equal(pupil.inside, radius <= 0.5)
    np.testing.assert_array_equal(pupil.segments, pupil.inside)


@pytest.mark.parametrize(
    "pupil",
    [
        Pupil.circular(30),
        Pupil.circular(30, 0.3, [(0.4, 0.05)]),
        Pupil.hexagonal(60, gap=0.01),
        Pupil.from_amplitude(np.random.default_rng(0).uniform(size=(9, 12))),
        Pupil.from_segments(np.arange(9).reshape(3, 3), np.arange(1.0, 10).reshape(3, 3)),
    ],
)
def test_mean_square_amplitude_is_1_inside_and_0_outside(pupil):
    assert np.mean(pupil.amplitude[pupil.inside] ** 2) == pytest.approx(1, abs=1e-12)
    assert not pupil.amplitude[~pupil.inside].any()
    assert pupil.n_points == np.count_nonzero(pupil.inside)


def test_spider_is_dark_on_its_side_only():
    pupil = Pupil.circular(101, spiders=[(np.pi / 2, 0.05)])
    x, y = pupil.x, pupil.y[:, np.newaxis]
    blocked = Pupil.circular(101).inside & ~pupil.inside
    np.testing.assert_array_equal(blocked, (np.hypot(x, y) <= 0.5) & (np.abs(x) < 0.025) & (y > -1e-12))


def test_three_rings_are_37_segments_of_equal_area():
    pupil = Pupil.hexagonal(300, n_rings=3, gap=0.004)
    numbers, areas = np.unique(pupil.segments[pupil.inside], return_counts=True)
    np.testing.assert_array_equal(numbers, np.arange(1, 38))
    pitch = 0.5 / np.sqrt(9 + 3 + 1 / 3)
    expected = 3 * np.sqrt(3) / 2 * ((pitch - 0.004) / np.sqrt(3)) ** 2 * 300**2
    np.testing.assert_allclose(areas, expected, rtol=0.03)
    assert areas.mean() == pytest.approx(expected, rel=3e-3)


def test_segments_are_numbered_counter_clockwise_from_30_degrees():
    pupil = Pupil.hexagonal(200, n_rings=2)
    centre = {k: pupil.points[pupil.segments[pupil.inside] == k].mean(axis=0) @ (1, 1j) for k in range(1, 20)}
    pitch = 0.5 / np.sqrt(4 + 2 + 1 / 3)
    assert abs(centre[1]) < 0.01 * pitch
    for ring, first in ((1, 2), (2, 8)):
        centres = [centre[first + k] for k in range(6 * ring)]
        angles = np.unwrap(np.angle(centres))
        assert angles[0] == pytest.approx(np.pi / 6, abs=0.01)
        assert np.all(np.diff(angles) > 0)
        assert np.abs(centres).max() == pytest.approx(ring * pitch, rel=0.01)


def test_missing_segments_leave_the_others_as_they_are():
    whole, broken = Pupil.hexagonal(100), Pupil.hexagonal(100, missing=(1, 37))
    np.testing.assert_array_equal(broken.segments, np.where(np.isin(whole.segments, (1, 37)), 0, whole.segments))


def test_stop_becomes_the_pupil():
    pupil = Pupil.hexagonal(200, stop=0.85)
    assert np.hypot(*pupil.points.T).max() <= 0.5
    inner = Pupil.circular(200).inside
    assert pupil.n_points / np.count_nonzero(inner) > 0.97


def test_amplitude_image_keeps_its_relative_values():
    image = np.array([[0.0, 1.0, 0.1], [2.0, 3.0, 0.0]])
    pupil = Pupil.from_amplitude(image, threshold=0.1)
    np.testing.assert_array_equal(pupil.inside, image > 0.3)
    inside = pupil.amplitude[pupil.inside]
    np.testing.assert_allclose(inside / inside[0], [1, 2, 3])
    assert pupil.n_pixels == 3
    assert pupil.center == (0.5, 1.0)


def test_field_has_the_amplitude_and_the_phase_and_is_dark_outside():
    pupil = Pupil.from_amplitude(np.pad(np.arange(1.0, 10).reshape(3, 3), 2))
    phase = np.linspace(-3, 3, 2 * 49).reshape(2, 7, 7)
    field = pupil.field(np.where(pupil.inside, phase, np.nan))
    np.testing.assert_allclose(np.abs(field), np.broadcast_to(pupil.amplitude, field.shape), rtol=1e-15)
    np.testing.assert_allclose(np.angle(pupil.gather(field)), pupil.gather(phase), rtol=1e-14)


def test_rms_ignores_piston_and_what_lies_outside():
    pupil = Pupil.circular(20)
    phase = np.where(pupil.x > 0, 1.0, -1.0) * np.ones(pupil.shape) + 7
    assert pupil.rms(np.where(pupil.inside, phase, np.nan)) == pytest.approx(1)


@pytest.mark.parametrize("dtype", [bool, np.int16, np.float32, np.complex64])
def test_gather_and_scatter_keep_the_dtype(dtype):
    pupil = Pupil.circular(12, 0.3)
    maps = np.arange(2 * 144).reshape(2, 12, 12).astype(dtype)
    values = pupil.gather(maps.tolist() if dtype is bool else maps)
    assert values.dtype == dtype
    again = pupil.scatter(values, fill=0)
    assert again.dtype == dtype
    np.testing.assert_array_equal(again, np.where(pupil.inside, maps, 0))
    if maps.dtype.kind == "f":
        np.testing.assert_array_equal(pupil.scatter(values), np.where(pupil.inside, maps, np.nan))


@pytest.mark.parametrize("scale", [1e-300, 1e200])
def test_the_unit_of_an_amplitude_does_not_matter(scale):
    image = np.random.default_rng(0).uniform(0.5, 1, (9, 12))
    expected = Pupil.from_amplitude(image).amplitude
    np.testing.assert_allclose(Pupil.from_amplitude(scale * image).amplitude, expected, rtol=1e-14)


def test_pupil_is_a_copy_of_its_arrays():
    image, segments = np.ones((8, 8)), np.ones((8, 8), int)
    pupils = Pupil(image, 8, segments, (3.5, 3.5)), Pupil.from_segments(segments), Pupil.from_amplitude(image)
    image[0, 0] = segments[0, 0] = 0
    for pupil in pupils:
        assert pupil.n_points == 64
        assert pupil.segments.all()
