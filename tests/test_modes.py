import numpy as np
import pytest
from scipy.special import eval_jacobi

from zwfs import Pupil, noll_to_nm, power_law_screens, zernike_basis
from zwfs.modes import fourier_basis, mode_frequencies


def test_noll_numbering_reaches_every_mode_once():
    orders = [noll_to_nm(j) for j in range(1, 2017)]  # 63 full radial orders
    assert sorted(orders) == sorted((n, m) for n in range(63) for m in range(-n, n + 1, 2))
    assert [(n, abs(m)) for n, m in orders] == sorted((n, abs(m)) for n, m in orders)
    assert all(m == 0 or (m > 0) == (j % 2 == 0) for j, (_, m) in enumerate(orders, start=1))


@pytest.mark.parametrize("pupil", [Pupil.circular(60), Pupil.circular(60, 0.3, [(1, 0.03)]), Pupil.hexagonal(60)])
@pytest.mark.parametrize("orthonormal", [False, True])
def test_zero_mean_and_unit_rms_on_the_sampled_pupil(pupil, orthonormal):
    modes = zernike_basis(pupil, 50, orthonormal=orthonormal)
    values = pupil.gather(modes)
    np.testing.assert_allclose(values.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(values.std(axis=1), 1, atol=1e-12)
    assert not modes[:, ~pupil.inside].any()


@pytest.mark.parametrize("pupil", [Pupil.circular(60), Pupil.circular(60, 0.3, [(1, 0.03)])])
def test_orthonormal_on_request_and_on_a_measured_pupil(pupil):
    plain = pupil.gather(zernike_basis(pupil, 60))
    values = pupil.gather(zernike_basis(pupil, 60, orthonormal=True))
    np.testing.assert_allclose(values @ values.T / pupil.n_points, np.eye(60), atol=1e-10)
    measured = Pupil.from_amplitude(pupil.amplitude)
    np.testing.assert_array_equal(zernike_basis(measured, 60), zernike_basis(pupil, 60, orthonormal=True))
    # Gram-Schmidt in Noll's order keeps the span of the first modes, and the sign of each.
    np.testing.assert_allclose(np.linalg.lstsq(values[:9].T, plain[:9].T)[1], 0, atol=1e-18 * pupil.n_points)
    assert np.all(np.einsum("ij,ij->i", values, plain) > 0)


def test_1500_modes_are_accurate():
    pupil = Pupil.circular(64)
    values = pupil.gather(zernike_basis(pupil, 1500))
    x, y = pupil.points.T
    radius, theta = 2 * np.hypot(x, y), np.arctan2(y, x)
    for j in (*range(2, 37), 100, 777, 1377, 1431, 1490, 1501):
        n, m = noll_to_nm(j)
        angular = np.cos(m * theta) if m >= 0 else np.sin(-m * theta)
        exact = radius ** abs(m) * eval_jacobi((n - abs(m)) // 2, 0, abs(m), 2 * radius**2 - 1) * angular
        exact -= exact.mean()
        np.testing.assert_allclose(values[j - 2], exact / exact.std(), atol=1e-9)
    assert np.isfinite(values).all()


def test_every_screen_has_exactly_the_rms_asked_for(pupil, modes):
    for rms in (0, 0.7):
        np.testing.assert_allclose(pupil.rms(power_law_screens(modes, rms, 20, seed=0)), rms, rtol=1e-12)
    single = power_law_screens(modes.astype(np.float32), 0.7, 5, seed=0)
    assert single.dtype == np.float32
    np.testing.assert_allclose(pupil.rms(single), 0.7, rtol=1e-5)


def test_fewer_screens_are_the_first_of_more(modes):
    few, many = (power_law_screens(modes, 1, n, seed=3) for n in (2, 7))
    np.testing.assert_allclose(few, many[:2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("exponent", [-2.0, -11 / 3])
def test_variance_of_the_coefficients_follows_the_power_law(exponent):
    pupil = Pupil.circular(40)
    modes = zernike_basis(pupil, 65, orthonormal=True)  # radial orders 1 to 10
    screens = power_law_screens(modes, 1, 3000, exponent, seed=2)
    coefficients = pupil.gather(screens) @ pupil.gather(modes).T / pupil.n_points
    orders = np.array([noll_to_nm(j)[0] for j in range(2, 67)])
    # The logarithm turns the scaling of each screen into an offset that all its modes share.
    level = np.log(coefficients**2).mean(axis=0)
    assert np.polyfit(np.log(orders), level, 1)[0] == pytest.approx(exponent, abs=0.03)


@pytest.mark.parametrize("exponent", [-2.0, -11 / 3])
def test_variance_of_other_modes_follows_their_frequency(exponent):
    pupil = Pupil.from_amplitude(np.ones((48, 48)))  # where whole cycles are orthogonal
    modes = fourier_basis(pupil, 120)
    frequencies = mode_frequencies(pupil, modes)
    screens = power_law_screens(modes, 1, 2000, exponent, seed=2, frequencies=frequencies)
    coefficients = pupil.gather(screens) @ pupil.gather(modes).T / pupil.n_points
    level = np.log(coefficients**2).mean(axis=0)
    assert np.polyfit(np.log(frequencies), level, 1)[0] == pytest.approx(exponent, abs=0.05)


@pytest.mark.parametrize("orthonormal", [False, True])
@pytest.mark.parametrize("n_modes", [1, 2, 4, 30])
def test_zernike_modes_on_any_pupil_are_known(orthonormal, n_modes):
    pupil = Pupil.hexagonal(40, n_rings=2, gap=0.02, missing=[1, 9])
    modes = zernike_basis(pupil, n_modes, orthonormal=orthonormal).astype(np.float32)
    assert np.isfinite(power_law_screens(modes, 1, 1, seed=1)).all()


def test_fourier_modes_are_cosine_and_sine_of_every_frequency_by_growing_frequency():
    """On a square of whole cycles, where the Fourier transform of a mode is a line at its frequency."""
    pupil = Pupil.from_amplitude(np.ones((24, 24)))
    modes = fourier_basis(pupil, 68)
    power = np.abs(np.fft.fft2(modes)).reshape(68, -1) ** 2
    lines = (power > 0.4 * power.sum(axis=1, keepdims=True)).argmax(axis=1)
    cycles = np.fft.fftfreq(24, 1 / 24)
    frequencies = np.hypot(cycles[:, np.newaxis], cycles).ravel()
    np.testing.assert_allclose(frequencies[lines], np.sort(frequencies)[1:69])
    np.testing.assert_array_equal(lines[::2], lines[1::2])
    assert len(set(lines)) == 34
    # Even and odd about the middle of the pupil.
    np.testing.assert_allclose(modes[::2], modes[::2, ::-1, ::-1], atol=1e-9)
    np.testing.assert_allclose(modes[1::2], -modes[1::2, ::-1, ::-1], atol=1e-9)


@pytest.mark.parametrize(
    "basis", [fourier_basis, lambda p, n: zernike_basis(p, n)[::-1], lambda p, n: zernike_basis(p, n + 3)[3:]]
)
def test_modes_of_unknown_order_are_refused(pupil, basis):
    modes = basis(pupil, 20)
    with pytest.raises(ValueError, match="expected their frequencies"):
        power_law_screens(modes, 1, 1)
    with pytest.raises(ValueError, match="20 positive numbers"):
        power_law_screens(modes, 1, 1, frequencies=np.ones(19))
    power_law_screens(modes, 1, 1, frequencies=mode_frequencies(pupil, modes))


def test_noll_is_exact_for_large_numbers():
    for n in (10**8, 2**31):
        first = n * (n + 1) // 2 + 1  # of radial order n
        assert noll_to_nm(first)[0] == n
        assert noll_to_nm(first - 1)[0] == n - 1
