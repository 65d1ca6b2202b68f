"""Frames of a vector sensor that HCIPy simulates: registration and phase."""

import numpy as np
import pytest

from zwfs.frames.pipeline import Optics, reconstruct, reduce_frames
from zwfs.frames.registration import record

from . import foreign


@pytest.fixture(scope="module", params=foreign.CASES)
def case(request):
    frames, clear_frames = foreign.recorded(**foreign.CASES[request.param])
    return foreign.CASES[request.param], record(frames, clear_frames)


def test_phase_is_recovered_however_the_second_image_stands(case):
    _, recording = case
    assert foreign.phase_error(reconstruct(reduce_frames(recording, Optics()))) < 0.015


def test_placement_of_the_second_image_is_measured_within_its_errors(case):
    given, recording = case
    placement = recording.placement
    found = [*placement.shift, placement.rotation, placement.magnification]
    true = [*given.get("shift", (0, 0)), given.get("rotation", 0), given.get("magnification", 1)]
    assert np.all(np.abs(np.subtract(found, true)) < 4 * placement.sigma)
    assert np.all(placement.sigma < [0.02, 0.02, 0.05, 5e-4])


def test_light_of_the_images_is_compared_whatever_their_size(case):
    given, recording = case
    ratios = reduce_frames(recording, Optics()).flux_ratio
    np.testing.assert_allclose(ratios, 1 / given.get("flux", 1), rtol=0.005)
