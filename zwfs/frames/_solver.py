"""Fit of the model of the camera: maps of light and phase, and all numbers, in one least-squares problem."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, ndimage
from scipy.interpolate import BSpline

from zwfs.frames._light import Light
from zwfs.frames._optics import Camera, Linearised, names_of, pooled, symbol
from zwfs.frames._segments import Segments

if TYPE_CHECKING:
    from zwfs.frames._explicit import Posterior

_BINS = 24  # of spatial frequency, for the preconditioner
_POINTS = 3.0  # response of the light of a single point that is taken, over the measured one
_POWER, _WEIGHED = 0.15, (0.1, 1e3)  # of the weight of light at a place in a smooth map, and its limits
_FAINTEST = 1e-3  # response of a spatial frequency, over the largest: a random probe measures no smaller ones
_LEAST = 1e-3  # damping
_DEPENDENT = 1e-12  # eigenvalue over the largest, below which directions depend on each other
_ALIKE = 1e-13  # eigenvalue over the largest, below which numbers have the same effect
_TOGETHER = 6  # vectors that are multiplied at once: with more, the arrays exceed the cache
_N_FOLLOWED = 6, 3  # iterations for the maps that follow the numbers: the first time, and from those nearby
_N_CHANGES = 30  # iterations for the maps that follow a change of the images
_SHARES = 0.0, 0.4, 0.7  # of the maps' own move, by which a step is shortened: the light of edges is not linear
_BLOCK = 6  # pixels along the side of a block whose residuals may be alike
_SETTLED = 0.3  # predicted decrease of half the sum of squares at which a fit has converged
_QUIET = 0.7  # the same of the numbers alone, where it is known
MISSED = 0.7
"""Errors of fits to frames of HCIPy, over the changes with a finer grid (rms)."""
_NO_STEPS = np.zeros(0)
_PIXEL_MEAN = 230 / 384, 2 * 76 / 384, 2 / 384  # of a cubic spline over a pixel, as a series of cosines


class Free(NamedTuple):
    """A free number, which may stand at several places of the vector of all numbers."""

    name: str
    places: tuple[tuple[int | None, str], ...]  # (arm, or None for the masks; name)
    value: float  # where a fit starts, and the mean of its prior
    low: float = -math.inf
    high: float = math.inf
    sigma: float = math.inf  # of its prior

    @property
    def kind(self) -> str:
        """Name without that of the arm or the image."""
        return "phase shift" if self.name in ("first", "second") else self.name.split()[-1]


class MapPrior(NamedTuple):
    """Gaussian prior of a map: its power spectral density is a power law, flat below 1 cycle / outer scale.

    A phase may also jump between the segments of a pupil, by a piston, a tip and a tilt of each.
    """

    rms: float  # of a pixel
    exponent: float = 0.0  # 0 for pixels that are independent
    outer_scale: float = 2.0  # D
    jumps: float = 0.0  # rms of each piston, and over its segment of each tip and tilt

    @property
    def strengths(self) -> tuple[float, ...]:
        """Standard deviations that scale the prior."""
        return (self.rms, self.jumps) if self.jumps else (self.rms,)

    def scaled(self, factors: Sequence[float]) -> MapPrior:
        """Prior whose standard deviations are multiplied."""
        return self._replace(
            **dict(zip(("rms", "jumps"), np.multiply(self.strengths, factors).tolist(), strict=False))
        )

    def spectrum(self, size: int, n_pixels: float) -> NDArray[np.float64]:
        """Variance of each frequency on a periodic grid, on half the plane, (size, size // 2 + 1)."""
        v, u = fft.fftfreq(size)[:, None], fft.rfftfreq(size)
        bend = 1 / (self.outer_scale * n_pixels)
        shape = (u**2 + v**2 + bend**2) ** (-self.exponent / 2)
        twice = np.where((u == 0) | (u == 0.5), 1.0, 2.0)  # half the plane stands for all of it
        return shape * self.rms**2 * size**2 / np.sum(shape * twice)


class PhaseMap:
    """White numbers to the means of a phase over the pixels, and to the phase on the fine grid.

    The phase is a cubic spline, from size * size white numbers, and the steps of the segments, from the others.
    """

    def __init__(
        self, n: int, oversampling: int, prior: MapPrior, n_pixels: float, segments: Segments | None = None
    ) -> None:
        self.n, self.prior, self.size = n, prior, fft.next_fast_len(round(1.2 * n), real=True)
        self.colour = np.sqrt(prior.spectrum(self.size, n_pixels))
        self.along = fine_spline(n, oversampling, self.size)
        self.spline = self.colour / symbol(_PIXEL_MEAN, self.size)
        self.segments = segments
        self.stepped = segments if prior.jumps else None
        self.n_white = self.size**2 + (self.stepped.n_steps if self.stepped else 0)

    def means(self, white: NDArray) -> NDArray[np.float64]:
        """Mean over each pixel, (..., n, n)."""
        maps = self._maps(white)
        means = fft.irfft2(self.colour * fft.rfft2(maps), s=maps.shape[-2:])[..., : self.n, : self.n]
        return means + self.stepped.means(self.steps(white)) if self.stepped else means

    def white(self, means: NDArray, steps: NDArray = _NO_STEPS) -> NDArray[np.float64]:
        """White numbers of a phase with these means, and with these steps if it has some.

        What lies beyond the segments is replaced where steps begin, or end.
        """
        changes = bool(steps.size) != bool(self.stepped)
        if self.stepped:
            steps = steps if steps.size else self.stepped.fitted(means)
            means = means - self.stepped.means(steps)
        if changes and self.segments:
            means = self.segments.continued(means)
        wide = np.pad(means, ((0, self.size - self.n),) * 2, "linear_ramp")
        white = fft.irfft2(fft.rfft2(wide) / self.colour, s=wide.shape).ravel()
        return np.concatenate([white, steps / self.prior.jumps]) if self.stepped else white

    def fine(self, white: NDArray) -> NDArray[np.float64]:
        """Phase on the fine grid."""
        smooth = self.along @ self.coefficients(white) @ self.along.T
        return smooth + self.stepped.fine(self.steps(white)) if self.stepped else smooth

    def adjoint(self, fine: NDArray) -> NDArray[np.float64]:
        """Adjoint of `fine`."""
        white = self.filtered(self.along.T @ fine @ self.along)
        if not self.stepped:
            return white
        return np.concatenate([white, self.prior.jumps * self.stepped.adjoint(fine)], axis=-1)

    def steps(self, white: NDArray) -> NDArray[np.float64]:
        """Steps of the segments, radian, (..., n_steps); none if the phase does not jump."""
        return self.prior.jumps * white[..., self.size**2 :]

    def coefficients(self, white: NDArray) -> NDArray[np.float64]:
        """Coefficients of the spline, (..., size, size)."""
        maps = self._maps(white)
        return fft.irfft2(self.spline * fft.rfft2(maps), s=maps.shape[-2:])

    def filtered(self, maps: NDArray) -> NDArray[np.float64]:
        """Adjoint of `coefficients`, (..., size * size)."""
        return fft.irfft2(self.spline * fft.rfft2(maps), s=maps.shape[-2:]).reshape(*maps.shape[:-2], -1)

    def _maps(self, white: NDArray) -> NDArray:
        return white[..., : self.size**2].reshape(*white.shape[:-1], self.size, self.size)


class LightMap:
    """White numbers to the change of the light on some points of the fine grid, where D has n_pixels points."""

    def __init__(self, where: NDArray, prior: MapPrior, n_pixels: float) -> None:
        self.where, self.n, self.prior = where, len(where), prior
        self.size = fft.next_fast_len(round(1.05 * self.n), real=True)
        self.n_white = self.size**2
        self.colour = np.sqrt(prior.spectrum(self.size, n_pixels))

    def fine(self, white: NDArray) -> NDArray[np.float64]:
        maps = white.reshape(*white.shape[:-1], self.size, self.size)
        change = fft.irfft2(self.colour * fft.rfft2(maps), s=maps.shape[-2:])
        return change[..., : self.n, : self.n] * self.where

    def adjoint(self, fine: NDArray) -> NDArray[np.float64]:
        """Adjoint of `fine`."""
        whole = np.zeros((*fine.shape[:-2], self.size, self.size), fine.dtype)
        whole[..., : self.n, : self.n] = fine * self.where
        return fft.irfft2(self.colour * fft.rfft2(whole), s=whole.shape[-2:]).reshape(*fine.shape[:-2], -1)


def _single(values: Any) -> Any:
    """Copy of a map whose numbers have single precision."""
    out = copy(values)
    for name, value in vars(values).items():
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            setattr(out, name, value.astype(np.float32))
    return out


def allowing(weights: NDArray, error: float | NDArray) -> NDArray[np.float64]:
    """Weights, one over the noise, with an error of the model added to the noise; those of bad pixels stay 0."""
    return weights / np.hypot(1, error * weights)


def fine_spline(n: int, oversampling: int, size: int) -> NDArray[np.float64]:
    """Cubic B-splines at nodes 0 to size - 1, periodic, at the fine points of n pixels, (n * f, size)."""
    places = (np.arange(n * oversampling) + 0.5) / oversampling - 0.5
    nodes = np.floor(places).astype(int)[:, None] + np.arange(-1, 3)
    values = np.nan_to_num(BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)(places[:, None] - nodes))
    matrix = np.zeros((len(places), size))
    np.add.at(matrix, (np.arange(len(places))[:, None], nodes % size), values)
    return matrix


def fine_phase(means: NDArray, oversampling: int) -> NDArray[np.float64]:
    """Phase on the fine grid by the cubic spline whose means over the pixels are given, (..., n, n)."""
    n, margin = means.shape[-1], 12
    padded = np.pad(means, [(0, 0)] * (means.ndim - 2) + [(margin, margin)] * 2, "reflect", reflect_type="odd")
    # A period that is the map and its mirror image has no jump.
    both = np.concatenate([padded, padded[..., ::-1]], -1)
    both = np.concatenate([both, both[..., ::-1, :]], -2)
    nodes = fft.irfft2(fft.rfft2(both) / symbol(_PIXEL_MEAN, both.shape[-1]), s=both.shape[-2:])
    nodes = nodes[..., margin - 2 : margin + n + 2, margin - 2 : margin + n + 2]
    along = fine_spline(n + 4, oversampling, n + 4)[2 * oversampling : -2 * oversampling]
    return along @ nodes @ along.T


@dataclass(frozen=True, eq=False)
class Problem:
    """Images, the model, and what is unknown."""

    camera: Camera
    counts: NDArray[np.float64]  # (n_images, ny, nx)
    weights: NDArray[np.float64]  # one over the noise of each pixel; 0 for bad pixels
    light: Light
    phase_map: PhaseMap
    light_maps: tuple[LightMap, ...]  # empty if the light is known
    values: NDArray[np.float64]  # all numbers; those that are free do not count
    free: Sequence[Free] = ()
    guide: Posterior | None = None  # explicit matrix; only where the phase alone is unknown
    following: Eliminated | None = None  # how the maps follow the numbers at a point nearby
    filters: list[tuple[NDArray, NDArray]] = field(default_factory=list, init=False)  # those of its first matrix

    @cached_property
    def places(self) -> list[list[int]]:
        """Places of each free number in the vector of all."""
        index = {name: place for place, name in enumerate(names_of(len(self.values)))}
        return [
            [index[name if arm is None else f"arm {arm} {name}"] for arm, name in free.places]
            for free in self.free
        ]

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Limits of the free numbers, (n_free, 2)."""
        return np.array([(free.low, free.high) for free in self.free]).reshape(-1, 2)

    @cached_property
    def prior(self) -> tuple[NDArray, NDArray]:
        """Means and inverse standard deviations of the priors of the free numbers."""
        return np.array([free.value for free in self.free]), np.array([1 / free.sigma for free in self.free])

    @cached_property
    def single(self) -> Problem:
        """The problem in single precision."""
        camera, maps = self.camera.single, [_single(unknown) for unknown in self.maps]
        weights = self.weights.astype(camera.real)
        return replace(self, camera=camera, weights=weights, phase_map=maps[0], light_maps=tuple(maps[1:]))

    @property
    def maps(self) -> tuple[PhaseMap | LightMap, ...]:
        """All maps, that of the phase first."""
        return (self.phase_map, *self.light_maps)

    @cached_property
    def n_white(self) -> int:
        return sum(unknown.n_white for unknown in self.maps)

    @property
    def start(self) -> NDArray[np.float64]:
        return np.concatenate([np.zeros(self.n_white), self.prior[0]])

    def split(self, x: NDArray) -> tuple[list[NDArray], NDArray]:
        """White numbers of each map, and free numbers."""
        *white, free = np.split(x, np.cumsum([unknown.n_white for unknown in self.maps]), axis=-1)
        return white, free

    def joined(self, phase: NDArray, light: NDArray) -> NDArray[np.float64]:
        """Adjoint of the maps, with zeros for the free numbers."""
        white = [self.phase_map.adjoint(phase), *(light_map.adjoint(light) for light_map in self.light_maps)]
        return np.concatenate([*white, np.zeros((*phase.shape[:-2], len(self.free)))], axis=-1)

    def light_change(self, white: Sequence[NDArray]) -> NDArray[np.float64]:
        """Change of the light on the fine grid."""
        pairs = zip(white[1:], self.light_maps, strict=True)
        zero = np.zeros((*white[0].shape[:-1], *self.light.start.shape), white[0].dtype)
        return sum((light_map.fine(change) for change, light_map in pairs), zero)


class Point:
    """Model, residuals and cost at given unknowns."""

    def __init__(self, problem: Problem, x: NDArray) -> None:
        self.problem, self.x = problem, x
        white, free = problem.split(x)
        self.light = problem.light.changed(problem.light_change(white))
        self.phase = problem.phase_map.fine(white[0])
        self.values = problem.values.copy()
        for places, value in zip(problem.places, free.tolist(), strict=True):
            self.values[places] = value
        self.model = Linearised(problem.camera, problem.light.maps(self.light, self.phase), self.values)
        self.residuals = problem.weights * (self.model.images - problem.counts)
        self.excess = (free - problem.prior[0]) * problem.prior[1]
        parts = self.residuals, x[: problem.n_white], self.excess
        self.cost = sum(float(np.vdot(part, part)) for part in parts) / 2

    def moved(self, change: NDArray) -> Point:
        """Return the point after a change of the unknowns; no number passes a limit."""
        n, x = self.problem.n_white, self.x + change
        x[n:] = np.clip(x[n:], *self.problem.bounds.T)
        return Point(self.problem, x)

    @property
    def phase_means(self) -> NDArray[np.float64]:
        return self.problem.phase_map.means(self.problem.split(self.x)[0][0])

    @property
    def light_means(self) -> NDArray[np.float64]:
        return pooled(self.light, self.problem.camera.f)

    @cached_property
    def misfit(self) -> NDArray[np.float64]:
        """Mean square of the residuals of each image."""
        n_good = np.count_nonzero(self.problem.weights, axis=(1, 2))
        return np.sum(self.residuals**2, axis=(1, 2)) / np.maximum(n_good, 1)

    @cached_property
    def light_slopes(self) -> tuple[NDArray, NDArray]:
        """Derivatives of mean field and rest by the change of the light."""
        return self.problem.light.slopes(self.light)

    @cached_property
    def gradient(self) -> NDArray[np.float64]:
        problem, n = self.problem, self.problem.n_white
        maps = self.model.adjoint(problem.weights * self.residuals)
        mean, rest = self.light_slopes
        gradient = problem.joined(maps.phase, maps.mean * mean + maps.rest * rest)
        gradient[:n] += self.x[:n]
        gradient[n:] = self.excess * problem.prior[1]
        for image, (which, slopes) in zip(self.residuals, self.matrix.columns, strict=True):
            gradient[n + which] += slopes @ image.ravel()
        return gradient

    @cached_property
    def stuck(self) -> NDArray[np.bool_]:
        """Numbers at a limit beyond which the cost would fall."""
        n, bounds = self.problem.n_white, self.problem.bounds
        stuck = np.zeros(self.x.shape, bool)
        values, slope = self.x[n:], self.gradient[n:]
        stuck[n:] = ((values <= bounds[:, 0]) & (slope > 0)) | ((values >= bounds[:, 1]) & (slope < 0))
        return stuck

    @cached_property
    def matrix(self) -> Matrix:
        return Matrix(self)


class Matrix:
    """Gauss and Newton's matrix at a point, in single precision.

    It decides how fast a fit converges, and not to what: gradient and cost are those of `Point`. Leading axes of
    the arguments are those of several vectors.
    """

    def __init__(self, point: Point) -> None:
        self.problem, self.x, self.cost = point.problem.single, point.x, point.cost
        self.model = Linearised(self.problem.camera, point.model.maps, point.values)
        self._light, self._zero = point.light, np.zeros_like(point.phase)
        self._slopes = [slope.astype(self.problem.camera.real) for slope in point.light_slopes]

    @cached_property
    def columns(self) -> list[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """Free numbers that change each image, and its changes over the noise with each, (k, n_pixels)."""
        places = [(number, *at) for number, free in enumerate(self.problem.free) for at in free.places]
        out = []
        for index, weight in enumerate(self.problem.weights):
            own = self.problem.camera.exposures[index].arm
            names = {number: name for number, arm, name in places if arm in (None, own)}
            slopes = self.model.slopes(index, list(names.values())) * weight
            out.append((np.array(list(names), int), slopes.reshape(len(names), weight.size)))
        return out

    def along(self, number: int) -> NDArray[np.float64]:
        """Change of the residuals with a free number."""
        out = [slopes.T @ (which == number) for which, slopes in self.columns]
        return np.reshape(out, self.problem.weights.shape)

    @cached_property
    def block(self) -> NDArray[np.float64]:
        """Matrix of the free numbers."""
        block = np.diag(self.problem.prior[1] ** 2 + 1e-300)
        for which, slopes in self.columns:
            block[np.ix_(which, which)] += slopes @ slopes.T
        return block

    def change(self, d: NDArray) -> NDArray[np.float64]:
        """Change of the residuals with the unknowns, (..., n) to (..., n_images, ny, nx)."""
        problem = self.problem
        white, free = problem.split(np.asarray(d, problem.camera.real))
        light = problem.light_change(white)
        mean, rest = (light * slope for slope in self._slopes)
        changes = problem.weights * self.model.apply(mean, rest, problem.phase_map.fine(white[0]))
        if free.any():
            for index, (which, slopes) in enumerate(self.columns):
                changes[..., index, :, :] += (free[..., which] @ slopes).reshape(
                    *d.shape[:-1], *changes.shape[-2:]
                )
        return changes

    def back(self, residuals: NDArray) -> NDArray[np.float64]:
        """Adjoint of `change`."""
        problem = self.problem
        maps = self.model.adjoint(problem.weights * residuals)
        mean, rest = self._slopes
        out = problem.joined(maps.phase, maps.mean * mean + maps.rest * rest)
        for index, (which, slopes) in enumerate(self.columns):
            image = residuals[..., index, :, :]
            out[..., problem.n_white + which] += image.reshape(*image.shape[:-2], -1) @ slopes.T
        return out

    def product(self, d: NDArray) -> NDArray[np.float64]:
        """Matrix times vectors."""
        n = self.problem.n_white
        out = self.back(self.change(d))
        out[..., :n] += d[..., :n]
        out[..., n:] += d[..., n:] * self.problem.prior[1] ** 2
        return out

    @property
    def filters(self) -> list[tuple[NDArray, NDArray]]:
        """Approximate matrix of each map, at this point or another one: a factor at each place, and a spectrum."""
        if self.problem.following:
            return self.problem.following.filters
        if not self.problem.filters:
            self.problem.filters.extend(self._probed())
        return self.problem.filters

    def _probed(self) -> list[tuple[NDArray, NDArray]]:
        """Approximate matrix of each map, by random vectors."""
        rng = np.random.default_rng(0)  # the choice hardly changes the number of steps
        problem, zero, (mean, rest) = self.problem, self._zero, self._slopes
        out = []
        for number, unknown in enumerate(problem.maps):
            where: NDArray = unknown.where if isinstance(unknown, LightMap) else self._light > 0.3
            probe = rng.choice([-1.0, 1.0], where.shape) * where
            images = self.model.apply(*((probe * mean, probe * rest, zero) if number else (zero, zero, probe)))
            factor, response = np.ones((unknown.size,) * 2), np.zeros((unknown.size, unknown.size // 2 + 1))
            if number and not unknown.prior.exponent:
                gain = _POINTS * np.sum((problem.weights * images) ** 2) / np.sum(self._local, where=where)
                factor[: unknown.n, : unknown.n] = np.sqrt(1 + gain * unknown.prior.rms**2 * self._local * where)
            else:
                maps = self.model.adjoint(problem.weights**2 * images)
                answer = (maps.mean * mean + maps.rest * rest) * where if number else maps.phase
                response = self._response(probe, answer, unknown)
                if number:
                    near = ndimage.gaussian_filter(self._local, problem.camera.f)
                    factor[: unknown.n, : unknown.n] = np.clip(near / np.median(near[where]), *_WEIGHED) ** _POWER
            white = [rng.normal(size=(map_.size,) * 2) * (map_ is unknown) for map_ in problem.maps]
            white[number] = fft.irfft2(fft.rfft2(white[number]) / np.sqrt(1 + response), s=factor.shape) / factor
            d = np.concatenate([*(values.ravel() for values in white), np.zeros(len(problem.free))])
            out.append((factor, float(d @ self.product(d)) / unknown.size**2 * (1 + response)))
        return [(factor.astype(np.float32), spectrum.astype(np.float32)) for factor, spectrum in out]

    @cached_property
    def _local(self) -> NDArray[np.float64]:
        """Response of the images to the light of each point, but for a factor: that of dark pixels is large."""
        return self.model.unspread(self.problem.weights, *self._slopes) + 1e-300

    @cached_property
    def evidence(self) -> tuple[float, tuple[float, ...]]:
        """Minus the logarithm of the evidence of the phase's prior, and the growth of its variance.

        Laplace's approximation, with approximate eigenvalues e of the matrix: cost + sum(log e) / 2. The growth
        is the logarithm of the factor that makes the evidence stationary (MacKay 1992):
        |x|^2 / sum(1 - 1 / e), with the white numbers x.
        """
        size = self.problem.phase_map.size
        squares = float(np.sum(self.x[: size**2] ** 2))
        spectrum = self.filters[0][1]
        twice = np.full(spectrum.shape[1], 2.0)  # half the plane stands for all of it
        twice[0] = 1
        twice[-1] = 1 + size % 2
        determined = float(np.sum((1 - 1 / spectrum) * twice))
        return self.cost + float(np.sum(np.log(spectrum) * twice)) / 2, (growth_of(squares, determined),)

    def _response(self, probe: NDArray, answer: NDArray, of: PhaseMap | LightMap) -> NDArray[np.float64]:
        """Mean response of the images at each spatial frequency of a map."""
        f = self.problem.camera.f
        v, u = fft.fftfreq(len(probe))[:, None] * f, fft.rfftfreq(len(probe)) * f
        edges = np.linspace(0, 0.5 * f, _BINS + 1)
        bins = np.minimum(np.digitize(np.hypot(u, v), edges), _BINS).ravel() - 1
        sent, got = fft.rfft2(np.stack([probe, answer]))
        power = np.bincount(bins, (np.abs(sent) ** 2).ravel(), _BINS)
        heard = np.bincount(bins, (sent.conj() * got).real.ravel(), _BINS)
        # A random probe may hold nothing of a frequency.
        curve = heard / np.maximum(power, 1e-9 * power.max())
        curve = np.maximum(curve, _FAINTEST * curve.max())
        scale, gain = (1, f**2) if isinstance(of, PhaseMap) else (f, 1)
        v, u = fft.fftfreq(of.size)[:, None] * scale, fft.rfftfreq(of.size) * scale
        spectrum = np.exp(np.interp(np.hypot(u, v), (edges[1:] + edges[:-1]) / 2, np.log(curve)))
        return gain * of.colour**2 * spectrum

    def _filtered(self, d: NDArray, power: int) -> list[NDArray]:
        white, _ = self.problem.split(np.asarray(d, self.problem.camera.real))
        out = []
        for values, (factor, spectrum) in zip(white, self.filters, strict=True):
            maps = values.reshape(*d.shape[:-1], *factor.shape)
            filtered = fft.irfft2(fft.rfft2(maps * factor**power) * spectrum**power, s=factor.shape)
            out.append((filtered * factor**power).reshape(*d.shape[:-1], -1))
        return out

    @cached_property
    def _numbers(self) -> tuple[NDArray, NDArray]:
        """How the maps follow the free numbers, and the inverse of the matrix of the numbers then."""
        following = self.problem.following
        if following:
            return following.maps, following.inverse
        unit = np.sqrt(np.diagonal(self.block))
        scaled = self.block / np.outer(unit, unit) + 1e-9 * np.eye(len(unit))
        return np.zeros((len(unit), self.problem.n_white)), linalg.inv(scaled) / np.outer(unit, unit)

    def precondition(self, r: NDArray, held: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Approximate inverse of the matrix times vectors, in which what is held stays."""
        if self.problem.guide:
            return self.problem.guide.inverse(r)
        n, (follow, inverse) = self.problem.n_white, self._numbers
        free = np.where(held[n:], 0, (r[..., n:] - r[..., :n] @ follow.T) @ inverse)
        return np.concatenate([np.concatenate(self._filtered(r, -1), axis=-1) - free @ follow, free], axis=-1)

    def scale(self, d: NDArray) -> NDArray[np.float64]:
        """Matrix of the damping times vectors."""
        if self.problem.guide:
            return self.problem.guide.scale(d)
        free = d[..., self.problem.n_white :] / np.diagonal(self._numbers[1])
        return np.concatenate([*self._filtered(d, 1), free], axis=-1)

    def solve(
        self, right: NDArray, held: NDArray[np.bool_], n_inner: int, tolerance: float, damping: float = 0.0
    ) -> NDArray[np.float64]:
        """Solutions of the damped equations for one or several right sides, (n,) or (k, n); what is held stays.

        Block conjugate gradients (O'Leary 1980): each solution is the best in the directions of all right sides.
        """

        def product(d: NDArray) -> NDArray:
            out = np.concatenate([self.product(few) for few in np.array_split(d, -(-len(d) // _TOGETHER))])
            return out + damping * self.scale(d) if damping else out

        def free(vectors: NDArray) -> NDArray:
            return np.where(held, 0, vectors)

        r = free(np.atleast_2d(right))
        x, z = np.zeros_like(r), free(self.precondition(r, held))
        d, sizes = z, np.vecdot(r, z)
        goals = tolerance**2 * sizes
        for _ in range(n_inner):
            if np.all(sizes <= goals):
                break
            d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
            along = free(product(d))
            inverse = linalg.pinvh(d @ along.T, rtol=_DEPENDENT)
            step = inverse @ (d @ r.T)
            x, r = x + step.T @ d, r - step.T @ along
            z = free(self.precondition(r, held))
            d, sizes = z - (inverse @ (along @ z.T)).T @ d, np.vecdot(r, z)
        return x.reshape(np.shape(right))


def minimise(
    problem: Problem, x: NDArray, n_steps: int, n_inner: int, enough: float = 0.0,
    report: Callable[[int], Any] = lambda step: None,
) -> tuple[Point, bool]:  # fmt: skip
    """Levenberg and Marquardt's method on all unknowns, until a step promises no more than a part of 1.

    It ends earlier when a step promises less than `enough` of the cost. Where it is known how the maps follow the
    numbers, both must hold, the first for the numbers alone, and the maps may do a part of their own move.
    `report` is called before each step with its number, from 1 on. Returns whether it has converged, too.
    """
    point, following = Point(problem, x), problem.following
    damping, converged, promised = 1e-2, False, math.inf
    for step in range(n_steps):
        small = promised <= enough * point.cost
        if (converged and small) if following else (converged or small):
            break
        report(step + 1)
        for _ in range(10):
            change = point.matrix.solve(-point.gradient, point.stuck, n_inner, 0.03, damping)
            promised = -float(point.gradient @ change) / 2
            own = following.own(change) if following else 0.0
            shares = _SHARES if following else (0.0,)
            trial = min((point.moved(change - share * own) for share in shares), key=lambda tried: tried.cost)
            gain = point.cost - trial.cost
            if gain >= 0 or promised < _SETTLED:
                break
            damping *= 8
        moved = following.promised(change) if following else promised
        converged = moved < (_QUIET if following else _SETTLED) and damping < 0.1
        if gain >= 0:
            point = trial
        share = gain / promised if promised > 0 else 1.0
        damping *= 0.2 if share > 0.75 else 1.0 if share > 0.4 else 4.0
        damping = max(damping, _LEAST)
    return point, converged


class Eliminated:
    """Equations of the free numbers at a point, where the maps follow.

    The maps follow a number by -X, with X = H_mm^-1 H_mp, and the residuals change by its effect E = J_p - J_m X.
    Schur's complement S = E^T E + X^T X + prior is the matrix of the numbers. The error of S is of second order in
    that of X. X at a point nearby is the start for that of another one.
    """

    def __init__(self, point: Point) -> None:
        n, n_all, matrix, before = point.problem.n_white, len(point.x), point.matrix, point.problem.following
        held = np.arange(n_all) >= n
        self._unit = np.sqrt(np.diagonal(matrix.block))
        along = np.array([matrix.along(number) / unit for number, unit in enumerate(self._unit)])
        followed, right = np.zeros((len(along), n_all)), matrix.back(along)
        if before:
            followed[:, :n] = before.maps / self._unit[:, None]
            right -= [matrix.product(direction) for direction in followed]
        followed += matrix.solve(right, held, _N_FOLLOWED[before is not None], 0.01)
        self._effects = along - matrix.change(followed)
        self._x, self._e = followed[:, :n], self._effects.reshape(len(along), -1)
        self._known = self._x @ self._x.T + np.diag((point.problem.prior[1] / self._unit) ** 2)
        self._matrix = self._e @ self._e.T + self._known
        self._inverse = linalg.pinvh(self._matrix, rtol=_ALIKE)
        self.filters = matrix.filters
        self.maps: NDArray[np.float64] = self._x * self._unit[:, None]
        self.inverse: NDArray[np.float64] = self._inverse / np.outer(self._unit, self._unit)

    def promised(self, step: NDArray) -> float:
        """How much the numbers of a step of all unknowns lower the cost."""
        numbers = step[-len(self._unit) :] * self._unit
        return float(numbers @ self._matrix @ numbers) / 2

    def own(self, step: NDArray) -> NDArray[np.float64]:
        """The part of a step of all unknowns in which maps do not follow the numbers."""
        n = len(step) - len(self._unit)
        return np.concatenate([step[:n] + step[n:] @ self.maps, np.zeros(len(step) - n)])

    def covariance(self, point: Point, changes: NDArray, scale: float) -> NDArray[np.float64]:
        """Covariance of the numbers: of the noise, of what the model misses, and of changes of the images.

        That of the noise is S^-1 times `scale`. Where the model misses something, residuals are alike over some
        pixels, and the scores E^T r of square blocks scatter more than noise makes them:
        S^-1 (sum of their squares + X^T X + prior) S^-1 replaces what is smaller. A change d of the images, over
        their noise, moves the numbers by S^-1 E^T d = S^-1 (E^T (d - J_m y) + X^T y), where y = H_mm^-1 J_m^T d
        makes the error of second order. The errors of the model are taken to be a part of the rms of these moves.
        Few changes are known, so the rms, over the noise, is that of all numbers of a kind, such as the focus of
        both arms.
        """
        inverse, matrix, n = self._inverse, point.matrix, point.problem.n_white
        scores = _block_sums(np.sum(point.residuals * self._effects, axis=1))
        spread = np.diagonal(inverse @ (scores @ scores.T + self._known) @ inverse) / np.diagonal(inverse)
        grow = np.sqrt(np.maximum(scale, spread)) / self._unit
        y = matrix.solve(matrix.back(changes), np.arange(len(point.x)) >= n, _N_CHANGES, 0.01)
        alone = (changes - matrix.change(y)).reshape(len(changes), -1)
        moved = inverse @ (self._e @ alone.T + self._x @ y[:, :n].T)
        squares = np.mean(moved**2, axis=1) / np.diagonal(inverse)
        kinds = np.array([free.kind for free in point.problem.free])
        alike = np.array([np.mean(squares[kinds == kind]) for kind in kinds])
        missed = MISSED**2 * alike * np.diagonal(inverse) / self._unit**2
        return inverse * np.outer(grow, grow) + np.diag(missed)


def growth_of(squares: float, determined: float) -> float:
    """Growth of the variance of a prior, from the squares of the white numbers and how many are determined."""
    return math.log(max(squares / max(determined, 1), 0.01))  # an rms of 0 allows no phase


def _block_sums(images: NDArray) -> NDArray[np.float64]:
    """Sums over square blocks of pixels, (k, n_blocks), of k images."""
    rows, columns = (np.arange(0, length, _BLOCK) for length in images.shape[1:])
    return np.add.reduceat(np.add.reduceat(images, rows, axis=1), columns, axis=2).reshape(len(images), -1)
