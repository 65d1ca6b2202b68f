import numpy as np
import pytest
from scipy.special import j1

from zwfs import Dimple, Patch, Pupil, ZernikeSensor
from zwfs.masks import focal_field


def test_dimple_is_uniform():
    u = np.linspace(-0.5, 0.5, 6).reshape(2, 3)
    np.testing.assert_allclose(Dimple(1.06, 0.3, 0.9).transmission(u, u), np.full((2, 3), 0.9 * np.exp(0.3j)))


def test_patch_is_its_function_of_u_and_v():
    u, v = np.array([0.1, 0.2]), np.array([0.3, -0.4])
    np.testing.assert_allclose(
        Patch(2, lambda u, v: np.exp(1j * (u + 10 * v))).transmission(u, v), np.exp([3.1j, -3.8j])
    )
    np.testing.assert_array_equal(Patch(2, lambda u, v: 0.5).transmission(u, v), [0.5, 0.5])


def test_phases_of_a_full_turn_are_accepted():
    for phase in (2 * np.pi, -2 * np.pi, 6.2832):  # rounded, as in the limits of the notebooks
        assert Dimple(1.06, phase).phase == phase


def test_a_function_that_works_in_place_moves_no_node():
    u = np.array([0.1, 0.2])

    def moved(u, v):
        u -= 0.1
        return np.exp(1j * u)

    np.testing.assert_allclose(Patch(2, moved).transmission(u, u), np.exp(1j * (u - 0.1)))
    np.testing.assert_array_equal(u, [0.1, 0.2])


def test_flat_wavefront_makes_the_airy_pattern():
    pupil = Pupil.circular(400)
    u = np.linspace(0.05, 4, 60)
    field = focal_field(pupil, pupil.amplitude, u, [0.0])[0]
    np.testing.assert_allclose(field, 2 * j1(np.pi * u) / (np.pi * u), atol=2e-3)
    assert focal_field(pupil, pupil.amplitude, [0.0], [0.0])[0, 0] == pytest.approx(1)


def test_integral_over_the_dimple_is_the_reference_wave_on_the_axis():
    pupil, mask = Pupil.circular(31), Dimple(1.4, 2.0)
    field = np.exp(1j * np.hypot(*np.meshgrid(pupil.x, pupil.y)))
    axis = (np.arange(400) + 0.5) / 400 * 1.4 - 0.7
    inside = np.hypot(*np.meshgrid(axis, axis)) <= 0.7
    total = (focal_field(pupil, field, axis, axis) * inside).sum() * (1.4 / 400) ** 2
    expected = (np.exp(2j) - 1) * total * pupil.n_points / pupil.n_pixels**2
    assert ZernikeSensor(pupil, mask).reference_wave(field)[0, 15, 15] == pytest.approx(expected, rel=2e-3)
