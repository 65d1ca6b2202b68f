"""What a verdict says at the boundaries of its factors, and what a fit keeps, on frames that HCIPy simulates."""

from dataclasses import replace

import numpy as np
import pytest

from zwfs.frames.pipeline import Optics, iterated_phase, recover_phase, reduce_frames, upside_down
from zwfs.frames.refine import fit, steps
from zwfs.frames.registration import register_frames
from zwfs.frames.verdict import CameraNoise, _of_score, judge

from .hcipy_bench import HcipyBench

SHIFTED = {"offsets": ((0.0, 0.0), (0.4, -0.7))}


def recorded(bench, clear_photons=None, seed=1):
    """Frames and clear frames of a screen of 0.5 rad rms, and the screen."""
    screen = bench.smooth(0.5, seed=seed)
    lamp = replace(bench, photons=clear_photons or bench.photons)
    return bench.images(screen, (7, seed)), lamp.images(0 * screen, (8, seed), masked=False), screen


def registered(bench, **settings):
    frames, clear_frames, _ = recorded(bench)
    return register_frames(frames, clear_frames, **settings)


def error(bench, found, screen):
    """Rms error of a phase at fully lit pixels, radian."""
    return np.nanstd(bench.difference(found.phase, found.measurement.registered.corner, screen))


@pytest.fixture(scope="module")
def disc():
    return registered(HcipyBench())


@pytest.fixture(scope="module")
def found(disc):
    return recover_phase(reduce_frames(disc, Optics()))


# Fits


def test_fit_keeps_a_value_that_predicts_unseen_blocks_better(disc):
    assert fit(disc, Optics(scale=1.1), ["scale"])[1].scale == pytest.approx(1, abs=0.01)


def test_fit_keeps_nothing_of_frames_that_do_not_belong_together(disc):
    """A lower scale predicts these frames better, too, but the control even more so."""
    frames = disc.frames[0], replace(disc.frames[1], counts=disc.frames[1].counts[::-1])
    nonsense, optics = replace(disc, frames=frames), Optics(scale=1.5)
    assert fit(nonsense, optics, ["scale"]) == (nonsense, optics)
    assert fit(disc, optics, ["scale"])[1].scale < 1.05


def test_last_step_on_a_shifted_disc_is_not_worse_than_one_before():
    bench = HcipyBench(**SHIFTED)
    frames, clear_frames, screen = recorded(bench)
    work = steps(frames, clear_frames, Optics(), ["registration", "diameter"])
    errors = [error(bench, step.result, screen) for step in work]
    assert [step.name for step in work[-2:]] == ["fit of registration (not kept)", "fit of diameter (not kept)"]
    assert errors[-1] == min(errors) < 0.015 < errors[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bench", "optics"),
    [
        (HcipyBench(leakage=0.05), Optics()),
        (HcipyBench("VLT"), Optics(1.2)),
        (HcipyBench("VLT", **SHIFTED), Optics()),
        (HcipyBench(diameter=1.1, leakage=0.03, focus=(6e-4, -4e-4), blur=0.6, static=0.15), Optics()),
    ],
    ids=["leakage", "diameter", "shift", "all"],
)
def test_steps_lower_the_error_or_keep_it(bench, optics):
    frames, clear_frames, screen = recorded(bench)
    work = steps(frames, clear_frames, optics, ["registration", "scale", "diameter", "leakage"])
    first, last = (error(bench, step.result, screen) for step in (work[3], work[-1]))
    assert last < 1.05 * first
    if optics.diameter > 1.1 or bench.leakage == 0.05:
        assert last < first / 3


# Sentences


def test_rotation_that_is_not_determined_is_named_and_the_misfit_is_not_called_explained():
    bench = HcipyBench("VLT", rotations=(0.0, 1.5), photons=300.0)
    verdict = judge(recover_phase(reduce_frames(registered(bench), Optics())), CameraNoise(1.0, bench.noise))
    assert verdict.inner < 1.25
    assert not verdict.placed
    assert verdict.explained is None
    assert "do not determine the rotation" in verdict.findings["fit"]


def test_scale_of_the_phase_is_determined_by_frames_that_belong_together_only(found):
    verdict = judge(found)
    assert verdict.scales == (1.0, 1.0)
    assert verdict.findings["scale"].startswith("Determined")
    control = upside_down(found.measurement)
    nonsense = judge(replace(found, phase=iterated_phase(control, 25, 1e-4), measurement=control))
    assert "The scale of the phase is not determined" in nonsense.findings["scale"]
    assert nonsense.strengths[1] > 1.5 * nonsense.strengths[0]


@pytest.mark.parametrize(("lead", "words"), [(0.21, "belong together"), (0.19, "hardly support")])
def test_frames_belong_together_if_both_lead_their_control_by_a_fifth(lead, words):
    control = np.array([0.3, 0.1])
    assert words in _of_score(control + np.array([lead, 0.5]), control)
    assert words in _of_score(control + np.array([0.5, lead]), control)


def test_photons_are_those_of_the_mean_of_the_clear_frames_and_their_noise_is_that_of_the_mean():
    bench = HcipyBench(photons=3e6, fluxes=(1.0, 0.6), read_noise=0.0, background=0.0)
    frames, clear_frames, _ = recorded(bench, clear_photons=3e3)
    measurement = reduce_frames(register_frames(frames, clear_frames, exposure=1e3), Optics())
    assert CameraNoise(2.0).photons(measurement) == pytest.approx(2 * 0.8 * 3e6, rel=0.02)
    # The noise of the clear frames is nearly all of it here.
    even = replace(bench, fluxes=(1.0, 1.0))
    frames, clear_frames, _ = recorded(even, clear_photons=3e3)
    measurement = reduce_frames(register_frames(frames, clear_frames, exposure=1e3), Optics())
    assert judge(recover_phase(measurement), CameraNoise(1.0)).inner == pytest.approx(1, abs=0.12)
