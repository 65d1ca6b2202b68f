from types import SimpleNamespace

import numpy as np
import pytest

from zwfs import Linear, PhaseShifted, dynamic_range, reconstruction_error
from zwfs.paper.linearity import convergence, linearity_curves, screens_at

RMS = (0.05, 0.3, 0.6)


@pytest.fixture(scope="module")
def methods(classic, shifted, modes):
    return {"linear": Linear(classic, modes), "shifted": PhaseShifted(shifted)}


@pytest.fixture(scope="module")
def curves(methods, modes):
    return linearity_curves(methods, modes, RMS, 4, seed=7)


def test_errors_are_those_of_each_screen(curves, methods, modes, pupil, classic):
    screens = screens_at(modes, 0.3, 4, seed=7, task=1)
    np.testing.assert_allclose(pupil.rms(screens), 0.3)
    found = methods["linear"](classic.measure(screens))
    np.testing.assert_allclose(curves.errors["linear"][1], reconstruction_error(pupil, found.phase, screens))
    assert curves.converged["shifted"].shape == (3, 4)
    np.testing.assert_allclose(curves.mean("linear"), curves.errors["linear"].mean(axis=1))
    np.testing.assert_allclose(curves.std("linear"), curves.errors["linear"].std(axis=1))


def test_linear_leaves_its_range_before_the_phase_shifted(curves):
    assert 0 < curves.dynamic_range("linear") < 0.3
    assert curves.dynamic_range("shifted") == np.inf
    assert curves.dynamic_range("linear") == dynamic_range(RMS, curves.mean("linear"))
    assert np.all(np.diff(curves.mean("linear")) > 0)


def test_a_point_depends_on_the_seed_and_its_place_only(curves, methods, modes):
    alone = linearity_curves({"linear": methods["linear"]}, modes, RMS[:2], 4, seed=7)
    np.testing.assert_allclose(alone.errors["linear"], curves.errors["linear"][:2], rtol=1e-9)
    other = linearity_curves({"linear": methods["linear"]}, modes, RMS[:2], 4, seed=8)
    assert not np.allclose(alone.errors["linear"], other.errors["linear"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reconstructors": {}}, "reconstructors is empty"),
        ({"n_screens": 0}, "n_screens = 0"),
        ({"rms": [0.1, -0.1]}, "rms"),
        ({"rms": 0.1}, "rms"),
        ({"rms": []}, r"rms has shape \(0,\): expected \(n_rms,\), at least one"),
    ],
)
def test_bad_input_is_named(methods, modes, change, message):
    with pytest.raises(ValueError, match=message):
        linearity_curves(**({"reconstructors": methods, "modes": modes, "rms": RMS, "n_screens": 1} | change))


def test_shares_of_the_screens_are_counted(curves, modes, pupil):
    for task, rms in enumerate(RMS):
        phase = pupil.gather(screens_at(modes, rms, 4, seed=7, task=task))
        np.testing.assert_allclose(curves.folded[task], np.mean(phase < -np.pi / 4, axis=1))
        np.testing.assert_allclose(curves.wrapped[task], np.mean(np.abs(phase) > np.pi, axis=1))
        np.testing.assert_allclose(curves.strehl[task], np.abs(np.exp(1j * phase).mean(axis=1)) ** 2)
    assert curves.folded[-1].min() > 0


def test_recovered_is_the_share_of_good_screens(curves):
    np.testing.assert_array_equal(curves.recovered("shifted"), 1)
    np.testing.assert_array_equal(curves.recovered("linear")[1:], 0)
    middle = np.median(curves.errors["linear"][0] / RMS[0])
    assert curves.recovered("linear", middle)[0] == 0.5


def test_convergence_goes_from_the_input_to_the_result(methods, modes, pupil, shifted):
    error = convergence(methods["shifted"], modes, 0.3, 2, seed=7)
    assert error.shape == (2, 26)
    np.testing.assert_allclose(error[:, 0], 0.3, rtol=1e-3)
    screens = screens_at(modes, 0.3, 2, seed=7, task=0)
    found = methods["shifted"](shifted.measure(screens))
    np.testing.assert_allclose(error[:, -1], reconstruction_error(pupil, found.phase, screens), atol=1e-12)
    assert np.all(error[:, -1] < 1e-6)


def test_wraps_on_both_sides_are_counted(methods, modes, pupil):
    curve = linearity_curves({"linear": methods["linear"]}, modes, [2.0], 3, seed=7)
    phase = pupil.gather(screens_at(modes, 2.0, 3, seed=7, task=0))
    above, below = np.mean(phase > np.pi, axis=1), np.mean(phase <= -np.pi, axis=1)
    assert np.all(above > 0.01)
    assert np.all(below > 0.01)
    np.testing.assert_allclose(curve.wrapped[0], above + below)


def test_an_unknown_reconstructor_is_named(curves):
    for method in (curves.mean, curves.std, curves.recovered, curves.dynamic_range):
        with pytest.raises(ValueError, match=r"name = 'nobody': expected one of \['linear', 'shifted'\]"):
            method("nobody")


class FirstOrder:
    """A reconstructor of a reader, for one mask: first order in the phase, with the reference wave of no phase."""

    def __init__(self, sensor):
        self.sensor, field = sensor, sensor.pupil.amplitude.astype(complex)
        self.flat = sensor.measure(np.zeros(sensor.pupil.shape))[0]
        slope = 2 * np.real(sensor.reference_wave(field)[0].conj() * 1j * field)
        self.gain = np.where(sensor.pupil.inside, 1, 0) / np.where(sensor.pupil.inside, slope, 1)

    def __call__(self, frames):
        phase = (frames[..., 0, :, :] - self.flat) * self.gain
        return SimpleNamespace(phase=phase, converged=np.ones(phase.shape[:-2], bool))


def test_a_reconstructor_of_a_reader_stands_next_to_the_others(classic, modes):
    """It has a sensor, and is called on frames; its result has a phase and says whether it converged."""
    methods = {"FirstOrder": FirstOrder(classic), "Linear": Linear(classic, modes)}
    curves = linearity_curves(methods, modes, np.array([0.0, 0.01]), 2)
    assert curves.mean("FirstOrder")[0] < 1e-12
    assert curves.mean("Linear")[1] < curves.mean("FirstOrder")[1] < 0.01
