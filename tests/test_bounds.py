"""Fisher information and Cramer-Rao bound, compared with dense matrices."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from zwfs import Dimple, Patch, Pupil, ZernikeSensor, cramer_rao, zernike_basis

from .test_properties import seeds, sensors


def jacobian(sensor, phase, amplitude=None, *, of_amplitude=False):
    """Derivative of the frames with respect to every point, (n_points, n_pixels), by propagating each of them."""
    pupil = sensor.pupil
    field = np.exp(1j * phase) * (pupil.amplitude if amplitude is None else amplitude)
    change = np.exp(1j * phase) if of_amplitude else 1j * field
    field = np.where(pupil.inside, field, 0)
    waves = sensor.propagate(field)
    changes = sensor.propagate(pupil.scatter(np.diag(pupil.gather(change)), fill=0))
    return 2 * np.real(np.conj(waves) * changes).reshape(pupil.n_points, -1)


def dense_bound(sensor, phase, photons, read_noise=0.0, modes=None, amplitude=None, amplitude_known=True):
    """Square roots of the diagonal of the pseudo-inverse of the information."""
    frames = sensor.measure(phase, amplitude)
    weights = photons**2 / (photons * frames.ravel() + read_noise**2 + 1e-12)
    parts = [jacobian(sensor, phase, amplitude)]
    if not amplitude_known:
        parts.append(jacobian(sensor, phase, amplitude, of_amplitude=True))
    derivative = np.concatenate(parts)
    if modes is not None:
        derivative = sensor.pupil.gather(modes) @ derivative
    information = (derivative * weights) @ derivative.T
    n = len(parts[0])
    if modes is None:  # the piston
        gauge = np.zeros(len(information))
        gauge[:n] = 1
        scale = information[:n, :n].trace() / n
        inverse = np.linalg.pinv(information + scale / n * np.outer(gauge, gauge))
        return np.sqrt(np.diag(inverse)[:n] - 1 / (scale * n)), np.linalg.cond(
            information + scale / n * np.outer(gauge, gauge)
        )
    return np.sqrt(np.diag(np.linalg.pinv(information))), np.linalg.cond(information)


@given(sensors(), seeds, st.floats(0, 1.5), st.floats(1, 1e5), st.sampled_from([0.0, 0.5, 20.0]))
@settings(max_examples=4)  # a dense matrix takes long
def test_bound_is_that_of_a_dense_matrix(sensor, seed, rms, photons, read_noise):
    phase = rms * np.random.default_rng(seed).normal(size=sensor.pupil.shape)
    expected, condition = dense_bound(sensor, phase, photons, read_noise)
    assume(condition < 1e5)  # else rounding decides
    bound = sensor.pupil.gather(cramer_rao(sensor, phase, photons=photons, read_noise=read_noise))
    np.testing.assert_allclose(bound, expected, rtol=1e-8 + 1e-9 * condition)


@pytest.fixture
def small():
    return Pupil.circular(20)


THREE = Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), Dimple(1, 0)
MIXED = Dimple(1.06, np.pi / 2), Dimple(2.2, -1.0), Patch(2.0, lambda u, v: np.exp(1j * (1 + u) - u**2 - v**2))


@pytest.mark.parametrize("masks", [THREE, MIXED])
@pytest.mark.parametrize("extent", [1.0, 1.5])
def test_bound_with_an_unknown_amplitude_is_that_of_a_dense_matrix(small, masks, extent):
    sensor = ZernikeSensor(small, *masks, extent=extent)
    rng = np.random.default_rng(1)
    phase, amplitude = rng.normal(0, 0.5, small.shape), rng.uniform(0.5, 1.5, small.shape)
    options = {"photons": 100.0, "read_noise": 1.0, "amplitude": amplitude}
    expected, _ = dense_bound(sensor, phase, amplitude_known=False, **options)
    bound = cramer_rao(sensor, phase, **options)
    unknown = cramer_rao(sensor, phase, amplitude_known=False, **options)
    np.testing.assert_allclose(small.gather(unknown), expected, rtol=1e-8)
    assert np.all(small.gather(unknown) > small.gather(bound))  # more unknowns, less information


@pytest.mark.parametrize("masks", [THREE[:1], THREE[:2], MIXED])
def test_bound_of_modes_is_that_of_a_dense_matrix(small, masks):
    sensor, modes = ZernikeSensor(small, *masks, extent=1.2), zernike_basis(small, 30)
    phase = np.random.default_rng(2).normal(0, 0.4, small.shape)
    expected, _ = dense_bound(sensor, phase, 50.0, modes=modes)
    np.testing.assert_allclose(cramer_rao(sensor, phase, photons=50.0, modes=modes), expected, rtol=1e-8)


def test_bound_does_not_depend_on_the_piston_or_the_batch(small):
    sensor, rng = ZernikeSensor(small, *THREE[:2]), np.random.default_rng(4)
    phases = rng.normal(0, 0.4, (2, 3, *small.shape))
    together = cramer_rao(sensor, phases, photons=10.0)
    assert together.shape == phases.shape
    assert np.array_equal(np.isnan(together[0, 0]), ~small.inside)
    for where in np.ndindex(2, 3):
        alone = cramer_rao(sensor, phases[where] + 1.3, photons=10.0)
        np.testing.assert_allclose(together[where], alone, rtol=1e-9)
    modes = zernike_basis(small, 5)
    assert cramer_rao(sensor, phases, photons=10.0, modes=modes).shape == (2, 3, 5)
