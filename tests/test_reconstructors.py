import inspect
import pickle
import pkgutil
import tracemalloc
import warnings
from importlib import import_module

import numpy as np
import pytest

import zwfs
from zwfs import (
    RECONSTRUCTORS,
    Arcsine,
    Dimple,
    GerchbergSaxton,
    GradientDescent,
    LearnedReference,
    Linear,
    MaximumLikelihood,
    PhaseShifted,
    ZernikeSensor,
    reconstruction_error,
)
from zwfs.reconstructors.base import ClosedForm, FixedPoint, Reconstructor
from zwfs.turbulence import turbulent_screens

every = pytest.mark.parametrize("method", RECONSTRUCTORS)
iterative = pytest.mark.parametrize("method", [method for method in RECONSTRUCTORS if method.iterative])
in_one_step = pytest.mark.parametrize("method", [method for method in RECONSTRUCTORS if not method.iterative])
fixed_point = pytest.mark.parametrize(
    "method", [method for method in RECONSTRUCTORS if issubclass(method, FixedPoint)]
)


def takes(method, name):
    return name in inspect.signature(method).parameters


def build(method, sensor, modes, **options):
    return method(sensor, modes, **options) if takes(method, "modes") else method(sensor, **options)


def steps(method, **options):
    """Return options of an iteration, and none for a method without one."""
    return options if method.iterative else {}


def once(method):
    """Option of a method that would try several starts."""
    return {"n_starts": 1} if takes(method, "n_starts") else {}


@pytest.fixture
def sensor_of(classic, shifted):
    """Sensor for a method: two masks if it accepts them, else one."""
    return lambda method: shifted if method.n_masks[0] <= 2 <= method.n_masks[1] else classic


@pytest.fixture
def make(sensor_of, modes):
    """Reconstructor of a method on its sensor, and that sensor."""

    def make(method, **options):
        sensor = sensor_of(method)
        return build(method, sensor, modes, **options), sensor

    return make


def errors(reconstruct, sensor, phase):
    return reconstruction_error(sensor.pupil, reconstruct(sensor.measure(phase)).phase, phase)


# What each method can do.


@pytest.mark.parametrize(
    ("method", "n_masks", "extent", "bound"),
    [
        (Linear, 1, 1, 1e-2),
        (Linear, 2, 1, 1e-2),
        (Arcsine, 1, 1, 1e-6),
        (PhaseShifted, 2, 1, 1e-6),
        (PhaseShifted, 3, 1, 1e-6),
        (GerchbergSaxton, 2, 8, 0.1),
        (GradientDescent, 1, 1, 1e-2),
        (GradientDescent, 2, 1, 1e-2),
    ],
)
def test_small_phases_come_back(pupil, modes, screens, method, n_masks, extent, bound):
    dimples = [Dimple(1.06, phase) for phase in (np.pi / 2, -np.pi / 2, 2.0)[:n_masks]]
    sensor = ZernikeSensor(pupil, *dimples, extent=extent)
    reconstruct = build(method, sensor, modes, **steps(method, n_iterations=50, tolerance=1e-10))
    assert errors(reconstruct, sensor, screens(0.01)).max() < bound * 0.01


@every
def test_most_of_a_small_phase_comes_back(sensor_of, pupil, modes, screens, method):
    sensor = ZernikeSensor(pupil, *sensor_of(method).masks, extent=4)  # Gerchberg-Saxton needs a wide detector
    assert errors(build(method, sensor, modes), sensor, screens(0.01)).max() < 0.5 * 0.01


@pytest.mark.parametrize("phases", [(np.pi / 2, -np.pi / 2), (0.3, -2.0), (1.5, -1.5, 2.5)])
def test_truth_is_a_fixed_point_of_the_phase_shifted_over_the_whole_circle(pupil, screens, phases):
    sensor = ZernikeSensor(pupil, *(Dimple(1.06, phase) for phase in phases))
    phase = screens(1.5)
    assert np.abs(phase).max() > np.pi
    result = PhaseShifted(sensor, n_iterations=1, tolerance=1e-8)(sensor.measure(phase), start=phase)
    assert reconstruction_error(pupil, result.phase, phase).max() < 1e-10
    assert result.converged.all()


def test_more_than_two_masks_are_combined_by_least_squares(pupil, screens):
    sensor = ZernikeSensor(pupil, *(Dimple(d, phase) for d, phase in ((1.06, 1.5), (1.3, -1.5), (0.9, 2.5))))
    frames = sensor.measure(screens(0.3, 1)[0])
    frames *= np.random.default_rng(0).uniform(0.8, 1.2, frames.shape)  # no field explains all three
    phase = PhaseShifted(sensor, n_iterations=1)(frames).phase
    waves = sensor.reference_wave(pupil.amplitude)
    right = frames - np.abs(waves) ** 2 - pupil.amplitude**2
    for point in ((20, 20), (3, 18), (30, 9)):
        wave = waves[:, *point]
        real, imag = np.linalg.lstsq(2 * np.stack([wave.real, wave.imag], axis=1), right[:, *point])[0]
        assert phase[point] == pytest.approx(np.arctan2(imag, real), abs=1e-9)


def test_masks_whose_shared_wave_cannot_be_scaled_are_solved_one_by_one(pupil, screens):
    # With 1 + s exp(2 pi i k / 3) the weighted sum of |t - 1|^2 that scales the shared wave is 0. No passive mask
    # is like that, but others may be written.
    class Third:
        diameter, breaks, n_samples = 1.06, (), 0

        def __init__(self, k):
            self.value = 1 + 0.3 * np.exp(2j * np.pi * k / 3)

        def transmission(self, u, v):
            return np.full(np.shape(u), self.value)

    sensor = ZernikeSensor(pupil, *(Third(k) for k in range(3)))
    assert errors(PhaseShifted(sensor, n_iterations=60), sensor, screens(0.3)).max() < 1e-6


@every
def test_measured_amplitude_is_used(sensor_of, modes, method, screens, pupil):
    sensor = ZernikeSensor(pupil, *sensor_of(method).masks, extent=4)  # Gerchberg-Saxton needs a wide detector
    amplitude = np.random.default_rng(0).uniform(0.7, 1.3, pupil.shape)
    frames = sensor.measure(screens(0.01), amplitude)
    right, wrong = (
        build(method, sensor, modes, **once(method), **option) for option in ({"amplitude": amplitude}, {})
    )
    assert np.all(right(frames).residual < 0.1 * wrong(frames).residual)


@pytest.mark.parametrize("height", [-0.7, 2.2])
def test_arcsine_covers_its_branch(classic, pupil, height):
    # From -pi/4 to 3 pi/4 about the phase of the reference wave, which a narrow peak hardly moves.
    phase = height * np.exp(-0.5 * (pupil.x**2 + pupil.y[:, np.newaxis] ** 2) / 0.05**2)
    assert errors(Arcsine(classic), classic, phase) < 1e-5


def test_arcsine_folds_what_lies_beyond_minus_pi_over_4(classic, pupil):
    phase = np.zeros(pupil.shape)
    phase[20, 20] = -1.1
    frames = classic.measure(phase)
    assert Arcsine(classic)(frames).phase[20, 20] == pytest.approx(-np.pi / 2 + 1.1, abs=0.02)
    # A start on the right side leads to the phase.
    assert Arcsine(classic)(frames, start=phase).phase[20, 20] == pytest.approx(-1.1, abs=1e-5)


def test_the_arcsine_does_not_change_its_side_as_the_piston_drifts(classic, screens):
    # Folded phases let the piston of the estimate drift, past the phase of the reference wave in the end.
    phase = screens(1.0, 6)
    result = Arcsine(classic, tolerance=0.0, n_iterations=40)(classic.measure(phase), history=True)
    drift = np.angle(np.mean(np.exp(1j * classic.pupil.gather(result.history)), axis=-1))
    assert np.abs(drift).max() > 2
    errors = reconstruction_error(classic.pupil, result.history, phase[:, np.newaxis])
    assert np.all(errors[:, 3:].max(axis=1) < 1.3 * np.median(errors[:, 3:], axis=1))


@pytest.mark.parametrize("mask", [Dimple(1.06, np.pi), Dimple(1.06, -np.pi), Dimple(1.06, 0, 0.5)])
def test_arcsine_takes_a_start_in_line_with_its_wave_as_ahead_of_it(pupil, mask):
    # The wave of these masks has the phase pi, so phases of 0 are in line with it, and those ahead are negative.
    sensor = ZernikeSensor(pupil, mask)
    peak = -0.4 * np.exp(-0.5 * (pupil.x**2 + pupil.y[:, np.newaxis] ** 2) / 0.05**2)
    for start in (None, np.zeros(pupil.shape)):
        phase = Arcsine(sensor, n_iterations=1)(sensor.measure(peak), start).phase[pupil.inside]
        assert np.all((phase <= 1e-6) | (phase > np.pi - 1e-6))
        assert phase.min() < -0.35


def test_arcsine_leaves_dark_points_as_they_were(classic, pupil, screens):
    amplitude = pupil.amplitude.copy()
    amplitude[20, 10:20] = 0
    result = Arcsine(classic, amplitude=amplitude, tolerance=0)(
        classic.measure(screens(0.1)[0], amplitude), start=np.full(pupil.shape, 0.1)
    )
    np.testing.assert_allclose(result.phase[20, 10:20], 0.1)
    assert result.n_unsolved == 10


def test_unsolved_points_are_those_of_each_frame(classic, pupil, screens):
    frames = classic.measure(screens(0.3, 3) * np.array([0, 1e-3, 1])[:, np.newaxis, np.newaxis])
    frames[0, 0, 20, 18:22] += 50
    frames[0, 0, 0, :3] += 50  # outside the pupil
    frames[2, 0, 20, 18:24] += 50
    result = Arcsine(classic, tolerance=1e-2)(frames)
    assert result.n_iterations.tolist() == [2, 1, 3]  # some leave early
    assert result.n_unsolved.tolist() == [Arcsine(classic, tolerance=1e-2)(frame).n_unsolved for frame in frames]
    assert result.n_unsolved[0] == 4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_weak_waves_of_different_size_are_solved(pupil, screens, dtype):
    sensor = ZernikeSensor(pupil, Dimple(0.01, np.pi / 2), Dimple(0.012, -np.pi / 2))
    frames, phase = sensor.measure(screens(0.4)), screens(0.4)
    result = PhaseShifted(sensor, n_iterations=10, tolerance=0)(frames.astype(dtype))
    assert np.all(result.n_unsolved == 0)
    assert reconstruction_error(pupil, result.phase, phase).max() < {np.float32: 1e-3, np.float64: 1e-10}[dtype]


@every
def test_a_result_belongs_to_the_caller(make, method, screens):
    reconstruct, sensor = make(method)
    frames = sensor.measure(screens(0.3, 2))
    result = reconstruct(frames, history=True)
    names = ("phase", "n_iterations", "converged", "n_unsolved", "history", "frames", "residual")
    expected = {name: getattr(result, name).copy() for name in names}
    for name in names:
        getattr(result, name)[...] = 0
    again = reconstruct(frames, history=True)
    frames[...] = 0  # as a camera does that writes the next frame to the same place
    for name in names:
        np.testing.assert_array_equal(getattr(again, name), expected[name])


def test_linear_is_exact_to_second_order_around_its_reference(pupil, modes, shifted, screens):
    reference = screens(0.5, 1)[0]
    reconstruct = Linear(shifted, modes, reference=reference, conditioning=1e-6, poke=1e-4)
    error = [
        errors(reconstruct, shifted, reference + small)
        for small in screens(1.0, seed=2) * np.array([[[[0.02]]], [[[0.01]]]])
    ]
    assert np.max(error) < 0.1 * 0.02
    np.testing.assert_allclose(error[0] / error[1], 4, rtol=0.2)


def test_conditioning_drops_what_the_sensor_does_not_see(pupil, modes, shifted, screens):
    with_piston = np.concatenate([modes, pupil.inside[np.newaxis]])
    assert Linear(shifted, modes).n_inverted == len(modes)
    assert Linear(shifted, with_piston).n_inverted == len(modes)
    few = Linear(shifted, modes, conditioning=0.9)
    assert 0 < few.n_inverted < len(modes)
    strength = np.linalg.svd(few.interaction_matrix, compute_uv=False)
    assert few.n_inverted == np.count_nonzero(strength > 0.9 * strength[0])
    with pytest.raises(ValueError, match="modes"):
        Linear(shifted, pupil.inside[np.newaxis].astype(float))


def core(u, v):
    """Gaussian that nearly vanishes at the edge of a patch of 3 lambda/D, as its transform does 2.5 D away."""
    return np.exp(-(u**2 + v**2) / (2 * 0.31**2))


SMOOTH = zwfs.Patch(3.0, lambda u, v: np.exp(1.5j * core(u, v) * (1 + 0.3 * u)))
DARK = zwfs.Patch(3.0, lambda u, v: np.sqrt(1 - 0.5 * core(u, v) ** 2) * np.exp(-1.2j * core(u, v)))


@pytest.mark.parametrize(
    "masks",
    [
        [Dimple(1.06, np.pi / 2)],
        [Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), Dimple(2.0, 1.0)],
        [Dimple(1.06, 1.0, amplitude=0.3), SMOOTH, DARK],
    ],
)
def test_true_phase_is_a_fixed_point_if_the_modelled_field_is_kept(pupil, screens, masks):
    sensor, phase = ZernikeSensor(pupil, *masks), screens(1.5)
    method = GerchbergSaxton(sensor, n_iterations=5, tolerance=0, unmeasured="model")
    estimate = method(sensor.measure(phase), start=phase).phase
    assert reconstruction_error(pupil, estimate, phase).max() < 1e-13


@pytest.mark.parametrize(("rms", "n_iterations", "bound"), [(0.1, 100, 1e-13), (0.4, 200, 1e-7)])
def test_kept_model_is_exact_on_a_detector_as_wide_as_the_pupil(pupil, shifted, screens, rms, n_iterations, bound):
    model, zero = (
        GerchbergSaxton(shifted, n_iterations=n_iterations, tolerance=0, unmeasured=unmeasured)
        for unmeasured in ("model", "zero")
    )
    assert errors(model, shifted, screens(rms)).max() < bound
    assert errors(zero, shifted, screens(rms)).min() > rms  # it diverges


def test_cost_is_half_the_mean_square_of_the_mismatch(pupil, shifted, screens):
    truth, guess = screens(0.4, 2)
    expected = np.mean((shifted.measure(truth) - shifted.measure(guess)) ** 2) / 2
    cost, _ = GradientDescent(shifted).cost(pupil.gather(guess), shifted.measure(truth)[np.newaxis])
    assert cost == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match=r"frames has a batch of \(2,\)"):
        GradientDescent(shifted).cost(pupil.gather(guess), shifted.measure([truth, guess]))


def test_descent_never_climbs(pupil, shifted, screens):
    frames = shifted.measure(screens(0.5, 1)[0])
    descent = GradientDescent(shifted, tolerance=0)
    path = descent(frames, history=True).history
    cost = [descent.cost(pupil.gather(phase), frames[np.newaxis])[0] for phase in path]
    assert np.all(np.diff(cost) < 0)
    assert cost[-1] < 1e-4 * cost[0]


def test_memory_of_a_call_does_not_grow_with_the_batch():
    sensor = ZernikeSensor(zwfs.Pupil.circular(100), Dimple(1.06, 1.5), Dimple(1.06, -1.5))
    method, tilt = PhaseShifted(sensor, n_iterations=5, tolerance=0), np.tile(2 * sensor.pupil.x, (100, 1))

    def beyond_its_result(n):
        frames = np.repeat(sensor.measure(tilt)[np.newaxis].astype(np.float32), n, axis=0)
        tracemalloc.start()
        result = method(frames)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak - result.phase.nbytes - result.frames.nbytes

    assert beyond_its_result(200) < 1.2 * beyond_its_result(10) + 100_000


# What all have in common.


@every
@pytest.mark.parametrize("extent", [1, 1.5])
def test_residual_is_the_mismatch_of_the_frames_in_the_pupil(sensor_of, modes, method, extent, screens, pupil):
    sensor = ZernikeSensor(pupil, *sensor_of(method).masks, extent=extent)
    frames = sensor.measure(screens(0.6))
    result = build(method, sensor, modes)(frames)
    mismatch = (sensor.measure(result.phase) - frames)[(..., *sensor.window)][..., pupil.inside]
    np.testing.assert_allclose(result.residual, np.sqrt(np.mean(mismatch**2, axis=(-2, -1))), atol=1e-10)


@every
@pytest.mark.parametrize("history", [False, True])
def test_batch_equals_loop(make, method, screens, pupil, history):
    reconstruct, sensor = make(method)
    # Some converge early and leave the others.
    phase = np.concatenate([screens(0.05, 2), screens(0.4, 4)]).reshape(2, 3, *pupil.shape)
    frames = sensor.measure(phase)
    together = reconstruct(frames, history=history)
    assert together.phase.shape == phase.shape
    for where in np.ndindex(2, 3):
        alone = reconstruct(frames[where], history=history)
        np.testing.assert_allclose(together.phase[where], alone.phase, atol=1e-9)
        np.testing.assert_allclose(together.residual[where], alone.residual, atol=1e-9)
        if history:
            np.testing.assert_allclose(together.history[where], alone.history, atol=1e-9)
        for name in ("n_iterations", "converged", "n_unsolved"):
            assert getattr(together, name)[where] == getattr(alone, name), name
            assert np.shape(getattr(alone, name)) == ()


@every
def test_single_precision_in_single_precision_out(make, method, screens, pupil):
    reconstruct, sensor = make(method, **steps(method, n_iterations=8, tolerance=0))
    frames = sensor.measure(screens(0.3))
    single = reconstruct(frames.astype(np.float32), history=True)
    assert single.phase.dtype == single.residual.dtype == single.history.dtype == np.float32
    np.testing.assert_allclose(single.phase, reconstruct(frames).phase, atol=1e-3)


@every
def test_history_leads_from_the_start_to_the_result(make, method, pupil, screens):
    reconstruct, sensor = make(method)
    frames = sensor.measure(screens(0.3))
    result = reconstruct(frames, history=True)
    assert result.history.shape == (3, reconstruct.settings.n_iterations + 1, 40, 40)
    if issubclass(method, ClosedForm | FixedPoint | GradientDescent):  # others may start from a better guess
        assert pupil.rms(result.history[:, 0]).max() < 1e-6
    np.testing.assert_array_equal(result.history[:, -1], result.phase)
    np.testing.assert_array_equal(np.isfinite(result.history), np.broadcast_to(pupil.inside, result.history.shape))
    assert reconstruct(frames).history is None


# What the iterative ones have in common.


@iterative
def test_history_holds_the_results_of_shorter_runs(make, method, screens):
    frames = make(method)[1].measure(screens(0.4))
    history = make(method, n_iterations=6, tolerance=0)[0](frames, history=True).history
    for n in (1, 2, 5, 6):
        shorter = make(method, n_iterations=n, tolerance=0)[0](frames)
        np.testing.assert_allclose(history[:, n], shorter.phase, atol=1e-9)
        np.testing.assert_array_equal(shorter.n_iterations, n)
        assert not shorter.converged.any()


@iterative
def test_tolerance_stops_early(make, method, screens, pupil):
    frames = make(method)[1].measure(screens(0.2))
    loose = make(method, n_iterations=500, tolerance=1e-3)[0](frames, history=True)
    tight = make(method, n_iterations=500, tolerance=1e-8)[0](frames)
    assert loose.converged.all()
    assert np.all((loose.n_iterations < tight.n_iterations) | (tight.n_iterations == 1))
    for history, n in zip(loose.history, loose.n_iterations, strict=True):
        change = pupil.gather(np.diff(history, axis=0))
        size = np.sqrt(np.mean(change**2, axis=1))
        assert size[n - 1] <= 1e-3 * (1 + 1e-6)
        assert np.all(size[: n - 1] > 1e-3 * (1 - 1e-6))
        assert not size[n:].any()


@iterative
def test_start_is_where_it_starts(make, method, screens, pupil):
    reconstruct, sensor = make(method, n_iterations=3, tolerance=0, **once(method))
    phase = np.where(pupil.inside, 4.0 + screens(0.4), np.nan)
    frames = sensor.measure(phase)
    result = reconstruct(frames, start=phase, history=True)
    assert reconstruction_error(pupil, result.history[:, 0], phase).max() < 1e-6
    same = reconstruct(frames, start=phase[0], history=True)
    np.testing.assert_allclose(same.history[0], result.history[0], atol=1e-9)
    assert reconstruction_error(pupil, same.history[1, 0], phase[0]) < 1e-6
    # Its own result, NaN outside, can be handed back in.
    again = reconstruct(frames, start=reconstruct(frames).phase)
    longer = make(method, n_iterations=6, tolerance=0)[0](frames)
    if method in (PhaseShifted, GerchbergSaxton):  # the arcsine picks its branch and the descent its steps anew
        np.testing.assert_allclose(again.phase, longer.phase, atol=1e-8)


@every
@pytest.mark.parametrize("extent", [1.0, 1.6])
def test_a_pickle_reconstructs_the_same_bits(method, extent):
    pupil = zwfs.Pupil.circular(32)
    modes = zwfs.zernike_basis(pupil, 10)
    dimples = [Dimple(1.06, shift) for shift in (1.5, -1.5)[: int(min(2, method.n_masks[1]))]]
    reconstruct = build(method, ZernikeSensor(pupil, *dimples, extent=extent), modes)
    frames = reconstruct.sensor.measure(zwfs.power_law_screens(modes, 0.5, 3, seed=1))
    copy = pickle.loads(pickle.dumps(reconstruct))
    np.testing.assert_array_equal(copy(frames).phase, reconstruct(frames).phase)
    assert copy.sensor.factors.detector.combine.strides == reconstruct.sensor.factors.detector.combine.strides


@fixed_point
def test_phase_lies_on_the_circle(make, method, screens):
    reconstruct, sensor = make(method)
    phase = reconstruct(sensor.measure(screens(1.5))).phase
    assert np.nanmax(np.abs(phase)) <= np.pi


def mean_phasor(pupil, phase):
    return np.mean(np.exp(1j * pupil.gather(phase)), axis=-1)


NOISE = {
    "100 photons": lambda frames, rng: rng.poisson(100 * frames) / 100,
    "10000 photons": lambda frames, rng: rng.poisson(1e4 * frames) / 1e4,
    "read noise": lambda frames, rng: frames + rng.normal(0, 0.1, frames.shape),
    "one frame brighter": lambda frames, rng: frames * np.array([1.2, 1.0])[: frames.shape[1], None, None],
}


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize(
    ("method", "options"), [(Arcsine, {}), (PhaseShifted, {}), (PhaseShifted, {"accelerate": True})]
)
def test_noisy_frames_converge(pupil, modes, sensor_of, method, options, noise):
    # The dimple is 2 % larger than the model has it.
    sensor = sensor_of(method)
    real = ZernikeSensor(pupil, *(Dimple(1.02 * mask.diameter, mask.phase) for mask in sensor.masks))
    phase = np.concatenate([zwfs.power_law_screens(modes, rms, 40, seed=1) for rms in (0.1, 0.5, 0.8)])
    frames = NOISE[noise](real.measure(phase), np.random.default_rng(2))
    result = method(sensor, n_iterations=50, **options)(frames)
    # A single frame that is 20 % too bright has cosines beyond 1 at up to two thirds of the points.
    assert result.converged.mean() > (0.95 if method is Arcsine else 0.99)
    assert result.n_iterations.mean() < (10 if options else 16)
    if method is PhaseShifted:  # the arcsine picks its branch anew
        # What has converged is a fixed point but for a piston.
        after = method(sensor, n_iterations=1, **options)(frames, result.phase).phase
        change = reconstruction_error(pupil, after, result.phase)
        assert np.all(change[result.converged] < 2e-6)
        piston = np.angle(mean_phasor(pupil, after) * np.conj(mean_phasor(pupil, result.phase)))
        assert np.median(np.abs(piston)) > 1e-5  # a piston that is added in each iteration unless it is held


@pytest.mark.parametrize("options", [{}, {"accelerate": True}])
def test_any_piston_of_the_start_gives_the_same_phase(shifted, pupil, screens, options):
    # Whatever the mean field of the start is: that of the first one here vanishes.
    start = np.where(pupil.x < 0, 0.0, np.pi) + np.zeros((pupil.shape[0], 1)) + screens(0.02)
    frames = NOISE["100 photons"](shifted.measure(screens(1.0)), np.random.default_rng(0))
    method = PhaseShifted(shifted, n_iterations=8, tolerance=1e-12, **options)
    assert np.abs(mean_phasor(pupil, start)).max() < 0.1
    expected = method(frames, start).phase
    for piston in (0.3, 1.7, 3.1, -2.0):
        turned = np.angle(np.exp(1j * (method(frames, start + piston).phase - expected - piston)))
        np.testing.assert_allclose(turned[:, pupil.inside], 0, atol=1e-8)


# Points without an equation.


def test_singular_points_keep_their_value_and_are_counted():
    # For a flat start the reference waves of these two masks mirror each other, so on the middle column they are
    # the same: the determinant vanishes there, and only there.
    pupil = zwfs.Pupil.circular(31, 0.3)  # points of the obscuration do not count
    masks = [zwfs.Patch(1.06, lambda u, v, sign=sign: np.exp(1j * (np.pi / 2 + sign * u))) for sign in (1, -1)]
    sensor = ZernikeSensor(pupil, *masks)
    frames = sensor.measure(zwfs.zernike_basis(pupil, 1)[0] * 0.1)
    start = np.full(pupil.shape, 0.3)
    result = PhaseShifted(sensor, n_iterations=1)(frames, start=start)
    assert result.n_unsolved == np.count_nonzero(pupil.inside[:, 15])
    np.testing.assert_allclose(result.phase[pupil.inside[:, 15], 15], 0.3, atol=1e-12)
    assert np.abs(result.phase - 0.3)[:, :15][pupil.inside[:, :15]].min() > 1e-4


# Bad input.


@pytest.mark.parametrize("phases", [(0.0, np.pi), (-0.4, 2 * np.pi - 0.4), (-np.pi, np.pi), (0, 0, 0)])
def test_masks_without_diversity_are_refused(pupil, phases):
    sensor = ZernikeSensor(pupil, *(Dimple(1.06, phase) for phase in phases))
    with pytest.raises(ValueError, match="determinant"):
        PhaseShifted(sensor)


@every
def test_raw_counts_are_warned_of(make, method, screens):
    reconstruct, sensor = make(method, **once(method))
    counts = np.rint(100 * sensor.measure(screens(0.3, 1))).astype(int)  # whole numbers, as of a camera
    mean = counts[..., sensor.pupil.inside].mean(axis=-1).max()
    with pytest.warns(UserWarning, match=f"frames: the mean inside the pupil reaches {mean:.4g}: ") as caught:
        reconstruct(counts)
    assert caught[0].filename == __file__


@every
@pytest.mark.parametrize(("dimple", "extent"), [(Dimple(1.06, np.pi), 1.0), (Dimple(2.5, 1.0, 0.3), 1.6)])
def test_no_frame_of_a_mask_is_taken_for_raw_counts(pupil, modes, screens, method, extent, dimple):
    sensor = ZernikeSensor(pupil, dimple, *[Dimple(1.06, -2.0)] * (method.n_masks[1] > 1), extent=extent)
    reconstruct = build(method, sensor, modes, **steps(method, n_iterations=1), **once(method))
    phase = np.concatenate([screens(rms, 1) for rms in (0.0, 0.5, 3.0)])
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="frames: ")  # a method may warn of other things
        for photons in (np.inf, 1.0):
            frames = 1.5 * sensor.measure(phase)  # a brighter star than that of the calibration
            if photons < np.inf:
                frames = (rng.poisson(frames * photons) + rng.normal(0, 3, frames.shape)) / photons
            reconstruct(frames)
        if method.iterative:
            bright = build(method, sensor, modes, n_iterations=1, amplitude=100 * pupil.amplitude, **once(method))
            bright(1e4 * sensor.measure(phase))


def test_frames_may_come_in_the_unit_of_their_calibration(shifted, modes, screens):
    calibration = [1e4 * shifted.measure(phase) for phase in (0 * modes[0], 0.01 * modes, -0.01 * modes)]
    phase = screens(0.05)
    frames = 1e4 * shifted.measure(phase)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = Linear(shifted, modes, calibration=calibration)(frames)
    np.testing.assert_allclose(result.phase, Linear(shifted, modes)(frames / 1e4).phase, atol=1e-9)


@every
def test_number_of_masks_is_checked(pupil, modes, method):
    fewest, most = method.n_masks
    for n in range(1, 5):
        sensor = ZernikeSensor(pupil, *(Dimple(1.06, 1.0 + k) for k in range(n)))
        if fewest <= n <= most:
            build(method, sensor, modes)
        else:
            with pytest.raises(
                ValueError, match=rf"sensor has {n} masks?: expected {fewest}.* for {method.__name__}"
            ):
                build(method, sensor, modes)


@in_one_step
def test_a_method_without_iteration_refuses_a_start(make, method, screens):
    reconstruct, sensor = make(method)
    frames = sensor.measure(screens(0.1))
    assert reconstruct(frames, None).converged.all()
    with pytest.raises(ValueError, match=rf"start = .*: expected None, since {method.__name__} does not iterate"):
        reconstruct(frames, screens(0.1))


def test_every_reconstructor_is_listed():
    folder = zwfs.reconstructors.__path__
    modules = [import_module(f"zwfs.reconstructors.{module.name}") for module in pkgutil.iter_modules(folder)]
    classes = {thing for module in modules for thing in vars(module).values() if isinstance(thing, type)}
    concrete = {kind for kind in classes if issubclass(kind, Reconstructor) and not inspect.isabstract(kind)}
    assert concrete == {*RECONSTRUCTORS, LearnedReference}  # which needs a training


def test_an_iteration_that_converged_to_a_wrong_phase_does_not_explain_the_frames(pupil, shifted):
    """Turbulence at D / r0 = 30 is far beyond the range of the plain iteration."""
    truth = turbulent_screens(pupil, 1 / 30, 6, seed=2)
    result = PhaseShifted(shifted, n_iterations=400)(shifted.measure(truth))
    wrong = reconstruction_error(pupil, result.phase, truth) > 1
    assert np.any(wrong & result.converged)
    assert not np.any(wrong & result.consistent)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_frames_without_noise_are_explained_to_rounding(shifted, screens, dtype):
    frames = shifted.measure(screens(0.5, 6)).astype(dtype)
    for options in ({}, {"accelerate": True}, {"accelerate": True, "tolerance": 0.0}):
        assert PhaseShifted(shifted, n_iterations=50, **options)(frames).consistent.all()
    assert not PhaseShifted(shifted, n_iterations=2, tolerance=0.0)(frames).consistent.any()
    assert not PhaseShifted(shifted, n_iterations=2)(frames).consistent.any()
    single = PhaseShifted(shifted, n_iterations=50)(frames[0])
    assert single.consistent.shape == ()
    assert single.consistent


@pytest.mark.parametrize(("photons", "read_noise"), [(30, 0.0), (1000, 0.0), (1000, 20.0)])
def test_noise_explains_nearly_all_noisy_frames(pupil, shifted, screens, photons, read_noise):
    camera = zwfs.Detector(photons, read_noise=read_noise)
    frames = camera.normalise(camera.expose(shifted.measure(screens(0.5, 150)), 4))
    result = PhaseShifted(shifted, n_iterations=100, accelerate=True)(frames)
    explained = result.explains(photons=photons, read_noise=read_noise)
    assert np.count_nonzero(~explained) <= 1
    assert not result.consistent.any()  # without noise, no phase would explain these frames
    assert not result.explains(photons=100 * photons, read_noise=read_noise).any()
    likely = zwfs.MaximumLikelihood(shifted, photons=photons, read_noise=read_noise)(frames[:4])
    assert likely.consistent.all()
    assert likely.explains(photons=photons, read_noise=read_noise).all()


@every
def test_every_result_says_whether_it_explains_the_frames(make, method, screens):
    reconstructor, sensor = make(method, **steps(method, n_iterations=3))
    result = reconstructor(sensor.measure(screens(0.4, 2)))
    assert result.explains(photons=1e-3).shape == result.consistent.shape == (2,)
    assert np.all(result.explains(photons=1e-3) == (result.converged | (not reconstructor.settings.tolerance)))
    with pytest.raises(ValueError, match="photons = 0"):
        result.explains(photons=0)
    with pytest.raises(ValueError, match="read_noise = 1: expected 0"):
        result.explains(read_noise=1.0)


@pytest.mark.parametrize("method", [
    lambda sensor: MaximumLikelihood(sensor),
    lambda sensor: MaximumLikelihood(sensor, photons=1000.0),
    lambda sensor: GerchbergSaxton(sensor, unmeasured="model", n_iterations=200),
    lambda sensor: GradientDescent(sensor, n_iterations=200),
])  # fmt: skip
def test_pixels_that_are_not_recorded_have_no_weight(pupil, modes, method):
    """Frames that hold 0 outside the pupil, where there is light, give the exact phase all the same."""
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), recorded=pupil.inside)
    phase = 0.4 * modes[5]
    result = method(sensor)(sensor.measure(phase) * pupil.inside)
    assert result.consistent
    assert reconstruction_error(pupil, result.phase, phase) < 2e-5


def test_one_mask_needs_no_axis_of_masks(pupil, modes):
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2))
    frame = sensor.measure(0.2 * modes[3])
    np.testing.assert_array_equal(Arcsine(sensor)(frame[0]).phase, Arcsine(sensor)(frame).phase)
    with pytest.raises(ValueError, match="frames has shape"):
        Arcsine(sensor)(frame[0][1:])


def test_linear_coefficients_are_those_of_its_phase():
    pupil = zwfs.Pupil.circular(24)
    sensor, modes = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2)), zwfs.zernike_basis(pupil, 8)
    method, truth = Linear(sensor, modes), 0.01 * np.arange(16.0).reshape(2, 8) / 8
    frames = sensor.measure(np.tensordot(truth, np.where(pupil.inside, modes, 0), 1))
    coefficients = method.coefficients(frames)
    np.testing.assert_allclose(coefficients, truth, atol=1e-3)
    phases = np.tensordot(coefficients, modes, 1)
    np.testing.assert_allclose(method(frames).phase[:, pupil.inside], phases[:, pupil.inside], atol=1e-12)
    np.testing.assert_allclose(method.inverse @ method.interaction_matrix, np.eye(8), atol=1e-10)
