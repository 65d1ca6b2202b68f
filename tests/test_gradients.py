"""Gradients through the sensors, in JAX and in PyTorch, and reconstructors, which have none."""

import warnings

import numpy as np
import pytest

import zwfs
from zwfs import RECONSTRUCTORS, Dimple, PolychromaticSensor, ZernikeSensor

from .conftest import needs_modes

PAIR = Dimple(1.06, np.pi / 2), Dimple(1.5, -np.pi / 2)
SENSORS = {
    "wide detector": lambda pupil: ZernikeSensor(pupil, *PAIR, extent=1.3),
    "three wavelengths": lambda pupil: PolychromaticSensor(ZernikeSensor(pupil, *PAIR), [600.0, 650.0, 720.0]),
}


JAX_OPTIONS = "jax_enable_x64", "jax_disable_most_optimizations"  # the second one halves the time of the tests


@pytest.fixture(params=SENSORS)
def sensor(request, rough_pupil):
    return SENSORS[request.param](rough_pupil)


@pytest.fixture
def problem(sensor):
    """Phases with NaN outside the pupil, weights of their frames, and the gradient of the weighted sum."""
    rng = np.random.default_rng(3)
    phase = np.where(sensor.pupil.inside, rng.normal(size=(3, *sensor.pupil.shape)), np.nan)
    weights = rng.normal(size=(3, sensor.n_masks, *sensor.detector_shape))
    return phase, weights, sensor.jacobian_adjoint(phase, weights)


@pytest.fixture
def jax():
    """JAX in double precision, without a warning."""
    library = pytest.importorskip("jax", reason="JAX is not installed")
    before = {name: library.config.read(name) for name in JAX_OPTIONS}
    for name in JAX_OPTIONS:
        library.config.update(name, True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield library
    for name, value in before.items():
        library.config.update(name, value)


def agrees(result, expected, atol=1e-12):
    np.testing.assert_allclose(np.asarray(result), expected, rtol=0, atol=atol)


def test_frames_and_gradients_in_jax(jax, sensor, problem):
    phase, weights, gradient = problem
    measure, frames = sensor.measure, sensor.measure(phase)
    change = np.where(sensor.pupil.inside, phase[::-1], 0)

    def loss(phase, weights):
        return (measure(phase) * weights).sum()

    @jax.jit
    def compositions(phase, weights):  # compiled together, which takes less time than one by one
        return (
            (frames, measure(phase)),
            (frames, jax.vmap(jax.jit(measure))(phase)),
            ((frames * weights).sum(), loss(phase, weights)),
            (gradient, jax.grad(loss)(phase, weights)),
            (gradient, jax.vmap(jax.grad(loss))(phase, weights)),
            (gradient, jax.grad(lambda phase: jax.vmap(loss)(phase, weights).sum())(phase)),
            (sensor.jacobian(problem[0], change), jax.jvp(measure, (phase,), (change,))[1]),
        )

    for expected, result in compositions(phase, weights):
        agrees(result, expected, 1e-11)
    agrees(jax.grad(loss)(phase[0], weights[0]), gradient[0])


def test_second_derivatives_in_jax(jax, sensor, problem):
    phase, weights, _ = problem
    measure, step = sensor.measure, 1e-4
    phase, change = (np.where(sensor.pupil.inside, values, 0) for values in phase[:2])
    gradient = jax.grad(lambda phase: (measure(phase) * weights[0]).sum())
    _, curvature = jax.jvp(gradient, (phase,), (change,))
    ahead, behind = (sensor.jacobian_adjoint(phase + s * change, weights[0]) for s in (step, -step))
    agrees(curvature, (ahead - behind) / (2 * step), 1e-5)


def test_amplitudes_in_jax(jax, sensor, problem):
    phase, weights, _ = problem
    measure, step = sensor.measure, 1e-5
    amplitude = sensor.pupil.amplitude * np.linspace(0.5, 1.5, 3)[:, np.newaxis, np.newaxis]
    agrees(jax.jit(measure)(phase, amplitude), sensor.measure(phase, amplitude))
    agrees(jax.jit(measure)(phase, amplitude + ~sensor.pupil.inside), sensor.measure(phase, amplitude))
    agrees(measure(phase[0], jax.numpy.asarray(amplitude)), sensor.measure(phase[0], amplitude))
    gradient = jax.jit(jax.grad(lambda amplitude: (measure(phase, amplitude) * weights).sum()))(amplitude)
    ahead, behind = ((sensor.measure(phase, (1 + s) * amplitude) * weights).sum() for s in (step, -step))
    assert (np.asarray(gradient) * amplitude).sum() == pytest.approx((ahead - behind) / (2 * step), rel=1e-6)


def test_a_sensor_keeps_nothing_of_a_trace(jax, sensor, problem):
    phase, _, _ = problem
    with jax.checking_leaks():
        inside = jax.jit(sensor.measure)(phase)  # the first call: the sensor makes its model for JAX
    agrees(sensor.measure(jax.numpy.asarray(phase)), inside)


def test_single_precision_in_jax(jax, sensor, problem):
    phase = problem[0].astype(np.float32)
    frames = jax.jit(sensor.measure)(phase)
    assert frames.dtype == np.float32
    agrees(frames, sensor.measure(phase.astype(float)), 1e-5)
    jax.config.update("jax_enable_x64", False)
    with pytest.warns(UserWarning, match="jax_enable_x64 is off, so JAX computes frames in float32") as warned:
        assert sensor.measure(jax.numpy.asarray(phase)).dtype == np.float32
    assert warned[0].filename == __file__


def test_bad_input_in_jax_is_named(jax, shifted, pupil):
    measure, xp = shifted.measure, jax.numpy
    for function in (measure, jax.jit(measure)):
        for shape, message in (((40, 39), r"expected \(\.\.\., 40, 40\)"), ((0, 40, 40), "at least one map")):
            with pytest.raises(ValueError, match=message):
                function(xp.zeros(shape))
        for dtype in (bool, complex):
            with pytest.raises(TypeError, match=rf"phase has dtype {dtype.__name__}\w*: expected real numbers"):
                function(xp.zeros(pupil.shape, dtype))
        with pytest.raises(ValueError, match=r"phase and amplitude have shapes .*: expected ones that broadcast"):
            function(xp.zeros((2, 40, 40)), xp.ones((3, 40, 40)))
    for phase, message in ((np.nan, r"phase holds \d+ NaN or infinite values inside"), (1e200, "phase reaches")):
        with pytest.raises(ValueError, match=message):
            measure(xp.full(pupil.shape, phase))
    with pytest.raises(ValueError, match="amplitude reaches down to -1"):
        measure(xp.zeros(pupil.shape), -xp.ones(pupil.shape))
    with pytest.warns(UserWarning, match="is it in degrees"):
        measure(xp.asarray(100 * pupil.x + 0 * pupil.inside))


def test_other_methods_of_a_sensor_name_the_way_for_jax(jax, shifted, pupil):
    phase = jax.numpy.zeros(pupil.shape)
    with pytest.raises(TypeError, match=r"phase is an array of JAX: .*; only `measure` of a sensor takes"):
        shifted.jacobian(phase, phase)


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="PyTorch is not installed")


def test_gradients_in_torch(torch, sensor, problem):
    phase, weights, gradient = problem
    variable, weights = torch.tensor(phase, requires_grad=True), torch.tensor(weights)
    amplitude = torch.tensor(np.array(sensor.pupil.amplitude), requires_grad=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (sensor.measure(variable, amplitude) * weights).sum().backward()
        (batch,) = torch.autograd.grad((sensor.measure(variable) * weights).sum(), variable)
        transformed = torch.vmap(
            torch.func.grad(lambda *arguments: (sensor.measure(arguments[0]) * arguments[1]).sum())
        )
        together = transformed(torch.tensor(phase), weights)
        sensor.jacobian_adjoint(variable, weights.requires_grad_()).sum().backward()
    for result in (batch, together):
        agrees(result, gradient)
    agrees(torch.autograd.grad((sensor.measure(variable) * weights).sum(), variable)[0], gradient)
    light = (sensor.measure(phase) * weights.detach().numpy()).sum()
    assert float((amplitude.grad * amplitude.detach()).sum()) == pytest.approx(
        2 * light, rel=1e-10
    )  # frames are quadratic


class Variable(np.ndarray):
    """An array that asks for a gradient, as a tensor of PyTorch does."""

    requires_grad = True


@pytest.mark.parametrize("method", RECONSTRUCTORS)
def test_reconstructors_refuse_gradients(method, pupil, modes):
    sensor = ZernikeSensor(pupil, *PAIR[: min(2, method.n_masks[1])])
    reconstruct = method(sensor, modes) if needs_modes(method) else method(sensor)
    frames, phase = sensor.measure(np.zeros(pupil.shape)), np.zeros(pupil.shape)
    with pytest.raises(TypeError, match=r"frames requires a gradient: expected frames\.detach\(\)"):
        reconstruct(frames.view(Variable))
    with pytest.raises(TypeError, match=r"start requires a gradient: expected start\.detach\(\)"):
        reconstruct(frames, phase.view(Variable))


def test_reconstructors_refuse_arrays_of_jax(jax, shifted, pupil):
    frames, reconstruct = jax.numpy.ones((2, *pupil.shape)), zwfs.PhaseShifted(shifted)
    for call in (reconstruct, jax.jit(reconstruct), jax.grad(lambda frames: reconstruct(frames).phase.sum())):
        with pytest.raises(TypeError, match=r"frames is an array of JAX: expected np\.asarray\(frames\), outside"):
            call(frames)
    with pytest.raises(TypeError, match=r"start is an array of JAX: expected np\.asarray\(start\)"):
        reconstruct(np.asarray(frames), frames[0])
