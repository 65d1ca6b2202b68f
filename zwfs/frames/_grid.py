"""Counts of camera images on the grid of the pupil, as fast as can be: splines and bad pixels of a calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, sparse

from zwfs import _check
from zwfs._information import Response
from zwfs.frames.registration import _TOUCHED, nearest_good
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

_FAR = 16  # pixels to which an edge is repeated
_REACH = 12  # pixels around the pupil that its splines need: farther ones weigh less than 2e-7
_CUT = _REACH - 1  # of these, those without a coefficient of a spline in the pupil
_NOISE = 0.2  # of the signal, in squares: the inverse of a blur goes no further
_NEGLIGIBLE = 1e-10  # of a weight: smaller ones only slow products down, much so if their products are subnormal


class Grid(NamedTuple):
    """Constants of the calls of a calibration, in single precision, on a box of the camera around each pupil."""

    reconstruct: PhaseShifted
    response: Response
    n_points: int
    weights: NDArray[np.float32]
    offset: NDArray[np.float32]
    flat_frames: NDArray[np.float32]
    boxes: list[tuple[int, Any, Any]]  # image, rows and columns
    dark: NDArray[np.float32]  # (2, h, w), background included
    bad: NDArray[np.bool_]  # (2, h, w)
    watched: NDArray[np.bool_]  # (2, h, w), good pixels from which the pupil is made
    repairs: list[tuple[NDArray, NDArray]]  # bad pixels of each box, and their nearest good ones
    filters: tuple[NDArray[np.float32], NDArray[np.float32]]  # spline coefficients along rows and columns
    splines: list[Any]  # sparse (ny nx, h' w'), cubic, 0 outside the pupil
    touching: list[Any]  # sparse (ny nx, h w), linear
    holes: tuple[NDArray, NDArray]  # bad points of the pupil, and their nearest good ones

    @classmethod
    def of(cls, calibration: Calibration) -> Grid:
        pupil = Pupil.from_amplitude(calibration.amplitude, calibration.diameter, calibration.center)
        masks = (Dimple(calibration.optics.diameter, shift) for shift in calibration.optics.phase_shifts)
        sensor = ZernikeSensor(pupil, *masks, tolerance=1e-6)
        settings: dict[str, Any] = {"n_iterations": calibration.n_iterations, "tolerance": calibration.tolerance}
        places = calibration.places.reshape(2, 2, -1)
        low = np.floor(places.min(axis=2)).astype(int) - _REACH
        size = (np.floor(places.max(axis=2)).astype(int) + _REACH + 2 - low).max(axis=0)
        boxes = []
        for index, (row, column) in enumerate(low):
            axes = zip((row, column), size, calibration.shape, strict=True)
            boxes.append((min(index, calibration.n_images - 1), *(_span(*axis) for axis in axes)))
        dark = np.stack([calibration.dark[i][rows][:, columns] for i, rows, columns in boxes])
        bad = np.stack([calibration.bad[i][rows][:, columns] for i, rows, columns in boxes])
        corners = places - low[:, :, np.newaxis]
        touching = [_interpolation(corner, tuple(size)) for corner in corners]
        inside = pupil.inside.ravel().astype(float)
        reached = np.stack([one.T @ inside > 0 for one in touching]).reshape(bad.shape)
        return cls(
            PhaseShifted(sensor, accelerate=True, **settings),
            Response.of(sensor),
            pupil.n_points,
            calibration.weights.astype(np.float32),
            calibration.offset.astype(np.float32),
            sensor.measure(np.zeros(pupil.shape)).astype(np.float32),
            boxes,
            dark + calibration.background[:, np.newaxis, np.newaxis].astype(np.float32),
            bad,
            reached & ~bad,
            [_repair(one, ~one) for one in bad],
            (_spline_filter(size[0], calibration.blur), _spline_filter(size[1], calibration.blur)),
            [_interpolation(one - _CUT, tuple(size - 2 * _CUT), pupil.inside.ravel()) for one in corners],
            touching,
            _repair(pupil.inside & ~calibration.good, calibration.good),
        )

    def on_grid(self, counts: NDArray, level: float, good: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Counts on the grid, (k, 2, n), good points, (k, ny, nx), and bad and saturated pixels, (k,)."""
        k = len(counts)
        raw = np.empty((k, *self.dark.shape), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # larger numbers become infinite: bad pixels
            for index, (image, rows, columns) in enumerate(self.boxes):
                raw[:, index] = counts[:, image][:, rows][:, :, columns]
            odd = ~((raw < level) & (raw > -_check.LARGEST) | self.bad)
            good = np.broadcast_to(good, (k, *good.shape))
            n_bad = n_saturated = np.zeros(k, int)
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
            for index, one in enumerate(odd[place]):
                usable = ~(one | self.bad[index])
                raw[place, index] = nearest_good(raw[place, index], usable) if usable.any() else 0
        coefficients = self.filters[0] @ raw @ self.filters[1].T
        values = np.stack(
            [spline @ coefficients[:, index].reshape(k, -1).T for index, spline in enumerate(self.splines)]
        )
        return np.ascontiguousarray(values.transpose(2, 0, 1)), good, n_bad, n_saturated

    def solve(
        self, frames: NDArray, good: NDArray, start: NDArray | None, judge: bool
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Phases with bad points filled, iterations, whether they converged, and residuals of ideal frames.

        Bad points take no part: in a second iteration their intensity is that of the model. The frames, shape
        (k, 2, ny, nx), are changed.
        """
        reconstruct, sensor = self.reconstruct, self.reconstruct.sensor
        found = reconstruct(frames, start)
        phase, n_iterations, converged = found.phase, found.n_iterations, found.converged
        phase[:, ~sensor.pupil.inside] = 0
        holes = sensor.pupil.inside & ~good
        some = np.flatnonzero(holes.any(axis=(1, 2)))
        if some.size:
            phase[some] = self.filled(phase[some], good[some])
            frames[some] = np.where(holes[some, np.newaxis], sensor.measure(phase[some]), frames[some])
            found = reconstruct(frames[some], phase[some])
            phase[some] = self.filled(np.where(sensor.pupil.inside, found.phase, 0), good[some])
            n_iterations[some] += found.n_iterations
            converged[some] = found.converged
        blind = np.full(len(phase), np.nan, np.float32)
        return phase, n_iterations, converged, reconstruct.settings.residual(phase, frames) if judge else blind

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
            one @ spoiled[:, index].reshape(k, -1).T.astype(np.float32) for index, one in enumerate(self.touching)
        )
        return (weights.T > _TOUCHED).reshape(k, *shape)


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


def _spline_filter(size: int, blur: float) -> NDArray[np.float32]:
    """Matrix from samples to coefficients of a cubic spline near the pupil, with Wiener's inverse of a blur."""
    samples = np.pad(np.eye(size), ((_FAR, _FAR), (0, 0)), "edge")
    spread = np.exp(-2 * (np.pi * blur * fft.rfftfreq(len(samples))) ** 2)[:, np.newaxis]
    sharp = fft.rfft(samples, axis=0) * (spread * (1 + _NOISE) / (spread**2 + _NOISE))
    matrix = fft.irfft(sharp, n=len(samples), axis=0)[_FAR:-_FAR] if blur else np.eye(size)
    matrix = ndimage.spline_filter1d(matrix, 3, axis=0, mode="nearest")
    matrix = np.where(np.abs(matrix) > _NEGLIGIBLE, matrix, 0).astype(np.float32)
    return np.ascontiguousarray(matrix[_CUT:-_CUT])


def _interpolation(places: NDArray, size: tuple[int, int], inside: NDArray | None = None) -> Any:
    """Sparse matrix to places (2, n): of cubic splines from coefficients, 0 outside, or linear, from pixels."""
    base = np.floor(places)
    t, u = places - base, 1 - places + base
    if inside is None:
        m, weights = 2, np.stack([u, t])
    else:
        cubics = np.stack([u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3])
        m, weights = 4, cubics * inside / 6
    values = weights[:, np.newaxis, 0] * weights[np.newaxis, :, 1]
    values = np.where(np.abs(values) > _NEGLIGIBLE, values, 0)
    first, steps = base.astype(int) - (m == 4), np.arange(m)
    rows = first[0] + steps[:, np.newaxis, np.newaxis]
    columns = first[1] + steps[np.newaxis, :, np.newaxis]
    pixels = rows * size[1] + columns
    points = np.broadcast_to(np.arange(places.shape[1]), pixels.shape)
    shape = places.shape[1], size[0] * size[1]
    matrix = sparse.csr_array((values.ravel(), (points.ravel(), pixels.ravel())), shape=shape, dtype=np.float32)
    matrix.eliminate_zeros()
    # Half the bytes of each index: reading them takes much of the time of a product.
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    return matrix
