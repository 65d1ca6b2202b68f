"""Claims that hold for any pupil, mask, batch and precision."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from zwfs import (
    Dimple,
    GerchbergSaxton,
    GradientDescent,
    Patch,
    PhaseShifted,
    Pupil,
    ZernikeSensor,
    power_law_screens,
    reconstruction_error,
    zernike_basis,
)

seeds = st.integers(0, 2**16)
batches = st.lists(st.integers(1, 3), max_size=2).map(tuple)
dimples = st.builds(Dimple, st.floats(0.3, 4), st.floats(-3, 3), st.floats(0, 1))
# A transmission without any symmetry.
patches = st.builds(Patch, st.floats(0.3, 3), st.just(lambda u, v: (0.8 + 0.1 * u) * np.exp(1j * (u - v + u * v))))
extents = st.sampled_from([1.0, 1.3, 2.0])


@st.composite
def pupils(draw):
    """Discs with an obscuration, or images of an uneven amplitude."""
    pupil = Pupil.circular(draw(st.integers(16, 24)), draw(st.sampled_from([0.0, 0.3])))
    if draw(st.booleans()):
        return pupil
    rng = np.random.default_rng(draw(seeds))
    image = rng.uniform(0.5, 1.5, pupil.shape) * pupil.inside
    right, below = draw(st.integers(0, 4)), draw(st.integers(0, 4))
    return Pupil.from_amplitude(np.pad(image, ((0, below), (0, right))), pupil.n_pixels, pupil.center)


@st.composite
def sensors(draw):
    masks = draw(st.lists(dimples | patches, min_size=1, max_size=3))
    return ZernikeSensor(draw(pupils()), *masks, extent=draw(extents))


@st.composite
def useful_pairs(draw):
    """Two dimples of a size whose determinant is far from 0."""
    a, b = draw(st.floats(-6, 6)), draw(st.floats(-6, 6))
    assume(abs(np.sin(a / 2) * np.sin(b / 2) * np.sin((b - a) / 2)) > 0.1)
    diameter = draw(st.floats(0.6, 1.2))
    return [Dimple(diameter, a), Dimple(diameter, b)]


def white(shape, seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def smooth(pupil, rms, batch, seed):
    n_screens = int(np.prod(batch))
    screens = power_law_screens(zernike_basis(pupil, 12), rms, n_screens, seed=seed)
    return screens.reshape(*batch, *pupil.shape)


@given(sensors(), batches, seeds)
def test_adjoint(sensor, batch, seed):
    field = white((*batch, *sensor.pupil.shape), seed)
    wave = white((*batch, sensor.n_masks, *sensor.detector_shape), seed + 1)
    difference = np.vdot(wave, sensor.propagate(field)) - np.vdot(sensor.adjoint(wave), field)
    assert abs(difference) < 1e-13 * np.linalg.norm(wave) * np.linalg.norm(field)
    assert not sensor.adjoint(wave)[..., ~sensor.pupil.inside].any()


@given(sensors(), batches, seeds)
def test_a_passive_mask_never_adds_light(sensor, batch, seed):
    field = white((*batch, *sensor.pupil.shape), seed) * sensor.pupil.inside
    flux = np.sum(np.abs(sensor.propagate(field)) ** 2, axis=(-2, -1))
    incoming = np.sum(np.abs(field) ** 2, axis=(-2, -1))
    assert np.all(flux <= incoming[..., np.newaxis] * (1 + 1e-12))


@given(sensors(), seeds)
def test_gradient(sensor, seed):
    pupil = sensor.pupil
    truth, guess, direction = smooth(pupil, 0.5, (3,), seed)
    amplitude = np.random.default_rng(seed).uniform(0.5, 1.5, pupil.shape)
    cost = GradientDescent(sensor, amplitude=amplitude).cost
    frames = sensor.measure(truth)[np.newaxis]
    step = 1e-3
    a, b, c, d = (cost(pupil.gather(guess + k * step * direction), frames)[0] for k in (-2, -1, 1, 2))
    slope = pupil.gather(direction) @ cost(pupil.gather(guess), frames)[1]
    np.testing.assert_allclose((a - 8 * b + 8 * c - d) / (12 * step), slope, rtol=1e-6, atol=1e-10)


@given(pupils(), useful_pairs(), batches, seeds)
def test_phase_shifted_inverts_small_phases(pupil, masks, batch, seed):
    sensor = ZernikeSensor(pupil, *masks)
    phase = smooth(pupil, 0.01, batch, seed)
    result = PhaseShifted(sensor, n_iterations=50, tolerance=1e-9)(sensor.measure(phase))
    assert result.phase.shape == phase.shape
    assert np.all(reconstruction_error(pupil, result.phase, phase) < 1e-6)


@given(sensors(), seeds, st.floats(0.1, 3))
def test_gerchberg_saxton_with_the_modelled_field_never_moves_away_from_the_frames(sensor, seed, rms):
    amplitude = np.sqrt(sensor.measure(smooth(sensor.pupil, rms, (), seed)))
    method = GerchbergSaxton(sensor, n_iterations=8, tolerance=0, unmeasured="model")
    history = method(amplitude**2, history=True).history
    mismatch = np.sum((amplitude - np.sqrt(sensor.measure(history))) ** 2, axis=(-3, -2, -1))
    assert np.all(np.diff(mismatch) <= 1e-9 * mismatch[0])
