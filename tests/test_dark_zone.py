"""The held drift: limits of the theory, and a simulated loop that reaches them."""

import numpy as np
import pytest

from studies.dark_zone import (
    IDEAL,
    Drift,
    best_gain,
    errors_of_one_photon,
    integrator_residual,
    kalman_limit,
    photons_to_hold,
    simulate,
)
from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis


@pytest.fixture(scope="module")
def drift():
    return Drift(zernike_basis(Pupil.circular(20), 6), 10.0, 500.0, n_cycles=60, n_screens=20, seed=1)


@pytest.fixture(scope="module")
def sensors():
    small, wide = ([Dimple(d, s * p * np.pi) for s in (1, -1)] for d, p in ((1.06, 0.5), (1.4, 0.7)))
    pupil = Pupil.circular(20)
    return {n: ZernikeSensor(pupil, *m) for n, m in (("one", small[:1]), ("pair", small), ("best", wide))}


@pytest.fixture(scope="module")
def errors(sensors, drift):
    return errors_of_one_photon(sensors, drift)


def test_the_limit_is_the_residual_of_the_best_gain_of_each_mode(errors, drift):
    for photons in (1e6, 1e9):
        share = Drift(drift.modes[:1], drift.rms / np.sqrt(6), drift.wavelength)
        held = [
            integrator_residual([error], share, photons, best_gain([error], share, photons))
            for error in errors["best"]
        ]
        assert kalman_limit(errors["best"], drift, photons) == pytest.approx(np.linalg.norm(held), rel=1e-6)


def test_the_limit_is_that_of_a_kalman_filter_step_by_step(errors, drift):
    step, noise, variance = 100 / 6, errors["pair"] ** 2 / 1e8, np.zeros(6)
    for _ in range(1000):
        variance = variance * noise / (variance + noise) + step
    assert kalman_limit(errors["pair"], drift, 1e8) == pytest.approx(np.sqrt(variance.sum()), rel=1e-9)


def test_limits_of_much_and_little_light(errors, drift):
    assert kalman_limit(errors["pair"], drift, 1e20) == pytest.approx(10.0)
    faint = kalman_limit(errors[IDEAL], drift, 1.0)
    assert faint**2 == pytest.approx(10.0 * drift.scale / 2 * np.sqrt(6), rel=1e-3)  # q + sqrt(q v), all modes


def test_best_gain_and_photons_to_hold(errors, drift):
    gain = best_gain(errors["pair"], drift, 1e8)
    around = integrator_residual(errors["pair"], drift, 1e8, gain * np.array([0.98, 1.0, 1.02]))
    assert around.argmin() == 1
    assert around[1] >= kalman_limit(errors["pair"], drift, 1e8)
    photons = photons_to_hold(errors["pair"], drift, 15.0)
    assert kalman_limit(errors["pair"], drift, photons) == pytest.approx(15.0)


def test_one_image_is_as_good_as_two_around_a_flat_wavefront_and_no_sensor_beats_the_ideal_one(errors):
    np.testing.assert_allclose(errors["one"], errors["pair"], rtol=1e-6)
    assert errors["best"].mean() < errors["pair"].mean()
    assert (errors["best"] > errors[IDEAL]).all()


def test_a_simulated_loop_has_the_residual_of_the_formula(errors, sensors, drift):
    gains = [0.2, 0.9]
    expected = integrator_residual(errors["best"], drift, 1e8, gains)
    np.testing.assert_allclose(simulate(sensors["best"], drift, 1e8, gains), expected, rtol=0.06)
