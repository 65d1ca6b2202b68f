"""Phases of pairs of frames with the optics of a fit, their error bars and a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._unwrapping import unwrapped
from zwfs.frames._explicit import Explicit, Posterior
from zwfs.frames._fit import EXPLAINED, BenchFit, places_of
from zwfs.frames._light import KnownLight
from zwfs.frames._optics import Camera, Exposure, Linearised
from zwfs.frames._solver import MapPrior, PhaseMap, Point, Problem, allowing, fine_phase, minimise
from zwfs.frames._states import PAD
from zwfs.frames.pipeline import unmixed
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

# Exponents of the spectrum of a phase, of which the evidence chooses. The smooth ones come first: from a rough
# phase, a smooth one is not found in a few steps.
_EXPONENTS = 8.0, 5.0, 3.0
_UPDATES = 4  # of the rms of a prior
_STATIONARY = 0.1  # logarithm of the factor on the variance of a prior, below which no update follows
_POWERS = 0.5, 2.0  # least and most power of this factor in an update of the rms
_STRONGER = 4.5  # factor on the first rms for each unit of the exponent: the same density at about 10 cycles / D
_ALLOWED = 0.05  # error of the model in the first stage, over the light of a full pixel
_LEAST, _MOST = 1e-12, 1e12  # counts: least of a noise, and most of a frame
_DRAWS = 12  # for the error bars of a phase


class PairFit(NamedTuple):
    """Phase of a pair of frames with the optics of a fit."""

    phase: NDArray[np.float64]  # (n, n), radian: mean over each pixel, that of the optics included
    sigma: NDArray[np.float64]  # (n, n), error bar of each pixel
    misfit: float  # mean square of the residuals over the noise
    consistent: bool  # whether the model explains these frames and those of the fit within their noise
    converged: bool
    prior: MapPrior  # as given, or as chosen by the evidence


@dataclass(frozen=True, eq=False)
class FittedSensor:
    """A sensor whose optics are those of a fit: pairs of frames in, phases out.

    The phase-shifted iteration with the fitted mask and amplitude gives a start. Then the phase alone is fitted
    with all of the model. In the first stage an error of the model adds to the noise, which keeps edges of the
    pupil from holding a wrong start. The prior is smooth to a degree that the evidence chooses: the probability of
    the frames with all phases of the prior.

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

    def __call__(
        self, frames: ArrayLike, sigma: ArrayLike | None = None, prior: MapPrior | None = None
    ) -> PairFit:
        """Phase of one pair of frames.

        Parameters
        ----------
        frames : array_like, shape (2, ny, nx), counts
            Less the dark, with the exposure of the fit's frames. NaN marks bad pixels.
        sigma : array_like, shape (2, ny, nx) or a number, counts rms, optional
            Noise of the pixels, by default ``sqrt(maximum(frames, 0) / gain + noise**2)`` with those of the fit;
            that of means of several frames is smaller.
        prior : MapPrior, optional
            That of an earlier result. It saves half of the time, and fits phases of the same roughness
            and strength only. By default the evidence chooses one.

        Returns
        -------
        PairFit
        """
        if prior is not None:
            _check.instance("prior", prior, MapPrior)
        counts = _check.real_array("frames", frames)
        shape = (2, *self._fitted.camera.shape)
        if counts.shape != shape:
            raise ValueError(f"frames has shape {counts.shape}: expected {shape}")
        if sigma is None:
            sigma = np.sqrt(np.maximum(np.nan_to_num(counts), 0) / self.fit.gain + self.fit.noise**2)
        sigma = _check.real_array("sigma", sigma)
        if sigma.shape not in ((), shape):
            raise ValueError(f"sigma has shape {sigma.shape}: expected {shape}, or a number")
        if np.nanmax(np.abs(counts), initial=0, where=np.isfinite(counts)) > _MOST:
            raise ValueError(f"frames reaches {np.nanmax(np.abs(counts)):.3g}: expected counts up to {_MOST:g}")
        if not np.all((sigma > _LEAST) & (sigma < np.inf)):
            raise ValueError(
                f"sigma reaches from {sigma.min():.6g} to {sigma.max():.6g}: expected finite values above "
                f"{_LEAST:g}"
            )
        sigma = np.broadcast_to(sigma, shape)
        good = np.isfinite(counts)
        counts, weights = np.where(good, counts, 0), good / sigma
        # Where the start is wrong by a wave, edges of the pupil would hold it there.
        allowed = _ALLOWED * np.array([arm["flux"] for arm in self.fit.point.model.arms[:2]])
        soft = allowing(weights, allowed[:, None, None])
        start = self._start(counts)
        problem = self._problem(counts, soft, MapPrior(_rms_of(start), 3.0))
        point = minimise(problem, problem.phase_map.white(start), 3, 12)[0]
        point = Point(replace(problem, weights=weights), point.x)
        point = self._chosen(point) if prior is None else self._under(prior, point, Explicit.of(point))
        point, converged = _lowered(point, self.n_steps)
        misfit, phase = float(np.mean(point.misfit)), point.phase_means[PAD:-PAD, PAD:-PAD]
        bars = _error_bars(point) * math.sqrt(max(1.0, misfit))
        explained = misfit < EXPLAINED and self.fit.consistent
        return PairFit(phase, bars, misfit, explained, converged, point.problem.phase_map.prior)

    def _chosen(self, start: Point) -> Point:
        """Phase with the prior that the evidence chooses."""
        exponent, rms, data = _EXPONENTS[0], _rms_of(start.phase_means), Explicit.of(start)
        prior = MapPrior(rms * _STRONGER ** (exponent - 4), exponent)
        point, converged = _lowered(self._under(prior, start, data), 4)
        if not converged:  # the matrix at the start may be far from that of this phase
            data = Explicit.of(point)
        best = None if data is None else data.best(point)
        least = math.inf
        for exponent in _EXPONENTS:
            prior = _denser(point.problem.phase_map.prior, exponent)
            tried, evidence = self._strongest(prior, point, data, best, least)
            if evidence > least:
                break
            least, point = evidence, tried
        return point

    def _strongest(
        self, prior: MapPrior, point: Point, data: Explicit | None, best: Any, least: float
    ) -> tuple[Point, float]:
        """Point with the strength of the prior at which the evidence is largest, and minus its logarithm.

        With an explicit matrix, the phase stays that of the point. A prior that is clearly worse than one with
        minus the logarithm `least` is not pursued.
        """
        tried: list[tuple[float, float]] = []
        for _ in range(_UPDATES):
            point = self._under(prior, point, data)
            guide = point.problem.guide
            point = point if guide else _lowered(point, 2)[0]
            evidence, growth = guide.evidence(best) if guide else point.matrix.evidence
            if abs(growth) < (_STATIONARY if evidence < least else 3 * _STATIONARY):
                break
            strength = math.log(prior.rms)
            power = 0.5 if growth > 0 else 1.0
            if tried:  # Newton's step with the slope between the last two
                before, then = tried[-1]
                power = float(np.clip((strength - before) / (then - growth), *_POWERS)) if then != growth else 0.5
            tried.append((strength, growth))
            prior = prior._replace(rms=prior.rms * math.exp(power * growth))
        return point, evidence

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
        fine = fine_phase(np.pad(phase, PAD, "edge"), self._fitted.camera.f)
        maps = self._light.maps(self._light.start, fine)
        return Linearised(self._camera, maps, self.fit.point.values).images

    @property
    def _fitted(self) -> Problem:
        return self.fit.point.problem

    @cached_property
    def _light(self) -> KnownLight:
        light = self.fit.point.light
        return KnownLight(self._fitted.light.maps(light, 0 * light), light)

    @cached_property
    def _camera(self) -> Camera:
        """The camera behind the two masks alone."""
        of = self._fitted.camera
        flat = np.zeros((1, of.n * of.f, of.n * of.f))
        settings: Any = [Exposure(0, 0, 0), Exposure(1, 1, 0)], flat, of.f, of.largest
        return Camera(of.n, of.shape, of.n_pixels, *settings, n_arms=of.n_arms)

    def _problem(self, counts: NDArray, weights: NDArray, prior: MapPrior) -> Problem:
        values = self.fit.point.values
        return Problem(self._camera, counts, weights, self._light, self._phase_map(prior), (), values)

    def _phase_map(self, prior: MapPrior) -> PhaseMap:
        of = self._fitted
        return PhaseMap(of.phase_map.n, of.camera.f, prior, of.camera.n_pixels)

    def _under(self, prior: MapPrior, point: Point, data: Explicit | None) -> Point:
        """The same phase with another prior."""
        phase_map = self._phase_map(prior)
        guide = None if data is None else Posterior(data, phase_map)
        problem = replace(point.problem, phase_map=phase_map, guide=guide)
        return Point(problem, phase_map.white(point.phase_means))

    def _start(self, counts: NDArray) -> NDArray[np.float64]:
        """Phase of the phase-shifted iteration on images brought back to the pupil, unwrapped and continued."""
        point, n = self.fit.point, self._fitted.phase_map.n
        light = np.maximum(point.light_means, 0)
        pupil = Pupil.from_amplitude(np.sqrt(light), self._fitted.camera.n_pixels, threshold=0.3)
        power = np.mean(pupil.amplitude[pupil.inside] ** 2) / np.mean(light[pupil.inside])
        masks, arms = point.model.masks, point.model.arms[:2]
        images = np.empty((2, n, n))
        for side, (arm, places) in enumerate(zip(arms, places_of(arms, n, counts.shape[1:]), strict=True)):
            image = (counts[side] - arm["background"]) / arm["flux"] * power
            images[side] = ndimage.map_coordinates(image, places, order=3, mode="nearest")
        images = unmixed(images, min(masks["leakage"], 0.4), masks["unmasked"], pupil.amplitude**2)
        dimples = (Dimple(masks["diameter"], masks[name]) for name in ("first", "second"))
        sensor = ZernikeSensor(pupil, *dimples, tolerance=1e-5)
        found = PhaseShifted(sensor, n_iterations=25, tolerance=1e-3)(np.maximum(images, 0)).phase
        inside = ndimage.binary_erosion(pupil.inside) | (pupil.inside & (light > 0.8))
        phase = nearest_good(unwrapped(np.nan_to_num(found), inside), inside)
        return phase - phase[inside].mean()


def _denser(prior: MapPrior, exponent: float) -> MapPrior:
    """Prior with another exponent, and the same density where images still show it."""
    return MapPrior(prior.rms * _STRONGER ** (exponent - prior.exponent), exponent)


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
