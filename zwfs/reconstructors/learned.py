"""Phase from one look: a small network reads the reference wave from the frames, and every point is solved once.

The paper hopes that machine learning makes its reconstructors faster (section 5). Others learn the phase. Here
only the reference wave is learned: of a small dimple it is about 15 complex numbers. With it the frames determine
the phase of each point (`eq-linear-system`).
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import helmert

from zwfs import _check
from zwfs._arrays import Immutable, Kind, per_kind, read_only
from zwfs._results import npz_bytes
from zwfs._system import path_of, write_file
from zwfs.modes import _unnormalised
from zwfs.pupil import Pupil
from zwfs.reconstructors import _network
from zwfs.reconstructors._network import Network
from zwfs.reconstructors._simulated import (
    LIMITS,
    BenchErrors,
    BenchValues,
    Light,
    Simulation,
    dimples_of,
    random_screens,
    solution_weights,
    unseen_direction,
)
from zwfs.reconstructors.base import Reconstruction, Reconstructor, Settings, Solution, pieces
from zwfs.reconstructors.look import Look, mixed_moments
from zwfs.reconstructors.phase_shifted import PhaseShifted
from zwfs.sensor import ZernikeSensor

__all__ = ["BenchErrors", "BenchValues", "LearnedReconstruction", "LearnedReference", "Training"]

_CHUNK = 100  # screens that are simulated together
_HELD_OUT = 0.05  # of the screens, which the training does not see
_HIDDEN = (256, 256)
_N_EPOCHS = 80
_MISSED = 2e-3  # of the reference wave, relative, that its polynomials may miss
_HIGHEST_ORDER = 10
_LARGEST_INPUT = 1e6  # times the intensity of a clear frame: far beyond any frame
_VALUE_WEIGHT = 0.3  # of the error of a value of the bench, relative to that of the reference wave
_FAR = 0.999  # of the screens held out are less unusual than this limit; it is widened by a factor
_WIDER = 1.2
_BEYOND = 1.3  # half ranges from their middle, beyond which a value of the bench is unlike those of the training
_N_BENCHES, _PER_BENCH = 12, 200  # benches that show the bias of means, and sets of frames of each
_SAME_MASK = 1e-3  # lambda/D or radian
_SAME_WAVE = 0.02  # relative difference of flat reference waves of the same sensor
_FORMAT = 2
_SETTINGS: dict[str, Any] = {"n_iterations": 1, "tolerance": 0.0, "amplitude": None}

SHIPPED: dict[str, dict[str, Any]] = {
    "paper": {"n_screens": 60_000, "photons": (100.0, 1e5), "seed": 1},
    "bench": {
        "n_screens": 60_000, "photons": (100.0, 1e5), "rms": (0.0, 2.0), "seed": 1,
        "errors": BenchErrors(leakage=(-0.04, 0.1), flux_ratio=(0.8, 1.25)),
    },
}  # fmt: skip
"""Settings of `LearnedReference.train` for the trainings of the package, with a round pupil of 64 pixels."""


class Training(NamedTuple):
    """All that a training leaves behind."""

    network: Network
    order: int  # largest radial order of the polynomials of the reference wave
    errors: BenchErrors
    masks: NDArray[np.float64]  # (n_masks, 3), diameter (lambda/D), phase shift and amplitude of the dimples
    flat: NDArray[np.complex64]  # (n_polynomials,), reference wave of a flat wavefront, of the sensor trained for
    whitening: NDArray[np.float32]  # (n_inputs, n_inputs): scaled inputs times it are uncorrelated
    farthest: float  # rms of these, above which frames are unlike those of the training
    slopes: NDArray[np.float64]  # (n_values,) and of the values that the network reads, in the true ones
    offsets: NDArray[np.float64]  # (n_values,)
    scatter: NDArray[np.float64]  # (n_values,), of values read from one set of frames, without their bias
    bias: NDArray[np.float64]  # (n_values,), rms error of the mean over many sets of frames of one bench


@dataclass(frozen=True, eq=False, repr=False)
class LearnedReconstruction(Reconstruction):
    """Result of `LearnedReference`; `...` is the batch of the frames.

    Attributes
    ----------
    frames : ndarray, shape (..., n_masks, ny, nx)
        Frames corrected for the leakage and the flux ratio that were read from them.
    bench : BenchValues
        Errors of the bench, as read from each set of frames. What the training did not vary has its nominal value.
    distance : ndarray, shape (...)
        How unusual the frames are; above 1 the training has seen nothing like them.
    """

    bench: BenchValues
    distance: NDArray[np.floating]

    @property
    def familiar(self) -> NDArray[np.bool_]:
        """Whether the frames are like those of the training, shape (...)."""
        return np.asarray(self.distance <= 1)


class LearnedReference(Reconstructor):
    """Phase from dimples of one diameter, by one solve with a learned reference wave.

    The inputs of the network are the means of the frames, less the incoming light, times 15 polynomials (for a
    dimple of 1.06 lambda/D), and the means of the products of two such differences. Its outputs are the
    coefficients of the reference wave in these polynomials, and those errors of the bench that the training has
    varied.

    Parameters
    ----------
    sensor : ZernikeSensor
        Dimples of one diameter; any number of pixels.
    training : Training or str
        Training for a sensor with the same dimples and a pupil of the same form: `LearnedReference.train` returns
        a reconstructor with one. Two come with the package, both for a circular pupil and the pair of the paper
        (1.06 lambda/D, +pi/2 and -pi/2): "paper" for a bench without errors, and "bench" for one with a leakage of
        -4 to 10 % and a flux ratio of 0.8 to 1.25. `SHIPPED` in this module has their settings.
    n_iterations : int
        Solves: 1 is that of the network. Others are iterations of `PhaseShifted`, which start from its phase; they
        need two or more images.
    tolerance : float, radian
        Stopping tolerance of these iterations.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude in the pupil; that of the sensor's pupil if left out.
    bench : BenchValues, optional
        Errors of the bench that are known, for example from `average`, instead of those read from each frame. The
        first solve corrects leakage, flux ratio and phase shifts, further iterations the diameter, too.

    Notes
    -----
    Outside of its training the network may be wrong although the phase looks plausible. `familiar` compares the
    inputs, and the errors of the bench that were read from them, with those of the training. `explains` compares
    the frames with those that the phase would make.

    Median errors of 40 to 60 simulated screens of 100 or 200 modes that the training has not seen:

    - The paper's pair, 1000 photons: at most 4 % above the converged iteration up to 1.6 rad rms, also in
      turbulence. Without noise, 0.003 rad at 0.8 rad rms; two further iterations reduce it to 0.0003 rad.
    - One image, a dimple of 1.06 lambda/D and pi/2: that of the converged `Arcsine` from 0.3 to 0.5 rad rms, and
      12 to 17 % less at 0.8 and 1 rad. Phases outside of the range of the arcsine are folded back.
    - Two dimples of 2 lambda/D: 0.055 rad at 0.5 rad rms and 0.16 rad at 0.8, without noise. That is less than
      after two accelerated iterations, but far above the photon noise; further iterations are needed. At
      2.4 lambda/D it is 0.078 and 0.16 rad, and even 25 further iterations leave 0.02 rad.
    - A camera that averages over its pixels seems to have 1 to 2 % more leakage than it has.

    References
    ----------
    Chambouleyron et al. 2024, equations (9) and (10), section 5; `eq-learned` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(40)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    >>> truth = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 50), 0.8, 1, seed=1)[0]
    >>> estimate = zwfs.LearnedReference(sensor)(sensor.measure(truth))
    >>> float(zwfs.reconstruction_error(pupil, estimate.phase, truth)) < 0.02
    True
    """

    n_masks = 1, math.inf
    iterative = False

    def __init__(
        self,
        sensor: ZernikeSensor,
        training: Training | str = "paper",
        *,
        n_iterations: int = 1,
        tolerance: float = 0.0,
        amplitude: ArrayLike | None = None,
        bench: BenchValues | None = None,
    ) -> None:
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=amplitude)
        masks = _masks_of(sensor)
        self._shifts, self._strengths = masks[:, 1:].T
        if isinstance(training, str):
            _check.choice("training", training, SHIPPED)
            name = f"learned_{training}.npz"
            training = _read(io.BytesIO(files(__package__).joinpath(name).read_bytes()), name)
        _check.instance("training", training, Training)
        self.training = training
        self._ranges = training.errors.ranges(sensor.n_masks)
        self._bench = None if bench is None else self._checked(bench)
        self._polynomials = _polynomials(sensor, training.order)
        if masks.shape != training.masks.shape or np.abs(masks - training.masks).max() > _SAME_MASK:
            raise ValueError(
                f"sensor: dimples of {_written(masks)}: expected {_written(training.masks)}, those of the "
                "training, or LearnedReference.train for this sensor"
            )
        if _relative(_flat_wave(sensor, self._polynomials) - training.flat, training.flat) > _SAME_WAVE:
            raise ValueError(
                "sensor: the reference wave of a flat wavefront differs from that of the training: expected a "
                "pupil of the same form, or LearnedReference.train for this sensor"
            )
        if sensor.n_masks == 1 and n_iterations > 1:
            raise ValueError(f"n_iterations = {n_iterations}: expected 1 for a sensor with one mask")
        self._iteration: PhaseShifted | None = None
        if n_iterations > 1:
            self._iteration = PhaseShifted(
                sensor if bench is None else _altered(sensor, bench),
                n_iterations=n_iterations - 1,
                tolerance=tolerance,
                amplitude=amplitude,
            )

    @classmethod
    def train(
        cls, sensor: ZernikeSensor, *, screens: ArrayLike | None = None, n_screens: int = 40_000,
        rms: tuple[float, float] = (0.0, 2.4), photons: tuple[float, float] = (300.0, 1e5),
        read_noise: float = 0.0, errors: BenchErrors | None = None, seed: int = 0,
        progress: Callable[[int, int], Any] | None = None, **settings: Any,
    ) -> LearnedReference:  # fmt: skip
        """Train the network on simulated frames; the same seed gives the same network but for rounding.

        Parameters
        ----------
        sensor : ZernikeSensor
        screens : array_like, shape (n, ny, nx), radian, optional
            Phases to learn from, scaled at random as `rms` says. If left out, random screens whose spectral
            density falls as the frequency to the power of 1.5 to 4.
        n_screens : int
            Simulated sets of frames.
        rms : (float, float), radian
            Smallest and largest rms of a screen.
        photons : (float, float)
            Smallest and largest number of photons of an intensity of 1 in a pixel of each frame.
        read_noise : float, electrons rms / pixel
        errors : BenchErrors, optional
            Ranges of bench errors to train for; none by default.
        seed : int
        progress : callable, optional
            Called with the number of steps that are done, and of all steps.
        **settings
            Those of the constructor: n_iterations, tolerance, amplitude.

        Returns
        -------
        LearnedReference
        """
        _check.instance("sensor", sensor, ZernikeSensor)
        dimples_of(sensor)
        n_screens = _check.integer("n_screens", n_screens, 1000, 10**7)
        low, high = _check.pair("rms", rms, _check.number, 0, 10)
        if not 0 <= low < high:
            raise ValueError(f"rms = {(low, high)}: expected a smallest and a larger value")
        light = Light(_check.pair("photons", photons, _check.number, 1, 1e12),
                      _check.number("read_noise", read_noise, 0))  # fmt: skip
        errors = BenchErrors() if errors is None else errors
        _check.instance("errors", errors, BenchErrors)
        if errors.leakage != (0.0, 0.0) and sensor.n_masks != 2:
            raise ValueError(f"errors.leakage = {errors.leakage}: expected (0, 0) for {sensor.n_masks} masks")
        if errors.flux_ratio != (1.0, 1.0) and sensor.n_masks == 1:
            raise ValueError(f"errors.flux_ratio = {errors.flux_ratio}: expected (1, 1) for one mask")
        shapes = None if screens is None else _shapes_of(screens, sensor)
        report, seed = _check.callback("progress", progress), _check.integer("seed", seed, 0)
        amplitude = Settings.checked(sensor, **{**_SETTINGS, **settings}).amplitude
        simulation = Simulation(sensor, amplitude, errors, light)
        n_chunks = math.ceil(n_screens / _CHUNK)
        rng = np.random.default_rng(seed)
        polynomials = _order_of(sensor)
        data = []
        for chunk in range(n_chunks):
            values = _drawn(simulation, rng)
            screens = _scaled_screens(sensor.pupil, shapes, rng.uniform(low, high, _CHUNK), rng)
            data.append((*_example(simulation, polynomials, screens, values, rng), values))
            report(chunk + 1, n_chunks + _N_EPOCHS)
        inputs, waves, values = (np.concatenate(column) for column in zip(*data, strict=True))
        training = _trained(
            sensor, polynomials, errors, (inputs, waves, values), rng,
            lambda epoch: report(n_chunks + epoch, n_chunks + _N_EPOCHS),
        )  # fmt: skip
        if training.scatter.any():
            means = np.array([_misread(training, simulation, polynomials, shapes, rng.uniform(low, high), rng)
                              for _ in range(_N_BENCHES)])  # fmt: skip
            training = training._replace(bias=np.sqrt(np.mean(means**2, axis=0)))
        return cls(sensor, training, **settings)

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> LearnedReconstruction:
        """Reconstruct the phase of each frame set; see `Reconstructor.__call__`. There is no start.

        Returns
        -------
        LearnedReconstruction
        """
        history = _check.flag("history", history)
        checked, batch, _ = self.accept(frames, start)
        solution, corrected, values, distance = self._solved_in_parts(checked, history)
        plain = self.report(corrected, batch, solution)
        return LearnedReconstruction(
            **{field.name: getattr(plain, field.name) for field in fields(plain)},
            bench=BenchValues.of(values.reshape(*batch, -1)),
            distance=distance.reshape(batch),
        )

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Solve checked frames, see `Reconstructor.solve`."""
        return self._solved_in_parts(frames, history)[0]

    def look(self) -> Look:
        """Return the fastest road for a control loop: one solve of one set of frames in single precision.

        The errors of the bench must be known: a training without errors, or `bench`.
        """
        return Look(self)

    def average(self, frames: ArrayLike) -> tuple[BenchValues, BenchValues]:
        """Errors of one bench from many sets of frames, and their standard errors.

        It needs a training with `errors`. A single set of frames gives values that are biased towards the middle
        of the training's ranges. This bias, measured on screens that the training has not seen, is taken out
        before they are averaged. The standard errors contain the part that does not average out, as benches with
        other values showed it.

        Parameters
        ----------
        frames : array_like, shape (..., n_masks, ny', nx')
            Of different phases.

        Returns
        -------
        values, standard_errors : BenchValues
            Each without a batch. Values that the training did not vary are nominal, with an error of 0.
        """
        checked, _, _ = self.accept(frames, None)
        training, window = self.training, checked[(..., *self.sensor.window)]
        inputs = _inputs(window.reshape(*window.shape[:2], -1), self._constants(Kind.of(checked)))
        outputs = training.network(training.network.scaled(inputs))
        values = _unbiased(training, _values(outputs, training, self._ranges))
        scatter = values.std(axis=0, ddof=min(1, len(values) - 1))
        spread = np.maximum(scatter, training.scatter) / math.sqrt(len(values))
        errors = np.where(self._free, np.hypot(spread, training.bias), 0)
        return BenchValues.of(values.mean(axis=0)), BenchValues.of(errors)

    def save(self, path: str | Path) -> None:
        """Write the training as NPZ, plain arrays without pickles, in one step."""
        path = path_of("path", path)
        if path.suffix != ".npz":
            raise ValueError(f"path = {str(path)!r}: expected a name that ends with .npz")
        training, network = self.training, self.training.network
        values = {
            "format": _FORMAT, "order": training.order, "farthest": training.farthest,
            "errors": asdict(training.errors), "n_layers": len(network.weights),
        }  # fmt: skip
        parts = training._asdict() | network._asdict()
        arrays = {name: part for name, part in parts.items() if isinstance(part, np.ndarray)}
        for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            arrays |= {f"weight{index}": weight.astype(_network.STORED), f"bias{index}": bias}
        write_file(path, npz_bytes(arrays, values))

    @classmethod
    def load(cls, path: str | Path, sensor: ZernikeSensor, **settings: Any) -> LearnedReference:
        """Read a training that `save` wrote, for its sensor; the settings are those of the constructor."""
        path = path_of("path", path)
        if not path.is_file():
            raise FileNotFoundError(
                f"path = {str(path)!r}: no such file: expected one that LearnedReference.save wrote"
            )
        return cls(sensor, _read(path, path.name), **settings)

    @cached_property
    def _free(self) -> NDArray[np.bool_]:
        """Values that the network reads, (n_values,)."""
        return self._ranges[:, 1] > self._ranges[:, 0]

    def _checked(self, bench: BenchValues) -> NDArray[np.float64]:
        """Values of a bench, (n_values,)."""
        _check.instance("bench", bench, BenchValues)
        values = []
        for name, value in zip(BenchValues._fields, bench, strict=True):
            array = _check.real_array(f"bench.{name}", value)
            shape = (len(self._shifts),) if name == "phase_shift" else ()
            if array.shape != shape:
                raise ValueError(f"bench.{name} has shape {array.shape}: expected {shape}, for one bench")
            values += [_check.number(f"bench.{name}", number, *LIMITS[name]) for number in array.ravel().tolist()]
        return np.array(values)

    @per_kind
    def _constants(self, kind: Kind) -> _Constants:
        """Arrays of one kind that all frames share."""
        return _Constants.of(self._polynomials, self.settings.amplitude, self.sensor.n_masks, kind)

    @per_kind
    def _fixed(self, kind: Kind) -> _Solve | None:
        """The solve of a bench whose errors are not read from its frames; None if they are."""
        if self._bench is not None:
            return self._solve_of(self._bench[np.newaxis], kind)
        return None if self._free.any() else self._solve_of(self._ranges.mean(axis=1)[np.newaxis], kind)

    def _solve_of(self, values: NDArray, kind: Kind) -> _Solve:
        """The linear part of the solve on benches with some values, (k, n_values)."""
        mixing = _mixing(values, self.sensor.n_masks)
        weights, power = solution_weights(self._shifts + values[:, 3:-2], self._strengths)
        total, mixed = weights.sum(axis=1), (weights[:, np.newaxis] @ mixing)[:, 0]
        parts = (np.stack([array.real, array.imag], axis=1) for array in (mixed, total, power))
        of_frames, of_light, of_power = (kind.array(array) for array in parts)
        light, unseen = of_light[..., np.newaxis] * self._constants(kind).light, None
        if self.sensor.n_masks == 1:
            direction = unseen_direction(self._shifts + values[:, 3:-2], self._strengths)
            unseen = kind.array(np.stack([direction.real, direction.imag], axis=1)[..., np.newaxis])
        return _Solve(values, kind.array(mixing), of_frames, light, of_power[..., np.newaxis], unseen)

    def _solved_in_parts(self, frames: NDArray, history: bool) -> tuple[Solution, NDArray, NDArray, NDArray]:
        """Join the results of `_solved` for parts of a batch."""
        parts = [self._solved(frames[piece], history) for piece in pieces(frames, Kind.of(frames))]
        if len(parts) == 1:
            return parts[0]
        solutions, *arrays = zip(*parts, strict=True)
        columns: Any = zip(*solutions, strict=True)
        columns = (None if column[0] is None else np.concatenate(column) for column in columns)
        corrected, values, distance = map(np.concatenate, arrays)
        return Solution(*columns), corrected, values, distance

    def _solved(self, frames: NDArray, history: bool) -> tuple[Solution, NDArray, NDArray, NDArray]:
        """Solution, corrected frames, values of the bench (k, n_values) and distance (k,) of checked frames."""
        kind, training = Kind.of(frames), self.training
        constants, window = self._constants(kind), frames[(..., *self.sensor.window)]
        flat = window.reshape(*window.shape[:2], -1)
        scaled = training.network.scaled(_inputs(flat, constants))
        outputs = training.network(scaled)
        distance = np.sqrt(np.mean((scaled @ training.whitening) ** 2, axis=1)) / training.farthest
        solve = self._fixed(kind)
        if solve is None:
            values, (low, high) = _values(outputs, training, self._ranges), self._ranges.T
            outside = np.abs(values - (low + high) / 2)[:, self._free] / (_BEYOND * (high - low) / 2)[self._free]
            distance = np.maximum(distance, outside.max(axis=1))
            solve = self._solve_of(np.clip(values, low, high), kind)
        coefficients = outputs[:, : 2 * len(training.flat)].reshape(len(flat), 2, -1)
        disc = (coefficients * np.float32(np.linalg.norm(training.flat))).astype(kind.dtype) @ constants.maps
        phase = _phase(flat, disc, solve, constants.light).reshape(len(flat), *self.sensor.pupil.shape)
        corrected = frames
        if self._corrects:
            corrected = (solve.mixing @ frames.reshape(*frames.shape[:2], -1)).reshape(frames.shape)
        path = np.stack([np.zeros_like(phase), phase], axis=1) if history else None
        solution = Solution(
            phase, np.ones(len(flat), int), np.ones(len(flat), bool), np.zeros(len(flat), int), path
        )
        if self._iteration is not None:
            further = self._iteration.solve(corrected, phase, history)
            if path is not None and further.history is not None:
                path = np.concatenate([path[:, :1], further.history], axis=1)
            solution = further._replace(n_iterations=further.n_iterations + 1, history=path)
        return solution, corrected, np.broadcast_to(solve.values, (len(flat), len(self._ranges))), distance

    @property
    def _corrects(self) -> bool:
        """Whether frames may have leakage or unequal light to correct."""
        return self._bench is not None or bool(self._free[:2].any())


class _Constants(NamedTuple):
    maps: NDArray[np.floating]  # (n_polynomials, ny * nx), 0 outside the pupil
    light: NDArray[np.floating]  # (ny * nx,), intensity with the mask out
    root: NDArray[np.floating]  # (ny * nx,), 1 over the root of the number of points, 0 outside
    means: NDArray[np.floating]  # (ny * nx, n_polynomials), of signals times the root
    mixed: NDArray[np.floating]  # (n_masks, n_masks), sum and differences of the images
    upper: tuple[NDArray[np.intp], NDArray[np.intp]]  # pairs of images

    @classmethod
    def of(cls, polynomials: _Polynomials, amplitude: NDArray, n_masks: int, kind: Kind) -> _Constants:
        root = (amplitude > 0).ravel() / math.sqrt(np.count_nonzero(amplitude))
        return cls(
            kind.array(polynomials.maps),
            kind.array((amplitude**2).ravel()),
            kind.array(root),
            kind.array(np.ascontiguousarray((polynomials.maps * root.max()).T)),
            kind.array(helmert(n_masks, full=True)),
            np.triu_indices(n_masks),
        )


class _Solve(NamedTuple):
    """Linear part of the solve: u = of_frames @ frames - light - of_power |D|^2, for k benches or for one."""

    values: NDArray[np.float64]  # (k, n_values), of the bench
    mixing: NDArray[np.floating]  # (k, n_masks, n_masks), undoes leakage and unequal light
    of_frames: NDArray[np.floating]  # (k, 2, n_masks), for the real and the imaginary part
    light: NDArray[np.floating]  # (k, 2, ny * nx)
    of_power: NDArray[np.floating]  # (k, 2, 1)
    unseen: NDArray[np.floating] | None  # (k, 2, 1), direction of the part that a single image does not show


class _Polynomials(Immutable):
    """Zernike polynomials of a pupil up to a radial order, piston first, and their least-squares inverse."""

    def __init__(self, maps: NDArray, order: int) -> None:
        self.order, self.maps = order, read_only(maps)  # (n_polynomials, ny * nx)
        self.inverse = read_only(np.linalg.pinv(maps))


def _polynomials(sensor: ZernikeSensor, order: int) -> _Polynomials:
    pupil = sensor.pupil
    disc = 2 * (pupil.points[:, 0] + 1j * pupil.points[:, 1])
    n = (order + 1) * (order + 2) // 2
    values = np.concatenate([np.ones((1, pupil.n_points)), _unnormalised(disc, n - 1)])
    values /= np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    return _Polynomials(pupil.scatter(values, fill=0.0).reshape(n, -1), order)


def _order_of(sensor: ZernikeSensor) -> _Polynomials:
    """Polynomials of the lowest order that describe the reference waves."""
    plane = sensor.factors.detector.cut(*sensor.window)
    waves = sensor.factors.core[0].T @ plane.expand(np.eye(plane.rank)).reshape(plane.rank, -1)
    waves = waves * sensor.pupil.inside.ravel()
    for order in range(2, _HIGHEST_ORDER + 1):
        polynomials = _polynomials(sensor, order)
        if _relative(waves - waves @ polynomials.inverse @ polynomials.maps, waves) < _MISSED:
            return polynomials
    diameter = sensor.masks[0].diameter
    raise ValueError(
        f"sensor: dimples of {diameter:g} lambda/D: expected a reference wave that polynomials of order "
        f"{_HIGHEST_ORDER} describe; use PhaseShifted"
    )


def _masks_of(sensor: ZernikeSensor) -> NDArray[np.float64]:
    """Diameter, phase shift and amplitude of each dimple, (n_masks, 3)."""
    return np.array([(dimple.diameter, dimple.phase, dimple.amplitude) for dimple in dimples_of(sensor)])


def _written(masks: NDArray) -> str:
    return ", ".join(f"{diameter:g} lambda/D and {phase:.4g} rad" for diameter, phase, _ in masks)


def _flat_wave(sensor: ZernikeSensor, polynomials: _Polynomials) -> NDArray[np.complex64]:
    """Coefficients of the disc wave of a flat wavefront, (n_polynomials,)."""
    plane, mask = sensor.factors.detector.cut(*sensor.window), dimples_of(sensor)[0]
    core = sensor.factors.core[0] / (mask.amplitude * np.exp(1j * mask.phase) - 1)
    wave = plane.expand(sensor.factors.pupil.project(sensor.pupil.amplitude) @ core.T)
    return (wave.ravel() @ polynomials.inverse).astype(np.complex64)


def _altered(sensor: ZernikeSensor, bench: BenchValues) -> ZernikeSensor:
    """Sensor with the dimples of a bench."""
    dimples = [
        replace(dimple, diameter=dimple.diameter + float(bench.diameter), phase=dimple.phase + float(shift))
        for dimple, shift in zip(dimples_of(sensor), bench.phase_shift, strict=True)
    ]
    return ZernikeSensor(sensor.pupil, *dimples, extent=sensor.extent, tolerance=sensor.tolerance)


def _relative(difference: NDArray, values: NDArray) -> float:
    return float(np.linalg.norm(difference) / np.linalg.norm(values))


def _shapes_of(screens: ArrayLike, sensor: ZernikeSensor) -> NDArray[np.float32]:
    """Screens of a caller, (n, ny, nx), scaled to an rms of 1."""
    pupil, screens = sensor.pupil, _check.real_array("screens", screens)
    _check.trailing_shape("screens", screens, pupil.shape, "the shape of the pupil")
    if screens.ndim != 3 or len(screens) < 2:
        raise ValueError(f"screens has shape {screens.shape}: expected (n, {pupil.shape[0]}, {pupil.shape[1]})")
    values = screens[:, pupil.inside]
    _check.finite("screens", values, " inside the pupil")
    values = values - values.mean(axis=1, keepdims=True)
    rms = values.std(axis=1, keepdims=True)
    if not rms.min() > 0:
        raise ValueError(f"screens[{int(np.argmin(rms))}] is constant: expected phases with an rms above 0")
    return pupil.scatter((values / rms).astype(np.float32), fill=0.0)


def _drawn(simulation: Simulation, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random values of benches, (k, n_values), with one diameter and one blur for all of them."""
    low, high = simulation.errors.ranges(len(simulation.shifts)).T
    values = rng.uniform(low, high, (_CHUNK, len(low)))
    values[:, [2, -1]] = values[0, [2, -1]]
    return values


def _scaled_screens(
    pupil: Pupil, shapes: NDArray | None, rms: NDArray, rng: np.random.Generator, *, alike: bool = False
) -> NDArray[np.float32]:
    """Screens of an rms each, (k,): some of those of a caller, or random ones; `alike`: of one spectrum."""
    if shapes is None:
        screens = random_screens(pupil, len(rms), rng, alike=alike)
    else:
        screens = shapes[rng.integers(len(shapes), size=len(rms))]
    return screens * rms[:, np.newaxis, np.newaxis].astype(np.float32)


def _example(
    simulation: Simulation, polynomials: _Polynomials, screens: NDArray, values: NDArray, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.complex64]]:  # fmt: skip
    """Inputs and disc waves (k, n_polynomials) of frames of screens on benches with some values, (k, n_values).

    The frames do not show the piston. The wave is turned to that of the first solve of the same frames with a flat
    reference, so that it is a function of the frames.
    """
    k = len(values)
    frames, disc = simulation.frames(screens, values, rng)
    flat = frames.reshape(k, len(simulation.shifts), -1)
    first = simulation.first_look(flat)
    waves, turned = (wave.reshape(k, -1) @ polynomials.inverse for wave in (disc, first))
    waves *= np.exp(-1j * np.angle(np.sum(waves * turned.conj(), axis=1, keepdims=True)))
    kind = Kind.numpy(np.float32)
    constants = _Constants.of(polynomials, simulation.amplitude, flat.shape[1], kind)
    return _inputs(flat, constants), waves.astype(np.complex64)


def _trained(
    sensor: ZernikeSensor, polynomials: _Polynomials, errors: BenchErrors,
    data: tuple[NDArray, NDArray, NDArray], rng: np.random.Generator, report: Callable[[int], None],
) -> Training:  # fmt: skip
    """Train the network on most of the data, and measure on the rest how well it reads the values of a bench."""
    inputs, waves, values = data
    flat, (low, high) = _flat_wave(sensor, polynomials), errors.ranges(sensor.n_masks).T
    free, middle, half = high > low, (low + high) / 2, (high - low) / 2
    scaled = _VALUE_WEIGHT * (values[:, free] - middle[free]) / half[free]
    targets = np.concatenate([waves.real, waves.imag], axis=1) / np.linalg.norm(flat)
    targets = np.concatenate([targets, scaled], axis=1).astype(np.float32)
    n_seen = round((1 - _HELD_OUT) * len(inputs))
    network = _network.train(inputs[:n_seen], targets[:n_seen], _HIDDEN, _N_EPOCHS, rng, report)
    inputs = network.scaled(inputs)
    strength, vectors = np.linalg.eigh(np.cov(inputs, rowvar=False))
    whitening = (vectors / np.sqrt(np.maximum(strength, 1e-4))).astype(np.float32)
    distance = np.sqrt(np.mean((inputs @ whitening) ** 2, axis=1))
    outputs = network(inputs[n_seen:])[:, 2 * len(flat) :] / _VALUE_WEIGHT * half[free] + middle[free]
    slopes, offsets, scatter = np.ones(len(low)), np.zeros(len(low)), np.zeros(len(low))
    for place, read, true in zip(np.flatnonzero(free), outputs.T, values[n_seen:, free].T, strict=True):
        slopes[place], offsets[place] = np.polyfit(true, read, 1)
        scatter[place] = np.std((read - offsets[place]) / slopes[place] - true)
    farthest = _WIDER * float(np.quantile(distance, _FAR))
    return Training(
        network,
        polynomials.order,
        errors,
        _masks_of(sensor),
        flat,
        whitening,
        farthest,
        slopes,
        offsets,
        scatter,
        np.zeros(len(low)),
    )


def _misread(
    training: Training, simulation: Simulation, polynomials: _Polynomials, shapes: NDArray | None,
    rms: float, rng: np.random.Generator,
) -> NDArray[np.float64]:  # fmt: skip
    """Error of the mean of many sets of frames of one random bench, (n_values,), with screens of one kind."""
    values = np.broadcast_to(_drawn(simulation, rng)[0], (_PER_BENCH, simulation.n_values))
    screens = _scaled_screens(simulation.pupil, shapes, np.full(_PER_BENCH, rms), rng, alike=True)
    inputs, _ = _example(simulation, polynomials, screens, values, rng)
    outputs = training.network(training.network.scaled(inputs))
    ranges = training.errors.ranges(len(simulation.shifts))
    return np.mean(_unbiased(training, _values(outputs, training, ranges)), axis=0) - values[0]


def _values(outputs: NDArray, training: Training, ranges: NDArray) -> NDArray[np.float64]:
    """Values of the bench (k, n_values) in outputs of the network; nominal where training did not vary them."""
    low, high = ranges.T
    free = high > low
    values = np.broadcast_to((low + high) / 2, (len(outputs), len(low))).copy()
    values[:, free] += outputs[:, 2 * len(training.flat) :] / _VALUE_WEIGHT * ((high - low) / 2)[free]
    return values


def _unbiased(training: Training, values: NDArray) -> NDArray[np.float64]:
    """Values without the trend towards the middle of the ranges."""
    return (values - training.offsets) / training.slopes


def _inputs(flat: NDArray, constants: _Constants) -> NDArray[np.float32]:
    """Inputs of the network, (k, n_inputs), from frames (k, n_masks, ny * nx)."""
    signal = flat - constants.light
    signal *= constants.root
    inputs = mixed_moments(signal @ constants.means, signal @ signal.swapaxes(1, 2), constants)
    return np.clip(inputs, -_LARGEST_INPUT, _LARGEST_INPUT).astype(np.float32)


def _mixing(values: NDArray, n_masks: int) -> NDArray[np.float64]:
    """Matrices (k, n_masks, n_masks) that undo leakage and unequal light."""
    bench = BenchValues.of(values)
    gains = np.ones((len(values), n_masks))
    gains[:, 1:] = bench.flux_ratio[:, np.newaxis]
    if n_masks != 2:
        return gains[:, :, np.newaxis] * np.eye(n_masks)
    leakage = bench.leakage[:, np.newaxis, np.newaxis]
    return (np.eye(2) - leakage) / (1 - 2 * leakage) * gains[:, np.newaxis]


def _phase(flat: NDArray, disc: NDArray, solve: _Solve, light: NDArray) -> NDArray:
    """Phase (k, ny * nx) of u D, see `_Solve`, from frames (k, n_masks, ny * nx) and waves (k, 2, ny * nx)."""
    real, imag = disc[:, 0], disc[:, 1]
    solved = solve.of_frames @ flat
    solved -= solve.light
    power = (real * real + imag * imag)[:, np.newaxis]
    solved -= solve.of_power * power
    if solve.unseen is not None:
        length = light * power - (solved * solved).sum(axis=1, keepdims=True)
        solved += solve.unseen * np.sqrt(np.maximum(length, 0))
    along, across = solved[:, 0], solved[:, 1]
    return np.arctan2(along * imag + across * real, along * real - across * imag)


def _read(source: Any, name: str) -> Training:
    """Read what `LearnedReference.save` writes."""
    try:
        with np.load(source, allow_pickle=False) as file:
            arrays = {key: np.asarray(file[key], np.float32 if "weight" in key else None) for key in file.files}
        values = json.loads(str(arrays["values"]))
        if values["format"] != _FORMAT:
            raise ValueError(f"format {values['format']}")
        layers = range(values["n_layers"])
        weights, biases = (tuple(arrays[f"{part}{index}"] for index in layers) for part in ("weight", "bias"))
        network = Network(arrays["center"], arrays["scale"], weights, biases, arrays["skip"])
        errors = BenchErrors(**{key: tuple(ends) for key, ends in values["errors"].items()})
        fields_read = {key: arrays[key] for key in Training._fields if key in arrays}
        return Training(
            network=network, order=values["order"], errors=errors, farthest=values["farthest"], **fields_read
        )
    except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{name}: expected a file that LearnedReference.save wrote: {error}") from error
