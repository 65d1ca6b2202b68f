"""The learned reference wave: its simulation against the sensor, its solve against the truth, and controls."""

from pathlib import Path

import numpy as np
import pytest

import zwfs
from zwfs.reconstructors import learned
from zwfs.reconstructors._simulated import (
    BenchErrors,
    BenchValues,
    Light,
    Simulation,
    random_screens,
    solution_weights,
)
from zwfs.reconstructors.learned import SHIPPED, LearnedReference

from .conftest import pair
from .hcipy_bench import HcipyBench

NOMINAL = BenchValues(0.0, 1.0, 0.0, np.zeros(2), 0.0, 0.0)
BRIGHT = Light((1e12, 1e13), 0.0)


def screens_of(pupil, rms, n, seed=1):
    return zwfs.power_law_screens(zwfs.zernike_basis(pupil, 100), rms, n, seed=seed)


def row(**changes):
    bench = NOMINAL._replace(**changes)
    return np.hstack([np.atleast_1d(value) for value in bench])


@pytest.fixture(scope="module")
def sensor(pupil):
    return pair(pupil)


@pytest.fixture(scope="module")
def trained(sensor):
    """Trained for a bench with leakage and unequal light."""
    return LearnedReference(sensor, "bench")


def median_error(reconstruct, pupil, truth, frames):
    return np.median(zwfs.reconstruction_error(pupil, reconstruct(frames).phase, truth))


@pytest.mark.parametrize("shifts", [(np.pi / 2, -np.pi / 2), (2.0, -1.0), (1.0, 2.5, -1.5)])
def test_the_true_reference_wave_gives_the_true_phase(pupil, shifts):
    sensor, truth = pair(pupil, shifts=shifts, tolerance=1e-12), screens_of(pupil, 1.0, 1)
    disc = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi), tolerance=1e-12)
    plane, core = disc.factors.detector.cut(*disc.window), disc.factors.core[0] / -2
    field = pupil.field(truth)
    wave = plane.expand(disc.factors.pupil.project(field) @ core.T)
    weights, power_weight = solution_weights(np.array(shifts), np.ones(len(shifts)))
    signal = sensor.measure(truth)[(..., *sensor.window)] - pupil.amplitude**2
    solved = np.einsum("m,kmyx->kyx", weights, signal) - power_weight * np.abs(wave) ** 2
    error = np.angle(solved * wave * field.conj())[:, pupil.inside]
    assert np.abs(error - error.mean()).max() < 1e-9


@pytest.mark.parametrize(
    ("errors", "changes"),
    [
        ({}, {}),
        ({"phase_shift": (-0.2, 0.2)}, {"phase_shift": np.array([0.1, -0.15])}),
        ({"diameter": (-0.1, 0.1)}, {"diameter": 0.07}),
    ],
)
def test_simulated_frames_are_those_of_the_sensor(pupil, sensor, errors, changes):
    rng = np.random.default_rng(0)
    simulation = Simulation(sensor, pupil.amplitude, BenchErrors(**errors), BRIGHT)
    truth = 0.8 * random_screens(pupil, 2, rng)
    frames, _ = simulation.frames(truth, np.tile(row(**changes), (2, 1)), rng)
    bench = NOMINAL._replace(**changes)
    real = pair(pupil, 1.06 + bench.diameter, np.array([np.pi / 2, -np.pi / 2]) + bench.phase_shift)
    expected = real.measure(truth)[(..., *real.window)]
    assert np.abs(frames - expected)[..., pupil.inside].max() < 2e-4


def test_simulated_leakage_and_light_act_on_the_images(pupil, sensor):
    rng = np.random.default_rng(0)
    errors = BenchErrors(leakage=(0, 0.1), flux_ratio=(0.8, 1.2))
    simulation = Simulation(sensor, pupil.amplitude, errors, BRIGHT)
    truth = 0.8 * random_screens(pupil, 1, rng)
    frames, _ = simulation.frames(truth, row(leakage=0.05, flux_ratio=1.25)[np.newaxis], rng)
    first, second = sensor.measure(truth)[0][(..., *sensor.window)]
    expected = np.stack([0.95 * first + 0.05 * second, (0.95 * second + 0.05 * first) / 1.25])
    assert np.abs(frames[0] - expected)[:, pupil.inside].max() < 2e-4


def test_random_screens_have_unit_rms_and_are_independent(pupil):
    values = random_screens(pupil, 6, np.random.default_rng(2))[:, pupil.inside]
    assert values.std(axis=1) == pytest.approx(1, abs=1e-4)
    assert np.abs(np.corrcoef(values) - np.eye(6)).max() < 0.8


def test_one_solve_reaches_the_noise_of_the_iteration(pupil, sensor):
    truth = screens_of(pupil, 0.8, 60, seed=7)
    frames = np.random.default_rng(3).poisson(1000 * sensor.measure(truth)) / 1000
    converged = median_error(zwfs.PhaseShifted(sensor), pupil, truth, frames)
    assert median_error(LearnedReference(sensor), pupil, truth, frames) < 1.1 * converged
    one_solve = zwfs.PhaseShifted(sensor, n_iterations=1, tolerance=0)
    assert median_error(one_solve, pupil, truth, frames) > 1.5 * converged


def test_it_goes_on_where_the_iteration_fails(pupil, sensor):
    truth = screens_of(pupil, 2.0, 40, seed=7)
    frames = sensor.measure(truth)
    assert median_error(zwfs.PhaseShifted(sensor), pupil, truth, frames) > 1
    assert median_error(LearnedReference(sensor), pupil, truth, frames) < 0.1
    assert median_error(LearnedReference(sensor, n_iterations=26), pupil, truth, frames) < 1e-4


def test_a_pupil_of_other_pixels_needs_no_other_training():
    pupil = zwfs.Pupil.circular(90)
    sensor, truth = pair(pupil), screens_of(pupil, 0.8, 10)
    assert median_error(LearnedReference(sensor), pupil, truth, sensor.measure(truth)) < 0.02


def test_results_do_not_depend_on_the_batch(pupil, sensor):
    reconstruct, frames = LearnedReference(sensor), sensor.measure(screens_of(pupil, 0.8, 70))
    whole, alone = reconstruct(frames), reconstruct(frames[69])
    assert alone.phase.shape == pupil.shape
    assert np.nanmax(np.abs(whole.phase[69] - alone.phase)) < 1e-4
    single = reconstruct(frames.astype(np.float32))
    assert single.phase.dtype == np.float32


def test_a_bench_with_errors_is_read_from_its_frames(trained, pupil, sensor):
    truth = screens_of(pupil, 0.7, 60, seed=5)
    first, second = np.moveaxis(sensor.measure(truth), 1, 0)
    images = np.stack([0.95 * first + 0.05 * second, (0.95 * second + 0.05 * first) / 0.92], axis=1)
    frames = np.random.default_rng(3).poisson(5000 * images) / 5000
    values, errors = trained.average(frames)
    assert abs(values.leakage - 0.05) < 3 * errors.leakage < 0.08
    assert abs(values.flux_ratio - 0.92) < 3 * errors.flux_ratio < 0.05
    assert values.diameter == 0
    learned_error = median_error(trained, pupil, truth, frames)
    assert learned_error < median_error(zwfs.PhaseShifted(sensor), pupil, truth, frames)
    corrected = LearnedReference(sensor, trained.training, bench=values)
    assert median_error(corrected, pupil, truth, frames) < 1.05 * learned_error
    (single, error), (_, averaged) = trained.average(frames[0]), (values, errors)
    assert abs(single.leakage - 0.05) < 3 * error.leakage
    assert error.leakage > 1.5 * averaged.leakage


def test_known_phase_shifts_hold_for_further_iterations(pupil, sensor):
    truth = screens_of(pupil, 0.5, 5)
    shifts = np.array([0.2, -0.1])
    frames = pair(pupil, shifts=(np.pi / 2 + 0.2, -np.pi / 2 - 0.1)).measure(truth)
    bench = NOMINAL._replace(phase_shift=shifts)
    assert median_error(LearnedReference(sensor, n_iterations=20), pupil, truth, frames) > 0.01
    assert median_error(LearnedReference(sensor, n_iterations=20, bench=bench), pupil, truth, frames) < 1e-4


def test_history_begins_flat_and_ends_at_the_phase(pupil, sensor):
    frames = sensor.measure(screens_of(pupil, 0.5, 70))
    result = LearnedReference(sensor, n_iterations=3)(frames, history=True)
    assert result.history.shape == (70, 4, *pupil.shape)
    assert not result.history[:, 0, pupil.inside].any()
    assert np.array_equal(result.history[:, -1], result.phase, equal_nan=True)


def test_frames_unlike_those_of_the_training_are_unfamiliar(trained, pupil, sensor):
    truth = screens_of(pupil, 0.8, 20)
    frames = sensor.measure(truth)
    assert trained(frames).familiar.mean() > 0.9
    assert not trained(2 * frames).familiar.any()
    assert not trained(frames[:, :, ::-1] * [[[1.5]], [[0.6]]]).familiar.any()


@pytest.fixture
def shuffled(monkeypatch):
    """Control: a training that gets the waves of other frames learns their distribution only."""
    example = learned._example

    def other_waves(*arguments):
        inputs, waves = example(*arguments)
        return inputs, waves[::-1]

    def train(*arguments, **settings):
        with monkeypatch.context() as patched:
            patched.setattr(learned, "_example", other_waves)
            return LearnedReference.train(*arguments, **settings)

    return train


def test_one_image_reaches_the_converged_arcsine_in_one_solve(pupil, shuffled):
    """A phase outside of the arcsine's range is folded back as by the arcsine itself."""
    sensor, truth = pair(pupil, shifts=(np.pi / 2,)), screens_of(pupil, 0.5, 40, seed=7)
    frames = sensor.measure(truth)
    settings = {"n_screens": 3000, "rms": (0.0, 1.2), "seed": 1}
    error = median_error(LearnedReference.train(sensor, **settings), pupil, truth, frames)
    assert error < 1.1 * median_error(zwfs.Arcsine(sensor), pupil, truth, frames)
    assert error < 0.8 * median_error(zwfs.Arcsine(sensor, n_iterations=1, tolerance=0), pupil, truth, frames)
    assert median_error(shuffled(sensor, **settings), pupil, truth, frames) > 1.2 * error


def test_one_image_of_a_negative_shift_and_a_dimple_that_absorbs(pupil):
    sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, -1.2, 0.9))
    truth = screens_of(pupil, 0.2, 20, seed=7)
    method = LearnedReference.train(sensor, n_screens=2000, rms=(0.0, 0.5), seed=1)
    assert median_error(method, pupil, truth, sensor.measure(truth)) < 0.03
    with pytest.raises(ValueError, match="n_iterations = 2: expected 1 for a sensor with one mask"):
        LearnedReference(sensor, method.training, n_iterations=2)


def test_a_large_dimple_is_read_better_than_by_two_accelerated_solves(pupil):
    """But not to the noise: `explains` says so, and further iterations go on from there."""
    sensor, truth = pair(pupil, 2.0), screens_of(pupil, 0.5, 40, seed=7)
    frames, settings = sensor.measure(truth), {"n_screens": 5000, "rms": (0.0, 1.2), "seed": 1}
    method = LearnedReference.train(sensor, **settings)
    error = median_error(method, pupil, truth, frames)
    two = zwfs.PhaseShifted(sensor, n_iterations=2, tolerance=0, accelerate=True)
    assert error < 0.7 * median_error(two, pupil, truth, frames)
    assert not method(frames).explains(photons=1e4).any()
    further = LearnedReference(sensor, method.training, n_iterations=26)
    assert median_error(further, pupil, truth, frames) < 1e-3


@pytest.mark.parametrize(("leakage", "fluxes"), [(0.05, (1.0, 0.9)), (0.03, (1.0, 1.15))])
def test_frames_of_hcipy_with_leakage_and_unequal_light(leakage, fluxes):
    """HCIPy's frames: four samples across a pixel, a dimple and a pupil of its own."""
    pytest.importorskip("hcipy")
    bench = HcipyBench(leakage=leakage, fluxes=fluxes, photons=1e4, read_noise=0.0, background=0.0)
    sensor = pair(zwfs.Pupil.circular(bench.pixels))
    margin = (bench.side - bench.pixels) // 2
    truth = [bench.smooth(0.8, seed=300 + number) for number in range(6)]
    counts = np.array([bench.counts(phase, (5, number)) for number, phase in enumerate(truth)])
    frames = counts[..., margin:-margin, margin:-margin] / bench.photons

    def error(method):
        return np.median([bench.error(*pair) for pair in zip(method(frames).phase, truth, strict=True)])

    learned_bench = LearnedReference(sensor, "bench")
    assert learned_bench(frames).familiar.all()
    assert error(learned_bench) < 0.018
    assert error(zwfs.PhaseShifted(sensor)) > 0.07  # the nominal model
    untaught = LearnedReference(sensor)
    assert error(untaught) > 0.15  # weights that were trained without errors of the bench
    assert not untaught(frames).familiar.any()
    values, errors = learned_bench.average(frames)
    assert abs(values.leakage - leakage) < 3 * errors.leakage
    assert abs(values.flux_ratio - fluxes[0] / fluxes[1]) < 3 * errors.flux_ratio


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_new_training_is_as_good_as_the_shipped_one(name):
    pupil = zwfs.Pupil.circular(64)
    sensor, truth = pair(pupil), screens_of(pupil, 0.8, 100, seed=7)
    first, second = np.moveaxis(sensor.measure(truth), 1, 0)
    leakage, ratio = (0.04, 0.92) if name == "bench" else (0.0, 1.0)
    mixed = (1 - leakage) * first + leakage * second, ((1 - leakage) * second + leakage * first) / ratio
    frames = np.random.default_rng(3).poisson(3e4 * np.stack(mixed, axis=1)) / 3e4
    error = median_error(LearnedReference(sensor, name), pupil, truth, frames)
    again = LearnedReference.train(sensor, **SHIPPED[name])
    assert median_error(again, pupil, truth, frames) == pytest.approx(error, rel=0.1)


def test_shipped_weights_are_small():
    folder = Path(learned.__file__).parent
    assert sum((folder / f"learned_{name}.npz").stat().st_size for name in SHIPPED) < 500_000


def test_a_training_is_reproducible_and_survives_a_file(tmp_path, sensor, pupil):
    steps = []
    first, again = (
        LearnedReference.train(sensor, n_screens=1000, seed=3, progress=lambda *step: steps.append(step))
        for _ in range(2)
    )
    assert np.array_equal(first.training.network.skip, again.training.network.skip)
    assert steps[-1][0] == steps[-1][1]
    first.save(tmp_path / "weights.npz")
    loaded = LearnedReference.load(tmp_path / "weights.npz", sensor)
    frames = sensor.measure(screens_of(pupil, 0.5, 1))
    assert np.array_equal(loaded(frames).phase, first(frames).phase, equal_nan=True)
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"broken\.npz: expected a file that LearnedReference\.save wrote"):
        LearnedReference.load(tmp_path / "broken.npz", sensor)
