"""Maximum likelihood: on masks and inputs beyond the paper, with noise, and in its own unknowns."""

import numpy as np
import pytest

from zwfs import (
    Detector,
    Dimple,
    MaximumLikelihood,
    Patch,
    Pupil,
    ZernikeSensor,
    cramer_rao,
    power_law_screens,
    reconstruction_error,
    wrapped_residual,
    zernike_basis,
)

PI = np.pi
CLEAR = Dimple(1, 0)


def pair(pupil, diameter, *shifts, **options):
    return ZernikeSensor(pupil, *(Dimple(diameter, shift * PI) for shift in shifts), **options)


def exposed(pupil, frames, photons, n_draws, seed=5):
    """Noisy frames, n_draws of each."""
    camera = Detector(photons)
    return camera.normalise(camera.expose(np.broadcast_to(frames, (n_draws, *frames.shape)), seed))


# The paper's iteration diverges on most of these masks.
@pytest.mark.parametrize("diameter", [1.06, 2.0, 2.4, 3.0])
@pytest.mark.parametrize("shifts", [(0.5, -0.5), (0.75, -0.75), (0.33, -0.74), (0.30, -0.68)])
def test_all_screens_come_back_and_are_known_to_be_right(pupil, screens, diameter, shifts):
    sensor = pair(pupil, diameter, *shifts)
    truth = np.concatenate([screens(rms, 2, seed=8) for rms in (0.2, 0.6, 1.0)])
    result = MaximumLikelihood(sensor)(sensor.measure(truth))
    assert result.consistent.all()
    assert result.converged.all()
    assert reconstruction_error(pupil, result.phase, truth).max() < 1e-6


def test_a_large_range_needs_several_starts(pupil, screens):
    sensor, truth = pair(pupil, 2.0, 0.5, -0.5), screens(2.0, 12, seed=3)
    frames = sensor.measure(truth)
    single, many = (MaximumLikelihood(sensor, n_starts=n)(frames) for n in (1, 8))
    right = reconstruction_error(pupil, many.phase, truth) < 0.05 * 2.0
    assert single.consistent.sum() < many.consistent.sum()
    assert right.sum() >= 10
    np.testing.assert_array_equal(right, many.consistent)  # a wrong solution is not called consistent
    np.testing.assert_array_equal(many.n_starts == 1, single.consistent)
    assert many.n_starts.max() <= 8


@pytest.mark.parametrize(
    ("diameter", "rms", "photons"), [(1.06, 0.5, 100), (1.06, 1.0, 1000), (2.0, 0.05, 100), (2.0, 1.0, 10000)]
)
def test_error_is_the_bound_and_sigma_says_so(pupil, screens, diameter, rms, photons):
    sensor, truth = pair(pupil, diameter, 0.5, -0.5), screens(rms, 1)[0]
    frames = exposed(pupil, sensor.measure(truth), photons, 20)
    result = MaximumLikelihood(sensor, photons=photons)(frames)
    residual = wrapped_residual(pupil, result.phase, truth)
    bound = cramer_rao(sensor, truth, photons=photons)
    assert np.nanmean(residual**2) == pytest.approx(np.nanmean(bound**2), rel=0.1)
    assert np.nanmean(result.chi2) == pytest.approx(1, abs=0.03)
    assert result.consistent.all()
    within = np.mean(pupil.gather(np.abs(residual) < result.sigma))
    assert within == pytest.approx(0.683, abs=0.02)
    # A control: with the wrong number of photons the error bars are too small, and the frames unexplained.
    wrong = MaximumLikelihood(sensor, photons=10 * photons, n_starts=1)(frames)
    assert np.mean(pupil.gather(np.abs(wrapped_residual(pupil, wrong.phase, truth)) < wrong.sigma)) < 0.4
    assert not wrong.consistent.any()


def test_negative_pixels_bias_nothing(pupil, modes):
    """Electrons plus the variance of the read noise are negative in 3 % of the pixels."""
    photons, read_noise = 5, 1.0
    sensor, basis = pair(pupil, 1.06, 0.5, -0.5), modes[:20]
    true = np.random.default_rng(3).normal(0, 0.05, (50, 20))
    camera = Detector(photons, read_noise=read_noise)
    frames = sensor.measure(np.tensordot(true, np.where(pupil.inside, basis, 0), 1))
    frames = camera.normalise(camera.expose(frames, 1))
    method = MaximumLikelihood(sensor, basis, photons=photons, read_noise=read_noise, n_starts=1)
    result, clipped = method(frames), method(np.maximum(frames, 0))
    gain, clipped_gain = (np.sum(estimate.coefficients * true) / np.sum(true**2) for estimate in (result, clipped))
    assert gain == pytest.approx(1, abs=0.02)
    within = np.mean(np.abs(result.coefficients - true) < result.sigma_coefficients)
    assert within == pytest.approx(0.683, abs=0.03)
    assert np.mean(result.chi2) == pytest.approx(1, abs=0.01)
    assert result.consistent.all()
    assert clipped_gain < 0.97
    assert np.mean(clipped.chi2) < 0.9


def test_a_solution_that_has_not_converged_is_not_called_consistent(pupil, screens):
    sensor = pair(pupil, 1.06, 0.5, -0.5)
    cut = MaximumLikelihood(sensor, n_iterations=2, tolerance=1e-12)(sensor.measure(screens(0.5)))
    assert cut.residual.max() < 1e-6
    assert not cut.converged.any()
    assert not cut.consistent.any()
    assert np.all(cut.n_starts == 1)  # the frames are explained: no other start would do better


@pytest.mark.parametrize(("sigmas", "consistent"), [(4.8, True), (5.2, False)])
def test_a_misfit_of_more_than_5_standard_deviations_is_not_consistent(pupil, modes, sigmas, consistent):
    sensor, photons = pair(pupil, 1.06, 0.5, -0.5), 1e6
    light = sensor.measure(np.zeros(pupil.shape))
    noise = np.random.default_rng(1).normal(size=light.shape)
    # The misfit is the sum of n squares, of variance 2 each; the fit of one mode takes one away.
    n = light.size
    noise *= np.sqrt((n - 1 + sigmas * np.sqrt(2 * n)) / np.sum(noise**2))
    result = MaximumLikelihood(sensor, modes[:1], photons=photons)(light + noise * np.sqrt(light / photons))
    assert result.converged
    assert result.consistent == consistent


def test_faint_photon_noise_is_consistent(pupil, modes):
    """Squares of Poisson numbers spread more than those of a Gaussian: at 0.1 photons by a factor of 2.4."""
    sensor = pair(pupil, 1.06, 0.5, -0.5)
    frames = exposed(pupil, sensor.measure(np.zeros(pupil.shape)), 0.1, 100)
    result = MaximumLikelihood(sensor, modes[:2], photons=0.1, n_starts=1)(frames)
    assert result.consistent.all()
    assert np.mean(result.chi2) == pytest.approx(1, abs=0.03)


def test_one_photon_in_the_dark_does_not_decide_chi2(pupil, modes):
    sensor = pair(pupil, 1.06, 0.5, -0.5, extent=2.0)
    light = sensor.measure(np.zeros(pupil.shape))
    assert 30 * light.min() < 1e-5
    result = MaximumLikelihood(sensor, modes[:2], photons=30, n_starts=1)(exposed(pupil, light, 30, 60))
    np.testing.assert_allclose(result.chi2, 1, atol=0.06)


def test_without_a_number_of_photons_sigma_follows_from_the_residual(pupil, screens):
    sensor, truth = pair(pupil, 1.06, 0.5, -0.5), screens(0.3, 1)[0]
    rng = np.random.default_rng(2)
    frames = sensor.measure(truth)
    frames = np.maximum(frames + rng.normal(0, 1e-3, (10, *frames.shape)), 0)
    result = MaximumLikelihood(sensor, n_starts=1)(frames)
    residual = wrapped_residual(pupil, result.phase, truth)
    assert np.mean(pupil.gather(np.abs(residual) < result.sigma)) == pytest.approx(0.683, abs=0.05)
    assert np.isnan(result.chi2).all()


def test_modes_and_their_errors(pupil, modes):
    sensor, basis = pair(pupil, 2.4, 0.3, -0.68), modes[:30]
    true = np.random.default_rng(3).normal(0, 0.12, (20, 30))
    truth = np.tensordot(true, np.where(pupil.inside, basis, 0), 1)
    exact = MaximumLikelihood(sensor, basis)(sensor.measure(truth))
    np.testing.assert_allclose(exact.coefficients, true, atol=1e-6)
    np.testing.assert_allclose(pupil.gather(exact.phase), pupil.gather(truth), atol=1e-6)  # it is not wrapped
    camera = Detector(30)
    noisy = MaximumLikelihood(sensor, basis, photons=30)(camera.normalise(camera.expose(sensor.measure(truth), 4)))
    pull = (noisy.coefficients - true) / noisy.sigma_coefficients
    assert np.std(pull) == pytest.approx(1, abs=0.1)
    points = wrapped_residual(pupil, noisy.phase, truth)
    assert np.sqrt(np.nanmean(points**2)) == pytest.approx(np.sqrt(np.nanmean(noisy.sigma**2)), rel=0.15)


@pytest.mark.parametrize(("rms", "photons"), [(1.0, 1e3), (1.5, 1e4), (2.0, 1e5), (3.0, 1e5), (3.0, None)])
def test_modes_are_at_least_as_good_as_points(rms, photons):
    """At the rim of these screens neighbours differ by more than pi."""
    pupil = Pupil.circular(48)
    basis = zernike_basis(pupil, 120)
    sensor = pair(pupil, 1.06, 0.5, -0.5)
    truth = power_law_screens(basis, rms, 5, exponent=-2, seed=41)
    frames = sensor.measure(truth)
    if photons is not None:
        camera = Detector(photons)
        frames = camera.normalise(camera.expose(frames, 8))
    points, fitted = (MaximumLikelihood(sensor, unknowns, photons=photons) for unknowns in (None, basis))
    result = fitted(frames)
    error = reconstruction_error(pupil, result.phase, truth)
    assert result.consistent.all()
    assert np.all(error <= reconstruction_error(pupil, points(frames).phase, truth) + 1e-5)
    if photons is not None and rms <= 2:
        bound = np.linalg.norm(cramer_rao(sensor, truth, photons=photons, modes=basis), axis=-1)
        assert np.sqrt(np.mean((error / bound) ** 2)) < 1.1
    # A given start may be wrapped, too.
    start = np.angle(np.exp(1j * np.where(pupil.inside, truth, 0)))
    again = MaximumLikelihood(sensor, basis, photons=photons, n_starts=1)(frames, start)
    assert reconstruction_error(pupil, again.phase, result.phase).max() < 1e-4


def test_modes_on_pupils_with_gaps_and_corners():
    y, x = np.mgrid[:48, :48] - 23.5
    parts = (np.hypot(x, y) < 24) & (np.hypot(x, y) > 6) & (np.abs(x) > 1) & (np.abs(y) > 1)
    quadrants, hexagon = Pupil.from_amplitude(parts.astype(float)), Pupil.hexagonal(48)
    for pupil, n_modes, rms, seed in ((quadrants, 60, 2.0, 42), (hexagon, 100, 1.0, 25)):
        basis, sensor = zernike_basis(pupil, n_modes), pair(pupil, 1.06, 0.5, -0.5)
        truth = power_law_screens(basis, rms, 4, exponent=-2, seed=seed)
        result = MaximumLikelihood(sensor, basis, n_starts=1)(sensor.measure(truth))
        assert result.consistent.all()
        assert reconstruction_error(pupil, result.phase, truth).max() < 1e-5


def test_a_prior_helps_faint_frames_and_does_not_bias_bright_ones(pupil):
    sensor, basis = pair(pupil, 1.06, 0.5, -0.5), zernike_basis(pupil, 60)
    variance = np.arange(2.0, 62) ** -2
    variance *= 0.25 / variance.sum()
    true = np.random.default_rng(6).normal(0, np.sqrt(variance), (20, 60))
    frames = sensor.measure(np.tensordot(true, np.where(pupil.inside, basis, 0), 1))
    for photons, gain in ((1, 0.8), (3000, 1.01)):
        camera = Detector(photons)
        noisy = camera.normalise(camera.expose(frames, 7))
        plain, prior = (
            MaximumLikelihood(sensor, basis, photons=photons, prior=covariance, n_starts=1)(noisy)
            for covariance in (None, np.diag(variance))
        )
        errors = [np.sqrt(np.mean((estimate.coefficients - true) ** 2)) for estimate in (plain, prior)]
        assert errors[1] < gain * errors[0]
        assert np.std((prior.coefficients - true) / prior.sigma_coefficients) == pytest.approx(1, abs=0.1)


def test_phase_and_amplitude_together(pupil, screens):
    sensor = ZernikeSensor(pupil, Dimple(1.06, PI / 2), Dimple(1.06, -PI / 2), CLEAR)
    truth = screens(0.7, 6)
    amplitude = np.exp(0.2 * np.where(pupil.inside, screens(1.0, 6, seed=9), 0))
    frames = sensor.measure(truth, amplitude)
    exact = MaximumLikelihood(sensor, amplitude="unknown")(frames)
    assert exact.consistent.all()
    np.testing.assert_allclose(pupil.gather(exact.amplitude), pupil.gather(amplitude), atol=1e-6)
    assert reconstruction_error(pupil, exact.phase, truth).max() < 1e-6
    assert exact.residual.max() < 1e-6
    ignorant = MaximumLikelihood(sensor, n_starts=1)(frames)
    assert not ignorant.consistent.any()
    camera = Detector(1000)
    noisy = MaximumLikelihood(sensor, photons=1000, amplitude="unknown")(
        camera.normalise(camera.expose(frames, 3))
    )
    for error, sigma in (
        (wrapped_residual(pupil, noisy.phase, truth), noisy.sigma),
        (noisy.amplitude - amplitude, noisy.sigma_amplitude),
    ):
        assert np.mean(pupil.gather(np.abs(error) < sigma)) == pytest.approx(0.683, abs=0.03)
    expected = cramer_rao(sensor, truth[0], photons=1000, amplitude=amplitude[0], amplitude_known=False)
    assert np.nanmean(noisy.sigma[0]) == pytest.approx(np.nanmean(expected), rel=0.03)


@pytest.mark.parametrize(
    "masks",
    [
        [Dimple(1.06, PI / 2), Dimple(2.2, -1.0)],
        [Patch(2.0, lambda u, v: (0.8 + 0.1 * u) * np.exp(1j * (1.5 + u - v))), Dimple(1.5, -1.2, amplitude=0.6)],
        [Dimple(1.06, PI / 2), Dimple(1.06, -PI / 2), Dimple(1.06, PI)],
    ],
)
@pytest.mark.parametrize("extent", [1.0, 1.6])
def test_any_masks_and_any_detector(pupil, screens, masks, extent):
    sensor, truth = ZernikeSensor(pupil, *masks, extent=extent), screens(0.6, 2)
    result = MaximumLikelihood(sensor)(sensor.measure(truth))
    assert result.consistent.all()
    assert reconstruction_error(pupil, result.phase, truth).max() < 1e-5
