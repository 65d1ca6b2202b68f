"""Screens that are recovered beyond the paper: control cases, and physics that the tables must show."""

import numpy as np
import pytest

import zwfs
from studies.beyond_dimple import dimple_limits
from studies.beyond_range import (
    DIMMED,
    SECANT,
    FineCamera,
    ModelErrors,
    Trials,
    causes,
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


TRIALS = Trials(n_iterations=25, source=make_screens(zwfs.Pupil.circular(32), 40, -2.0), seed=3)


def test_photons_set_the_error_and_the_plain_iteration_has_a_range(sensor, modes):
    noiseless, few, many = noise_curves(sensor, modes, [1e5, 1e3], [0.5, 3.0], [8.0], 8, TRIALS)
    assert (few.photons, many.photons) == (1e3, 1e5)
    assert noiseless.complete_up_to(LIKELY, 0.05) == 8.0
    assert noiseless.complete_up_to(PLAIN, 0.05) == 0.5
    assert noiseless.consistent.all()
    for name in (ACCELERATED, LIKELY, MODES):
        np.testing.assert_allclose(few.median(name)[0] / many.median(name)[0], 10, rtol=0.1)
    for curve in (few, many):
        assert curve.median(PLAIN)[1] > 1
        for name in (LIKELY, MODES):
            np.testing.assert_allclose(curve.median(name)[0], curve.bound[name][0], rtol=0.15)
        assert curve.bound[MODES][0] < curve.bound[LIKELY][0] / 2
        assert curve.median("Linear")[0] > 5 * curve.median(LIKELY)[0]


def test_each_error_of_the_model_costs_and_a_right_model_does_not(sensor, modes):
    wrong = model_curves(sensor, modes, ModelErrors(0.02, 0.03, 0.2, 0.05, 3), [0.5], 3, TRIALS)
    right = model_curves(sensor, modes, ModelErrors(0.0, 0.0, 0.0, 0.0, 3), [0.5], 3, TRIALS)
    amplitude, offset, diameter, shift, area = (np.median(one.errors[LIKELY]) for one in wrong.values())
    assert amplitude > offset > diameter > shift > area > 0
    for kind, (curve, control) in enumerate(zip(wrong.values(), right.values(), strict=True)):
        if kind in (0, 2, 3):  # on the grid of the model
            assert control.errors[ACCELERATED].max() < 1e-5 < 1e-3 < curve.errors[ACCELERATED].min()


def test_camera_pixels_are_means_and_a_whole_pixel_of_displacement_is_one(sensor, modes):
    camera = FineCamera(sensor, modes, 4)
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


def test_the_start_and_the_contraction_limit_the_iteration(sensor, modes, pupil):
    found = causes(sensor, modes, [0.5, 2.2, 2.6], 16, 0.05, TRIALS)
    share = {name: found.curves.recovered(name) for name in found.curves.errors}
    assert all(values[0] == 1 for values in share.values())
    assert np.all(share[PLAIN][1:] < 0.5)
    assert np.array_equal(share[PLAIN] < 0.5, share[SECANT] < 0.5)  # the steps alone do not help
    assert np.all(share[DIMMED][1:] > share[PLAIN][1:] + 0.3)  # the start does
    assert np.all(share[ACCELERATED] >= share[DIMMED])
    half, accuracy = found.half(PLAIN, 0.05)
    assert 0.5 < half < 2.2
    assert accuracy > 0
    assert found.half(ACCELERATED, 0.05)[0] == np.inf
    # The factor decides whether the plain iteration returns to the truth from nearby.
    screens = screens_at(modes, 2.6, 16, TRIALS.seed, 2)
    near = screens + screens_at(modes, 1e-4, 16, 9, 0)
    plain = zwfs.PhaseShifted(sensor, n_iterations=300, tolerance=0)
    stays = zwfs.reconstruction_error(pupil, plain(sensor.measure(screens), start=near).phase, screens) < 1e-4
    assert np.mean(stays == (found.factor[2] < 1)) > 0.9


def test_frames_of_a_flat_wavefront_lose_tilt_where_the_eigenvalue_is_one_not_where_it_is_larger(pupil, modes):
    screen = screens_at(modes, 0.5, 1, seed=3, task=0)
    limits = dimple_limits(pupil, modes, np.pi / 2, [1.06, 3.0], screen)
    usual, ring, large = range(3)
    assert limits.diameters[ring] == DARK_RING
    np.testing.assert_allclose(
        limits.factor[:, 1], [abs(iteration_spectrum(pupil, d, screen[0])[0]) for d in limits.diameters]
    )
    assert limits.factor[usual, 0] < 0.5 < limits.factor[ring, 0] < limits.factor[large, 0]
    assert abs(limits.factor[ring, 0] - 1) < 0.01 < limits.factor[large, 0] - 1
    assert limits.tilt[ring, 0] > 50 * limits.others[ring, 0]  # blind to tilt, and to nothing else
    assert limits.others[ring, 0] < limits.others[usual, 0]
    assert limits.tilt[large, 0] < 30  # diverging, not blind
    assert limits.tilt[ring, 1] < 30  # not blind around an aberrated wavefront
    assert np.all(limits.bound >= 1)  # no sensor is better than the ideal one
