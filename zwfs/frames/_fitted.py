"""Phases of camera images with the fitted optics of a calibration and a smooth prior."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._unwrapping import unwrapped
from zwfs.frames._explicit import Explicit, Posterior
from zwfs.frames._fit import EXPLAINED, BenchFit, places_of
from zwfs.frames._optics import Camera, Exposure, Linearised, pooled
from zwfs.frames._segments import Segments
from zwfs.frames._solver import MapPrior, PhaseMap, Point, Problem, allowing, fine_phase, minimise
from zwfs.frames._states import PAD
from zwfs.frames.phases import Flag, Phases
from zwfs.frames.pipeline import MOST_BAD, unmixed
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

WIDEST = 2**16  # rows or columns of a camera
_N_STEPS = 8  # most steps for a pair
# Exponents of the spectrum of a phase, of which the evidence chooses. The smooth ones come first: from a rough
# phase, a smooth one is not found in a few steps.
_EXPONENTS = 8.0, 5.0, 3.0
_UPDATES = 4  # of the rms of a prior
_STATIONARY = 0.1  # logarithm of the factor on the variance of a prior, below which no update follows
_POWERS = 0.5, 2.0  # least and most power of this factor in an update of the rms
_STRONGER = 4.5  # factor on the first rms for each unit of the exponent: the same density at about 10 cycles / D
_LEAST_JUMP = 0.01  # radian, rms of jumps, below which a phase has none
_ALLOWED = 0.05  # error of the model in the first stage, over the light of a full pixel
_LEAST, _MOST = 1e-12, 1e12  # counts: least of a noise, and most of a frame
_DRAWS = 12  # for the error bars of a phase


class PairFit(NamedTuple):
    """Phase of a pair of frames with the optics of a fit."""

    phase: NDArray[np.float64]  # (n, n), radian: mean over each pixel, that of the optics included
    sigma: NDArray[np.float64]  # (n, n), error bar of each pixel
    misfit: float  # mean square of the residuals over the noise
    converged: bool
    prior: MapPrior  # as given, or as chosen by the evidence


class Windows(NamedTuple):
    """Windows around the two pupils on one or two images of a camera."""

    corners: NDArray[np.int64]  # (2, 2), row and column of their first pixels
    size: tuple[int, int]
    n_images: int
    shape: tuple[int, int]  # of an image

    @classmethod
    def of(cls, calibration: Calibration, bench: BenchFit) -> Windows:
        """Windows whose frames a calibration was fitted to."""
        size, n = bench.model.shape, len(bench.light)
        first = places_of(bench.model.arms, n, size)[:, :, 0, 0]
        corners = np.rint(calibration.places[:, :, 0, 0] - first).astype(int)
        return cls(corners, size, calibration.n_images, calibration.shape)

    @property
    def places(self) -> list[tuple[int, slice, slice]]:
        """Image, rows and columns of each window."""
        height, width = self.size
        return [
            (min(index, self.n_images - 1), slice(row, row + height), slice(column, column + width))
            for index, (row, column) in enumerate(self.corners)
        ]

    def cut(self, images: NDArray) -> NDArray:
        """Windows (..., 2, height, width) of images (..., n_images, ny, nx)."""
        return np.stack([images[(..., *place)] for place in self.places], axis=-3)

    def on_camera(self, pairs: NDArray) -> NDArray:
        """Images (k, n_images, ny, nx) with windows (k, 2, height, width), and 0 elsewhere."""
        images = np.zeros((len(pairs), self.n_images, *self.shape))
        for index, place in enumerate(self.places):
            images[(slice(None), *place)] = pairs[:, index]
        return images


def smooth_phases(
    calibration: Calibration, counts: NDArray, level: float, prior: bool | MapPrior, noise: Any
) -> Phases:
    """Phases of exposures (k, n_images, ny, nx), one fit each, see `Calibration.__call__`."""
    bench = calibration.bench
    if bench is None:
        raise ValueError(
            "smooth needs the `bench` of a calibration, and this one has none: expected one from known commands"
        )
    if not isinstance(prior, MapPrior) and prior is not True:
        raise TypeError(f"smooth = {_check.shown(prior)}: expected True or False, or one of `priors` of phases")
    sensor, windows = FittedSensor(bench), Windows.of(calibration, bench)
    sigma = None if noise is None else windows.cut(_checked_noise(noise, counts.shape[1:]))
    _, good, n_bad, n_saturated = calibration._work.on_grid(counts, level, calibration.good)
    inside = calibration.sensor.pupil.inside
    lost = np.count_nonzero(good, axis=(1, 2)) < (1 - MOST_BAD) * np.count_nonzero(inside)
    empty = np.full(inside.shape, np.nan)
    fits = [PairFit(empty, empty, np.nan, False, MapPrior(np.nan))] * len(counts)
    for number in np.flatnonzero(~lost):
        exposure = counts[number].astype(float)
        usable = (exposure < level) & (exposure > -_check.LARGEST) & ~calibration.bad
        if np.abs(exposure).max(initial=0, where=usable) > _MOST:
            raise ValueError(f"counts reaches {exposure[usable].max():.3g}: expected counts up to {_MOST:g}")
        pair = windows.cut(np.where(usable, exposure - calibration.dark, np.nan))
        fits[number] = sensor.phase(pair, sigma, None if prior is True else prior)
    phase, bars, misfit, converged = (np.array([fit[index] for fit in fits]) for index in range(4))
    consistent = (misfit < EXPLAINED) & bench.consistent
    flags = Flag.LOST * lost + Flag.BAD_PIXELS * (n_bad > 0) + Flag.SATURATED * (n_saturated > 0)
    flags += Flag.INCONSISTENT * ~(consistent | lost) + Flag.NOT_CONVERGED * ~(converged | lost)
    unknown, zero = np.full(len(counts), np.nan, np.float32), np.zeros(len(counts), int)
    return Phases(
        phase=np.where(inside, phase, np.nan),
        filled=np.where(inside, np.nan_to_num(phase), 0),
        flux=np.where(lost, unknown, 1),
        n_bad=n_bad,
        n_saturated=n_saturated,
        residual=unknown,
        displacement=np.stack([unknown, unknown], axis=-1),
        background=np.stack([unknown, unknown], axis=-1),
        n_iterations=zero,
        n_unsolved=zero,
        flags=np.asarray(flags, int),
        sigma=np.where(inside, bars, np.nan),
        misfit=misfit,
        priors=tuple(fit.prior for fit in fits),
    )


def _checked_noise(noise: Any, images: tuple[int, ...]) -> NDArray[np.float64]:
    """Noise of the pixels of camera images, (n_images, ny, nx)."""
    noise = _check.real_array("noise", noise)
    if noise.shape not in ((), images[1:], images):
        raise ValueError(f"noise has shape {noise.shape}: expected {images[1:]} or {images}, or a number")
    if not np.all((noise > _LEAST) & (noise < np.inf)):
        raise ValueError(
            f"noise reaches from {noise.min():.6g} to {noise.max():.6g}: expected finite values above {_LEAST:g}"
        )
    return np.broadcast_to(noise, images)


class FittedSensor:
    """A sensor whose optics are those of a fit: pairs of frames in, phases out.

    The phase-shifted iteration with the fitted mask and amplitude gives a start. Then the phase alone is fitted
    with all of the model. In the first stage an error of the model adds to the noise, which keeps edges of the
    pupil from holding a wrong start. The prior is smooth to a degree that the evidence chooses: the probability of
    the frames with all phases of the prior. On a pupil with segments and not too many pixels, the evidence
    also chooses whether the phase jumps between them.
    """

    def __init__(self, fit: BenchFit) -> None:
        self.fit, self._model = fit, fit.model
        of, side = fit.model, len(fit.model.light.start)
        pair = [Exposure(0, 0, 0), Exposure(1, 1, 0)]
        settings: Any = pair, np.zeros((1, side, side)), of.oversampling, of.largest
        self._camera = Camera(of.n, of.shape, of.n_pixels, *settings)
        few = Explicit.suits(np.maximum(of.light.start, 0), of.oversampling)
        self._segments = Segments.of(of) if few else None  # conjugate gradients without the matrix are too slow

    def frames(self, phase: NDArray) -> NDArray[np.float64]:
        """Frames (2, ny, nx), counts, of a phase (n, n) that includes that of the optics."""
        fine = fine_phase(np.pad(phase, PAD, "edge"), self._camera.f)
        maps = self._model.light.maps(self._model.light.start, fine)
        return Linearised(self._camera, maps, self._model.values).images

    def phase(self, counts: NDArray, sigma: NDArray | None, prior: MapPrior | None) -> PairFit:
        """Phase of a pair of frames (2, ny, nx) less the dark, NaN at bad pixels, with the noise of its pixels."""
        if sigma is None:
            sigma = np.sqrt(np.maximum(np.nan_to_num(counts), 0) / self.fit.gain + self.fit.noise**2)
        good = np.isfinite(counts)
        counts, weights = np.where(good, counts, 0), good / sigma
        # Where the start is wrong by a wave, edges of the pupil would hold it there.
        allowed = _ALLOWED * np.array([arm["flux"] for arm in self._model.arms])
        soft = allowing(weights, allowed[:, None, None])
        start = self._start(counts)
        segments = self._segments if prior is None or prior.jumps else None
        phase_map = self._phase_map(MapPrior(_rms_of(start), 3.0), segments)
        problem = Problem(self._camera, counts, soft, self._model.light, phase_map, (), self._model.values)
        point = minimise(problem, phase_map.white(start), 3, 12)[0]
        point = Point(replace(problem, weights=weights), point.x)
        point = self._chosen(point) if prior is None else self._under(prior, point, Explicit.of(point))
        point, converged = _lowered(point, _N_STEPS)
        misfit = float(np.mean(point.misfit))
        bars = _error_bars(point) * math.sqrt(max(1.0, misfit))
        inner = slice(PAD, -PAD)
        return PairFit(point.phase_means[inner, inner], bars, misfit, converged, point.problem.phase_map.prior)

    def _chosen(self, start: Point) -> Point:
        """Phase with the prior that the evidence chooses."""
        exponent, rms, data = _EXPONENTS[0], _rms_of(start.phase_means), Explicit.of(start)
        jumps = rms / 2 if start.problem.phase_map.segments else 0.0
        prior = MapPrior(rms * _STRONGER ** (exponent - 4), exponent, jumps=jumps)
        point, converged = _lowered(self._under(prior, start, data), 4)
        if not converged:  # the matrix at the start may be far from that of this phase
            data = Explicit.of(point)
        best = None if data is None else data.best(point)
        point, least = self._smoothest(point, data, best, math.inf)
        prior = point.problem.phase_map.prior
        if not prior.jumps:
            return point
        whole, without = self._smoothest(self._under(prior._replace(jumps=0.0), point, data), data, best, least)
        return whole if without < least else point

    def _smoothest(self, point: Point, data: Explicit | None, best: Any, least: float) -> tuple[Point, float]:
        """Point with the exponent of the prior at which the evidence is largest, and minus its logarithm.

        The point stays if minus the logarithm exceeds `least` for the smoothest prior.
        """
        for exponent in _EXPONENTS:
            prior = _denser(point.problem.phase_map.prior, exponent)
            tried, evidence = self._strongest(prior, point, data, best, least)
            if evidence > least:
                break
            least, point = evidence, tried
        return point, least

    def _strongest(
        self, prior: MapPrior, point: Point, data: Explicit | None, best: Any, least: float
    ) -> tuple[Point, float]:
        """Point with the strength of the prior at which the evidence is largest, and minus its logarithm.

        With an explicit matrix, the phase stays that of the point. A prior that is clearly worse than one with
        minus the logarithm `least` is not pursued.
        """
        tried: list[list[tuple[float, float]]] = []
        for _ in range(_UPDATES):
            point = self._under(prior, point, data)
            guide = point.problem.guide
            point = point if guide else _lowered(point, 2)[0]
            evidence, growths = guide.evidence(best) if guide else point.matrix.evidence
            if max(map(abs, growths)) < (_STATIONARY if evidence < least else 3 * _STATIONARY):
                break
            strengths = [math.log(strength) for strength in prior.strengths]
            before = tried[-1] if tried and len(tried[-1]) == len(growths) else [None] * len(growths)
            tried.append(list(zip(strengths, growths, strict=True)))
            prior = prior.scaled([math.exp(_step(*pair)) for pair in zip(tried[-1], before, strict=True)])
            if prior.jumps < _LEAST_JUMP:
                prior = prior._replace(jumps=0.0)
        return point, evidence

    def _phase_map(self, prior: MapPrior, segments: Segments | None) -> PhaseMap:
        return PhaseMap(self._camera.n, self._camera.f, prior, self._camera.n_pixels, segments)

    def _under(self, prior: MapPrior, point: Point, data: Explicit | None) -> Point:
        """The same phase with another prior."""
        before = point.problem.phase_map
        phase_map = self._phase_map(prior, before.segments)
        guide = None if data is None else Posterior(data, phase_map)
        problem = replace(point.problem, phase_map=phase_map, guide=guide)
        return Point(problem, phase_map.white(point.phase_means, before.steps(point.x)))

    def _start(self, counts: NDArray) -> NDArray[np.float64]:
        """Phase of the phase-shifted iteration on images brought back to the pupil, unwrapped and continued."""
        model, n = self._model, self._model.n
        light = np.maximum(pooled(model.light.start, model.oversampling), 0)
        pupil = Pupil.from_amplitude(np.sqrt(light), model.n_pixels, threshold=0.3)
        power = np.mean(pupil.amplitude[pupil.inside] ** 2) / np.mean(light[pupil.inside])
        masks, arms = model.masks, model.arms
        images = np.empty((2, n, n))
        for side, (arm, places) in enumerate(zip(arms, places_of(arms, n, counts.shape[1:]), strict=True)):
            image = (counts[side] - arm["background"]) / arm["flux"] * power
            images[side] = ndimage.map_coordinates(image, places, order=3, mode="nearest")
        images = unmixed(images, min(masks["leakage"], 0.4), masks["unmasked"], pupil.amplitude**2)
        dimples = (Dimple(masks["diameter"], masks[name]) for name in ("first", "second"))
        sensor = ZernikeSensor(pupil, *dimples, tolerance=1e-5)
        found = PhaseShifted(sensor, n_iterations=25, tolerance=1e-3)(np.maximum(images, 0)).phase
        inside = ndimage.binary_erosion(pupil.inside) | (pupil.inside & (light > 0.8))
        phase = nearest_good(self._unwrapped(np.nan_to_num(found), inside), inside)
        return phase - phase[inside].mean()

    def _unwrapped(self, phase: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Phase without jumps of 2 pi in a segment; those between segments may be steps."""
        whole = unwrapped(phase, inside)
        if self._segments is None:
            return whole
        out, numbers = whole.copy(), self._segments.numbers
        for number in range(1, numbers.max() + 1):
            own = inside & (numbers == number)
            if own.any():
                part = unwrapped(phase, own)[own]
                out[own] = part + 2 * np.pi * np.rint(np.median(whole[own] - part) / (2 * np.pi))
        return out


def _step(now: tuple[float, float], before: tuple[float, float] | None) -> float:
    """Change of the logarithm of a strength, from those and the growths now and before."""
    strength, growth = now
    power = 0.5 if growth > 0 else 1.0
    if before:  # Newton's step with the slope between the last two
        power = 0.5
        if before[1] != growth:
            power = float(np.clip((strength - before[0]) / (before[1] - growth), *_POWERS))
    return power * growth


def _denser(prior: MapPrior, exponent: float) -> MapPrior:
    """Prior with another exponent, and the same density where images still show it."""
    return prior._replace(rms=prior.rms * _STRONGER ** (exponent - prior.exponent), exponent=exponent)


def _lowered(point: Point, n_steps: int) -> tuple[Point, bool]:
    """Point with a lower cost, and whether it has converged."""
    return minimise(point.problem, point.x, n_steps, 30 if point.problem.guide is None else 15)


def _error_bars(point: Point) -> NDArray[np.float64]:
    """Error bar of each pixel of a phase, from draws of the noise and of the prior."""
    problem, right, rng = point.problem, [], np.random.default_rng(0)  # the choice changes them by some percent
    for _ in range(_DRAWS):
        noise = rng.normal(size=problem.weights.shape) * (problem.weights > 0)
        right.append(point.matrix.back(noise) + rng.normal(size=point.x.shape))
    found = point.matrix.solve(np.array(right), np.zeros(point.x.shape, bool), 60, 0.03)
    draws = problem.phase_map.means(problem.split(found)[0][0])[:, PAD:-PAD, PAD:-PAD]
    lit = point.light_means[PAD:-PAD, PAD:-PAD] > 0.3
    left = np.stack([one - one[lit].mean() for one in draws])
    return np.sqrt(ndimage.gaussian_filter(np.mean(left**2, axis=0), 1.0))


def _rms_of(phase: NDArray) -> float:
    """First rms of a prior, from that of a phase in the middle of its map."""
    n = len(phase)
    return max(0.1, 2 * float(phase[n // 4 : -n // 4].std()))
