"""Phase and amplitude from two masks and a clear frame."""

from dataclasses import replace

import numpy as np
import pytest

import zwfs
from studies.phase_amplitude import (
    KINDS,
    WAYS,
    amplitude_curves,
    amplitude_maps,
    costs_table,
    findings,
    reconstruct,
)

PUPIL = zwfs.Pupil.circular(24)
MODES = zwfs.zernike_basis(PUPIL, 30)
PAIR = [zwfs.Dimple(1.06, sign * np.pi / 2) for sign in (1, -1)]
SENSOR = zwfs.ZernikeSensor(PUPIL, *PAIR, zwfs.Dimple(1, 0))
IGNORED, MEASURED, ESTIMATED = (f"MaximumLikelihood, {word}" for word in ("ignored", "measured", "estimated"))
PHOTONS = 1000.0


@pytest.fixture(scope="module")
def curves():
    return amplitude_curves(SENSOR, MODES, [0.0, 0.05, 0.2], 0.5, 4, PHOTONS, seed=1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("variation", [0.0, 0.05, 0.4])
def test_amplitudes_have_the_stated_variation_and_a_mean_square_of_one(kind, variation):
    amplitudes = PUPIL.gather(amplitude_maps(PUPIL, MODES, kind, variation, 3, seed=2))
    assert amplitudes.std(axis=1) / amplitudes.mean(axis=1) == pytest.approx(variation, abs=1e-9)
    assert np.mean(amplitudes**2, axis=1) == pytest.approx(1)
    assert np.all(amplitudes > 0)


def test_dips_are_dark_spots_and_scintillation_is_bright_and_dark():
    skewness = {}
    for kind in KINDS:
        amplitudes = PUPIL.gather(amplitude_maps(PUPIL, MODES, kind, 0.2, 8, seed=3))
        centred = amplitudes - amplitudes.mean(axis=1, keepdims=True)
        skewness[kind] = np.mean(centred**3) / np.mean(centred**2) ** 1.5
    assert skewness["dips"] < -0.5 < 0 < skewness["scintillation"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_joint_estimate_reaches_the_bound_and_is_consistent(curves, kind):
    one = curves[kind]
    assert one.error(ESTIMATED) / one.bound == pytest.approx(1, abs=0.08)
    assert np.all(one.consistent[ESTIMATED])


@pytest.mark.parametrize("kind", KINDS)
def test_an_ignored_amplitude_is_wrong_and_called_inconsistent(curves, kind):
    one = curves[kind]
    for way in (IGNORED, "PhaseShifted, ignored"):
        assert np.all(np.diff(one.error(way)) > 0)
        assert one.error(way)[-1] > 4 * one.bound[-1]
    assert np.all(one.consistent[IGNORED][0])  # the amplitude is uniform indeed
    assert not np.any(one.consistent[IGNORED][1:])


@pytest.mark.parametrize("kind", KINDS)
def test_a_measured_amplitude_costs_little_but_spoils_the_verdict(curves, kind):
    one = curves[kind]
    assert np.all(one.error(MEASURED) < 1.2 * one.bound)
    assert np.all(one.error(MEASURED) > one.error(ESTIMATED))
    assert not np.any(one.consistent[MEASURED])


def test_the_error_of_an_ignored_amplitude_is_a_fixed_share_of_a_small_phase():
    # To first order an amplitude error d changes the phase by d sin(phi) / |beta|.
    amplitude = amplitude_maps(PUPIL, MODES, "dips", 0.02, 1, seed=5)[0]
    screen = zwfs.power_law_screens(MODES, 1.0, 1, seed=5)[0]
    shares = []
    for rms in (0.05, 0.1):
        frames = SENSOR.measure(rms * screen, amplitude)[np.newaxis]
        [result] = reconstruct("PhaseShifted, ignored", SENSOR, frames, PHOTONS)
        shares.append(zwfs.reconstruction_error(PUPIL, result.phase[0], rms * screen) / rms)
    assert shares[0] == pytest.approx(shares[1], rel=0.05)
    assert 0.5 < shares[0] / (2 * 0.02) < 2


def test_curves_do_not_depend_on_the_other_variations(curves):
    alone = amplitude_curves(SENSOR, MODES, [0.0, 0.05], 0.5, 4, PHOTONS, seed=1)
    for kind in KINDS:
        for way in WAYS:
            assert np.array_equal(alone[kind].errors[way], curves[kind].errors[way][:2])


def test_text_names_the_variations_that_were_sampled(curves):
    sampled = {kind: replace(one, variations=np.array([0.0, 0.1, 0.3])) for kind, one in curves.items()}
    assert "variation of 10 % is ignored" in findings(sampled, 0.5, PHOTONS).markdown
    assert costs_table(sampled).header[2:4] == ["scintillation, 10 %", "scintillation, 30 %"]
