"""Calibration of the simulated bench, on frames of the same sampling as the model and of a finer one."""

from dataclasses import fields

import numpy as np
import pytest

from studies.calibration import (
    WAYS,
    dimmed,
    fit_models,
    fitted_parameters,
    measure_segments,
    take_calibration_frames,
)
from zwfs.bench import Bench
from zwfs.frames import fit_bench

LAYOUT = {"extent": 1.25, "n_pixels": 32, "n_rings": 1, "gap": 0.05, "missing": (), "stop": 0.85, "quilting": 0.0}
TOLERANCES = {
    "diameter": 0.005 * 1.06,
    "phase shift": 0.01 * np.pi / 2,
    "leakage": 0.005,
    "blur": 0.02,
    "focus": 0.05 * 3e-4,
    "distance": 0.02,
}


class FineBench(Bench):
    """A bench on a pupil grid that is twice as fine: a camera pixel is the sum of four."""

    @property
    def _fine(self):
        same = {field.name: getattr(self, field.name) for field in fields(Bench)}
        twice = {name: 2 * same[name] for name in ("n_pixels", "blur", "misregistration")}
        fewer = {"background": self.background / 4, "read_noise": self.read_noise / 2}
        return Bench(**{**same, **twice, **fewer})

    def frames(self, pistons=None, seed=None):
        return binned(self._fine.frames(pistons, seed))

    def clear_frames(self, seed=None):
        return binned(self._fine.clear_frames(seed))

    def dark(self, seed=None):
        return binned(self._fine.dark(seed))


def binned(images):
    ny, nx = images.shape[-2:]
    return images.reshape(*images.shape[:-2], ny // 2, 2, nx // 2, 2).sum(axis=(-3, -1))


def measured(bench):
    taken = take_calibration_frames(bench, 3, 0.6, seed=1)
    fits = fit_models(taken)
    return fits, *measure_segments(taken, fits, [0.3, 0.8], 1, seed=1)


@pytest.fixture(scope="module")
def bench():
    return dimmed(Bench(**LAYOUT), 1e5)


@pytest.fixture(scope="module")
def calibrated(bench):
    return measured(bench)


def test_parameters_of_the_bench_are_recovered_within_their_error_bars(bench, calibrated):
    for one in fitted_parameters(bench, calibrated[0]["calibrated"]):
        tolerance = next(value for name, value in TOLERANCES.items() if one.name.startswith(name))
        assert abs(one.value - one.true) <= tolerance, one.name
        assert abs(one.deviation) <= 3.5, one.name


def test_calibrated_model_measures_new_screens_and_the_control_fails(calibrated):
    _, curves, examples = calibrated
    assert set(curves.residuals) == set(WAYS)
    assert curves.mean("calibrated").max() < 0.01
    assert curves.mean("design, less flat").min() > 3 * curves.mean("calibrated").max()
    assert curves.mean("shuffled").min() > 0.3
    [example] = examples[1]
    counts, sigma = example.measured
    misfits = {name: np.sqrt(np.mean(((one - counts) / sigma) ** 2)) for name, one in example.modelled.items()}
    assert misfits["calibrated"] < 1.3 < 10 < min(misfits["design"], misfits["shuffled"])


def test_a_bench_on_a_finer_grid_is_measured_better_than_with_the_model_of_the_design(calibrated):
    """The model shares no grid with this bench. The gain is smaller, and its parameters are not those put in."""
    finer = dimmed(FineBench(**LAYOUT), 1e5)
    taken = take_calibration_frames(finer, 3, 0.6, seed=1)
    known = finer.commanded_phase(taken.commands)
    settings = {"n_pixels": finer.n_pixels, "noise": taken.noise, "n_inner": 30, "n_steps": 10}
    fit = fit_bench(taken.frames, taken.clear, known, **settings, errors=False)
    curves, _ = measure_segments(taken, {"calibrated": fit}, [0.3, 0.8], 1, seed=1)
    error = curves.mean("calibrated").mean()
    assert 3 * calibrated[1].mean("calibrated").mean() < error < 0.5 * curves.mean("design, less flat").mean()


@pytest.mark.slow
def test_frames_are_explained_where_a_segment_is_missing():
    """The fitted amplitude is small there, not zero, so its phase must be that of the calibration."""
    bench, whole = (dimmed(Bench(**LAYOUT | {"missing": missing}), 1e5) for missing in ((3,), ()))
    taken = take_calibration_frames(bench, 3, 0.6, seed=1)
    known = bench.commanded_phase(taken.commands)
    settings = {"n_pixels": bench.n_pixels, "noise": taken.noise, "n_inner": 30, "tolerance": 5e-4}
    fit = fit_bench(taken.frames, taken.clear, known, **settings, errors=False)
    [[example]] = measure_segments(taken, {"calibrated": fit}, [0.8], 1, seed=1)[1]
    counts, sigma = example.measured
    margin = (counts.shape[-1] - bench.n_pixels) // 2
    dark = np.pad((whole.segments > 0) & (bench.segments == 0), margin)
    assert np.count_nonzero(dark) > 50
    misfit = (counts - example.modelled["calibrated"]) / sigma
    assert abs(misfit[:, dark].mean()) < 0.5


def test_exposures_keep_the_share_of_the_background():
    bench = Bench(n_pixels=40)
    short = dimmed(bench, 1e4)
    n_points = np.count_nonzero(bench.segments)
    assert short.photons == pytest.approx(1e4 * n_points)
    assert short.background / short.photons == pytest.approx(bench.background / bench.photons)
    assert short.read_noise**2 / short.photons == pytest.approx(bench.read_noise**2 / bench.photons)
