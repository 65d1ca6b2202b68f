"""Optics of a bench from frames of a mirror in known states."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import radius, turning
from zwfs._results import Result
from zwfs.frames._light import Light
from zwfs.frames._optics import ARM, MASKS, Camera, Exposure, Linearised, named, names_of
from zwfs.frames._solver import (
    MISSED,
    Eliminated,
    Free,
    LightMap,
    MapPrior,
    PhaseMap,
    Point,
    Problem,
    allowing,
    fine_phase,
    minimise,
)
from zwfs.frames._states import PAD, Recording, aligned, centred
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

EXPLAINED = 1.2
"""Mean square of the residuals over the noise up to which a model explains the frames."""
_WEAK = 0.02  # radian rms, of commands: from weaker ones the fit learns little of the bench
_FARTHEST = 3e-3  # D^2 / lambda: with more defocus the model's grid would be too small
_PHASE_PRIOR = MapPrior(0.5, 3.0)
_LEAST_FOCUS = 2e-4  # D^2 / lambda, where a fit starts with another sign of the focus
_WRONG = 3.0  # misfit of a wrong sign of the focus, over that of noise, at least
_DIVIDED = 0.1  # rms error of the light of a point that an edge or a vane divides, over that of a full one
_PIXEL = 1 / 12  # pixels squared: variance of the area of a pixel; f points along it lack 1 / f^2 of it
# Errors in frames of HCIPy of which a finer grid shows too little: with a blur (radian, D^2 / lambda), and without
# (pixels, radian, 1), where light that changes within a pixel aliases.
_BLURRED = {"phase shift": 3e-4, "focus": 5e-6}
_SHARP = {"row": 1.2e-3, "column": 1.2e-3, "rotation": 2e-4, "magnification": 4e-5}
_PHYSICAL = "leakage", "blur"  # the lower limit of these numbers is that of the physics
_MOST = 1e9  # of a number that replaces an estimate
_N_NUMBERS = 4 * len(ARM) + len(MASKS)  # arms of the frames behind the masks, and of the clear frames
# Fields of a fit and of its model, as they are saved.
_PLAIN_OF_FIT = "noise", "gain", "converged", "remarks"
_MAPS_OF_FIT = "covariance", "flat", "light", "misfit"
_PLAIN_OF_MODEL = "shape", "n_pixels", "oversampling", "largest", "places"
_DIAMETERS = (0.8, 0.9, 1.0, 1.1, 1.25)  # of the coarse grid, over that of the design


class _Stage(NamedTuple):
    allowed: float  # error of the model that adds to the noise, over the light of a full pixel
    enough: float  # of the cost: the stage ends when a step promises less
    n_inner: int  # iterations for a step
    focus: bool  # whether the focus is free
    divide: bool  # whether the light is divided anew after it
    signs: bool = False  # whether other signs of the focus are tried if it does not explain the frames


# With a large error allowed, edges have little weight, and the numbers find their places in a few steps. A focus
# that is free from the start can take the wrong sign; on sharp images it can take it later, too.
_STAGES = (
    _Stage(0.1, 0.1, 25, focus=False, divide=False),
    _Stage(0.05, 0.1, 25, focus=True, divide=True, signs=True),
    _Stage(0.01, 0.1, 35, focus=True, divide=True),
    _Stage(0.0, 4e-3, 25, focus=True, divide=False),
)


@dataclass(frozen=True)
class Estimate:
    """Value of a number of the bench.

    Attributes
    ----------
    name : str
    value : float
    sigma : float
        One standard deviation, with the maps and all other numbers free. It grows with the root of the misfit, and
        includes what the model misses, as far as a finer grid or frames of HCIPy show it.
    at_limit : bool
        Whether the value is one of its limits, so that the error bar does not hold.
    """

    name: str
    value: float
    sigma: float
    at_limit: bool

    def __post_init__(self) -> None:
        _check.declared(self)


@dataclass(frozen=True, eq=False)
class FrameModel:
    """All that predicts the frames of a fitted bench."""

    shape: tuple[int, int]  # of a frame
    n_pixels: float  # of D
    oversampling: int
    largest: float  # lambda/D: the grids are made for dimples up to it
    light: Light  # fitted, on the fine grid
    values: NDArray[np.float64]  # all numbers, see `names_of`
    places: dict[str, list[int]]  # those of an estimate among the values

    def __post_init__(self) -> None:
        _check.declared(self)
        for name, low, high in (("n_pixels", 1, 1e4), ("oversampling", 1, 8), ("largest", 1e-3, 1e4)):
            _check.number(name, getattr(self, name), low, high)
        side, maps = self.n * self.oversampling, vars(self.light)
        for name, array in {**maps, "values": self.values}.items():
            size = (side, side) if name in maps else (_N_NUMBERS,)
            if array.shape != size:
                raise ValueError(f"{name} has shape {array.shape}: expected {size}")
            _check.finite(name, array)

    @property
    def n(self) -> int:
        """Pixels along the maps."""
        return len(self.light.start) // self.oversampling

    @property
    def arms(self) -> list[dict[str, float]]:
        """Numbers of the two arms behind a mask."""
        return named(self.values)[0][:2]

    @property
    def masks(self) -> dict[str, float]:
        return named(self.values)[1]


@dataclass(frozen=True, eq=False, repr=False)
class BenchFit(Result):
    """Fit of a bench to known commands, which `Calibration.fit` makes.

    Attributes
    ----------
    estimates : tuple of Estimate
        Of "diameter" (lambda/D), "first" and "second" (phase shifts, radian), "leakage", "unmasked" (share of
        light that no mask shifts), "blur" (pixels rms), and for each arm, as in "arm 0 focus": focus
        (D^2 / lambda), row and column (pixels), rotation (radian, from x to y), magnification, flux and background
        (counts). The arms 0 and 1 are the frames behind the masks, 2 and 3 the clear frames, which share focus,
        rotation and magnification with them. The flux of arm 2 is fixed.
    covariance : ndarray, shape (n_estimates, n_estimates)
    flat : ndarray, shape (n, n), radian
        Phase of the optics without a command, mean over each pixel.
    light : ndarray, shape (n, n)
        Light of each pixel of the pupil, 1 = mean of the first clear frame.
    misfit : ndarray, shape (2 + 2 n_states,)
        Mean square of the residuals over the noise, over all pixels: of the clear frames, then of each pair.
    noise, gain : float, counts rms and electrons / count
        Noise of a pixel without light, as given or as estimated, and the gain as given.
    converged : bool
        Whether the last step of the estimates, which the maps follow, promised to lower half the sum of squares by
        less than 0.7.
    remarks : tuple of str
        What does not fit together, in words.
    """

    panels = (
        ("flat", "phase without a command (rad)"),
        ("light", "light, 1 = mean"),
        ("misfit", "misfit of each image"),
    )
    estimates: tuple[Estimate, ...]
    covariance: NDArray[np.float64]
    flat: NDArray[np.float64]
    light: NDArray[np.float64]
    misfit: NDArray[np.float64]
    noise: float
    gain: float
    converged: bool
    remarks: tuple[str, ...]
    model: FrameModel

    @property
    def consistent(self) -> bool:
        """Whether the model explains all images within their noise."""
        return bool(np.mean(self.misfit) < EXPLAINED and not self.remarks)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Error bars of the estimates, (n_estimates,)."""
        return np.sqrt(np.diagonal(self.covariance))

    def replaced(self, values: Mapping[str, float]) -> BenchFit:
        """Return the fit with other values of some numbers, such as those of a design; the maps stay.

        Misfit, error bars and remarks are those of the fit, not of the values.

        Parameters
        ----------
        values : mapping of str to float
            By the names of `estimates`, in their units.

        Raises
        ------
        TypeError, ValueError
            If no estimate has a name, or a value is not a number within 1e9.
        """
        _check.instance("values", values, Mapping)
        numbers = self.model.values.copy()
        for name, value in values.items():
            _check.choice("values", name, self.model.places)
            numbers[self.model.places[name]] = _check.number(name, value, -_MOST, _MOST)
        estimates = (replace(old, value=float(values.get(old.name, old.value))) for old in self.estimates)
        return replace(self, estimates=tuple(estimates), model=replace(self.model, values=numbers))

    def _values(self) -> Iterator[tuple[str, bool | int | float | str]]:
        return (pair for pair in super()._values() if not pair[0].startswith("model "))

    def packed(self) -> tuple[dict[str, Any], dict[str, NDArray]]:
        """Plain values and arrays, from which `unpacked` makes the fit again."""
        values = {name: getattr(self, name) for name in _PLAIN_OF_FIT}
        values |= {name: getattr(self.model, name) for name in _PLAIN_OF_MODEL}
        values["estimates"] = [astuple(estimate) for estimate in self.estimates]
        arrays = {name: getattr(self, name) for name in _MAPS_OF_FIT}
        light = {f"light_{name}": array for name, array in vars(self.model.light).items()}
        return values, arrays | light | {"values": self.model.values}

    @classmethod
    def unpacked(cls, values: dict[str, Any], arrays: dict[str, NDArray]) -> BenchFit:
        """Fit from its plain values and arrays."""
        light = Light(**{name: arrays[f"light_{name}"] for name in Light.__dataclass_fields__})
        settings = {name: values[name] for name in _PLAIN_OF_MODEL} | {"shape": tuple(values["shape"])}
        plain = {name: values[name] for name in _PLAIN_OF_FIT} | {"remarks": tuple(values["remarks"])}
        estimates = tuple(Estimate(*fields) for fields in values["estimates"])
        maps: Any = {name: arrays[name] for name in _MAPS_OF_FIT}
        return cls(estimates, **maps, **plain, model=FrameModel(**settings, light=light, values=arrays["values"]))

    def __getitem__(self, name: str) -> Estimate:
        """Estimate of a name."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(f"{name!r}: expected one of {[estimate.name for estimate in self.estimates]}")


def places_of(arms: Sequence[Mapping[str, float]], n: int, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Row and column of each of the n x n pixels of the maps on a frame behind each arm, (n_arms, 2, n, n)."""
    grid = np.indices((n, n)) - (n - 1) / 2
    places = []
    for arm in arms:
        middle = np.array([arm["row"], arm["column"]]) + (np.array(shape) - 1) / 2
        turned = np.einsum("ij,jyx->iyx", turning(np.degrees(arm["rotation"]), arm["magnification"]), grid)
        places.append(turned + middle[:, None, None])
    return np.stack(places)


def fit_bench(
    frames: ArrayLike,
    clear_frames: ArrayLike,
    phases: ArrayLike,
    *,
    n_pixels: float,
    noise: float | None = None,
    gain: float = 1.0,
    diameter: float = 1.06,
    phase_shifts: tuple[float, float] = (np.pi / 2, -np.pi / 2),
    oversampling: int | None = None,
    n_steps: int = 15,
    progress: Callable[[str], Any] | None = None,
) -> BenchFit:
    """Fit a model of the optics to frames of a mirror in known states, see `Calibration.fit`.

    Maps of phase and light and all numbers are the unknowns of one least-squares problem. The place of the maps is
    that of the known phases. The flux of the first clear frame is fixed: it defines the map of the light.
    """
    data = Recording.of(frames, clear_frames, phases, n_pixels, noise, gain)
    diameter = _check.number("diameter", diameter, 0, data.n_pixels, open_low=True)
    shifts = _check.pair("phase_shifts", phase_shifts, _check.number)
    if oversampling is not None:
        oversampling = _check.integer("oversampling", oversampling, 1, 8)
    n_steps = _check.integer("n_steps", n_steps, 1)
    report = _check.callback("progress", progress)
    report("dimple and order of the images")
    start = _coarse(data, diameter, shifts)
    fitted = _fitted(data, *_problem(data, start, oversampling or 2), range(len(_STAGES)), n_steps, report)
    if oversampling is None and np.mean(fitted[0].misfit) > 1:
        fitted = _fitted(data, *_divided(data, fitted[0], 3), range(1, len(_STAGES)), n_steps, report)
    report("error bars")
    return _result(data, *fitted, start.reversed)


class _Start(NamedTuple):
    diameter: float
    shifts: tuple[float, float]
    flat: NDArray[np.float64]
    reversed: bool


def _coarse(data: Recording, diameter: float, shifts: tuple[float, float]) -> _Start:
    """Diameter and order that explain the frames best, with one flat for all states."""
    light, flux = data.light
    n = len(light)
    stop = radius((n, n), ((n - 1) / 2,) * 2) <= data.n_pixels / 2 + 1
    pupil = Pupil.from_amplitude(np.sqrt(light) * stop, data.n_pixels, threshold=0.3)
    inside = pupil.inside
    scale = flux * np.mean(light[inside])
    frames = np.stack([centred(image, n) for image in data.counts[2:]]).reshape(-1, 2, n, n) / scale[:, None, None]
    starts: list[tuple[float, _Start]] = []
    for order in (False, True):
        pair = shifts[::-1] if order else shifts
        for factor in _DIAMETERS:
            sensor = ZernikeSensor(pupil, *(Dimple(factor * diameter, shift) for shift in pair), tolerance=1e-4)
            phase = PhaseShifted(sensor, n_iterations=15)(np.maximum(frames, 0)).phase
            waves = aligned(np.where(inside, np.exp(1j * (np.nan_to_num(phase) - data.phases)), 0))
            flat = np.angle(ndimage.gaussian_filter(waves.mean(axis=0), 1.0))
            misfit = float(np.mean((sensor.measure(flat + data.phases) - frames)[..., inside] ** 2))
            starts.append((misfit, _Start(factor * diameter, pair, np.where(inside, flat, 0), order)))
    return min(starts, key=lambda start: start[0])[1]


def _free(data: Recording, start: _Start) -> list[Free]:
    """Numbers that are free, and where they start; a stage limits the focus."""
    _, flux = data.light
    free = []
    for side in (0, 1):
        shared = {"focus": (0.0,), "rotation": (0.0, -0.3, 0.3, 0.05), "magnification": (1.0, 0.7, 1.4, 0.05)}
        free += [
            Free(f"arm {side} {name}", ((side, name), (side + 2, name)), *limits)
            for name, limits in shared.items()
        ]
        for arm in (side, side + 2):
            names = {
                "row": (0.0, -6.0, 6.0),
                "column": (0.0, -6.0, 6.0),
                "background": (0.0,),
                "flux": (flux[side], 0.0),
            }
            free += [
                Free(f"arm {arm} {name}", ((arm, name),), *limits)
                for name, limits in names.items()
                if (arm, name) != (2, "flux")
            ]
    limits = {
        "diameter": (start.diameter, 0.4 * start.diameter, 1.8 * start.diameter),
        "first": (start.shifts[0],),
        "second": (start.shifts[1],),
        "leakage": (0.01, 0.0, 0.45),
        # Two phase shifts, leakage and this share are hardly told apart: its prior decides their error bars. Noise
        # may bring it below 0, where a limit would stop the fit.
        "unmasked": (0.0, -0.2, 0.45, 0.03),
        "blur": (0.5, 0.02, 5.0),
    }
    return free + [Free(name, ((None, name),), *values) for name, values in limits.items()]


def _problem(data: Recording, start: _Start, f: int) -> tuple[Problem, NDArray]:
    """Return the first problem of a fit, and its start."""
    light, flux = data.light
    n, shape = len(light), data.counts[0].shape
    exposures = [Exposure(2, None, 0), Exposure(3, None, 0)]
    exposures += [Exposure(side, side, state) for state in range(len(data.phases)) for side in (0, 1)]
    camera = Camera(n, shape, data.n_pixels, exposures, fine_phase(data.phases, f), f, 1.9 * start.diameter)
    values = np.zeros(_N_NUMBERS)
    values[names_of(_N_NUMBERS).index("arm 2 flux")] = flux[0]  # the only number that is not free
    division = Light.sharp(light, f)
    smooth = [ndimage.uniform_filter(image, 3) for image in data.counts]
    free = _free(data, start)
    phase_map = PhaseMap(n, f, _PHASE_PRIOR, data.n_pixels)
    lights = _light_maps(division, f * data.n_pixels)
    images = np.array(data.counts), data.weights(np.array(smooth))
    problem = Problem(camera, *images, division, phase_map, lights, values, free)
    x = problem.start
    x[: phase_map.size**2] = phase_map.white(start.flat)
    return problem, x


def _light_maps(light: Light, n_pixels: float) -> tuple[LightMap, ...]:
    """Smooth changes of the light, and free ones of the points that edges and vanes divide."""
    smooth = LightMap(light.support, MapPrior(0.2, 3.0, outer_scale=0.1), n_pixels)
    return smooth, LightMap(light.support & ~light.full, MapPrior(_DIVIDED), n_pixels)


def _fitted(
    data: Recording, problem: Problem, x: NDArray, numbers: range, n_steps: int,
    report: Callable[[str], Any],
) -> tuple[Point, bool]:  # fmt: skip
    """Return the point at which these stages of a fit end, and whether the last one has converged."""
    for number in numbers:
        stage = _STAGES[number]
        staged = _staged(data, problem, stage)
        if not stage.allowed:  # with the true noise, steps need to know how the maps follow
            staged = replace(staged, following=Eliminated(Point(staged, x)))
        name = f"stage {number + 1} of {len(_STAGES)}, {problem.camera.f} points along a pixel, step"
        settings: Any = n_steps, stage.n_inner, stage.enough, lambda step, name=name: report(f"{name} {step}")
        point, converged = minimise(staged, x, *settings)
        if stage.signs and np.mean(point.misfit) > _WRONG * _expected(problem, staged):
            others = [minimise(staged, start, *settings)[0] for start in _other_signs(point)]
            point = min(point, *others, key=lambda end: end.cost)
        if stage.divide:
            problem, x = _divided(data, point, problem.camera.f)
        else:
            problem, x = replace(point.problem, weights=data.weights(point.model.images)), point.x
    return point, converged


def _expected(problem: Problem, staged: Problem) -> float:
    """Return the misfit of noise alone, with the error that a stage allows."""
    pairs = zip(problem.weights, staged.weights, strict=True)
    return float(np.mean([np.mean((few[many > 0] / many[many > 0]) ** 2) for many, few in pairs]))


def _other_signs(point: Point) -> list[NDArray[np.float64]]:
    """Return the unknowns of a point with all other signs of the focus in the two arms."""
    focus = [point.problem.n_white + k for k, free in enumerate(point.problem.free) if free.name.endswith("focus")]
    signed = np.copysign(np.maximum(np.abs(point.x[focus]), _LEAST_FOCUS), point.x[focus])
    starts = np.repeat(point.x[None], 3, axis=0)
    starts[:, focus] = signed * [(-1, -1), (-1, 1), (1, -1)]
    return list(starts)


def _staged(data: Recording, problem: Problem, stage: _Stage) -> Problem:
    """Return the problem with the noise and the free numbers of a stage."""
    farthest = _FARTHEST if stage.focus else 0.0
    free = [
        number._replace(low=-farthest, high=farthest) if number.name.endswith("focus") else number
        for number in problem.free
    ]
    level = stage.allowed * data.light[1][0]
    return replace(problem, weights=allowing(problem.weights, level), free=free)


def _divided(data: Recording, point: Point, f: int) -> tuple[Problem, NDArray]:
    """Return the next problem and its start, with the light divided anew into f points along a pixel."""
    before, light = point.problem, Light.sharp(np.maximum(point.light_means, 0), f)
    problem = replace(
        before,
        camera=_camera(data, before.camera, f),
        weights=data.weights(point.model.images),
        light=light,
        following=None,
        phase_map=PhaseMap(before.camera.n, f, _PHASE_PRIOR, data.n_pixels),
        light_maps=_light_maps(light, f * data.n_pixels),
    )
    x, n_phase = problem.start, problem.phase_map.size**2
    x[:n_phase], x[problem.n_white :] = point.x[:n_phase], point.x[before.n_white :]
    return problem, x


def _camera(data: Recording, of: Camera, f: int) -> Camera:
    """Return a camera with f points along a pixel."""
    if f == of.f:
        return of
    return Camera(of.n, of.shape, data.n_pixels, of.exposures, fine_phase(data.phases, f), f, of.largest)


def _changes(data: Recording, point: Point) -> NDArray[np.float64]:
    """Changes of the images over their noise with twice the resolution.

    First, the light is divided anew. Second, each point keeps its light, and is divided as an edge divides it.
    """
    of, f = point.problem, 2 * point.problem.camera.f
    finer, twice = _camera(data, of.camera, f), np.ones((2, 2))
    light = Light.sharp(np.maximum(point.light_means, 0), f)
    # Halfway between the amplitude of the fit and a new one, of which it is not known which is better.
    light = replace(light, amplitude=(np.kron(of.light.amplitude, twice) + light.amplitude) / 2)
    n = len(point.light)
    sharp = np.kron(light.start.reshape(n, 2, n, 2).mean(axis=(1, 3)), twice)
    share = np.divide(light.start, sharp, out=np.ones_like(sharp), where=sharp > 1e-6)
    phase = PhaseMap(finer.n, f, _PHASE_PRIOR, data.n_pixels).fine(of.split(point.x)[0][0])
    changes = []
    for divided in (light.start, share * np.kron(point.light, twice)):
        images = Linearised(finer, light.maps(divided, phase), point.values).images
        changes.append(of.weights * (images - point.model.images))
    return np.array(changes)


def _result(data: Recording, point: Point, converged: bool, is_reversed: bool) -> BenchFit:
    images = point.model.images
    residuals = data.weights(images) * (images - data.counts)
    misfit = np.sum(residuals**2, axis=(1, 2)) / np.maximum(np.count_nonzero(data.good, axis=(1, 2)), 1)
    scale = max(1.0, float(np.mean(misfit)))
    spread = Eliminated(point).covariance(point, _changes(data, point), scale)
    values = point.x[point.problem.n_white :]
    kinds = [free.kind for free in point.problem.free]
    blur = kinds.index("blur")
    spread[blur, blur] += (MISSED * _PIXEL / point.problem.camera.f**2 / (2 * values[blur])) ** 2
    passed = math.exp(-2 * (math.pi * values[blur]) ** 2)  # by the blur, at one cycle per pixel
    missed = [(1 - passed) * _BLURRED.get(kind, 0.0) + passed * _SHARP.get(kind, 0.0) for kind in kinds]
    spread += np.diag(np.square(missed))
    sigma = np.sqrt(np.diagonal(spread)).tolist()
    estimates = tuple(
        Estimate(free.name, value, error, not free.low < value < free.high)
        for free, value, error in zip(point.problem.free, values.tolist(), sigma, strict=True)
    )
    remarks = tuple(_remarks(data, point, misfit, estimates, is_reversed))
    flat, light = (means[PAD:-PAD, PAD:-PAD] for means in (point.phase_means, point.light_means))
    camera, fitted_light = point.problem.camera, replace(point.problem.light, start=point.light)
    places = {free.name: at for free, at in zip(point.problem.free, point.problem.places, strict=True)}
    grids = camera.shape, camera.n_pixels, camera.f, camera.largest
    model = FrameModel(*grids, fitted_light, point.values, places)
    return BenchFit(estimates, spread, flat, light, misfit, data.noise, data.gain, bool(converged), remarks, model)


def _remarks(
    data: Recording, point: Point, misfit: NDArray, estimates: tuple[Estimate, ...], is_reversed: bool
) -> list[str]:
    """What does not fit together, in words."""
    out = []
    if is_reversed:
        out.append("The images are in reverse order: the first image has the second of the phase shifts given.")
    strength = float(np.std(data.phases - data.phases.mean(axis=0)))
    if strength < _WEAK:
        out.append(f"The commands change the phase by {strength:.2g} rad rms: expected {_WEAK:g} or more.")
    for estimate, free in zip(estimates, point.problem.free, strict=True):
        if estimate.at_limit and not (free.name in _PHYSICAL and estimate.value <= free.low):
            out.append(f"{estimate.name} stands at a limit of the fit.")
    states = misfit[2:].reshape(-1, 2).mean(axis=1)
    typical = float(np.median(states))
    for state, misfit in enumerate(states):
        if misfit > max(2 * typical, EXPLAINED):
            out.append(
                f"State {state} has a misfit of {misfit:.3g}, the median is {typical:.3g}: its command or its "
                "frames are wrong."
            )
    level = data.light[1][0]
    for estimate in estimates:
        if estimate.name.endswith("background") and abs(estimate.value) > max(5 * estimate.sigma, 3e-3 * level):
            out.append(f"{estimate.name} is {estimate.value:.4g} counts: the dark does not belong to the frames.")
    return out
