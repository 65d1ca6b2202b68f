import pickle

import numpy as np
import pytest

from zwfs import (
    Dimple,
    GradientDescent,
    Linear,
    MaximumLikelihood,
    Patch,
    PhaseShifted,
    PolychromaticSensor,
    Pupil,
    ZernikeSensor,
    cramer_rao,
    power_law_screens,
    reconstruction_error,
    zernike_basis,
)

WAVELENGTHS, WEIGHTS, REFERENCE = [600.0, 640.0, 700.0], [1.0, 3.0, 2.0], 650.0


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(24)


@pytest.fixture(scope="module")
def modes(pupil):
    return zernike_basis(pupil, 30)


@pytest.fixture(scope="module")
def sensor(pupil):
    return ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))


@pytest.fixture(scope="module")
def phases(modes):
    return power_law_screens(modes, 0.8, 2, exponent=-2, seed=1)


@pytest.fixture(scope="module", params=[False, True], ids=["achromatic", "chromatic"])
def band(sensor, request):
    return PolychromaticSensor(
        sensor, WAVELENGTHS, WEIGHTS, reference_wavelength=REFERENCE, chromatic=request.param
    )


def explicit(band, phases, amplitude=None):
    """Sum of the frames of one sensor for each wavelength."""
    total, light = 0, np.sum(WEIGHTS)
    for wavelength, weight in zip(WAVELENGTHS, WEIGHTS, strict=True):
        ratio = REFERENCE / wavelength
        shift = ratio if band.chromatic else 1.0
        masks = [Dimple(mask.diameter * ratio, mask.phase * shift) for mask in band.masks]
        sensor = ZernikeSensor(band.pupil, *masks, extent=band.extent)
        total = total + weight / light * sensor.measure(ratio * phases, amplitude)
    return total


def test_frames_are_the_sum_over_the_wavelengths(band, phases):
    np.testing.assert_allclose(band.measure(phases), explicit(band, phases), atol=1e-9)
    amplitude = band.pupil.inside * (1 + 0.2 * band.pupil.x)
    np.testing.assert_allclose(band.measure(phases, amplitude), explicit(band, phases, amplitude), atol=1e-9)
    larger = ZernikeSensor(band.pupil, *band.masks, extent=1.5)
    wide = PolychromaticSensor(larger, WAVELENGTHS, WEIGHTS, reference_wavelength=REFERENCE)
    np.testing.assert_allclose(wide.measure(phases), explicit(wide, phases), atol=1e-9)


def test_five_wavelengths_are_enough_for_a_quarter_of_the_centre(sensor, phases):
    few, many = (PolychromaticSensor.flat_band(sensor, 0.25, n).measure(phases) for n in (5, 20))
    np.testing.assert_allclose(few, many, atol=1e-6)


def test_a_patch_keeps_its_size_in_the_focal_plane(sensor, phases):
    def shift(u, v):
        return np.where(np.hypot(u, v) < 0.5, 1j, np.exp(0.3j))

    patch = ZernikeSensor(sensor.pupil, Patch(1.06, shift, breaks=[1.0]))
    total = 0
    for wavelength in (0.9, 1.1):
        scaled = Patch(
            1.06 / wavelength, lambda u, v, w=wavelength: shift(u * w, v * w), breaks=[1.0 / wavelength]
        )
        total = total + ZernikeSensor(sensor.pupil, scaled).measure(phases / wavelength) / 2
    band = PolychromaticSensor(patch, [0.9, 1.1])
    np.testing.assert_allclose(band.measure(phases), total, atol=1e-9)


@pytest.fixture(params=["one wavelength", "band"])
def any_sensor(sensor, band, request):
    return sensor if request.param == "one wavelength" else band


def test_jacobian_is_the_derivative_of_the_frames(any_sensor, phases):
    change, step = np.random.default_rng(1).standard_normal(phases.shape), 1e-5
    plus, minus = (any_sensor.measure(phases + sign * step * change) for sign in (1, -1))
    expected = (plus - minus) / (2 * step)
    np.testing.assert_allclose(any_sensor.jacobian(phases, change), expected, atol=1e-8)


def test_adjoint_of_the_jacobian_has_the_same_products(any_sensor, phases):
    rng = np.random.default_rng(2)
    change = rng.standard_normal(phases.shape) * any_sensor.pupil.inside
    frames = rng.standard_normal((len(phases), any_sensor.n_masks, *any_sensor.detector_shape))
    forward = np.vdot(any_sensor.jacobian(phases, change), frames)
    backward = np.vdot(change, any_sensor.jacobian_adjoint(phases, frames))
    assert forward == pytest.approx(backward, rel=1e-12)


def test_the_bound_is_that_of_the_dense_information(band, phases):
    pupil = Pupil.circular(10)
    small = PolychromaticSensor(
        ZernikeSensor(pupil, *band.masks, extent=1.4), band.wavelengths, band.weights, chromatic=band.chromatic
    )
    rng = np.random.default_rng(3)
    phase, n = pupil.scatter(0.5 * rng.standard_normal(pupil.n_points), fill=0), pupil.n_points
    units = pupil.scatter(np.eye(n), fill=0)
    rows = small.jacobian(np.broadcast_to(phase, units.shape), units).reshape(n, -1)
    weights = 100.0**2 / (100.0 * small.measure(phase).ravel() + 4.0)
    information = (rows * weights) @ rows.T
    piston = np.ones((n, n)) / n
    covariance = np.linalg.inv(information + piston) - piston
    bound = pupil.gather(cramer_rao(small, phase, photons=100.0, read_noise=2.0))
    np.testing.assert_allclose(bound, np.sqrt(np.diag(covariance)), rtol=1e-6)


def test_methods_that_know_the_band_find_the_phase_and_those_that_ignore_it_do_not(band, modes, phases):
    frames = band.measure(phases)

    def error(method):
        return reconstruction_error(band.pupil, method(frames).phase, phases).max()

    assert error(MaximumLikelihood(band)) < 1e-6
    assert error(MaximumLikelihood(band, modes)) < 1e-6
    assert error(GradientDescent(band, modes, n_iterations=60)) < 1e-4
    ignorant = PhaseShifted(band.reference), MaximumLikelihood(band.reference, n_starts=1)
    assert min(map(error, ignorant)) > 1e-4
    small = 0.01 * phases
    wrong, right = (
        reconstruction_error(band.pupil, Linear(sensor, modes)(band.measure(small)).phase, small).max()
        for sensor in (band.reference, band)
    )
    assert right < wrong / 3


def test_likelihood_follows_a_phase_beyond_pi(sensor, modes):
    band = PolychromaticSensor.flat_band(sensor, 0.25)
    phases = power_law_screens(modes, 1.6, 4, exponent=-3, seed=1)
    assert np.abs(band.pupil.gather(phases)).max() > np.pi + 0.5
    result = MaximumLikelihood(band)(band.measure(phases))
    difference = band.pupil.gather(result.phase - phases)
    difference -= difference.mean(axis=-1, keepdims=True)
    assert np.abs(difference).max() < 1e-5  # without wrapping
    assert result.consistent.all()
    assert result.residual.max() < 1e-6


def test_likelihood_turns_single_points_that_start_a_wave_off(sensor, phases):
    band = PolychromaticSensor.flat_band(sensor, 0.25)
    start, phase = phases[0].copy(), phases[0]
    start[12, 8:11] += 2 * np.pi
    start[6, 14] -= 2 * np.pi
    difference = band.pupil.gather(MaximumLikelihood(band, n_starts=1)(band.measure(phase), start).phase - phase)
    assert np.ptp(difference) < 1e-5


def test_a_band_survives_a_pickle(band, phases):
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(band)).measure(phases), band.measure(phases))
