import numpy as np
import pytest

from zwfs import Dimple, Pupil, ZernikeSensor, opd_to_phase, phase_to_opd
from zwfs.masks import focal_field


@pytest.mark.parametrize("wavelength", [500.0, 1650.0])
def test_one_wave_is_two_pi(wavelength):
    np.testing.assert_allclose(
        phase_to_opd([2 * np.pi, np.nan, -np.pi], wavelength), [wavelength, np.nan, -wavelength / 2]
    )
    phase = np.linspace(-9, 9, 20).reshape(4, 5)
    np.testing.assert_allclose(opd_to_phase(phase_to_opd(phase, wavelength), wavelength), phase)


def test_image_of_the_positive_mask_is_brighter_where_the_phase_is_positive():
    pupil = Pupil.circular(60)
    y, x = (np.mgrid[:60, :60] - 29.5) / 60
    poke = 0.3 * np.exp(-((x - 0.2) ** 2 + (y + 0.1) ** 2) / 0.05**2)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))
    change = sensor.measure(poke) - sensor.measure(np.zeros(pupil.shape))
    assert change[0][poke > 0.25].min() > 0.1
    assert change[1][poke > 0.25].max() < -0.1


def test_phase_that_grows_to_the_right_moves_the_focus_to_the_right():
    pupil = Pupil.circular(60)
    u = v = np.linspace(-3, 3, 61)
    tilted = np.exp(2j * np.pi * (1.5 * pupil.x - 0.5 * pupil.y[:, np.newaxis]))
    row, column = np.unravel_index(np.argmax(np.abs(focal_field(pupil, tilted, u, v))), (61, 61))
    assert (u[column], v[row]) == pytest.approx((1.5, -0.5))
