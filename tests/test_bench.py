from fractions import Fraction

import numpy as np
import pytest
from scipy import ndimage

from zwfs import Dimple, PhaseShifted, Pupil, ZernikeSensor, power_law_screens, zernike_basis
from zwfs.bench.model import Bench, BenchModel, segment_residual, segment_screens

from .conftest import SMALL
from .conftest import ideal_bench as ideal

N = SMALL["n_pixels"]
EXTENT = 180 / 136
MARGIN = 11
LAYOUT = Pupil.hexagonal(N, 3, 0.02, (21,), 0.8)


def design(bench, diameter=1.06):
    """Sensor of an ideal bench, made without it."""
    pupil = Pupil.from_segments(LAYOUT.segments, np.sqrt(1 + bench.illumination * LAYOUT.x))
    return ZernikeSensor(pupil, Dimple(diameter, np.pi / 2), Dimple(diameter, -np.pi / 2), extent=EXTENT)


def inner(images):
    return images[..., MARGIN:-MARGIN, MARGIN:-MARGIN]


def phase_of(bench):
    """Phase that a bench adds to the flat command, as a perfect sensor would see it: NaN outside."""
    return PhaseShifted(design(bench), n_iterations=50, tolerance=1e-10)(bench.frames()).phase


@pytest.fixture(scope="module")
def commands(perfect):
    """Two random commands of 0.5 rad rms."""
    return segment_screens(perfect, 0.5, 2, seed=1)


# Layout


def test_layout_is_36_segments_six_across_with_one_missing_at_the_top_right():
    bench = Bench.ideal()
    assert bench.n_segments == 36
    np.testing.assert_array_equal(bench.numbers, np.setdiff1d(np.arange(1, 38), [21]))
    rows, columns = np.nonzero(Pupil.hexagonal(136, 3, 0.02, (), 0.8).segments == 21)
    assert columns.min() > 80  # +x
    assert rows.min() > 80  # +y, at the top as the figures show it
    assert not bench.segments[rows, columns].any()
    centres = {k: np.mean(np.nonzero(bench.segments == k), axis=1) for k in range(1, 8)}
    pitches = [np.hypot(*(centres[k] - centres[1])) for k in range(2, 8)]
    np.testing.assert_allclose(pitches, np.mean(pitches), rtol=0.01)
    assert 5.4 < 136 / np.mean(pitches) < 6.5  # 24.9 pixels, as in the real frames


def test_blur_widens_the_images_and_loses_no_light(perfect):
    def moments(image):
        axes = np.indices(image.shape).reshape(2, -1)
        return image.sum(), np.cov(axes, aweights=image.ravel(), ddof=0).diagonal()

    for sharp, blurred in zip(perfect.clear_frames(), ideal(blur=1.5).clear_frames(), strict=True):
        (light, width), (same, wider) = moments(sharp), moments(blurred)
        assert same == pytest.approx(light)
        np.testing.assert_allclose(wider - width, 1.5**2, rtol=0.01)


# Without errors


@pytest.mark.parametrize("illumination", [0, 0.5, 1.2])
def test_ideal_bench_is_the_sensor(illumination, commands):
    bench = ideal(illumination=illumination)
    sensor = design(bench)
    expected = sensor.measure(bench.commanded_phase(commands))
    np.testing.assert_allclose(bench.frames(commands), expected, rtol=0, atol=1e-10)
    flat = sensor.measure(np.zeros(LAYOUT.shape))
    np.testing.assert_allclose(bench.frames(), flat, rtol=0, atol=1e-10)
    lit = np.pad(sensor.pupil.amplitude**2, MARGIN)
    np.testing.assert_allclose(bench.clear_frames(), [lit, lit], rtol=0, atol=1e-12)
    assert not bench.dark().any()


@pytest.mark.parametrize("relay", [{}, {"misregistration": 0.5, "focus_difference": 3e-4, "blur": 0.8}])
@pytest.mark.parametrize("extent", [1, EXTENT, 2.5])
def test_frames_do_not_depend_on_the_width_of_the_camera(relay, extent, commands):
    """The relay moves light over the edge of the camera, and none comes back."""
    frames = ideal(extent=extent, **relay).frames(commands)
    margin = (frames.shape[-1] - N) // 2
    assert margin == round((extent - 1) * N / 2)
    centre = frames[..., margin : margin + N, margin : margin + N]
    np.testing.assert_allclose(centre, inner(ideal(**relay).frames(commands)), rtol=0, atol=1e-9)


# Each error alone


@pytest.mark.parametrize("leakage", [0.03, 0.2, 0.5])
def test_leakage_mixes_the_images_by_that_fraction(perfect, commands, leakage):
    bench = ideal(leakage=leakage)
    plus, minus = np.moveaxis(perfect.frames(commands), 1, 0)
    mixed = np.stack([(1 - leakage) * plus + leakage * minus, (1 - leakage) * minus + leakage * plus], axis=1)
    np.testing.assert_allclose(bench.frames(commands), mixed, rtol=0, atol=1e-13)
    np.testing.assert_allclose(bench.clear_frames(), perfect.clear_frames(), rtol=0, atol=1e-13)
    assert np.abs(plus - minus).max() > 0.5


@pytest.mark.parametrize("imbalance", [-0.3, 0.05])
def test_flux_imbalance_shows_in_the_pupil_images_and_drops_out(perfect, commands, imbalance):
    bench = ideal(flux_imbalance=imbalance)
    share = np.array([1 + imbalance, 1 - imbalance])[:, np.newaxis, np.newaxis]
    np.testing.assert_allclose(bench.clear_frames(), share * perfect.clear_frames(), rtol=1e-13)
    np.testing.assert_allclose(bench.frames(commands), share * perfect.frames(commands), rtol=1e-13)
    scaled = BenchModel.from_images(bench).normalise(bench.frames(commands))
    np.testing.assert_allclose(scaled, perfect.frames(commands), rtol=1e-12)


@pytest.mark.parametrize("distance", [0.2, 1.3, 3.0])
def test_misregistration_moves_the_images_apart(perfect, distance):
    def centroids(images):
        rows, columns = np.mgrid[: images.shape[-2], : images.shape[-1]]
        return np.stack([(images * grid).sum(axis=(1, 2)) / images.sum(axis=(1, 2)) for grid in (rows, columns)])

    images = ideal(misregistration=distance).clear_frames()
    moved = centroids(images) - centroids(perfect.clear_frames())
    np.testing.assert_allclose(moved, np.array([[0.5, -0.5]] * 2) * distance, atol=0.02)
    np.testing.assert_allclose(images.sum(axis=(1, 2)), perfect.clear_frames().sum(axis=(1, 2)), rtol=2e-3)


def test_misregistration_moves_frames_as_it_moves_pupil_images(perfect, commands):
    frames, moved = perfect.frames(commands), ideal(misregistration=2).frames(commands)
    for arm, step in enumerate((1, -1)):
        expected = np.roll(frames[:, arm], (step, step), axis=(-2, -1))
        np.testing.assert_allclose(inner(moved[:, arm]), inner(expected), rtol=0, atol=1e-12)


@pytest.mark.parametrize("distance", [0.2, 1])
def test_misregistration_does_not_blur(distance):
    # A shift leaves the modulus of the spectrum alone: here at the quilting, 22 / D along either axis.
    bench = {"n_rings": 0, "missing": (), "illumination": 0, "quilting": 0.3}
    still, moved = (np.abs(np.fft.fft2(ideal(misregistration=d, **bench).frames())) for d in (0, distance))
    frequency = np.abs(np.fft.fftfreq(still.shape[-1], 1 / N))
    line = np.argmin(np.abs(frequency - 22))
    for row, column in ((0, line), (line, 0)):
        np.testing.assert_allclose(moved[:, row, column], still[:, row, column], rtol=0.05)


def fresnel(field, distance, n_wide):
    """Angular spectrum by plain matrices, on a plane n_wide pixels wide."""
    pad = (n_wide - len(field)) // 2
    axis = np.arange(n_wide) / N
    frequency = (np.arange(n_wide) - n_wide // 2) * N / n_wide
    fourier = np.exp(-2j * np.pi * np.outer(frequency, axis))
    propagation = np.exp(-1j * np.pi * distance * frequency**2)
    operator = fourier.conj().T @ (propagation[:, np.newaxis] * fourier) / n_wide
    wide = operator @ np.pad(field, pad) @ operator.T
    return wide[pad : pad + len(field), pad : pad + len(field)]


@pytest.mark.parametrize("distance", [1e-4, 2e-3])
def test_focus_difference_is_free_space_to_either_side(perfect, commands, distance):
    bench = ideal(focus_difference=distance)
    sensor = design(bench)
    wide = ZernikeSensor(sensor.pupil, *sensor.masks, extent=4)
    waves = wide.propagate(sensor.pupil.amplitude * np.exp(1j * bench.commanded_phase(commands[0])))
    expected = np.stack(
        [np.abs(fresnel(w, s * distance / 2, 12 * N)) ** 2 for w, s in zip(waves, (1, -1), strict=True)]
    )
    cut = 3 * N // 2 - MARGIN
    # The light that comes back from the other side of the plane is all that differs.
    np.testing.assert_allclose(bench.frames(commands[0]), expected[:, cut:-cut, cut:-cut], rtol=0, atol=3e-5)
    unlike = np.abs(bench.frames(commands[0]) - perfect.frames(commands[0])).max()
    assert unlike > 50 * distance


def test_dimple_error_changes_the_dimple_only(perfect, commands):
    bench = ideal(dimple_error=0.25)
    np.testing.assert_array_equal(bench.clear_frames(), perfect.clear_frames())
    expected = design(bench, 1.06 * 1.25).measure(bench.commanded_phase(commands))
    np.testing.assert_allclose(bench.frames(commands), expected, rtol=0, atol=1e-10)
    assert np.abs(expected - perfect.frames(commands)).max() > 0.05


def test_static_aberration_is_smooth_and_has_its_rms(perfect):
    bench = ideal(static=0.3)
    np.testing.assert_allclose(bench.clear_frames(), perfect.clear_frames(), rtol=0, atol=1e-14)
    phase = phase_of(bench)
    assert LAYOUT.rms(phase) == pytest.approx(0.3, abs=1e-6)
    low = zernike_basis(LAYOUT, 27)[:, LAYOUT.inside]
    values = phase[LAYOUT.inside] - phase[LAYOUT.inside].mean()
    rest = values - low.T @ np.linalg.lstsq(low.T, values)[0]
    assert rest.std() < 1e-5
    # It belongs to the bench: half of it has the same shape, another seed another one.
    half, fresh = phase_of(ideal(static=0.15))[LAYOUT.inside], phase_of(ideal(static=0.3, seed=1))[LAYOUT.inside]
    np.testing.assert_allclose(2 * (half - half.mean()), values, atol=1e-5)
    assert abs(np.corrcoef(fresh, values)[0, 1]) < 0.9


def test_quilting_has_its_rms_and_22_periods(perfect):
    bench = ideal(quilting=0.06)
    np.testing.assert_allclose(bench.clear_frames(), perfect.clear_frames(), rtol=0, atol=1e-14)
    values = phase_of(bench)[LAYOUT.inside]
    assert values.std() == pytest.approx(0.06, rel=0.03)
    x, y = LAYOUT.points.T
    grid = np.cos(2 * np.pi * 22 * x) + np.cos(2 * np.pi * 22 * y)
    assert np.corrcoef(values, grid)[0, 1] > 0.99999


def test_static_and_quilting_add_to_the_commands(commands):
    bench = ideal(static=0.2, quilting=0.06)
    flat, phase = (
        PhaseShifted(design(bench), n_iterations=60, tolerance=1e-10)(bench.frames(pistons)).phase[LAYOUT.inside]
        for pistons in (None, commands[0])
    )
    excess = np.exp(1j * (phase - flat - bench.commanded_phase(commands[0])[LAYOUT.inside]))
    assert abs(excess.mean()) == pytest.approx(1, abs=1e-9)


# Noise


def test_counts_scatter_as_those_of_a_camera(perfect):
    photons, read_noise, background = 1e6, 20.0, 300.0
    bench = ideal(photons_per_image=photons, read_noise=read_noise, background=background, flux_imbalance=0.2)
    share = np.array([1.2, 0.8])[:, np.newaxis, np.newaxis]
    expected = perfect.frames() * share * photons / LAYOUT.n_points + background
    frames = bench.frames(np.zeros((200, 36)), seed=3)
    score = (frames.mean(axis=0) - expected) / np.sqrt((expected + read_noise**2) / 200)
    assert np.abs(score).max() < 5.5
    assert score.std() == pytest.approx(1, abs=0.05)
    assert np.mean(frames.var(axis=0, ddof=1) / (expected + read_noise**2)) == pytest.approx(1, abs=0.01)
    dark = bench.dark(4)
    assert dark.mean() == pytest.approx(background, abs=5 * np.sqrt((background + read_noise**2) / dark.size))
    assert dark.var() == pytest.approx(background + read_noise**2, rel=0.05)


# Commands


def test_commands_are_in_the_order_of_the_numbers(perfect):
    pistons = np.zeros(36)
    pistons[[4, 20]] = 0.3, -0.2  # numbers 5 and 22: 21 is missing
    phase = perfect.commanded_phase(pistons)
    expected = 0.3 * (LAYOUT.segments == 5) - 0.2 * (LAYOUT.segments == 22)
    np.testing.assert_array_equal(phase, expected)
    np.testing.assert_array_equal(perfect.frames(0 * pistons), perfect.frames())


# What the bench hands out


def test_bench_keeps_its_aberrations_to_itself():
    low, high = (Bench(**SMALL, static=value, quilting=value, seed=seed) for value, seed in ((0.1, 1), (0.5, 2)))
    own = {"static", "quilting", "seed"}
    names = [name for name in dir(low) if not name.startswith("_") and name not in own]
    assert {"segments", "numbers", "n_pixels"} <= set(names)
    shown = [name for name in names if not callable(getattr(low, name))]
    for name in shown:
        np.testing.assert_array_equal(getattr(low, name), getattr(high, name), name)
    pistons = np.linspace(-1, 1, low.n_segments)
    np.testing.assert_array_equal(low.commanded_phase(pistons), high.commanded_phase(pistons))


def test_model_knows_no_more_than_the_images_show(perfect, model):
    hidden = ideal(leakage=0.1, dimple_error=0.3, static=0.4, quilting=0.2, seed=7)
    blind = BenchModel.from_images(hidden)
    np.testing.assert_allclose(blind.shifted.pupil.amplitude, model.shifted.pupil.amplitude, atol=1e-12)
    np.testing.assert_allclose(blind.scale, model.scale)
    for sensor, masks in ((blind.shifted, 2), (blind.classic, 1)):
        assert [mask.diameter for mask in sensor.masks] == [1.06] * masks
        assert [mask.phase for mask in sensor.masks] == [np.pi / 2, -np.pi / 2][:masks]
    assert not any(isinstance(value, Bench) for value in vars(blind).values())


def test_model_has_the_layout_and_amplitude_of_an_ideal_bench(perfect, model):
    truth = design(perfect).pupil.amplitude
    np.testing.assert_allclose(model.shifted.pupil.amplitude, truth, atol=1e-12)
    np.testing.assert_array_equal(model.segments, LAYOUT.segments)
    np.testing.assert_array_equal(model.modes.argmax(axis=0)[LAYOUT.inside], model.segments[LAYOUT.inside] - 1
                                  - (model.segments[LAYOUT.inside] > 21))  # fmt: skip
    np.testing.assert_array_equal(model.modes.sum(axis=0), LAYOUT.inside)


def test_model_amplitude_is_close_to_the_truth_on_the_bench_as_it_is():
    bench = Bench()
    layout = Pupil.hexagonal(136, 3, 0.02, (21,), 0.8)
    truth = Pupil.from_segments(layout.segments, np.sqrt(1 + 0.5 * layout.x)).amplitude
    pupil = BenchModel.from_images(bench, seed=1).shifted.pupil
    assert pupil.inside[layout.inside].mean() > 0.999
    missing = Pupil.hexagonal(136, 3, 0.02, (), 0.8).segments == 21
    assert pupil.inside[missing].mean() < 0.35  # its edges catch some light
    ratio = (pupil.amplitude / truth.clip(0.1))[layout.inside]
    assert ratio.std() / ratio.mean() < 0.1
    # Away from gaps and edges, where diffraction is at home, it is much closer.
    deep = ndimage.binary_erosion(layout.inside, iterations=4)[layout.inside]
    assert ratio[deep].std() / ratio[deep].mean() < 0.04
    assert not pupil.inside[np.hypot(layout.x, layout.y[:, np.newaxis]) > 0.5].any()


def test_normalised_counts_are_1_on_average_in_the_pupil():
    bench = ideal(photons_per_image=1e9, read_noise=30, background=5000, flux_imbalance=0.2)
    model = BenchModel.from_images(bench, 1)
    off = model.normalise(bench.clear_frames(2))
    np.testing.assert_allclose(inner(off)[:, LAYOUT.inside].mean(axis=1), 1, atol=1e-3)
    assert off.min() < 0  # noise around 0 is left as it is
    np.testing.assert_allclose(model.normalise(model.dark), 0)
    frames = bench.frames(np.zeros((3, 36)), 2)
    np.testing.assert_array_equal(model.normalise(frames)[1], model.normalise(frames[1]))


# Pistons


def test_pistons_are_circular_means_over_finite_points(model):
    rng = np.random.default_rng(2)
    truth = rng.uniform(-np.pi, np.pi, (2, 36))
    phase = np.einsum("bk,kyx->byx", truth, model.modes)
    noisy = phase + np.where(rng.uniform(size=phase.shape) < 0.5, 0.8, -0.8)
    wrapped = np.angle(np.exp(1j * noisy))
    pistons = model.pistons(wrapped)
    for batch in range(2):
        for index, number in enumerate(model.numbers):
            values = wrapped[batch][model.segments == number]
            expected = np.arctan2(np.sin(values).sum(), np.cos(values).sum())
            assert pistons[batch, index] == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(np.cos(pistons - truth), 1, atol=0.2)
    holes = np.where(rng.uniform(size=phase.shape) < 0.3, np.nan, phase)
    holes[:, model.segments == 0] = np.nan
    np.testing.assert_allclose(model.pistons(holes), truth, atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * model.pistons(phase + 40)), np.exp(1j * (truth + 40)), atol=1e-10)


def test_segment_residual_is_blind_to_piston_and_turns():
    rng = np.random.default_rng(3)
    commanded, error = rng.normal(size=(2, 4, 36))
    error *= 0.2
    turns = 2 * np.pi * rng.integers(-2, 3, error.shape)
    rest = segment_residual(commanded + error + turns + 1.7, commanded)
    np.testing.assert_allclose(np.exp(1j * (rest - error)) / np.exp(1j * (rest - error))[:, :1], 1, atol=1e-12)
    np.testing.assert_allclose(np.angle(np.exp(1j * rest).mean(axis=1)), 0, atol=1e-12)
    single = np.zeros(36)
    single[3] = 3.0
    assert segment_residual(single, np.zeros(36))[3] == pytest.approx(3.0, abs=0.1)
    np.testing.assert_allclose(segment_residual(commanded, commanded[0]).shape, (4, 36))


def test_segment_screens_are_averaged_power_law_screens(perfect):
    screens = segment_screens(perfect, 0.8, 6, seed=4)
    assert screens.shape == (6, 36)
    np.testing.assert_allclose(screens.std(axis=1), 0.8, rtol=1e-12)
    np.testing.assert_allclose(screens.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_array_equal(segment_screens(perfect, 0.8, 6, seed=4), screens)
    np.testing.assert_allclose(segment_screens(perfect, 0.8, 2, seed=4), screens[:2], atol=1e-12)
    np.testing.assert_allclose(segment_screens(perfect, 0.4, 6, seed=4), screens / 2, atol=1e-12)
    assert np.abs(segment_screens(perfect, 0.8, 6, seed=5) - screens).max() > 0.1
    # The errors of a bench do not change what it is commanded.
    np.testing.assert_array_equal(segment_screens(Bench(**SMALL, seed=3), 0.8, 6, seed=4), screens)
    maps = power_law_screens(zernike_basis(Pupil.circular(N), 200), 1.0, 6, seed=4)
    means = np.stack([maps[:, LAYOUT.segments == k].mean(axis=1) for k in perfect.numbers], axis=1)
    for mean, screen in zip(means, screens, strict=True):
        assert np.corrcoef(mean, screen)[0, 1] == pytest.approx(1, abs=1e-12)
    assert not segment_screens(perfect, 0, 1, seed=4).any()


def test_numbers_of_other_types_are_kept_as_plain_ones():
    small = {name: np.int8(value) if isinstance(value, int) else value for name, value in SMALL.items()}
    converted = Bench(**small, seed=np.uint8(1), focus_difference=Fraction(1, 10**4))
    plain = Bench(**SMALL, seed=1, focus_difference=1e-4)
    np.testing.assert_array_equal(converted.frames(seed=2), plain.frames(seed=2))
