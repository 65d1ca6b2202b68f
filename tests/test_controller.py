"""Controllers: counts to commands, from pokes; loops on benches of HCIPy against an integrator that knows all."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis
from zwfs.frames import Calibration, FileError
from zwfs.frames.controller import Controller, PhaseController
from zwfs.frames.pipeline import Optics, reduce_frames
from zwfs.frames.registration import Image, register_frames

from .conftest import code_of
from .hcipy_loop import LoopBench

POKE, DARK = 0.2, 100


class Camera:
    """Both pupils of a model on one image; modes of the whole pupil stand for a mirror."""

    def __init__(self, n_modes=12, phase_shifts=(np.pi / 2, -np.pi / 2), photons=2e4):
        n, margin = 40, 10
        self.pupil, self.photons = Pupil.hexagonal(n, 3, 0.03, (21,), 0.8), photons
        masks = [Dimple(1.06, shift) for shift in phase_shifts]
        self.sensor = ZernikeSensor(self.pupil, *masks, extent=1 + 2 * margin / n)
        self.modes = np.where(self.pupil.inside, zernike_basis(self.pupil, n_modes), 0)
        self.clear = np.stack([np.pad(self.pupil.amplitude**2, margin)] * len(masks))

    def exposed(self, frames, seed, light=1.0):
        image = np.concatenate(list(frames), axis=-1) * self.photons * light
        return np.rint(np.random.default_rng(seed).poisson(image) + DARK).astype(np.uint16)

    def __call__(self, commands, seed, light=1.0):
        return self.exposed(self.sensor.measure(np.tensordot(commands, self.modes, 1)), seed, light)

    def calibration(self):
        flat, clear = self(np.zeros(len(self.modes)), 1), self.exposed(self.clear, 2)
        bad, dark = np.zeros(flat.shape, bool), float(DARK)
        images = [Image(counts - dark, bad, dark=dark) for counts in (flat, clear)]
        shifts = tuple(mask.phase for mask in self.sensor.masks)
        registered = register_frames(images[:1], images[1:], n_pupils=len(shifts))
        measurement = reduce_frames(registered, Optics(1.06, shifts))
        return Calibration.of(measurement, saturation=65535.0)

    def pokes(self, size=POKE):
        steps = size * np.eye(len(self.modes))
        flat = np.stack([self(0 * steps[0], (3, number)) for number in range(4)])
        pushed, pulled = (
            np.stack([self(sign * step, (4 + sign, i)) for i, step in enumerate(steps)]) for sign in (1, -1)
        )
        return flat, pushed, pulled


@pytest.fixture(scope="module")
def camera():
    return Camera()


@pytest.fixture(scope="module")
def calibration(camera):
    return camera.calibration()


@pytest.fixture(scope="module")
def pokes(camera):
    return camera.pokes()


@pytest.fixture(scope="module")
def controller(calibration, pokes):
    return calibration.controller(*pokes, poke=POKE, gain=1.0)


@pytest.fixture(scope="module")
def truth():
    return 0.02 * np.random.default_rng(8).normal(size=12)


@pytest.mark.parametrize("method", ["linear", "phase-shifted", "likelihood"])
def test_commands_are_those_that_made_the_frame(camera, calibration, pokes, truth, method):
    control = calibration.controller(*pokes, poke=POKE, gain=0.5, method=method)
    out = np.empty(12, np.float32)
    assert control(camera(truth, 9), out=out) is out
    np.testing.assert_allclose(out, 0.5 * truth, atol=3e-3)
    assert control.n_kept == control.n_commands == 12
    assert not control.lost


def test_fast_road_of_the_phase_agrees_with_the_plain_one(camera, calibration, pokes, truth):
    fast, plain, straight = (calibration.controller(*pokes, poke=POKE, method="phase-shifted") for _ in range(3))
    assert fast._tracking
    assert fast._straight
    straight._straight = plain._tracking = None
    inside = calibration.sensor.pupil.inside
    for seed in range(4):
        counts = camera(5 * truth, (20, seed), light=0.5 + seed)
        commands = fast(counts)
        largest = np.abs(commands).max()
        np.testing.assert_allclose(commands, plain(counts), atol=3e-6 * largest)
        np.testing.assert_allclose(fast.phase[inside], plain.phase[inside], atol=1e-5)
        assert not fast.phase[~inside].any()
        # Rows and columns of the grid lie along those of the camera to 0.02 pixels only.
        np.testing.assert_allclose(commands, straight(counts), atol=1e-3 * largest)


def test_light_is_measured_in_each_frame(camera, controller, truth):
    for light in (3.0, 1.0, 0.01):
        np.testing.assert_allclose(controller(camera(truth, 10, light)), truth, atol=4e-3 / min(light, 1) ** 0.5)
        assert controller.flux == pytest.approx(light, rel=0.03)


def test_errors_of_commands_are_those_that_noise_makes(camera, calibration, pokes, controller):
    likely = calibration.controller(*pokes, poke=POKE, gain=1.0, method="likelihood")
    still = np.zeros(12)
    for control, n in ((controller, 200), (likely, 12)):
        scatter = np.std([control(camera(still, (11, seed))) for seed in range(n)], axis=0)
        assert np.sqrt(np.mean((scatter / control.sigma) ** 2)) == pytest.approx(1, abs=0.12 if n > 100 else 0.3)
    assert controller.expected_residual == pytest.approx(np.sqrt(np.mean(controller.sigma**2)))


def test_call_allocates_nothing(camera, controller, truth):
    counts, out = camera(truth, 9), np.empty(12, np.float32)
    controller(counts, out=out)
    tracemalloc.start()
    controller(counts, out=out)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1500  # headers of views; a map of the pixels would be 7 kB


def test_bad_pixels_of_one_frame_are_replaced_and_counted(camera, controller, truth):
    counts = camera(truth, 9)
    whole = controller(counts).copy()
    rows, columns = (places[::97] for places in np.nonzero(controller.mask))
    for value in (65535, np.nan, np.inf):
        spoiled = counts.astype(counts.dtype if value == 65535 else float)
        spoiled[rows, columns] = value
        np.testing.assert_allclose(controller(spoiled), whole, atol=4e-3)
        assert controller.n_bad == len(rows)
        assert controller.flux == pytest.approx(1, rel=0.02)
    controller(counts)
    assert controller.n_bad == 0


@pytest.mark.parametrize("method", ["linear", "phase-shifted"])
def test_frame_without_light_gives_no_command(camera, calibration, pokes, method):
    control = calibration.controller(*pokes, poke=POKE, method=method)
    for counts in (DARK, np.nan):
        assert not control(np.full(calibration.shape, counts)).any()
        assert control.lost
    control(camera(np.zeros(12), 9))
    assert not control.lost


@pytest.mark.parametrize("method", ["linear", "phase-shifted"])
def test_frame_without_a_pupil_gives_no_command(camera, calibration, pokes, method):
    control = calibration.controller(*pokes, poke=POKE, method=method)
    rng = np.random.default_rng(1)
    for level in (100, 1e4, 1e6):
        for counts in (np.full(calibration.shape, level), rng.poisson(level, calibration.shape)):
            assert not control(np.minimum(DARK + counts, 65534)).any()
            assert control.lost


@pytest.mark.parametrize("method", ["linear", "phase-shifted"])
def test_background_that_has_risen_is_measured(camera, calibration, pokes, truth, method):
    control = calibration.controller(*pokes, poke=POKE, method=method)
    for risen in (0.0, 0.1):
        control(camera(truth, 9) + risen * camera.photons)
        # Behind the masks, the flat mirror has about half of the light of a clear frame.
        assert control.background == pytest.approx(2 * risen, abs=0.05)
        assert not control.lost


def test_noisy_pokes_do_not_lower_the_gain(camera, calibration, controller, truth):
    faint = calibration.controller(*Camera(photons=100).pokes(), poke=POKE, gain=1.0)
    exact, noisy = (
        control(camera(2 * truth, 12)) - control(camera(0 * truth, 13)) for control in (controller, faint)
    )
    assert noisy @ exact / (exact @ exact) == pytest.approx(1, abs=0.1)


def test_one_image_with_one_mask_gives_commands(truth):
    camera = Camera(phase_shifts=(np.pi / 2,))
    calibration, pokes = camera.calibration(), camera.pokes()
    for method in ("linear", "phase-shifted"):
        control = calibration.controller(*pokes, poke=POKE, gain=1.0, method=method)
        np.testing.assert_allclose(control(camera(truth, 9)), truth, atol=8e-3)


@pytest.mark.parametrize("name", ["controller.npz", "controller.fits"])
def test_file_holds_plain_arrays_and_makes_the_same_controller(tmp_path, camera, controller, truth, name):
    for _ in range(2):  # a controller may be replaced
        controller.save(tmp_path / name)
    read = Controller.load(tmp_path / name)
    counts = camera(truth, 9)
    np.testing.assert_array_equal(read(counts), controller(counts))
    assert read.background == pytest.approx(controller.background) != 0
    assert repr(read) == repr(controller)
    assert read.expected_residual == pytest.approx(controller.expected_residual)
    # As other software applies it.
    if name.endswith("npz"):
        arrays = np.load(tmp_path / name)
    else:
        fits = pytest.importorskip("astropy.io.fits")
        units = fits.open(tmp_path / name, memmap=False)
        arrays = {"matrix": units[0].data} | {unit.name.lower(): unit.data for unit in units[1:]}
    signal = counts[arrays["mask"] > 0] - arrays["dark"]
    commands = arrays["matrix"] @ (signal / signal.sum() - arrays["reference"])
    np.testing.assert_allclose(commands, controller(counts), atol=1e-5)


@pytest.mark.parametrize(("name", "method"), [("phase.npz", "phase-shifted"), ("phase.fits", "likelihood")])
def test_slower_controller_is_saved(tmp_path, camera, calibration, pokes, truth, name, method):
    if name.endswith("fits"):
        pytest.importorskip("astropy.io.fits")
    control = calibration.controller(*pokes, poke=POKE, gain=0.5, method=method)
    for _ in range(2):
        control.save(tmp_path / name)
    read = PhaseController.load(tmp_path / name, calibration)
    assert repr(read) == repr(control)
    for seed in (9, 10):
        counts = camera(truth, seed)
        np.testing.assert_array_equal(read(counts), control(counts))
    with pytest.raises(ValueError, match="calibration: expected the one with which the controller"):
        PhaseController.load(tmp_path / name, replace(calibration, saturation=60000.0))
    with pytest.raises(FileError, match=f"{name}: a broken controller"):
        Controller.load(tmp_path / name)


def test_pokes_come_from_files(tmp_path, calibration, pokes, controller):
    paths = [tmp_path / f"{name}.npy" for name in ("flat", "pushed", "pulled")]
    for path, frames in zip(paths, pokes, strict=True):
        np.save(path, frames)
    np.testing.assert_array_equal(calibration.controller(*paths, poke=POKE, gain=1.0).matrix, controller.matrix)


def spoiled(pokes, **changes):
    names = ("flat", "pushed", "pulled")
    return [changes.get(name, frames) for name, frames in zip(names, pokes, strict=True)]


def test_pokes_that_make_no_sense_are_named(calibration, pokes):
    flat, pushed, pulled = pokes

    def with_poke(frames, number, image):
        return np.concatenate([frames[:number], image[np.newaxis], frames[number + 1 :]])

    cases = [
        (spoiled(pokes, pushed=with_poke(pushed, 3, flat[0]), pulled=with_poke(pulled, 3, flat[1])),
         r"pokes \[3\] do not move the frames"),
        (spoiled(pokes, pulled=with_poke(pulled, 5, flat[0])), r"pokes \[5\] contradict each other"),
        (spoiled(pokes, pushed=with_poke(pushed, 7, pushed[2]), pulled=with_poke(pulled, 7, pulled[2])),
         "pokes 2 and 7 move the frames in the same way"),
        (spoiled(pokes, pulled=pulled[:-1]), r"pulled has shape \(11, .*expected \(12,"),
        (spoiled(pokes, pushed=pushed[0]), "pushed has shape .*for each command"),
        (spoiled(pokes, flat=flat[..., 1:]), "flat has shape .*the camera image"),
        (spoiled(pokes, flat=np.full(flat.shape, 65535)), "0 of the .* pixels of the pupils are good"),
        (spoiled(pokes, flat=np.full(flat.shape, DARK - 1)), r"flat: frames \[0, 1, 2, 3\] have no light"),
    ]  # fmt: skip
    for frames, message in cases:
        with pytest.raises(ValueError, match=message):
            calibration.controller(*frames, poke=POKE)


def test_frames_of_another_kind_are_refused_by_name(tmp_path, calibration, pokes, controller):
    with pytest.raises(ValueError, match=r"counts has shape \(3, 3\)"):
        controller(np.zeros((3, 3)))
    with pytest.raises(TypeError, match="counts has dtype complex"):
        controller(np.zeros(calibration.shape, complex))
    with pytest.raises(TypeError, match=r"out .*float32"):
        controller(pokes[0][0], out=np.zeros(12))
    with pytest.raises(ValueError, match=r"out has shape \(3,\)"):
        controller(pokes[0][0], out=np.zeros(3, np.float32))
    with pytest.raises(FileNotFoundError, match="no such file"):
        Controller.load(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"pokes.npy': expected a name that ends with .npz or .fits"):
        controller.save(tmp_path / "pokes.npy")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(ValueError, match=r"text.npz' exists and is no controller"):
        controller.save(tmp_path / "text.npz")
    with pytest.raises(FileError, match=r"text.npz: a broken controller"):
        Controller.load(tmp_path / "text.npz")


@pytest.mark.parametrize("kind", ["actuators", "segments"])
def test_loop_on_a_bench_of_hcipy_is_as_good_as_with_perfect_knowledge(kind):
    """The delay is two frames, and the light falls 100-fold halfway."""
    pytest.importorskip("hcipy", reason="HCIPy is not installed")
    bench, rng, photons, gain, n = LoopBench(kind), np.random.default_rng(7), 5000.0, 0.3, 90
    screens = bench.wind(0.5, speed=3.0)
    wind = [screens(step * 1e-3) for step in range(n)]

    def residuals(estimate):
        """Rms in bright and in faint light, radian."""
        rms, commands = [], [np.zeros(bench.n_commands)] * 3
        for step, screen in enumerate(wind):
            residual = screen + commands[-3] @ bench.modes
            rms.append(bench.rms(residual))
            commands.append(commands[-1] - estimate(residual, photons if step < n // 2 else photons / 100))
        return np.sqrt(np.mean(np.square([rms[n // 2 - 15 : n // 2], rms[-15:]]), axis=1))

    knowing = bench.perfect_estimate(photons)
    perfect = residuals(lambda residual, light: gain * knowing(residual, light, rng))
    calibration, pokes = bench.calibration(photons), bench.pokes(0.3, photons)
    for method in ("linear", "phase-shifted"):
        control = calibration.controller(*pokes, poke=0.3, gain=gain, method=method)
        loop = residuals(lambda residual, light: control(bench.counts(residual, light, rng)))  # noqa: B023
        print(kind, method, loop.round(4), perfect.round(4))
        assert np.all(loop < 1.2 * perfect)
        assert loop[0] < 0.12  # of 0.5


def test_phases_reach_farther_than_the_product():
    """In open loop, relative to the input of 0.5 rad rms: the numbers of the page on real time."""
    pytest.importorskip("hcipy", reason="HCIPy is not installed")
    bench, photons, rng = LoopBench("segments"), 2e4, np.random.default_rng(0)
    calibration, pokes = bench.calibration(photons), bench.pokes(0.3, photons)
    errors = []
    for method, n_frames in (("linear", 1), ("phase-shifted", 5)):
        control = calibration.controller(*pokes, poke=0.3, gain=1.0, method=method)
        for truth in rng.normal(size=(4, bench.n_commands)):
            commands = truth * 0.5 / bench.rms(truth @ bench.modes)
            for _ in range(n_frames):
                measured = control(bench.counts(commands @ bench.modes, photons, rng))
            errors.append(bench.rms((measured - commands) @ bench.modes) / 0.5)
    product, phases = np.median(np.reshape(errors, (2, 4)), axis=1)
    assert product == pytest.approx(0.32, abs=0.06)
    assert phases == pytest.approx(0.07, abs=0.03)


def test_page_on_real_time_closes_a_loop(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    loop, bench, result, fit = code_of("real_time.md")
    names: dict = {}
    for code in (bench, loop, result):
        exec(code, names)
    assert capsys.readouterr().out == code_of("real_time.md", "text")[0]
    exec(fit, names)
    assert names["residuals"][-1] < 0.04
    assert np.std(names["shape"]) < 0.1
