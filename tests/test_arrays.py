"""Arrays of other libraries: the same answers, in the library and on the device that the input came from."""

import array_api_strict
import numpy as np
import pytest
from astropy import units

from zwfs import Arcsine, Dimple, GerchbergSaxton, Linear, PhaseShifted, ZernikeSensor, reconstruction_error
from zwfs._arrays import Kind
from zwfs.reconstructors import base


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


def same(library, found, expected, atol=1e-10):
    """Values, precision, and the library and device that they come in."""
    values, like = library.to_numpy(found), library.array(np.zeros(1))
    assert type(found) is type(like)
    assert found.device == like.device
    assert values.dtype == np.asarray(expected).dtype
    np.testing.assert_allclose(values, expected, atol=atol, rtol=0)


@pytest.fixture
def wide(pupil):
    return ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1.3)


@pytest.mark.parametrize("name", ["propagate", "reference_wave"])
def test_fields(library, pupil, wide, screens, name):
    field = np.exp(1j * screens(0.5, 2))
    method = getattr(wide, name)
    same(library, method(library.array(field)), method(field))
    same(
        library, method(library.array(field[0].astype(np.complex64))), method(field[0].astype(np.complex64)), 1e-5
    )


def test_adjoint(library, wide):
    rng = np.random.default_rng(1)
    shape = (2, wide.n_masks, *wide.detector_shape)
    waves = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    same(library, wide.adjoint(library.array(waves)), wide.adjoint(waves))


def test_measure(library, pupil, wide, screens):
    phase = screens(0.5, 6).reshape(2, 3, *pupil.shape)
    phase[:, :, ~pupil.inside] = np.nan
    amplitude = np.linspace(0.5, 1.5, 3)[:, np.newaxis, np.newaxis] * pupil.amplitude
    same(library, wide.measure(library.array(phase)), wide.measure(phase))
    same(library, wide.measure(library.array(phase), library.array(amplitude)), wide.measure(phase, amplitude))
    same(library, wide.diameter_derivative(library.array(phase)), wide.diameter_derivative(phase))
    # What is the same for all calls may stay an array of NumPy.
    same(library, wide.measure(library.array(phase), amplitude), wide.measure(phase, amplitude))


PAIR = Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2)
METHODS = {
    "plain": lambda pupil: PhaseShifted(ZernikeSensor(pupil, *PAIR)),
    "accelerated": lambda pupil: PhaseShifted(ZernikeSensor(pupil, *PAIR), accelerate=True),
    "real time": lambda pupil: PhaseShifted(
        ZernikeSensor(pupil, *PAIR), n_iterations=2, tolerance=0, accelerate=True
    ),
    "three masks": lambda pupil: PhaseShifted(
        ZernikeSensor(pupil, *PAIR, Dimple(1.06, 2.5), extent=1.2), n_iterations=8
    ),
    "two sizes": lambda pupil: PhaseShifted(
        ZernikeSensor(pupil, PAIR[0], Dimple(1.5, -1.5)), n_iterations=8, accelerate=True
    ),
    "own amplitude": lambda pupil: PhaseShifted(
        ZernikeSensor(pupil, *PAIR), amplitude=pupil.amplitude * np.linspace(0.5, 1, pupil.shape[1])
    ),
    "arcsine": lambda pupil: Arcsine(ZernikeSensor(pupil, PAIR[0]), n_iterations=8),
    "arcsine, dark points": lambda pupil: Arcsine(
        ZernikeSensor(pupil, PAIR[0]), amplitude=pupil.amplitude * (np.arange(pupil.shape[1]) > 12)
    ),
    "Gerchberg-Saxton": lambda pupil: GerchbergSaxton(ZernikeSensor(pupil, *PAIR, extent=1.5), n_iterations=4),
    "Gerchberg-Saxton, model kept": lambda pupil: GerchbergSaxton(
        ZernikeSensor(pupil, *PAIR), n_iterations=4, unmeasured="model"
    ),
}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("batch", [(), (4,), (2, 2)])
def test_reconstructors(library, pupil, screens, name, batch):
    method = METHODS[name](pupil)
    # Some converge early and leave the others.
    phase = (screens(0.4, 4) * np.array([0.01, 1, 0.1, 0.7])[:, np.newaxis, np.newaxis])[
        : np.prod(batch, dtype=int)
    ]
    frames = method.sensor.measure(phase.reshape(*batch, *pupil.shape), method.settings.amplitude)
    expected, found = method(frames), method(library.array(frames))
    for attribute in ("phase", "residual", "n_iterations", "converged", "n_unsolved", "frames"):
        same(library, getattr(found, attribute), getattr(expected, attribute), 1e-9)


def test_history_and_start(library, pupil, screens):
    method = METHODS["accelerated"](pupil)
    phase = screens(0.4, 3)
    frames = method.sensor.measure(phase)
    expected, found = method(frames, history=True), method(library.array(frames), history=True)
    same(library, found.history, expected.history, 1e-9)
    same(library, method(library.array(frames), library.array(phase)).phase, method(frames, phase).phase, 1e-9)


def test_frames_that_do_not_converge(library, pupil, screens):
    sensor = ZernikeSensor(pupil, Dimple(2.0, np.pi / 2), Dimple(2.0, -np.pi / 2))
    method = PhaseShifted(sensor, n_iterations=8, accelerate=True)
    frames = sensor.measure(screens(1.2, 4)) * np.array([1.2, 1.0])[:, np.newaxis, np.newaxis]
    expected = method(frames)
    assert not expected.converged.any()
    same(library, method(library.array(frames)).phase, expected.phase, 1e-8)


def test_single_precision(library, pupil, screens):
    method, phase = METHODS["real time"](pupil), screens(0.4, 2)
    frames = method.sensor.measure(phase).astype(np.float32)
    found = method(library.array(frames))
    same(library, found.phase, method(frames).phase, 1e-3)
    assert reconstruction_error(pupil, library.to_numpy(found.phase), phase).max() < 0.01


def test_pieces_are_put_together(library, pupil, screens, monkeypatch):
    method, frames = METHODS["plain"](pupil), METHODS["plain"](pupil).sensor.measure(screens(0.4, 5))
    together = method(library.array(frames))
    monkeypatch.setattr(base, "_CHUNK", 2 * frames[0].size)
    monkeypatch.setattr(base, "_CHUNK_ELSEWHERE", 2 * frames[0].size)
    found = method(library.array(frames))
    for attribute in ("phase", "n_iterations", "converged", "residual"):
        same(library, getattr(found, attribute), library.to_numpy(getattr(together, attribute)), 1e-9)


def test_bad_input_is_named(library, pupil):
    method = METHODS["plain"](pupil)
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


def test_constants_are_not_shared_with_other_libraries(library):
    array = np.zeros(3)
    array.setflags(write=False)
    copy = Kind.of(library.array(np.zeros(1))).array(array)
    copy += 1.0
    np.testing.assert_array_equal(array, 0)
    np.testing.assert_array_equal(library.to_numpy(copy), 1)


def test_subclasses_become_plain_arrays(pupil, screens):
    method = METHODS["plain"](pupil)
    frames = method.sensor.measure(screens(0.4, 1)[0])
    found = method(np.ma.array(frames))
    assert type(found.phase) is np.ndarray
    np.testing.assert_array_equal(found.phase, method(frames).phase)


@pytest.mark.parametrize("method", ["measure", "propagate"])
def test_what_would_be_lost_is_refused(pupil, classic, method):
    name = {"measure": "phase", "propagate": "field"}[method]
    phase = np.zeros(pupil.shape)
    masked = np.ma.array(phase, mask=False)
    masked[20, 18:21] = np.ma.masked
    with pytest.raises(
        ValueError, match=f"{name} is a masked array, 3 values of which are masked: expected plain"
    ):
        getattr(classic, method)(masked)
    with pytest.raises(TypeError, match=f"{name} carries the unit deg: expected plain numbers"):
        getattr(classic, method)(phase * units.deg)


def test_others_take_arrays_of_numpy(pupil, modes, screens):
    """Methods that are written for NumPy only answer in NumPy."""
    method = Linear(ZernikeSensor(pupil, PAIR[0]), modes)
    frames = method.sensor.measure(screens(0.1, 2))
    found = method(array_api_strict.asarray(frames))
    assert isinstance(found.phase, np.ndarray)
    np.testing.assert_array_equal(found.phase, method(frames).phase)
