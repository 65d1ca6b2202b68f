"""The sensors in JAX: frames that can be differentiated, compiled and vectorised.

Arrays of PyTorch need no such module: `loss.backward()` passes through `Sensor.measure`. JAX is imported by the
first call of `measure`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._propagator import amplitude_maps, propagator, pupil_maps, square, warn_of_degrees
from zwfs.polychromatic import PolychromaticSensor
from zwfs.sensor import ZernikeSensor


def measure(sensor: ZernikeSensor | PolychromaticSensor) -> Callable[..., Any]:
    """Return the frames of a sensor as a function of arrays of JAX, for `jax.jit`, `jax.grad` and `jax.vmap`.

    The function has the parameters and the result of `Sensor.measure`. It consists of products with the factors of
    the sensor, so JAX differentiates it in forward and in reverse mode, to any order. Gradients are 0 outside the
    pupil. Shapes are always checked; values are checked except where JAX traces them.

    Frames are float64 if the phase is. JAX makes every array float32, with an error of the frames of about 1e-6,
    until ``jax.config.update("jax_enable_x64", True)``.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor

    Returns
    -------
    callable
        ``frames = function(phase, amplitude=None)``, shapes (..., ny, nx) to
        (..., n_masks, ny_detector, nx_detector).

    Raises
    ------
    ModuleNotFoundError
        If JAX is not installed.

    Warns
    -----
    UserWarning
        If JAX makes every array float32.

    Examples
    --------
    >>> import jax, numpy as np, zwfs, zwfs.jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> sensor = zwfs.ZernikeSensor(zwfs.Pupil.circular(32), zwfs.Dimple(1.06, np.pi / 2))
    >>> measure = zwfs.jax.measure(sensor)
    >>> mean_square = jax.jit(jax.grad(lambda phase: (measure(phase) ** 2).mean()))
    >>> mean_square(np.zeros(sensor.pupil.shape)).shape
    (32, 32)
    """
    _check.instance("sensor", sensor, ZernikeSensor, PolychromaticSensor)
    try:
        import jax
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "zwfs.jax.measure needs JAX: expected it installed, as by pip install jax"
        ) from error
    if not jax.config.read("jax_enable_x64"):
        warnings.warn(
            "jax_enable_x64 is off, so JAX computes frames in float32, with an error of about 1e-6: expected "
            'jax.config.update("jax_enable_x64", True) for float64',
            UserWarning,
            stacklevel=2,
        )
    xp, shape = jax.numpy, sensor.pupil.shape

    def array(name: str, value: Any) -> Any:
        """Real array of JAX of at least one map."""
        if not isinstance(value, jax.Array):
            value = _check.real_array(name, value)
        if not xp.isdtype(value.dtype, ("real floating", "integral")):
            raise TypeError(f"{name} has dtype {value.dtype}: expected real numbers")
        _check.maps(name, value, shape)
        double = jax.dtypes.canonicalize_dtype(np.float64)
        return xp.asarray(value, dtype=value.dtype if value.dtype == np.float32 else double)

    def frames(phase: Any, amplitude: Any = None) -> Any:
        maps = array("phase", phase)
        if not isinstance(maps, jax.core.Tracer):
            warn_of_degrees(pupil_maps("phase", np.asarray(maps), sensor)[0], sensor.pupil, stacklevel=3)
        with jax.ensure_compile_time_eval():  # the sensor keeps the model, which must not belong to a trace
            model = propagator(sensor, Kind(xp, np.dtype(maps.dtype), None))
        strength: Any = model.amplitude
        if amplitude is not None:
            strength = array("amplitude", amplitude).astype(maps.dtype)
            if not isinstance(strength, jax.core.Tracer):
                amplitude_maps(np.asarray(strength), sensor, Kind.numpy(maps.dtype))
            _check.broadcast(phase=maps, amplitude=strength)
            strength = xp.where(model.inside, strength, 0)
        maps, strength = xp.broadcast_arrays(xp.where(model.inside, maps, 0), strength)
        flat: Any = [xp.reshape(values, (-1, *shape)) for values in (maps, strength)]
        result = square(model.propagate(model.incoming(*flat)))
        return xp.reshape(result, (*maps.shape[:-2], *result.shape[1:]))

    return frames
