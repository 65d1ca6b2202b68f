"""Closed loops: any sensor, a mirror of influence functions, and an integrator."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, read_only
from zwfs._images import parts_of
from zwfs.detector import Detector
from zwfs.metrics import strehl, without_piston
from zwfs.pupil import Pupil

_LONGEST_DELAY = 1000  # cycles: beyond it only a gain below 0.0016 is stable


class Mirror(Immutable):
    """Deformable mirror, described by its influence functions.

    The wavefront of commands c is the sum of c times the influence functions. The commands of a wavefront are its
    least-squares fit.

    Parameters
    ----------
    pupil : Pupil
    influence : array_like, shape (n_actuators, ny, nx), radian / command
        Change of the wavefront by each actuator, such as the modes of `zernike_basis`.
    conditioning : float
        Singular values below this times the largest are left out of the fit, in [0, 1).

    Attributes
    ----------
    influence : ndarray, shape (n_actuators, n_points), radian / command
        Influence functions at the points of the pupil.
    inverse : ndarray, shape (n_points, n_actuators)
        Matrix from phases at the points of the pupil to commands.

    Examples
    --------
    >>> import zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> mirror = zwfs.Mirror(pupil, zwfs.zernike_basis(pupil, 5))
    >>> float(mirror.fit(mirror.wavefront([0.1, 0, 0, 0, 0]))[0].round(6))
    0.1
    """

    def __init__(self, pupil: Pupil, influence: ArrayLike, *, conditioning: float = 1e-15) -> None:
        _check.instance("pupil", pupil, Pupil)
        conditioning = _check.number("conditioning", conditioning, 0, 1, open_high=True)
        self.pupil = pupil
        self.influence = _check.modes("influence", influence, pupil)
        self._conditioning = conditioning
        self.inverse = read_only(np.linalg.pinv(self.influence, rcond=conditioning))

    @classmethod
    def segments(cls, pupil: Pupil, *, tilts: bool = True) -> Mirror:
        """Mirror of the segments of a pupil: the piston of each, and its slopes along x and y.

        The commands are all pistons (radian), then all slopes along x, then along y (radian per D).

        Parameters
        ----------
        pupil : Pupil
            With segments, such as `Pupil.hexagonal`. In a measured pupil, segments are the parts between which the
            light falls.
        tilts : bool
            Whether the segments tilt, too.
        """
        _check.instance("pupil", pupil, Pupil)
        tilts = _check.flag("tilts", tilts)
        numbers = (parts_of(pupil.amplitude) if pupil.measured else pupil.segments)[pupil.inside]
        own = (numbers == np.unique(numbers)[:, np.newaxis]).astype(float)
        rows = [own]
        for coordinate in pupil.points.T if tilts else ():
            middle = own @ coordinate / own.sum(axis=1)
            rows.append(own * (coordinate - middle[:, np.newaxis]))
        influence = np.concatenate(rows)
        # A segment of one row or column of points has no slope across it.
        return cls(pupil, pupil.scatter(influence, fill=0), conditioning=1e-10)

    def __repr__(self) -> str:
        return f"Mirror({self.n_actuators} actuators, {self.pupil.n_points} points)"

    @property
    def n_actuators(self) -> int:
        """Number of influence functions."""
        return len(self.influence)

    def wavefront(self, commands: ArrayLike) -> NDArray[np.float64]:
        """Return the wavefront of commands: (..., n_actuators) to (..., ny, nx), radian, 0 outside the pupil."""
        commands = _check.real_array("commands", commands)
        _check.trailing_shape("commands", commands, (self.n_actuators,), "the actuators")
        _check.finite("commands", commands)
        return self.pupil.scatter(commands @ self.influence, fill=0)

    def fit(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Return the commands whose wavefront is nearest to a phase: (..., ny, nx) to (..., n_actuators).

        Points that are NaN take no part.
        """
        phase = _check.real_array("phase", phase)
        _check.maps("phase", phase, self.pupil.shape)
        values = self.pupil.gather(phase)
        good = ~np.isnan(values)
        values = np.where(good, values, 0)
        _check.moderate("phase", values, " inside the pupil")
        commands = values @ self.inverse
        for index in np.argwhere(~good.all(axis=-1)):
            where = good[tuple(index)]
            if np.count_nonzero(where) < self.n_actuators:
                raise ValueError(
                    f"phase has {np.count_nonzero(where)} points that are not NaN: expected at least the "
                    f"{self.n_actuators} actuators"
                )
            inverse = np.linalg.pinv(self.influence[:, where], rcond=self._conditioning)
            commands[tuple(index)] = values[tuple(index)][where] @ inverse
        return commands


@dataclass(frozen=True, eq=False)
class LoopRecord:
    """Record of a closed loop, cycle by cycle.

    Attributes
    ----------
    open_loop : ndarray, shape (n_screens, n_cycles), radian rms
        Disturbance without correction, piston removed.
    residual : ndarray, shape (n_screens, n_cycles), radian rms
        Disturbance less the mirror, not wrapped, piston removed.
    strehl : ndarray, shape (n_screens, n_cycles)
        Of the residual.
    commands : ndarray, shape (n_screens, n_cycles, n_actuators)
        Of the mirror during each cycle.
    electrons : ndarray, shape (n_screens, n_cycles)
        In all frames of a cycle; NaN without a camera.
    """

    open_loop: NDArray[np.float64]
    residual: NDArray[np.float64]
    strehl: NDArray[np.float64]
    commands: NDArray[np.float64]
    electrons: NDArray[np.float64]

    def __post_init__(self) -> None:
        cycles: tuple[int | str, ...] = "n_screens", "n_cycles"
        for name, values in vars(self).items():
            shape = (*cycles, "n_actuators") if name == "commands" else cycles
            _check.array_of(name, values, "real floating", shape)
            cycles = values.shape[:2]
            object.__setattr__(self, name, read_only(values))

    def settled(self, n_cycles: int) -> NDArray[np.float64]:
        """Rms of the residual over the last cycles, shape (n_screens,), radian rms."""
        n_cycles = _check.integer("n_cycles", n_cycles, 1, self.residual.shape[1])
        return np.sqrt(np.mean(self.residual[:, -n_cycles:] ** 2, axis=1))


def close_loop(
    plant: Any,
    mirror: Mirror,
    reconstructor: Any,
    disturbance: Iterable[ArrayLike],
    *,
    gain: float = 0.5,
    leak: float = 0.0,
    delay: int = 1,
    stroke: float | None = None,
    camera: Detector | None = None,
    seed: int | np.random.Generator | np.random.SeedSequence | None = None,
) -> LoopRecord:
    """Correct a sequence of wavefronts with an integrator that a sensor feeds.

    In each cycle the plant measures the disturbance less the mirror. The reconstructed phase, its piston removed
    on the circle, is fitted by the mirror. The integrator adds `gain` times that to (1 - leak) times its last
    shape, and the mirror takes the new shape `delay` cycles later. Frames without a photon add nothing.

    Parameters
    ----------
    plant : object with `measure`
        The true sensor: `measure(phase)` returns frames, as that of `ZernikeSensor` and `PolychromaticSensor`. It
        may have leakage, static errors or other masks that the reconstructor does not know.
    mirror : Mirror
    reconstructor : reconstructor
        On the pupil of the mirror.
    disturbance : iterable of array_like, shape (n_screens, ny, nx) or (ny, nx), radian
        Wavefront in each cycle: an array with the cycles first, or a generator. Screens are corrected side by
        side.
    gain : float
        In (0, 2). If the estimate is correct, the loop is stable below 2 with a delay of 1, and below 1 with one
        of 2.
    leak : float
        Share of the shape that the integrator loses in each cycle, in [0, 1).
    delay : int, cycles
        From a measurement to its correction, from 1 to 1000.
    stroke : float, radian rms, optional
        Largest shape of the mirror, at least 1e-12; one beyond it is scaled down to it. Any shape if left out.
    camera : Detector, optional
        Its noise is added to all frames; no noise if left out.
    seed : int, Generator or SeedSequence, optional
        Of the noise.

    Returns
    -------
    LoopRecord

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    >>> modes = zwfs.zernike_basis(pupil, 20)
    >>> still = np.repeat(0.3 * modes[np.newaxis, 3:4], 10, axis=0)  # 10 cycles of one screen
    >>> record = zwfs.close_loop(sensor, zwfs.Mirror(pupil, modes), zwfs.PhaseShifted(sensor), still)
    >>> record.residual[0, [0, 1, 9]].round(4).tolist()
    [0.3, 0.15, 0.0006]
    """
    pupil = _check.sensor_of("reconstructor", reconstructor).pupil
    _check.instance("mirror", mirror, Mirror)
    if not callable(getattr(plant, "measure", None)):
        raise TypeError(f"plant is a {type(plant).__name__}: expected an object with measure(phase)")
    if mirror.pupil.shape != pupil.shape or np.any(mirror.pupil.inside != pupil.inside):
        raise ValueError(
            f"mirror has {_check.shown(mirror.pupil)}: expected that of the reconstructor, {_check.shown(pupil)}"
        )
    gain = _check.number("gain", gain, 0, 2, open_low=True, open_high=True)
    leak = _check.number("leak", leak, 0, 1, open_high=True)
    delay = _check.integer("delay", delay, 1, _LONGEST_DELAY)
    stroke = math.inf if stroke is None else _check.number("stroke", stroke, 1e-12)
    if camera is not None:
        _check.instance("camera", camera, Detector)
    rng = _check.generator("seed", seed)
    # Figures of the mirror at the points of the pupil, and their commands: that in use first, the newest last.
    figures: deque[tuple[NDArray, NDArray]] = deque()
    rows = []
    for screens in _checked_screens(disturbance, pupil):
        if not figures:
            n = len(screens)
            figures.extend([(np.zeros((n, pupil.n_points)), np.zeros((n, mirror.n_actuators)))] * delay)
        figure, commands = figures[0]
        residual = pupil.scatter(screens - figure, fill=0)
        frames, electrons = plant.measure(residual), np.full(len(screens), np.nan)
        if camera is not None:
            counts = camera.expose(frames, rng)
            electrons = counts.sum(axis=(-3, -2, -1))
            frames = camera.normalise(counts)
        rows.append((screens.std(axis=-1), pupil.rms(residual), strehl(pupil, residual), commands, electrons))
        measured = np.zeros(screens.shape)
        # A frame without a photon holds no information: the mirror keeps its shape.
        lit = (frames.max(axis=(-2, -1)) > 0).all(axis=-1)
        if lit.any():
            measured[lit] = without_piston(pupil.gather(reconstructor(frames[lit]).phase))
        step, (figure, commands) = gain * (measured @ mirror.inverse), figures[-1]
        figure = (1 - leak) * figure + step @ mirror.influence
        excess = np.maximum(figure.std(axis=-1, keepdims=True) / stroke, 1)
        figures.append((figure / excess, ((1 - leak) * commands + step) / excess))
        figures.popleft()
    names = "open_loop", "residual", "strehl", "commands", "electrons"
    columns = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
    return LoopRecord(**dict(zip(names, columns, strict=True)))


def _checked_screens(disturbance: Any, pupil: Pupil) -> Iterator[NDArray[np.float64]]:
    """Disturbances at the points of the pupil, (n_screens, n_points), of one shape."""
    shape = None
    for index, maps in enumerate(_check.items("disturbance", disturbance, "one wavefront for each cycle")):
        name = f"disturbance[{index}]"
        screens = np.atleast_2d(_check.values_inside(name, maps, pupil).astype(np.float64))
        shape = shape or screens.shape
        if screens.shape != shape or screens.ndim != 2:
            raise ValueError(
                f"{name} has shape {np.shape(maps)}: expected (n_screens, ny, nx) or (ny, nx), as the first one"
            )
        yield screens
    if shape is None:
        raise ValueError("disturbance is empty: expected one wavefront for each cycle")
