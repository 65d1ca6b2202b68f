import numpy as np
import pytest

from studies.kit.methods import paper_reconstructors
from studies.photon_noise import EXPECTED, SIGMAS, photon_curves

PHOTONS = [100.0, 1e4]
ONE = int(np.flatnonzero(SIGMAS == 1)[0])


@pytest.fixture(scope="module")
def methods(pupil, modes):
    return paper_reconstructors(pupil, modes, 1.06, np.pi / 2)


@pytest.fixture(scope="module")
def curves(shifted, methods, modes):
    others = {name: methods[name] for name in ("Arcsine", "PhaseShifted")}
    return photon_curves(shifted, others, modes, [0.05, 0.5], PHOTONS, 3, seed=4)


def test_maximum_likelihood_reaches_the_bound(curves):
    np.testing.assert_allclose(curves.ratio("MaximumLikelihood"), 1, atol=0.06)


def test_equal_weights_cost_photons_on_an_aberrated_wavefront(curves):
    shifted, likely = curves.ratio("PhaseShifted"), curves.ratio("MaximumLikelihood")
    assert np.all(shifted[1] > likely[1] + 0.02)
    assert np.all(shifted < 1.3)


def test_photons_do_not_reduce_a_systematic_error(curves):
    arcsine = curves.error("Arcsine")[1]
    assert arcsine[1] > 5 * curves.bound[1, 1].max()
    assert curves.error("MaximumLikelihood")[1, 1] < 0.2 * arcsine[1]


def test_68_percent_are_within_one_sigma(curves):
    np.testing.assert_allclose(curves.within, EXPECTED[ONE], atol=0.03)
