import numpy as np
import pytest

from zwfs import Detector, Dimple, ZernikeSensor

N_FRAMES = 400


@pytest.fixture(scope="module")
def flat(pupil):
    """Frames of the pupil with the mask taken out."""
    return np.broadcast_to(pupil.inside.astype(float), (N_FRAMES, *pupil.shape))


def test_photons_are_those_of_the_pupil_without_a_mask(pupil, flat):
    detector = Detector(1e5 / pupil.n_points)
    assert detector.expose(flat, seed=1).sum(axis=(-2, -1)).mean() == pytest.approx(1e5, rel=1e-3)
    no_mask = ZernikeSensor(pupil, Dimple(1.06, 0)).measure(np.zeros(pupil.shape))
    np.testing.assert_allclose(no_mask, pupil.inside[np.newaxis], atol=1e-12)


def test_photon_noise_is_poissonian(pupil, flat):
    detector = Detector(7.0)
    counts = detector.expose(flat, seed=1)
    inside = counts[:, pupil.inside]
    assert inside.mean() == pytest.approx(7, rel=0.01)
    assert inside.var() == pytest.approx(7, rel=0.01)
    assert not np.any(inside % 1)
    assert not counts[:, ~pupil.inside].any()


def test_background_has_photon_noise_and_adds_to_read_noise(pupil, flat):
    dark = Detector(1.0, background=5, read_noise=3).expose(0 * flat, seed=2)
    assert dark.mean() == pytest.approx(5, rel=0.01)
    assert dark.var() == pytest.approx(5 + 3**2, rel=0.01)
    assert dark.min() < 0  # read noise is not cut off


def test_normalise_undoes_expose(pupil):
    frames = np.random.default_rng(0).uniform(0, 4, (2, 3, *pupil.shape))
    detector = Detector(1e12, background=1e11)
    np.testing.assert_allclose(detector.normalise(detector.expose(frames, 1)), frames, atol=2e-5)
    np.testing.assert_array_equal(Detector(1.0, background=2).normalise([0.0, 3]), [-2, 1])
