"""What all reconstructors share: their result, their checks, and the loop of the iterative ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.sensor import ZernikeSensor, split

_CHUNK = 80_000  # detector pixels handled together: few enough for the fast memory, enough to vectorise


@dataclass(frozen=True)
class Reconstruction:
    """What a reconstructor found; `...` is the batch of the frames.

    Attributes
    ----------
    phase : ndarray, shape (..., ny, nx), radian
        NaN outside the pupil. Wrapped to (-pi, pi], except by `Linear` and `GradientDescent`.
    residual : ndarray, shape (...)
        Rms difference, over all masks and the points of the pupil, between measured frames and those modelled
        from the phase; the unit is the mean intensity of the pupil.
    n_iterations : ndarray of int, shape (...)
        Iterations used.
    converged : ndarray of bool, shape (...)
        Whether the last iteration changed the phase by no more than the tolerance.
    n_unsolved : ndarray of int, shape (...)
        Points whose equation had no (unique) solution in the last iteration: singular ones, which kept the value
        of the iteration before, or cosines beyond +-1.
    history : ndarray, shape (..., n_iterations + 1, ny, nx), radian, or None
        Phase at the start and after each iteration, if asked for; repeated once converged.
    """

    phase: NDArray[np.floating]
    residual: NDArray[np.floating]
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]
    history: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class Settings:
    """Checked arguments that every reconstructor takes; see `settings`."""

    sensor: ZernikeSensor
    n_iterations: int
    tolerance: float
    amplitude: NDArray[np.float64]


def settings(sensor: Any, n_iterations: Any, tolerance: Any, amplitude: ArrayLike | None) -> Settings:
    """Check the common arguments.

    Parameters
    ----------
    sensor : ZernikeSensor
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if None.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    if not isinstance(sensor, ZernikeSensor):
        raise TypeError(f"sensor is a {type(sensor).__name__}: expected a ZernikeSensor")
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    tolerance = _check.number("tolerance", tolerance, 0)
    maps, batch = sensor.amplitude_maps(amplitude, np.float64)
    if batch:
        raise ValueError(f"amplitude has shape {np.shape(amplitude)}: expected {sensor.pupil.shape}")
    return Settings(sensor, n_iterations, tolerance, maps[0])


class FixedPoint(Protocol):
    """An iterative reconstructor: each step makes a better phasor out of the one before."""

    settings: Settings

    def prepare(self, frames: NDArray, amplitude: NDArray, start: NDArray) -> dict[str, NDArray]:
        """What the steps need, computed once: arrays with the frames (k, n_masks, ny', nx') on the first axis."""

    def step(self, phasor: NDArray, amplitude: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Next unit phasor exp(i phase), split, (k, 2, ny, nx), and the number of unsolved points (k,)."""


def iterate(method: FixedPoint, frames: ArrayLike, start: ArrayLike | None, history: bool) -> Reconstruction:
    """Run the steps of `method` on every frame until it converges or the iterations are used up."""
    config = method.settings
    frames, batch = check_frames(config.sensor, frames)
    phase = start_phase(config.sensor, start, batch, frames.dtype)
    n_frames, shape = len(frames), config.sensor.pupil.shape
    n_used = np.zeros(n_frames, int)
    converged = np.zeros(n_frames, bool)
    n_unsolved = np.zeros(n_frames, int)
    record = np.empty((n_frames, config.n_iterations + 1, *shape), frames.dtype) if history else None
    amplitude = config.amplitude.astype(frames.dtype)
    size = max(1, _CHUNK // frames[0].size)
    for first in range(0, n_frames, size):
        piece = slice(first, first + size)
        _iterate_piece(
            method, frames[piece], amplitude, phase[piece], n_used[piece], converged[piece], n_unsolved[piece],
            None if record is None else record[piece],
        )  # fmt: skip
    return report(config, frames, batch, phase, n_used, converged, n_unsolved, record)


def _iterate_piece(
    method: FixedPoint,
    frames: NDArray,
    amplitude: NDArray,
    phase: NDArray,
    n_used: NDArray,
    converged: NDArray,
    n_unsolved: NDArray,
    record: NDArray | None,
) -> None:
    """Iterate a few frames; the last five arguments and `phase` are written to."""
    config = method.settings
    inside = config.sensor.pupil.mask.astype(frames.dtype)
    data = method.prepare(frames, amplitude, phase)
    phasor = split(phase, inside)
    # Frames that are done leave the loop, so a frame's result does not depend on its neighbours.
    active = np.arange(len(frames))
    if record is not None:
        record[:, 0] = phase
    for iteration in range(1, config.n_iterations + 1):
        new, unsolved = method.step(phasor, amplitude, data)
        n_unsolved[active], n_used[active] = unsolved, iteration
        done = _rms_change(new, phasor, inside) <= config.tolerance
        phasor = new
        if record is not None:
            record[active, iteration:] = angle(phasor)[:, np.newaxis]
        if done.any():
            phase[active[done]], converged[active[done]] = angle(phasor[done]), True
            active, phasor = active[~done], phasor[~done]
            data = {name: values[~done] for name, values in data.items()}
            if not active.size:
                return
    phase[active] = angle(phasor)


def report(
    config: Settings,
    frames: NDArray,
    batch: tuple[int, ...],
    phase: NDArray,
    n_used: NDArray,
    converged: NDArray,
    n_unsolved: NDArray,
    record: NDArray | None,
) -> Reconstruction:
    """Result in the shape of the batch, with the mismatch of the frames modelled from the phase."""
    sensor = config.sensor
    pupil = sensor.pupil
    residual = np.empty(len(frames), frames.dtype)
    amplitude = config.amplitude.astype(frames.dtype)[np.newaxis]
    size = max(1, _CHUNK // frames[0].size)
    for first in range(0, len(frames), size):
        piece = slice(first, first + size)
        mismatch = sensor.intensity(phase[piece], amplitude) - frames[piece]
        mismatch = mismatch[(..., *sensor.window)] * pupil.mask
        residual[piece] = np.sqrt(
            np.mean(mismatch**2, axis=(-3, -2, -1)) * (pupil.amplitude.size / pupil.n_points)
        )

    def shaped(values: NDArray) -> NDArray:
        return values.reshape((*batch, *values.shape[1:]))

    def public(maps: NDArray) -> NDArray:
        return shaped(np.where(pupil.mask, maps, np.nan).astype(maps.dtype, copy=False))

    return Reconstruction(
        public(phase), shaped(residual), shaped(n_used), shaped(converged), shaped(n_unsolved),
        None if record is None else public(record),
    )  # fmt: skip


def check_frames(
    sensor: ZernikeSensor, frames: ArrayLike, name: str = "frames"
) -> tuple[NDArray[np.floating], tuple[int, ...]]:
    """Checked frames, (k, n_masks, ny', nx'), and the shape of the batch."""
    frames = _check.real_array(name, frames)
    shape = (sensor.n_masks, *sensor.detector_shape)
    _check.trailing_shape(name, frames, shape, "masks and detector of the sensor")
    batch, flat = frames.shape[:-3], frames.reshape(-1, *shape)
    if not len(flat):
        raise ValueError(f"{name} has shape {frames.shape}: expected at least one frame")
    _check.finite(name, flat)
    _check.non_negative(name, flat, "; after subtracting a background, raise them to 0 explicitly")
    dark = ~flat.any(axis=(-2, -1))
    if dark.any():
        raise ValueError(
            f"{name}: {np.count_nonzero(dark)} of {dark.size} hold no light: expected some flux in each"
        )
    return flat, batch


def start_phase(
    sensor: ZernikeSensor, start: ArrayLike | None, batch: tuple[int, ...], dtype: np.dtype
) -> NDArray[np.floating]:
    """Checked starting phase of every frame, (k, ny, nx), 0 outside; flat for None."""
    shape = sensor.pupil.shape
    if start is None:
        return np.zeros((int(np.prod(batch)), *shape), dtype)
    maps, start_batch = sensor.pupil_maps("start", start)
    if start_batch not in ((), batch):
        raise ValueError(f"start has shape {np.shape(start)}: expected {shape} or {(*batch, *shape)}")
    maps = maps.reshape(*start_batch, *shape).astype(dtype)
    return np.array(np.broadcast_to(maps, (*batch, *shape))).reshape(-1, *shape)


def angle(phasor: NDArray) -> NDArray:
    """Phase of a split phasor: (..., 2, ny, nx) to (..., ny, nx)."""
    return np.arctan2(phasor[..., 1, :, :], phasor[..., 0, :, :])


def unit(field: NDArray, fallback: NDArray) -> NDArray:
    """Phasor of a split field; that of `fallback` where the field vanishes."""
    modulus = np.sqrt(field[..., 0, :, :] ** 2 + field[..., 1, :, :] ** 2)[..., np.newaxis, :, :]
    if modulus.min() > 0:
        return field / modulus
    return np.where(modulus > 0, field / np.where(modulus > 0, modulus, 1), fallback)


def _rms_change(new: NDArray, old: NDArray, inside: NDArray) -> NDArray:
    """Rms over the pupil of the change of the phase, for small changes: (k,)."""
    change = ((new - old) * inside).reshape(len(new), -1)
    return np.sqrt(np.einsum("ki,ki->k", change, change) / np.count_nonzero(inside))
