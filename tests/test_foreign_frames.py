"""Frames of a vector sensor that HCIPy simulates: registration and phase."""

from dataclasses import replace

import numpy as np
import pytest

from zwfs.frames.pipeline import Optics, near_edges, recover_phase, reduce_frames
from zwfs.frames.registration import Image, register_frames
from zwfs.frames.verdict import CameraNoise, judge

from . import foreign
from .hcipy_bench import HcipyBench


@pytest.fixture(scope="module", params=foreign.CASES)
def case(request):
    frames, clear_frames = foreign.recorded(**foreign.CASES[request.param])
    return foreign.CASES[request.param], register_frames(frames, clear_frames)


def test_phase_is_recovered_however_the_second_image_stands(case):
    _, registered = case
    assert foreign.phase_error(recover_phase(reduce_frames(registered, Optics()))) < 0.015


def test_placement_of_the_second_image_is_measured_within_its_errors(case):
    given, registered = case
    placement = registered.placement
    found = [*placement.shift, placement.rotation, placement.magnification]
    true = [*given.get("shift", (0, 0)), given.get("rotation", 0), given.get("magnification", 1)]
    assert np.all(np.abs(np.subtract(found, true)) < 4 * placement.sigma)
    assert np.all(placement.sigma < [0.02, 0.02, 0.05, 5e-4])


def test_light_of_the_images_is_compared_whatever_their_size(case):
    given, registered = case
    ratios = reduce_frames(registered, Optics()).flux_ratio
    np.testing.assert_allclose(ratios, 1 / given.get("flux", 1), rtol=0.005)


def test_bad_pixel_of_the_second_image_spoils_the_points_around_its_place():
    frames, clear_frames = foreign.recorded(**foreign.CASES["everything"])
    cosine, sine = np.cos(np.radians(1.5)), np.sin(np.radians(1.5))
    turned = np.array([[cosine, sine], [-sine, cosine]])
    middle, there = (foreign.SIDE - 1) / 2, np.array([-20.0, 33.0])  # from the middle of the first image
    row, column = np.round(middle + np.array([0.4, -0.7]) + 1.02 * turned @ there).astype(int)
    bad = np.zeros_like(frames[1].bad)
    bad[row, column] = True
    registered = register_frames([frames[0], replace(frames[1], bad=bad)], clear_frames)
    measurement = reduce_frames(registered, Optics())
    usual = reduce_frames(register_frames(frames, clear_frames), Optics()).bad
    spoiled = np.argwhere(measurement.bad[1] & ~usual[1]) + registered.corner - measurement.margin - middle
    assert 1 <= len(spoiled) <= 9
    assert np.abs(spoiled - there).max() < 2
    np.testing.assert_array_equal(measurement.bad[0], usual[0])


NOISE = CameraNoise(1.0, foreign.READ_NOISE)


def test_noise_explains_the_frames_and_its_error_bar_holds(case):
    found = recover_phase(reduce_frames(case[1], Optics()))
    verdict = judge(found, NOISE)
    assert verdict.explained
    assert np.all(verdict.score > verdict.control + 0.5)
    far = found.measurement.good & ~near_edges(found.measurement)
    pulls = (foreign.phase_difference(found) / verdict.sigma)[far]
    assert 0.8 < pulls.std() < 1.4


@pytest.mark.parametrize("wrong", [Optics(1.3), Optics(scale=1.1), Optics(unmasked=0.1), Optics(background=0.05)])
def test_wrong_model_is_not_explained(wrong):
    registered = register_frames(*foreign.recorded())
    assert not judge(recover_phase(reduce_frames(registered, wrong)), NOISE).explained


def test_frames_that_do_not_belong_together_score_like_the_control():
    frames, clear_frames = foreign.recorded()
    upside_down = [frames[0], replace(frames[1], counts=frames[1].counts[::-1])]
    verdict = judge(recover_phase(reduce_frames(register_frames(upside_down, clear_frames), Optics())))
    assert np.all(verdict.score < 0.3)
    assert verdict.explained is None
    assert verdict.sigma is None


@pytest.mark.parametrize(
    ("aperture", "given", "least"),
    [
        ("LUVOIR", False, 0.02),
        ("LUVOIR", True, 0.009),
        pytest.param("GMT", False, 0.012, marks=pytest.mark.slow),
        pytest.param("GMT", True, 0.009, marks=pytest.mark.slow),
        pytest.param("Keck", False, 0.015, marks=pytest.mark.slow),
        pytest.param("Keck", True, 0.009, marks=pytest.mark.slow),
    ],
)
def test_pupils_with_many_edges_are_measured(aperture, given, least):
    """The circle lies around all segments, and a pixel that is lit in part has two areas."""
    bench = HcipyBench(aperture)
    screen = bench.smooth(0.5, seed=1)
    frames, clear_frames = (
        [Image(one, np.zeros(one.shape, bool)) for one in bench.counts(phase, (7, 1), masked)]
        for phase, masked in ((screen, True), (0 * screen, False))
    )
    registered = register_frames(frames, clear_frames, pupil_diameter=float(bench.pixels) if given else None)
    assert registered.diameter == pytest.approx(bench.pixels, rel=0.025)
    found = recover_phase(reduce_frames(registered, Optics())).phase
    start = (bench.side - bench.pixels) // 2
    first = [start - corner for corner in registered.corner]
    window = tuple(slice(one, one + bench.pixels) for one in first)
    lit = bench.fully_lit & np.isfinite(found[window])
    left = np.exp(1j * (found[window] - bench.on_pupil(screen)))[lit]
    assert np.count_nonzero(lit) > 0.98 * np.count_nonzero(bench.fully_lit)
    assert np.angle(left * np.conj(left.mean())).std() < least
