"""Costs of sensors with masks in the focal plane: derivatives, brute force, other packages, published values."""

import numpy as np
import pytest

import zwfs
from studies import sensors as study
from studies.sensors import (
    DimpleSensor,
    FilterSensor,
    SensorCurves,
    compared_sensors,
    edges,
    fit_error,
    frames_and_slopes,
    mode_variances,
    quadrants,
)

HALF = np.pi / 2


@pytest.fixture(scope="module")
def pupil():
    return zwfs.Pupil.circular(16)


@pytest.fixture(scope="module")
def modes(pupil):
    return zwfs.zernike_basis(pupil, 12, orthonormal=True)


@pytest.fixture(scope="module")
def phase(modes):
    return zwfs.power_law_screens(modes, 0.7, 1, seed=3)[0]


def vortex(u, v):
    """A mask that is complex everywhere and absorbs light."""
    return np.exp(1j * np.arctan2(v, u)) * np.exp(-(u**2 + v**2) / 50)


def every_kind(pupil):
    return [
        *compared_sensors(pupil, (1.06, HALF), (2.0, 2.2), 2.0, 5, 3),
        FilterSensor("vortex", "", pupil, 3, [vortex]),
    ]


def exact(sensor, phase, modes):
    return frames_and_slopes(sensor, phase, modes, np.complex128)


def costs(sensor, phase, modes):
    return 4 * mode_variances(*exact(sensor, phase, modes))


@pytest.mark.parametrize("number", range(8))
def test_slopes_are_finite_differences_of_the_frames(pupil, modes, phase, number):
    sensor, h = every_kind(pupil)[number], 1e-5
    _, slopes = exact(sensor, phase, modes)
    for slope, mode in zip(slopes, modes, strict=True):
        up, down = (exact(sensor, phase + step * mode, modes[:0])[0] for step in (h, -h))
        np.testing.assert_allclose(slope, (up - down) / (2 * h), atol=1e-9)


def test_single_precision_is_enough_for_three_digits(pupil, modes, phase):
    for sensor in every_kind(pupil):
        single = 4 * mode_variances(*frames_and_slopes(sensor, phase, modes))
        np.testing.assert_allclose(single, costs(sensor, phase, modes), rtol=3e-4)


@pytest.mark.parametrize("read_noise", [0.0, 2.0])
def test_bounds_of_dimples_are_those_of_the_package(pupil, modes, phase, read_noise):
    model = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, HALF), zwfs.Dimple(2.0, -1.0), extent=3)
    per_point = 40.0
    total = 2 * per_point * pupil.n_points
    variances = mode_variances(*exact(DimpleSensor("", "", model), phase, modes), total, read_noise)
    wanted = zwfs.cramer_rao(model, phase, photons=per_point, read_noise=read_noise, modes=modes)
    np.testing.assert_allclose(np.sqrt(variances), wanted, rtol=1e-8)


def test_fourier_transforms_give_the_frames_of_a_smooth_patch(pupil, phase, modes):
    def blob(u, v):
        return 1 + (np.exp(2j) - 1) * np.exp(-3 * (u**2 + v**2))

    patch = zwfs.ZernikeSensor(pupil, zwfs.Patch(4.6, blob), extent=3, tolerance=1e-7)
    near, far = DimpleSensor("", "", patch), FilterSensor("", "", pupil, 6, [blob])
    ours, theirs = (exact(sensor, phase, modes[:0])[0][:, sensor.inside] for sensor in (near, far))
    np.testing.assert_allclose(ours, theirs, atol=1e-5 * ours.max())


def test_edges_and_faces_lose_no_light_and_no_sensor_beats_the_ideal_one(pupil, modes, phase):
    for sensor in every_kind(pupil)[:-1]:
        frames, slopes = exact(sensor, phase, modes)
        if isinstance(sensor, FilterSensor):
            assert frames.sum() == pytest.approx(1)
        assert np.all(4 * mode_variances(frames, slopes) > 1)


def test_frames_and_bounds_are_those_of_the_pyramid_of_hcipy(pupil, modes, phase):
    import hcipy

    n, apart = len(pupil.x), 4  # between the images, D
    grids = hcipy.make_pupil_grid(n, 1.0), hcipy.make_pupil_grid(2 * apart * n, 2 * apart)
    optics = hcipy.PyramidWavefrontSensorOptics(
        *grids, separation=apart, pupil_diameter=1.0, q=2 * apart, num_airy=n / 2
    )
    psi = np.where(pupil.inside, np.exp(1j * phase), 0) / np.sqrt(pupil.n_points)
    wave = optics.forward(hcipy.Wavefront(hcipy.Field(psi.ravel(), grids[0]), 1.0))
    theirs = np.abs(np.asarray(wave.electric_field).reshape(2 * apart * n, -1)) ** 2

    def prism(u, v):
        return np.exp(-1j * np.pi * apart * (abs(u) + abs(v))) * (np.hypot(u, v) < n / 2)

    frames, slopes = exact(FilterSensor("", "", pupil, 2 * apart, [prism]), phase, modes)
    ours = np.roll(frames[0], 2 * (apart * n - n // 2,), (0, 1))
    np.testing.assert_allclose(ours, theirs[::-1, ::-1], atol=1e-12 * ours.max())  # its second transform turns it
    # Images that are far apart give the same bound as one prism, whose images overlap a little.
    separate = costs(FilterSensor("", "", pupil, apart, quadrants()), phase, modes)
    np.testing.assert_allclose(4 * mode_variances(frames, slopes), separate, rtol=0.1)
    assert 4 * mode_variances(frames, slopes).mean() == pytest.approx(separate.mean(), rel=0.03)


@pytest.fixture(scope="module")
def flat():
    """Costs of 60 modes for a flat wavefront, by sensor."""
    pupil = zwfs.Pupil.circular(32)
    modes = zwfs.zernike_basis(pupil, 60, orthonormal=True)
    sensors = compared_sensors(pupil, (1.06, HALF), (2.0, 0.7 * np.pi), 3.0, 40, 3)
    return {sensor.name: costs(sensor, np.zeros(pupil.shape), modes) for sensor in sensors}


def test_costs_of_a_flat_wavefront_are_the_published_ones(flat):
    # Guyon 2005: beta_p^2 = 2 for an unmodulated pyramid, and 1 for the best sensor.
    assert flat[study.PYRAMID].mean() == pytest.approx(2, rel=0.03)
    assert min(cost.min() for cost in flat.values()) > 1
    # One image of a flat wavefront is as good as two, for shifts of pi/2.
    single, pair = flat["single dimple of 1.06 λ/D"], flat["pair of 1.06 λ/D (±0.5π)"]
    np.testing.assert_allclose(single, pair, rtol=1e-8)


def test_a_large_dimple_is_almost_twice_as_sensitive_but_not_to_tilt(pupil):
    """Chambouleyron et al. 2021: 2 instead of 1.06 lambda/D, by the norm of the change of a frame."""
    waves = [np.where(pupil.inside, np.sqrt(2) * np.cos(2 * np.pi * k * pupil.x), 0) for k in (2, 4)]
    modes = np.stack([zwfs.zernike_basis(pupil, 1)[0], *waves])

    def sensitivity(diameter):
        model = zwfs.ZernikeSensor(pupil, zwfs.Dimple(diameter, HALF), extent=3)
        _, slopes = exact(DimpleSensor("", "", model), np.zeros(pupil.shape), modes)
        return np.linalg.norm(slopes.reshape(len(modes), -1), axis=1)

    tilt, *others = sensitivity(2.0) / sensitivity(1.06)
    assert tilt < 0.6
    assert min(others) > 1.6


def test_tilt_of_a_modulated_pyramid_is_that_of_rays(flat):
    """A tilt of s lambda/D moves 2 s / (pi r) of the light from one half of the focal plane to the other.

    Tilt of unit rms has s = 2/pi. The difference of two equally bright halves has the variance of one photon.
    """
    slope = 2 / np.pi * (2 / np.pi) / 3.0
    assert flat["modulated pyramid, 3 λ/D"][:2].mean() == pytest.approx(4 / slope**2, rel=0.15)


def test_fit_recovers_a_small_wavefront_and_reports_a_failure(pupil, modes):
    sensors = every_kind(pupil)
    pair, pyramid = sensors[1], sensors[4]
    screens = zwfs.power_law_screens(modes, 1.0, 1, seed=1)
    for sensor in (pair, pyramid):
        assert fit_error(sensor, 0.3 * screens[0], modes, 20) < 1e-3
        assert fit_error(sensor, screens[0], modes, 1) > 0.05


def test_reach_is_the_largest_input_below_the_first_failure():
    shares = {"good": [1, 1, 1], "gap": [1, 0.5, 1], "bad": [0.5, 1, 1], "none": [np.nan] * 3}
    nothing = {name: np.ones((3, 4)) for name in shares}
    recovered = {name: np.array(values, float) for name, values in shares.items()}
    curves = SensorCurves([], np.array([0.1, 0.5, 1.0]), nothing, nothing, nothing, {}, recovered)
    assert [curves.reach(name) for name in ("good", "gap", "bad")] == [1.0, 0.1, 0.0]
    assert np.isnan(curves.reach("none"))
    assert curves.nearest(0.7) == 1


def test_bi_o_edge_is_two_knife_edges(pupil, modes, phase):
    """Its information is the mean of those of its two knife edges, each of which gets half of the light."""
    both = exact(FilterSensor("", "", pupil, 3, edges(), n_beams=2), phase, modes)
    parts = [exact(FilterSensor("", "", pupil, 3, edges()[k : k + 2]), phase, modes) for k in (0, 2)]
    np.testing.assert_allclose(both[0], np.concatenate([frames for frames, _ in parts]) / 2, atol=1e-15)
