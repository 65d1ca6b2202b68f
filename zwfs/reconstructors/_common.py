"""What all reconstructors share: their result, their checks, and the loop of the iterative ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.sensor import ZernikeSensor, split, square

_CHUNK = 80_000  # detector pixels handled together: few enough for the fast memory, enough to vectorise


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a reconstructor found; `...` is the batch of the frames.

    Attributes
    ----------
    phase : ndarray, shape (..., ny, nx), radian
        NaN outside the pupil. Wrapped to (-pi, pi], except by `Linear` and `GradientDescent`.
    n_iterations : ndarray of int, shape (...)
        Iterations used.
    converged : ndarray of bool, shape (...)
        Whether the last iteration changed the phase by no more than the tolerance.
    n_unsolved : ndarray of int, shape (...)
        Points whose equation had no (unique) solution in the last iteration: singular ones, which kept the value
        of the iteration before, or cosines beyond +-1.
    history : ndarray, shape (..., n_iterations + 1, ny, nx), radian, or None
        Phase at the start and after each iteration, if asked for; repeated once converged.
    settings : Settings
        Of the reconstructor.
    frames : ndarray, shape (..., n_masks, ny, nx)
        Copy of what was reconstructed, on the grid of the pupil.
    """

    phase: NDArray[np.floating]
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]
    history: NDArray[np.floating] | None
    settings: Settings = field(repr=False)
    frames: NDArray[np.floating] = field(repr=False)

    @cached_property
    def residual(self) -> NDArray[np.floating]:
        """Mismatch of the frames, shape (...), computed when it is first asked for.

        Rms difference, over all masks and the points of the pupil, between the measured frames and those modelled
        from the phase; the unit is the mean intensity of the pupil.
        """
        sensor = self.settings.sensor
        amplitude, inside, _ = self.settings.maps(self.phase.dtype)
        frames = self.frames.reshape(-1, *self.frames.shape[-3:])
        phase = np.where(sensor.pupil.mask, self.phase, 0).reshape(-1, *sensor.pupil.shape)
        residual = np.empty(len(frames), frames.dtype)
        for piece in pieces(frames):
            psi = split(phase[piece], amplitude)
            waves = sensor.operator(psi.dtype).split_reference(psi, in_window=True) + psi[:, np.newaxis]
            mismatch = ((square(waves) - frames[piece]) * inside).reshape(len(psi), -1)
            residual[piece] = np.vecdot(mismatch, mismatch)
        return np.sqrt(residual / (sensor.n_masks * sensor.pupil.n_points)).reshape(self.phase.shape[:-2])[()]


class Maps(NamedTuple):
    """Maps on the pupil in one precision, shape (ny, nx)."""

    amplitude: NDArray[np.floating]
    inside: NDArray[np.floating]  # 1 inside, 0 outside
    outside: NDArray[np.floating]  # 0 inside, NaN outside

    def field(self, phasor: NDArray) -> NDArray:
        """Split field of a phasor that is 0 outside."""
        return phasor if self.amplitude is self.inside else phasor * self.amplitude


@dataclass(frozen=True, eq=False)
class Settings:
    """Checked arguments that every reconstructor takes; see `settings`."""

    sensor: ZernikeSensor
    n_iterations: int
    tolerance: float
    amplitude: NDArray[np.float64]
    _maps: dict[np.dtype, Maps] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_maps": {}}  # cheap to make again, and no part of what was asked for

    def maps(self, dtype: np.dtype) -> Maps:
        """Maps in float32 or float64; made once, then kept."""
        if dtype not in self._maps:
            mask = self.sensor.pupil.mask
            inside = mask.astype(dtype)
            amplitude = inside if np.array_equal(self.amplitude, mask) else self.amplitude.astype(dtype)
            self._maps[dtype] = Maps(amplitude, inside, np.where(mask, 0, np.nan).astype(dtype))
        return self._maps[dtype]


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
    """An iterative reconstructor: each step makes a better phasor out of the one before.

    A phasor is exp(i phase), split, shape (k, 2, ny, nx), and 0 outside the pupil.
    """

    settings: Settings

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool) -> dict[str, NDArray]:
        """What the steps need and keep: arrays with the frames (k, n_masks, ny', nx') on the first axis.

        `flat` says that the starting phasor is flat.
        """

    def step(self, phasor: NDArray, data: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Next phasor, and the number of unsolved points (k,)."""


def iterate(method: FixedPoint, frames: ArrayLike, start: ArrayLike | None, history: bool) -> Reconstruction:
    """Run the steps of `method` on every frame until it converges or the iterations are used up."""
    config = method.settings
    frames, batch = check_frames(config.sensor, frames)
    n_frames, shape = len(frames), config.sensor.pupil.shape
    first = None if start is None else start_phase(config.sensor, start, batch, frames.dtype)
    phase = np.empty((n_frames, *shape), frames.dtype)
    n_used = np.zeros(n_frames, int)
    converged = np.zeros(n_frames, bool)
    n_unsolved = np.zeros(n_frames, int)
    record = np.empty((n_frames, config.n_iterations + 1, *shape), frames.dtype) if history else None
    for piece in pieces(frames):
        _iterate_piece(
            method, frames[piece], None if first is None else first[piece], phase[piece], n_used[piece],
            converged[piece], n_unsolved[piece], None if record is None else record[piece],
        )  # fmt: skip
    return report(config, frames, batch, phase, n_used, converged, n_unsolved, record)


def _iterate_piece(
    method: FixedPoint,
    frames: NDArray,
    start: NDArray | None,
    phase: NDArray,
    n_used: NDArray,
    converged: NDArray,
    n_unsolved: NDArray,
    record: NDArray | None,
) -> None:
    """Iterate a few frames; the last five arguments are written to."""
    config = method.settings
    inside = config.maps(frames.dtype).inside
    if start is None:
        phasor = np.zeros((len(frames), 2, *inside.shape), inside.dtype)
        phasor[:, 0] = inside
    else:
        phasor = split(start, inside)
    if record is not None:
        record[:, 0] = 0 if start is None else start
    data = method.prepare(frames, phasor, start is None)
    limit = config.tolerance**2 * config.sensor.pupil.n_points
    active = np.arange(len(frames))

    def write(which: NDArray | slice) -> None:
        where = active[which]
        phase[where] = angle(phasor[which])
        n_used[where], converged[where], n_unsolved[where] = iteration, done[which], unsolved[which]

    for iteration in range(1, config.n_iterations + 1):
        new, unsolved = method.step(phasor, data)
        last = iteration == config.n_iterations
        done = _small(new - phasor, limit) if limit or last else np.zeros(len(new), bool)
        phasor = new
        if record is not None:
            record[active, iteration:] = angle(phasor)[:, np.newaxis]
        if last or (limit and done.all()):
            break
        if limit and done.any():
            # Frames that are done leave the loop, so a frame's result does not depend on its neighbours.
            write(done)
            active, phasor = active[~done], phasor[~done]
            data = {name: values[~done] for name, values in data.items()}
    write(slice(None))


def _small(change: NDArray, limit: float) -> NDArray[np.bool_]:
    """Whether the squared norm of a change of the phasors, nearly that of the phases, is within the limit."""
    change = change.reshape(len(change), -1)
    return np.vecdot(change, change) <= limit


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
    """Result in the shape of the batch; `phase` and `record` are written to."""
    outside = config.maps(phase.dtype).outside
    phase += outside
    if record is not None:
        record += outside
    # A copy, since the residual is computed later: a camera may write the next frame to the same place.
    window = np.array(frames[(..., *config.sensor.window)])

    def shaped(values: NDArray) -> NDArray:
        return values.reshape((*batch, *values.shape[1:]))

    return Reconstruction(
        shaped(phase), shaped(n_used), shaped(converged), shaped(n_unsolved),
        None if record is None else shaped(record), config, shaped(window),
    )  # fmt: skip


def pieces(frames: NDArray) -> Iterator[slice]:
    """Slices of frames (n, ...) that are handled together."""
    size = max(1, _CHUNK // frames[0].size)
    return (slice(first, first + size) for first in range(0, len(frames), size))


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
    light = flat.sum(axis=(-2, -1))
    # A sum is finite only if all its terms are, and costs a tenth of the full test.
    if not np.isfinite(light).all():
        _check.finite(name, flat)
    _check.non_negative(name, flat, "; after subtracting a background, raise them to 0 explicitly")
    if not light.all():
        raise ValueError(
            f"{name}: {np.count_nonzero(light == 0)} of {light.size} hold no light: expected some flux in each"
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


def count(points: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of points that are true in each map: (k, ny, nx) to (k,)."""
    # Along an axis NumPy turns all of them into integers first.
    return np.array([np.count_nonzero(one) for one in points])


def unit(field: NDArray, fallback: NDArray, modulus: NDArray) -> NDArray:
    """Split field with another modulus, (..., ny, nx); `fallback` where the field vanishes. `field` is reused."""
    power = square(field)
    if power.min() > 0:
        field *= (modulus / np.sqrt(power))[..., np.newaxis, :, :]
        return field
    dark = power == 0
    scale = modulus / np.sqrt(np.where(dark, 1, power))
    return np.where(dark[..., np.newaxis, :, :], fallback, field * scale[..., np.newaxis, :, :])
