import numpy as np
import pytest

from zwfs import (
    Detector,
    Dimple,
    Mirror,
    PhaseShifted,
    PolychromaticSensor,
    Pupil,
    ZernikeSensor,
    close_loop,
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


def test_segments_have_pistons_and_slopes():
    pupil = Pupil.hexagonal(40, n_rings=1)
    mirror = Mirror.segments(pupil)
    commands = np.random.default_rng(1).standard_normal(21)
    np.testing.assert_allclose(mirror.fit(mirror.wavefront(commands)), commands, atol=1e-10)
    slope = mirror.wavefront(np.eye(21)[7 + 2])  # slope along x of the third segment
    inside = pupil.segments == np.unique(pupil.segments[pupil.inside])[2]
    assert not slope[~inside].any()
    assert np.ptp(np.diff(slope, axis=1)[inside[:, 1:] & inside[:, :-1]]) < 1e-12
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
    assert np.isnan(record.electrons).all()


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


def test_electrons_of_each_cycle_are_counted(mirror, modes, sensor, shifted):
    camera = Detector(5000 / sensor.pupil.n_points)
    still = np.zeros((8, 3, *sensor.pupil.shape))
    record = close_loop(sensor, mirror, shifted, still, camera=camera, seed=1)
    expected = 5000 * sensor.measure(still[0, 0]).sum() / sensor.pupil.n_points
    assert record.electrons.shape == (3, 8)
    assert record.electrons.mean() == pytest.approx(expected, rel=0.02)
    with pytest.raises(ValueError, match="read-only"):
        record.electrons[0, 0] = 1


def test_settled_residual_is_that_of_the_last_cycles():
    residual = np.array([[0.5, 0.4, 0.3, 0.1], [0.2, 0.2, 0.2, 0.6]])
    record = LoopRecord(residual, residual, residual, residual[..., np.newaxis], residual)
    np.testing.assert_allclose(record.settled(1), [0.1, 0.6])
    np.testing.assert_allclose(record.settled(2), np.sqrt([(0.3**2 + 0.1**2) / 2, (0.2**2 + 0.6**2) / 2]))
    np.testing.assert_allclose(record.settled(4), np.sqrt(np.mean(residual**2, axis=1)))
    with pytest.raises(ValueError, match="n_cycles = 5"):
        record.settled(5)


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
