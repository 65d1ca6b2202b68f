"""Screens that are recovered beyond the paper: control cases, and physics that the tables must show."""

import numpy as np
import pytest

import zwfs
from studies.beyond_dimple import dimple_curves, dimple_limits
from studies.beyond_range import RecoveryCurves, Verdicts, compared_methods, recovery_curves
from studies.fig04_dimple_diameter import DARK_RING, iteration_spectrum
from studies.kit.methods import opposite_dimples
from studies.kit.setups import screens_at


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(32)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, 40)


@pytest.fixture(scope="module")
def curves(pupil, modes):
    sensors = {diameter: opposite_dimples(pupil, diameter, np.pi / 2) for diameter in (1.06, 3.0)}
    return recovery_curves(sensors, modes, [0.5, 2.5], 4, seed=3)


def test_only_maximum_likelihood_recovers_screens_beyond_the_dark_ring(curves):
    assert all(curve.recovered("MaximumLikelihood")[0] == 1 for curve in curves.values())
    assert curves[1.06].recovered("PhaseShifted")[0] == 1
    for name in ("PhaseShifted", "PhaseShiftedAccelerated"):
        assert curves[3.0].recovered(name)[0] == 0


def test_errors_are_those_of_each_screen_whatever_the_order_of_the_tasks(curves, pupil, modes):
    screens = screens_at(modes, 2.5, 4, seed=3, task=1)
    sensor = opposite_dimples(pupil, 3.0, np.pi / 2)
    result = zwfs.MaximumLikelihood(sensor)(sensor.measure(screens))
    error = zwfs.reconstruction_error(pupil, result.phase, screens)
    np.testing.assert_allclose(curves[3.0].errors["MaximumLikelihood"][1], error, rtol=1e-6, atol=1e-7)
    assert np.array_equal(curves[3.0].n_starts[1], result.n_starts)


def test_no_wrong_solution_is_consistent_and_some_are_wrong(pupil, modes):
    """With one start and few steps many solutions are wrong; the flag must see all of them."""
    sensor, said, right = opposite_dimples(pupil, 3.0, np.pi / 2), [], []
    screens = screens_at(modes, 2.5, 20, seed=1, task=0)
    for n_iterations in (2, 20):
        method = zwfs.MaximumLikelihood(sensor, n_starts=1, n_iterations=n_iterations)
        result = method(sensor.measure(screens))
        said.append(result.consistent)
        right.append(zwfs.reconstruction_error(pupil, result.phase, screens) <= 0.05 * 2.5)
    said, right = np.array(said), np.array(right)
    assert not np.any(said & ~right)
    assert 0 < np.count_nonzero(right) < right.size
    assert np.any(said)


def test_verdicts_count_every_screen_once():
    errors = np.array([[0.0, 0.5, 0.0, 0.5, 0.5]])
    said = np.array([[True, True, False, False, False]])
    curve = RecoveryCurves(np.array([1.0]), {"MaximumLikelihood": errors}, said, np.ones((1, 5), int))
    assert curve.verdicts() == Verdicts(1, 1, 1, 2)


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


def test_bounds_are_rms_values_of_those_of_the_modes(pupil, modes):
    limits = dimple_limits(pupil, modes, np.pi / 2, [2.0], np.zeros((1, *pupil.shape)))
    np.testing.assert_allclose(limits.factor[:, 0], limits.factor[:, 1])
    n_modes = len(modes)
    squares = 2 * limits.tilt**2 + (n_modes - 2) * limits.others**2
    np.testing.assert_allclose(limits.total**2, squares / n_modes)


def test_diameters_are_compared_for_the_same_pair_of_shifts(pupil, modes):
    screens = screens_at(modes, 0.5, 2, seed=3, task=0)
    curves = dimple_curves(pupil, np.pi / 2, 25, [1.06, 3.0], screens)
    sensor = opposite_dimples(pupil, 3.0, np.pi / 2)
    phase = compared_methods(sensor, 25)["PhaseShifted"](sensor.measure(screens)).phase
    np.testing.assert_allclose(curves.errors["PhaseShifted"][1], zwfs.reconstruction_error(pupil, phase, screens))
    assert list(curves.errors) == ["PhaseShifted", "PhaseShiftedAccelerated", "MaximumLikelihood"]
