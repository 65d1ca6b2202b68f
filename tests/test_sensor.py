import copy
import inspect
import pickle
import re
import warnings

import numpy as np
import pytest

import zwfs
from zwfs import Detector, Dimple, Patch, Pupil, ZernikeSensor, zernike_basis

from .conftest import needs_modes
from .reference import exact_ellipse, exact_reference


def ramp(u, v):
    """A transmission without any symmetry."""
    return (0.8 + 0.1 * u) * np.exp(1j * (0.9 + 1.3 * u - 0.4 * v + 0.2 * u * v))


MASKS = {
    "dimple": (Dimple(1.06, np.pi / 2),),
    "two dimples": (Dimple(1.06, np.pi / 2), Dimple(2.0, -1.0, 0.7)),
    "patch": (Patch(1.5, ramp), Dimple(1.06, -np.pi / 2), Patch(3.0, lambda u, v: 0.3j, breaks=[1.0])),
}


@pytest.mark.parametrize("masks", MASKS.values(), ids=MASKS)
def test_error_stays_at_the_tolerance(masks):
    pupil = Pupil.circular(12)
    points = pupil.scatter(np.eye(pupil.n_points), fill=0)

    def matrices(tolerance):
        sensor = ZernikeSensor(pupil, *masks, extent=1.5, tolerance=tolerance)
        return sensor.rank, sensor.reference_wave(points).reshape(len(points), len(masks), -1).swapaxes(0, 1)

    _, exact = matrices(1e-15)
    strongest = np.linalg.norm(exact, 2, axis=(1, 2)).max()
    ranks = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        rank, waves = matrices(tolerance)
        ranks.append(rank)
        assert np.linalg.norm(waves - exact, 2, axis=(1, 2)).max() < 3 * tolerance * strongest
    assert np.all(np.diff(ranks) > 0)


def test_patch_of_several_rings_is_a_sum_of_airy_kernels(complex_field):
    pupil, margin = Pupil.circular(32), 8
    edges, inside = (0.8, 1.5, 2.1, 3.0), (0.9j, 0.2, -0.7, np.exp(0.4j))
    field = complex_field(pupil)

    def rings(u, v):
        return np.array(inside)[np.searchsorted(np.divide(edges[:3], 2), np.hypot(u, v))]

    steps = -np.diff([*inside, 1])  # of the transmission, outwards
    discs = (exact_reference(pupil, Dimple(d, 0.0, 0.0), field, margin) for d in edges)  # opaque: minus the kernel
    exact = -sum(step * disc for step, disc in zip(steps, discs, strict=True))
    sensor = ZernikeSensor(pupil, Patch(3.0, rings, breaks=edges[:3]), extent=1.5, tolerance=1e-14)
    np.testing.assert_allclose(sensor.reference_wave(field)[0], exact, rtol=0, atol=1e-12)


def ellipse(width, height, turned, **settings):
    """Opaque ellipse, turned by an angle from u to v."""

    def along(u, v):
        wave = (u + 1j * v) * np.exp(-1j * turned)
        return np.hypot(wave.real / width, wave.imag / height)

    def outline(angle):
        return 1 / along(np.cos(angle), np.sin(angle))

    breaks = [0.3, outline]  # the circle is not needed, and disturbs nothing
    return Patch(width, lambda u, v: np.where(along(u, v) < 0.5, 0, 1), breaks=breaks, **settings)


@pytest.mark.parametrize(
    ("width", "height", "settings"), [(1.6, 1.0, {}), (1.01, 1.0, {}), (1.2, 0.5, {"n_samples": 96})]
)
def test_ellipse_with_its_outline_is_as_exact_as_a_dimple(complex_field, width, height, settings):
    pupil = Pupil.circular(16)
    field = complex_field(pupil)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor = ZernikeSensor(pupil, ellipse(width, height, 0.4, **settings), tolerance=1e-14)
    exact = exact_ellipse(pupil, width, height, 0.4, field)
    np.testing.assert_allclose(sensor.reference_wave(field)[0], exact, rtol=0, atol=1e-12)


def test_outline_scales_with_the_wavelength(complex_field):
    pupil = Pupil.circular(16)
    phase = 0.3 * complex_field(pupil).real
    band = zwfs.PolychromaticSensor(
        ZernikeSensor(pupil, ellipse(1.6, 1.0, 0.4)), [600.0, 700.0], reference_wavelength=600.0
    )
    at_700 = ZernikeSensor(pupil, ellipse(1.6 * 6 / 7, 6 / 7, 0.4)).measure(phase * 6 / 7)
    both = (band.reference.measure(phase) + at_700) / 2
    np.testing.assert_allclose(band.measure(phase), both, rtol=0, atol=1e-8)


@pytest.mark.parametrize("diameter", [0.5, 1.5, 5.0])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_quadrature_is_exact_to_far_below_the_tolerance(diameter, tolerance):
    pupil = Pupil.circular(12)
    points = pupil.scatter(np.eye(pupil.n_points), fill=0)
    function = {"function": lambda u, v: 0.7 * ramp(u, v)}
    waves, exact = (
        ZernikeSensor(pupil, Patch(diameter, **function, n_samples=n), tolerance=tolerance)
        .reference_wave(points)
        .reshape(len(points), -1)
        for n in (0, 128)
    )
    assert np.linalg.norm(waves - exact, 2) < 1e-4 * tolerance * np.linalg.norm(exact, 2)


SIDE = 1.0  # of the square, lambda/D


def square(u, v):
    return np.where(np.maximum(np.abs(u), np.abs(v)) < SIDE / 2, 1j, 1)


@pytest.mark.parametrize("n_samples", [0, 100, 200])
def test_error_of_a_square_patch_is_estimated(n_samples):
    pupil = Pupil.circular(12)
    points = pupil.scatter(np.eye(pupil.n_points), fill=0)
    with pytest.warns(UserWarning, match=r"masks\[1\]: .* error of about .*`breaks`.*`n_samples`") as warned:
        sensor = ZernikeSensor(
            pupil, Dimple(1.06, 1.0), Patch(np.sqrt(2) * SIDE, square, n_samples=n_samples), extent=2
        )
    assert [warning.filename for warning in warned] == [__file__]
    stated = float(re.search(r"error of about (\S+),", str(warned[0].message))[1])
    y, x = (np.arange(-6, 18) - 5.5) / 12, pupil.x
    along = SIDE / 12 * np.sinc(SIDE * (y[:, np.newaxis] - x))  # the kernel of a square is a product
    exact = (1j - 1) * (along @ points @ along.T).reshape(len(points), -1)
    waves = sensor.reference_wave(points)[:, 1].reshape(len(points), -1)
    error = np.linalg.norm(waves - exact, 2) / np.linalg.norm(exact, 2)
    assert stated / 4 < error < 4 * stated


class Grating(Dimple):
    """Dimple whose transmission varies faster than its quadrature can follow."""

    def transmission(self, u, v):
        return np.exp(40j * np.pi * np.hypot(u, v - 0.2))


def test_dimple_with_a_transmission_of_its_own_is_integrated_and_its_error_estimated():
    pupil = Pupil.circular(12)
    with pytest.warns(UserWarning, match=r"masks\[0\]: .* error of about .*`n_samples`"):
        grating = ZernikeSensor(pupil, Grating(1.5, 0.0))
    with pytest.warns(UserWarning, match=r"masks\[0\]: .* error of about"):
        patch = ZernikeSensor(pupil, Patch(1.5, Grating(1.5, 0.0).transmission))
    np.testing.assert_array_equal(*(sensor.measure(0 * pupil.amplitude) for sensor in (grating, patch)))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-6, 1e-10, 1e-14])
def test_no_patch_that_is_exact_draws_a_warning(tolerance):
    def rings(u, v):
        return np.where(np.hypot(u, v) < 0.5, 1j, np.where(np.hypot(u, v) < 0.8, 0, np.exp(0.1j * u)))

    masks = (
        Patch(1.5, ramp), Patch(0.1, ramp), Patch(2.0, rings, breaks=[1.0, 1.6]),
        Patch(1, lambda u, v: 1), Patch(1, lambda u, v: 1 - 1e-9 * u**2),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for mask in masks:
            ZernikeSensor(Pupil.circular(16), mask, extent=1.5, tolerance=tolerance)


def test_masks_as_wide_as_the_sampling_carries(complex_field):
    # Up to n_pixels lambda/D the sum over the pixels stands for the integral over the pupil.
    pupil = Pupil.circular(8)
    field = complex_field(pupil)
    sensor = ZernikeSensor(pupil, Dimple(8, 1.0), tolerance=1e-14)
    exact = exact_reference(pupil, Dimple(8, 1.0), field)
    np.testing.assert_allclose(sensor.reference_wave(field)[0], exact, rtol=0, atol=1e-12)


def attributes(thing):
    """Public attributes that are no methods."""
    names = (name for name in dir(thing) if not name.startswith("_"))
    values = ((name, getattr(thing, name)) for name in names)
    return {name: value for name, value in values if not inspect.ismethod(value)}


def assert_frozen(thing, path):
    """No attribute can be assigned or deleted, no array written to, here and in what the attributes hold."""
    if isinstance(thing, np.ndarray):
        assert not thing.flags.writeable, path
        with pytest.raises(ValueError, match="read-only"):
            thing[...] = 0
        return
    if isinstance(thing, tuple):
        for index, value in enumerate(thing):
            assert_frozen(value, f"{path}[{index}]")
    if not type(thing).__module__.startswith("zwfs"):
        return
    public = attributes(thing)
    for name in (*public, *getattr(thing, "__dict__", ()), "anything"):
        with pytest.raises(AttributeError):
            setattr(thing, name, 1)
        with pytest.raises(AttributeError):
            delattr(thing, name)
    for name, value in public.items():
        assert_frozen(value, f"{path}.{name}")


@pytest.mark.parametrize(
    "again", [lambda thing: thing, lambda thing: pickle.loads(pickle.dumps(thing)), copy.copy, copy.deepcopy]
)
def test_no_public_object_can_be_changed(rough_pupil, again):
    sensor = again(ZernikeSensor(rough_pupil, Dimple(1.06, np.pi / 2), Patch(2.0, ramp, breaks=[1.0]), extent=1.5))
    detector = again(Detector(1e6))
    phase = rough_pupil.x * np.ones(rough_pupil.shape)
    before = sensor.measure(phase), detector.expose(sensor.measure(phase), seed=1)
    band = again(zwfs.PolychromaticSensor(sensor, [600.0, 650.0]))
    mirror = again(zwfs.Mirror(rough_pupil, phase[np.newaxis]))
    classic, modes = ZernikeSensor(rough_pupil, sensor.masks[0]), zernike_basis(rough_pupil, 3)
    methods = [
        again(kind(sensor if kind.n_masks[1] > 1 else classic, *([modes] if needs_modes(kind) else [])))
        for kind in zwfs.RECONSTRUCTORS
    ]
    for thing in (sensor.pupil, sensor, *sensor.masks, sensor.factors, detector, band, mirror, *methods):
        assert_frozen(thing, type(thing).__name__)
    after = sensor.measure(phase), detector.expose(sensor.measure(phase), seed=1)
    np.testing.assert_array_equal(after[0], before[0])
    np.testing.assert_array_equal(after[1], before[1])


@pytest.mark.parametrize("extent", [1, 1.5])
def test_detector_sees_incoming_field_plus_reference_wave(pupil, complex_field, extent):
    sensor = ZernikeSensor(pupil, *MASKS["two dimples"], extent=extent)
    field = complex_field(pupil)
    rest = sensor.propagate(field) - sensor.reference_wave(field)
    np.testing.assert_allclose(rest[(..., *sensor.window)], [field * pupil.inside] * 2, atol=1e-14)
    rest[(..., *sensor.window)] = 0
    assert not rest.any()


@pytest.mark.parametrize("phases", [(np.pi / 2, -np.pi / 2), (np.pi / 2, np.pi), (0.3, -2.0)])
def test_reference_phases_differ_by_half_the_phases_of_the_dimples(pupil, screens, phases):
    sensor = ZernikeSensor(pupil, *(Dimple(1.06, phase) for phase in phases))
    a, b = np.moveaxis(sensor.reference_wave(np.exp(1j * screens(0.8))), 1, 0)
    excess = (np.angle(b / a) - (phases[1] - phases[0]) / 2)[:, pupil.inside]
    np.testing.assert_allclose(np.sin(excess), 0, atol=1e-10)


def test_piston_is_invisible(shifted, screens):
    phase = screens(0.5)
    np.testing.assert_allclose(shifted.measure(phase + 1.234), shifted.measure(phase), rtol=0, atol=1e-13)


def test_amplitudes_in_a_batch(shifted, screens, pupil):
    phase = screens(0.5, 4).reshape(2, 2, *pupil.shape)
    amplitude = np.random.default_rng(0).uniform(0.5, 1.5, phase.shape)
    both, one_phase, one_row = (
        shifted.measure(*arguments)
        for arguments in ((phase, amplitude), (phase[0, 0], amplitude), (phase, amplitude[0]))
    )
    for i, j in np.ndindex(2, 2):
        for frames, turned, a in ((both, phase[i, j], i), (one_phase, phase[0, 0], i), (one_row, phase[i, j], 0)):
            expected = np.abs(shifted.propagate(amplitude[a, j] * np.exp(1j * turned))) ** 2
            np.testing.assert_allclose(frames[i, j], expected, atol=1e-12)


def test_single_precision_in_single_precision_out(shifted, screens, pupil):
    phase = screens(0.5)
    single = shifted.measure(phase.astype(np.float32))
    swapped = shifted.measure(phase.astype(">f4"))
    assert single.dtype == swapped.dtype == np.float32
    np.testing.assert_array_equal(swapped, single)
    np.testing.assert_allclose(single, shifted.measure(phase), atol=1e-5)
    field = np.exp(1j * phase)
    for function in (shifted.propagate, shifted.reference_wave):
        waves = function(field.astype(np.complex64))
        assert waves.dtype == np.complex64
        np.testing.assert_allclose(waves, function(field), atol=1e-5)
    assert shifted.adjoint(waves).dtype == np.complex64


def test_what_lies_outside_the_pupil_does_not_matter(shifted, screens, pupil):
    phase = screens(0.5)
    np.testing.assert_array_equal(shifted.measure(np.where(pupil.inside, phase, np.nan)), shifted.measure(phase))
    field = np.exp(1j * phase) * pupil.inside
    np.testing.assert_array_equal(shifted.propagate(np.where(pupil.inside, field, 5)), shifted.propagate(field))


def test_phase_in_degrees_draws_a_warning(shifted, screens):
    with pytest.warns(UserWarning, match=r"phase has an rms of 28\.65: expected radian, less than 20 rms"):
        shifted.measure(np.degrees(screens(0.5)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shifted.measure(screens(19.0) + 1000)  # piston does not count


def test_pupil_of_a_single_row_is_a_pupil():
    sensor = zwfs.ZernikeSensor(Pupil.from_amplitude(np.ones((1, 8))), Dimple(1.06, np.pi / 2))
    assert sensor.measure(np.zeros((1, 8))).shape == (1, 1, 8)
