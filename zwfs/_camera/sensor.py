"""Phases of pairs of frames with the optics of a fit, their error bars and a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from zwfs import _check
from zwfs._camera.bench import EXPLAINED, BenchFit, places_of
from zwfs._camera.light import KnownLight
from zwfs._camera.model import Camera, Exposure, Linearised
from zwfs._camera.recording import PAD
from zwfs._camera.solve import MapPrior, PhaseMap, Point, Problem, allowing, fine_phase, minimise
from zwfs._images import nearest_good
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

# Exponents of the spectrum of a phase, of which the evidence chooses, and how often it updates the rms. The smooth
# ones come first: from a rough phase, a smooth one is not found in a few steps.
_PRIORS = (8.0, 4), (5.0, 2), (3.0, 2)
_STRONGER = 4.5  # factor on the first rms for each unit of the exponent: the same density at about 10 cycles / D
_ALLOWED = 0.05  # error of the model in the first stage, over the light of a full pixel
_DRAWS = 12  # for the error bars of a phase


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
    prior : MapPrior
        Of the phase: `rms` (radian), `exponent` of the spectrum and `outer_scale` (D), as given or as chosen by
        the evidence.
    """

    phase: NDArray[np.float64]
    misfit: float
    consistent: bool
    converged: bool
    prior: MapPrior
    _point: Point

    @property
    def exponent(self) -> float:
        """Exponent of the spectrum of the prior."""
        return self.prior.exponent

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
        problem, right = point.problem, []
        for _ in range(_DRAWS):
            noise = rng.normal(size=problem.weights.shape) * (problem.weights > 0)
            right.append(point.matrix.back(noise) + rng.normal(size=point.x.shape))
        found = point.matrix.solve(np.array(right), np.zeros(point.x.shape, bool), 60, 0.03)
        draws = problem.phase_map.means(problem.split(found)[0][0])[:, PAD:-PAD, PAD:-PAD]
        lit = point.light_means[PAD:-PAD, PAD:-PAD] > 0.3
        left = np.stack([one - one[lit].mean() for one in draws])
        variance = ndimage.gaussian_filter(np.mean(left**2, axis=0), 1.0)
        return np.sqrt(variance * max(1.0, self.misfit))


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

    def __call__(self, frames: ArrayLike, sigma: ArrayLike, prior: MapPrior | None = None) -> FittedPhase:
        """Phase of one pair of frames.

        Parameters
        ----------
        frames : array_like, shape (2, ny, nx), counts
            Less the dark, with the exposure of the fit's frames. NaN marks bad pixels.
        sigma : array_like, shape (2, ny, nx) or a number, counts rms
            Noise of the pixels: ``sqrt(maximum(frames, 0) / gain + noise**2)`` with those of `fit_bench`.
        prior : MapPrior, optional
            That of an earlier result. It saves more than half of the time, and fits phases of the same roughness
            and strength only. By default the evidence chooses one.

        Returns
        -------
        FittedPhase
        """
        counts = _check.real_array("frames", frames)
        shape = (2, *self._fitted.camera.shape)
        if counts.shape != shape:
            raise ValueError(f"frames has shape {counts.shape}: expected {shape}")
        sigma = _check.real_array("sigma", sigma)
        if sigma.shape not in ((), shape):
            raise ValueError(f"sigma has shape {sigma.shape}: expected {shape}, or a number")
        if not np.all((sigma > 0) & (sigma < np.inf)):
            raise ValueError(
                f"sigma reaches from {sigma.min():.6g} to {sigma.max():.6g}: expected finite values above 0"
            )
        sigma = np.broadcast_to(sigma, shape)
        good = np.isfinite(counts)
        counts, weights = np.where(good, counts, 0), good / sigma
        # Where the start is wrong by a wave, edges of the pupil would hold it there.
        allowed = _ALLOWED * np.array([arm["flux"] for arm in self.fit.point.model.arms[:2]])
        soft = allowing(weights, allowed[:, None, None])
        start = self._start(counts)
        means = self._minimum(counts, soft, MapPrior(_rms_of(start), 3.0), start, 5, 20)[0].phase_means
        if prior is None:
            prior, means = self._chosen(counts, weights, means)
        point, converged = self._minimum(counts, weights, prior, means, self.n_steps, 30)
        misfit, phase = float(np.mean(point.misfit)), point.phase_means[PAD:-PAD, PAD:-PAD]
        return FittedPhase(phase, misfit, misfit < EXPLAINED, converged, prior, point)

    def _chosen(self, counts: NDArray, weights: NDArray, means: NDArray) -> tuple[MapPrior, NDArray]:
        """Prior that the evidence chooses, and the phase with it."""
        least = math.inf
        for exponent, n_updates in _PRIORS:
            rms, now = _rms_of(means) * _STRONGER ** (exponent - 4), means
            for _ in range(n_updates):
                point, _ = self._minimum(counts, weights, MapPrior(rms, exponent), now, 3, 30)
                now, (evidence, growth) = point.phase_means, point.matrix.evidence
                rms *= math.sqrt(max(growth, 0.01))  # an rms of 0 allows no phase
            if evidence > least:
                break
            least, prior, means = evidence, MapPrior(rms, exponent), now
        return prior, means

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

    def _minimum(
        self, counts: NDArray, weights: NDArray, prior: MapPrior, start: NDArray, n_steps: int, n_inner: int
    ) -> tuple[Point, bool]:
        """Fit of the phase alone."""
        of = self._fitted
        phase_map = PhaseMap(of.phase_map.n, of.camera.f, prior, of.camera.n_pixels)
        problem = Problem(self._camera, counts, weights, self._light, phase_map, (), self.fit.point.values)
        return minimise(problem, phase_map.white(start), n_steps, n_inner)

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
        leaked = min(masks["leakage"], 0.4)
        images = ((1 - leaked) * images - leaked * images[::-1]) / (1 - 2 * leaked)
        dimples = (Dimple(masks["diameter"], masks[name]) for name in ("first", "second"))
        sensor = ZernikeSensor(pupil, *dimples, tolerance=1e-5)
        found = PhaseShifted(sensor, n_iterations=25, tolerance=1e-3)(np.maximum(images, 0)).phase
        inside = ndimage.binary_erosion(pupil.inside) | (pupil.inside & (light > 0.8))
        phase = nearest_good(unwrapped(np.nan_to_num(found), inside), inside)
        return phase - phase[inside].mean()


def _rms_of(phase: NDArray) -> float:
    """First rms of a prior, from that of a phase in the middle of its map."""
    n = len(phase)
    return max(0.1, 2 * float(phase[n // 4 : -n // 4].std()))


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
