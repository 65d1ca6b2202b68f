import numpy as np
import pytest

import zwfs
from studies.identities import (
    approximation_errors,
    arccosine_phase,
    direct_reference_wave,
    fourier_waves,
    pair_phase,
    two_waves,
)


@pytest.fixture
def patch():
    return zwfs.Patch(2.0, lambda u, v: (0.7 + 0.2 * np.cos(u)) * np.exp(1j * (0.5 + u * v)))


@pytest.mark.parametrize("mask", ["patch", "dimple"])
def test_fourier_transforms_and_two_waves_agree(pupil, screens, patch, mask):
    mask = patch if mask == "patch" else zwfs.Dimple(1.06, np.pi / 2)
    field = pupil.amplitude * np.exp(1j * screens(0.5, 1)[0])
    outgoing, incoming, reference = fourier_waves(pupil, mask, field)
    assert np.abs(outgoing) ** 2 == pytest.approx(two_waves(incoming, reference), abs=1e-13)
    # The transform's coarse mask edge limits how near it comes.
    corner = reference[: pupil.shape[0], : pupil.shape[1]]
    exact = direct_reference_wave(pupil, mask, field)
    assert np.abs(corner - exact).max() < 0.03 * np.abs(exact).max()


def test_equations_give_the_phase_back(shifted, screens):
    pupil = shifted.pupil
    phase = screens(0.2, 2)
    amplitude, truth = pupil.gather(pupil.amplitude), pupil.gather(phase)
    waves = pupil.gather(shifted.reference_wave(pupil.amplitude * np.exp(1j * phase)))
    frames = pupil.gather(shifted.measure(phase))
    assert pair_phase(frames, amplitude, waves) == pytest.approx(truth, abs=1e-12)
    # One image: on the side of the branch that the dimple of +pi/2 has.
    safe = np.abs(truth) < 0.5
    found = arccosine_phase(frames[:, 0], amplitude, waves[:, 0])
    assert found[safe] == pytest.approx(truth[safe], abs=1e-6)


def test_approximation_is_right_to_second_order_in_amplitude_only(shifted, screens):
    shapes = screens(1.0, 4)
    small, large = (approximation_errors(shifted, rms * shapes) for rms in (0.05, 0.1))
    assert large.phase / small.phase == pytest.approx(2, rel=0.05)
    assert large.amplitude / small.amplitude == pytest.approx(4, rel=0.2)
    assert large.two_images / small.two_images == pytest.approx(2, rel=0.05)
    unscaled = approximation_errors(shifted, 0.1 * shapes, power=0)
    assert unscaled.amplitude > large.amplitude


def test_flat_wavefront_needs_no_approximation(shifted):
    errors = approximation_errors(shifted, np.zeros((1, *shifted.pupil.shape)))
    assert max(errors.phase, errors.amplitude, errors.wave, errors.two_images) < 1e-12
