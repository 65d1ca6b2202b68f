"""The base of all reconstructors: what each of them accepts and returns, and the loop of the iterative ones.

A reconstructor without iteration derives from `ClosedForm` and computes a phase from frames. One that improves a
field step by step derives from `FixedPoint`. Anything else derives from `Reconstructor`. A new method is a module
in `zwfs.reconstructors` with such a class, and an entry in `RECONSTRUCTORS`.

Frames arrive checked, with one batch axis: shape (k, n_masks, ny', nx') on the detector. Phases have shape
(k, ny, nx) and are 0 outside the pupil; the base class puts NaN there.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, Kind, per_kind, read_only
from zwfs._likelihood import Noise
from zwfs._propagator import Propagator, amplitude_map, angle, propagator, pupil_maps, split, square, unit
from zwfs._results import PhaseResult
from zwfs.polychromatic import PolychromaticSensor
from zwfs.sensor import Sensor, ZernikeSensor

__all__ = ["ClosedForm", "Estimate", "FixedPoint", "Reconstruction", "Reconstructor", "State"]

# Detector pixels handled together: on the processor few enough for its fast memory, enough to vectorise.
_CHUNK, _CHUNK_ELSEWHERE = 80_000, 40_000_000
_BRIGHT = 10.0  # mean of a frame inside the pupil, relative to no mask: masks never exceed 1, raw counts soon do
_MOST_ITERATIONS = 2**31 - 1


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction(PhaseResult):
    """Result of a reconstruction; `...` is the batch of the frames. For NumPy it is the array `phase`.

    The arrays belong to the caller: they are writable and share no memory with the frames or the reconstructor.

    Attributes
    ----------
    phase : ndarray, shape (..., ny, nx), radian
        NaN outside the pupil. Wrapped to (-pi, pi], except by `Linear` and `GradientDescent`. The frames do not
        depend on the piston, so its value has no meaning: remove it on the circle before you fit modes.
    n_iterations : ndarray of int, shape (...)
        Iterations used; 1 without iteration.
    converged : ndarray of bool, shape (...)
        Whether the last iteration changed the phase by no more than the tolerance. A `FixedPoint` with a tolerance
        of 0 makes no such test and reports False. A `ClosedForm` always reports True. The phase may be wrong all
        the same: see `explains`.
    n_unsolved : ndarray of int, shape (...)
        Points whose equation had no (unique) solution in the last iteration: singular ones, which kept the value
        of the iteration before, or cosines beyond +-1.
    history : ndarray, shape (..., n_iterations + 1, ny, nx), radian, or None
        Phase at the start and after each iteration, if asked for; repeated once converged.
    settings : Settings
        Of the reconstructor.
    frames : ndarray, shape (..., n_masks, ny, nx)
        Copy of the reconstructed frames, cut to the grid of the pupil.
    """

    phase: NDArray[np.floating]
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]
    history: NDArray[np.floating] | None
    settings: Settings
    frames: NDArray[np.floating]

    def __post_init__(self) -> None:
        _check.instance("settings", self.settings, Settings)
        sensor, grid = self.settings.sensor, self.settings.sensor.pupil.shape
        _check.array_of("phase", self.phase, "real floating")
        _check.trailing_shape("phase", self.phase, grid, "the shape of the pupil")
        batch = tuple(self.phase.shape[:-2])
        _check.array_of("n_iterations", self.n_iterations, "integral", batch)
        _check.array_of("converged", self.converged, "bool", batch)
        _check.array_of("n_unsolved", self.n_unsolved, "integral", batch)
        _check.array_of("frames", self.frames, "real floating", (*batch, sensor.n_masks, *grid))
        if self.history is not None:
            _check.array_of("history", self.history, "real floating", (*batch, "n_iterations + 1", *grid))

    def __repr__(self) -> str:
        xp, n_frames = Kind.of(self.phase).xp, prod(self.converged.shape)
        n_converged = int(xp.count_nonzero(self.converged))
        return f"Reconstruction(phase {tuple(self.phase.shape)}, {n_converged} of {n_frames} converged)"

    @cached_property
    def residual(self) -> NDArray[np.floating]:
        """Mismatch of the frames, shape (...), computed at its first use.

        Rms difference, over all masks and the points of the pupil, between the measured frames and those modelled
        from the phase; the unit is the mean intensity of the pupil.
        """
        kind = Kind.of(self.frames)
        parts = [(light - frames) ** 2 for light, frames in self._compared(kind)]
        squares = kind.xp.concat([kind.xp.mean(part, axis=(1, 2)) for part in parts])
        return self._shaped(kind.xp.sqrt(squares))

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Whether the phase explains frames without noise, shape (...), see `explains`.

        The result of `MaximumLikelihood` has its noise, and compares the frames with that.
        """
        return self.explains()

    def explains(self, *, photons: float | None = None, read_noise: float = 0.0) -> NDArray[np.bool_]:
        """Return whether the method converged and its phase explains the frames, shape (...).

        `converged` only says that the phase stopped to change. Here the frames that it gives are compared with
        those measured, at the points of the pupil: their misfit must exceed that of noise by less than 5 standard
        deviations. Without a number of photons the rms residual must be at most 1e-5 of the mean intensity, which
        is far above rounding in single precision. Where the tolerance is 0 no iteration tests whether it has
        converged, and only the frames count.

        The frames cannot reject all that is wrong. The phase of every point follows part of the noise, and an
        error of the frames of up to 0.7 standard deviations of a pixel passes. With 50 photons per point this is
        10 %, more than most errors of the model cause. For one mask many phases explain a frame.

        Parameters
        ----------
        photons : float, optional
            Photons per pupil point and image, `Detector.photons`. Left out
            for frames without noise.
        read_noise : float, electrons rms / pixel
            That of the frames, with the noise of a background that was subtracted.

        Returns
        -------
        ndarray of bool, shape (...)

        Raises
        ------
        ValueError
            If there is read noise without a number of photons.
        """
        noise, kind = Noise.checked(photons, read_noise), Kind.of(self.frames)
        double = kind._replace(dtype=kind.xp.float64)
        fine = kind.xp.concat([noise.explains(*pair) for pair in self._compared(double)])
        explained = self._shaped(fine)
        return explained & self.converged if self.settings.tolerance else explained

    def _compared(self, kind: Kind) -> Iterator[tuple[NDArray[np.floating], NDArray[np.floating]]]:
        """Modelled and measured frames at the points of the pupil, (1, n_masks, n_points) for each frame set."""
        model, xp = self.settings.model(kind), kind.xp
        inside = kind.integers(np.flatnonzero(model.pupil.inside))
        frames = xp.reshape(xp.astype(self.frames, kind.dtype), (-1, *self.frames.shape[-3:]))
        for index, psi in enumerate(self._fields(model)):
            light = square(model.reference(psi) + psi[:, np.newaxis, ...])
            flat = (xp.reshape(maps, (*maps.shape[:2], -1)) for maps in (light, frames[index : index + 1, ...]))
            modelled, measured = (xp.take(maps, inside, axis=2) for maps in flat)
            yield modelled, measured

    def _fields(self, model: Propagator) -> Iterator[NDArray[np.floating]]:
        """Estimated field of each frame set, split, (1, 2 n_wavelengths, ny, nx)."""
        for phase in self._singles(self.phase, model):
            yield model.incoming(phase)

    def _singles(self, maps: NDArray[np.floating], model: Propagator) -> Iterator[NDArray[np.floating]]:
        """Each map of a result, (1, ny, nx), 0 outside the pupil."""
        xp, zero = model.kind.xp, model.kind.array(0.0)
        maps = xp.reshape(maps, (-1, *model.pupil.shape))
        for index in range(maps.shape[0]):
            yield xp.where(model.inside, xp.astype(maps[index : index + 1, ...], model.kind.dtype), zero)

    def _shaped(self, values: NDArray) -> NDArray:
        """Values of all frame sets, (k,), in the shape of their batch."""
        batch = self.phase.shape[:-2]
        return Kind.of(self.phase).xp.reshape(values, batch) if batch else values[0]


@dataclass(frozen=True, eq=False)
class Settings(Immutable):
    """Checked arguments that every reconstructor accepts.

    Attributes
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one.
    amplitude : ndarray, shape (ny, nx)
        Amplitude A_in of the incoming field, 0 outside the pupil.
    light : float
        Sum of the squared amplitude over the pupil: the light of a clear frame.
    """

    sensor: ZernikeSensor | PolychromaticSensor
    n_iterations: int
    tolerance: float
    amplitude: NDArray[np.float64]
    light: float

    @classmethod
    def checked(cls, sensor: Any, n_iterations: Any, tolerance: Any, amplitude: ArrayLike | None) -> Settings:
        """Check the arguments; an amplitude of None is that of the sensor's pupil."""
        _check.instance("sensor", sensor, ZernikeSensor, PolychromaticSensor)
        n_iterations = _check.integer("n_iterations", n_iterations, 1, _MOST_ITERATIONS)
        tolerance = _check.number("tolerance", tolerance, 0)
        checked = amplitude_map(amplitude, sensor).copy()
        return cls(sensor, n_iterations, tolerance, read_only(checked), float(np.sum(checked * checked)))

    @per_kind
    def model(self, kind: Kind) -> Propagator:
        """Model of the sensor with this amplitude, for arrays of one kind."""
        return propagator(self.sensor, kind).with_amplitude(self.amplitude)

    def residual(self, phase: NDArray, light: NDArray) -> NDArray[np.floating]:
        """Rms mismatch, (k,), of phases (k, ny, nx) and frames on the grid of the pupil, (k, n_masks, ny, nx)."""
        kind = Kind.of(light)
        model = self.model(kind)
        squares = [model.mismatch(phase[piece, ...], light[piece, ...]) for piece in pieces(light, kind)]
        return kind.xp.sqrt(kind.xp.concat(squares) / (self.sensor.n_masks * model.pupil.n_points))


class Solution(NamedTuple):
    """Result for a batch of k frame sets; the meaning is that of `Reconstruction`, 0 outside the pupil."""

    phase: NDArray[np.floating]
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]
    history: NDArray[np.floating] | None = None

    def empty(self, k: int, kind: Kind) -> Solution:
        """Return arrays of the same shapes and types for k frame sets, yet to be filled."""
        return self.map_arrays(
            lambda array: kind.xp.empty((k, *array.shape[1:]), dtype=array.dtype, device=kind.device)
        )

    @classmethod
    def joined(cls, parts: list[tuple[NDArray[np.int64], Solution]], kind: Kind) -> Solution:
        """Join the results of parts of a batch; each comes with the places of its frame sets, integers (j,)."""
        if len(parts) == 1:
            return parts[0][1]
        order = kind.xp.argsort(kind.xp.concat([places for places, _ in parts]))
        columns = zip(*(solution[:4] for _, solution in parts), strict=True)  # a part with a history is alone
        return cls(*(kind.xp.concat(column) for column in columns)).take(order, kind)

    def take(self, which: NDArray[np.int64], kind: Kind) -> Solution:
        """Return the results of some frame sets: integers, (j,)."""
        return self.map_arrays(lambda array: kind.xp.take(array, which, axis=0))

    def at(self, index: int) -> Solution:
        """Return the result of one frame set, without the batch axis."""
        return self.map_arrays(lambda array: array[index, ...])

    def put(self, which: slice | int, part: Solution) -> None:
        """Write the results of some frame sets to their places."""
        pairs: zip[tuple[Any, Any]] = zip(self, part, strict=True)
        for array, values in pairs:
            if array is not None:
                array[which, ...] = values

    def map_arrays(self, function: Callable[[NDArray], NDArray]) -> Solution:
        """Apply a function to each array."""
        return Solution._make(None if array is None else function(array) for array in self)


class Reconstructor(Immutable, ABC):
    """Base class of the reconstructors: they are built with a sensor and called on frames.

    A subclass implements `solve`. Its constructor hands the common arguments to this class and checks its own.

    Parameters
    ----------
    sensor : ZernikeSensor
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        An iteration that changes the phase by no more than this (rms over the pupil) is the last one.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.

    Attributes
    ----------
    n_masks : (int, float)
        Fewest and most masks of a sensor; class attribute.
    iterative : bool
        Whether the method iterates and accepts a starting phase; class attribute.
    polychromatic : bool
        Whether the method accepts a `PolychromaticSensor`; class attribute.
    any_library : bool
        Whether `solve` accepts arrays of any library. If not, frames become arrays of NumPy. Class attribute.
    """

    n_masks: ClassVar[tuple[int, float]] = (1, math.inf)
    iterative: ClassVar[bool] = True
    polychromatic: ClassVar[bool] = False
    any_library: ClassVar[bool] = False

    def __init__(
        self,
        sensor: ZernikeSensor | PolychromaticSensor,
        *,
        n_iterations: int = 25,
        tolerance: float = 1e-6,
        amplitude: ArrayLike | None = None,
    ) -> None:
        if isinstance(sensor, PolychromaticSensor) and not self.polychromatic:
            raise TypeError(
                f"sensor is a PolychromaticSensor: expected a ZernikeSensor for {type(self).__name__}, such as "
                "sensor.reference, which ignores the bandwidth; Linear, GradientDescent and MaximumLikelihood "
                "accept both"
            )
        self._settings = Settings.checked(sensor, n_iterations, tolerance, amplitude)
        self._light = self._settings.light  # of a clear frame; infinite where frames may come in any unit
        fewest, most = self.n_masks
        if not fewest <= sensor.n_masks <= most:
            expected = (
                f"{fewest}" if fewest == most else f"{fewest} {'or more' if most == math.inf else f'to {most}'}"
            )
            raise ValueError(
                f"sensor has {sensor.n_masks} mask{'s' * (sensor.n_masks > 1)}: expected {expected} for "
                f"{type(self).__name__}"
            )

    @property
    def settings(self) -> Settings:
        """Checked arguments that every reconstructor accepts."""
        return self._settings

    @property
    def sensor(self) -> ZernikeSensor | PolychromaticSensor:
        """Sensor whose frames are reconstructed."""
        return self._settings.sensor

    def __repr__(self) -> str:
        config = self._settings
        return f"{type(self).__name__}({config.sensor!r}, {config.n_iterations}, tolerance={config.tolerance:g})"

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> Reconstruction:
        """Reconstruct the phase of each frame set.

        Parameters
        ----------
        frames : array_like, shape (..., n_masks, ny', nx')
            Intensity, 1 = mean of the pupil with the mask out; with one mask also (ny', nx'). Keep the values
            below 0 that noise causes after the dark is subtracted: to raise them to 0 would bias the phase.
        start : array_like, shape (ny, nx) or (..., ny, nx), radian, optional
            Phase at which the iteration starts; flat if left out. A method that does not iterate refuses it.
        history : bool
            Keep the phase after each iteration.

        Returns
        -------
        Reconstruction

        Raises
        ------
        ValueError
            If no pixel of a frame is above 0.

        Warns
        -----
        UserWarning
            If a frame is more than 10 times as bright, inside the pupil, as with the mask out: raw counts?
        """
        frames, batch, start = self.accept(frames, start)
        return self.report(frames, batch, self.solve(frames, start, _check.flag("history", history)))

    def accept(
        self, frames: ArrayLike, start: ArrayLike | None
    ) -> tuple[NDArray[np.floating], tuple[int, ...], NDArray[np.floating] | None]:
        """Check the arguments of a call and return them as `solve` expects them, with the batch of the frames."""
        _check.no_gradient("frames", frames)
        _check.no_gradient("start", start)
        if not self.any_library:
            frames = _check.real_array("frames", frames)
        frames, batch = check_frames(self.sensor, frames, light=self._light)
        if start is None:
            return frames, batch, None
        if not self.iterative:
            raise ValueError(
                f"start = {_check.shown(start)}: expected None, since {type(self).__name__} does not iterate"
            )
        return frames, batch, check_phase("start", start, self.sensor, batch, Kind.of(frames))

    def report(self, frames: NDArray, batch: tuple[int, ...], solution: Solution) -> Reconstruction:
        """Return the result of a solution in the shape of the batch; its phases are written to."""
        kind = Kind.of(frames)
        for phase in (solution.phase, solution.history):
            if phase is not None:
                phase += self._settings.model(kind).no_data
        # A copy, since the residual is computed later: a camera may write the next frame to the same place.
        window = kind.xp.asarray(frames[(..., *self.sensor.window)], copy=True)

        def shaped(values: NDArray) -> NDArray:
            # A single frame is the case of a control loop: no need to compute its shape.
            return kind.xp.reshape(values, (*batch, *values.shape[1:])) if batch else values[0, ...]

        return Reconstruction(
            **solution.map_arrays(shaped)._asdict(), settings=self._settings, frames=shaped(window)
        )

    @abstractmethod
    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Reconstruct checked frames.

        Parameters
        ----------
        frames : ndarray, shape (k, n_masks, ny', nx')
        start : ndarray, shape (k, ny, nx), radian, or None for a flat phase
        history : bool
            Whether the solution needs a history.
        """


class ClosedForm(Reconstructor):
    """Base class of the reconstructors without iteration: a subclass implements `invert`.

    Parameters
    ----------
    sensor : ZernikeSensor
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2))
    >>> class Mean(zwfs.reconstructors.base.ClosedForm):
    ...     def invert(self, frames):
    ...         excess = frames[:, 0] - frames[:, 0].mean(axis=(-2, -1), keepdims=True)
    ...         return excess / 2 * self.sensor.pupil.inside, 0
    ...
    >>> Mean(sensor)(sensor.measure(np.zeros(pupil.shape))).phase.shape
    (32, 32)
    """

    iterative = False

    def __init__(self, sensor: ZernikeSensor | PolychromaticSensor, *, amplitude: ArrayLike | None = None) -> None:
        super().__init__(sensor, n_iterations=1, tolerance=0.0, amplitude=amplitude)

    @abstractmethod
    def invert(self, frames: NDArray) -> tuple[NDArray, NDArray | int]:
        """Return the phase, (k, ny, nx), and the number of points without a solution, (k,) or one for all.

        The frames are an array of NumPy, shape (k, n_masks, ny', nx'). Values outside the pupil do not matter.
        """

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Return the phase of `invert` as the result of one iteration, which has always converged."""
        k, inside = len(frames), self.sensor.pupil.inside
        phase, n_unsolved = self.invert(frames)
        phase = np.where(inside, phase, 0).astype(frames.dtype)
        before = np.broadcast_to(self._before().astype(frames.dtype), phase.shape)
        path = np.stack([before, phase], axis=1) if history else None
        return Solution(phase, np.ones(k, int), np.ones(k, bool), np.zeros(k, int) + n_unsolved, path)

    def _before(self) -> NDArray[np.floating]:
        """Phase with which a history begins, (ny, nx)."""
        return np.zeros(self.sensor.pupil.shape)


@dataclass
class State:
    """State of an iteration: base of dataclasses of arrays with the frame sets on the first axis, or None."""

    def keep(self, active: NDArray[np.bool_]) -> None:
        """Drop the frame sets that have left the loop: only those where `active`, (k,), is True stay."""
        for name, values in vars(self).items():
            if values is not None:
                setattr(self, name, values[active])


class Estimate(NamedTuple):
    """Result of a step: a field of any modulus, shape (k, 2, ny, nx)."""

    field: NDArray[np.floating]
    n_unsolved: NDArray[np.int64] | int = 0  # points without a solution, (k,) or the same for all
    modulus: NDArray[np.floating] | None = None  # of the field, (k, ny, nx), if the step knows it


class FixedPoint(Reconstructor):
    """Base class of the iterations in which each step computes a better field from the phasor of the last one.

    The phasor exp(i phase) is all that is kept of a field. It is split into its real and imaginary part: shape
    (k, 2, ny, nx), 0 outside the pupil. A subclass implements `begin` and `step`, for arrays of any library. Both
    receive the `constants` of the arrays' kind: those of `Propagator`, unless the subclass computes others.

    Parameters are those of `Reconstructor`; with a tolerance of 0 all iterations are done.
    """

    any_library = True

    @property
    def sensor(self) -> ZernikeSensor:
        """Sensor whose frames are reconstructed."""
        return cast(ZernikeSensor, self._settings.sensor)

    def constants(self, kind: Kind) -> Any:
        """Arrays of one kind that all frames share; an override is decorated with `per_kind`."""
        return self.settings.model(kind)

    @abstractmethod
    def begin(self, frames: NDArray, phasor: NDArray | None, constants: Any) -> State:
        """Return the state before the first step; a phasor of None stands for a flat wavefront."""

    @abstractmethod
    def step(self, phasor: NDArray, state: Any, constants: Any) -> Estimate:
        """Return the next field, as a new array; the state may change, the phasor may not."""

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Iterate the steps on every frame set until it converges or the iterations are used up."""
        kind = Kind.of(frames)

        def iterate(piece: slice) -> Solution:
            return self._iterate(frames[piece, ...], None if start is None else start[piece, ...], history)

        # With a history each frame set is a piece by itself: one that converges early would leave a gap.
        first, *others = pieces(frames, kind, 1 if history else None)
        solution = iterate(first)
        if not others:
            return solution
        whole = solution.empty(frames.shape[0], kind)
        whole.put(first, solution)
        for piece in others:
            whole.put(piece, iterate(piece))
        return whole

    def _iterate(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Iterate a few frame sets together. Those that are done leave, so no result depends on the others."""
        kind, k, config = Kind.of(frames), frames.shape[0], self.settings
        xp, model, constants = kind.xp, config.model(kind), self.constants(kind)
        limit = config.tolerance * config.tolerance * model.pupil.n_points  # of the squared norm of a change
        phasor = model.flat + kind.zeros(k, 1, 1, 1) if start is None else split(start, model.stop)
        path = [angle(phasor, xp) if start is None else start] if history else []
        state = self.begin(frames, None if start is None else phasor, constants)
        places, done = kind.integers(np.arange(k)), kind.flags(np.zeros(k, bool))
        ended: list[tuple[NDArray[np.int64], Solution]] = []

        def result(phasor: NDArray, done: NDArray, n_unsolved: NDArray | int) -> Solution:
            zeros = kind.integers([0] * done.shape[0])
            return Solution(angle(phasor, xp), zeros + iteration, done, zeros + n_unsolved)

        for iteration in range(1, config.n_iterations + 1):
            before, last, n_done = phasor, iteration == config.n_iterations, 0
            phasor, n_unsolved, modulus = self.step(before, state, constants)
            if limit or not last:  # the phase of the last field does not depend on its modulus
                phasor = unit(phasor, model.stop, xp, modulus)
            if limit:
                before -= phasor  # in place: the array is not needed any more
                done = _small(before, limit, xp)
                n_done = int(xp.count_nonzero(done))
            if history:
                path.append(angle(phasor, xp))
            if last or n_done == done.shape[0]:
                break
            if n_done:
                n_unsolved = n_unsolved + xp.zeros_like(places)
                ended.append((places[done], result(phasor[done], done[done], n_unsolved[done])))
                places, phasor = places[~done], phasor[~done]
                state.keep(~done)
        ended.append((places, result(phasor, done, n_unsolved)))
        solution = Solution.joined(ended, kind)
        if not history:
            return solution
        path += path[-1:] * (config.n_iterations + 1 - len(path))
        return solution._replace(history=xp.stack(path, axis=1))


def _small(change: NDArray, limit: float, xp: Any) -> NDArray[np.bool_]:
    """Whether the squared norm of a change of the phasors, nearly that of the phases, is within the limit."""
    change = xp.reshape(change, (change.shape[0], -1))
    return xp.vecdot(change, change) <= limit


def pieces(frames: NDArray, kind: Kind, size: int | None = None) -> Iterator[slice]:
    """Slices of frames (n, ...) that are handled together."""
    if size is None:
        chunk = _CHUNK if kind.on_host else _CHUNK_ELSEWHERE
        size = max(1, chunk // prod(frames.shape[1:]))
    n = frames.shape[0]
    return (slice(first, min(first + size, n)) for first in range(0, n, size))


def check_frames(
    sensor: Sensor, frames: ArrayLike, name: str = "frames", *, light: float = math.inf
) -> tuple[NDArray[np.floating], tuple[int, ...]]:
    """Check frames and return them with one batch axis, (k, n_masks, ny', nx'), and the shape of their batch.

    Parameters
    ----------
    sensor : ZernikeSensor
    frames : array_like, shape (..., n_masks, ny', nx')
    name : str
        Name of the frames in error messages.
    light : float
        Sum of a clear frame over the pupil. Frames that are more than 10 times as bright cause a warning.
    """
    frames = _check.real_any(name, frames)
    shape, xp = (sensor.n_masks, *sensor.detector_shape), Kind.of(frames).xp
    if sensor.n_masks == 1 and frames.ndim == 2:
        frames = frames[np.newaxis, ...]
    _check.trailing_shape(name, frames, shape, "masks and detector of the sensor")
    batch = tuple(frames.shape[:-3])
    flat = xp.reshape(frames, (-1, *shape))
    if not prod(batch):
        raise ValueError(f"{name} has shape {tuple(frames.shape)}: expected at least one frame")
    with np.errstate(over="ignore"):
        total, lit = xp.sum(flat, axis=(-2, -1)), xp.max(flat, axis=(-2, -1)) > 0
    # A sum is finite only if all its terms are.
    if not xp.all(lit & (xp.abs(total) < _BRIGHT * light)):
        _check.moderate(name, flat)
        if not xp.all(lit):
            n_dark = int(xp.count_nonzero(~lit))
            raise ValueError(f"{name}: {n_dark} of {prod(lit.shape)} hold no light: expected some flux in each")
        _warn_of_counts(sensor, name, flat, light)
    return flat, batch


def _warn_of_counts(sensor: Sensor, name: str, frames: NDArray, light: float) -> None:
    """Warn if frames (k, n_masks, ny', nx') are brighter inside the pupil than behind any mask."""
    kind = Kind.of(frames)
    inside = frames[(..., *sensor.window)] * propagator(sensor, kind).stop
    brightest = float(kind.xp.max(kind.xp.sum(inside, axis=(-2, -1)))) / sensor.pupil.n_points
    expected = light / sensor.pupil.n_points
    if brightest > _BRIGHT * expected:
        warnings.warn(
            f"{name}: the mean inside the pupil reaches {brightest:.4g}: expected at most about {expected:.4g}, "
            "the mean with the mask taken out; are these raw counts? Subtract the background, then divide by the "
            "mean count in the pupil with the mask taken out",
            UserWarning,
            stacklevel=5,  # the call of the reconstructor
        )


def check_phase(
    name: str, phase: ArrayLike, sensor: Sensor, batch: tuple[int, ...], kind: Kind
) -> NDArray[np.floating]:
    """Check one phase, or one for each frame set, and return one for each: (k, ny, nx), 0 outside the pupil."""
    shape = sensor.pupil.shape
    maps, own_batch = pupil_maps(name, phase, sensor)
    if own_batch not in ((), batch):
        expected = f"{shape} or {(*batch, *shape)}" if batch else f"{shape}"
        raise ValueError(f"{name} has shape {(*own_batch, *shape)}: expected {expected}")
    # As many copies as there are frame sets, of one map or of each.
    return _check.in_kind(name, maps, kind) + kind.zeros(prod(batch), 1, 1)
