"""Frames of a sensor for arrays of JAX, which cannot be changed in place and have no values while JAX traces them.

JAX is imported where it is used: who has no array of JAX needs no JAX.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._propagator import SensorParts, amplitude_maps, propagator, pupil_maps, square, warn_of_degrees


def measure(sensor: SensorParts, phase: Any, amplitude: Any = None) -> Any:
    """Return the frames, as products with the factors of the sensor, which JAX differentiates to any order.

    Parameters and result are those of `Sensor.measure`. Gradients are 0 outside the pupil. Shapes are always
    checked; values are checked except where JAX traces them.
    """
    import jax

    if not jax.config.read("jax_enable_x64"):
        warnings.warn(
            "jax_enable_x64 is off, so JAX computes frames in float32, with an error of about 1e-6: expected "
            'jax.config.update("jax_enable_x64", True) for float64',
            UserWarning,
            stacklevel=3,
        )
    xp, shape = jax.numpy, sensor.pupil.shape
    maps = _array("phase", phase, shape)
    if not isinstance(maps, jax.core.Tracer):
        warn_of_degrees(pupil_maps("phase", np.asarray(maps), sensor)[0], sensor.pupil, stacklevel=4)
    with jax.ensure_compile_time_eval():  # the sensor keeps the model, which must not belong to a trace
        model = propagator(sensor, Kind(xp, np.dtype(maps.dtype), None))
    strength: Any = model.amplitude
    if amplitude is not None:
        strength = _array("amplitude", amplitude, shape).astype(maps.dtype)
        if not isinstance(strength, jax.core.Tracer):
            amplitude_maps(np.asarray(strength), sensor, Kind.numpy(maps.dtype))
        _check.broadcast(phase=maps, amplitude=strength)
        strength = xp.where(model.inside, strength, 0)
    maps, strength = xp.broadcast_arrays(xp.where(model.inside, maps, 0), strength)
    flat: Any = [xp.reshape(values, (-1, *shape)) for values in (maps, strength)]
    frames = square(model.propagate(model.incoming(*flat)))
    return xp.reshape(frames, (*maps.shape[:-2], *frames.shape[1:]))


def _array(name: str, value: Any, shape: tuple[int, int]) -> Any:
    """Real array of JAX of at least one map."""
    import jax

    xp = jax.numpy
    if not isinstance(value, jax.Array):
        value = _check.real_array(name, value)
    if not xp.isdtype(value.dtype, ("real floating", "integral")):
        raise TypeError(f"{name} has dtype {value.dtype}: expected real numbers")
    _check.maps(name, value, shape)
    double = jax.dtypes.canonicalize_dtype(np.float64)
    return xp.asarray(value, dtype=value.dtype if value.dtype == np.float32 else double)
