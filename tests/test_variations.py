import numpy as np
import pytest
from scipy.special import j1, jn_zeros

import zwfs
from studies.fig04_dimple_diameter import measured_factor
from studies.kit.curves import crossing
from studies.kit.iteration import DARK_RING, DimpleLight, iteration_spectrum, mode_sensitivity
from studies.phase_shift_pairs import pair_maps, phase_noise

HALF = np.pi / 2


@pytest.fixture(scope="module")
def small():
    return zwfs.Pupil.circular(16)


def pair(pupil, diameter, a=HALF, b=-HALF):
    return zwfs.ZernikeSensor(pupil, zwfs.Dimple(diameter, a), zwfs.Dimple(diameter, b), tolerance=1e-13)


def test_the_iteration_is_the_same_for_every_pair(pupil, screens):
    phase = screens(0.8, 2)
    wanted = None
    for a, b in [(HALF, -HALF), (0.4, 0.9), (np.pi, 1.0), (-0.2, 3.0)]:
        sensor = pair(pupil, 1.3, a, b)
        method = zwfs.PhaseShifted(sensor, n_iterations=4, tolerance=0.0)
        history = pupil.gather(np.exp(1j * method(sensor.measure(phase), history=True).history))
        wanted = history if wanted is None else wanted
        np.testing.assert_allclose(history, wanted, atol=1e-10)


def derivative_of_a_step(pupil, diameter, phase, errors):
    """Errors after one step, (k, n_points), over small errors before it."""
    sensor, h = pair(pupil, diameter, 1.9, -1.0), 1e-4
    method = zwfs.PhaseShifted(sensor, n_iterations=1)
    frames = np.broadcast_to(sensor.measure(phase), (len(errors), *sensor.measure(phase).shape))
    plus, minus = (method(frames, start=phase + s * h * errors).phase for s in (1, -1))
    return pupil.gather(np.angle(np.exp(1j * (plus - minus)))) / (2 * h)


@pytest.mark.parametrize("diameter", [1.06, 2.2, 2.8])
def test_spectrum_tells_the_rate(pupil, screens, diameter):
    phase = screens(0.5, 1)[0]
    away = 1e-4 * screens(1.0, 1, seed=9)[0]
    factor = np.abs(iteration_spectrum(pupil, diameter, phase)[0])
    assert measured_factor(pupil, diameter, phase, away) == pytest.approx(factor, rel=0.001)


def test_tilt_is_lost_where_the_dimple_ends_on_the_dark_ring():
    assert pytest.approx(2 * jn_zeros(1, 1)[0] / np.pi) == DARK_RING
    assert abs(j1(np.pi * DARK_RING / 2)) < 1e-12
    shares = []
    for n_pixels in (40, 160):
        pupil = zwfs.Pupil.circular(n_pixels)
        tilt = zwfs.zernike_basis(pupil, 1)
        shares.append(mode_sensitivity(pupil, DARK_RING, tilt)[0] / mode_sensitivity(pupil, 1.06, tilt)[0])
        step = derivative_of_a_step(pupil, DARK_RING, np.zeros(pupil.shape), tilt)
        np.testing.assert_allclose(step, pupil.gather(tilt), atol=0.6 / n_pixels)
        assert iteration_spectrum(pupil, DARK_RING)[0] == pytest.approx(1, abs=0.2 / n_pixels)
    # What is left is the staircase of the pupil's edge.
    assert shares[1] < shares[0] < 0.02
    assert shares[1] < 0.004


@pytest.mark.parametrize("rms", [0.0, 0.5])
def test_sensitivity_is_the_derivative_of_the_frames(pupil, modes, screens, rms):
    phase, h = screens(rms, 1)[0], 1e-5
    shifts = (HALF, -1.2)
    sensor = pair(pupil, 1.5, *shifts)
    slope = (sensor.measure(phase + h * modes[:4]) - sensor.measure(phase - h * modes[:4])) / (2 * h)
    expected = np.sqrt(np.mean(pupil.gather(slope) ** 2, axis=-1).sum(axis=-1))
    np.testing.assert_allclose(mode_sensitivity(pupil, 1.5, modes[:4], shifts, phase), expected, rtol=1e-6)


def test_noise_of_the_symmetric_pair_on_a_flat_wavefront(pupil):
    flat = np.zeros(pupil.shape)
    b = DimpleLight(pupil, 1.06)(np.ones((1, pupil.n_points)))[0].real
    for theta in (HALF, 2.3):
        noise = phase_noise(pair(pupil, 1.06, theta, -theta), flat)
        intensity = 1 - 2 * b * (1 - b) * (1 - np.cos(theta))
        expected = np.sqrt(intensity / 2) / (2 * b * np.sin(theta))
        np.testing.assert_allclose(noise.photon, expected, rtol=1e-8)
        np.testing.assert_allclose(noise.bound, expected, rtol=1e-8)
        np.testing.assert_allclose(noise.read, 1 / (np.sqrt(8) * b * np.sin(theta)), rtol=1e-8)


def test_no_estimate_is_better_than_the_bound(pupil, screens):
    for a, b in [(HALF, -HALF), (2.5, 0.7), (-1.0, 3.0)]:
        noise = phase_noise(pair(pupil, 1.06, a, b), screens(0.6, 1)[0])
        assert np.all(noise.bound <= noise.photon * (1 + 1e-9))


@pytest.mark.parametrize("shifts", [(HALF, -HALF), (2.3, -2.3), (HALF, -1.0)])
def test_noise_is_that_of_noisy_frames(pupil, screens, shifts):
    phase, photons, n_draws = screens(0.4, 1)[0], 1e6, 12
    sensor, camera = pair(pupil, 1.06, *shifts), zwfs.Detector(photons)
    frames = np.repeat(sensor.measure(phase)[np.newaxis], n_draws, axis=0)
    estimate = zwfs.PhaseShifted(sensor)(camera.normalise(camera.expose(frames, 1)))
    power = photons * zwfs.reconstruction_error(pupil, estimate.phase, phase) ** 2
    noise = np.sqrt(power.mean())
    error = power.std(ddof=1) / np.sqrt(n_draws) / (2 * noise)
    expected = np.sqrt(np.mean(phase_noise(sensor, phase).photon ** 2))
    # The reference waves, held fixed in the expectation, take part in the noise of a few modes.
    assert noise == pytest.approx(expected, abs=3 * error + 0.01 * expected)
    assert error < 0.01 * noise


def test_a_mask_without_a_phase_shift_makes_the_noise_infinite(pupil):
    noise = phase_noise(pair(pupil, 1.0, 0.0, 1.0), np.zeros(pupil.shape))
    assert np.isinf(noise.photon).all()


def test_pair_maps(small):
    screens = zwfs.power_law_screens(zwfs.zernike_basis(small, 20), 0.5, 2, seed=1)
    angles = np.linspace(-np.pi, np.pi, 9)
    maps = pair_maps(small, 1.06, angles, screens)
    np.testing.assert_array_equal(maps.singular, maps.forbidden)
    # The diagonal, both lines of 0 (once on the diagonal), and the two corners.
    assert maps.singular.sum() == 9 + 16 + 2
    for name in ("error", "flat", "aberrated", "bound", "read"):
        values = getattr(maps, name)
        np.testing.assert_array_equal(values, values.T)
    assert np.nanmax(maps.error) == pytest.approx(np.nanmin(maps.error), rel=1e-6)
    assert np.nanmax(maps.error) < 1e-6
    # Read noise: +-pi/2 is best on a flat wavefront; photon noise: a larger shift is.
    assert maps.best("read")[:2] == pytest.approx((HALF, -HALF))
    assert maps.best("flat")[:2] == pytest.approx((0.75 * np.pi, -0.75 * np.pi))


def test_crossing_is_interpolated_on_the_logarithm():
    assert crossing([1, 2, 3], [1e-4, 1e-2, 1e-4], 1e-3) == pytest.approx(1.5)
    assert crossing([1, 2], [1.0, 2.0], 0.5) == 1
    assert crossing([1, 2], [1.0, 2.0], 5) == np.inf
