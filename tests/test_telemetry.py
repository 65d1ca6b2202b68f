"""A calibrated bench and its telemetry: phases, flags, what is refused, and that no frame is lost."""

import json
import os
import pickle
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from zwfs import (
    Dimple,
    GerchbergSaxton,
    GradientDescent,
    Linear,
    MaximumLikelihood,
    PhaseShifted,
    Pupil,
    ZernikeSensor,
    power_law_screens,
    zernike_basis,
)
from zwfs._images import nearest_good
from zwfs.frames import Calibration, FileError, reconstruct
from zwfs.frames.__main__ import main
from zwfs.frames._stack import Stack
from zwfs.frames.phases import Flag
from zwfs.frames.pipeline import Optics, iterated_phase, reduce_frames
from zwfs.frames.registration import Image, register_frames

from .conftest import code_of

D, MARGIN, PHOTONS, DARK = 40, 8, 1e4, 500
OPTICS = {"DIMPLE": 1.06, "THETA1": np.pi / 2, "THETA2": -np.pi / 2, "BUNIT": "adu"}


class Bench:
    """Camera images of a simulated bench: both pupils on one image, 16 bit, photon noise."""

    pupil = Pupil.hexagonal(D, 2, 0.03, (9,), 0.8)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1 + 2 * MARGIN / D)
    screens = power_law_screens(zernike_basis(Pupil.circular(D), 60), 0.4, 12, seed=3)

    def __init__(self):
        self.rng = np.random.default_rng(1)
        self.flat = self.expose(self.sensor.measure(np.zeros(self.pupil.shape)))
        self.clear = self.expose(np.stack([np.pad(self.pupil.amplitude**2, MARGIN)] * 2))
        self.frames = self.expose(self.sensor.measure(self.screens))

    def expose(self, frames):
        image = np.concatenate(list(np.moveaxis(frames, -3, 0)), axis=-1)
        return np.rint(self.rng.poisson(image * PHOTONS) + DARK).astype(np.uint16)

    def image(self, counts, bad=None):
        bad = np.zeros(counts.shape, bool) if bad is None else bad
        return Image(nearest_good(counts - float(DARK), ~bad), bad, "camera.fits", dark=float(DARK))

    def registered(self, bad=None):
        return register_frames([self.image(self.flat, bad)], [self.image(self.clear)])

    @property
    def dark(self):
        return np.full(self.flat.shape, float(DARK))

    def calibration(self, optics=Optics(), bad=None, **settings):  # noqa: B008
        measurement = reduce_frames(self.registered(bad), optics)
        return Calibration.of(measurement, saturation=65535, **settings)


@pytest.fixture(scope="module")
def bench():
    return Bench()


@pytest.fixture(scope="module")
def calibration(bench):
    return bench.calibration(bunit="adu")


@pytest.fixture
def folder(tmp_path, monkeypatch, bench, calibration):
    """A folder with a cube, its calibration, and the files from which a calibration is made."""
    monkeypatch.chdir(tmp_path)
    header = fits.Header(OPTICS)
    fits.PrimaryHDU(bench.frames, fits.Header(OPTICS | {"EXPTIME": 0.01})).writeto("cube.fits")
    for name, image in (("frame", bench.flat), ("pupils", bench.clear), ("dark", bench.dark.astype(np.uint16))):
        fits.PrimaryHDU(image, header).writeto(f"{name}.fits")
    calibration.save("bench.npz")
    return tmp_path


def rms(difference):
    difference = difference[np.isfinite(difference)]
    return np.sqrt(np.mean((difference - difference.mean()) ** 2))


# The calibrated object


@pytest.mark.parametrize(
    ("optics", "apart"), [(Optics(), 2e-3), (Optics(leakage=0.05, unmasked=0.1, background=0.02), 0.01)]
)
@pytest.mark.parametrize("n_bad", [0, 30])
def test_phase_is_that_of_the_plain_iteration_in_double_precision(bench, optics, apart, n_bad):
    """But for the light, which a call measures in each frame; with wrong optics it differs more."""
    bad = np.zeros(bench.flat.shape, bool)
    bad.flat[np.random.default_rng(2).choice(bad.size, n_bad, replace=False)] = True
    calibration = bench.calibration(optics, bad, tolerance=1e-5, n_iterations=50)
    estimate = calibration(np.where(bad, np.nan, bench.frames[:3]))  # known bad pixels raise no flag
    registered = bench.registered(bad)
    for phase, counts in zip(estimate.phase, bench.frames, strict=False):
        exposure = replace(registered, frames=(bench.image(counts, bad),) * 2)
        measurement = reduce_frames(exposure, optics)
        assert rms(phase - iterated_phase(measurement, 60, 1e-6)) < apart
        np.testing.assert_array_equal(np.isfinite(phase), measurement.good)
    assert not estimate.flags.any()


def test_calibration_needs_no_flat_mirror(bench, calibration):
    aberrated = register_frames([bench.image(bench.frames[0])], [bench.image(bench.clear)])
    recalibrated = Calibration.of(reduce_frames(aberrated, Optics()), saturation=65535)
    np.testing.assert_array_equal(recalibrated.places[0, :, 0, 0].round(), calibration.places[0, :, 0, 0].round())
    assert rms(recalibrated(bench.frames).phase - calibration(bench.frames).phase) < 0.03


def test_longer_exposure_time_of_the_frames_changes_no_phase(bench, calibration):
    def longer(counts):
        return 3.0 * counts - 2 * DARK

    registered = register_frames([bench.image(longer(bench.flat))], [bench.image(bench.clear)], exposure=3.0)
    recalibrated = Calibration.of(reduce_frames(registered, Optics()), saturation=1e6)
    estimate, expected = recalibrated(longer(bench.frames[:2])), calibration(bench.frames[:2])
    np.testing.assert_allclose(estimate.phase, expected.phase, rtol=0, atol=1e-4)
    assert not estimate.flags.any()


def test_calibration_is_kept_in_a_file_and_in_a_pickle(tmp_path, bench, calibration):
    calibration.save(tmp_path / "a.npz")
    loaded = Calibration.load(tmp_path / "a.npz")
    loaded.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    expected = calibration(bench.frames[:2]).phase
    for restored in (loaded, pickle.loads(pickle.dumps(calibration))):
        np.testing.assert_array_equal(restored(bench.frames[:2]).phase, expected)
        assert restored.sha256 == calibration.sha256
        with pytest.raises(ValueError, match="read-only"):
            restored.amplitude[0, 0] = 1
        with pytest.raises(AttributeError):
            restored.n_images = 2


def rewritten(path, **changes):
    """The same file with other values."""
    with np.load(path) as file:
        arrays = dict(file)
    values = json.loads(str(arrays["values"])) | changes
    np.savez(path, **(arrays | {"values": np.array(json.dumps(values))}))


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda path: np.savez(path, x=np.ones(3)), "expected a calibration"),
        (lambda path: rewritten(path, format=99), "a calibration of format 99: expected format 2"),
        (lambda path: rewritten(path, saturation=0), "a broken calibration: saturation = 0"),
    ],
)
def test_file_that_is_no_calibration_is_named(folder, break_it, message):
    break_it(folder / "bench.npz")
    with pytest.raises(FileError, match=f"bench.npz: {message}"):
        reconstruct("cube.fits", "bench.npz", "phase.fits")
    assert not list(folder.glob("*phase*"))


SPOIL = {
    "dark beyond all counts": ("dark.fits", lambda image: image + 1e38),
    "bad half of the dark": ("dark.fits", lambda image: np.where(np.arange(112) < 56, np.nan, image)),
    "bad half of the map": ("map.fits", lambda image: np.arange(112) + 0 * image < 56),
    "frames without light": ("frame.fits", lambda image: 0 * image),
}


@pytest.mark.parametrize("kind", SPOIL)
def test_refusal_of_a_calibration_names_the_bad_file(folder, bench, kind):
    name, spoil = SPOIL[kind]
    fits.PrimaryHDU(np.zeros(bench.flat.shape)).writeto("map.fits")
    image = spoil(fits.getdata(name).astype(float))
    fits.PrimaryHDU(image.astype(float), fits.Header(OPTICS)).writeto(name, overwrite=True)
    with pytest.raises(ValueError, match=name):
        Calibration.from_files(["frame.fits"], ["pupils.fits"], ["dark.fits"], ["map.fits"])


def test_calibration_replaces_no_other_file(folder, calibration):
    with pytest.raises(ValueError, match="exists and is not a calibration"):
        calibration.save("cube.fits")
    calibration.save("bench.npz")


# Other methods, other light


@pytest.mark.parametrize("method", [
    Linear,
    lambda sensor, modes: PhaseShifted(sensor),
    lambda sensor, modes: GerchbergSaxton(sensor, n_iterations=100, unmeasured="model"),
    lambda sensor, modes: GradientDescent(sensor, n_iterations=100),
    lambda sensor, modes: GradientDescent(sensor, modes, n_iterations=100),
    lambda sensor, modes: MaximumLikelihood(sensor),
    lambda sensor, modes: MaximumLikelihood(sensor, photons=PHOTONS),
    lambda sensor, modes: MaximumLikelihood(sensor, modes, photons=PHOTONS),
])  # fmt: skip
def test_each_method_recovers_a_poke(bench, calibration, method):
    modes = zernike_basis(Pupil.circular(D), 60)
    poke = 0.3 * modes[3]
    counts = bench.expose(bench.sensor.measure(np.stack([0 * poke, poke])))
    wide = zernike_basis(calibration.sensor.pupil, 60, orthonormal=True)
    phases = calibration(counts, method=method(calibration.sensor, wide)).phase
    change = nearest_good(phases[1] - phases[0], np.isfinite(phases[0]))
    shape = np.array(calibration.good.shape)
    first = (shape - D) // 2
    change = change[first[0] : first[0] + D, first[1] : first[1] + D]
    assert rms(np.where(bench.pupil.inside, change - poke, np.nan)) < 0.05


@pytest.mark.parametrize("faint", [1.0, 0.5, 0.01])
def test_light_is_measured_in_each_frame(bench, calibration, faint):
    image = np.concatenate(list(bench.sensor.measure(bench.screens[0])), axis=-1)
    counts = np.random.default_rng(5).poisson(faint * PHOTONS * image) + DARK
    estimate, bright = calibration(counts), calibration(bench.frames[0])
    assert estimate.flags == 0
    assert estimate.flux == pytest.approx(faint, rel=0.03)
    assert rms(estimate.phase - bright.phase) < 1.5 / np.sqrt(faint * PHOTONS)


def test_calibration_takes_the_dark_of_the_frames(folder, bench):
    for name, image in (("long", bench.dark + 100), ("short", bench.dark)):
        fits.PrimaryHDU(np.stack([image - 1, image + 1])).writeto(f"{name}.fits")
    fits.PrimaryHDU(bench.flat + 100.0, fits.Header(OPTICS)).writeto("frame.fits", overwrite=True)
    mixed = Calibration.from_files(["frame.fits"], ["pupils.fits"], ["long.fits"], pupil_dark_files=["short.fits"])
    np.testing.assert_array_equal(mixed.dark[0], bench.dark + 100)
    expected = Calibration.from_files(
        ["frame.fits"], ["pupils.fits"], ["long.fits"], pupil_dark_files=["dark.fits"]
    )
    np.testing.assert_array_equal(mixed(bench.frames[0] + 100.0).phase, expected(bench.frames[0] + 100.0).phase)


# Flags


def pixel(calibration, point, image=0):
    """Row and column on the camera of a point of the grid."""
    return tuple(np.rint(calibration.places[image, :, *point]).astype(int))


def test_frames_with_faults_are_flagged_and_the_others_stay(bench, calibration):
    frames = np.stack([bench.frames[0].astype(float)] * 8)
    inside = np.argwhere(calibration.good)[200]
    frames[1] = DARK  # the shutter is closed
    frames[2] = np.nan
    frames[3][pixel(calibration, inside)] = 65535
    frames[4][pixel(calibration, inside, 1)] = np.nan
    frames[5, 0, 0] = np.inf  # outside the pupil
    frames[6, :, : frames.shape[2] // 2] = DARK  # an image is lost
    frames[7, 20:40] = -np.inf
    estimate = calibration(frames)
    bad, saturated = Flag.BAD_PIXELS, Flag.BAD_PIXELS | Flag.SATURATED
    assert estimate.flags.tolist() == [0, 1, 3, saturated, bad, 0, 1, 3]
    lost = estimate.flags & Flag.LOST > 0
    assert np.isnan(estimate.phase[lost]).all()
    good = estimate.phase[0]
    for index, image in ((3, 0), (4, 1)):
        assert estimate.n_bad[index] == 1
        touched = np.argwhere(np.isnan(estimate.phase[index]) & np.isfinite(good))
        assert 1 <= len(touched) <= 4
        assert np.abs(touched - inside).max() <= 1, image
        assert rms(estimate.phase[index] - good) < 0.02
    assert estimate.n_saturated.tolist() == [0, 0, 0, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(estimate.phase[5], good)


def test_iteration_that_does_not_end_is_flagged(bench, calibration):
    assert (replace(calibration, n_iterations=1)(bench.frames).flags & Flag.NOT_CONVERGED).all()
    assert not replace(calibration, n_iterations=3, tolerance=0.0)(bench.frames).flags.any()


def test_frames_between_bad_ones_stay_and_none_is_left_out(folder, bench, calibration):
    cube, half = bench.frames.astype(np.float32), bench.frames.shape[2] // 2
    cube[[3, 7]] = np.nan
    cube[5, :, half:] = cube[6, :, half:]  # two images that do not belong together
    np.save("wrong.npy", cube)
    options = {"modes": 3, "phases": True, "saturation": 65535}
    summary = reconstruct("wrong.npy", calibration, "phase.fits", **options)
    assert (summary.counts["LOST"], summary.counts["INCONSISTENT"], summary.n_flagged) == (2, 1, 3)
    phase, table = fits.getdata("phase.fits"), fits.getdata("phase.fits", "FRAMES")
    assert np.flatnonzero(table["FLAGS"]).tolist() == [3, 5, 7]
    assert np.isnan(phase[[3, 7]]).all()
    assert np.isnan(table["COEFFS"][[3, 7]]).all()
    others = np.delete(np.arange(12), [3, 5, 7])
    expected = calibration(bench.frames).phase[others]  # other batches, so the sums are rounded otherwise
    np.testing.assert_allclose(phase[others], expected, rtol=0, atol=1e-6)
    assert table["RESIDUAL"][5] > 2 * table["RESIDUAL"][others].max()
    strict = reconstruct("wrong.npy", calibration, "strict.fits", largest_residual=0.0, **options)
    assert strict.counts["INCONSISTENT"] == 10


@pytest.mark.parametrize(("moved", "flags"), [((0, 0), 0), ((1, 0), Flag.MOVED), ((0, -1), Flag.MOVED)])
def test_images_that_have_moved_are_flagged(bench, calibration, moved, flags):
    estimate = calibration(np.roll(bench.frames, moved, axis=(1, 2)))
    assert np.all(estimate.flags & Flag.MOVED == flags)
    np.testing.assert_allclose(estimate.displacement, [moved] * 12, atol=0.5)


def test_background_that_has_risen_is_measured_and_flagged(bench, calibration):
    risen = calibration(bench.frames + 0.06 * PHOTONS)
    assert (risen.flags & Flag.INCONSISTENT).all()
    np.testing.assert_allclose(risen.background, 0.06, atol=0.02)
    np.testing.assert_allclose(calibration(bench.frames).background, 0, atol=0.01)


@pytest.mark.parametrize("level", [30, 1e3, 1e4, 1e6])
def test_frame_without_a_pupil_is_flagged(bench, calibration, level):
    shape = calibration.shape
    frames = np.stack([np.full(shape, level), bench.rng.poisson(level, shape), bench.rng.normal(0, level, shape)])
    assert (calibration(frames + DARK, saturation=np.inf).flags & (Flag.LOST | Flag.INCONSISTENT) > 0).all()


def test_background_is_unknown_where_no_pixel_around_the_pupils_is_good(bench, calibration):
    far = np.ones(calibration.bad.shape, bool)
    for row, column in calibration.places[:, :, calibration.good].reshape(2, 2, -1):
        far[0, np.rint(row).astype(int), np.rint(column).astype(int)] = False
    far = ndimage.binary_erosion(far, iterations=2, border_value=1)
    estimate = replace(calibration, bad=calibration.bad | far)(bench.frames)
    assert np.isnan(estimate.background).all()
    assert not estimate.flags.any()


def test_header_states_units_and_the_place_of_the_map(folder, calibration):
    reconstruct("cube.fits", calibration, "phase.fits", wavelength=1650.0, photons=1e4, modes=3, phases=True)
    with fits.open("phase.fits") as units:
        header, table = units[0].header, units["FRAMES"].columns
    assert header["BUNIT"] == "rad"
    assert header["NMPERRAD"] == pytest.approx(1650 / (2 * np.pi))
    assert header["MAPFRAME"] == "first image"
    place = [header["CROPROW"], header["CROPCOL"]]
    assert all(isinstance(value, int) for value in place)
    exact = np.add(place, [header["OFFROW"], header["OFFCOL"]])
    assert exact == pytest.approx(calibration.places[0, :, 0, 0], abs=1e-6)
    assert {table[name].unit for name in ("SIGMA", "COEFFS", "SIGCOEFF")} == {"rad"}


@pytest.mark.parametrize("value", [0, -5, "1E400", "'red'"])
def test_wavelength_of_a_header_that_none_can_have_stops_nothing(folder, bench, calibration, value):
    fits.PrimaryHDU(bench.frames[:1], fits.Header({"WAVELEN": 12345})).writeto("a.fits")
    content = Path("a.fits").read_bytes()
    Path("a.fits").write_bytes(content.replace(f"{12345:>20}".encode(), f"{value:>20}".encode()))
    assert reconstruct("a.fits", calibration, "phase.fits").n_flagged == 0
    assert "NMPERRAD" not in fits.getheader("phase.fits")


# Modes and errors


def test_coefficients_are_those_that_were_put_in(bench, calibration):
    modes = zernike_basis(calibration.sensor.pupil, 9)
    matrix = calibration.modal_matrix(modes)
    put = np.random.default_rng(5).normal(0, 0.15, (4, 9)).astype(np.float32)
    filled = np.tensordot(put, np.nan_to_num(modes), 1)
    estimate = calibration(bench.frames[:4])
    np.testing.assert_allclose(calibration.coefficients(replace(estimate, filled=filled), matrix), put, atol=1e-4)


def linear(calibration):
    return Linear(calibration.sensor, zernike_basis(calibration.sensor.pupil, 60))


def test_linear_method_replaces_the_iteration(bench):
    small, leakage = bench.screens[:3] / 8, 0.05
    frames = bench.sensor.measure(small)
    images = bench.expose((1 - leakage) * frames + leakage * frames[:, ::-1])

    def gain(optics):  # of the phases over those that were put in
        calibration = bench.calibration(optics)
        phase = calibration(images, method=linear(calibration)).phase
        row, column = np.rint(calibration.places[0, :, 0, 0] - MARGIN).astype(int)
        phase = phase[:, -row : D - row, -column : D - column]
        inside = np.isfinite(phase[0]) & bench.pupil.inside
        phase, put = (maps[:, inside] - maps[:, inside].mean(axis=1, keepdims=True) for maps in (phase, small))
        return np.sum(phase * put) / np.sum(put**2)

    assert gain(Optics(leakage=leakage)) == pytest.approx(1, abs=0.03)
    assert gain(Optics()) == pytest.approx(1 - 2 * leakage, abs=0.03)


def test_method_keeps_the_flags_and_fills_bad_pixels(bench, calibration):
    images = np.stack([bench.frames[0], bench.frames[0], np.full_like(bench.frames[0], DARK)]).astype(float)
    images[1][pixel(calibration, (20, 20))] = np.nan
    estimate = calibration(images, method=linear(calibration))
    assert estimate.flags.tolist() == [0, Flag.BAD_PIXELS, Flag.LOST]
    assert np.isfinite(estimate.filled[:2]).all()
    assert rms(estimate.filled[1] - estimate.filled[0]) < 0.01
    same = PhaseShifted(calibration.sensor, accelerate=True, tolerance=1e-3)
    assert rms(calibration(images[:2], method=same).phase - calibration(images[:2]).phase) < 1e-3


def test_sigma_without_errors_of_the_calibration_is_the_scatter_of_many_exposures(bench, calibration):
    calibration = replace(
        calibration, unexplained=calibration.unexplained[:0], slopes=np.zeros(0), displacements=np.zeros((0, 2))
    )
    frames = np.stack([bench.expose(bench.sensor.measure(bench.screens[0])) for _ in range(60)])
    modes = zernike_basis(calibration.sensor.pupil, 9)
    estimate = calibration(frames)
    photons = float(calibration.unit.mean())
    first = replace(estimate, **{name: value[:1] for name, value in estimate._arrays()})
    scatter = calibration.coefficients(estimate, calibration.modal_matrix(modes)).std(axis=0)
    sigma = calibration.sigma(first, photons, modes=modes)[0]
    assert 0.8 < np.median(scatter / sigma) < 1.4
    points = calibration.sigma(first, photons)[0]
    np.testing.assert_array_equal(np.isnan(points), np.isnan(estimate.phase[0]))
    phase = estimate.phase - np.nanmean(estimate.phase, axis=(1, 2), keepdims=True)
    assert 0.7 < np.nanmedian(phase.std(axis=0) / points) < 1.2  # resampling smooths the noise a little
    noisy = calibration.sigma(first, photons, read_noise=100.0)
    assert (noisy[0] > points)[np.isfinite(points)].all()


# Telemetry


def test_file_holds_phases_table_and_keywords(folder, bench, calibration):
    options = {"keywords": ["exptime", "BUNIT"], "photons": 1e4, "read_noise": 2, "modes": 6, "phases": True}
    summary = reconstruct("cube.fits", "bench.npz", "out/phase.fits", **options)
    assert (summary.n_frames, summary.n_flagged, summary.n_resumed) == (12, 0, 0)
    expected = calibration(bench.frames)
    matrix = calibration.modal_matrix(zernike_basis(calibration.sensor.pupil, 6))
    with fits.open("out/phase.fits") as units:
        units.verify("exception")
        assert [unit.name for unit in units] == ["PRIMARY", "SIGMA", "FRAMES", "FILES"]
        np.testing.assert_array_equal(units[0].data, expected.phase)
        header, table = units[0].header, units["FRAMES"].data
        assert (header["BUNIT"], header["NFRAMES"], header["NFLAGGED"], header["EXPTIME"]) == ("rad", 12, 0, 0.01)
        assert header["CALIBSHA"] == calibration.sha256
        np.testing.assert_array_equal(table["INDEX"], np.arange(12))
        np.testing.assert_array_equal(table["RESIDUAL"], expected.residual)
        assert set(table["BUNIT"]) == {"adu"}
        assert (table["EXPTIME"] == 0.01).all()
        np.testing.assert_allclose(table["COEFFS"], calibration.coefficients(expected, matrix), rtol=1e-6)
        sigma = units["SIGMA"].data
        np.testing.assert_allclose(table["SIGMA"], np.sqrt(np.nanmean(sigma**2, axis=(1, 2))), rtol=1e-5)
        assert units["FILES"].data["NAME"].tolist() == ["cube.fits"]
    assert os.listdir("out") == ["phase.fits"]


def small_chunks(monkeypatch, exposures):
    """Chunks of a few exposures, as those of large cameras."""
    from zwfs.frames import telemetry

    monkeypatch.setattr(telemetry, "_CHUNK", 56 * 112 * 2 * exposures)


class Stopped(Exception):  # noqa: N818
    pass


def stop_after(n):
    def progress(done, total):
        if n <= done < total:
            raise Stopped

    return progress


def test_part_of_another_run_is_not_taken_over(folder, monkeypatch, bench):
    small_chunks(monkeypatch, 3)
    assert str(interrupted()) == ".phase.fits.part"
    with pytest.raises(ValueError, match=r"\.phase\.fits\.part is part of a run with other frames"):
        reconstruct("cube.fits", "bench.npz", "phase.fits", photons=100)
    fits.PrimaryHDU(bench.frames[::-1], fits.Header(OPTICS)).writeto("cube.fits", overwrite=True)
    with pytest.raises(ValueError, match="part of a run with other frames"):
        reconstruct("cube.fits", "bench.npz", "phase.fits")
    assert reconstruct("cube.fits", "bench.npz", "phase.fits", restart=True).n_resumed == 0
    assert not list(folder.glob(".*"))


def interrupted(name="phase.fits"):
    """Scratch file of a run that was stopped after its first two pieces, of 3 and 3 of 12 frames."""
    with pytest.raises(Stopped):
        reconstruct("cube.fits", "bench.npz", name, n_workers=1, progress=stop_after(6))
    return Path(f".{name}.part")


@pytest.mark.parametrize("place", [2880 * 2 + 4000, -32 - 4 * 8, -32 - 2 * 8], ids=["phase", "mark", "new mark"])
def test_damaged_piece_is_named_and_computed_again(folder, monkeypatch, place):
    small_chunks(monkeypatch, 3)
    reconstruct("cube.fits", "bench.npz", "whole.fits", n_workers=3)
    part = interrupted()
    assert not Path("phase.fits").exists()
    content = bytearray(part.read_bytes())
    content[place] ^= 255
    part.write_bytes(content)
    named = pytest.warns(UserWarning, match=r"phase\.fits\.part: 1 of \d finished pieces are damaged")
    with named, pytest.raises(Stopped):
        reconstruct("cube.fits", "bench.npz", "phase.fits", n_workers=1, progress=stop_after(9))
    assert reconstruct("cube.fits", "bench.npz", "phase.fits").n_resumed >= 9  # that of the second run, too
    assert Path("phase.fits").read_bytes() == Path("whole.fits").read_bytes()
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("n_bytes", [0, 4000])
def test_cut_scratch_file_is_written_again(folder, monkeypatch, n_bytes):
    small_chunks(monkeypatch, 3)
    reconstruct("cube.fits", "bench.npz", "whole.fits")
    os.truncate(interrupted(), n_bytes)
    reconstruct("cube.fits", "bench.npz", "phase.fits", restart=n_bytes > 0)
    assert Path("phase.fits").read_bytes() == Path("whole.fits").read_bytes()


# Files of other people


def left_alone(names):
    return {name: Path(name).read_bytes() for name in names}


FOREIGN = {
    "link to a file": lambda scratch: scratch.symlink_to("cube.fits"),
    "link to nothing": lambda scratch: scratch.symlink_to("nowhere"),
    "link to a scratch file": lambda scratch: scratch.symlink_to(interrupted().rename("mine")),
    "hard link": lambda scratch: os.link(interrupted("other.fits"), scratch),
    "text": lambda scratch: scratch.write_bytes(b"raw data"),
    "frames": lambda scratch: shutil.copy("cube.fits", scratch),
    "folder": lambda scratch: scratch.mkdir(),
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("settings", [{}, {"overwrite": True, "restart": True}])
@pytest.mark.parametrize("put", FOREIGN.values(), ids=FOREIGN)
def test_foreign_scratch_file_is_refused_and_stays(folder, monkeypatch, put, settings):
    small_chunks(monkeypatch, 3)
    put(Path(".phase.fits.part"))
    names = [path for path in folder.rglob("*") if path.is_file()]
    before = left_alone(names)
    with pytest.raises(ValueError, match=r"needs the file \.phase\.fits\.part, which is there"):
        reconstruct("cube.fits", "bench.npz", "phase.fits", **settings)
    assert left_alone(names) == before
    assert not os.path.lexists("nowhere")
    assert not os.path.lexists("phase.fits")


def test_scratch_file_of_another_user_is_refused(folder, monkeypatch):
    small_chunks(monkeypatch, 3)
    owner = interrupted().stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(ValueError, match="it belongs to another user"):
        reconstruct("cube.fits", "bench.npz", "phase.fits", restart=True)


def test_input_as_the_scratch_file_is_refused(folder, monkeypatch):
    small_chunks(monkeypatch, 3)
    raw = Path(".phase.fits.part")
    shutil.copy("cube.fits", raw)
    Path("link.fits").symlink_to(raw)
    before = left_alone([raw])
    for name in (raw, "link.fits"):
        with pytest.raises(ValueError, match="its scratch file is the input"):
            reconstruct(name, "bench.npz", "phase.fits", restart=True, overwrite=True)
    assert left_alone([raw]) == before


@pytest.mark.parametrize("way", ["itself", "symbolic link", "hard link", "link as output"])
@pytest.mark.parametrize("role", ["frames", "second frames", "calibration"])
def test_overwrite_replaces_no_input_and_no_calibration(folder, way, role):
    names = {"frames": "cube.fits", "second frames": "frame.fits", "calibration": "bench.npz"}
    target = names[role]
    before, output = left_alone(names.values()), target
    if way != "itself":
        (os.link if way == "hard link" else os.symlink)(folder / target, "other")
        if way == "link as output":
            output = "other"
        else:
            names[role] = "other"
    with pytest.raises(ValueError, match=f"output = '{output}' is the input '{names[role]}'"):
        reconstruct(
            names["frames"], names["calibration"], output, second_frames=names["second frames"], overwrite=True
        )
    assert left_alone(before) == before


def test_foreign_output_that_appears_during_the_run_stays(folder):
    def progress(done, total):
        Path("phase.fits").write_bytes(b"mine")

    with pytest.raises(ValueError, match="exists and is not a phase map of zwfs"):
        reconstruct("cube.fits", "bench.npz", "phase.fits", progress=progress)
    assert Path("phase.fits").read_bytes() == b"mine"
    os.remove("phase.fits")
    assert reconstruct("cube.fits", "bench.npz", "phase.fits").n_resumed == 12


def test_memory_does_not_grow_with_the_cube(folder, monkeypatch, bench, calibration):
    small_chunks(monkeypatch, 12)

    def peak(n):
        np.save("long.npy", np.concatenate([bench.frames] * n))
        tracemalloc.start()
        reconstruct("long.npy", calibration, "long.fits", n_workers=1)
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    peak(2)
    assert peak(16) < 1.2 * peak(4)


# Kinds of files


KINDS = {
    "cube.npy": np.save,
    "single.npy": lambda path, frames: np.save(path, frames[:, np.newaxis]),
    "columns.npy": lambda path, frames: np.save(path, np.asfortranarray(frames)),
    "compressed.fits": lambda path, frames: fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(frames)]).writeto(
        path
    ),
    "extensions.fits": lambda path, frames: fits.HDUList(
        [fits.PrimaryHDU(), *map(fits.ImageHDU, (frames[:7], frames[7], frames[8:]))]
    ).writeto(path),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_file_holds_the_same_frames(folder, bench, calibration, name):
    KINDS[name](folder / name, bench.frames)
    stack = Stack([folder / name], [], 1, calibration.shape)
    assert stack.n == 12
    np.testing.assert_array_equal(stack.read(0, 12)[:, 0], bench.frames)
    assert reconstruct(name, calibration, "phase.fits").n_flagged == 0
    np.testing.assert_array_equal(fits.getdata("phase.fits"), calibration(bench.frames).phase)


def test_list_of_files_is_one_cube(folder, bench, calibration):
    names = [f"frame{index:02}.fits" for index in range(12)]
    for index, name in enumerate(names):
        header = fits.Header({"DATE-OBS": f"2026-11-22T10:00:{index:02}"})
        fits.PrimaryHDU(bench.frames[index], header).writeto(name)
    reconstruct(names, calibration, "phase.fits", keywords=["DATE-OBS"])
    table = fits.getdata("phase.fits", "FRAMES")
    assert table["FILE"].tolist() == list(range(12))
    assert table["DATE-OBS"][11] == "2026-11-22T10:00:11"
    assert fits.getdata("phase.fits", "FILES")["NAME"][3] == "frame03.fits"
    np.testing.assert_array_equal(fits.getdata("phase.fits"), calibration(bench.frames).phase)
    summary = reconstruct(names[0], calibration, "one.fits")
    assert (summary.n_frames, summary.counts["INCONSISTENT"]) == (1, 0)


@pytest.mark.parametrize("kind", ["pairs", "extensions", "second files", "single pair", "single extensions"])
def test_second_image_is_read_wherever_it_is(tmp_path, kind):
    pairs = np.arange(5 * 2 * 6 * 7, dtype=np.int16).reshape(5, 2, 6, 7)
    path, second = tmp_path / "a.fits", tmp_path / "b.npy"
    pairs = pairs[:1] if kind.startswith("single") else pairs
    np.save(second, pairs[:, 1].astype(">i2"))
    images = {
        "pairs": [pairs],
        "extensions": [None, pairs[:, 0], pairs[:, 1]],
        "second files": [pairs[:, 0]],
        "single pair": [pairs[0]],
        "single extensions": [pairs[0, 0], pairs[0, 1]],
    }[kind]
    fits.HDUList([fits.PrimaryHDU(images[0]), *map(fits.ImageHDU, images[1:])]).writeto(path)
    stack = Stack([path], [second] if kind == "second files" else [], 2, (6, 7))
    np.testing.assert_array_equal(stack.read(0, stack.n), pairs)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.data())
def test_any_range_of_any_files_is_read(tmp_path_factory, lengths, data):
    folder = tmp_path_factory.mktemp("stack")
    whole = np.arange(sum(lengths) * 6, dtype=np.int32).reshape(-1, 2, 3)
    ends = np.cumsum(lengths)
    paths = [folder / f"{index}.npy" for index in range(len(lengths))]
    for path, stop, n in zip(paths, ends, lengths, strict=True):
        np.save(path, whole[stop - n : stop])
    stack = Stack(paths, [], 1, (2, 3))
    first = data.draw(st.integers(0, stack.n - 1))
    stop = data.draw(st.integers(first + 1, stack.n))
    np.testing.assert_array_equal(stack.read(first, stop)[:, 0], whole[first:stop])


# Bad input


BAD = {
    "shape": (lambda path, f: _save(path, f[:, 1:]), r"its shape is \(12, 55, 112\): expected \(n, 56, 112\)"),
    "pairs": (lambda path, f: _save(path, np.stack([f, f], 1)), r"its shape is \(12, 2, .*: expected \(n, 56"),
    "no frame": (lambda path, f: _save(path, f[:0]), r"its shape is \(0, 56, 112\)"),
    "other numbers": (lambda path, f: _save(path, f.astype(float)), "its numbers are float64: expected uint16"),
    "truncated": (
        lambda path, f: path.write_bytes(Path("cube.fits").read_bytes()[:80000]),
        "truncated: it holds 77120 of the 150528 bytes",
    ),
    "unit": (
        lambda path, f: fits.PrimaryHDU(f, fits.Header({"BUNIT": "electron"})).writeto(path),
        "BUNIT = 'electron': expected 'adu', that of the calibration",
    ),
}


def _save(path, array):
    with path.open("wb") as file:
        np.save(file, array)


@pytest.mark.parametrize("kind", BAD)
def test_bad_file_is_refused_by_name_before_any_work(folder, bench, kind):
    write, message = BAD[kind]
    write(folder / "bad.fits", bench.frames)
    with pytest.raises(FileError, match=rf"bad.fits(\[\d\])?: {message}"):
        reconstruct(["cube.fits", "bad.fits"], "bench.npz", "phase.fits")
    assert not Path("phase.fits").exists()
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize(
    ("names", "settings", "error", "message"),
    [
        ([], {}, ValueError, "frames is empty"),
        (["none.fits"], {}, FileNotFoundError, "none.fits: no such file"),
        (["cube.fits"], {"second_frames": "cube.fits"}, ValueError, "second_files holds 1 files: expected none"),
        (["cube.fits"], {"phases": False}, ValueError, "phases = False: expected True, or modes"),
        (["cube.fits"], {"keywords": ["FLAGS"]}, FileError, "cube.fits: its header has no FLAGS"),
        (["cube.fits"], {"modes": np.ones((2, 5, 5))}, ValueError, "modes has shape"),
    ],
)
def test_wrong_argument_is_named(folder, names, settings, error, message):
    with pytest.raises(error, match=message):
        reconstruct(names, "bench.npz", "phase.fits", **settings)
    assert not list(folder.glob("*phase.fits*"))


# The command


# Options of the command that exclude no other, with other values than their defaults.
RECONSTRUCT = [
    "--modes 5", "--modes 5 --phases", "--photons 1e4", "--photons 1e4 --read-noise 3", "--keywords EXPTIME BUNIT",
    "--saturation 60000", "--largest-residual 0.5", "--wavelength 1650", "--workers 1",
    "--restart", "--overwrite", "--strict", "--follow",
    "--quiet",
]  # fmt: skip
CALIBRATE = [
    "--dark dark.fits", "--pupil-dark dark.fits", "--images 1",
    "--bad-pixels bad.npy", "--diameter 1.1", "--phase-shifts 1.5 -1.5", "--no-registration",
    "--pupil-centers 27.5 27.5 27.5 83.5 --pupil-diameter 40", "--exposure 1.1", "--saturation 60000",
    "--fit registration", "--iterations 10", "--tolerance 0.01",
]  # fmt: skip


def each_and_all(options):
    """Each option alone, and all together."""
    return [*((option,) for option in options), options]


@pytest.mark.parametrize("chosen", each_and_all(RECONSTRUCT))
def test_options_of_a_reconstruction_work_together(folder, bench, chosen):
    fits.PrimaryHDU(bench.frames[:2], fits.Header(OPTICS | {"EXPTIME": 0.01})).writeto("two.fits")
    options = " ".join(chosen)
    files = ["two.fits", "--calibration", "bench.npz", "--output", "phase.fits"]
    assert main(["reconstruct", *files, *options.split()]) == 0
    with fits.open("phase.fits") as units:
        units.verify("exception")
        table = units["FRAMES"].data
        modes, photons = "--modes" in options, "--photons" in options
        phases = not modes or "--phases" in options
        assert (units[0].data is not None) == phases
        assert ("SIGMA" in units) == ("SIGMA" in table.names) == (phases and photons)
        assert ("SIGCOEFF" in table.names) == (modes and photons)
        assert ("COEFFS" in table.names) == modes
        assert ("EXPTIME" in table.names) == ("--keywords" in options)


@pytest.mark.parametrize("chosen", each_and_all(CALIBRATE))
def test_options_of_a_calibration_work_together(folder, bench, chosen):
    np.save("bad.npy", np.zeros(bench.flat.shape))
    files = ["--frames", "frame.fits", "--pupils", "pupils.fits"]
    assert main(["calibrate", "new.npz", *files, *" ".join(chosen).split()]) == 0
    assert np.isfinite(Calibration.load("new.npz")(bench.frames[:1]).flux).all()


def test_exit_code_says_how_the_command_ended(folder, capsys):
    assert main(["reconstruct", "none.fits", "--calibration", "bench.npz", "-o", "phase.fits"]) == 1
    assert "error: none.fits: no such file" in capsys.readouterr().err
    arguments = "--calibration bench.npz -o strict.fits --strict --largest-residual 0"
    assert main(["reconstruct", "cube.fits", *arguments.split()]) == 3
    assert "12 flagged: 12 inconsistent" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct"])
    assert stopped.value.code == 2


def test_progress_is_reported_in_lines_without_a_terminal(folder, capsys, monkeypatch):
    monkeypatch.setattr("zwfs.frames.__main__._PERIOD", -1.0)
    arguments = ["reconstruct", "cube.fits", "--calibration", "bench.npz", "--overwrite", "-o", "phase.fits"]
    assert main(arguments) == 0
    assert capsys.readouterr().err.splitlines()[-1] == "12 of 12 frames"
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert main(arguments) == 0
    assert f"\r[{'#' * 40}] 12 of 12 frames" in capsys.readouterr().err
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


# The command with a pause after each chunk: it cannot end before the test stops it.
SLOW = """
import signal, sys, time
from zwfs.frames import __main__ as command

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for its background jobs
fast = command.reconstruct
command.reconstruct = lambda *args, **options: fast(*args, **{**options, "progress": lambda *_: time.sleep(0.5)})
sys.exit(command.main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_command_that_is_stopped_goes_on_to_the_same_bytes(folder, bench, calibration, number):
    np.save("long.npy", np.concatenate([bench.frames] * 200))
    arguments = ["reconstruct", "long.npy", "--calibration", "bench.npz", "-o"]
    reconstruct("long.npy", calibration, "whole.fits", saturation=65535)
    process = subprocess.Popen([sys.executable, "-c", SLOW, *arguments, "phase.fits"], cwd=folder)
    part, marks = Path(".phase.fits.part"), bytes(80)  # of ten pieces
    while process.poll() is None and not any(marks):
        time.sleep(0.01)
        content = part.read_bytes() if part.exists() else b""
        marks = content[-32 - 80 : -32] if content[-32:].strip(b"\0 ") else marks
    process.send_signal(number)
    expected = -signal.SIGKILL if number == signal.SIGKILL else 130
    assert process.wait() == expected
    assert not Path("phase.fits").exists()
    assert subprocess.run([sys.executable, "-m", "zwfs.frames", *arguments, "phase.fits"]).returncode == 0
    assert Path("phase.fits").read_bytes() == Path("whole.fits").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("reconstruct cube.fits --calibration bench.npz -o full",
         "error: output = '.*/full' cannot be written .File too large.: expected .*\n"),
        ("calibrate full --frames frame.fits --pupils pupils.fits", "error: full: File too large\n"),
    ],
)  # fmt: skip
def test_full_disk_is_one_message_and_keeps_nothing(folder, arguments, message):
    shown = subprocess.run(
        ["bash", "-c", f"ulimit -f 40; exec '{sys.executable}' -m zwfs.frames {arguments}"],
        cwd=folder, capture_output=True, text=True,
    )  # fmt: skip
    assert shown.returncode == 1
    assert re.fullmatch(message, shown.stderr)
    assert not list(folder.glob("*full*"))
    assert not list(folder.glob(".*"))


# The pages of the book


def test_page_on_telemetry_does_what_it_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, *rest = code_of("telemetry.md")
    names: dict = {}
    exec(first, names)
    for line in "".join(code_of("telemetry.md", "sh")).replace("\\\n", "").splitlines():
        assert line.startswith("python -m zwfs.frames ")
        assert main(shlex.split(line)[3:]) == 0
    for code in rest:
        exec(code, names)
    assert "[0 1 6]" in capsys.readouterr().out
    assert (names["table"]["FLAGS"] > 0).sum() == 2
    assert names["phase"].shape[0] == 38
    assert fits.getdata("modes.fits", "FRAMES")["SIGCOEFF"].shape == (40, 20)
