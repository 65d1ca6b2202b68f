"""What all reconstructors share: their result, their checks, and the loop of the iterative ones."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from math import prod
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, read_only
from zwfs._pickle import read_only_state
from zwfs.sensor import PupilMaps, ZernikeSensor, split, square

# Detector pixels handled together: on the processor few enough for its fast memory, enough to vectorise.
_CHUNK, _CHUNK_ELSEWHERE = 80_000, 40_000_000
_VANISHING = 1e-30  # modulus, or its square, of a field that counts as 0
_BRIGHT = 10.0  # mean of a frame inside the pupil, relative to no mask: masks never exceed 1, raw counts soon do
_MOST_ITERATIONS = 2**31 - 1
_RANGE = 1e30  # of the light in the pupil, and of its inverse: its square is a number in single precision, too


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """Result of a reconstruction; `...` is the batch of the frames.

    The arrays belong to the caller: they are writable and share no memory with the frames or the reconstructor.

    Attributes
    ----------
    phase : ndarray, shape (..., ny, nx), radian
        NaN outside the pupil. Wrapped to (-pi, pi], except by `Linear` and `GradientDescent`. The frames do not
        depend on the piston, so its value has no meaning: remove it on the circle before you fit modes.
    n_iterations : ndarray of int, shape (...)
        Iterations used.
    converged : ndarray of bool, shape (...)
        Whether the last iteration changed the phase by no more than the tolerance; with a tolerance of 0,
        `Arcsine`, `PhaseShifted` and `GerchbergSaxton` do not look, and tell False. Always True for `Linear`.
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
    settings: Settings
    frames: NDArray[np.floating]

    def __repr__(self) -> str:
        xp, n_frames = Kind.of(self.phase).xp, prod(self.converged.shape)
        n_converged = int(xp.count_nonzero(self.converged))
        return f"Reconstruction(phase {tuple(self.phase.shape)}, {n_converged} of {n_frames} converged)"

    @cached_property
    def residual(self) -> NDArray[np.floating]:
        """Mismatch of the frames, shape (...), computed when it is first asked for.

        Rms difference, over all masks and the points of the pupil, between the measured frames and those modelled
        from the phase; the unit is the mean intensity of the pupil.
        """
        config, kind = self.settings, Kind.of(self.frames)
        sensor, maps, xp = config.sensor, config.maps(kind), kind.xp
        frames = xp.reshape(self.frames, (-1, *self.frames.shape[-3:]))
        phase = xp.reshape(xp.where(maps.mask, self.phase, kind.array(0.0)), (-1, *sensor.pupil.shape))
        found = []
        for piece in pieces(frames, kind):
            psi = split(phase[piece, ...], maps.amplitude)
            waves = sensor.operator(kind).split_reference(psi, in_window=True) + psi[:, np.newaxis, ...]
            mismatch = (square(waves) - frames[piece, ...]) * maps.inside
            mismatch = xp.reshape(mismatch, (psi.shape[0], -1))
            found.append(xp.vecdot(mismatch, mismatch))
        mean = xp.concat(found) / (sensor.n_masks * sensor.pupil.n_points)
        batch = self.phase.shape[:-2]
        return xp.reshape(xp.sqrt(mean), batch) if batch else xp.sqrt(mean)[0]


@dataclass(frozen=True, eq=False)
class Settings:
    """Checked arguments that every reconstructor takes; see `settings`."""

    sensor: ZernikeSensor
    n_iterations: int
    tolerance: float
    amplitude: NDArray[np.float64]
    light: float  # sum of the squared amplitude over the pupil: a frame without mask
    _maps: dict[Kind, PupilMaps] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_maps": {}}  # cheap to make again, and no part of what was asked for

    __setstate__ = read_only_state

    def maps(self, kind: Kind) -> PupilMaps:
        """Maps of the pupil, with the amplitude of the settings, for arrays of one kind; made once, then kept."""
        if kind not in self._maps:
            self._maps[kind] = PupilMaps.of(self.sensor.pupil.inside, self.amplitude, kind)
        return self._maps[kind]


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
    _check.instance("sensor", sensor, ZernikeSensor)
    n_iterations = _check.integer("n_iterations", n_iterations, 1, _MOST_ITERATIONS)
    tolerance = _check.number("tolerance", tolerance, 0)
    maps, batch = sensor.amplitude_maps(amplitude, Kind.numpy())
    if batch:
        raise ValueError(f"amplitude has shape {(*batch, *sensor.pupil.shape)}: expected {sensor.pupil.shape}")
    own = read_only(maps[0].copy())
    light = float(np.sum(own * own))
    if not 1 / _RANGE < light < _RANGE:
        raise ValueError(f"amplitude: its squares add up to {light:.3g}: expected {1 / _RANGE:g} to {_RANGE:g}")
    return Settings(sensor, n_iterations, tolerance, own, light)


def load(path: str) -> type:
    """Return the class of a reconstructor from its path.

    Parameters
    ----------
    path : str
        "module:Class", such as "zwfs.reconstructors.linear:Linear". The module may be any that can be imported: a
        file next to the notebook, or a part of an installed package.

    Raises
    ------
    TypeError, ValueError
        If the path is no such string, there is no such module or class, or objects of the class cannot be called.
    """
    if not isinstance(path, str):
        raise TypeError(f"path = {_check.shown(path)}: expected a string 'module:Class'")
    module, colon, name = path.partition(":")
    if not (colon and name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
        raise ValueError(f"path = {path!r}: expected 'module:Class', such as 'my_method:MyMethod'")
    try:
        method = getattr(import_module(module), name, None)
    except ModuleNotFoundError as error:
        raise ValueError(f"path = {path!r}: expected a module that can be imported ({error})") from error
    if not isinstance(method, type) or "__call__" not in dir(method):
        raise ValueError(f"path = {path!r}: expected the class of a reconstructor, got {_check.shown(method)}")
    return method


class Reconstructor:
    """Base of the reconstructors: the sensor that they model and the arguments that all of them take.

    Parameters
    ----------
    settings : Settings
        From `settings`, which checks them.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    @property
    def settings(self) -> Settings:
        """Checked arguments that every reconstructor takes."""
        return self._settings

    @property
    def sensor(self) -> ZernikeSensor:
        """Sensor whose frames are reconstructed."""
        return self._settings.sensor

    def __repr__(self) -> str:
        config = self._settings
        return f"{type(self).__name__}({config.sensor!r}, {config.n_iterations}, tolerance={config.tolerance:g})"


class FixedPoint(Protocol):
    """An iterative reconstructor: each step makes a better field out of the phasor before.

    A phasor is exp(i phase), split, shape (k, 2, ny, nx), and 0 outside the pupil: all that is kept of a field.
    """

    @property
    def settings(self) -> Settings:
        """Checked arguments that every reconstructor takes."""

    def prepare(self, frames: NDArray, phasor: NDArray, flat: bool, kind: Kind) -> dict[str, NDArray]:
        """What the steps need and keep: arrays with the frames (k, n_masks, ny', nx') on the first axis.

        `flat` says that the starting phasor is flat, `kind` what all arrays are.
        """

    def step(self, phasor: NDArray, data: dict[str, NDArray], kind: Kind) -> Estimate:
        """Next field."""


class Estimate(NamedTuple):
    """Field that a step found, (k, 2, ny, nx), of any modulus."""

    field: NDArray[np.floating]
    unsolved: NDArray[np.int64] | int = 0  # number of points, (k,) or the same for all
    modulus: NDArray[np.floating] | None = None  # of the field, (k, ny, nx), where the step knows it


def iterate(method: FixedPoint, frames: ArrayLike, start: ArrayLike | None, history: bool) -> Reconstruction:
    """Run the steps of `method` on every frame until it converges or the iterations are used up."""
    config = method.settings
    history = _check.flag("history", history)
    frames, batch = check_frames(config.sensor, frames, light=config.light, depth=4)
    kind = Kind.of(frames)
    first = None if start is None else start_phase(config.sensor, start, batch, kind)

    def run(piece: slice) -> Found:
        return _iterate_piece(method, frames[piece, ...], None if first is None else first[piece, ...], history)

    # Frames that leave early would leave gaps in a history, so each then is a piece of its own.
    slices = list(pieces(frames, kind, 1 if history else None))
    found = run(slices[0])
    if len(slices) > 1:
        whole = found.room_for(frames.shape[0], kind)
        whole.put(slices[0], found)
        for piece in slices[1:]:
            whole.put(piece, run(piece))
        found = whole
    return report(config, frames, batch, found)


class Found(NamedTuple):
    """What was found for k frames; the meaning is that of `Reconstruction`, 0 outside the pupil."""

    phase: NDArray[np.floating]
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]
    history: NDArray[np.floating] | None = None

    def room_for(self, n_frames: int, kind: Kind) -> Found:
        """Arrays of the same kind for more frames, yet to be filled."""
        return Found._make(
            None if array is None
            else kind.xp.empty((n_frames, *array.shape[1:]), dtype=array.dtype, device=kind.device)
            for array in self
        )  # fmt: skip

    def put(self, piece: slice, some: Found) -> None:
        """Put some of the frames in their places."""
        pairs: zip[tuple[Any, Any]] = zip(self, some, strict=True)
        for array, part in pairs:
            if array is not None:
                array[piece, ...] = part


def _iterate_piece(method: FixedPoint, frames: NDArray, start: NDArray | None, history: bool) -> Found:
    """Iterate a few frames."""
    config, kind = method.settings, Kind.of(frames)
    xp, maps, n_frames = kind.xp, config.maps(kind), frames.shape[0]
    phasor = maps.flat + kind.zeros(n_frames, 1, 1, 1) if start is None else split(start, maps.inside)
    path = [angle(phasor, xp) if start is None else start] if history else []
    data = method.prepare(frames, phasor, start is None, kind)
    limit = config.tolerance * config.tolerance * config.sensor.pupil.n_points
    none = kind.integers([0] * n_frames)
    active, finished, done = None, [], none > 0

    def result(iteration: int, phasor: NDArray, done: NDArray, unsolved: NDArray) -> Found:
        return Found(angle(phasor, xp), none[: done.shape[0]] + iteration, done, unsolved)

    for iteration in range(1, config.n_iterations + 1):
        field, unsolved, modulus = method.step(phasor, data, kind)
        last = iteration == config.n_iterations
        if last and not limit:
            phasor = field  # the modulus does not matter any more
        else:
            before, phasor = phasor, unit(field, maps.inside, xp, modulus)
            done = _small(phasor - before, limit, xp) if limit else done
        if history:
            path.append(angle(phasor, xp))
        if last or (limit and xp.all(done)):
            break
        if limit and xp.any(done):
            # Frames that are done leave the loop, so a frame's result does not depend on its neighbours.
            active = kind.integers(np.arange(n_frames)) if active is None else active
            finished.append((active[done], result(iteration, phasor[done], done[done], (unsolved + none)[done])))
            active, phasor = active[~done], phasor[~done]
            data = {name: values[~done] for name, values in data.items()}
            none = none[: phasor.shape[0]]
    found = result(iteration, phasor, done, unsolved + none)
    if finished:
        order = xp.argsort(xp.concat([*(which for which, _ in finished), active]))
        parts = zip(*(part[:4] for _, part in finished), found[:4], strict=True)
        found = Found(*(xp.take(xp.concat(arrays), order, axis=0) for arrays in parts))
    if history:
        path += path[-1:] * (config.n_iterations + 1 - len(path))
        found = found._replace(history=xp.stack(path, axis=1))
    return found


def _small(change: NDArray, limit: float, xp: Any) -> NDArray[np.bool_]:
    """Whether the squared norm of a change of the phasors, nearly that of the phases, is within the limit."""
    change = xp.reshape(change, (change.shape[0], -1))
    return xp.vecdot(change, change) <= limit


def report(config: Settings, frames: NDArray, batch: tuple[int, ...], found: Found) -> Reconstruction:
    """Result in the shape of the batch; the phases found are written to."""
    kind = Kind.of(frames)
    outside = config.maps(kind).outside
    phase, n_iterations, converged, n_unsolved, history = found
    phase += outside
    if history is not None:
        history += outside
    # A copy, since the residual is computed later: a camera may write the next frame to the same place.
    window = kind.xp.asarray(frames[(..., *config.sensor.window)], copy=True)

    def shaped(values: NDArray) -> NDArray:
        # A single frame is what a control loop hands in: no need to compute its shape.
        return kind.xp.reshape(values, (*batch, *values.shape[1:])) if batch else values[0, ...]

    return Reconstruction(
        shaped(phase), shaped(n_iterations), shaped(converged), shaped(n_unsolved),
        None if history is None else shaped(history), config, shaped(window),
    )  # fmt: skip


def pieces(frames: NDArray, kind: Kind, size: int | None = None) -> Iterator[slice]:
    """Slices of frames (n, ...) that are handled together."""
    if size is None:
        chunk = _CHUNK if kind.on_host else _CHUNK_ELSEWHERE
        size = max(1, chunk // prod(frames.shape[1:]))
    n = frames.shape[0]
    return (slice(first, min(first + size, n)) for first in range(0, n, size))


def check_frames(
    sensor: ZernikeSensor, frames: ArrayLike, name: str = "frames", *, light: float = np.inf, depth: int = 3
) -> tuple[NDArray[np.floating], tuple[int, ...]]:
    """Checked frames, (k, n_masks, ny', nx'), and the shape of the batch.

    Parameters
    ----------
    sensor : ZernikeSensor
    frames : array_like, shape (..., n_masks, ny', nx')
    name : str
        Of the frames, in messages.
    light : float
        Sum over the pupil with the mask out. Frames that are far brighter cause a warning; none do if left out.
    depth : int
        Calls between the warning and the line that it names.
    """
    frames = _check.real_any(name, frames)
    shape = (sensor.n_masks, *sensor.detector_shape)
    _check.trailing_shape(name, frames, shape, "masks and detector of the sensor")
    batch, xp = tuple(frames.shape[:-3]), Kind.of(frames).xp
    flat = xp.reshape(frames, (-1, *shape))
    if not prod(batch):
        raise ValueError(f"{name} has shape {tuple(frames.shape)}: expected at least one frame")
    total = xp.sum(flat, axis=(-2, -1))
    # A sum is finite only if all its terms are; one of nothing negative is 0 only if all of them are.
    if not (xp.min(flat) >= 0 and xp.all((total > 0) & (total < _BRIGHT * light))):
        _check.finite(name, flat)
        _check.non_negative(name, flat, "; after subtracting a background, raise them to 0 explicitly")
        if not xp.all(total > 0):
            n_dark = int(xp.count_nonzero(total == 0))
            raise ValueError(f"{name}: {n_dark} of {prod(total.shape)} hold no light: expected some flux in each")
        _warn_of_counts(sensor, name, flat, light, depth + 1)
    return flat, batch


def _warn_of_counts(sensor: ZernikeSensor, name: str, frames: NDArray, light: float, depth: int) -> None:
    """Warn if frames (k, n_masks, ny', nx') are brighter inside the pupil than behind any mask."""
    kind = Kind.of(frames)
    inside = frames[(..., *sensor.window)] * sensor.maps(kind).inside
    brightest = float(kind.xp.max(kind.xp.sum(inside, axis=(-2, -1)))) / sensor.pupil.n_points
    expected = light / sensor.pupil.n_points
    if brightest > _BRIGHT * expected:
        warnings.warn(
            f"{name}: the mean inside the pupil reaches {brightest:.4g}: expected at most about {expected:.4g}, "
            "the mean with the mask taken out; are these raw counts? Subtract the background, then divide by the "
            "mean count in the pupil with the mask taken out",
            UserWarning,
            stacklevel=depth,
        )


def start_phase(
    sensor: ZernikeSensor, start: ArrayLike | None, batch: tuple[int, ...], kind: Kind, name: str = "start"
) -> NDArray[np.floating]:
    """Checked starting phase of every frame, (k, ny, nx), 0 outside; flat for None."""
    shape = sensor.pupil.shape
    if start is None:
        return kind.xp.zeros((prod(batch), *shape), dtype=kind.dtype, device=kind.device)
    maps, start_batch = sensor.pupil_maps(name, start)
    if start_batch not in ((), batch):
        expected = f"{shape} or {(*batch, *shape)}" if batch else f"{shape}"
        raise ValueError(f"{name} has shape {(*start_batch, *shape)}: expected {expected}")
    # As many copies as there are frames, of one map or of each.
    return _check.in_kind(name, maps, kind) + kind.xp.zeros(
        (prod(batch), 1, 1), dtype=kind.dtype, device=kind.device
    )


def angle(phasor: NDArray, xp: Any) -> NDArray:
    """Phase of a split phasor: (..., 2, ny, nx) to (..., ny, nx)."""
    return xp.atan2(phasor[..., 1, :, :], phasor[..., 0, :, :])


def count(points: NDArray[np.bool_], kind: Kind) -> NDArray[np.int64]:
    """Number of points that are true in each map: (k, ny, nx) to (k,)."""
    if kind.xp is np:  # along an axis NumPy turns all of them into integers first
        return np.array([np.count_nonzero(one) for one in points])
    return kind.xp.sum(kind.xp.astype(points, kind.xp.int64), axis=(-2, -1))


def turn(wave: NDArray, along: NDArray, across: NDArray) -> NDArray:
    """Split product (along + i across) wave, of two maps (k, ny, nx) and a split wave (k, 2, ny, nx)."""
    turned = along[:, np.newaxis, ...] * wave
    ahead = across[:, np.newaxis, ...] * wave
    turned[:, 0, ...] -= ahead[:, 1, ...]
    turned[:, 1, ...] += ahead[:, 0, ...]
    return turned


def for_each(array: NDArray, n_frames: int, xp: Any) -> NDArray:
    """What all frames share, (1, ...), as a view of shape (n_frames, ...)."""
    return xp.broadcast_to(array, (n_frames, *array.shape[1:]))


def steady(found: NDArray, data: dict[str, NDArray], xp: Any) -> NDArray:
    """Coefficients of an estimate, (k, 2 r), turned to the piston of those before; kept for the next ones."""
    if "tried" in data:
        found = with_piston_of(data["tried"], found, xp)
    data["tried"] = found
    return found


def with_piston_of(before: NDArray, found: NDArray, xp: Any) -> NDArray:
    """Coefficients (k, 2 r) turned by the constant phase that brings them nearest to those before.

    The frames do not depend on a piston, and one iteration F obeys F(exp(i a) psi) = exp(i a) F(psi) for any a. It
    therefore may settle at F(psi) = exp(i w) psi: if noise or a wrong model leaves no phase that explains the
    frames, each iteration adds the piston w. The angle that makes <before, found> real and positive removes w and
    changes nothing else. A fixed gauge, such as a real mean field, would fail where the mean field vanishes.
    """
    rank = found.shape[-1] // 2
    real, imag = found[:, :rank], found[:, rank:]
    across = xp.vecdot(before[:, :rank], imag) - xp.vecdot(before[:, rank:], real)
    ahead = xp.atan2(across, xp.vecdot(before, found))[:, np.newaxis]
    along, across = xp.cos(ahead), xp.sin(ahead)
    return xp.concat([along * real + across * imag, along * imag - across * real], axis=-1)


def unit(field: NDArray, modulus: NDArray, xp: Any, before: NDArray | None = None) -> NDArray:
    """Split field with another modulus, (..., ny, nx); 0 where the field vanishes. `field` is reused.

    `before` is the modulus that it has, if that is known.
    """
    before = xp.sqrt(square(field) + _VANISHING) if before is None else before + _VANISHING
    field *= (modulus / before)[..., np.newaxis, :, :]
    return field
