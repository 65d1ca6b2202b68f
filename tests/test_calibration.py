"""The notebook `calibration`: its recorded frames, and what a fit of the bench makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from studies import calibration as study

from . import calibration_frames


@pytest.fixture(scope="module")
def taken():
    return study.Recording.read()


@pytest.fixture(scope="module")
def fit(taken):
    return study.calibrate(taken, n_steps=3)


@pytest.fixture(scope="module")
def measured(taken, fit):
    return study.measure_inputs(taken, fit, 0.3, 1)


def test_recorded_frames_are_those_that_the_script_makes(taken):
    assert calibration_frames.FILE.stat().st_size < 300e3
    made = calibration_frames.made()
    assert made.keys() == taken.arrays.keys()
    for name, values in made.items():
        assert values.dtype == taken.arrays[name].dtype
        # The last digits of the light depend on the processor: a draw may then differ by a count.
        np.testing.assert_allclose(taken.arrays[name], values, rtol=0, atol=values.dtype == np.int16)


def test_shorter_exposures_have_the_light_of_the_calibration_and_more_noise(taken):
    [bright, _], [faint, _] = (taken.unseen(0.5, photons) for photons in taken.photons)
    (light, noise), (same, more) = (taken.shot(number) for number in (bright, faint))
    assert same.sum() == pytest.approx(light.sum(), rel=0.05)  # of another screen
    assert np.median(more) > 10 * np.median(noise)


def test_fit_recovers_the_bench(taken, fit):
    for name, value in study.known_values(taken).items():
        if name in ("diameter", "first", "second"):
            assert fit[name].value == pytest.approx(value, rel=5e-3), name
        elif name.endswith(("row", "column", "leakage")):
            assert fit[name].value == pytest.approx(value, abs=0.02), name
    assert fit.consistent


def test_calibrated_phases_are_better_than_those_of_the_design_and_their_error_bars_hold(measured):
    assert measured.rms.tolist() == [0.1, 0.3]
    assert np.all(measured.column("calibrated") < 0.75 * measured.column("plain"))
    assert measured.column("calibrated").max() < 0.02
    for [one] in measured.measured:
        assert 0.5 < one.inside < 0.9
        assert one.consistent


def test_frames_of_a_different_bench_are_flagged(taken, fit):
    [number] = taken.unseen(0.3, taken.photons[0])[:1]
    frames = taken.arrays["unseen_frames"].copy()
    frames[number, 1] = frames[number, 1, ::-1]
    [one] = study.measure(replace(taken, arrays={**taken.arrays, "unseen_frames": frames}), fit, [number])
    assert not one.consistent
    assert one.misfit > 10
