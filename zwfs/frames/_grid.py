"""Counts of camera images on the grid of the pupil, as fast as can be: splines and bad pixels of a calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, sparse
from scipy.interpolate import BSpline, NdBSpline

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._images import nearest_good
from zwfs._information import Response
from zwfs._propagator import square
from zwfs.frames.registration import _TOUCHED
from zwfs.pupil import Pupil
from zwfs.reconstructors import Arcsine, PhaseShifted
from zwfs.reconstructors.base import FixedPoint, Reconstructor
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

_FAR = 16  # pixels to which an edge is repeated
_REACH = 12  # pixels around the pupil that its splines need: farther ones weigh less than 2e-7
_RIM = 2  # pixels on both sides of the edge of the pupil, from which its place follows
_AWAY = 3  # pixels between a pupil and the nearest pixels in which the background is measured
_FEWEST, _MOST = 16, 200  # number of these far pixels
_STEEPEST = 1.2  # largest light of a far pixel without background, over that of its model
_OUTLYING = 4.0  # residual of a line over their rms, above which a pixel does not count
_CUT = _REACH - 1 - _RIM  # of these, those without a coefficient of a spline in the pupil or its rim
_NOISE = 0.2  # of the signal, in squares: the inverse of a blur goes no further
_STRAIGHT = 0.02  # pixels by which the places of a row or a column may differ from its mean
_NEGLIGIBLE = 1e-10  # of a weight: smaller ones only slow products down, much so if their products are subnormal


class Solved(NamedTuple):
    """Phases of k frame sets."""

    phase: NDArray  # (k, ny, nx), bad points filled
    n_iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    n_unsolved: NDArray[np.int64]


def iterated(
    reconstruct: Reconstructor, frames: NDArray, good: NDArray, start: NDArray | None = None,
    fill: Callable[[NDArray, NDArray], NDArray] | None = None,
) -> Solved:  # fmt: skip
    """Phases of ideal frames, (k, n_masks, ny, nx), which are changed, from good points (k, ny, nx).

    Bad points take no part: in a second iteration their intensity is that of the model, so that the reference wave
    has no hole.
    """
    sensor, fill = reconstruct.sensor, fill or _filled
    result = reconstruct(frames, start)
    phase, n_iterations, converged, n_unsolved = (
        getattr(result, name) for name in ("phase", "n_iterations", "converged", "n_unsolved")
    )
    phase[:, ~sensor.pupil.inside] = 0
    holes = sensor.pupil.inside & ~good
    spoiled = np.flatnonzero(holes.any(axis=(1, 2)))
    if spoiled.size:
        phase[spoiled] = fill(phase[spoiled], good[spoiled])
        model = sensor.measure(phase[spoiled])[(..., *sensor.window)]
        frames[spoiled] = np.where(holes[spoiled, np.newaxis], model, frames[spoiled])
        again = reconstruct(frames[spoiled], phase[spoiled] if reconstruct.iterative else None)
        phase[spoiled] = fill(np.where(sensor.pupil.inside, again.phase, 0), good[spoiled])
        n_iterations[spoiled] += again.n_iterations
        converged[spoiled], n_unsolved[spoiled] = again.converged, again.n_unsolved
    return Solved(phase, n_iterations, converged, n_unsolved)


def _filled(phase: NDArray, good: NDArray) -> NDArray:
    """Phases (k, ny, nx) with bad points replaced by the nearest good one."""
    return np.stack([nearest_good(*pair) for pair in zip(phase, good, strict=True)])


class Grid:
    """Constants of the calls of a calibration, in single precision, on a box of the camera around each pupil."""

    def __init__(self, calibration: Calibration) -> None:
        pupil = Pupil.from_amplitude(calibration.amplitude, calibration.diameter, calibration.center)
        # Outside the pupil a camera sees light that the model does not know.
        sensor = ZernikeSensor(pupil, *calibration.optics.focal_masks, tolerance=1e-6, recorded=pupil.inside)
        settings: dict[str, Any] = {"n_iterations": calibration.n_iterations, "tolerance": calibration.tolerance}
        self.reconstruct: FixedPoint = (
            Arcsine(sensor, **settings)
            if calibration.optics.single
            else PhaseShifted(sensor, accelerate=True, **settings)
        )
        self.response = Response.of(sensor)
        self.weights, self.offset = calibration.weights.astype(np.float32), calibration.offset.astype(np.float32)
        flat = sensor.measure(np.zeros(pupil.shape)).astype(np.float32)
        self.flat_frames = np.broadcast_to(flat, (2, *pupil.shape))
        near = ndimage.binary_dilation(pupil.inside, iterations=_RIM)
        inner = ndimage.binary_erosion(pupil.inside)
        self._near, rim = near.ravel().astype(float), near & ~inner
        rim[[0, -1]] = rim[:, [0, -1]] = False  # a slope needs neighbours
        self.rim, self._outside = np.flatnonzero(rim), ~pupil.inside
        self.beyond = ~pupil.inside.ravel()[self.rim]  # points of the rim outside the pupil
        self.edge = _repair(pupil.inside & ~inner, inner)  # points of the edge, and the nearest ones off it
        self._place(calibration, calibration.places)
        self._ignore(calibration.good)

    def moved(self, calibration: Calibration, shift: NDArray) -> Grid:
        """Grid of images that have moved on the camera by some rows and columns, both by the same ones.

        Dark and bad pixels stay where they are, and points that move onto bad pixels or off the camera are bad.
        """
        grid, places = copy(self), calibration.places + shift[:, np.newaxis, np.newaxis]
        grid._place(calibration, places)
        last = np.reshape(calibration.shape, (2, 1, 1)) - 1
        off = np.any((places < -0.5) | (places > last + 0.5), axis=(0, 1))
        grid._ignore(calibration.good & ~off & ~grid.touched(grid.bad[np.newaxis])[0])
        return grid

    def _place(self, calibration: Calibration, points: NDArray) -> None:
        """Set the boxes of the camera, and the way from them to points of the pupil, (2, 2, ny, nx)."""
        places = points.reshape(2, 2, -1)
        low = np.floor(places.min(axis=2)).astype(int) - _REACH
        size = (np.floor(places.max(axis=2)).astype(int) + _REACH + 2 - low).max(axis=0)
        self.boxes: list[tuple[int, Any, Any]] = []  # image, rows and columns
        for index, (row, column) in enumerate(low):
            axes = zip((row, column), size, calibration.shape, strict=True)
            self.boxes.append((min(index, calibration.n_images - 1), *(_span(*axis) for axis in axes)))
        pairs = calibration.dark, calibration.bad
        dark, bad = (np.stack([maps[i][rows][:, columns] for i, rows, columns in self.boxes]) for maps in pairs)
        self.dark, self.bad = dark + calibration.background[:, np.newaxis, np.newaxis].astype(np.float32), bad
        corners = places - low[:, :, np.newaxis]
        inside = self.reconstruct.sensor.pupil.inside.ravel().astype(float)
        self.touching = [_interpolation(place, size, 1, inside) for place in corners]  # from all pixels of a box
        self._corners = corners.reshape(points.shape)
        self.splines = [_interpolation(place - _CUT, size - 2 * _CUT, 3, self._near) for place in corners]
        self.filters = [_spline_filter(length, calibration.blur) for length in size]  # to their coefficients
        reached = np.stack([matrix.sum(axis=0) > 0 for matrix in self.touching])
        self.watched = reached.reshape(bad.shape) & ~bad  # good pixels from which the pupil is made
        self.dim = ~reached.reshape(bad.shape) & ~bad  # good pixels around it
        self._watch(calibration, points, low, size)
        # Bad pixels of each box with their nearest good ones.
        self.repairs = [_repair(pixels, ~pixels) for pixels in bad]

    def _watch(self, calibration: Calibration, points: NDArray, low: NDArray, size: NDArray) -> None:
        """Set the points far from both pupils, and the pixels of the boxes there, that show the background."""
        reached = pixels_around(points[:, :, ~self._outside], calibration.n_images, calibration.shape)
        dark = ~ndimage.binary_dilation(reached, np.ones((1, 3, 3)), _AWAY) & ~calibration.bad
        nearest, far = np.rint(points).astype(int), self._outside
        for (image, *_), pixels in zip(self.boxes, nearest, strict=True):
            on_camera = np.all((pixels >= 0) & (pixels < np.reshape(calibration.shape, (2, 1, 1))), axis=0)
            far = far & on_camera & dark[(image, *np.where(on_camera, pixels, 0))]
        chosen = np.flatnonzero(far)
        self.far = chosen[:: 1 + len(chosen) // _MOST] if len(chosen) >= _FEWEST else chosen[:0]
        rows, columns = nearest.reshape(2, 2, -1)[..., self.far].transpose(1, 0, 2)
        self.far_pixels = (rows - low[:, :1]) * size[1] + columns - low[:, 1:]
        images = np.reshape([box[0] for box in self.boxes], (2, 1))
        self.far_on_camera = np.ravel_multi_index((images, rows, columns), calibration.bad.shape)

    def _ignore(self, good: NDArray[np.bool_]) -> None:
        """Set the good points, and bad ones of the pupil with their nearest good ones."""
        self.good = good
        self.holes = _repair(self.reconstruct.sensor.pupil.inside & ~good, good)

    def on_grid(self, counts: NDArray, level: float, good: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Counts on the grid, (k, 2, n), good points, (k, ny, nx), and bad and saturated pixels, (k,)."""
        raw, good, n_bad, n_saturated = self.cleaned(counts, level, good)
        return self.resampled(raw), good, n_bad, n_saturated

    def resampled(self, raw: NDArray) -> NDArray[np.float32]:
        """Counts of the boxes, (k, 2, h, w), on the grid, (k, 2, n)."""
        coefficients = self.filters[0] @ raw @ self.filters[1].T
        values = np.stack(
            [spline @ coefficients[:, index].reshape(len(raw), -1).T for index, spline in enumerate(self.splines)]
        )
        return np.ascontiguousarray(values.transpose(2, 0, 1))

    def cleaned(self, counts: NDArray, level: float, good: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Counts of the boxes, (k, 2, h, w), less the dark and with bad pixels filled; the rest as `on_grid`."""
        k = len(counts)
        raw = np.empty((k, *self.dark.shape), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # larger numbers become infinite: bad pixels
            for index, (image, rows, columns) in enumerate(self.boxes):
                raw[:, index] = counts[:, image][:, rows][:, :, columns]
            good = np.broadcast_to(good, (k, *good.shape))
            n_bad = n_saturated = np.zeros(k, int)
            strange = np.zeros(k, bool)
            if not (raw.max() < level and raw.min() > -_check.LARGEST):  # takes a tenth of the full test
                odd = ~((raw < level) & (raw > -_check.LARGEST) | self.bad)
                strange = odd.any(axis=(1, 2, 3))
            if strange.any():
                spoiled = odd & self.watched
                n_bad = np.count_nonzero(spoiled, axis=(1, 2, 3))
                n_saturated = np.count_nonzero(spoiled & (raw >= level), axis=(1, 2, 3))
                good = good & ~self.touched(spoiled)
            raw -= self.dark
        flat = raw.reshape(k, len(self.boxes), -1)
        for index, (pixels, nearest) in enumerate(self.repairs):
            flat[:, index, pixels] = flat[:, index, nearest]
        for place in np.flatnonzero(strange):
            for index, spoiled_pixels in enumerate(odd[place]):
                usable = ~(spoiled_pixels | self.bad[index])
                raw[place, index] = nearest_good(raw[place, index], usable) if usable.any() else 0
        return raw, good, n_bad, n_saturated

    def straight(self, level: float) -> Straight | None:
        """Faster road onto the grid for single exposures of pixels below a level; None if the grid is turned."""
        lines = self._corners[:, 0].mean(axis=2), self._corners[:, 1].mean(axis=1)
        apart = self._corners - np.stack(
            np.broadcast_arrays(lines[0][..., np.newaxis], lines[1][:, np.newaxis]), 1
        )
        if np.abs(apart).max() > _STRAIGHT:
            return None
        pupils = []
        for box, dark, bad, *places in zip(self.boxes, self.dark, self.bad, *lines, strict=True):
            along = [
                _line(place - _CUT, len(onto)) @ onto for place, onto in zip(places, self.filters, strict=True)
            ]
            pupils.append(_StraightPupil.of(box, along, dark, bad))
        return Straight(pupils, self.offset.shape[1:], level)

    def solve(
        self, frames: NDArray, good: NDArray, start: NDArray | None = None, method: Reconstructor | None = None
    ) -> Solved:
        """Phases of ideal frames, shape (k, 2, ny, nx), which are changed."""
        reconstruct = method or self.reconstruct
        return iterated(reconstruct, frames[:, : self.reconstruct.sensor.n_masks], good, start, self.filled)

    def compared(self, phase: NDArray, frames: NDArray, good: NDArray) -> tuple[NDArray, NDArray]:
        """Rms difference of frames (k, 2, ny, nx) from those of phases, (k,), and the ratio of their light."""
        modelled, pupil = self.modelled(phase), self.reconstruct.sensor.pupil
        squares = np.sum((modelled - frames) ** 2, axis=(1, 2, 3), where=pupil.inside)
        where = good[:, np.newaxis]
        light, expected = (np.sum(pair - self.offset, axis=(1, 2, 3), where=where) for pair in (frames, modelled))
        with np.errstate(invalid="ignore", divide="ignore"):  # no point of a lost frame may be good
            return np.sqrt(squares / (2 * pupil.n_points)), light / expected

    def steady(self, phase: NDArray) -> NDArray:
        """Frames of phases, (k, 2, ny, nx), whose edge has the phase of points farther inside."""
        inner = phase.reshape(len(phase), -1).copy()
        inner[:, self.edge[0]] = inner[:, self.edge[1]]
        return self.modelled(inner.reshape(phase.shape))

    def displaced(self, steady: NDArray, frames: NDArray, good: NDArray) -> tuple[NDArray, NDArray]:
        """Displacement of both images on frames (k, 2, ny, nx), (k, 2) in pixels, and its standard error.

        The rim of the pupil moves with the images. A phase at the edge could follow it, hence the `steady` frames.
        They are wrong by a little, which changes the two images in opposite directions, so only their sum counts.
        """
        k, width = len(frames), frames.shape[3]
        modelled, measured = (pair.sum(axis=1).reshape(k, -1) for pair in (steady, frames))
        weight = good.reshape(k, -1)[:, self.rim] | self.beyond
        around = ((self.rim + step, self.rim - step) for step in (width, 1))
        slopes = weight * np.stack([(modelled[:, after] - modelled[:, before]) / 2 for after, before in around])
        missing = weight * (modelled - measured)[:, self.rim]
        normal = np.vecdot(slopes[:, np.newaxis], slopes).transpose(2, 0, 1).astype(float)
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, np.newaxis, np.newaxis] + 1e-30
        inverse = np.linalg.inv(normal + ridge * np.eye(2))  # a pseudo-inverse takes ten times as long
        shift = (inverse @ np.vecdot(slopes, missing).T[..., np.newaxis])[..., 0]
        missing -= np.einsum("ka,akp->kp", shift, slopes)
        variance = np.vecdot(missing, missing) / np.maximum(weight.sum(axis=1) - 2, 1)
        return shift, np.sqrt(variance[:, np.newaxis] * inverse[:, (0, 1), (0, 1)])

    def background(self, raw: NDArray, modelled: NDArray, unit: NDArray) -> tuple[NDArray, NDArray]:
        """Uniform light around the pupils that no phase explains, and its standard error; NaN if unknown.

        Diffracted light falls with the distance from the pupil. So the background is the constant of a line that
        gives the light of far pixels from modelled frames, (k, 2, ny, nx), whatever part of their light is there.
        The first result, (2, k, 2), has the best line, and the steepest one possible. The latter gives a lower
        limit with less noise. The pixels are those of boxes, (k, 2, h, w), and the units, (k, 2), are counts.
        """
        if not self.far.size:
            return np.full((2, len(raw), 2), np.nan), np.full((2, len(raw), 2), np.nan)
        values = np.stack([raw[:, i].reshape(len(raw), -1)[:, far] for i, far in enumerate(self.far_pixels)], 1)
        return _constant(
            values / unit[..., np.newaxis].astype(np.float32), modelled.reshape(len(raw), 2, -1)[..., self.far]
        )

    def modelled(self, phase: NDArray) -> NDArray:
        """Frames of phases on the grid of the pupil, (k, 2, ny, nx)."""
        model = self.reconstruct.settings.model(Kind.of(phase))
        psi = model.incoming(phase)
        frames = square(model.reference(psi) + psi[:, np.newaxis])
        return np.broadcast_to(frames, (len(frames), 2, *frames.shape[2:]))

    def noise(self, counts: NDArray) -> NDArray[np.float64]:
        """Noise of a pixel without light, (k, 2), counts rms, from neighbours around both pupils."""
        scatter = np.zeros((len(counts), 2))
        for index, (image, rows, columns) in enumerate(self.boxes):
            steps = np.diff(counts[:, image][:, rows][:, :, columns].astype(float), axis=2)
            steps = steps[:, self.dim[index, :, 1:] & self.dim[index, :, :-1]]
            if steps.shape[1]:
                scatter[:, index] = 1.4826 / np.sqrt(2) * np.median(np.abs(np.nan_to_num(steps)), axis=1)
        return scatter

    def filled(self, phase: NDArray, good: NDArray) -> NDArray:
        """Phases (k, ny, nx) with bad points replaced by the nearest good one."""
        flat = phase.reshape(len(phase), -1)
        inside = self.reconstruct.sensor.pupil.inside
        flat[:, self.holes[0]] = flat[:, self.holes[1]]
        n_static = np.count_nonzero(inside) - len(self.holes[0])
        for index in np.flatnonzero(np.count_nonzero(good, axis=(1, 2)) < n_static):
            if good[index].any():
                phase[index] = np.where(inside, nearest_good(phase[index], good[index]), 0)
        return phase

    def touched(self, spoiled: NDArray) -> NDArray[np.bool_]:
        """Points with a bad pixel on one of their sides: (k, 2, h, w) to (k, ny, nx)."""
        k, shape = len(spoiled), self.offset.shape[1:]
        weights = sum(
            matrix @ spoiled[:, index].reshape(k, -1).T.astype(np.float32)
            for index, matrix in enumerate(self.touching)
        )
        return (weights.T > _TOUCHED).reshape(k, *shape)


class _StraightPupil(NamedTuple):
    """Constants and arrays of one pupil, on the pixels of the camera that its box covers."""

    place: tuple[int, slice, slice]  # in an exposure
    rows: list[_Band]  # (ny, h)
    columns: list[_Band]  # (nx, w)
    dark: NDArray[np.float32]  # (h, w)
    repair: tuple[NDArray, NDArray]  # bad pixels and the nearest good ones
    raw: NDArray[np.float32]  # (h, w)
    half: NDArray[np.float32]  # (ny, w)

    @classmethod
    def of(
        cls, box: tuple[int, Any, Any], along: Sequence[NDArray], dark: NDArray, bad: NDArray
    ) -> _StraightPupil:
        """Cut a box to the camera: a row or column that it repeats counts as often."""
        spans, firsts, matrices = [], [], []
        for span, onto in zip(box[1:], along, strict=True):
            lines = np.arange(span.start, span.stop) if isinstance(span, slice) else span
            covered, first, places = np.unique(lines, return_index=True, return_inverse=True)
            matrices.append(onto @ (places[:, np.newaxis] == np.arange(len(covered))))
            spans.append(slice(covered[0], covered[-1] + 1))
            firsts.append(first)
        bad, dark = bad[np.ix_(*firsts)], np.ascontiguousarray(dark[np.ix_(*firsts)])
        repair = _repair(bad, ~bad)
        dark.ravel()[repair[0]] = dark.ravel()[repair[1]]
        rows, columns = map(_Band.halves, matrices)
        raw, half = np.empty(dark.shape, np.float32), np.empty((len(matrices[0]), dark.shape[1]), np.float32)
        return cls((box[0], spans[0], spans[1]), rows, columns, dark, repair, raw, half)


class _Band(NamedTuple):
    """Some rows of a matrix that is 0 far from a diagonal, cut to the columns that they need."""

    onto: slice
    read: slice
    part: NDArray[np.float32]

    @classmethod
    def halves(cls, matrix: NDArray) -> list[_Band]:
        """Both halves: small products run faster than the whole."""
        middle, bands = len(matrix) // 2, []
        for onto in (slice(middle), slice(middle, len(matrix))):
            needed = np.flatnonzero(np.abs(matrix[onto]).max(axis=0) > _NEGLIGIBLE)
            read = slice(needed[0], needed[-1] + 1)
            bands.append(cls(onto, read, np.ascontiguousarray(matrix[onto, read], np.float32)))
        return bands


class Straight:
    """Counts of one exposure on the grid of the pupil, whose rows and columns lie along those of the camera.

    Two products for each pupil take half the time of `Grid.on_grid`. All arrays are used again.
    """

    def __init__(self, pupils: Sequence[_StraightPupil], shape: tuple[int, ...], level: float) -> None:
        self._pupils, self._level = pupils, level
        self._values = np.empty((2, *shape), np.float32)

    def __call__(self, counts: NDArray) -> NDArray[np.float32] | None:
        """Counts (n_images, ny', nx') on the grid, (2, ny, nx), less the dark; None if a pixel is newly bad."""
        for pupil, values in zip(self._pupils, self._values, strict=True):
            raw = pupil.raw
            with np.errstate(over="ignore", invalid="ignore"):
                np.copyto(raw, counts[pupil.place], casting="unsafe")
            raw.ravel()[pupil.repair[0]] = raw.ravel()[pupil.repair[1]]
            if not raw.max() < self._level:
                return None
            np.subtract(raw, pupil.dark, out=raw)
            for onto, read, part in pupil.rows:
                np.matmul(part, raw[read], out=pupil.half[onto])
            for onto, read, part in pupil.columns:
                np.matmul(pupil.half[:, read], part.T, out=values[:, onto])
        return self._values


def pixels_around(places: NDArray, n_images: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels of n_images camera images of a shape next to places, (2, 2, n): rows and columns on both frames."""
    reached = np.zeros((n_images, *shape), bool)
    for index, corner in enumerate(np.floor(places).astype(int)):
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row, column = corner + np.reshape(step, (2, 1))
            inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
            reached[min(index, n_images - 1), row[inside], column[inside]] = True
    return reached


def _constant(values: NDArray, model: NDArray) -> tuple[NDArray, NDArray]:
    """Constants of lines from model to values along the last axis, and their standard errors, without outliers.

    The first line fits the values best, the second is the steepest one that they may have.
    """
    weight = np.ones_like(values)
    for _ in range(2):
        n = weight.sum(axis=-1, keepdims=True)
        level, middle = (np.vecdot(weight, array)[..., np.newaxis] / n for array in (values, model))
        away, missing = weight * (model - middle), weight * (values - level)
        spread = np.maximum(np.vecdot(away, away)[..., np.newaxis], 1e-12)
        slope = np.vecdot(away, missing)[..., np.newaxis] / spread
        missing -= slope * away
        variance = np.vecdot(missing, missing)[..., np.newaxis] / np.maximum(n - 2, 1)
        usual = np.abs(missing) <= _OUTLYING * np.sqrt(variance)
        if usual.all():
            break
        weight *= usual
    constants = np.stack([level - slope * middle, level - _STEEPEST * middle])
    return constants[..., 0], np.sqrt(variance * np.stack([1 / n + middle**2 / spread, 1 / n]))[..., 0]


def _span(low: int, size: int, length: int) -> Any:
    """Indices of an axis of the camera; beyond the edge it is repeated."""
    if low >= 0 and low + size <= length:
        return slice(low, low + size)
    return np.clip(np.arange(low, low + size), 0, length - 1)


def _repair(bad: NDArray[np.bool_], good: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
    """Flat indices of bad pixels and of the nearest good ones."""
    if not bad.any() or not good.any():
        return np.zeros(0, int), np.zeros(0, int)
    nearest = nearest_good(np.arange(bad.size, dtype=float).reshape(bad.shape), good).astype(int)
    return np.flatnonzero(bad), nearest[bad]


@lru_cache(maxsize=16)
def _spline_filter(size: int, blur: float) -> NDArray[np.float32]:
    """Matrix from samples to coefficients of a cubic spline near the pupil, with Wiener's inverse of a blur."""
    samples = np.pad(np.eye(size), ((_FAR, _FAR), (0, 0)), "edge")
    spread = np.exp(-2 * (np.pi * blur * fft.rfftfreq(len(samples))) ** 2)[:, np.newaxis]
    sharp = fft.rfft(samples, axis=0) * (spread * (1 + _NOISE) / (spread**2 + _NOISE))
    matrix = fft.irfft(sharp, n=len(samples), axis=0)[_FAR:-_FAR] if blur else np.eye(size)
    matrix = ndimage.spline_filter1d(matrix, 3, axis=0, mode="nearest")
    matrix = np.where(np.abs(matrix) > _NEGLIGIBLE, matrix, 0).astype(np.float32)
    return np.ascontiguousarray(matrix[_CUT:-_CUT])


def _line(places: NDArray, size: int) -> NDArray[np.float64]:
    """Matrix from coefficients of a cubic spline, 1 pixel apart, to places along a line."""
    knots = np.arange(-2, size + 2, dtype=float)
    return np.asarray(BSpline.design_matrix(places, knots, 3).toarray())


def _interpolation(places: NDArray, size: NDArray, degree: int, inside: NDArray) -> sparse.csr_array:
    """Sparse matrix from coefficients of splines, of degree 1 pixels, to places (2, n); 0 where not inside."""
    around = (degree + 1) // 2
    knots = tuple(np.arange(-around, length + around, dtype=float) for length in size)
    basis = NdBSpline.design_matrix(np.ascontiguousarray(places.T), knots, degree)
    matrix = sparse.diags_array(inside) @ sparse.csr_array(basis)
    matrix.data[np.abs(matrix.data) <= _NEGLIGIBLE] = 0
    matrix.eliminate_zeros()
    # Half the bytes of each number: reading them takes much of the time of a product.
    index = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    return sparse.csr_array((matrix.data.astype(np.float32), *index), shape=(len(inside), size.prod()))
