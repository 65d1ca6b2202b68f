"""Frames of a vector sensor that HCIPy simulates: registration and phase."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits

from zwfs.frames import Calibration
from zwfs.frames.__main__ import main
from zwfs.frames._fit import _remarks
from zwfs.frames.pipeline import Optics, near_edges, phase_of, recover_phase, reduce_frames
from zwfs.frames.refine import fit, steps
from zwfs.frames.registration import Image, find_pupils, register_frames
from zwfs.frames.verdict import CameraNoise, judge

from .hcipy_bench import HcipyBench

IDEAL = HcipyBench("VLT", pixels=100, side=148, photons=2e4, background=0.0)
NOISE = CameraNoise(1.0, IDEAL.read_noise)
EVERYTHING = {
    "offsets": ((0.0, 0.0), (0.4, -0.7)),
    "rotations": (0.0, 1.5),
    "magnifications": (1.0, 1.02),
    "fluxes": (1.0, 0.8),
}
CASES = {"nothing": {}, "everything": EVERYTHING, **{name: {name: EVERYTHING[name]} for name in EVERYTHING}}


def recorded(bench):
    """Frames and clear frames of a screen of 0.5 rad rms."""
    screen = bench.smooth(0.5, seed=1)
    return bench.images(screen, 1), bench.images(0 * screen, 2, masked=False)


def difference(bench, estimate):
    """Measured phase less the true one, radian."""
    return bench.difference(estimate.phase, estimate.measurement.registered.corner, bench.smooth(0.5, seed=1))


@pytest.fixture(scope="module", params=CASES)
def case(request):
    bench = replace(IDEAL, **CASES[request.param])
    return bench, register_frames(*recorded(bench))


@pytest.fixture(scope="module")
def ideal():
    return recorded(IDEAL)


def test_phase_is_recovered_however_the_second_image_stands(case):
    bench, registered = case
    assert np.nanstd(difference(bench, recover_phase(reduce_frames(registered, Optics())))) < 0.015


def test_placement_of_the_second_image_is_measured_within_its_errors(case):
    bench, registered = case
    placement = registered.placement
    measured = [*placement.shift, placement.rotation, placement.magnification]
    true = [*bench.offsets[1], bench.rotations[1], bench.magnifications[1]]
    assert np.all(np.abs(np.subtract(measured, true)) < 4 * placement.sigma)
    assert np.all(placement.sigma < [0.02, 0.02, 0.05, 5e-4])


def test_light_of_the_images_is_compared_whatever_their_size(case):
    bench, registered = case
    ratios = reduce_frames(registered, Optics()).flux_ratio
    np.testing.assert_allclose(ratios, 1 / bench.fluxes[1], rtol=0.005)


def test_bad_pixel_of_the_second_image_spoils_the_points_around_its_place():
    frames, clear_frames = recorded(replace(IDEAL, **EVERYTHING))
    cosine, sine = np.cos(np.radians(1.5)), np.sin(np.radians(1.5))
    turned = np.array([[cosine, sine], [-sine, cosine]])
    middle, there = (IDEAL.side - 1) / 2, np.array([-20.0, 33.0])  # from the middle of the first image
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


def test_noise_explains_the_frames_and_its_error_bar_holds(case):
    estimate = recover_phase(reduce_frames(case[1], Optics()))
    verdict = judge(estimate, NOISE)
    assert verdict.explained
    assert np.all(verdict.score > verdict.control + 0.5)
    far = estimate.measurement.good & ~near_edges(estimate.measurement)
    pulls = (difference(case[0], estimate) / verdict.sigma)[far]
    assert 0.8 < pulls.std() < 1.4


@pytest.mark.parametrize("wrong", [Optics(1.3), Optics(scale=1.1), Optics(unmasked=0.1), Optics(background=0.05)])
def test_wrong_model_is_not_explained(ideal, wrong):
    registered = register_frames(*ideal)
    assert not judge(recover_phase(reduce_frames(registered, wrong)), NOISE).explained


def test_frames_that_do_not_belong_together_score_like_the_control(ideal):
    frames, clear_frames = ideal
    upside_down = [frames[0], replace(frames[1], counts=frames[1].counts[::-1])]
    verdict = judge(recover_phase(reduce_frames(register_frames(upside_down, clear_frames), Optics())))
    assert np.all(verdict.score < 0.3)
    assert verdict.explained is None
    assert verdict.sigma is None


@pytest.mark.parametrize(
    ("aperture", "diameter_known", "least"),
    [
        ("LUVOIR", False, 0.02),
        ("LUVOIR", True, 0.009),
        pytest.param("GMT", False, 0.012, marks=pytest.mark.slow),
        pytest.param("GMT", True, 0.009, marks=pytest.mark.slow),
        pytest.param("Keck", False, 0.015, marks=pytest.mark.slow),
        pytest.param("Keck", True, 0.009, marks=pytest.mark.slow),
    ],
)
def test_pupils_with_many_edges_are_measured(aperture, diameter_known, least):
    """The circle lies around all segments, and a pixel that is lit in part has two areas."""
    bench = HcipyBench(aperture)
    settings = {"pupil_diameter": float(bench.pixels)} if diameter_known else {}
    registered = register_frames(*recorded(bench), **settings)
    assert registered.diameter == pytest.approx(bench.pixels, rel=0.025)
    errors = difference(bench, recover_phase(reduce_frames(registered, Optics())))
    assert np.count_nonzero(np.isfinite(errors)) > 0.98 * np.count_nonzero(bench.fully_lit)
    assert np.nanstd(errors) < least


# Frames of any bench: two arms on one camera image


@pytest.fixture(scope="module")
def arms():
    """A bench with a plain disc, its screen of 0.3 rad rms, and camera images: frame, clear frame and dark."""
    bench = HcipyBench(pixels=40, side=56, photons=1e4)
    screen = bench.smooth(0.3, 3)
    frame, clear = (np.hstack(bench.counts(screen, (2, masked), bool(masked))) for masked in (1, 0))
    return bench, screen, frame, clear, np.random.default_rng(5).normal(300, 5, frame.shape)


def arms_error(arms, phase, corner=(0, 0)):
    """Rms error at fully lit pixels, radian, of a phase that begins at a corner: 0.010 without faults."""
    bench, screen, *_ = arms
    return np.nanstd(bench.difference(phase.astype(float), corner, screen))


def test_windows_and_times_of_the_headers_place_and_scale_frames(arms, tmp_path, monkeypatch):
    """Frames of another window and time than the clear frames, darks of the whole detector."""
    monkeypatch.chdir(tmp_path)
    _, _, frame, clear, dark = arms
    ny, nx = frame.shape
    for name, counts, start, time in (
        ("frame", 3 * (frame + dark)[3:, 2:], (3, 2), 3.0),
        ("clear", clear + dark, (0, 0), 1.0),
        ("dark", dark, (0, 0), 1.0),
        ("dark3", 3 * dark, (0, 0), 3.0),
    ):
        header = fits.Header({"EXPTIME": time, "DETSEC": f"[{start[1] + 1}:{nx},{start[0] + 1}:{ny}]"})
        fits.writeto(f"{name}.fits", counts, header)
    files = ["--frames", "frame.fits", "--pupils", "clear.fits", "--dark", "dark3.fits", "dark.fits"]
    optics = ["--phase-shifts", "1.5708", "-1.5708", "--diameter", "1.06"]
    assert main(["calibrate", "bench.npz", *files, *optics]) == 0
    assert main(["reconstruct", "frame.fits", "--calibration", "bench.npz", "-o", "phase.fits", "--quiet"]) == 0
    header = fits.getheader("phase.fits")
    corner = header["CROPROW"] + 3, header["CROPCOL"] + 2
    assert arms_error(arms, fits.getdata("phase.fits")[0], corner) < 0.015


def test_clear_frames_of_another_window_are_placed_without_a_header(arms):
    _, _, frame, clear, _ = arms
    phases = phase_of(frame, clear[2:-3, 1:-2])
    origins = phases.measurement.registered.origins
    np.testing.assert_allclose(origins[:2] - origins[2:], [[2, 1]] * 2, atol=1e-9)


def spoiled(arms, kind):
    """Frame and clear frame with a fault."""
    frame, clear = arms[2].copy(), arms[3].copy()
    if kind == "dead column":
        frame[:, 25] = clear[:, 25] = 0
    elif kind == "hot column":
        frame[:, 25] = clear[:, 25] = 65535
    elif kind == "dead row of the frame":
        frame[30] = 0
    elif kind == "groups of hot pixels":
        for row, column in ((20, 25), (35, 30), (28, 80)):
            for image in (frame, clear):
                image[row : row + 2, column : column + 2] += 12000
    else:  # surroundings without counts around a frame with a background
        frame, clear = (np.pad(image + 100, 6) for image in (frame, clear))
    return frame, clear


@pytest.mark.parametrize(
    "kind", ["dead column", "hot column", "dead row of the frame", "groups of hot pixels", "padded"]
)
def test_faults_of_a_camera_are_found_without_a_map(arms, kind):
    phases = phase_of(*spoiled(arms, kind))
    pad = 6 * (kind == "padded")
    assert arms_error(arms, phases.phase, phases.measurement.registered.corner - pad) < 0.015


def test_arrays_have_a_saturation_and_an_exposure(arms):
    _, _, frame, clear, _ = arms
    longer = 3 * frame
    level = np.quantile(longer, 0.98)
    phases = phase_of(np.minimum(longer, level), clear, saturation=level, exposure=3.0)
    assert arms_error(arms, phases.phase, phases.measurement.registered.corner) < 0.015
    assert phases.measurement.n_bad > 20


UNEVEN = {
    "gradient": lambda y, x: (1, 1 + 0.3 * y),
    "vignette": lambda y, x: (1 - 0.25 * (x**2 + y**2), 1),
    "both arms": lambda y, x: (1 + 0.2 * x, np.exp(-(x**2) - y**2)),
    "one vignette for both": lambda y, x: (np.exp(-(x**2) - y**2),) * 2,
}


@pytest.mark.parametrize("kind", UNEVEN)
def test_gains_behind_the_masks_leave_the_phase_alone(arms, kind):
    bench, _, frame, clear, _ = arms
    rows, columns = (np.indices((bench.side,) * 2) - (bench.side - 1) / 2) * 2 / bench.pixels
    gain = np.hstack(np.broadcast_arrays(*UNEVEN[kind](rows, columns), rows)[:2])
    phases = phase_of(frame * gain, clear * gain)
    assert arms_error(arms, phases.phase, phases.measurement.registered.corner) < 0.012


def test_frames_off_the_clear_frames_give_a_warning(arms):
    _, _, frame, clear, _ = arms
    with pytest.warns(UserWarning, match="off its place on the clear frames"):
        phase_of(np.roll(frame, 2, axis=1), clear)


def test_masked_arrays_and_two_units_of_a_dark_are_read(arms, tmp_path):
    _, _, frame, clear, dark = arms
    bad = np.zeros(frame.shape, bool)
    bad[20, 25] = True
    phases = phase_of(np.ma.array(np.where(bad, 6e4, frame), mask=bad), clear)
    assert arms_error(arms, phases.phase, phases.measurement.registered.corner) < 0.015
    units = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(dark), fits.ImageHDU(dark[::-1])])
    units.writeto(tmp_path / "dark.fits")
    for name, counts in (("frame", frame + dark), ("clear", clear + dark)):
        np.save(tmp_path / f"{name}.npy", counts)
    files = ([tmp_path / name] for name in ("frame.npy", "clear.npy", "dark.fits"))
    calibration = Calibration.from_files(*files, diameter=1.06, phase_shifts=(np.pi / 2, -np.pi / 2))
    np.testing.assert_allclose(calibration.dark[0], (dark + dark[::-1]) / 2, rtol=1e-6)


def test_frames_that_no_phase_explains_give_a_warning(arms):
    _, _, frame, clear, _ = arms
    half = frame.shape[1] // 2
    for wrong in (np.hstack([frame[:, :half], frame[:, : half - 1 : -1]]), 2.5 * frame):
        with pytest.warns(UserWarning, match="The frames differ from their model by"):
            phases = phase_of(wrong, clear)
    assert "a mask makes no light" in judge(phases).findings["warnings"]


def test_verdict_names_cosmic_rays(arms):
    _, _, frame, clear, _ = arms
    frame = frame.copy()
    frame[18:21, 28:30] += 9000
    frame[36, 30:34] += 9000
    assert "cosmic rays" in judge(phase_of(frame, clear)).findings["warnings"]


def test_close_pupils_are_found(arms):
    clear = arms[3]
    close = np.hstack([clear[:, :51], clear[:, 61:]])  # 6 pixels apart
    assert [round(circle.diameter) for circle in find_pupils(Image.of(close, "clear"), 2)] == [40, 40]


def test_messages_name_the_cause(arms, tmp_path):
    _, _, frame, clear, _ = arms
    half = frame.shape[1] // 2
    for name, counts in (("frame", frame), ("clear", clear)):
        np.save(tmp_path / f"{name}.npy", np.stack([counts[:, :half], counts[:, half:]]))
    files = [tmp_path / "frame.npy"], [tmp_path / "clear.npy"]
    with pytest.raises(ValueError, match="n_images = 2 takes the two exposures of frame"):
        Calibration.from_files(*files, diameter=1.06, phase_shifts=(np.pi / 2, -np.pi / 2))
    with pytest.raises(ValueError, match="frames less the dark: all pixels are NaN"):
        phase_of(frame * np.nan, clear)
    files = [[tmp_path / f"{name}{k}.npy" for k in (1, 2)] for name in ("frame", "clear")]
    for path, counts in zip((*files[0], *files[1]), (frame, frame, clear, clear), strict=True):
        np.save(path, counts)
    with pytest.raises(ValueError, match="with both pupils on each exposure, set n_images = 1"):
        Calibration.from_files(*files, diameter=1.06, phase_shifts=(np.pi / 2, -np.pi / 2))
    lit = clear > clear.max() / 2
    marked = Image(np.where(lit, 0, clear), lit)
    with pytest.raises(ValueError, match="of its pixels are marked as bad: expected a map that is 0 where good"):
        find_pupils(marked, 2)


def test_weak_commands_are_remarked():
    data = SimpleNamespace(phases=0.01 * np.random.default_rng(1).normal(size=(3, 8, 8)), light=[0, [1.0]])
    point = SimpleNamespace(problem=SimpleNamespace(free=()))
    [remark] = _remarks(data, point, np.ones(8), (), False)
    assert remark.endswith("expected 0.02 or more.")


# One mask, one image


@pytest.fixture(scope="module")
def single():
    """A bench with one image, its screen (40 nm rms at 635 nm), frame and clear frame."""
    bench = HcipyBench(pixels=50, side=70, photons=2e4, blur=0.3)
    screen = bench.smooth(0.4, 3)
    return bench, screen, bench.counts(screen, (1, 1))[0], bench.counts(0 * screen, (1, 2), masked=False)[0]


def single_error(single, phase, corner):
    """Rms error at fully lit pixels, radian."""
    bench, screen, *_ = single
    return np.nanstd(bench.difference(phase, corner, screen))


@pytest.mark.filterwarnings("error")
def test_one_image_gives_the_phase_and_no_verdict(single):
    estimate = phase_of(*single[2:], phase_shifts=(np.pi / 2,))
    assert single_error(single, estimate.phase, estimate.measurement.registered.corner) < 0.015  # 1.5 nm
    verdict = judge(estimate, NOISE)
    assert verdict.explained is None
    assert np.isnan(verdict.score).all()
    assert "one image" in verdict.findings["fit"]
    assert np.nanmedian(verdict.sigma) == pytest.approx(0.006, rel=0.2)


def test_one_image_with_hot_pixels_or_cut_surroundings_stays_one(single):
    _, _, frame, clear = single
    frame, clear = frame.copy(), clear.copy()
    frame[[40, 50], [42, 35]] *= 10
    clear[:5] = 0
    assert np.isfinite(phase_of(frame, clear, phase_shifts=(np.pi / 2,)).phase).any()


def test_one_image_takes_the_road_of_two(single, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, image in (
        ("frame", single[2]),
        ("clear", single[3]),
        ("cube", np.stack([single[2], 0.1 * single[2]])),
    ):
        np.save(f"{name}.npy", image)
    options = ["--phase-shifts", "1.5708", "--diameter", "1.06"]
    assert main(["calibrate", "one.npz", "--frames", "frame.npy", "--pupils", "clear.npy", *options]) == 0
    assert main(["reconstruct", "cube.npy", "--calibration", "one.npz", "-o", "phase.fits", "--quiet"]) == 0
    phases, header = fits.getdata("phase.fits"), fits.getheader("phase.fits")
    corner = header["CROPROW"], header["CROPCOL"]
    assert single_error(single, phases[0].astype(float), corner) < 0.015
    np.testing.assert_allclose(phases[1], phases[0], rtol=0, atol=0.03)  # a tenth of the light
    assert "THETA2" not in header


def test_one_image_cannot_test_a_fit(single):
    images = [[Image(counts, np.zeros(counts.shape, bool))] for counts in single[2:]]
    optics = Optics(1.06, (np.pi / 2,))
    assert steps(*images, optics, ["scale"])[-1].name == "no fit: one image cannot test it"
    with pytest.raises(ValueError, match="expected none with one image"):
        fit(register_frames(*images, n_pupils=1), optics, ["scale"])
    with pytest.raises(ValueError, match=r"leakage = 0\.1: expected 0 with one phase shift"):
        Optics(1.06, (np.pi / 2,), leakage=0.1)
