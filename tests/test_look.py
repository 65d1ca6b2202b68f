"""One learned solve in a loop: it agrees with the reconstructor that makes it."""

import numpy as np
import pytest

import zwfs
from zwfs.reconstructors.learned import BenchErrors, BenchValues, LearnedReference

PUPIL = zwfs.Pupil.circular(32)


def sensor_of(diameter=1.06, shifts=(np.pi / 2, -np.pi / 2), amplitude=1.0, **options):
    dimples = (zwfs.Dimple(diameter, shift, amplitude) for shift in shifts)
    return zwfs.ZernikeSensor(PUPIL, *dimples, **options)


def absorbing():
    """Training on few screens, for a bench with known errors."""
    sensor = sensor_of(1.2, (2.0, -1.0), 0.9)
    training = LearnedReference.train(sensor, n_screens=1000, errors=BenchErrors(leakage=(0.0, 0.1))).training
    return LearnedReference(sensor, training, bench=BenchValues(0.03, 1.1, 0.0, np.array([0.1, 0.0]), 0.0, 0.0))


def paper():
    return LearnedReference(sensor_of(extent=1.5))


@pytest.mark.parametrize("make", [paper, absorbing])
def test_phase_is_that_of_the_reconstructor(make):
    reconstruct = make()
    look, out = reconstruct.look(), np.empty(PUPIL.shape, np.float32)
    screens = zwfs.power_law_screens(zwfs.zernike_basis(PUPIL, 50), 0.8, 3, seed=1)
    for frames in reconstruct.sensor.measure(screens).astype(np.float32):
        expected = reconstruct(frames)
        assert look(frames, out) is out
        assert np.abs(np.angle(np.exp(1j * (out - expected.phase))))[PUPIL.inside].max() < 3e-5
        assert np.isnan(out[~PUPIL.inside]).all()
        assert look.distance == pytest.approx(float(expected.distance), rel=1e-4)
        np.testing.assert_array_equal(look(frames.tolist()), look(frames.astype(float)))
    assert np.isnan(look(np.full(frames.shape, np.nan))).all()
