"""The model of the camera: its limit, its derivatives and their adjoint."""

import numpy as np
import pytest

from zwfs import Pupil
from zwfs.frames._optics import Camera, Exposure, Linearised, Maps, names_of

N, F, SHAPE = 20, 2, (28, 28)
EXPOSURES = [Exposure(0, 0, 0), Exposure(1, 1, 0), Exposure(2, None, 0), Exposure(0, 0, 1), Exposure(1, 1, 1)]
VALUES = np.array(
    [
        *(3e-4, 0.3, -0.4, 0.01, 1.02, 10, 0.2),
        *(-2e-4, -0.2, 0.6, 0.02, 1.01, 12, 0.1),
        *(0, 0.1, 0.1, 0, 1, 9, 0.1),
        *(1.1, 1.5, -1.4, 0.05, 0.03, 0.7),
    ]
)
SCALE = np.array([1e-4, *[0.1] * 2, 0.01, 0.01, 1, 1] * 3 + [0.1] * 6)
EDGES = np.random.default_rng(4).random((N * F, N * F)) < 0.2  # points that stand for their cells


@pytest.fixture(scope="module")
def camera():
    commands = np.zeros((2, N * F, N * F))
    commands[1] = 0.3 * np.random.default_rng(1).normal(size=commands[1].shape)
    return Camera(N, SHAPE, N, EXPOSURES, commands, F, 1.5)


@pytest.fixture(scope="module")
def maps():
    rng = np.random.default_rng(0)
    inside = Pupil.circular(N * F).amplitude
    mean = inside * (1 + 0.1 * rng.normal(size=inside.shape))
    return Maps(mean, 0.1 * inside * rng.random(inside.shape), 0.4 * rng.normal(size=inside.shape), EDGES)


def test_values_in_the_middle_of_a_point_become_means_over_its_cell():
    values = np.array([*[0, 0, 0, 0, 1, 1, 0] * 3, 1.06, np.pi / 2, -np.pi / 2, 0, 0, 0.0])

    def image(f, means=True):
        # Waves of six pixels on a square pupil whose edges are those of pixels.
        axis = (np.arange(N * f) - (N * f - 1) / 2) / f
        phase = 0.5 * np.sin(np.pi * axis / 3) * np.cos(np.pi * axis[:, None] / 3)
        away = np.maximum(*np.abs(np.meshgrid(axis, axis)))
        lit, edges = (away < 8).astype(float), np.abs(away - 8) < 1 / f
        still = Camera(N, SHAPE, N, EXPOSURES[:3], np.zeros((1, N * f, N * f)), f, 1.5)
        maps = Maps(lit, 0 * lit, phase, edges if means else True)
        return Linearised(still, maps, values).images[0][8:-8, 8:-8]

    true = image(8)
    for f, factor in ((1, 5), (2, 20)):
        corrected, plain = (np.abs(image(f, means) - true).max() for means in (True, False))
        assert corrected < plain / factor


@pytest.mark.parametrize("index", range(len(VALUES)))
def test_derivatives_are_those_of_finite_differences(camera, maps, index):
    name = names_of(len(VALUES))[index]
    step = np.zeros(VALUES.size)
    step[index] = 1e-4 * SCALE[index]
    point = Linearised(camera, maps, VALUES)
    up, down = (Linearised(camera, maps, VALUES + sign * step).images for sign in (1, -1))
    for number, exposure in enumerate(EXPOSURES):
        own = not name.startswith("arm") or int(name.split()[1]) == exposure.arm
        exact = point.slopes(number, [name.split()[-1]])[0] * step[index] if own else 0 * up[number]
        error = np.abs((up[number] - down[number]) / 2 - exact).max()
        assert error <= 1e-5 * max(np.abs(exact).max(), 1e-4)


def test_change_of_the_maps_is_that_of_finite_differences_and_has_an_adjoint(camera, maps):
    rng = np.random.default_rng(3)
    change = rng.normal(size=(3, N * F, N * F))
    point = Linearised(camera, maps, VALUES)
    up, down = (
        Linearised(
            camera,
            Maps(*(one + sign * 1e-6 * two for one, two in zip(maps[:3], change, strict=True)), EDGES),
            VALUES,
        ).images
        for sign in (1, -1)
    )
    applied = point.apply(*change)
    for high, low, exact in zip(up, down, applied, strict=True):
        np.testing.assert_allclose((high - low) / 2e-6, exact, rtol=0, atol=1e-5 * np.abs(exact).max())
    pixels = [rng.normal(size=SHAPE) for _ in EXPOSURES]
    seen = sum(np.vdot(one, two) for one, two in zip(pixels, applied, strict=True))
    back = sum(np.vdot(one, two) for one, two in zip(point.adjoint(pixels)[:3], change, strict=True))
    assert back == pytest.approx(seen, rel=1e-10)
