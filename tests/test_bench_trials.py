import numpy as np
import pytest

from studies.kit.bench import bench_curves, bench_reconstructors
from zwfs import Linear
from zwfs.bench import Bench, BenchModel, segment_residual, segment_screens

from .conftest import SMALL
from .conftest import ideal_bench as ideal

RMS = (0, 0.05, 0.5)
ERRORS = {"static": 0.1, "quilting": 0.1, "leakage": 0.05, "photons_per_image": 1e9}


@pytest.fixture(scope="module")
def known(perfect, model):
    return bench_reconstructors(perfect, model)


@pytest.fixture(scope="module")
def curves(perfect, model, known):
    return bench_curves(perfect, model, known, RMS, 3, seed=2)


# Linear reconstruction with a recorded calibration


def recordings(bench, model, poke=0.01):
    """Frames of the first mask: flat, and with every segment pushed and pulled."""
    pokes = poke * np.eye(bench.n_segments)
    return tuple(model.normalise(bench.frames(c))[..., :1, :, :] for c in (None, pokes, -pokes))


def test_calibration_takes_up_the_errors_of_the_bench():
    # What the model does not know is in the recorded frames: no offset, and no loss of gain for a small input.
    bench = ideal(leakage=0.2, static=0.3, dimple_error=0.1)
    model = BenchModel.from_images(bench)
    small = segment_screens(bench, 0.005, 2, seed=1)
    frames = [model.normalise(bench.frames(c))[..., :1, :, :] for c in (np.zeros((1, 36)), small)]
    calibrated, modelled = (
        Linear(model.classic, model.modes, conditioning=0.1, calibration=c)
        for c in (recordings(bench, model), None)
    )
    flat, found = (model.pistons(calibrated(one).phase) for one in frames)
    np.testing.assert_allclose(flat, 0, atol=1e-10)
    np.testing.assert_allclose(segment_residual(found, small), 0, atol=5e-4)
    assert segment_residual(model.pistons(modelled(frames[0]).phase), np.zeros(36)).std() > 0.1


def test_the_calibrated_method_has_no_offset_whatever_the_error():
    benches = Bench(**SMALL, **ERRORS).single_errors()
    for case in ("none", *Bench.errors()):
        model = BenchModel.from_images(benches[case], 1)
        calibrated = {"Linear": bench_reconstructors(benches[case], model, seed=1)["Linear"]}
        assert bench_curves(benches[case], model, calibrated, [0], 2, seed=1).mean("Linear")[0] < 1e-9, case


# Curves


def test_ideal_bench_holds_no_error_for_the_exact_methods(curves):
    for name, tolerance in (("PhaseShifted", 1e-5), ("GradientDescent", 1e-4)):
        assert curves.errors[name].max() < tolerance
        np.testing.assert_allclose(curves.gain(name)[1:], 1, atol=tolerance * 10)
    # Beyond its range the linear method sees too little.
    assert curves.gain("Linear")[2] < 0.9
