import numpy as np
import pytest

from studies.error_budget import error_budget
from studies.kit.bench import bench_curves, bench_reconstructors
from zwfs import Linear, PhaseShifted
from zwfs.bench import Bench, BenchModel, segment_residual, segment_screens

from .conftest import SMALL
from .conftest import ideal_bench as ideal

RMS = (0, 0.05, 0.5)
ERRORS = {"static": 0.1, "quilting": 0.1, "leakage": 0.05, "photons": 1e9}


@pytest.fixture(scope="module")
def known(perfect, model):
    return bench_reconstructors(perfect, model)


@pytest.fixture(scope="module")
def curves(perfect, model, known):
    return bench_curves(perfect, model, known, RMS, 3, seed=2)


@pytest.fixture(scope="module")
def budget():
    return error_budget(Bench(**SMALL, **ERRORS).single_errors(), RMS, 2, seed=1)


# Linear reconstruction with a recorded calibration


def recordings(bench, model, poke=0.01):
    """Frames of the first mask: flat, and with every segment pushed and pulled."""
    pokes = poke * np.eye(bench.n_segments)
    return tuple(model.normalise(bench.frames(c))[..., :1, :, :] for c in (None, pokes, -pokes))


def test_calibration_on_an_ideal_bench_is_that_of_the_model(perfect, model, known):
    recorded = Linear(model.classic, model.modes, calibration=recordings(perfect, model))
    made = Linear(model.classic, model.modes)
    np.testing.assert_allclose(recorded.interaction_matrix, made.interaction_matrix, rtol=0, atol=1e-8)
    assert np.abs(made.interaction_matrix).max() > 0.5
    frames = model.normalise(perfect.frames(segment_screens(perfect, 0.2, 2, seed=1)))[:, :1]
    np.testing.assert_allclose(recorded(frames).phase, made(frames).phase, rtol=0, atol=1e-6)


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


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f, p, q: (np.stack([f, f]), p, q), "calibration flat has a batch"),
        (lambda f, p, q: (f, p[:-1], q), "calibration pushed has a batch"),
        (lambda f, p, q: (f, p, np.concatenate([q, q], 1)), "calibration pulled has shape"),
        (lambda f, p, q: (f, p, -q), "calibration pulled: 36 of 36 hold no light"),
        (lambda f, p, q: (f, p, p), "sensor sees none of them"),
        (lambda f, p, q: (f, p), "calibration (is|has) .*expected .*flat, pushed, pulled"),
    ],
)
def test_bad_calibration_is_named(perfect, model, spoil, message):
    with pytest.raises(ValueError, match=message):
        Linear(model.classic, model.modes, calibration=spoil(*recordings(perfect, model)))


# Reconstructors of a bench


# Curves


def test_curves_follow_the_seed_with_noise():
    bench = Bench(**SMALL, photons=1e8)
    model = BenchModel.from_images(bench, 1)
    method = {"PhaseShifted": PhaseShifted(model.shifted)}
    one, again, other = (bench_curves(bench, model, method, [0, 0.3], 2, seed=s) for s in (4, 4, 5))
    np.testing.assert_array_equal(one.residuals["PhaseShifted"], again.residuals["PhaseShifted"])
    assert np.abs(one.residuals["PhaseShifted"][0] - other.residuals["PhaseShifted"][0]).max() > 1e-5
    assert np.abs(one.commanded[1] - other.commanded[1]).max() > 0.1
    # Noise is drawn anew for every screen.
    assert np.abs(np.diff(one.residuals["PhaseShifted"][0], axis=0)).max() > 1e-5
    # The first input does not depend on those that follow it.
    short = bench_curves(bench, model, method, [0], 2, seed=4)
    np.testing.assert_array_equal(short.residuals["PhaseShifted"][0], one.residuals["PhaseShifted"][0])


def test_ideal_bench_holds_no_error_for_the_exact_methods(curves):
    for name, tolerance in (("PhaseShifted", 1e-5), ("GradientDescent", 1e-4)):
        assert curves.errors[name].max() < tolerance
        np.testing.assert_allclose(curves.gain(name)[1:], 1, atol=tolerance * 10)
    # Beyond its range the linear method sees too little.
    assert curves.gain("Linear")[2] < 0.9


# Error budget


def test_budget_takes_each_error_alone(budget):
    assert tuple(budget) == ("none", *Bench.errors(), "noise", "all")
    for curves in budget.values():
        np.testing.assert_array_equal(curves.commanded, budget["none"].commanded)
    assert budget["none"].errors["PhaseShifted"].max() < 1e-5


def test_budget_names_the_static_aberration_for_the_offset(budget):
    offset = {case: curves.mean("PhaseShifted")[0] for case, curves in budget.items()}
    static = offset.pop("static")
    assert 0.06 < static < 0.11  # 0.1 rad rms over the pupil, a little less between segments
    del offset["all"]
    assert max(offset.values()) < 0.1 * static
    # Small inputs add to it and do not change it.
    np.testing.assert_allclose(budget["static"].mean("PhaseShifted"), static, rtol=1e-3)
    np.testing.assert_allclose(budget["static"].gain("PhaseShifted")[1:], 1, atol=1e-4)


def test_budget_names_the_leakage_for_the_underestimation(budget):
    gain = {case: curves.gain("PhaseShifted")[1] for case, curves in budget.items()}
    assert gain["leakage"] == pytest.approx(0.9, abs=0.01)  # 1 - 2 leakage
    assert min(gain, key=lambda case: gain[case] + (case == "all")) == "leakage"
    assert gain["none"] == pytest.approx(1, abs=1e-5)
    assert gain["flux_imbalance"] == pytest.approx(1, abs=1e-5)


def test_the_calibrated_method_has_no_offset_whatever_the_error():
    benches = Bench(**SMALL, **ERRORS).single_errors()
    for case in ("none", *Bench.errors()):
        model = BenchModel.from_images(benches[case], 1)
        calibrated = {"Linear": bench_reconstructors(benches[case], model, seed=1)["Linear"]}
        assert bench_curves(benches[case], model, calibrated, [0], 2, seed=1).mean("Linear")[0] < 1e-9, case


def test_budget_of_noise_falls_with_the_photons(budget):
    bench = Bench(**SMALL, photons=1e7, read_noise=0, background=0)
    few = error_budget(bench.single_errors(), [0.05], 4)["noise"].mean("PhaseShifted")[0]
    many = budget["noise"].mean("PhaseShifted")[1]
    assert 5 < few / many < 15  # as the square root; read noise and background take a little
