import numpy as np
import pytest

from studies.bandwidth import IGNORANT, KNOWN, WAYS, band_curves, costs_table, findings
from zwfs import Dimple, Pupil, ZernikeSensor, power_law_screens, zernike_basis


@pytest.fixture(scope="module")
def sensor():
    return ZernikeSensor(Pupil.circular(20), Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))


@pytest.fixture(scope="module")
def screens(sensor):
    return power_law_screens(zernike_basis(sensor.pupil, 30), 0.5, 2, exponent=-2, seed=1)


@pytest.fixture(scope="module")
def curves(sensor, screens):
    return band_curves(sensor, screens, [0.0, 0.1, 0.2], 1e6, chromatic=True)


def test_only_the_method_that_knows_the_band_stays_at_the_bound(curves):
    for way in WAYS:
        ratio = curves.error(way) / curves.bound
        assert ratio[0] == pytest.approx(1, abs=0.1)
        assert (ratio[2] > 2) == (way in IGNORANT)
    assert curves.error(KNOWN)[2] == pytest.approx(curves.bound[2], rel=0.1)


def test_the_bias_grows_with_the_square_of_the_bandwidth(curves):
    for way in IGNORANT:
        assert curves.bias(way)[0] < 1e-6
        assert curves.bias(way)[2] / curves.bias(way)[1] == pytest.approx(4, rel=0.05)


def test_text_names_the_bandwidths_that_were_sampled(curves):
    cases = {(0.5, chromatic): curves for chromatic in (False, True)}
    assert "in a band of 10 %, and" in findings(cases).markdown
    assert "in a band of 20 %." in findings(cases).markdown
    assert costs_table(cases).header[1:3] == ["phase-shifted, 10 %", "phase-shifted, 20 %"]
