import numpy as np
import pytest

from zwfs import Dimple, Patch


def test_dimple_is_uniform():
    u = np.linspace(-0.5, 0.5, 6).reshape(2, 3)
    np.testing.assert_allclose(Dimple(1.06, 0.3, 0.9).transmission(u, u), np.full((2, 3), 0.9 * np.exp(0.3j)))


def test_patch_is_its_function_of_u_and_v():
    u, v = np.array([0.1, 0.2]), np.array([0.3, -0.4])
    np.testing.assert_allclose(
        Patch(2, lambda u, v: np.exp(1j * (u + 10 * v))).transmission(u, v), np.exp([3.1j, -3.8j])
    )
    np.testing.assert_array_equal(Patch(2, lambda u, v: 0.5).transmission(u, v), [0.5, 0.5])


def test_phases_of_a_full_turn_are_accepted():
    for phase in (2 * np.pi, -2 * np.pi, 6.2832):  # rounded, as in the limits of the notebooks
        assert Dimple(1.06, phase).phase == phase


def test_a_function_that_works_in_place_moves_no_node():
    u = np.array([0.1, 0.2])

    def moved(u, v):
        u -= 0.1
        return np.exp(1j * u)

    np.testing.assert_allclose(Patch(2, moved).transmission(u, u), np.exp(1j * (u - 0.1)))
    np.testing.assert_array_equal(u, [0.1, 0.2])


def test_coordinates_broadcast():
    for mask in (Dimple(1, 1), Patch(1, lambda u, v: 1j)):
        assert mask.transmission(np.zeros((1, 3)), np.zeros((2, 1))).shape == (2, 3)
        with pytest.raises(ValueError, match=r"u and v have shapes \(2,\) and \(3,\)"):
            mask.transmission(np.zeros(2), np.zeros(3))


def test_breaks_are_sorted():
    assert Patch(3, lambda u, v: 1, breaks=[2, 1]).breaks == (1, 2)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Dimple(0, 1), ValueError, r"diameter = 0: .*\(0, inf"),
        (lambda: Dimple(1, 1, 1.01), ValueError, r"amplitude = 1\.01: .*\[0, 1\]"),
        (lambda: Dimple(1, 1, -0.1), ValueError, r"amplitude = -0\.1"),
        (lambda: Patch(0, lambda u, v: 1), ValueError, "diameter = 0"),
        (lambda: Patch(1, lambda u, v: 1, breaks=[1]), ValueError, r"breaks\[0\] = 1: .*\(0, 1\)"),
        (lambda: Patch(1, lambda u, v: 1, n_samples=-2), ValueError, "n_samples = -2"),
        (lambda: Patch(1, lambda u, v: 1, n_samples=10**9), ValueError, "n_samples = 1000000000"),
        (lambda: Dimple(1.06, 90), ValueError, "phase = 90: expected radian.*degrees"),
        (lambda: Dimple(1.06, -7.0), ValueError, r"phase = -7\.0: expected radian"),
    ],
)
def test_bad_input_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda u, v: 1.1 + 0 * u, ValueError, r"transmission reaches a modulus of 1\.1: expected at most 1"),
        (lambda u, v: np.nan * u, ValueError, "transmission holds 2 NaN"),
        (lambda u, v: "glass", TypeError, "transmission has dtype"),
        (lambda u, v: np.ones(3), ValueError, r"transmission has shape \(3,\): expected \(2,\)"),
    ],
)
def test_bad_transmission_is_named(function, error, message):
    with pytest.raises(error, match=message):
        Patch(1, function).transmission(np.zeros(2), np.zeros(2))
