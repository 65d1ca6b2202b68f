"""Closed loops: any sensor, a mirror of influence functions, an integrator, and the drift that a loop holds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._arrays import Immutable, read_only
from zwfs._results import Result
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.metrics import strehl, without_piston
from zwfs.polychromatic import PolychromaticSensor
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

_LONGEST_DELAY = 1000  # cycles: beyond it only a gain below 0.0016 is stable
_FASTEST = 1e12  # pm / cycle: a metre
_LOWEST_GAIN = 1e-9
_GAPS = 0.0, 0.5, 0.7, 0.8, 0.9, 0.95  # amplitude of gaps over that of their surroundings
_BRIDGES = 0, 1, 2  # points by which parts shrink while they are counted
_LEAST_PART = 0.2  # points of a part, over those of the largest
_ALIKE = 0.35  # standard deviation of the sizes of parts, over their mean


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
    def gaussian(
        cls, pupil: Pupil, n_actuators: int, *, coupling: float = 0.3, conditioning: float = 1e-3
    ) -> Mirror:
        """Mirror of Gaussian influence functions on a square grid, cut to a circle.

        The outermost actuators of the middle rows stand on the rim of the circle of diameter D, or half a pitch
        from the axis of an even grid.

        Parameters
        ----------
        pupil : Pupil
        n_actuators : int
            A number of points of the grid within a circle: 4, 5, 9, 12, ..., 97 for 11 across, ...
        coupling : float
            Influence at the neighbouring actuator, in (0, 1).
        conditioning : float
            Singular values below this times the largest are left out of the fit, in [0, 1).

        Raises
        ------
        ValueError
            If no circle holds so many actuators.
        """
        _check.instance("pupil", pupil, Pupil)
        n_actuators = _check.integer("n_actuators", n_actuators, 4, pupil.n_points)
        _check.count("n_actuators", n_actuators, 2 * pupil.n_points)
        coupling = _check.number("coupling", coupling, 0, 1, open_low=True, open_high=True)
        places = _actuators(n_actuators)
        pitch = 0.5 / np.abs(places).max()
        square = (pupil.points[:, np.newaxis] - pitch * places) ** 2 / pitch**2
        influence = np.exp(math.log(coupling) * square.sum(axis=-1)).T
        return cls(pupil, pupil.scatter(influence, fill=0), conditioning=conditioning)

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
        numbers = (_parts(pupil) if pupil.measured else pupil.segments)[pupil.inside]
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
    photons : ndarray, shape (n_screens, n_cycles)
        Electrons in all frames of a cycle; NaN without a camera.
    """

    open_loop: NDArray[np.float64]
    residual: NDArray[np.float64]
    strehl: NDArray[np.float64]
    commands: NDArray[np.float64]
    photons: NDArray[np.float64]

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
        left = pupil.scatter(screens - figure, fill=0)
        frames, photons = plant.measure(left), np.full(len(screens), np.nan)
        if camera is not None:
            counts = camera.expose(frames, rng)
            photons = counts.sum(axis=(-3, -2, -1)) * (camera.gain or 1.0)
            frames = camera.normalise(counts)
        rows.append((screens.std(axis=-1), pupil.rms(left), strehl(pupil, left), commands, photons))
        found = np.zeros(screens.shape)
        # A frame without a photon holds no information: the mirror keeps its shape.
        seen = (frames.max(axis=(-2, -1)) > 0).all(axis=-1)
        if seen.any():
            found[seen] = without_piston(pupil.gather(reconstructor(frames[seen]).phase))
        step, (figure, commands) = gain * (found @ mirror.inverse), figures[-1]
        figure = (1 - leak) * figure + step @ mirror.influence
        excess = np.maximum(figure.std(axis=-1, keepdims=True) / stroke, 1)
        figures.append((figure / excess, ((1 - leak) * commands + step) / excess))
        figures.popleft()
    return LoopRecord(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))


@dataclass(frozen=True, eq=False, repr=False)
class HeldDrift(Result):
    """Residual of an integrator that holds a drift, per mode: see `hold_drift`.

    Attributes
    ----------
    gain : ndarray, shape (n_modes,)
    lag : ndarray, shape (n_modes,), pm rms
        Share of the drift.
    noise : ndarray, shape (n_modes,), pm rms
        Share of the photon noise.
    """

    panels = (("gain", "gain"), ("lag", "lag (pm rms)"), ("noise", "noise (pm rms)"))
    gain: NDArray[np.float64]
    lag: NDArray[np.float64]
    noise: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape: tuple[int | str, ...] = ("n_modes",)
        for name, values in vars(self).items():
            _check.array_of(name, values, "real floating", shape)
            shape = values.shape

    @property
    def residual(self) -> float:
        """Rms of the wavefront, all modes together, pm."""
        return float(np.sqrt(np.sum(self.lag**2 + self.noise**2)))


def hold_drift(
    sensor: ZernikeSensor | PolychromaticSensor,
    modes: ArrayLike,
    *,
    drift: float,
    photons: float,
    wavelength: float,
    speed: float = 0.0,
    gain: float | None = None,
    phase: ArrayLike | None = None,
) -> HeldDrift:
    """Return the residual at which an integrator holds a drift, as in the maintenance of a dark zone.

    In each cycle every mode moves by a random step of rms w and by a constant step v. The sensor measures the
    residual r with an error of rms s, the Cramer-Rao bound of `cramer_rao` for the photons of one cycle, and the
    mirror corrects g times that in the next cycle: r' = (1 - g) r + step - g error. The steady state has

        mean square of r = (v / g)^2 + w^2 / (g (2 - g)) + g s^2 / (2 - g).

    The first two terms are the lag, the last one is the noise. Without a constant drift the best gain solves
    g^2 + q g - q = 0 with q = w^2 / s^2. The residual is then the smallest of all integrators on this sensor: no
    unbiased reconstruction of the frames of one cycle has an error below the bound. The modes are taken to be
    independent, and the mirror to make exactly these modes.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
    modes : array_like, shape (n_modes, ny, nx)
        Modes that drift, of unit rms to 1 % and nearly orthogonal, as those of `zernike_basis`.
    drift : float, pm rms / cycle
        Random step of the wavefront, all modes together, divided equally among them; at most 1e12, a metre.
    photons : float, photons / cycle
        Detected within the pupil with the mask out, divided equally among the masks.
    wavelength : float, nm
        At which the phase is in radian: that of the sensor, or its reference wavelength.
    speed : float, pm rms / cycle
        Constant step of the wavefront, divided equally among the modes; at most 1e12.
    gain : float, optional
        In [1e-9, 2), the same for all modes. If left out, the one that is best for the random drift of each mode.
    phase : array_like, shape (ny, nx), radian, optional
        Static wavefront around which the loop works; flat if left out.

    Returns
    -------
    HeldDrift

    Raises
    ------
    ValueError
        If there is neither a gain nor a random drift.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    >>> held = zwfs.hold_drift(sensor, zwfs.zernike_basis(pupil, 20), drift=5.0, photons=1e9, wavelength=635.0)
    >>> round(held.residual, 1)  # pm rms
    8.4
    """
    _check.instance("sensor", sensor, ZernikeSensor, PolychromaticSensor)
    rms = _check.modes("modes", modes, sensor.pupil).std(axis=1)
    if np.abs(rms - 1).max() > 0.01:
        raise ValueError(f"modes have an rms from {rms.min():.3g} to {rms.max():.3g}: expected unit rms")
    drift = _check.number("drift", drift, 0, _FASTEST)
    photons = _check.number("photons", photons, 1e-6)
    wavelength = _check.wavelength(wavelength)
    speed = _check.number("speed", speed, 0, _FASTEST)
    if gain is None and not drift:
        raise ValueError("gain = None: expected a gain, since drift = 0 has no best one")
    around = np.zeros(sensor.pupil.shape) if phase is None else _check.map_inside("phase", phase, sensor.pupil)
    per_point = photons / (sensor.n_masks * sensor.pupil.n_points)
    sigma = cramer_rao(sensor, around, photons=per_point, modes=modes) * (1e3 * wavelength / (2 * np.pi))
    step, constant = drift / math.sqrt(sigma.size), speed / math.sqrt(sigma.size)
    if gain is None:
        gains = _best_gains(step, sigma)
        if gains.min() < _LOWEST_GAIN:
            raise ValueError(f"drift = {drift:g}: expected more or a gain, as its best one is {gains.min():.1g}")
    else:
        gains = np.full(sigma.size, _check.number("gain", gain, _LOWEST_GAIN, 2, open_high=True))
    lag = np.sqrt((constant / gains) ** 2 + step**2 / (gains * (2 - gains)))
    return HeldDrift(gains, lag, sigma * np.sqrt(gains / (2 - gains)))


def _best_gains(step: float, noise: ArrayLike) -> NDArray[np.float64]:
    """Gain of the smallest residual: g^2 + q g - q = 0, where q is the step over the noise, both squared."""
    return 2 * step / (step + np.hypot(step, 2 * np.asarray(noise)))


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


def _parts(pupil: Pupil) -> NDArray[np.intp]:
    """Number of the part of a measured pupil that each point belongs to, from 1 on; 0 outside.

    A gap is where the amplitude is less than a share of that of its surroundings; an erosion cuts bridges across
    it. Of several shares and erosions, those count that make the most parts of similar sizes. Points of gaps go to
    the nearest part.
    """
    around, most = ndimage.median_filter(pupil.amplitude, 5), 1
    best = pupil.inside.astype(int)
    for share, cut in product(_GAPS, _BRIDGES):
        bright = pupil.inside & (pupil.amplitude > share * around)
        parts, n = ndimage.label(ndimage.binary_erosion(bright, iterations=cut) if cut else bright)
        sizes = np.bincount(parts.ravel(), minlength=n + 1)
        large = (sizes > _LEAST_PART * sizes[1:].max(initial=0)) & (np.arange(n + 1) > 0)
        if np.count_nonzero(large) <= most:
            continue
        numbers = np.where(large, np.cumsum(large), 0)[parts]
        nearest = ndimage.distance_transform_edt(numbers == 0, return_distances=False, return_indices=True)
        grown = np.where(pupil.inside, numbers[tuple(nearest)], 0)
        sizes = np.bincount(grown.ravel())[1:]
        if sizes.min() > _LEAST_PART * sizes.max() and sizes.std() < _ALIKE * sizes.mean():
            best, most = grown, len(sizes)
    return best


def _actuators(n_actuators: int) -> NDArray[np.float64]:
    """Points of a square grid of pitch 1 within a circle, (n_actuators, 2)."""
    counts = []
    for offset in (0.0, 0.5):
        half = np.arange(math.isqrt(n_actuators) + 2) + offset
        line = np.unique(np.concatenate([-half, half]))
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        radius = (points**2).sum(axis=1).round(6)
        for limit in np.unique(radius):
            inside = radius <= limit
            counts.append(int(inside.sum()))
            if counts[-1] == n_actuators:
                return points[inside]
    near = sorted(set(counts), key=lambda count: abs(count - n_actuators))[:2]
    raise ValueError(f"n_actuators = {n_actuators}: expected a number of grid points in a circle, such as {near}")
