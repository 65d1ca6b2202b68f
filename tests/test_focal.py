import numpy as np
import pytest
from scipy.special import j1

from zwfs import Dimple, Pupil, ZernikeSensor, strehl
from zwfs.focal import focal_field


def test_flat_wavefront_makes_the_airy_pattern():
    pupil = Pupil.circular(400)
    u = np.linspace(0.05, 4, 60)
    field = focal_field(pupil, pupil.amplitude, u, [0.0])[0]
    np.testing.assert_allclose(field, 2 * j1(np.pi * u) / (np.pi * u), atol=2e-3)
    assert focal_field(pupil, pupil.amplitude, [0.0], [0.0])[0, 0] == pytest.approx(1)


def test_tilt_moves_the_image_along_its_slope():
    pupil = Pupil.circular(64)
    u = np.linspace(-3, 3, 121)
    tilted = np.exp(2j * np.pi * (1.5 * pupil.x - 0.5 * pupil.y[:, np.newaxis]))
    intensity = np.abs(focal_field(pupil, tilted, u, u)) ** 2
    row, column = np.unravel_index(intensity.argmax(), intensity.shape)
    assert (u[column], u[row]) == pytest.approx((1.5, -0.5))


def test_strehl_is_the_intensity_on_the_axis(pupil, screens):
    screen = screens(0.7, 1)[0]
    field = focal_field(pupil, np.exp(1j * screen), [0.0], [0.0])
    assert np.abs(field[0, 0]) ** 2 == pytest.approx(strehl(pupil, screen), rel=1e-12)


def test_integral_over_the_dimple_is_the_reference_wave_on_the_axis():
    pupil, mask = Pupil.circular(31), Dimple(1.4, 2.0)
    field = np.exp(1j * np.hypot(*np.meshgrid(pupil.x, pupil.y)))
    axis = (np.arange(400) + 0.5) / 400 * 1.4 - 0.7
    inside = np.hypot(*np.meshgrid(axis, axis)) <= 0.7
    total = (focal_field(pupil, field, axis, axis) * inside).sum() * (1.4 / 400) ** 2
    expected = (np.exp(2j) - 1) * total * pupil.n_points / pupil.n_pixels**2
    assert ZernikeSensor(pupil, mask).reference_wave(field)[0, 15, 15] == pytest.approx(expected, rel=2e-3)


def test_bad_input_is_named(pupil):
    field = np.ones(pupil.shape)
    with pytest.raises(ValueError, match=r"field has shape \(3, 3\)"):
        focal_field(pupil, np.ones((3, 3)), [0.0], [0.0])
    with pytest.raises(ValueError, match=r"u has shape \(1, 1\): expected one dimension"):
        focal_field(pupil, field, [[0.0]], [0.0])
    with pytest.raises(ValueError, match="v holds 1 NaN"):
        focal_field(pupil, field, [0.0], [np.nan])
    with pytest.raises(ValueError, match=r"u reaches 20\.1 lambda/D: expected at most 20,"):
        focal_field(pupil, field, [20.1], [0.0])
    with pytest.raises(ValueError, match=r"field reaches a modulus of 1e\+308"):
        focal_field(pupil, 1e308 * field, [0.0], [0.0])
