"""Telemetry of a bench that was calibrated with known commands, on frames that HCIPy simulates."""

import io
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from scipy import ndimage

from zwfs import Linear, zernike_basis
from zwfs.frames import Calibration, reconstruct
from zwfs.frames.__main__ import main
from zwfs.frames._calibrate import _read_states, _windows
from zwfs.frames._fit import fit_bench
from zwfs.frames._solver import MapPrior
from zwfs.frames.phases import Flag

from .hcipy_bench import HcipyBench

pytest.importorskip("hcipy")
OPTICS = {"diameter": 1.08, "shifts": (1.52, -1.60), "leakage": 0.02, "blur": 0.5, "fluxes": (1.0, 0.95)}
TURNED = {"rotations": (0.0, 1.0), "magnifications": (1.0, 1.01), "offsets": ((0.3, -0.1), (-0.2, 0.3))}


class Recorded:
    """Frames of a bench with bad pixels: of commands, without the mask, and of unseen screens."""

    def __init__(self):
        self.bench = HcipyBench(pixels=24, side=32, amplitude_error=0.05, static=0.1, **OPTICS, **TURNED)
        frames, clear, self.phases = self.bench.recording()
        self.bad = np.random.default_rng(5).random(clear.shape) < 0.002
        self.frames, self.clear = (np.where(self.bad, np.nan, images) for images in (frames, clear))
        screens = [self.bench.smooth(0.4, 1000 + index) for index in range(12)]
        self.unseen = np.stack([self.bench.counts(screen, (7, index)) for index, screen in enumerate(screens)])
        self.truth = np.stack([self.bench.on_pupil(screen + self.bench.flat) for screen in screens])

    def errors(self, phase):
        """Phases less the truth, NaN where they are."""
        waves = np.exp(1j * (phase - self.truth))
        return np.angle(waves / np.nanmean(waves, axis=(1, 2), keepdims=True))


def rms(errors, where):
    errors = errors[:, where]
    return np.sqrt(np.nanmean((errors - np.nanmean(errors, axis=1, keepdims=True)) ** 2))


@pytest.fixture(scope="module")
def recorded():
    return Recorded()


def wide(pairs):
    """Pairs of images as one image with both pupils on it."""
    return np.concatenate([pairs[..., 0, :, :], pairs[..., 1, :, :]], axis=-1)


@pytest.fixture(scope="module")
def files(recorded, tmp_path_factory):
    """Folder with files of the bench: two exposures of each state, a dark, and unseen screens."""
    folder = tmp_path_factory.mktemp("bench")
    arrays = {
        "frames": 200 + wide(np.repeat(recorded.frames, 2, axis=0)),
        "clear": 200 + wide(np.stack([recorded.clear] * 2)),
        "dark": np.full(wide(recorded.clear).shape, 200.0),
        "commands": recorded.phases,
        "unseen": 200 + wide(recorded.unseen),
    }
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return folder


@pytest.fixture(scope="module")
def command(recorded, files):
    """Calibration that the command makes with known commands, and what it says."""
    side, said = recorded.bench.side, io.StringIO()
    said.isatty = lambda: True
    centers = [str(place) for place in (side / 2 - 0.5, side / 2 - 0.5, side / 2 - 0.5, 1.5 * side - 0.5)]
    names = ["--frames", "frames.npy", "--pupils", "clear.npy", "--dark", "dark.npy", "--commands", "commands.npy"]
    options = ["--pupil-centers", *centers, "--pupil-diameter", "24", "--noise", str(recorded.bench.noise)]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(action="ignore"):
        patch.chdir(files)
        patch.setattr(sys, "stderr", said)
        quick = {"n_steps": 4, "oversampling": 2}
        patch.setattr("zwfs.frames._calibrate.fit_bench", lambda *data, **rest: fit_bench(*data, **rest | quick))
        assert main(["calibrate", "bench.npz", *names, *options]) == 0, said.getvalue()
    return Calibration.load(files / "bench.npz"), said.getvalue()


@pytest.fixture(scope="module")
def calibration(command):
    return command[0]


@pytest.fixture(scope="module")
def estimate(recorded, calibration):
    return calibration(wide(np.where(recorded.bad, np.nan, recorded.unseen)))


def test_phases_are_right_and_their_error_bars_hold_for_points_and_modes(recorded, calibration, estimate):
    errors, lit = recorded.errors(estimate.phase), recorded.bench.fully_lit
    assert not estimate.flags.any()
    assert rms(errors, lit) < 0.03
    photons, noise = calibration.unit.mean(), recorded.bench.noise
    inner = ndimage.binary_erosion(lit, iterations=2)
    assert 0.8 < rms(errors / calibration.sigma(estimate, photons, noise), inner) < 1.3
    modes = zernike_basis(calibration.sensor.pupil, 20)
    # The screens have finer modes than the commands, so that next to the rim their errors are larger.
    coefficients = calibration.sensor.pupil.gather(
        np.where(ndimage.binary_erosion(lit), np.nan_to_num(errors), 0)
    ) @ calibration.modal_matrix(modes)
    assert 0.6 < np.sqrt(np.mean((coefficients / calibration.sigma(estimate, photons, noise, modes)) ** 2)) < 1.6


def test_command_calibrates_with_known_commands(files, command, estimate):
    """Both pupils on one image, two exposures of each state, and a dark."""
    calibration, said = command
    assert "stage 4 of 4" in said
    assert calibration.n_images == 1
    assert calibration.n_averaged == 2
    summary = reconstruct(files / "unseen.npy", calibration, files / "phase.fits", photons=calibration.unit.mean())
    assert summary.n_flagged == 0
    np.testing.assert_allclose(fits.getdata(files / "phase.fits"), estimate.phase, atol=0.05)


def test_saved_calibration_keeps_its_fit(tmp_path, recorded, calibration):
    calibration.save(tmp_path / "bench.npz")
    loaded = Calibration.load(tmp_path / "bench.npz")
    assert (loaded.sha256, loaded.bench.estimates) == (calibration.sha256, calibration.bench.estimates)
    assert loaded.bench.consistent == calibration.bench.consistent
    counts = wide(recorded.unseen[0])
    result, expected = (road(counts, smooth=MapPrior(0.3, 4.0)) for road in (loaded, calibration))
    np.testing.assert_array_equal(result.phase, expected.phase)
    loaded.bench.save(tmp_path / "fit.fits")
    assert "MODEL SHAPE 0" not in fits.getheader(tmp_path / "fit.fits")


KINDS = {
    "cube of pairs": lambda frames: {"frames.npy": frames},
    "two cubes": lambda frames: {"first.npy": frames[:, 0], "second.npy": frames[:, 1]},
    "a file for each pair": lambda frames: {f"pair{index}.npy": pair for index, pair in enumerate(frames)},
}


@pytest.mark.parametrize("kind", KINDS)
def test_states_are_read_from_every_kind_of_file(tmp_path, kind):
    frames = np.random.default_rng(1).uniform(100, 200, (6, 2, 20, 24))
    frames[2, 1, 5, 6] = 1e4
    files = {tmp_path / name: array for name, array in KINDS[kind](frames).items()}
    extra = {"clear.npy": frames[0], "dark.npy": np.full((20, 24), 100.0), "bad.npy": np.eye(20, 24)}
    extra |= {"commands.npy": np.zeros((3, 12, 12))}
    for path, array in (files | {tmp_path / name: array for name, array in extra.items()}).items():
        np.save(path, array)
    clear, dark, bad, commands = (tmp_path / name for name in extra)
    states = _read_states((list(files), [clear], [dark], [bad], ()), commands, 1000.0, None)
    expected = np.where(np.eye(20, 24) > 0, np.nan, frames - 100)
    expected[2, 1, 5, 6] = np.nan
    np.testing.assert_array_equal(states.frames.reshape(frames.shape), expected)
    assert states.frames.shape[:2] == (3, 2)
    windows, _ = _windows(states, [(9.5, 10.0), (9.5, 12.0)], 12.0)
    assert windows.corners.tolist() == [[2, 2], [2, 4]]
    np.testing.assert_array_equal(windows.cut(states.frames)[:, :, 1], states.frames[:, :, 1, 2:18, 4:20])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"commands": np.zeros((4, 12, 12))}, "4 commands for 6 exposures"),
        ({"commands": np.zeros((3, 30, 30))}, "commands have 30 pixels: expected at most 20"),
        ({"fitted": ["scale"]}, "expected none with commands"),
        ({"clear": np.ones((2, 21, 24))}, r"exposures of shape \(2, 20, 24\): expected"),
    ],
)
def test_states_that_do_not_belong_together_are_named(tmp_path, settings, message):
    arrays = {"frames": np.ones((6, 2, 20, 24)), "clear": np.ones((2, 20, 24)), "commands": np.zeros((3, 12, 12))}
    arrays |= {name: settings.pop(name) for name in arrays if name in settings}
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    frames, clear, commands = (tmp_path / f"{name}.npy" for name in arrays)
    with pytest.raises(ValueError, match=message):
        Calibration.from_files(
            [frames], [clear], commands=commands, pupil_centers=[(9.5, 11.5)] * 2, pupil_diameter=12.0, **settings
        )


def test_linear_method_measures_small_screens_on_a_fitted_bench(recorded, calibration):
    bench = recorded.bench
    screen = bench.smooth(0.1, 1000)
    method = Linear(calibration.sensor, zernike_basis(calibration.sensor.pupil, 60))
    phase = calibration(wide(bench.counts(screen, (8, 0))), method=method).phase
    truth = np.where(np.isfinite(phase), bench.on_pupil(screen + bench.flat), np.nan)
    inside = bench.fully_lit & np.isfinite(phase)
    assert rms((phase - truth)[np.newaxis], inside) < 0.3 * rms(truth[np.newaxis], inside)
    assert rms((phase + truth)[np.newaxis], inside) > rms(truth[np.newaxis], inside)  # control: the other sign


# Images that have moved


def test_fitted_bench_shows_that_images_have_moved(recorded, calibration):
    moved = replace(recorded.bench, offsets=tuple((row + 0.3, column) for row, column in recorded.bench.offsets))
    exposures = [moved.counts(moved.smooth(0.4, 1000 + index), (7, index)) for index in range(6)]
    flags = calibration(wide(np.stack(exposures))).flags & Flag.MOVED
    assert np.count_nonzero(flags) >= 4  # some phases imitate a displacement


class Drifting:
    """Exposures of a bench with hot pixels, whose images have moved since the calibration."""

    shifts = (0, 0), (0.3, -0.2), (0.6, 0.8), (-1.7, 1.05), (5, 0)

    def __init__(self):
        bench, rng = HcipyBench(pixels=32, side=48, fine=3, static=0.1), np.random.default_rng(3)
        hot = rng.random((2, 48, 48)) < 0.003
        self.screen = bench.smooth(0.4, 1001)
        flat, clear = (np.where(hot, np.nan, bench.counts(0 * bench.flat, 1, masked)) for masked in (True, False))
        self.bench, self.calibration = bench, Calibration.from_arrays(flat, clear)
        benches = [replace(bench, offsets=(shift,) * 2) for shift in self.shifts]
        self.counts = np.stack([bench.counts(self.screen, 2) for bench in benches])
        self.counts[:, hot] = 4 * bench.photons

    def errors(self, phases):
        corner = np.rint(self.calibration.places[0, :, 0, 0]).astype(int)
        return np.array([np.nanstd(self.bench.difference(phase, corner, self.screen)) for phase in phases])


@pytest.fixture(scope="module")
def drifting():
    return Drifting()


def test_images_that_have_moved_are_followed(drifting):
    plain, followed = (drifting.calibration(drifting.counts, follow=follow) for follow in (False, True))
    before, after = drifting.errors(plain.phase), drifting.errors(followed.phase)
    assert before[2] > 8 * before[0]  # control
    assert (after[2:4] < 0.25 * before[2:4]).all()
    assert after[1] < 0.75 * before[1]
    np.testing.assert_allclose(followed.displacement[:4], drifting.shifts[:4], atol=0.15)
    assert (followed.flags[[0, 1, 2, 4]] & Flag.MOVED > 0).tolist() == [False, False, False, True]
    np.testing.assert_array_equal(followed.phase[0], plain.phase[0])


def test_telemetry_follows_images_with_equal_bits_and_says_so(drifting, tmp_path):
    np.save(tmp_path / "cube.npy", drifting.counts)
    for follow in (False, True):
        output = tmp_path / f"{follow}.fits"
        drifting.calibration.save(tmp_path / "bench.npz")
        options = ["--calibration", str(tmp_path / "bench.npz"), "--saturation", "inf"] + ["--follow"] * follow
        assert main(["reconstruct", str(tmp_path / "cube.npy"), *options, "-o", str(output)]) == 0
        expected, table = drifting.calibration(drifting.counts, follow=follow), fits.getdata(output, "FRAMES")
        np.testing.assert_array_equal(fits.getdata(output), expected.phase)
        np.testing.assert_array_equal(table["SHIFT"], expected.displacement)
        np.testing.assert_array_equal(table["FLAGS"], expected.flags)
        assert fits.getheader(output)["FOLLOW"] is follow
