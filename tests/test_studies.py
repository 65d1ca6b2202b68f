"""Numbers of the studies against theory, and against other ways to them; nbval sees every other change."""

import numpy as np
import pytest

import zwfs
from studies.beyond_range import FineCamera
from studies.dark_zone import Drift, errors_of_one_photon, integrator_residual, kalman_limit, simulate
from studies.identities import approximation_errors, arccosine_phase, pair_phase
from studies.kit.curves import Limit, fitted_limit, refined_limit
from studies.kit.setups import screens_at
from studies.phase_amplitude import amplitude_maps, reconstruct
from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis

TRUE = 1.6  # where 5 % of the screens fail


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
    limits = [fitted_limit(x, draw(x, rng, 200), 0.05, seed, n_draws=200) for seed in range(300)]
    value, error = np.transpose(limits)
    assert abs(value.mean() - TRUE) < 0.3 * value.std()
    assert value.std() < 0.02 * TRUE
    within = [np.mean(abs(value - TRUE) < size * error) for size in (0.5, 1, 2)]
    assert 0.60 < within[1] < 0.76
    assert within[0] < 0.5  # control: an error of half the size does not cover the limit
    assert within[2] > 0.90


@pytest.mark.parametrize("ratio", [0.01, 0.1])
def test_a_curve_without_a_limit_has_no_uncertainty(ratio):
    limit = refined_limit(lambda x: np.full((5, 3), ratio), 1.0, 0.05, width=0.15)
    assert limit.value == 1
    assert np.isnan(limit.error)


def test_the_error_of_a_ratio_is_that_of_draws():
    rng, upper, lower = np.random.default_rng(3), Limit(1.6, 0.03), Limit(0.06, 0.002)
    draws = rng.normal(*upper, 100_000) / rng.normal(*lower, 100_000)
    assert upper.over(lower) == pytest.approx((draws.mean(), draws.std()), rel=0.02)
    assert np.isnan(upper.over(Limit(0.0)).value)
    assert np.isnan(upper.over(Limit(np.inf)).value)


def test_equations_give_the_phase_back(shifted, screens):
    pupil, phase = shifted.pupil, screens(0.2, 2)
    amplitude, truth = pupil.gather(pupil.amplitude), pupil.gather(phase)
    waves = pupil.gather(shifted.reference_wave(pupil.amplitude * np.exp(1j * phase)))
    frames = pupil.gather(shifted.measure(phase))
    assert pair_phase(frames, amplitude, waves) == pytest.approx(truth, abs=1e-12)
    # One image: on the side of the branch that the dimple of +pi/2 has.
    safe = np.abs(truth) < 0.5
    estimate = arccosine_phase(frames[:, 0], amplitude, waves[:, 0])
    assert estimate[safe] == pytest.approx(truth[safe], abs=1e-6)


def test_approximation_is_right_to_second_order_in_amplitude_only(shifted, screens):
    shapes = screens(1.0, 4)
    small, large = (approximation_errors(shifted, rms * shapes) for rms in (0.05, 0.1))
    assert large.phase / small.phase == pytest.approx(2, rel=0.05)
    assert large.amplitude / small.amplitude == pytest.approx(4, rel=0.2)
    assert large.two_images / small.two_images == pytest.approx(2, rel=0.05)


def test_camera_pixels_are_means_and_a_whole_pixel_of_displacement_is_one(shifted):
    camera = FineCamera(shifted, 30, 4)
    assert camera.mean(np.arange(64.0).reshape(8, 8)).tolist() == [[13.5, 17.5], [45.5, 49.5]]
    fine = np.where(camera.pupil.inside, screens_at(camera.modes, 0.3, 2, 1, 0), 0)
    still, moved = camera.frames(fine), camera.frames(fine, 1.0)
    assert np.array_equal(moved[:, 0], still[:, 0])
    np.testing.assert_allclose(moved[:, 1], np.roll(still[:, 1], -1, axis=-1), atol=1e-14)
    between = (camera.frames(fine, 0.25) + camera.frames(fine, 0.5)) / 2
    np.testing.assert_allclose(camera.frames(fine, 0.375), between, atol=1e-14)


def test_the_error_of_an_ignored_amplitude_is_a_fixed_share_of_a_small_phase(pupil, modes, shifted):
    # To first order an amplitude error d changes the phase by d sin(phi) / |beta|.
    sensor = ZernikeSensor(pupil, *shifted.masks, Dimple(1, 0))
    amplitude = amplitude_maps(pupil, modes, "dips", 0.02, 1, seed=5)[0]
    screen = zwfs.power_law_screens(modes, 1.0, 1, seed=5)[0]
    shares = []
    for rms in (0.05, 0.1):
        frames = sensor.measure(rms * screen, amplitude)[np.newaxis]
        [result] = reconstruct("PhaseShifted, ignored", sensor, frames, 1000.0)
        shares.append(zwfs.reconstruction_error(pupil, result.phase[0], rms * screen) / rms)
    assert shares[0] == pytest.approx(shares[1], rel=0.05)
    assert 0.5 < shares[0] / (2 * 0.02) < 2


@pytest.fixture(scope="module")
def drift():
    return Drift(zernike_basis(Pupil.circular(20), 6), 10.0, 500.0, n_cycles=60, n_screens=20, seed=1)


@pytest.fixture(scope="module")
def drift_sensors():
    pairs = {"pair": (1.06, 0.5 * np.pi), "best": (1.4, 0.7 * np.pi)}
    pupil = Pupil.circular(20)
    return {
        name: ZernikeSensor(pupil, Dimple(diameter, shift), Dimple(diameter, -shift))
        for name, (diameter, shift) in pairs.items()
    }


def test_the_limit_is_that_of_a_kalman_filter_step_by_step(drift_sensors, drift):
    errors = errors_of_one_photon(drift_sensors, drift)["pair"]
    step, noise, variance = 100 / 6, errors**2 / 1e8, np.zeros(6)
    for _ in range(1000):
        variance = variance * noise / (variance + noise) + step
    assert kalman_limit(errors, drift, 1e8) == pytest.approx(np.sqrt(variance.sum()), rel=1e-9)


def test_a_simulated_loop_has_the_residual_of_the_formula(drift_sensors, drift):
    errors, gains = errors_of_one_photon(drift_sensors, drift)["best"], [0.2, 0.9]
    expected = integrator_residual(errors, drift, 1e8, gains)
    np.testing.assert_allclose(simulate(drift_sensors["best"], drift, 1e8, gains), expected, rtol=0.06)
