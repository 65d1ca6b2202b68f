"""Model of a bench: optics from frames of a mirror in known states, and phases of other frames with them.

`fit_bench` finds all unknowns of the model of `zwfs.frames.camera` at once. `FittedSensor` keeps what was fitted, and
seeks only the phase of a pair of frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage, sparse
from scipy.sparse.linalg import splu

from zwfs import _check
from zwfs.frames.camera import ARM, Camera, Exposure, names_of
from zwfs.frames.camera_fit import Free, Light, LightMap, Minimum, PhaseMap, Point, Problem, covariance, fine_phase, minimise
from zwfs.frames.joint import MapPrior
from zwfs.frames.registration import radius
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

_PAD = 2  # pixels of the maps around the grid of the known phases
_REACH = 3  # pixels over which a known phase is continued
_FARTHEST = 3e-3  # D^2 / lambda: with more defocus the model's grid would be too small
_EXPLAINED = 1.2  # mean square of the residuals over the noise up to which a model explains the frames
_PASSES = 3  # of the fit: each divides the light again, and weighs by the images of the one before
_DIAMETERS = (0.8, 0.9, 1.0, 1.1, 1.25)  # of the coarse grid, over that of the design
_EXPONENTS = (2.0, 3.0, 4.0, 5.0)  # of the spectrum of a phase; held-out pixels choose
_HELD_OUT = 0.1  # of the pixels
_TIE = 0.03  # of priors that predict held-out pixels as well as this, the smoothest is taken
_DRAWS = 12  # for the error bars of a phase


class Estimate(NamedTuple):
    """Value of a number of the bench.

    Attributes
    ----------
    name : str
    value : float
    sigma : float
        One standard deviation, with the maps and all other numbers free. It grows with the root of the misfit.
    at_limit : bool
        Whether the value is one of its limits, so that the error bar does not hold.
    """

    name: str
    value: float
    sigma: float
    at_limit: bool


@dataclass(frozen=True, eq=False)
class BenchFit:
    """Result of `fit_bench`.

    Attributes
    ----------
    estimates : tuple of Estimate
        Diameter (lambda/D), phase shifts (radian), leakage, blur (pixels rms), and for each arm focus (D^2 / lambda),
        row and column (pixels), rotation (radian, from x to y), magnification, flux and background (counts). The
        arms 0 and 1 are the frames behind the masks, 2 and 3 the clear frames, which share focus, rotation and
        magnification with them.
    covariance : ndarray, shape (n_estimates, n_estimates)
    flat : ndarray, shape (n, n), radian
        Phase of the optics without a command, mean over each pixel.
    light : ndarray, shape (n, n)
        Light of each pixel of the pupil, 1 = mean of the first clear frame.
    misfit : ndarray, shape (2 + 2 n_states,)
        Mean square of the residuals over the noise: of the clear frames, then of each pair.
    noise : float, counts rms
        Noise of a pixel without light, as given or as estimated.
    converged : bool
        Whether the next step promises to lower half the sum of squares by less than a part of 1.
    remarks : tuple of str
        What does not fit together, in words.
    """

    estimates: tuple[Estimate, ...]
    covariance: NDArray[np.float64]
    flat: NDArray[np.float64]
    light: NDArray[np.float64]
    misfit: NDArray[np.float64]
    noise: float
    converged: bool
    remarks: tuple[str, ...]
    _point: Point

    @property
    def consistent(self) -> bool:
        """Whether the model explains all images within their noise."""
        return bool(np.mean(self.misfit) < _EXPLAINED and not self.remarks)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Error bars of the estimates, (n_estimates,)."""
        return np.sqrt(np.diagonal(self.covariance))

    def __getitem__(self, name: str) -> Estimate:
        """Estimate of a name."""
        for one in self.estimates:
            if one.name == name:
                return one
        raise KeyError(f"{name!r}: expected one of {[one.name for one in self.estimates]}")


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
    oversampling: int = 2,
    n_steps: int = 10,
) -> BenchFit:
    """Fit a model of the optics to frames of a mirror in known states, and to clear frames.

    Maps of phase and light and all numbers are the unknowns of one least-squares problem. The place of the maps is
    that of the known phases. The flux of the first clear frame is fixed: it defines the map of the light.

    Parameters
    ----------
    frames : array_like, shape (n_states, 2, ny, nx) or (n_states, n_frames, 2, ny, nx), counts
        Less the dark. NaN marks bad pixels. The mean of several frames is taken.
    clear_frames : array_like, shape (2, ny, nx) or (n_frames, 2, ny, nx), counts
        Less the dark, with the mask out.
    phases : array_like, shape (n_states, n, n), radian
        Phases that the commands add, mean over each pixel, on a grid whose middle is that of the frames. NaN, or 0
        in all states, marks what is unknown around the pupil; there the phases are continued.
    n_pixels : float, pixels
        Diameter D.
    noise : float, counts rms, optional
        Of a pixel of one frame without light: read noise, and that of the background and the dark. By default it
        is estimated from the darkest pixels; the result names it.
    gain : float, electrons / count
        For the photon noise.
    diameter : float, lambda/D
        Of the dimple, by design. The fit starts from the best of several diameters around it.
    phase_shifts : (float, float), radian
        Of the two images, by design. The fit also tries the reverse order, and a remark tells if it is right.
    oversampling : int
        Points of the model along a pixel.
    n_steps : int
        Largest number of steps of each of the passes.

    Returns
    -------
    BenchFit

    Raises
    ------
    ValueError
        If the shapes do not belong together, there are fewer than two states, or a clear frame holds no light.
    """
    data = _Recording.of(frames, clear_frames, phases, n_pixels, noise, gain)
    diameter = _check.number("diameter", diameter, 0, open_low=True)
    shifts = _check.pair("phase_shifts", phase_shifts, _check.number)
    oversampling, n_steps = _check.integer("oversampling", oversampling, 1, 8), _check.integer("n_steps", n_steps, 1)
    start = _coarse(data, diameter, shifts)
    problem = _problem(data, start, oversampling)
    best = minimise(problem, _with_flat(problem, start.flat), n_steps, 25)
    for _ in range(_PASSES - 1):
        problem, x = _again(data, best)
        best = minimise(problem, x, n_steps, 35)
    return _result(data, best, start.reversed)


@dataclass(frozen=True, eq=False)
class _Recording:
    """Checked data: means of cubes, their bad pixels, and the noise of a mean."""

    counts: list[NDArray[np.float64]]  # clear frames first, then each pair
    good: list[NDArray[np.bool_]]
    n_frames: list[int]
    phases: NDArray[np.float64]  # (n_states, n + 2 pad, n + 2 pad), continued
    n_pixels: float
    noise: float
    gain: float

    @classmethod
    def of(
        cls, frames: ArrayLike, clear: ArrayLike, phases: ArrayLike, n_pixels: float, noise: float | None, gain: float
    ) -> _Recording:
        masked, m = _mean_of("frames", frames, 4)
        clear, k = _mean_of("clear_frames", clear, 3)
        phases = _check.real_array("phases", phases)
        for name, array in (("frames", masked[0]), ("clear_frames", clear)):
            if len(array) != 2:
                raise ValueError(f"{name} has {len(array)} images: expected 2")
        if masked.shape[2:] != clear.shape[1:]:
            raise ValueError(f"clear_frames has shape {clear.shape}: expected (2, {masked.shape[2]}, {masked.shape[3]})")
        if phases.ndim != 3 or len(phases) != len(masked) or phases.shape[1] != phases.shape[2]:
            raise ValueError(f"phases has shape {phases.shape}: expected ({len(masked)}, n, n), one for each state")
        if len(phases) < 2:
            raise ValueError("phases holds 1 state: expected two or more, which fix the place and the plane of the maps")
        n_pixels = _check.number("n_pixels", n_pixels, 1)
        if any((length - phases.shape[1]) % 2 for length in clear.shape[1:]):
            raise ValueError(
                f"phases has shape {phases.shape} and frames {clear.shape[1:]}: expected even differences, so that "
                "the pixels stand at the same places"
            )
        gain = _check.number("gain", gain, 0, open_low=True)
        images = [*clear, *masked.reshape(-1, *masked.shape[2:])]
        good = [np.isfinite(one) for one in images]
        if noise is None:
            noise = _dark_noise(images, n_pixels) * math.sqrt(m)
        counts = [np.where(ok, one, 0) for one, ok in zip(images, good, strict=True)]
        noise = _check.number("noise", noise, 0, open_low=True)
        n_frames = [k, k] + [m] * (len(images) - 2)
        return cls(counts, good, n_frames, _continued(phases), n_pixels, noise, gain)

    @cached_property
    def light(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Light of each pixel of the maps, 1 on average where it is lit, and the counts of 1 in each clear frame."""
        n = self.phases.shape[-1]
        inner = np.stack([centred(one, n) for one in self.counts[:2]])
        mean = inner.mean(axis=0)
        lit = mean > 0.5 * np.percentile(mean, 80)
        flux = inner[:, lit].mean(axis=1)
        if np.any(flux <= 0) or not np.all(np.isfinite(flux)):
            raise ValueError(f"clear_frames hold {flux} counts on average in the pupil: expected light")
        return np.maximum((inner / flux[:, None, None]).mean(axis=0), 0), flux

    def weights(self, images: list[NDArray]) -> list[NDArray[np.float64]]:
        """One over the noise of each pixel, for the images of a model."""
        pairs = zip(images, self.good, self.n_frames, strict=True)
        return [ok * np.sqrt(k / (np.maximum(image, 0) / self.gain + self.noise**2)) for image, ok, k in pairs]


def _mean_of(name: str, images: ArrayLike, n_axes: int) -> tuple[NDArray[np.float64], int]:
    """Mean over the frames of cubes, and their number; NaN where all are bad."""
    array = _check.real_array(name, images)
    if array.ndim not in (n_axes, n_axes + 1) or not array.size:
        raise ValueError(f"{name} has shape {array.shape}: expected {n_axes} axes, or {n_axes + 1} with cubes")
    if array.ndim == n_axes:
        return array, 1
    axis = array.ndim - 4
    return array.mean(axis=axis), array.shape[axis]


def _dark_noise(images: list[NDArray], n_pixels: float) -> float:
    """Noise of the darkest pixels of the clear frames, from differences of neighbours."""
    found = []
    for image in images[:2]:
        far = radius(image.shape, tuple((n - 1) / 2 for n in image.shape)) > 0.56 * n_pixels
        step = (np.diff(image, axis=1) / math.sqrt(2))[far[:, 1:] & far[:, :-1]]
        step = step[np.isfinite(step)]
        if step.size < 50:
            raise ValueError("noise = None: expected the noise of a pixel, because the frames hold too few dark pixels")
        found.append(1.4826 * np.median(np.abs(step - np.median(step))))
    return float(np.mean(found))


def centred(image: NDArray, n: int) -> NDArray:
    """The n middle rows and columns, with zeros where there are fewer."""
    margin = max(0, *(n - length for length in image.shape)) // 2 + 1
    whole = np.pad(image, margin)
    first = [(length - n) // 2 for length in whole.shape]
    return whole[first[0] : first[0] + n, first[1] : first[1] + n]


def _continued(phases: NDArray) -> NDArray[np.float64]:
    """Known phases on a wider grid, smoothly continued by a few pixels beyond where they are known."""
    bad = ~np.isfinite(phases).all(axis=0) | (phases == 0).all(axis=0)
    wide = np.pad(np.nan_to_num(phases), ((0, 0), (_PAD, _PAD), (_PAD, _PAD)))
    regions, _ = ndimage.label(np.pad(bad, _PAD, constant_values=True))
    unknown = regions == regions[0, 0]
    if np.any(bad & unknown[_PAD:-_PAD, _PAD:-_PAD]):  # a pixel of the outline mixes the phase with zeros
        unknown = ndimage.binary_dilation(unknown)
    if unknown.all():
        return wide
    n = wide.shape[-1]
    second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n))
    first = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(n - 1, n))
    same = sparse.eye_array(n)
    parts = (sparse.kron(second, same), sparse.kron(same, second), math.sqrt(2) * sparse.kron(first, first))
    bending = sum(one.T @ one for one in parts).tocsc()
    flat, rows = wide.reshape(len(wide), -1).copy(), unknown.ravel()
    right = -(bending[rows][:, ~rows] @ flat[:, ~rows].T)
    flat[:, rows] = splu(bending[rows][:, rows].tocsc()).solve(right).T
    far = ndimage.distance_transform_edt(unknown) > _REACH
    near = ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    return flat.reshape(wide.shape)[(slice(None), *near)]


class _Start(NamedTuple):
    """Best of the coarse grid."""

    diameter: float
    shifts: tuple[float, float]
    flat: NDArray[np.float64]
    reversed: bool


def _coarse(data: _Recording, diameter: float, shifts: tuple[float, float]) -> _Start:
    """Diameter and order that explain the frames best, with one flat for all states by the phase-shifted iteration."""
    light, flux = data.light
    n = len(light)
    stop = radius((n, n), ((n - 1) / 2,) * 2) <= data.n_pixels / 2 + 1
    pupil = Pupil.from_amplitude(np.sqrt(light) * stop, data.n_pixels, threshold=0.3)
    inside = pupil.inside
    scale = flux * np.mean(light[inside])
    frames = np.stack([centred(one, n) for one in data.counts[2:]]).reshape(-1, 2, n, n) / scale[:, None, None]
    best: tuple[float, _Start] | None = None
    for order in (False, True):
        pair = shifts[::-1] if order else shifts
        for factor in _DIAMETERS:
            sensor = ZernikeSensor(pupil, *(Dimple(factor * diameter, one) for one in pair), tolerance=1e-4)
            found = PhaseShifted(sensor, n_iterations=15)(np.maximum(frames, 0)).phase
            waves = np.where(inside, np.exp(1j * (np.nan_to_num(found) - data.phases)), 0)
            for _ in range(3):  # each phase has its own piston
                mean = waves.mean(axis=0)
                waves = waves * np.exp(-1j * np.angle(np.sum(waves * mean.conj(), axis=(1, 2))))[:, None, None]
            flat = np.angle(ndimage.gaussian_filter(waves.mean(axis=0), 1.0))
            misfit = float(np.mean((sensor.measure(flat + data.phases) - frames)[..., inside] ** 2))
            if best is None or misfit < best[0]:
                best = misfit, _Start(factor * diameter, pair, np.where(inside, flat, 0), order)
    assert best is not None
    return best[1]


def _free(data: _Recording, start: _Start) -> list[Free]:
    """Numbers that are free, and where they start."""
    _, flux = data.light
    free = []
    for side in (0, 1):
        both = (side, side + 2)

        def shared(name: str, *limits: float, arms: tuple[int, int] = both) -> Free:
            return Free(f"arm {arms[0]} {name}", tuple((arm, name) for arm in arms), *limits)

        free += [shared("focus", 0.0, -_FARTHEST, _FARTHEST), shared("rotation", 0.0, -0.3, 0.3, 0.05)]
        free += [shared("magnification", 1.0, 0.7, 1.4, 0.05)]
        for arm in both:
            names = {"row": (0.0, -6.0, 6.0), "column": (0.0, -6.0, 6.0), "background": (0.0,), "flux": (flux[side], 0.0)}
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
        "blur": (0.5, 0.02, 5.0),
    }
    return free + [Free(name, ((None, name),), *values) for name, values in limits.items()]


def _problem(data: _Recording, start: _Start, f: int) -> Problem:
    """The first problem of a fit."""
    light, flux = data.light
    n, shape = len(light), data.counts[0].shape
    exposures = [Exposure(2, None, 0), Exposure(3, None, 0)]
    exposures += [Exposure(side, side, state) for state in range(len(data.phases)) for side in (0, 1)]
    camera = Camera(n, shape, data.n_pixels, exposures, fine_phase(data.phases, f), f, 1.9 * start.diameter)
    values = np.zeros(len(names_of(4)))
    table = values[: 4 * len(ARM)].reshape(4, -1)
    table[:, ARM.index("magnification")], table[:, ARM.index("flux")] = 1, np.tile(flux, 2)
    division = Light.of(np.kron(light, np.ones((f, f))), light, f)
    smooth = [ndimage.uniform_filter(one, 3) for one in data.counts]
    free = _free(data, start)
    phase_map = PhaseMap(n, f, MapPrior(0.5, 3.0), data.n_pixels)
    lights = _light_maps(division, f * data.n_pixels)
    zero = np.zeros((n * f, n * f))
    return Problem(camera, data.counts, data.weights(smooth), division, zero, phase_map, lights, values, free)


def _light_maps(light: Light, n_pixels: float) -> tuple[LightMap, ...]:
    return (LightMap(light.support, MapPrior(0.2, 3.0, outer_scale=0.1), n_pixels),)


def _white(phase_map: PhaseMap, means: NDArray) -> NDArray[np.float64]:
    """White numbers of a phase, mean over each pixel."""
    size, n = phase_map.size, phase_map.n
    wide = np.pad(means, ((0, size - n),) * 2, "linear_ramp")
    return fft.irfft2(fft.rfft2(wide) / phase_map.colour, s=wide.shape)


def _with_flat(problem: Problem, flat: NDArray) -> NDArray[np.float64]:
    x = problem.start
    x[: problem.phase_map.size**2] = _white(problem.phase_map, flat).ravel()
    return x


def _again(data: _Recording, best: Minimum) -> tuple[Problem, NDArray]:
    """The problem with light divided, and pixels weighed, by what was fitted."""
    point, before = best.point, best.point.problem
    f, n = before.camera.f, before.phase_map.n
    light = Light.of(point.light, point.light.reshape(n, f, n, f).mean(axis=(1, 3)), f)
    free = [
        one if math.isfinite(one.sigma) else one._replace(value=float(point.values[places[0]]))
        for one, places in zip(before.free, before.places, strict=True)
    ]
    problem = replace(
        before,
        light=light,
        weights=data.weights(point.model.images),
        light_maps=_light_maps(light, f * data.n_pixels),
        values=point.values,
        free=free,
    )
    x, n_phase = problem.start, before.phase_map.size**2
    x[:n_phase], x[problem.n_white :] = point.x[:n_phase], point.x[before.n_white :]
    return problem, x


def _result(data: _Recording, best: Minimum, is_reversed: bool) -> BenchFit:
    point = best.point
    scale = max(1.0, float(np.mean(point.misfit)))
    spread = covariance(point, 10) * scale
    values = point.x[point.problem.n_white :]
    sigma = np.sqrt(np.diagonal(spread)).tolist()
    estimates = tuple(
        Estimate(one.name, value, error, not one.low < value < one.high)
        for one, value, error in zip(point.problem.free, values.tolist(), sigma, strict=True)
    )
    n, f = point.problem.phase_map.n, point.problem.camera.f
    inner = (slice(_PAD, n - _PAD),) * 2
    return BenchFit(
        estimates,
        spread,
        point.problem.phase_map.means(point.problem.split(point.x)[0][0])[inner],
        point.light.reshape(n, f, n, f).mean(axis=(1, 3))[inner],
        point.misfit,
        data.noise,
        best.converged,
        tuple(_remarks(data, point, estimates, is_reversed)),
        point,
    )


def _remarks(data: _Recording, point: Point, estimates: tuple[Estimate, ...], is_reversed: bool) -> list[str]:
    """What does not fit together, in words."""
    out = []
    if is_reversed:
        out.append("The images are in reverse order: the first image has the second of the phase shifts given.")
    out += [f"{one.name} stands at a limit of the fit." for one in estimates if one.at_limit]
    states = point.misfit[2:].reshape(-1, 2).mean(axis=1)
    typical = float(np.median(states))
    for state, misfit in enumerate(states):
        if misfit > max(2 * typical, _EXPLAINED):
            out.append(f"State {state} has a misfit of {misfit:.3g}, the median is {typical:.3g}: its command or its frames are wrong.")
    for one in estimates:
        level = data.light[1][0]
        if one.name.endswith("background") and abs(one.value) > max(5 * one.sigma, 3e-3 * level):
            out.append(f"{one.name} is {one.value:.4g} counts: the dark does not belong to the frames.")
    return out


@dataclass(frozen=True, eq=False)
class FittedPhase(NDArrayOperatorsMixin):
    """Phase of a pair of frames; in arithmetic and for NumPy it is the array `phase`.

    Attributes
    ----------
    phase : ndarray, shape (n, n), radian
        Mean over each pixel, that of the optics included.
    misfit : float
        Mean square of the residuals over the noise.
    consistent : bool
        Whether the model explains the frames within their noise.
    converged : bool
    exponent : float
        Of the spectrum of the prior, as chosen by held-out pixels.
    """

    phase: NDArray[np.float64]
    misfit: float
    consistent: bool
    converged: bool
    exponent: float
    _point: Point

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        return np.array(self.phase, dtype=dtype, copy=True if copy is None else copy)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **settings: Any) -> Any:
        arrays = [one.phase if isinstance(one, FittedPhase) else one for one in inputs]
        return getattr(ufunc, method)(*arrays, **settings)

    def __getitem__(self, index: Any) -> Any:
        return self.phase[index]

    @cached_property
    def sigma(self) -> NDArray[np.float64]:
        """Error bar of each pixel, (n, n), radian: from draws of the noise and of the prior, and the misfit."""
        point, rng = self._point, np.random.default_rng(0)  # the choice changes the error bars by some percent
        problem, draws = point.problem, []
        held = np.zeros(point.x.shape, bool)
        for _ in range(_DRAWS):
            noise = [rng.normal(size=one.shape) * (one > 0) for one in problem.weights]
            right = point.back(noise) + rng.normal(size=point.x.shape)
            white, _ = problem.split(point.solve(right, held, 60, 0.03))
            draws.append(problem.phase_map.means(white[0])[_PAD:-_PAD, _PAD:-_PAD])
        inner = point.light.reshape(problem.phase_map.n, problem.camera.f, problem.phase_map.n, -1).mean(axis=(1, 3))
        lit = inner[_PAD:-_PAD, _PAD:-_PAD] > 0.3
        left = np.stack([one - one[lit].mean() for one in draws])
        variance = ndimage.gaussian_filter(np.mean(left**2, axis=0), 1.0)
        return np.sqrt(variance * max(1.0, self.misfit))


@dataclass(frozen=True, eq=False)
class FittedSensor:
    """A sensor whose optics are those of a fit: pairs of frames in, phases out.

    The phase-shifted iteration with the fitted mask and amplitude gives a start. Then the phase alone is fitted
    with all of the model. Its prior is smooth to a degree that held-out pixels choose.

    Parameters
    ----------
    fit : BenchFit
    n_steps : int
        Largest number of steps for a pair.
    """

    fit: BenchFit
    n_steps: int = 8

    def __post_init__(self) -> None:
        _check.instance("fit", self.fit, BenchFit)
        _check.integer("n_steps", self.n_steps, 1)

    @property
    def flat(self) -> NDArray[np.float64]:
        """Phase of the optics at a flat command, (n, n)."""
        return self.fit.flat

    def __call__(self, frames: ArrayLike, sigma: ArrayLike) -> FittedPhase:
        """Phase of one pair of frames.

        Parameters
        ----------
        frames : array_like, shape (2, ny, nx), counts
            Less the dark. NaN marks bad pixels.
        sigma : array_like, shape (2, ny, nx) or a number, counts rms
            Noise of the pixels.

        Returns
        -------
        FittedPhase
        """
        counts = _check.real_array("frames", frames)
        shape = (2, *self._fitted.camera.shape)
        if counts.shape != shape:
            raise ValueError(f"frames has shape {counts.shape}: expected {shape}")
        sigma = np.broadcast_to(_check.real_array("sigma", sigma), shape)
        if not np.all(sigma > 0):
            raise ValueError(f"sigma reaches down to {sigma.min():.6g}: expected more than 0")
        good = np.isfinite(counts)
        counts, weights = np.where(good, counts, 0), good / sigma
        held = np.random.default_rng(0).random(shape) < _HELD_OUT  # the choice hardly changes the prior
        lit = held & good & (counts > 0.1 * np.median(counts[counts > 0.5 * counts.max()]))
        best: tuple[float, float, NDArray] | None = None
        for accelerate in (False, True):  # the second is for phases from which the plain iteration does not converge
            means, tried = self._start(counts, accelerate), []
            for exponent in _EXPONENTS:
                seen = self._minimum(counts, weights * ~held, exponent, means, 2 if tried else 3, 20).point
                means = seen.problem.phase_map.means(seen.problem.split(seen.x)[0][0])
                score = float(np.mean(((np.array(seen.model.images) - counts) * weights)[lit] ** 2))
                tried.append((score, exponent, means))
                if score > 1.1 * min(one[0] for one in tried):
                    break
            least = min(one[0] for one in tried)
            smoothest = [one for one in tried if one[0] <= (1 + _TIE) * least][-1]
            if best is None or least < best[0]:
                best = least, smoothest[1], smoothest[2]
            if least < 2 * _EXPLAINED:
                break
        assert best is not None
        _, exponent, means = best
        end = self._minimum(counts, weights, exponent, means, self.n_steps, 30)
        point = end.point
        misfit = float(np.mean(point.misfit))
        phase = point.problem.phase_map.means(point.problem.split(point.x)[0][0])[_PAD:-_PAD, _PAD:-_PAD]
        return FittedPhase(phase, misfit, misfit < _EXPLAINED, end.converged, exponent, point)

    def frames(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Frames that the model predicts for a phase.

        Parameters
        ----------
        phase : array_like, shape (n, n), radian
            That of the optics included.

        Returns
        -------
        ndarray, shape (2, ny, nx), counts
        """
        phase = _check.real_map("phase", phase, 2)
        _check.trailing_shape("phase", phase, self.flat.shape, "the grid of the pupil")
        fine = fine_phase(np.pad(phase, _PAD, "edge"), self._fitted.camera.f)
        point = self.fit._point
        return np.stack(self._camera.at(self._light.maps(point.light, fine), point.values).images)

    @property
    def _fitted(self) -> Problem:
        return self.fit._point.problem

    @property
    def _light(self) -> Light:
        return replace(self._fitted.light, start=self.fit._point.light)

    @cached_property
    def _camera(self) -> Camera:
        """The camera behind the two masks alone."""
        of = self._fitted.camera
        exposures = [Exposure(0, 0, 0), Exposure(1, 1, 0), Exposure(2, None, 0), Exposure(3, None, 0)]
        camera = Camera(of.n, of.shape, of.n_pixels, exposures, np.zeros((1, of.n * of.f, of.n * of.f)), of.f, of.largest)
        camera.exposures = camera.exposures[:2]
        return camera

    def _minimum(
        self, counts: NDArray, weights: NDArray, exponent: float, start: NDArray, n_steps: int, n_inner: int
    ) -> Minimum:
        """Fit of the phase alone."""
        of = self._fitted
        inside = start[of.phase_map.n // 4 : -of.phase_map.n // 4]
        phase_map = PhaseMap(of.phase_map.n, of.camera.f, MapPrior(max(0.1, 2 * float(inside.std())), exponent), of.camera.n_pixels)
        values = self.fit._point.values
        problem = Problem(self._camera, counts, weights, self._light, np.zeros(self._light.start.shape), phase_map, (), values)
        return minimise(problem, _white(phase_map, start).ravel(), n_steps, n_inner)

    def _start(self, counts: NDArray, accelerate: bool) -> NDArray[np.float64]:
        """Phase of the phase-shifted iteration on images brought back to the pupil, unwrapped and continued."""
        point, n, f = self.fit._point, self._fitted.phase_map.n, self._fitted.camera.f
        light = np.maximum(point.light.reshape(n, f, n, f).mean(axis=(1, 3)), 0)
        pupil = Pupil.from_amplitude(np.sqrt(light), self._fitted.camera.n_pixels, threshold=0.3)
        power = np.mean(pupil.amplitude[pupil.inside] ** 2) / np.mean(light[pupil.inside])
        masks = point.model.masks
        y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2,) * 2, indexing="ij")
        images = np.empty((2, n, n))
        for side, arm in enumerate(point.model.arms[:2]):
            cosine, sine = (arm["magnification"] * one(arm["rotation"]) for one in (math.cos, math.sin))
            rows = cosine * y + sine * x + arm["row"] + (counts.shape[1] - 1) / 2
            columns = cosine * x - sine * y + arm["column"] + (counts.shape[2] - 1) / 2
            image = (counts[side] - arm["background"]) / arm["flux"] * power
            images[side] = ndimage.map_coordinates(image, [rows, columns], order=3, mode="nearest")
        leaked = min(masks["leakage"], 0.4)
        images = ((1 - leaked) * images - leaked * images[::-1]) / (1 - 2 * leaked)
        sensor = ZernikeSensor(pupil, *(Dimple(masks["diameter"], masks[name]) for name in ("first", "second")), tolerance=1e-5)
        found = PhaseShifted(sensor, n_iterations=25, tolerance=1e-3, accelerate=accelerate)(np.maximum(images, 0)).phase
        inside = ndimage.binary_erosion(pupil.inside) | (pupil.inside & (light > 0.8))
        phase = unwrapped(np.nan_to_num(found), inside)
        near = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        return phase[tuple(near)] - phase[inside].mean()


def unwrapped(phase: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Phase without jumps of 2 pi between neighbours inside, by least squares."""
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(np.count_nonzero(inside))
    rows, right = [], []
    for axis in (0, 1):
        first, second = (np.moveaxis(number, axis, 0)[cut] for cut in (slice(None, -1), slice(1, None)))
        values = np.moveaxis(phase, axis, 0)
        both = (first >= 0) & (second >= 0)
        rows.append(np.stack([first[both], second[both]], axis=1))
        right.append(np.angle(np.exp(1j * np.diff(values, axis=0)))[both])
    pairs, step = np.concatenate(rows), np.concatenate(right)
    k = np.arange(len(pairs))
    size = (len(pairs), int(number.max()) + 1)
    slope = sparse.csr_array((np.tile([-1.0, 1.0], len(pairs)), (np.repeat(k, 2), pairs.ravel())), size)
    normal = (slope.T @ slope + 1e-9 * sparse.eye_array(size[1])).tocsc()
    smooth = splu(normal).solve(slope.T @ step)
    out = phase.copy()
    difference = smooth - phase[inside]
    difference -= np.median(difference)
    out[inside] += 2 * np.pi * np.rint(difference / (2 * np.pi))
    return out
