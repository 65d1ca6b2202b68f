import numpy as np
import pytest

from studies.closed_loop import FrozenFlow, follow_flow
from zwfs import Dimple, Linear, PhaseShifted, Pupil, ZernikeSensor, zernike_basis

PLUS, MINUS = Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2)


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(32)


@pytest.fixture(scope="module")
def modes(pupil):
    return zernike_basis(pupil, 60)


@pytest.fixture(scope="module")
def shifted(pupil):
    return PhaseShifted(ZernikeSensor(pupil, PLUS, MINUS))


def test_screens_have_the_rms_asked_for_at_the_start_and_no_piston(pupil):
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


def test_a_still_screen_is_corrected_by_the_gain_in_each_step(pupil, modes, shifted):
    flow = FrozenFlow(pupil, 0.3, 2, speed=0.0, cutoff=1.0, seed=4)
    screens = pupil.gather(flow(0.0))
    flat = pupil.gather(modes)
    fitted = np.linalg.lstsq(flat.T, screens.T, rcond=None)[0].T
    run = follow_flow(shifted, modes, flow, 6, gain=0.5, delay=1)
    for step in range(6):
        left = screens - (1 - 0.5**step) * fitted @ flat
        np.testing.assert_allclose(run.residual[:, step], left.std(axis=-1), rtol=1e-4)
    np.testing.assert_allclose(run.open_loop, 0.3)


def test_a_correction_takes_the_delay(pupil, modes, shifted):
    flow = FrozenFlow(pupil, 0.3, 1, speed=0.0, cutoff=1.0, seed=4)
    residual = follow_flow(shifted, modes, flow, 5, gain=0.5, delay=3).residual[0]
    np.testing.assert_allclose(residual[:3], 0.3)
    assert residual[3] < 0.2


def test_noise_falls_with_the_root_of_the_photons(pupil, modes, shifted):
    flow = FrozenFlow(pupil, 0.0, 4, seed=1)
    few, many = (
        follow_flow(shifted, modes, flow, 60, photons=photons, seed=5).settled().mean() for photons in (1e6, 1e8)
    )
    assert few / many == pytest.approx(10, rel=0.15)


def test_the_phase_shifted_loop_closes_where_the_linear_one_does_not(pupil, modes):
    plain = Linear(ZernikeSensor(pupil, PLUS), modes)
    few = PhaseShifted(ZernikeSensor(pupil, PLUS, MINUS), n_iterations=5)
    flow = FrozenFlow(pupil, 0.9, 6, seed=1)
    options = {"gain": 0.4, "delay": 2, "stroke": 4.0}
    assert follow_flow(few, modes, flow, 80, **options).closed().all()
    lost = follow_flow(plain, modes, flow, 80, **options)
    assert not lost.closed().all()
    assert np.all(lost.residual <= 4.0 + lost.open_loop + 1e-9)


def test_the_mirror_stays_where_no_photon_came(pupil, modes, shifted):
    flow = FrozenFlow(pupil, 0.5, 8, seed=1)
    dark = follow_flow(shifted, modes, flow, 3, photons=1e-9, seed=2)
    np.testing.assert_allclose(dark.residual, dark.open_loop)
    faint = follow_flow(shifted, modes, flow, 2, photons=3.0, seed=2)
    stayed = np.isclose(faint.residual, faint.open_loop)[:, 1]
    assert 0 < stayed.sum() < len(stayed)


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
