import numpy as np
import pytest

from zwfs import Pupil, dynamic_range, reconstruction_error, strehl, wrapped_residual


def test_piston_and_turns_do_not_count(pupil, screens):
    phase = screens(1.0)
    offset = 2 * np.pi * np.random.default_rng(0).integers(-2, 3, phase.shape) + np.array(
        [[[1.3]], [[-2]], [[0.1]]]
    )
    np.testing.assert_allclose(reconstruction_error(pupil, phase + offset, phase), 0, atol=1e-12)
    residual = wrapped_residual(pupil, phase + offset, phase)
    assert np.isnan(residual[:, ~pupil.inside]).all()
    np.testing.assert_allclose(residual[:, pupil.inside], 0, atol=1e-12)


def test_error_is_the_rms_of_a_small_difference(pupil, screens):
    truth, difference = screens(3.0), screens(0.1, seed=2)
    # The piston of the mean phasor is the mean to third order.
    np.testing.assert_allclose(reconstruction_error(pupil, truth + difference, truth), 0.1, rtol=1e-4)


def test_residual_lies_on_the_circle(pupil):
    residual = wrapped_residual(pupil, np.linspace(-50, 50, 1600).reshape(40, 40), np.zeros(pupil.shape))
    inside = pupil.gather(residual)
    assert -np.pi < inside.min() < -3
    assert 3 < inside.max() <= np.pi


def test_strehl_of_two_halves_is_a_cosine():
    pupil = Pupil.circular(20)  # even: as many points left as right
    phase = np.where(pupil.x > 0, 0.4, -0.4) * np.ones(pupil.shape)
    assert strehl(pupil, phase + 2) == pytest.approx(np.cos(0.4) ** 2)


def test_strehl_weighs_points_with_their_amplitude():
    pupil = Pupil.from_amplitude([[1.0, 3.0]])
    assert strehl(pupil, [[np.pi, 0]]) == pytest.approx((2 / 4) ** 2)


def test_dynamic_range_interpolates_the_ratio():
    # Ratios 0.02 and 0.08: the threshold, their geometric mean, lies half of the way from 1 to 2.
    assert dynamic_range([0, 0.5, 1, 2], [9, 0, 0.02, 0.16], threshold=0.04) == pytest.approx(1.5)
    assert dynamic_range([0.5, 1, 2], [0, 0.02, 0.2], threshold=0.02) == pytest.approx(1)


def test_dynamic_range_ends_at_the_first_crossing():
    assert dynamic_range([1, 2, 3, 4], [0.025, 0.2, 0, 0.4]) == pytest.approx(1.5)


def test_dynamic_range_without_a_crossing():
    assert dynamic_range([1, 2], [0.06, 0]) == 0
    assert dynamic_range([1, 2], [0.05, 0.1]) == np.inf
