"""Calibration with the model of the camera, on frames that HCIPy simulates, and the parts that it is made of."""

import functools
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import ndimage

from zwfs.frames import Calibration
from zwfs.frames import _fit as fitting
from zwfs.frames._fit import fit_bench
from zwfs.frames._fitted import FittedSensor, Windows
from zwfs.frames._learnt import of_bench
from zwfs.frames._light import Light
from zwfs.frames._optics import Camera, Exposure, Linearised, Maps
from zwfs.frames.phases import Flag

from .hcipy_bench import BORDER, CASES, HcipyBench


def blocks(image, k):
    return image.reshape(len(image) // k, k, -1, k).mean(axis=(1, 3))


def test_model_with_the_true_maps_makes_the_frames_of_a_foreign_bench():
    """Its grid is that of the bench, so that every step of the model is compared: mask, blur, pixel and place."""
    bench = replace(
        CASES["ideal"], aperture="VLT", pixels=40, side=52, blur=0.6, offsets=((0.2, -0.1), (-0.15, 0.25))
    )
    phase, n, f = bench.smooth(0.8, seed=1), bench.side + 2 * BORDER, bench.fine
    exposures = [Exposure(0, 0, 0), Exposure(1, 1, 0)]
    camera = Camera(n, (bench.side,) * 2, bench.pixels, exposures, np.zeros((1, n * f, n * f)), f, 1.5)
    arms = [[0, *bench.offsets[side], 0, 1, 1, 0] for side in (0, 1)]
    values = np.array([*arms[0], *arms[1], bench.diameter, *bench.shifts, 0, 0, bench.blur])
    images = Linearised(camera, Maps(bench.amplitude, 0 * phase, phase), values).images
    np.testing.assert_allclose(images, bench.exposed(phase, True), rtol=0, atol=2e-4)


def test_light_that_the_grid_does_not_resolve_spreads_with_the_focus(monkeypatch):
    """On a grid coarser than that of the bench, most of the error of a defocused image is gone."""
    bench = replace(CASES["ideal"], pixels=40, side=52, focus=(1e-3, -6e-4))
    n, f = bench.side + 2 * BORDER, 2
    light, mean = (blocks(bench.amplitude**power, bench.fine // f) for power in (2, 1))
    exposures = [Exposure(0, None, 0), Exposure(1, None, 0)]
    arms = [[focus, 0, 0, 0, 1, 1, 0] for focus in bench.focus]
    values = np.array([*arms[0], *arms[1], bench.diameter, *bench.shifts, 0, 0, 0])
    true = bench.exposed(np.zeros_like(bench.amplitude), False)

    def error():
        camera = Camera(n, (bench.side,) * 2, bench.pixels, exposures, np.zeros((1, n * f, n * f)), f, 1.5)
        images = Linearised(camera, Maps(mean, light - mean**2, np.zeros_like(mean)), values).images
        return np.sqrt(np.mean((np.array(images) - true) ** 2, axis=(1, 2)))

    spread = error()
    monkeypatch.setattr(Camera, "spread_at", lambda self, focus: (1.0, 0.0))
    assert np.all(spread < error() / 2)


@pytest.mark.parametrize(("center", "radius"), [((12.0, 12.0), 8.3), ((11.7, 12.2), 8.6)])
def test_sharp_light_divides_pixels_as_the_edge_does(center, radius):
    """The light of each pixel stays; of the error of an even division, less than a seventh remains."""
    k, f, n = 16, 2, 24
    y, x = (np.mgrid[: n * k, : n * k] + 0.5) / k
    disc = (np.hypot(y - center[0], x - center[1]) < radius).astype(float)
    pixels, true = blocks(disc, k), blocks(disc, k // f)
    light = Light.sharp(pixels, f).start
    np.testing.assert_allclose(blocks(light, f), pixels, atol=1e-9)
    even = np.kron(pixels, np.ones((f, f)))
    assert np.sum((light - true) ** 2) < np.sum((even - true) ** 2) / 50


def test_light_of_vanes_that_does_not_interfere_has_no_bias():
    """Its share is s (1 - s) at a point that is lit to a share s; an even division makes it too large."""
    k, f, n = 16, 2, 24
    y, x = (np.mgrid[: n * k, : n * k] + 0.5) / k - n / 2
    ratios, control = [], []
    for angle, width, place in product((0, 25, 45), (0.4, 0.8, 1.2), (0, 0.3, 0.5)):
        turn = np.radians(angle)
        across = np.cos(turn) * y + np.sin(turn) * x - place
        lit = ((np.hypot(y, x) < 9) & (np.abs(across) > width / 2)).astype(float)
        pixels, true = blocks(lit, k), blocks(lit, k // f)
        sharp, even = Light.sharp(pixels, f).start, np.kron(pixels, np.ones((f, f)))
        right, *others = (np.sum(share * (1 - share)) for share in (true, sharp, even))
        ratios.append(others[0] / right)
        control.append(others[1] / right)
    assert abs(np.mean(ratios) - 1) < 0.05
    assert np.mean(control) > 1.3


@pytest.mark.parametrize("mottling", [0.0, 0.12])
def test_dark_spots_of_the_illumination_are_not_edges(mottling):
    y, x = np.indices((40, 40)) - 19.5
    light = np.hypot(y, x) < 17
    light = light * (1 + mottling * np.random.default_rng(0).normal(size=light.shape))
    full = Light.of(light, light, 1).full
    assert full[np.hypot(y, x) < 14].mean() > 0.95
    assert not full[np.hypot(y, x) > 17].any()


BENCH = replace(CASES["disc"], pixels=40, side=52)
TURNED = replace(CASES["turned VLT"], pixels=40, side=52)


IDEAL = replace(CASES["ideal"], pixels=40, side=56)
HEXAGONS = CASES["hexagons"]
SMALL = replace(CASES["disc"], pixels=24, side=32)


@functools.cache
def fitted(bench, seed=1):
    """Fit of a bench to a recording of it, which several tests look at."""
    frames, clear, phases = bench.recording(seed=seed)
    return Calibration.fit(frames, clear, phases, n_pixels=bench.pixels, noise=bench.noise)


@pytest.fixture(scope="module", params=[BENCH, TURNED], ids=["disc", "turned VLT"])
def calibrated(request):
    return request.param, fitted(request.param)


def test_calibration_of_a_foreign_bench_explains_its_frames(calibrated):
    bench, fit = calibrated[0], calibrated[1].bench
    assert fit.misfit.mean() < 1.2
    assert fit.consistent
    assert max(abs(fit[name].value / bench.truth[name] - 1) for name in ("diameter", "first", "second")) < 3e-3
    assert fit["leakage"].value == pytest.approx(bench.leakage, abs=3e-3)
    assert fit["blur"].value == pytest.approx(bench.blur, abs=0.04)
    for arm in range(4):
        assert fit[f"arm {arm} row"].value == pytest.approx(bench.truth[f"arm {arm} row"], abs=0.02)
        assert fit[f"arm {arm} column"].value == pytest.approx(bench.truth[f"arm {arm} column"], abs=0.02)
    for side in (0, 1):
        assert fit[f"arm {side} rotation"].value == pytest.approx(bench.truth[f"arm {side} rotation"], abs=1e-3)
        assert fit[f"arm {side} focus"].value == pytest.approx(bench.focus[side], abs=6e-5)


@pytest.mark.slow
def test_other_values_replace_those_of_a_fit_and_explain_its_frames_worse():
    fit = fitted(BENCH).bench
    wrong = fit.replaced({"diameter": 1.06, "leakage": 0.0})
    assert (wrong["diameter"].value, wrong["leakage"].value) == (1.06, 0.0)
    assert wrong["first"] == fit["first"]
    recorded = BENCH.recording(seed=1)[0][0]
    misfit, worse = (np.sum((FittedSensor(bench).frames(bench.flat) - recorded) ** 2) for bench in (fit, wrong))
    assert worse > 2 * misfit
    with pytest.raises(ValueError, match="values = 'size': expected one of"):
        fit.replaced({"size": 1.0})
    with pytest.raises(TypeError, match="diameter = 'large'"):
        fit.replaced({"diameter": "large"})


def test_fit_that_ends_early_has_not_converged():
    frames, clear, phases = SMALL.recording()
    steps = []
    settings = {"n_pixels": 24, "noise": SMALL.noise, "oversampling": 1, "n_steps": 1, "progress": steps.append}
    assert not fit_bench(frames, clear, phases, **settings).converged
    first, *stages, last = dict.fromkeys(text.partition(",")[0] for text in steps)
    assert (first, last) == ("dimple and order of the images", "error bars")
    assert stages == [f"stage {number} of 4" for number in range(1, 5)]


@pytest.mark.parametrize(("rms", "bound"), [(0.3, 0.0115), (0.8, 0.02), (1.2, 0.064)])
def test_calibrated_phase_has_half_the_error_that_the_plain_route_had(calibrated, rms, bound):
    bench, calibration = calibrated
    screen = bench.smooth(rms, seed=1)
    counts = bench.counts(screen, (7, 1))
    estimate = calibration(counts, smooth=True)
    assert bench.error(estimate, screen) < bound
    residual = (estimate - bench.on_pupil(screen + bench.flat))[bench.fully_lit]
    pull = (residual - residual.mean()) / estimate.sigma[bench.fully_lit]
    assert 0.5 < pull.std() < 2


@pytest.mark.slow
def test_smooth_phase_of_a_whole_camera_image_is_that_of_its_windows():
    bench, calibration = BENCH, fitted(BENCH)
    frames, _, phases = bench.recording(seed=1)
    windows = Windows(np.array([[3, 2], [1, 60]]), (52, 52), 1, (60, 120))
    dark = np.full((1, 60, 120), 50, np.float32)
    whole = of_bench(Calibration, calibration.bench, frames, phases, windows, dark)
    counts = bench.counts(bench.smooth(0.3, seed=1), (7, 1))
    counts[1, 20, 30] = np.nan
    [image] = windows.on_camera(counts[np.newaxis])[0] + 50
    [prior] = calibration(counts, smooth=True).priors
    estimate, expected = whole(image, smooth=prior), calibration(counts, smooth=prior)
    np.testing.assert_allclose(estimate, expected, rtol=0, atol=1e-6)
    # Around the windows this image has no noise, so the corrections leave out less.
    np.testing.assert_allclose(whole(image), calibration(counts), rtol=0, atol=5e-3)
    assert estimate.flags == expected.flags == Flag.BAD_PIXELS
    assert not np.isnan(estimate.phase[calibration.good]).any()
    lost = whole(0 * image + np.nan, smooth=prior)
    assert lost.flags & Flag.LOST
    assert np.isnan(lost.phase).all()


@pytest.mark.parametrize("tilts", [False, True], ids=["pistons", "tips and tilts"])
def test_phase_jumps_at_the_gaps_of_a_segmented_pupil(tilts):
    """With a smooth prior alone, it would be worse than without a prior."""
    bench, calibration = HEXAGONS, fitted(HEXAGONS)
    steps = bench.segmented(0.8, seed=1, tilts=tilts)
    counts = bench.counts(steps, (7, 1))
    estimate = calibration(counts, smooth=True)
    [prior] = estimate.priors
    assert prior.jumps > 0.2
    assert bench.error(estimate, steps) < 0.9 * bench.error(calibration(counts), steps)
    alone = calibration(counts, smooth=prior._replace(rms=0.9, jumps=0.0))
    assert bench.error(estimate, steps) < 0.6 * bench.error(alone, steps)


def test_smooth_phase_does_not_jump_at_gaps():
    bench = HEXAGONS
    screen = bench.smooth(0.8, seed=1)
    estimate = fitted(bench)(bench.counts(screen, (7, 1)), smooth=True)
    assert estimate.priors[0].jumps == 0
    assert bench.error(estimate, screen) < 0.02


@pytest.mark.parametrize(("rms", "share"), [(0.1, 1.0), (0.5, 0.8), (0.8, 0.7)])
def test_call_without_a_prior_uses_all_of_the_fit(calibrated, rms, share):
    """The linear road alone has two times the error at 0.8 rad rms."""
    bench, calibration = calibrated
    screens = [bench.smooth(rms, seed=seed) for seed in (31, 32)]
    counts = np.stack([bench.counts(screen, (9, 1)) for screen in screens])
    errors, linear = (
        [bench.error(*pair) for pair in zip(road(counts, light=1.0), screens, strict=True)]
        for road in (calibration, replace(calibration, bench=None))
    )
    assert np.linalg.norm(errors) < share * np.linalg.norm(linear)
    assert not calibration(counts).flags.any()


def test_error_bars_of_a_call_without_a_prior_hold_away_from_edges(calibrated):
    bench, calibration = calibrated
    screens = [bench.smooth(0.5, seed=seed) for seed in range(31, 37)]
    estimate = calibration(np.stack([bench.counts(screen, (9, 1)) for screen in screens]))
    truth = np.stack([bench.on_pupil(screen + bench.flat) for screen in screens])
    inner = ndimage.binary_erosion(bench.fully_lit)
    waves = np.exp(1j * (estimate.phase - truth))[:, inner]
    errors = np.angle(waves / waves.mean(axis=1, keepdims=True))
    assert errors.std() < 0.012
    sigma = calibration.sigma(estimate, calibration.unit.mean(), bench.noise)[:, inner]
    assert 0.8 < (errors / sigma).std() < 1.3


@pytest.mark.parametrize("change", [{"blur": 1.0}, {"leakage": 0.08}, {"offsets": ((0.8, -0.1), (0.45, 0.25))}])
def test_frames_that_their_phases_do_not_predict_are_inconsistent(calibrated, change):
    """The phase of the ideal frames alone explains some of these, which are wrong by 0.04 rad and more."""
    bench, calibration = calibrated
    wrong, screen = replace(bench, **change), bench.smooth(0.5, seed=21)
    estimate = calibration(wrong.counts(screen, (7, 1)))
    assert bench.error(estimate, screen) > 0.035
    assert estimate.flags & Flag.INCONSISTENT


@pytest.mark.slow
def test_predicted_frames_move_with_the_images():
    bench, calibration, screen = BENCH, fitted(BENCH), BENCH.smooth(0.5, seed=21)
    moved = replace(bench, offsets=tuple((row + 1, column - 0.5) for row, column in bench.offsets))
    estimate = calibration(moved.counts(screen, (7, 1)), follow=True)
    np.testing.assert_allclose(estimate.displacement, (1, -0.5), rtol=0, atol=0.05)
    assert bench.error(estimate, screen) < 0.015
    assert not estimate.flags


def segments(bench, rms, width=6):
    """Random pistons of square segments, so many pixels wide, on the fine grid of a bench."""
    rows, columns = np.indices(bench.lit.shape) // (width * bench.fine)
    return bench.lit * rms * np.random.default_rng(3).normal(size=(rows.max() + 1,) * 2)[rows, columns]


@pytest.mark.slow
def test_evidence_chooses_a_prior_as_smooth_as_the_phase(monkeypatch):
    bench = BENCH

    def measured(screen):
        counts = bench.counts(screen, (7, 1))
        return fitted(bench)(counts, smooth=True)

    smooth = bench.smooth(0.3, seed=1)
    estimate = measured(smooth)
    assert estimate.priors[0].exponent > measured(segments(bench, 0.3)).priors[0].exponent
    # Control: a prior for rough phases amplifies the noise of the highest frequencies.
    monkeypatch.setattr("zwfs.frames._fitted._EXPONENTS", (3.0,))
    assert bench.error(measured(smooth), smooth) > 1.5 * bench.error(estimate, smooth)


@pytest.mark.slow
def test_error_bars_of_a_fit_cover_the_true_values():
    """Of two benches, and of a second draw of the noise. The error bars also hold what the model misses."""
    draws = (BENCH, 1), (BENCH, 2), (IDEAL, 1)
    pulls = np.abs([pull for bench, seed in draws for pull in bench.pulls(fitted(bench, seed).bench).values()])
    assert 0.5 < np.mean(pulls < 1) < 0.85
    assert pulls.max() < 4.5


@pytest.mark.slow
def test_reverse_order_and_a_command_with_the_wrong_sign_are_reported():
    frames, clear, phases = SMALL.recording()
    phases[2] *= -1
    settings = {"n_pixels": SMALL.pixels, "noise": SMALL.noise, "n_steps": 3, "oversampling": 2}
    fit = fit_bench(frames[:, ::-1], clear[::-1], phases, **settings)
    assert any("reverse order" in remark for remark in fit.remarks)
    assert any(remark.startswith("State 2") for remark in fit.remarks)
    assert not fit.consistent


@pytest.mark.slow
def test_focus_has_its_sign_on_sharp_images(monkeypatch):
    """The first try ends with one or both signs reversed, and explains nothing: other signs are tried."""
    bench, tried = replace(CASES["disc"], blur=0.3), []
    frames, clear, phases = bench.recording(seed=3)
    others = fitting._other_signs
    monkeypatch.setattr(fitting, "_other_signs", lambda point: tried.append(point) or others(point))
    fit = fit_bench(frames, clear, phases, n_pixels=bench.pixels, noise=bench.noise, oversampling=2)
    assert len(tried) == 1
    assert fit.consistent
    for side in (0, 1):
        assert fit[f"arm {side} focus"].value == pytest.approx(bench.focus[side], abs=3e-5)


@pytest.mark.slow
def test_light_of_vanes_needs_a_finer_grid(monkeypatch):
    """With the grid from which a fit goes on, the model does not explain the frames."""
    bench, coarse = replace(CASES["turned VLT"], pixels=56, side=72).reversed, []
    frames, clear, phases = bench.recording(seed=1)
    divided = fitting._divided

    def watched(data, point, f):
        coarse.extend([np.mean(point.misfit)] * (f == 3 > point.problem.camera.f))
        return divided(data, point, f)

    monkeypatch.setattr(fitting, "_divided", watched)
    fit = fit_bench(frames, clear, phases, n_pixels=bench.pixels, noise=bench.noise)
    assert fit.converged
    assert np.mean(fit.misfit) < 1 < 1.2 < coarse[0]
    for name in ("diameter", "first", "second"):
        assert fit[name].value == pytest.approx(bench.truth[name], rel=2e-3)


@pytest.mark.slow
def test_light_past_the_mask_widens_the_error_bars_of_what_it_resembles():
    """A pair of opposite phase shifts, their leakage, and a share that no mask shifts have too few images."""
    bench = HcipyBench(pixels=40, side=56, static=0.1, photons=5e3, unmasked=0.05, blur=0.3)
    frames, clear, phases = bench.recording(2)
    fit = fit_bench(frames, clear, phases, n_pixels=bench.pixels, noise=bench.noise, oversampling=2)
    for name in ("first", "second", "leakage", "unmasked"):
        assert abs(fit[name].value - bench.truth[name]) < 3 * fit[name].sigma
    assert 0.01 < fit["first"].sigma < 0.1
