"""Timings on the pupil of the paper; with --benchmark-disable each is run once and only its result is checked."""

import numpy as np
import pytest

from zwfs import (
    Arcsine,
    GerchbergSaxton,
    GradientDescent,
    Linear,
    PhaseShifted,
    ZernikeSensor,
    power_law_screens,
    zernike_basis,
)

from .ratios import DIMPLES, N_ITERATIONS, Contest


@pytest.fixture(scope="module")
def contest():
    return Contest()


@pytest.mark.parametrize("package", ["zwfs", "hcipy"])
@pytest.mark.parametrize("task", ["propagation", f"{N_ITERATIONS} phase-shifted iterations"])
def test_beside_hcipy(benchmark, contest, task, package):
    benchmark.group = task
    function = contest.tasks[task][package]
    function()
    error = contest.error(task, benchmark(function))
    benchmark.extra_info["error"] = error
    assert error < 5e-3


@pytest.mark.parametrize("extent", [1, 4])
def test_set_up_of_a_sensor(benchmark, contest, extent):
    benchmark.group = "set-up"
    assert benchmark(ZernikeSensor, contest.pupil, *DIMPLES, extent=extent).rank < 100


def test_set_up_of_200_modes(benchmark, contest):
    benchmark.group = "set-up"
    assert len(benchmark(zernike_basis, contest.pupil, 200)) == 200


def test_set_up_of_an_interaction_matrix(benchmark, contest):
    benchmark.group = "set-up"
    assert benchmark.pedantic(Linear, (contest.classic, contest.modes)).n_inverted == 200


@pytest.mark.parametrize("method", [Linear, Arcsine, PhaseShifted, GerchbergSaxton, GradientDescent])
def test_20_screens(benchmark, contest, method):
    benchmark.group = f"20 screens, {N_ITERATIONS} iterations"
    sensor = contest.shifted if method is PhaseShifted else contest.classic
    if method is GerchbergSaxton:
        sensor = ZernikeSensor(contest.pupil, *DIMPLES, extent=4)
    options = {} if method is Linear else {"n_iterations": N_ITERATIONS, "tolerance": 0}
    reconstruct = method(sensor, *([contest.modes] if method is Linear else []), **options)
    frames = sensor.measure(power_law_screens(contest.modes, 0.3, 20, seed=1))
    found = benchmark.pedantic(reconstruct, (frames,), warmup_rounds=1, rounds=3)
    assert np.isfinite(found.residual).all()
