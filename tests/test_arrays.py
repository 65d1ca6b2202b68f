"""Arrays of other libraries: the same answers, in the library and on the device that the input came from."""

import array_api_strict
import numpy as np
import pytest
from astropy import units

from zwfs import Arcsine, Dimple, GerchbergSaxton, Linear, PhaseShifted, ZernikeSensor


class Library:
    """A library of the array API, and the way there and back."""

    def __init__(self, xp, device, to_numpy=np.asarray):
        self.xp, self.device, self.to_numpy = xp, device, to_numpy

    def array(self, values):
        return self.xp.asarray(values, device=self.device)


def torch_on(device):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU that PyTorch can use")
    return Library(torch, device, lambda array: array.cpu().numpy())


def cupy():
    library = pytest.importorskip("cupy", reason="CuPy is not installed")
    if not library.is_available():
        pytest.skip("no GPU that CuPy can use")
    return Library(library, None, library.asnumpy)


LIBRARIES = {
    # Two devices: what is made on the wrong one is refused there.
    "strict": lambda: Library(array_api_strict, array_api_strict.Device("CPU_DEVICE")),
    "strict device 1": lambda: Library(
        array_api_strict,
        array_api_strict.Device("device1"),
        lambda array: np.asarray(array.to_device(array_api_strict.Device("CPU_DEVICE"))),
    ),
    "torch": lambda: torch_on("cpu"),
    "torch on a GPU": lambda: torch_on("cuda"),
    "cupy": cupy,
}


@pytest.fixture(params=LIBRARIES)
def library(request):
    return LIBRARIES[request.param]()


def same(library, result, expected, atol=1e-10):
    """Values, precision, and the library and device that they come in."""
    values, like = library.to_numpy(result), library.array(np.zeros(1))
    assert type(result) is type(like)
    assert result.device == like.device
    assert values.dtype == np.asarray(expected).dtype
    np.testing.assert_allclose(values, expected, atol=atol, rtol=0)


@pytest.fixture
def wide(pupil):
    return ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1.3)


@pytest.mark.parametrize("name", ["propagate", "reference_wave", "adjoint"])
def test_fields(library, pupil, wide, complex_field, name):
    method = getattr(wide, name)
    field = wide.propagate(complex_field(pupil, 2)) if name == "adjoint" else complex_field(pupil, 2)
    single = field[0].astype(np.complex64)
    same(library, method(library.array(field)), method(field))
    same(library, method(library.array(single)), method(single), 1e-5)


def test_measure(library, pupil, wide, screens):
    phase = screens(0.5, 6).reshape(2, 3, *pupil.shape)
    phase[:, :, ~pupil.inside] = np.nan
    amplitude = np.linspace(0.5, 1.5, 3)[:, np.newaxis, np.newaxis] * pupil.amplitude
    same(library, wide.measure(library.array(phase)), wide.measure(phase))
    same(library, wide.measure(library.array(phase), library.array(amplitude)), wide.measure(phase, amplitude))
    # What is the same for all calls may stay an array of NumPy.
    same(library, wide.measure(library.array(phase), amplitude), wide.measure(phase, amplitude))


PAIR = Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2)
REAL_TIME = {"n_iterations": 2, "tolerance": 0, "accelerate": True}
# Method, masks, extent of the detector, options, and share of the amplitude across the pupil.
METHODS = {
    "plain": (PhaseShifted, PAIR, 1, {}, 1),
    "accelerated": (PhaseShifted, PAIR, 1, {"accelerate": True}, 1),
    "real time": (PhaseShifted, PAIR, 1, REAL_TIME, 1),
    "three masks": (PhaseShifted, (*PAIR, Dimple(1.06, 2.5)), 1.2, {"n_iterations": 8}, 1),
    "two sizes": (PhaseShifted, (PAIR[0], Dimple(1.5, -1.5)), 1, {"n_iterations": 8, "accelerate": True}, 1),
    "own amplitude": (PhaseShifted, PAIR, 1, {}, np.linspace(0.5, 1, 40)),
    "arcsine, dark points": (Arcsine, PAIR[:1], 1, {}, np.arange(40) > 12),
    "Gerchberg-Saxton": (GerchbergSaxton, PAIR, 1.5, {"n_iterations": 4}, 1),
    "Gerchberg-Saxton, model kept": (GerchbergSaxton, PAIR, 1, {"n_iterations": 4, "unmeasured": "model"}, 1),
}


def make(name, pupil):
    method, masks, extent, options, share = METHODS[name]
    sensor = ZernikeSensor(pupil, *masks, extent=extent)
    return method(sensor, amplitude=pupil.amplitude * share, **options)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("batch", [(), (4,), (2, 2)])
def test_reconstructors(library, pupil, screens, name, batch):
    method = make(name, pupil)
    # Some converge early and leave the others.
    phase = (screens(0.4, 4) * np.array([0.01, 1, 0.1, 0.7])[:, np.newaxis, np.newaxis])[
        : np.prod(batch, dtype=int)
    ]
    frames = method.sensor.measure(phase.reshape(*batch, *pupil.shape), method.settings.amplitude)
    expected, result = method(frames), method(library.array(frames))
    for attribute in ("phase", "residual", "n_iterations", "converged", "n_unsolved", "frames"):
        same(library, getattr(result, attribute), getattr(expected, attribute), 1e-9)


def test_history_and_start(library, pupil, screens):
    method = make("accelerated", pupil)
    phase = screens(0.4, 3)
    frames = method.sensor.measure(phase)
    expected, result = method(frames, history=True), method(library.array(frames), history=True)
    same(library, result.history, expected.history, 1e-9)
    same(library, method(library.array(frames), library.array(phase)).phase, method(frames, phase).phase, 1e-9)


def test_frames_that_do_not_converge(library, pupil, screens):
    sensor = ZernikeSensor(pupil, Dimple(2.0, np.pi / 2), Dimple(2.0, -np.pi / 2))
    method = PhaseShifted(sensor, n_iterations=8, accelerate=True)
    frames = sensor.measure(screens(1.2, 4)) * np.array([1.2, 1.0])[:, np.newaxis, np.newaxis]
    expected = method(frames)
    assert not expected.converged.any()
    same(library, method(library.array(frames)).phase, expected.phase, 1e-8)


def test_single_precision(library, pupil, screens):
    method, phase = make("real time", pupil), screens(0.4, 2)
    frames = method.sensor.measure(phase).astype(np.float32)
    result = method(library.array(frames))
    same(library, result.phase, method(frames).phase, 1e-3)


def test_bad_input_is_named(library, pupil):
    method = make("plain", pupil)
    frames = np.ones((2, *pupil.shape))
    for change, message in (
        ((0, 3, 4, np.nan), "frames holds 1 NaN or infinite values"),
        ((0, slice(None), slice(None), -1.0), "frames: 1 of 2 hold no light"),
        ((0, slice(None), slice(None), 0.0), "frames: 1 of 2 hold no light"),
    ):
        bad = frames.copy()
        bad[change[:-1]] = change[-1]
        with pytest.raises(ValueError, match=message):
            method(library.array(bad))
    with pytest.raises(ValueError, match=r"frames has shape \(2, 5, 5\)"):
        method(library.array(frames[:, :5, :5]))
    with pytest.raises(TypeError, match="frames is complex"):
        method(library.array(frames + 1j))


def test_arrays_on_the_wrong_device_are_named(pupil, classic, modes):
    there = array_api_strict.asarray(np.ones(pupil.shape), device=array_api_strict.Device("device1"))
    frames = classic.measure(np.zeros(pupil.shape))
    for call, name in (
        (lambda: Arcsine(classic, amplitude=there), "amplitude"),
        (lambda: classic.measure(np.zeros(pupil.shape), there), "amplitude"),
        (lambda: Arcsine(classic)(frames, there), "start"),
        (lambda: Linear(classic, modes)(there[np.newaxis, ...]), "frames"),
    ):
        with pytest.raises(TypeError, match=f"{name} is a Array that cannot become an array here"):
            call()


def test_a_unit_is_not_lost(pupil, classic):
    for method in (classic.measure, classic.propagate):
        with pytest.raises(TypeError, match="carries the unit deg"):
            method(np.zeros(pupil.shape) * units.deg)


def test_others_take_arrays_of_numpy(pupil, modes, screens):
    """Methods that are written for NumPy only answer in NumPy."""
    method = Linear(ZernikeSensor(pupil, PAIR[0]), modes)
    frames = method.sensor.measure(screens(0.1, 2))
    result = method(array_api_strict.asarray(frames))
    assert isinstance(result.phase, np.ndarray)
    np.testing.assert_array_equal(result.phase, method(frames).phase)
