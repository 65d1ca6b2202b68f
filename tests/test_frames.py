import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from scipy import ndimage

from zwfs import Dimple, Patch, PhaseShifted, Pupil, ZernikeSensor, power_law_screens, zernike_basis
from zwfs.bench import bench_error, write_bench
from zwfs.bench.model import Bench, BenchModel, segment_residual, segment_screens
from zwfs.frames import Calibration
from zwfs.frames import files as camera
from zwfs.frames.pipeline import Optics, phase_of, recover_phase, reduce_frames
from zwfs.frames.refine import fit, steps
from zwfs.frames.registration import Image, find_pupils, register, register_frames
from zwfs.frames.verdict import judge, order_of_images

SEAL = "ZWFS_SEAL_FRAMES"
D, MARGIN = 68, 12
COUNTS = 2e4
SHIFT = np.array([0.4, -0.7])  # of the second image, pixels
EXACT = {"pupil_centers": [[45.5, 45.5], [45.5, 137.5]], "pupil_diameter": D}
SECOND = SHIFT + np.array([0, 92])  # where it stands beside the first


def image(counts, name="camera.fits", bad=None):
    return Image(counts, np.zeros(counts.shape, bool) if bad is None else bad, name)


def shifted(frame, shift):
    """A frame moved by a fraction of a pixel, exactly as far as it is band-limited."""
    return np.fft.ifft2(ndimage.fourier_shift(np.fft.fft2(frame), shift)).real


def pair(phase=None, dark=500.0, flux=(1.0, 0.8), gap=0.03):
    """Two frames and two clear frames with both pupils on one camera: (64 + 24) x 2 columns, without noise."""
    pupil = Pupil.from_segments(layout := Pupil.hexagonal(D, 3, gap, (21,), 0.8).segments, 1 + 0.1 * (layout > 7))
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1 + 2 * MARGIN / D)
    masked = sensor.measure(np.zeros(pupil.shape) if phase is None else phase)
    bare = np.stack([np.pad(pupil.amplitude**2, MARGIN)] * 2)
    both = []
    for images in (masked, bare):
        images = [ndimage.gaussian_filter(frame, 0.7) * part for frame, part in zip(images, flux, strict=True)]
        images[1] = shifted(images[1], SHIFT)
        both.append(np.hstack(images) * COUNTS + dark)
    return pupil, *both


@pytest.fixture(scope="module")
def screen():
    return power_law_screens(zernike_basis(Pupil.circular(D), 60), 0.4, 1, seed=3)[0]


@pytest.fixture(scope="module")
def recorded(screen):
    return pair(screen)


def on_grid(estimate, registered):
    """The phase on the grid of `pair`."""
    canvas = np.full(registered.clear_frames[0].counts.shape, np.nan)
    row, column = registered.corner
    n = registered.n_pixels
    canvas[row : row + n, column : column + n] = estimate.phase
    return canvas[MARGIN : MARGIN + D, MARGIN : MARGIN + D]


def error(estimate, registered, truth):
    phase = on_grid(estimate, registered)
    waves = np.exp(1j * (phase - truth)[np.isfinite(phase)])
    return np.sqrt(np.mean(np.angle(waves * np.conj(waves.mean())) ** 2))


# Registration


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.45), (-2.6, 3.35)])
def test_register_finds_a_known_shift(shift):
    segments = Pupil.hexagonal(100, 3, 0.03, stop=0.8).segments
    reference = ndimage.gaussian_filter(np.pad((segments > 0).astype(float), 10), 1.0)
    noise = np.random.default_rng(1).normal(0, 0.02, (2, *reference.shape))
    inside = np.hypot(*(np.mgrid[:120, :120] - 59.5)) < 45
    placement = register(shifted(reference, shift) + noise[0], reference + noise[1], inside)
    np.testing.assert_allclose(placement.shift, shift, atol=0.03)


def test_register_refuses_a_shift_out_of_reach():
    reference = ndimage.gaussian_filter(np.random.default_rng(1).random((100, 100)), 2)
    inside = np.hypot(*(np.mgrid[:100, :100] - 49.5)) < 35
    with pytest.raises(ValueError, match="the end of the search"):
        register(np.roll(reference, 9, axis=0), reference, inside)


@pytest.mark.parametrize("illumination", [0.0, 0.5])
@pytest.mark.parametrize("center", [(50.0, 52.0), (49.3, 51.75)])
def test_circle_through_the_outline(center, illumination):
    rows, columns = np.mgrid[:104, :105]
    distance = np.hypot(rows - center[0], columns - center[1])
    disc = np.clip(34.2 - distance + 0.5, 0, 1) * (1 + illumination * (columns - 52) / 68)
    (circle,) = find_pupils(image(COUNTS * disc + 300), 1)
    assert np.hypot(circle.row - center[0], circle.column - center[1]) < 0.1 + 0.3 * illumination
    assert circle.diameter == pytest.approx(68.4, abs=0.3)


@pytest.mark.parametrize("missing", [(), (20,), (22, 23), (29,), (19, 25, 31)])
def test_dark_outer_segments_do_not_move_the_outline(missing):
    """On rays through them there is only noise."""
    lit = np.pad(Pupil.hexagonal(D, 3, 0.02, missing).inside, MARGIN)
    (circle,) = find_pupils(image(np.random.default_rng(1).normal(300 + 2000.0 * lit, 40)), 1)
    assert circle == pytest.approx([45.5, 45.5, D - 2], abs=0.3)  # the blur of the search rounds off corners


def test_cropped_mask_out_images_are_found_on_the_frames():
    _, masked, bare = pair()
    crops = [np.pad(half[10:-10, 10:-10], 0) for half in np.hsplit(bare, 2)]
    registered = register_frames([image(masked)], [image(crop, f"crop{i}") for i, crop in enumerate(crops)])
    # The mask moves the outline; content of a flat wavefront brings it back.
    np.testing.assert_allclose(registered.origins[:2] - 10, [[0, 0], SECOND], atol=1.0)


def test_stacked_pupils_and_given_centers(recorded):
    _, masked, bare = recorded
    turned = [image(np.vstack(np.hsplit(frame, 2))) for frame in (masked, bare)]
    registered = register_frames(turned[:1], turned[1:])
    np.testing.assert_allclose(registered.origins[1], [92 + SHIFT[0], SHIFT[1]], atol=0.1)
    centred = register_frames(
        [image(masked)], [image(bare)], pupil_centers=[[45.5, 45.5], [46, 137]], pupil_diameter=D
    )
    np.testing.assert_allclose(centred.origins[1], SECOND, atol=0.1)


# Measurement


def test_background_and_flux_are_measured(recorded):
    pupil, masked, bare = recorded
    measurement = reduce_frames(register_frames([image(masked)], [image(bare)]), Optics())
    np.testing.assert_allclose(measurement.background, 500, rtol=0.02)
    assert measurement.flux_ratio[1] == pytest.approx(1.25, rel=0.01)
    # Mask in, the light of two opposite masks is the same: the frames show the same ratio.
    assert measurement.flux_ratio[0] == pytest.approx(1.25, rel=0.02)
    # Blur spreads the same light over the gaps, too.
    light = np.sum(measurement.pupil.amplitude**2 + measurement.rest)
    assert measurement.counts[0] * light == pytest.approx(COUNTS * pupil.n_points, rel=0.02)


def test_arms_that_are_lit_differently_hardly_change_the_phase(screen):
    phases = []
    for slope in (0.0, 0.1):
        gain = 1 + slope * np.linspace(-1, 1, D + 2 * MARGIN) * (D + 2 * MARGIN) / D  # 10 % at the edge
        _, masked, bare = pair(screen, flux=(1.0, gain))
        registered = register_frames([image(masked)], [image(bare)])
        phases.append(on_grid(recover_phase(reduce_frames(registered, Optics())), registered))
    assert np.nanstd(phases[1] - phases[0]) < 0.01


def test_hot_and_dead_pixels_without_a_map_are_found(screen):
    _, *clean = pair(screen)
    rng = np.random.default_rng(8)
    noisy = [rng.normal(frame, 100.0) for frame in clean]
    lit = np.flatnonzero(ndimage.binary_erosion(clean[1] > 0.5 * COUNTS, iterations=2))
    hot, dead = rng.choice(lit, (2, 30), replace=False)
    for frame in noisy:
        frame.flat[hot] += COUNTS
        frame.flat[dead] = 500
    registered = register_frames([image(noisy[0])], [image(noisy[1])])
    bad = registered.frames[0].bad
    assert bad.flat[hot].mean() > 0.9
    assert bad.flat[dead].mean() > 0.75
    assert 45 < np.count_nonzero(bad) < 70
    assert registered.n_odd >= np.count_nonzero(bad)
    assert register_frames([image(clean[0])], [image(clean[1])]).n_odd < 20


@pytest.mark.parametrize("balance", [False, True])
def test_balance_gives_both_frames_the_same_light_in_the_pupil(recorded, balance):
    _, masked, bare = recorded
    uneven = masked - 500
    uneven[:, 92:] *= 0.9
    measurement = reduce_frames(
        register_frames([image(uneven)], [image(bare - 500)], background=False, balance=balance), Optics()
    )
    light = measurement.intensity[(..., *measurement.window)][:, measurement.good].mean(axis=1)
    assert light[0] / light[1] == pytest.approx(1 if balance else 1 / 0.9, rel=1e-12 if balance else 0.02)


def test_leakage_and_unmasked_light_are_undone(screen):
    pupil, *_ = pair()
    optics = Optics(leakage=0.1, unmasked=0.2)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1 + 2 * MARGIN / D)
    ideal = sensor.measure(screen)
    bare = np.stack([np.pad(pupil.amplitude**2, MARGIN)] * 2)
    mixed = 0.8 * (0.9 * ideal + 0.1 * ideal[::-1]) + 0.2 * bare
    registered = register_frames([image(np.hstack(mixed))], [image(np.hstack(bare))], subpixel=False, **EXACT)
    estimate = recover_phase(reduce_frames(registered, optics), 100)
    assert error(estimate, registered, screen) < 1e-3
    np.testing.assert_allclose(estimate.agreement.correlation, 1, atol=1e-5)
    plain = Optics()
    assert error(recover_phase(reduce_frames(registered, plain), 100), registered, screen) > 0.03


def ring(u, v):
    return np.where(np.hypot(u, v) < 0.4, 1.0, -1j)


@pytest.mark.parametrize("second", [Dimple(1.6, -2.0), Patch(1.2, ring, breaks=[0.8])])
def test_masks_other_than_a_pair_of_dimples_are_taken(tmp_path, screen, second):
    pupil, *_ = pair()
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), second, extent=1 + 2 * MARGIN / D)
    frames, bare = sensor.measure(screen), np.stack([np.pad(pupil.amplitude**2, MARGIN)] * 2)
    registered = register_frames([image(np.hstack(frames))], [image(np.hstack(bare))], subpixel=False, **EXACT)
    measurement = reduce_frames(registered, Optics(masks=sensor.masks))
    assert error(recover_phase(measurement, 100), registered, screen) < 0.01
    with pytest.raises(ValueError, match="masks are objects"):
        Calibration.of(measurement).save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="holds 'diameter'"):
        fit(registered, measurement.optics, ["diameter"])


def test_fit_finds_the_diameter_and_the_scale(screen):
    pupil, *_ = pair()
    sensor = ZernikeSensor(pupil, Dimple(1.2, np.pi / 2), Dimple(1.2, -np.pi / 2), extent=1 + 2 * MARGIN / D)
    frames, bare = 1.3 * sensor.measure(screen) + 0.04, np.stack([np.pad(pupil.amplitude**2, MARGIN)] * 2)
    registered = register_frames([image(np.hstack(frames))], [image(np.hstack(bare))], subpixel=False, **EXACT)
    _, optics = fit(registered, Optics(), ["diameter", "scale", "background"], n_steps=20)
    assert optics.diameter == pytest.approx(1.2, abs=0.02)
    assert optics.scale == pytest.approx(1 / 1.3, abs=0.02)
    assert optics.background == pytest.approx(0.04 / 1.3, abs=0.01)


def test_fit_leaves_a_clear_image_where_registration_is_sure_of_it(recorded):
    _, masked, bare = recorded
    registered = register_frames([image(masked)], [image(bare)])
    refined, optics = fit(registered, Optics(scale=1.2), ["registration", "scale"], n_steps=3)
    assert optics.scale == pytest.approx(1, abs=0.05)
    assert not np.array_equal(refined.origins[:2], registered.origins[:2])
    np.testing.assert_array_equal(refined.origins[2:], registered.origins[2:])


# Order of the images


def poked_pair(screen, height):
    """Measurements before and after a poke, with the images in the given order of the phase shifts."""
    y, x = (np.mgrid[:D, :D] - (D - 1) / 2) / D
    poke = height * np.exp(-((x + 0.15) ** 2 + (y - 0.1) ** 2) / 0.06**2)
    rng, both = np.random.default_rng(4), []
    for phase in (screen, screen + poke):
        _, masked, bare = pair(phase)
        both.append(reduce_frames(register_frames([image(rng.poisson(masked) * 1.0)], [image(bare)]), Optics()))
    return both


@pytest.mark.parametrize("height", [0.4, -0.4])
def test_order_of_the_images_follows_from_a_poke(screen, height):
    right = poked_pair(screen, height)
    wrong = [replace(measurement, optics=Optics(phase_shifts=(-np.pi / 2, np.pi / 2))) for measurement in right]
    for measured, exchanged in ((right, False), (wrong, True)):
        order = order_of_images(*measured, sign=int(np.sign(height)))
        assert order.exchanged == exchanged
        assert order.optics.phase_shifts == (np.pi / 2, -np.pi / 2)
        assert order.score > 0.8


def test_order_without_a_poke_is_refused(screen):
    flat, poked = poked_pair(screen, 0.0)
    with pytest.raises(ValueError, match="flat and poked: the change of phase scores"):
        order_of_images(flat, poked)
    with pytest.raises(ValueError, match="flat and poked differ in optics"):
        order_of_images(flat, replace(poked, optics=Optics(1.1)))


# Bad frames


def test_frames_without_two_equal_pupils_are_refused(recorded):
    _, masked, bare = recorded
    with pytest.raises(ValueError, match=r"empty\.fits: every pixel is 0: expected light"):
        register_frames([image(masked)], [image(np.zeros_like(bare), "empty.fits")])
    with pytest.raises(ValueError, match="1 bright regions as large as a pupil: expected 2, because two images"):
        register_frames([image(masked)], [image(np.hsplit(bare, 2)[0])])
    with pytest.raises(
        ValueError, match=r"expected 1, because another image holds .* or phase_shifts has one value"
    ):
        register_frames([image(masked)], [image(bare)], n_pupils=1)
    left, right = np.hsplit(bare, 2)
    small = ndimage.zoom(right, 0.9, order=1)
    with pytest.raises(ValueError, match=r"the two pupils are 61\.\d and 6\d\.\d pixels wide"):
        register_frames([image(left), image(right)], [image(left, "left"), image(small, "right")])


@pytest.mark.parametrize(
    ("cut", "side"),
    [(np.s_[30:, :], "top"), (np.s_[:-30, :], "bottom"), (np.s_[:, 30:], "left"), (np.s_[:, :-30], "right")],
)
def test_cut_pupil_is_refused(recorded, cut, side):
    _, masked, bare = recorded
    with pytest.raises(ValueError, match=f"is cut off at the {side}"):
        register_frames([image(masked[cut])], [image(bare[cut])])


def test_too_many_masked_points_are_refused(recorded):
    _, masked, bare = recorded
    bad = np.zeros(masked.shape, bool)
    bad[:, 30:50] = True
    with pytest.raises(ValueError, match=r"points of the pupil are bad or saturated: expected at most 20%"):
        reduce_frames(register_frames([image(masked, bad=bad)], [image(bare)]), Optics())


# The simulated bench


def test_bench_writes_what_the_pipeline_reads(tmp_path):
    bench = Bench(n_pixels=D, gap=0.02, stop=0.8)
    commanded = segment_screens(bench, 0.3, 1, seed=2)[0]
    written = write_bench(tmp_path, bench, commanded, n_bad=40, seed=1)
    kinds = ("frame", "pupils", "dark", "bad_pixels")
    frames, clear_frames, [source, *_] = camera.read_all(*([written[kind]] for kind in kinds))
    assert source.keyword("WAVELEN") == 635
    assert source.keyword("DIMPLE") == 1.06
    assert fits.getheader(tmp_path / "frame.fits")["BITPIX"] == 16
    assert np.count_nonzero(frames[0].bad) == 40
    registered = register_frames(frames, clear_frames)
    # The bench sets the images half a pixel apart.
    np.testing.assert_allclose(registered.origins[3], [-0.5, 89.5], atol=0.1)
    estimate = recover_phase(reduce_frames(registered, Optics()))
    error = bench_error(bench, commanded, estimate)
    model = BenchModel.from_images(bench, 1)
    informed = PhaseShifted(model.shifted)(model.normalise(bench.frames(commanded, 1))).phase
    # As good as one who knows where the pupils stand.
    assert error < segment_residual(model.pistons(informed), commanded).std() + 0.03 < 0.18
    written = write_bench(tmp_path, bench, seed=2)
    flat = camera.read_all([written["frame"]], [written["pupils"]], [written["dark"]])[:2]
    flat = recover_phase(reduce_frames(register_frames(*flat), Optics()))
    assert bench_error(bench, commanded, estimate, flat) < 0.7 * error


def test_phase_file_says_where_it_comes_from(tmp_path, recorded):
    _, masked, bare = recorded
    masked = masked.copy()
    masked[:, 92:] = 500 + 0.9 * (masked[:, 92:] - 500)  # its second image has less light than that without a mask
    bad = np.zeros(masked.shape, bool)
    bad[40, 50] = True
    registered = register_frames([image(masked, bad=bad)], [image(bare)])
    optics = Optics(diameter=1.1)
    estimate = recover_phase(reduce_frames(registered, optics))
    source = camera.CameraFile(masked[np.newaxis], "frame.fits", "ab" * 32, {"DATE-OBS": "2023-05-01"})
    for name in ("a.fits", "b.fits"):
        camera.write_phase(tmp_path / name, estimate, 635.0, [source])
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    with fits.open(tmp_path / "a.fits") as units:
        units.verify("exception")
        header = units[0].header
        np.testing.assert_array_equal(units[0].data, estimate.phase)
        np.testing.assert_allclose(units["PHASE_NM"].data, estimate.phase * 635 / (2 * np.pi), rtol=1e-6)
        assert units["BAD"].data.sum() == estimate.measurement.n_bad == header["NBAD"] > 0
        assert (header["BUNIT"], units["PHASE_NM"].header["BUNIT"]) == ("rad", "nm")
        assert (header["WAVELEN"], header["DIMPLE"]) == (635, 1.1)
        assert [header[f"CORR{i}"] for i in (1, 2)] == pytest.approx([*estimate.agreement.correlation])
        masked_halves, bare_halves = (np.split(frame - 500, 2, axis=1) for frame in (masked, bare))
        light = [first.sum() / second.sum() for first, second in (masked_halves, bare_halves)]
        assert [header["FLUXMASK"], header["FLUXOUT"]] == pytest.approx(light, rel=0.02)
        assert [header["ROW2"] - header["ROW1"], header["COL2"] - header["COL1"]] == pytest.approx(SECOND, abs=0.1)
        assert (header["FILE1"], header["SHA1"], header["DATE-OBS"]) == ("frame.fits", "ab" * 32, "2023-05-01")
        assert header["CREATOR"].startswith("zwfs ")
    with pytest.raises(ValueError, match="wavelength = 0"):
        camera.write_phase(tmp_path / "c.fits", estimate, 0)
    assert not (tmp_path / "c.fits").exists()
    (tmp_path / "mine.fits").write_text("precious")
    with pytest.raises(ValueError, match=r"mine\.fits' exists and is not a phase map"):
        camera.write_phase(tmp_path / "mine.fits", estimate, 635.0)


# The real bench


@pytest.fixture(scope="module")
def seal():
    folder = os.environ.get(SEAL)
    if not folder:
        pytest.skip(f"{SEAL} is not set: the frames of the SEAL bench carry no licence and are not part of this")
    names = ["onDimple"], ["offDimpleLeft", "offDimpleRight"]
    paths = ([Path(folder) / f"img_{name}_ZWFS_SEAL.npy" for name in kind] for kind in names)
    return camera.read_all(*paths)[:2]


@pytest.fixture(scope="module")
def seal_steps(seal):
    """Do all steps on a frame with the clear frames of the bench."""
    names = ["registration", "background", "scale"]
    return lambda frame: steps([frame], seal[1], Optics(), names, pupil_diameter=136.0)


@pytest.fixture(scope="module")
def seal_work(seal, seal_steps):
    return seal_steps(seal[0][0])


@pytest.mark.slow
def test_seal_frames_are_explained(seal_work):
    named = {step.name: step.result for step in seal_work}
    # Already the light of the two frames, balanced, and nothing fitted.
    assert named["balance of the flux"].agreement.correlation == pytest.approx([0.83, 0.90], abs=0.02)
    first, second = seal_work[-1].result.agreement.correlation
    assert first > 0.87
    assert second > 0.91
    assert seal_work[-1].result.measurement.n_bad == 0
    # One frame predicts the other one far better than the outlines alone let it.
    assert np.all(seal_work[-1].predicted > seal_work[0].predicted + 0.05)
    assert np.all(seal_work[-1].predicted > seal_work[-1].control + 0.25)
    # Their light is uneven, and they do not show a rotation.
    measurement = seal_work[-1].result.measurement
    assert measurement.flux_ratio == pytest.approx((1.22, 1.02), abs=0.01)
    assert np.isnan(measurement.registered.placement.sigma[2:]).all()
    assert np.all(measurement.registered.placement.sigma[:2] < 0.5)
    for step in (seal_work[3], seal_work[-1]):
        verdict = judge(step.result)
        assert "The scale of the phase is not determined" in verdict.findings["scale"]
        assert verdict.strengths[1] > 2 * verdict.strengths[0]


@pytest.mark.slow
def test_seal_frames_that_do_not_belong_together_are_refused(seal, seal_steps):
    frame = seal[0][0]
    left, right = np.hsplit(frame.counts, 2)
    with pytest.raises(ValueError, match=r"the best shift of the images is .* the end of the search"):
        seal_steps(Image(np.hstack([left, right[::-1]]), frame.bad, "nonsense"))


def test_first_look_is_that_of_the_single_steps():
    bench = Bench(n_pixels=40)
    frames, clear = bench.frames(), bench.clear_frames()
    estimate = phase_of(frames + 100, clear + 100, np.full(clear[0].shape, 100.0))
    images = ([Image(counts, np.zeros(counts.shape, bool)) for counts in pair] for pair in (frames, clear))
    expected = recover_phase(reduce_frames(register_frames(*images), Optics()))
    np.testing.assert_allclose(estimate, expected, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(phase_of(frames, clear), expected)
    np.testing.assert_array_equal(Calibration.from_arrays(frames, clear)(frames), expected)
