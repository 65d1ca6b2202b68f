"""Screens that are recovered beyond the paper: control cases, and physics that the tables must show."""

import numpy as np
import pytest

import zwfs
from studies.beyond_range import (
    REST,
    TILT,
    FineCamera,
    ModelErrors,
    Trials,
    dimple_bounds,
    model_curves,
    noise_curves,
)
from studies.kit.iteration import DARK_RING, iteration_spectrum
from studies.kit.methods import ACCELERATED, LIKELY, MODES, PLAIN, opposite_dimples
from studies.kit.setups import make_screens, screens_at


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(32)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, 40)


@pytest.fixture(scope="module")
def sensor(pupil):
    return opposite_dimples(pupil, 1.06, np.pi / 2)


@pytest.fixture(scope="module")
def trials(pupil, sensor):
    return Trials(sensor, make_screens(pupil, 40, -2.0), n_iterations=25, seed=3)


def test_photons_set_the_error_and_the_plain_iteration_has_a_range(trials):
    noiseless, few, many = noise_curves(trials, [1e5, 1e3], [0.5, 3.0], [8.0], 8)
    assert (few.photons, many.photons) == (1e3, 1e5)
    assert noiseless.rms.tolist() == [0.5, 3.0, 8.0]
    assert noiseless.recovered(LIKELY).tolist() == [1, 1, 1]
    assert noiseless.recovered(PLAIN)[0] == 1 > noiseless.recovered(PLAIN)[1]
    for name in (ACCELERATED, LIKELY, MODES):
        np.testing.assert_allclose(few.median(name)[0] / many.median(name)[0], 10, rtol=0.1)
    for curve in (few, many):
        assert curve.median(PLAIN)[1] > 1
        np.testing.assert_allclose(curve.median(LIKELY)[0], curve.bound[0], rtol=0.15)
        assert curve.median(MODES)[0] < curve.bound[0] / 2
        assert curve.median("Linear")[0] > 5 * curve.median(LIKELY)[0]


def test_each_error_of_the_model_costs_and_a_right_model_does_not(trials):
    wrong = model_curves(trials, ModelErrors(0.02, 0.03, 0.2, 0.05, 3), [0.5], 3)
    right = model_curves(trials, ModelErrors(0.0, 0.0, 0.0, 0.0, 3), [0.5], 3)
    amplitude, offset, diameter, shift, area = (np.median(one.errors[LIKELY]) for one in wrong.values())
    assert amplitude > offset > diameter > shift > area > 0
    for kind, (curve, control) in enumerate(zip(wrong.values(), right.values(), strict=True)):
        if kind in (0, 2, 3):  # on the grid of the model
            assert control.errors[ACCELERATED].max() < 1e-5 < 1e-3 < curve.errors[ACCELERATED].min()


def test_camera_pixels_are_means_and_a_whole_pixel_of_displacement_is_one(sensor):
    camera = FineCamera(sensor, 40, 4)
    assert camera.pupil.n_points == 16 * sensor.pupil.n_points
    assert camera.mean(np.arange(64.0).reshape(8, 8)).tolist() == [[13.5, 17.5], [45.5, 49.5]]
    fine = np.where(camera.pupil.inside, screens_at(camera.modes, 0.3, 2, 1, 0), 0)
    still, moved = camera.frames(fine), camera.frames(fine, 1.0)
    assert np.array_equal(moved[:, 0], still[:, 0])
    np.testing.assert_allclose(moved[:, 1], np.roll(still[:, 1], -1, axis=-1), atol=1e-14)
    between = (camera.frames(fine, 0.25) + camera.frames(fine, 0.5)) / 2
    np.testing.assert_allclose(camera.frames(fine, 0.375), between, atol=1e-14)
    # Smooth screens hardly change within a pixel.
    coarse = sensor.measure(camera.mean(fine))
    assert np.abs(still - coarse)[..., sensor.pupil.inside].max() < 0.02


def test_the_contraction_limits_the_iteration_near_the_truth(sensor, modes, pupil):
    screens = screens_at(modes, 2.6, 16, 3, 2)
    factors = np.array([abs(iteration_spectrum(pupil, 1.06, screen)[0]) for screen in screens])
    near = screens + screens_at(modes, 1e-4, 16, 9, 0)
    plain = zwfs.PhaseShifted(sensor, n_iterations=300, tolerance=0)
    stays = zwfs.reconstruction_error(pupil, plain(sensor.measure(screens), start=near).phase, screens) < 1e-4
    assert 0 < np.mean(factors < 1) < 1
    assert np.mean(stays == (factors < 1)) > 0.9


def test_frames_of_a_flat_wavefront_lose_tilt_at_the_dark_ring_and_not_beyond(trials):
    screen = trials.screens(0.5, 1, task=0)
    bounds = dimple_bounds(trials, np.array([1.06, DARK_RING, 3.0]), screen)
    usual, ring, large = range(3)
    assert bounds[TILT][ring, 0] > 50 * bounds[REST][ring, 0]  # blind to tilt, and to nothing else
    assert bounds[REST][ring, 0] < bounds[REST][usual, 0]
    assert bounds[TILT][large, 0] < 30  # where the iteration diverges, too
    assert bounds[TILT][ring, 1] < 30  # not blind around an aberrated wavefront
    assert all(np.all(values >= 1) for values in bounds.values())  # no sensor is better than the ideal one
