import numpy as np
import pytest

from zwfs import Detector, Dimple, ZernikeSensor

N_FRAMES = 400


@pytest.fixture(scope="module")
def flat(pupil):
    """Frames of the pupil with the mask taken out."""
    return np.broadcast_to(pupil.inside.astype(float), (N_FRAMES, *pupil.shape))


def test_photons_are_those_of_the_pupil_without_a_mask(pupil, flat):
    detector = Detector(1e5 / pupil.n_points, photon_noise=False)
    np.testing.assert_allclose(detector.expose(flat).sum(axis=(-2, -1)), 1e5)
    no_mask = ZernikeSensor(pupil, Dimple(1.06, 0)).measure(np.zeros(pupil.shape))
    assert detector.expose(no_mask).sum() == pytest.approx(1e5)


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


def test_noise_of_neighbouring_pixels_is_independent(pupil, flat):
    counts = Detector(1.0, background=50).expose(0 * flat, seed=4)
    assert abs(np.corrcoef(counts[..., :-1].ravel(), counts[..., 1:].ravel())[0, 1]) < 0.01


def test_full_well_saturates(pupil):
    detector = Detector(1.0, photon_noise=False, full_well=2.5)
    counts = detector.expose([0.0, 2.4, 2.5, 9.0])
    np.testing.assert_allclose(counts, [0, 2.4, 2.5, 2.5])
    np.testing.assert_array_equal(detector.saturated(counts), [False, False, True, True])


def test_saturation_is_seen_in_counts(pupil):
    detector = Detector(1.0, photon_noise=False, full_well=100, gain=8.0)
    np.testing.assert_array_equal(detector.saturated(detector.expose([80.0, 101, 500])), [False, True, True])
    assert not Detector(1.0, gain=8.0).saturated([1e9])


def test_gain_rounds_to_whole_counts(pupil):
    detector = Detector(1.0, photon_noise=False, gain=4.0)
    np.testing.assert_array_equal(detector.expose([0.0, 1.9, 2.1, 4.0, 9.9]), [0, 0, 1, 1, 2])


def test_normalise_undoes_expose(pupil):
    frames = np.random.default_rng(0).uniform(0, 4, (2, 3, *pupil.shape))
    detector = Detector(1e3, photon_noise=False, background=11)
    np.testing.assert_allclose(detector.normalise(detector.expose(frames)), frames, atol=1e-12)
    coarse = Detector(1e3, photon_noise=False, background=11, gain=5)
    error = coarse.normalise(coarse.expose(frames)) - frames
    assert np.abs(error).max() <= 2.5 / coarse.photons * (1 + 1e-9)


def test_floor_is_applied_only_on_request(pupil):
    detector = Detector(1.0, background=2)
    np.testing.assert_array_equal(detector.normalise([0.0, 3]), [-2, 1])
    np.testing.assert_array_equal(detector.normalise([0.0, 3], floor=0), [0, 1])


def test_seed_decides_the_noise(pupil, flat):
    state = np.random.get_state()[1].copy()
    detector = Detector(10, read_noise=1)
    first = detector.expose(flat[:2], seed=3)
    np.testing.assert_array_equal(first, detector.expose(flat[:2], seed=np.random.default_rng(3)))
    assert np.any(first != detector.expose(flat[:2], seed=4))
    np.testing.assert_array_equal(state, np.random.get_state()[1])


def test_a_single_pixel_may_be_exposed():
    counts = Detector(1e6).expose(1.0, seed=1)
    assert counts.shape == ()
    assert counts == Detector(1e6).expose([1.0], seed=1)[0]
