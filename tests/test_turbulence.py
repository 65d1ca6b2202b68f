"""Screens of turbulence have the structure function and the Zernike variances of the theory."""

from math import inf

import numpy as np
import pytest

from zwfs import Pupil, zernike_basis
from zwfs.turbulence import FrozenFlow, structure_function, turbulent_screens


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(32)


@pytest.fixture(scope="module")
def kolmogorov(pupil):
    return turbulent_screens(pupil, r0=1.0, n_screens=3000, seed=1)


def test_kolmogorov_is_the_limit_of_a_large_outer_scale():
    separation = np.array([0.0, 0.01, 0.3, 1.0])
    expected = 6.88388 * (separation / 0.2) ** (5 / 3)
    np.testing.assert_allclose(structure_function(separation, 0.2), expected, rtol=1e-5)
    near = separation < 0.1
    np.testing.assert_allclose(structure_function(separation[near], 0.2, 1e5), expected[near], rtol=1e-2)


def test_an_outer_scale_saturates_at_twice_the_variance():
    # The integral of 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) over the plane is 0.0229 (6 pi / 5) (L0 / r0)^(5/3).
    variance = 0.022896 * 6 * np.pi / 5 * 4 ** (5 / 3)
    assert structure_function(100.0, 0.5, 2.0) == pytest.approx(2 * variance, rel=1e-4)


@pytest.mark.parametrize("outer_scale", [inf, 20.0, 0.6])
def test_structure_function_of_the_screens(pupil, outer_scale):
    """At every separation, up to the whole diameter, along axes and diagonals."""
    screens = turbulent_screens(pupil, 0.3, 2000, outer_scale, seed=2)
    screens = np.where(pupil.inside, screens, np.nan)
    for dy, dx in [(0, 1), (1, 1), (0, 5), (8, 8), (16, 0), (20, 18), (0, 30)]:
        difference = screens[:, dy:, dx:] - screens[:, : 32 - dy, : 32 - dx]
        expected = structure_function(np.hypot(dy, dx) / 32, 0.3, outer_scale)
        assert np.nanmean(difference**2) == pytest.approx(expected, rel=0.08)


def test_variances_of_noll(pupil, kolmogorov):
    """Noll 1976, tables I and IV, for D / r0 = 1; the standard error of a variance is 2.6 %."""
    assert np.mean(pupil.rms(kolmogorov) ** 2) == pytest.approx(1.0299, rel=0.06)
    modes = pupil.gather(zernike_basis(pupil, 20, orthonormal=True))
    coefficients = pupil.gather(kolmogorov) @ modes.T / pupil.n_points
    variances = np.var(coefficients, axis=0)
    np.testing.assert_allclose(variances[:2], 0.448, rtol=0.1)
    np.testing.assert_allclose(variances[2:5], 0.0232, rtol=0.1)
    residuals = np.mean(pupil.rms(kolmogorov) ** 2) - np.cumsum(np.mean(coefficients**2, axis=0))
    np.testing.assert_allclose(residuals[[1, 2, 4, 9]], [0.134, 0.111, 0.0648, 0.0401], rtol=0.06)


def test_screens_are_independent_of_each_other(pupil, kolmogorov):
    """Two screens come from one transform: the tilts, which are added, and all other modes."""
    modes = pupil.gather(zernike_basis(pupil, 10))
    coefficients = pupil.gather(kolmogorov) @ modes.T
    for first, second in ((coefficients[::2], coefficients[1::2]), (coefficients[1:-1:2], coefficients[2::2])):
        between = np.corrcoef(first, second, rowvar=False)[:10, 10:]
        assert np.abs(between).max() < 4.5 / np.sqrt(len(first))


def test_screens_scale_with_r0_and_the_seed_decides(pupil):
    whole, half = (turbulent_screens(pupil, r0, 3, 5.0, seed=4) for r0 in (1.0, 0.5))
    np.testing.assert_allclose(half, whole * 2 ** (5 / 6), atol=1e-12)
    np.testing.assert_array_equal(whole[:1], turbulent_screens(pupil, 1.0, 1, 5.0, seed=4))
    assert not whole[:, ~pupil.inside].any()
    np.testing.assert_allclose(pupil.gather(whole).mean(axis=-1), 0, atol=1e-12)


def test_moving_screens_have_the_rms_asked_for_at_the_start_and_no_piston():
    pupil = Pupil.circular(32)
    screens = FrozenFlow(pupil, 0.8, 5, seed=1)(0.0)
    np.testing.assert_allclose(pupil.rms(screens), 0.8)
    np.testing.assert_allclose(pupil.gather(screens).mean(axis=-1), 0, atol=1e-12)
    assert not screens[:, ~pupil.inside].any()


def test_screens_move_with_the_wind():
    pupil = Pupil.circular(128)
    flow = FrozenFlow(pupil, 1.0, 3, speed=2.0, cutoff=1.0, seed=2)
    step, now, middle = 1e-4, 0.3, np.s_[:, 40:-40, 40:-40]
    change = (flow(now + step) - flow(now - step)) / (2 * step)
    slope = np.stack(np.gradient(flow(now), 1 / pupil.n_pixels, axis=(1, 2)), axis=-1)
    expected = -np.einsum("kyxi,ki->kyx", slope, flow.velocity)
    np.testing.assert_allclose(np.hypot(*flow.velocity.T), 2.0)
    # The piston that is taken out of each screen changes with time, too.
    difference = change[middle] - expected[middle]
    difference -= difference.mean(axis=(1, 2), keepdims=True)
    assert np.abs(difference).max() < 2e-3 * np.abs(change).max()


@pytest.mark.parametrize("exponent", [-4.0, -2.0, 0.0])
def test_the_power_falls_with_the_exponent(exponent):
    whole = Pupil.from_amplitude(np.ones((36, 36)), n_pixels=12)  # 3 D: the screens repeat after that
    screens = FrozenFlow(whole, 1.0, 200, cutoff=4.0, exponent=exponent, seed=6)(0.0)
    power = np.mean(np.abs(np.fft.fft2(screens)) ** 2, axis=0)
    lines = np.fft.fftfreq(36, 1 / 12)
    frequency = np.hypot(lines[:, np.newaxis], lines)
    used = (frequency > 0) & (frequency <= 4.0)
    slope = np.polyfit(np.log(frequency[used]), np.log(power[used]), 1)[0]
    assert slope == pytest.approx(exponent, abs=0.1)
    assert power[frequency > 4.01].max() < 1e-20 * power.max()
