"""Screens of turbulence have the structure function and the Zernike variances of the theory."""

from math import inf

import numpy as np
import pytest

from zwfs import Pupil, zernike_basis
from zwfs.turbulence import karhunen_loeve_basis, structure_function, turbulent_screens


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


@pytest.mark.parametrize(("n_pixels", "n_modes", "outer_scale"), [(24, 60, inf), (24, 60, 2.0), (28, 15, 2.0)])
def test_karhunen_loeve_modes_are_all_eigenvectors_of_the_covariance(n_pixels, n_modes, outer_scale):
    """Against a dense solution, in which modes of equal variance, such as the two tilts, are all present.

    A single run of Lanczos misses one of the 15 modes.
    """
    pupil = Pupil.circular(n_pixels, 0.2)
    modes, variances = karhunen_loeve_basis(pupil, n_modes, outer_scale)
    values = pupil.gather(modes)
    np.testing.assert_allclose(values @ values.T / pupil.n_points, np.eye(n_modes), atol=1e-10)
    np.testing.assert_allclose(values.mean(axis=1), 0, atol=1e-12)
    apart = pupil.points[:, np.newaxis] - pupil.points
    covariance = -structure_function(np.hypot(*apart.transpose(2, 0, 1)), 1.0, outer_scale) / 2
    covariance -= covariance.mean(axis=0)
    covariance = (covariance - covariance.mean(axis=1, keepdims=True)) / pupil.n_points
    of_modes = values @ covariance @ values.T / pupil.n_points
    np.testing.assert_allclose(of_modes, np.diag(variances), atol=1e-9 * variances[-1])
    np.testing.assert_allclose(variances, np.linalg.eigvalsh(covariance)[::-1][:n_modes], rtol=1e-9)


def test_karhunen_loeve_modes_describe_the_screens_and_more_of_them_than_zernike_modes(pupil, kolmogorov):
    modes, variances = karhunen_loeve_basis(pupil, 20)
    screens = pupil.gather(kolmogorov)
    coefficients = screens @ pupil.gather(modes).T / pupil.n_points
    np.testing.assert_allclose(np.mean(coefficients**2, axis=0), variances, rtol=0.12)
    assert np.abs(np.corrcoef(coefficients.T) - np.eye(20)).max() < 5 / np.sqrt(len(screens))
    # Variance that 2, 5 and 10 Zernike modes do not describe: Noll 1976, table IV.
    apart = pupil.points[:, np.newaxis] - pupil.points
    left = structure_function(np.hypot(*apart.transpose(2, 0, 1))).mean() / 2 - np.cumsum(variances)
    noll = np.array([0.134, 0.0648, 0.0377])
    assert (left[[1, 4, 9]] < 1.01 * noll).all()
    assert (left[[1, 4, 9]] > 0.85 * noll).all()


def test_screens_scale_with_r0_and_the_seed_decides(pupil):
    one, half = (turbulent_screens(pupil, r0, 3, 5.0, seed=4) for r0 in (1.0, 0.5))
    np.testing.assert_allclose(half, one * 2 ** (5 / 6), atol=1e-12)
    np.testing.assert_array_equal(one[:1], turbulent_screens(pupil, 1.0, 1, 5.0, seed=4))
    assert not one[:, ~pupil.inside].any()
    np.testing.assert_allclose(pupil.gather(one).mean(axis=-1), 0, atol=1e-12)


def test_bad_input_is_named(pupil):
    for change in ({"r0": 0}, {"outer_scale": 0.1}, {"n_screens": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(change))} = "):
            turbulent_screens(**{"pupil": pupil, "r0": 0.1, "n_screens": 1} | change)
    for change in ({"n_modes": 0}, {"n_modes": 204}, {"outer_scale": 0.1}):
        with pytest.raises(ValueError, match=f"{next(iter(change))} = "):
            karhunen_loeve_basis(**{"pupil": pupil, "n_modes": 3} | change)
