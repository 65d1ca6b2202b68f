import numpy as np
import pytest

from zwfs import (
    Detector,
    Dimple,
    MaximumLikelihood,
    Mirror,
    PhaseShifted,
    PolychromaticSensor,
    Pupil,
    ZernikeSensor,
    close_loop,
    cramer_rao,
    hold_drift,
    zernike_basis,
)
from zwfs.loop import LoopRecord


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(20)


@pytest.fixture(scope="module")
def sensor(pupil):
    return ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))


@pytest.fixture(scope="module")
def modes(pupil):
    return zernike_basis(pupil, 6)


@pytest.fixture(scope="module")
def mirror(pupil, modes):
    return Mirror(pupil, modes)


@pytest.fixture(scope="module")
def shifted(sensor):
    return PhaseShifted(sensor, accelerate=True)


def test_gaussian_influence_functions_couple_to_their_neighbours():
    pupil = Pupil.circular(41)
    mirror = Mirror.gaussian(pupil, 97, coupling=0.2)
    assert mirror.n_actuators == 97
    middle = np.argmin(np.abs(mirror.influence.max(axis=1) - 1) + np.abs(mirror.influence @ pupil.points[:, 0]))
    wave = mirror.wavefront(np.eye(97)[middle])
    row, column = np.unravel_index(np.argmax(wave), wave.shape)
    assert wave[row, column] == pytest.approx(1)
    assert wave[row, column + 4] == pytest.approx(0.2 ** (0.97561**2), rel=0.01)  # 4 of 41 pixels, pitch 0.1 D


def test_a_gaussian_mirror_makes_smooth_wavefronts(pupil, modes):
    mirror = Mirror.gaussian(pupil, 97)
    left = modes - mirror.wavefront(mirror.fit(modes))
    assert pupil.rms(left).max() < 0.1
    with pytest.raises(ValueError, match=r"n_actuators = 98: expected .* \[97, "):
        Mirror.gaussian(pupil, 98)


def test_segments_have_pistons_and_slopes():
    pupil = Pupil.hexagonal(40, n_rings=1)
    mirror = Mirror.segments(pupil)
    commands = np.random.default_rng(1).standard_normal(21)
    np.testing.assert_allclose(mirror.fit(mirror.wavefront(commands)), commands, atol=1e-10)
    one = mirror.wavefront(np.eye(21)[7 + 2])  # slope along x of the third segment
    inside = pupil.segments == np.unique(pupil.segments[pupil.inside])[2]
    assert not one[~inside].any()
    assert np.ptp(np.diff(one, axis=1)[inside[:, 1:] & inside[:, :-1]]) < 1e-12
    assert Mirror.segments(pupil, tilts=False).n_actuators == 7


@pytest.mark.parametrize("gap", [0.01, 0.04])
def test_segments_of_a_measured_pupil_are_found(gap):
    fine = Pupil.hexagonal(4 * 48, n_rings=3, gap=gap, missing=[1])
    light = fine.inside.reshape(48, 4, 48, 4).mean(axis=(1, 3))
    image = np.sqrt(np.random.default_rng(1).poisson(1000 * light) / 1000)
    assert Mirror.segments(Pupil.from_amplitude(image, threshold=0.2)).n_actuators == 3 * 36
    disc = np.sqrt(np.random.default_rng(2).poisson(300 * Pupil.circular(48).inside) / 300)
    assert Mirror.segments(Pupil.from_amplitude(disc, threshold=0.2)).n_actuators == 3


def test_bad_points_take_no_part_in_a_fit(pupil, mirror, modes):
    commands = np.random.default_rng(3).standard_normal((2, 6))
    phase = mirror.wavefront(commands)
    phase[1][pupil.inside & (np.random.default_rng(4).random(pupil.shape) < 0.3)] = np.nan
    np.testing.assert_allclose(mirror.fit(phase), commands, atol=1e-10)
    with pytest.raises(ValueError, match="phase has 0 points that are not NaN: expected at least the 6"):
        mirror.fit(np.full(pupil.shape, np.nan))


def test_a_leak_keeps_a_share_of_a_still_screen(mirror, modes, sensor, shifted):
    still = np.repeat(0.1 * modes[np.newaxis, 4:5], 60, axis=0)
    record = close_loop(sensor, mirror, shifted, still, gain=0.4, leak=0.1)
    np.testing.assert_allclose(record.open_loop, 0.1)
    assert record.residual[0, -1] == pytest.approx(0.1 * 0.1 / (0.4 + 0.1), rel=1e-3)
    np.testing.assert_allclose(record.commands[0, -1], 0.08 * np.eye(6)[4], atol=1e-5)
    np.testing.assert_allclose(record.strehl[0], np.exp(-(record.residual[0] ** 2)), rtol=1e-3)
    assert np.isnan(record.photons).all()


def test_any_plant_can_be_measured(mirror, modes, sensor, shifted):
    class Leaking:
        """Sensor whose masks miss 5 % of the light, in front of a static error."""

        def measure(self, phase):
            frames = sensor.measure(phase + 0.05 * modes[2])
            return 0.95 * frames + 0.05 * sensor.pupil.amplitude**2

    still = np.repeat(0.2 * modes[np.newaxis, 4], 30, axis=0)
    record = close_loop(Leaking(), mirror, shifted, still)
    # The loop flattens what its sensor sees: the mirror takes the static error as well.
    assert record.commands[0, -1, 4] == pytest.approx(0.2, abs=1e-3)
    assert record.commands[0, -1, 2] == pytest.approx(0.05, abs=1e-3)
    assert record.residual[0, -1] == pytest.approx(0.05, abs=1e-3)
    band = PolychromaticSensor.flat_band(sensor, 0.2, 3)
    assert close_loop(band, mirror, shifted, still).residual[0, -1] < 2e-3


def test_photons_of_each_cycle_are_counted(mirror, modes, sensor, shifted):
    camera = Detector(sensor.pupil, 5000, gain=2.0)
    still = np.zeros((8, 3, *sensor.pupil.shape))
    record = close_loop(sensor, mirror, shifted, still, camera=camera, seed=1)
    expected = 5000 * sensor.measure(still[0, 0]).sum() / sensor.pupil.n_points
    assert record.photons.shape == (3, 8)
    assert record.photons.mean() == pytest.approx(expected, rel=0.02)
    with pytest.raises(ValueError, match="read-only"):
        record.photons[0, 0] = 1


def test_settled_residual_is_that_of_the_last_cycles():
    residual = np.array([[0.5, 0.4, 0.3, 0.1], [0.2, 0.2, 0.2, 0.6]])
    record = LoopRecord(residual, residual, residual, residual[..., np.newaxis], residual)
    np.testing.assert_allclose(record.settled(1), [0.1, 0.6])
    np.testing.assert_allclose(record.settled(2), np.sqrt([(0.3**2 + 0.1**2) / 2, (0.2**2 + 0.6**2) / 2]))
    np.testing.assert_allclose(record.settled(4), np.sqrt(np.mean(residual**2, axis=1)))
    with pytest.raises(ValueError, match="n_cycles = 5"):
        record.settled(5)


def test_a_ramp_lags_by_the_speed_over_the_gain(mirror, modes, sensor, shifted):
    ramp = (0.002 * np.arange(60))[:, np.newaxis, np.newaxis] * modes[3]
    record = close_loop(sensor, mirror, shifted, ramp, gain=0.4)
    assert record.settled(5)[0] == pytest.approx(0.002 / 0.4, rel=1e-3)
    speed = 0.002 * 635e3 / (2 * np.pi)
    held = hold_drift(sensor, modes[3:4], drift=0, speed=speed, gain=0.4, photons=1e14, wavelength=635.0)
    assert held.residual == pytest.approx(speed / 0.4, rel=1e-3)


def test_speed_is_divided_among_the_modes(sensor, modes):
    held = hold_drift(sensor, modes[:4], drift=0, speed=100.0, gain=0.4, photons=1e14, wavelength=635.0)
    np.testing.assert_allclose(held.lag, 100 / np.sqrt(4) / 0.4)
    assert held.residual == pytest.approx(100 / 0.4, rel=1e-3)


def test_commands_and_figure_stay_within_the_stroke(mirror, modes, sensor, shifted):
    still = np.repeat(0.3 * modes[np.newaxis, 4:5], 20, axis=0)
    record = close_loop(sensor, mirror, shifted, still, stroke=0.1)
    assert record.residual[0, -1] == pytest.approx(0.2, rel=1e-3)
    np.testing.assert_allclose(record.commands[0, -1], 0.1 * np.eye(6)[4], atol=1e-5)
    figures = sensor.pupil.rms(mirror.wavefront(record.commands[0]))
    assert figures.max() == pytest.approx(0.1, rel=1e-9)


def test_the_mirror_keeps_its_figure_where_one_of_two_frames_is_dark(mirror, modes, sensor, shifted):
    class Blinking:
        """Sensor whose second frame of the first screen is dark in the third cycle."""

        cycle = 0

        def measure(self, phase):
            frames, self.cycle = sensor.measure(phase), self.cycle + 1
            if self.cycle == 3:
                frames[0, 1] = 0
            return frames

    still = np.broadcast_to(0.2 * modes[4], (5, 2, *sensor.pupil.shape))
    commands = close_loop(Blinking(), mirror, shifted, still).commands[:, :, 4]
    np.testing.assert_allclose(commands[0], [0, 0.1, 0.15, 0.15, 0.175], rtol=1e-3)
    np.testing.assert_allclose(commands[1], [0, 0.1, 0.15, 0.175, 0.1875], rtol=1e-3)


def test_read_noise_does_not_lower_the_gain_of_the_loop(mirror, modes, sensor):
    camera = Detector(sensor.pupil, 20 * sensor.pupil.n_points, read_noise=10.0)
    likely = MaximumLikelihood(sensor, modes, photons=20, read_noise=10.0, n_starts=1)
    still = np.broadcast_to(0.2 * modes[4], (2, 80, *sensor.pupil.shape))
    record = close_loop(sensor, mirror, likely, still, gain=0.5, camera=camera, seed=1)
    assert record.commands[:, 1, 4].mean() == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("gain", [None, 0.8])
def test_the_held_drift_is_that_of_a_simulated_loop(mirror, modes, sensor, gain):
    photons, drift = 1e6, 200.0  # per cycle; pm rms per cycle
    scale = 635e3 / (2 * np.pi)  # pm / radian
    held = hold_drift(sensor, modes, drift=drift, photons=photons, wavelength=635.0, gain=gain)
    used = float(np.mean(held.gain))
    held = hold_drift(sensor, modes, drift=drift, photons=photons, wavelength=635.0, gain=used)
    rng, camera = np.random.default_rng(1), Detector(sensor.pupil, photons / 2)
    steps = drift / scale / np.sqrt(len(modes)) * rng.standard_normal((120, 20, len(modes)))
    walks = np.tensordot(np.cumsum(steps, axis=0), modes, 1)
    likely = MaximumLikelihood(sensor, modes, photons=camera.photons_per_pixel, n_starts=1)
    record = close_loop(sensor, mirror, likely, walks, gain=used, camera=camera, seed=rng)
    simulated = scale * np.sqrt(np.mean(record.residual[:, 20:] ** 2))
    assert simulated == pytest.approx(held.residual, rel=0.05)


def test_the_best_gain_is_the_best(sensor, modes):
    def residual(gain, mode):
        options = {"drift": 20.0, "photons": 1e9, "wavelength": 635.0}
        return hold_drift(sensor, modes[mode : mode + 1], gain=gain, **options)

    best = residual(None, 4)
    assert 0 < best.gain[0] < 1
    for factor in (0.9, 1.1):
        assert residual(factor * best.gain[0], 4).residual > best.residual


def test_noise_is_that_of_the_bound(sensor, modes):
    held = hold_drift(sensor, modes, drift=0, gain=1.0, photons=1e8, wavelength=500.0)
    bound = cramer_rao(sensor, np.zeros(sensor.pupil.shape), photons=1e8 / 2 / sensor.pupil.n_points, modes=modes)
    np.testing.assert_allclose(held.noise, bound * 500e3 / (2 * np.pi))


OTHER = Pupil.circular(16)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mirror": 1}, "mirror is a int"),
        ({"mirror": Mirror(OTHER, zernike_basis(OTHER, 3))}, "mirror has Pupil"),
        ({"gain": 2.0}, "gain = 2"),
        ({"leak": 1.0}, "leak = 1"),
        ({"delay": 0}, "delay = 0"),
        ({"stroke": 0.0}, "stroke = 0"),
        ({"disturbance": []}, "disturbance is empty"),
        ({"disturbance": [np.zeros((20, 20)), np.zeros((2, 20, 20))]}, "disturbance.1. has shape"),
    ],
)
def test_bad_input_is_refused(mirror, sensor, shifted, change, message):
    arguments = {"mirror": mirror, "disturbance": np.zeros((2, 20, 20))} | change
    with pytest.raises((TypeError, ValueError), match=message):
        close_loop(sensor, reconstructor=shifted, **arguments)


def test_bad_drifts_are_refused(sensor, modes):
    for change in (
        {"modes": 0 * modes},
        {"modes": 2 * modes},
        {"drift": 1e155},
        {"drift": 1e-100},
        {"speed": 1e155},
        {"gain": 1e-300},
        {"gain": None, "drift": 0},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            hold_drift(sensor, **{"modes": modes, "drift": 1.0, "photons": 1e9, "wavelength": 635.0} | change)
