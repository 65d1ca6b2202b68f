"""The accelerated phase-shifted iteration: the same answers, sooner."""

import numpy as np
import pytest

import zwfs
from zwfs import Dimple, PhaseShifted, Pupil, ZernikeSensor, reconstruction_error

from .conftest import pair


@pytest.mark.parametrize("rms", [0.1, 0.5, 0.8])
@pytest.mark.parametrize(
    "masks",
    [
        *([Dimple(diameter, np.pi / 2), Dimple(diameter, -np.pi / 2)] for diameter in (0.5, 1.06, 1.5, 2.0)),
        [Dimple(1.06, 0.3), Dimple(1.06, -2.0)],
        [Dimple(1.06, 1.5), Dimple(1.06, -1.5), Dimple(1.06, 2.5)],
        [Dimple(1.06, np.pi / 2), Dimple(1.8, -np.pi / 2, 0.8)],  # no shared wave
    ],
)
def test_same_fixed_point(pupil, screens, masks, rms):
    sensor, phase = ZernikeSensor(pupil, *masks), screens(rms, 5)
    plain, faster = (
        PhaseShifted(sensor, n_iterations=200, tolerance=1e-9, accelerate=accelerate)(sensor.measure(phase))
        for accelerate in (False, True)
    )
    assert reconstruction_error(pupil, faster.phase, phase).max() < 1e-7
    # A small dimple leaves nothing to gain, and the relaxation then costs an iteration.
    small = masks[0].diameter < 1
    assert np.all(faster.n_iterations < plain.n_iterations + 2 * small)


@pytest.mark.parametrize("diameter", [0.6, 1.06, 1.4])
def test_relaxation_leaves_nothing_of_a_small_tilt(pupil, diameter):
    sensor, tilt = pair(pupil, diameter), np.where(pupil.inside, 1e-2 * pupil.x, 0)
    shares = {}
    for accelerate in (False, True):
        result = PhaseShifted(sensor, n_iterations=2, tolerance=0, accelerate=accelerate)(sensor.measure(tilt))
        shares[accelerate] = reconstruction_error(pupil, result.phase, tilt) / pupil.rms(tilt)
    assert shares[True] < 0.15 * shares[False]


def test_relaxation_does_not_depend_on_the_origin():
    # The axis of the sensor may lie beside the middle of the pupil; piston is then in x, and in no frame.
    y, x = np.mgrid[:32, :32] - 15.5
    image = (np.hypot(x, y) < 14).astype(float)
    pupils = [Pupil.from_amplitude(image, n_pixels=28, center=(15.5, 15.5 + shift)) for shift in (0, 1, 9)]
    frames = pair(pupils[0]).measure(0.5 * np.sin(9 * x / 28))
    options = {"n_iterations": 3, "tolerance": 0, "accelerate": True}
    phases = [PhaseShifted(pair(pupil), **options)(frames).phase for pupil in pupils]
    np.testing.assert_allclose(phases, np.broadcast_to(phases[0], (3, *y.shape)), atol=1e-9)


@pytest.mark.parametrize("photons", [100, 1000, 1e4])
def test_no_noisy_frame_is_worse_for_the_acceleration(photons):
    pupil = zwfs.Pupil.circular(24)
    modes = zwfs.zernike_basis(pupil, 60)
    sensor, rng = pair(pupil), np.random.default_rng(3)
    phase = np.concatenate([zwfs.power_law_screens(modes, rms, 100, seed=rng) for rms in (0.1, 0.3, 0.5, 0.8)])
    frames = rng.poisson(photons * sensor.measure(phase)) / photons
    plain, faster = (PhaseShifted(sensor, n_iterations=50, accelerate=a)(frames) for a in (False, True))
    assert plain.converged.mean() > 0.99
    assert faster.converged.mean() > 0.99
    assert faster.n_iterations.mean() < 0.8 * plain.n_iterations.mean()
    ratio = reconstruction_error(pupil, faster.phase, phase) / reconstruction_error(pupil, plain.phase, phase)
    assert ratio.max() < 1.1


@pytest.fixture(scope="module")
def mismatched():
    """Frames of a large dimple, the first 20 % too bright: a part of them never converges."""
    pupil = zwfs.Pupil.circular(24)
    modes = zwfs.zernike_basis(pupil, 60)
    sensor, rng = pair(pupil, 2.0), np.random.default_rng(5)
    phase = zwfs.power_law_screens(modes, 1.0, 60, seed=rng)
    return sensor, phase, rng.poisson(1e3 * sensor.measure(phase) * [[[1.2]], [[1.0]]]) / 1e3


def test_frames_that_do_not_converge_are_explained_as_well_as_without_acceleration(mismatched):
    sensor, phase, frames = mismatched
    plain, faster = (PhaseShifted(sensor, n_iterations=50, accelerate=a)(frames) for a in (False, True))
    lost = ~faster.converged
    assert lost.sum() > 3
    assert (faster.residual[lost] <= plain.residual[lost] * (1 + 1e-9)).all()
    errors = [reconstruction_error(sensor.pupil, result.phase, phase) for result in (plain, faster)]
    usable = errors[0] < 0.3
    assert (errors[1][usable] < 1.1 * errors[0][usable]).all()


def test_frames_that_do_not_converge_do_not_depend_on_their_batch(mismatched):
    sensor, phase, frames = mismatched
    frames, start = frames[:12].reshape(3, 4, *frames.shape[1:]), 0.5 * phase[:12].reshape(3, 4, *phase.shape[1:])
    method = PhaseShifted(sensor, n_iterations=20, accelerate=True)
    whole = method(frames, start, history=True)
    assert not whole.converged.all()
    np.testing.assert_array_equal(whole.history[:, :, -1], whole.phase)
    for index in np.ndindex(3, 4):
        single = method(frames[index], start[index])
        np.testing.assert_allclose(single.phase, whole.phase[index], atol=1e-9)
        assert single.n_iterations == whole.n_iterations[index]


@pytest.mark.parametrize("flux", [0.01, 0.5, 2.0, 9.0])
def test_a_wrong_flux_leaves_numbers(shifted, screens, pupil, flux):
    method = PhaseShifted(shifted, accelerate=True, tolerance=0)
    assert np.all(np.isfinite(method(flux * shifted.measure(screens(0.5))).phase[:, pupil.inside]))


@pytest.mark.parametrize("phases", [(1.5, -1.5), (0.3, -2.0), (1.5, -1.5, 2.5), (0.0, 1.0, -0.4)])
def test_shared_wave_solves_the_general_system(pupil, screens, phases):
    def masks(change):
        return [Dimple(1.3 + change * k, phase, 0.9) for k, phase in enumerate(phases)]

    same, nearly = (ZernikeSensor(pupil, *masks(change)) for change in (0, 1e-9))  # only the first share a wave
    rng = np.random.default_rng(1)
    frames = same.measure(screens(0.3, 2)) * rng.uniform(0.8, 1.2, (2, len(phases), *pupil.shape))
    special, general = (PhaseShifted(s, n_iterations=2, tolerance=0)(frames).phase for s in (same, nearly))
    assert reconstruction_error(pupil, special, general).max() < 1e-6
