"""An independent implementation, whose dimple is sampled in steps: the two agree within that error."""

import numpy as np
import pytest

from zwfs import Dimple, Pupil, ZernikeSensor, power_law_screens, zernike_basis

from .reference import HcipySensor

DIMPLE = Dimple(1.06, np.pi / 2)


@pytest.fixture(scope="module")
def pupil():
    return Pupil.circular(100)


@pytest.fixture(scope="module")
def phases(pupil):
    """Flat, and 0.8 rad rms on 200 modes."""
    return np.stack([np.zeros(pupil.shape), power_law_screens(zernike_basis(pupil, 200), 0.8, 1, seed=1)[0]])


def difference(pupil, frame, reference):
    return np.abs(frame - reference)[pupil.inside].max()


@pytest.mark.parametrize("dimple", [Dimple(1.06, -np.pi / 2), Dimple(2.0, 0.7)])
def test_sign_of_the_phase_and_orientation_of_the_pupil_are_the_same(pupil, phases, dimple):
    ours = ZernikeSensor(pupil, dimple).measure(phases[1])[0]
    theirs = HcipySensor(pupil, dimple, num_pix=256).measure(phases[1])[0]
    for wrong in (Dimple(dimple.diameter, -dimple.phase), dimple):
        changed = ZernikeSensor(pupil, wrong).measure(phases[1] if wrong is not dimple else phases[1][::-1])[0]
        assert difference(pupil, ours, theirs) < 0.02 * difference(pupil, changed, theirs)


def test_fields_have_the_same_phase(pupil, phases):
    # The sign of the field's own phase does not show in an intensity.
    field = np.exp(1j * phases[1]) * pupil.inside
    ours = ZernikeSensor(pupil, DIMPLE).propagate(field)[0]
    assert np.abs(ours - HcipySensor(pupil, DIMPLE).propagate(field)[0])[pupil.inside].max() < 2e-3
