"""Limits of reconstructors that are printed with an uncertainty."""

import numpy as np
import pytest

import zwfs
from studies.fig03_dynamic_range import error_limits
from studies.kit.curves import Limit, fitted_limit, refined_limit
from studies.kit.experiments import diameter_curves, diameter_limit, linearity_curves
from studies.kit.methods import PLAIN, opposite_dimples
from studies.kit.setups import screens_at

TRUE = 1.6  # where 5 % of the screens fail


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(32)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, 40)


def failing_screens(x, rng, n_screens):
    """Ratio of error to input if a screen is either recovered or lost, as near the limit of an iteration."""
    share = 1 / (1 + 19 * np.exp(-(np.asarray(x) - TRUE) / 0.1))
    return 1.0 * (rng.random((len(x), n_screens)) < share[:, np.newaxis])


def noisy_errors(x, rng, n_screens):
    """Ratio of error to input of a method whose error grows smoothly."""
    return 0.05 * (np.asarray(x)[:, np.newaxis] / TRUE) ** 1.5 * rng.gamma(4, 1 / 4, (len(x), n_screens))


@pytest.mark.parametrize("draw", [failing_screens, noisy_errors])
def test_a_known_limit_is_found_and_its_error_covers_it(draw):
    rng = np.random.default_rng(1)
    x = 1.04 * TRUE * np.linspace(0.85, 1.15, 5)
    found = np.array([fitted_limit(x, draw(x, rng, 200), 0.05, seed, n_draws=200) for seed in range(300)])
    value, error = found.T
    assert abs(value.mean() - TRUE) < 0.3 * value.std()
    assert value.std() < 0.02 * TRUE
    within = [np.mean(abs(value - TRUE) < size * error) for size in (0.5, 1, 2)]
    assert 0.60 < within[1] < 0.76
    assert within[0] < 0.5  # control: an error of half the size does not cover the limit
    assert within[2] > 0.90


def test_a_refined_limit_does_not_depend_on_the_start():
    rng = np.random.default_rng(2)
    for start in (0.7 * TRUE, TRUE, 1.4 * TRUE):
        limit = refined_limit(lambda x: failing_screens(x, rng, 400), start, 0.05, width=0.15)
        assert abs(limit.value - TRUE) < 3 * limit.error


@pytest.mark.parametrize("ratio", [0.01, 0.1])
def test_a_curve_without_a_limit_has_no_uncertainty(ratio):
    limit = refined_limit(lambda x: np.full((5, 3), ratio), 1.0, 0.05, width=0.15)
    assert limit.value == 1
    assert np.isnan(limit.error)


def test_the_error_of_a_ratio_is_that_of_draws():
    rng, (one, other) = np.random.default_rng(3), (Limit(1.6, 0.03), Limit(0.06, 0.002))
    draws = rng.normal(*one, 100_000) / rng.normal(*other, 100_000)
    assert one.over(other) == pytest.approx((draws.mean(), draws.std()), rel=0.02)
    assert np.isnan(one.over(Limit(0.0)).value)
    assert np.isnan(one.over(Limit(np.inf)).value)


def test_other_screens_give_the_same_limits(pupil, modes):
    sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    methods = {"PhaseShifted": zwfs.PhaseShifted(sensor), "GradientDescentPoints": zwfs.PhaseShifted(sensor)}
    curves = linearity_curves(methods, modes, [0.5, 1.0, 1.5, 2.0], 20, seed=1)
    one, two = (error_limits(methods, modes, curves, 0.05, seed=seed) for seed in (1, 2))
    first, second = one["PhaseShifted"], two["PhaseShifted"]
    assert 0 < abs(first.value - second.value) < 3 * np.hypot(first.error, second.error)
    assert 0 < first.error < 0.03 * first.value
    coarse = one["GradientDescentPoints"]  # not refined
    assert coarse.value == curves.dynamic_range("PhaseShifted")
    assert np.isnan(coarse.error)


def test_limits_of_the_diameter(pupil, modes):
    screens = screens_at(modes, 0.5, 60, seed=3, task=0)

    def make(diameter):
        return {PLAIN: zwfs.PhaseShifted(opposite_dimples(pupil, diameter, np.pi / 2))}

    def limit(half):
        return diameter_limit(curve, PLAIN, lambda diameters: diameter_curves(make, diameters, half), 0.05)

    curve = diameter_curves(make, np.arange(2, 2.7, 0.1), screens[:4])
    one, two = limit(screens[:30]), limit(screens[30:])
    assert abs(one.value - two.value) < 3 * np.hypot(one.error, two.error)
    assert 0 < one.error < 0.02 * one.value
