"""Camera frames that phases predict with all of a fitted bench, and corrections of the phases by what they miss.

The linear road of a calibration turns counts c into ideal frames, whose phase follows from a model of the sensor
alone. Let F(phi) be the counts that the whole model of the bench predicts, with blur, edges and relay, and I(phi)
the ideal frames. A correction solves

    I(phi_next) = I(phi) + B (c - F(phi)),

where B is the linear road. Its fixed point explains the frames with the whole model. Of a residual, the share that
noise explains is left out, so that few corrections amplify little of it.
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from zwfs._images import nearest_good
from zwfs.frames._fit import BenchFit
from zwfs.frames._fitted import FittedSensor, Windows
from zwfs.frames._grid import Grid, Solved
from zwfs.frames._optics import Linearised, _Spline, pooled
from zwfs.frames._states import PAD

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration

_N_CORRECTIONS = 2  # the next ones gain little
_SMOOTHING = 0.5  # pixels rms, of residuals
_AROUND = 2.0  # pixels rms, of the neighbours whose residuals are compared with their noise
_FULLY_LIT = 0.9  # share of the light of a pixel
# Smallest displacement that counts, pixels and standard errors. Residuals show a tenth to nine tenths of the true
# one, because the phase follows it. Errors of the model look like up to 0.05 pixel.
_MOVED_BY, _SURE = 0.07, 5.0
_FEWEST = 30  # points without a neighbour that is lit in part: with fewer, edges count, too


class Corrected(NamedTuple):
    """Result of the corrections of k exposures."""

    frames: NDArray[np.float32]  # (k, 2, ny, nx), those of an ideal sensor with all that their phases miss
    quiet: NDArray[np.float32]  # the same without what noise explains
    solved: Solved
    residual: NDArray[np.float64]  # (k,), rms of counts less their prediction away from edges, 1 = clear frame
    noise: NDArray[np.float64]  # (k,), that of noise alone
    moved: NDArray[np.bool_]  # (k,), whether a displacement of the images explains a part of the residual


class Prediction:
    """Model of a fitted bench, in single precision, on the boxes and the grid of a calibration."""

    def __init__(self, calibration: Calibration, bench: BenchFit) -> None:
        grid, model = calibration._work, bench.model
        self._bench, self._windows = bench, Windows.of(calibration, bench)
        self._inside = grid.reconstruct.sensor.pupil.inside
        self._background, self._unit = (
            values[:, None, None].astype(np.float32) for values in (calibration.background, calibration.unit)
        )
        camera = FittedSensor(bench)._camera.single
        still = model.light.maps(model.light.start, np.zeros_like(model.light.start))
        self._flat = Linearised(camera, still, model.values)
        lit = np.pad(self._inside, PAD)
        self._continued = nearest_good(np.pad(np.arange(self._inside.size).reshape(self._inside.shape), PAD), lit)
        self._pairs = lit[1:] & lit[:-1], lit[:, 1:] & lit[:, :-1]
        share = pooled(model.light.start, camera.f) / pooled(model.light.amplitude**2, camera.f)
        full = self._inside & (share[PAD:-PAD, PAD:-PAD] > _FULLY_LIT)
        self._inner = ndimage.binary_erosion(full, np.ones((3, 3)))
        if np.count_nonzero(self._inner) < _FEWEST:
            self._inner = self._inside
        self._place(grid)

    def moved(self, grid: Grid, shift: NDArray) -> Prediction:
        """Prediction of images that have moved on the camera by rows and columns, for a grid that follows them."""
        out, flat = copy(self), copy(self._flat)
        out._flat, flat.optics = flat, copy(flat.optics)
        flat.optics.splines = {}
        for number, arm in enumerate(self._bench.model.arms):
            place = arm["row"] + shift[0], arm["column"] + shift[1], arm["rotation"], arm["magnification"]
            flat.optics.splines[number] = _Spline(flat.camera, place).single
        out._place(grid)
        return out

    def _place(self, grid: Grid) -> None:
        """Set the grid, and the way from predicted frames to its boxes."""
        flat, self._grid = self._flat, grid
        # The light that does not interfere, counts.
        self._steady = np.stack([
            flat._on_camera(arm, flat.optics.spread[arm][0] * flat._rest) + flat.arms[arm]["background"]
            for arm in (0, 1)
        ])  # fmt: skip
        self._cuts = _cuts(grid, self._windows)
        self._calm = ~self._under(self._inside & ~self._inner)

    def counts(self, phase: NDArray) -> NDArray[np.float32]:
        """Counts of the boxes, (2, h, w), less dark and background, of a phase (n, n)."""
        images = self._interfering(phase) + self._steady
        return np.stack([image[cut] for image, cut in zip(images, self._cuts, strict=True)]) - self._background

    def corrected(self, raw: NDArray, light: NDArray, lit: NDArray, good: NDArray, solved: Solved) -> Corrected:
        """Correct phases of counts on the boxes, (k, 2, h, w), with their light, (k,), and good points.

        Those of exposures that are not lit, (k,), stay. The points are maps (k, ny, nx).
        """
        grid, scale = self._grid, light[:, None, None, None].astype(np.float32)
        variance = np.maximum(raw + self._background, 0) / self._bench.gain + self._bench.noise**2
        usable = np.stack([~self._under(self._inside & ~points) for points in good]) & lit[:, None, None, None]
        residual = self._residual(raw, scale, solved.phase, usable)
        shown = variance * _excess(residual / np.sqrt(variance), usable & grid.watched)
        n_iterations = solved.n_iterations
        for correction in range(_N_CORRECTIONS):
            missing = _significant(residual, shown, usable) / scale
            if correction:  # a second one would overshoot where pixels are lit in part
                missing *= self._calm
            frames = self._ideal(solved.phase, missing)
            solved = grid.solve(np.maximum(frames, 0), good, solved.phase)
            n_iterations = n_iterations + solved.n_iterations
            residual = self._residual(raw, scale, solved.phase, usable)
        chosen = np.stack([self._under(self._inner & points) for points in good]) & usable & grid.watched
        chosen &= np.stack([~self._under(self._inside & ~(self._inner & points)) for points in good])
        number = np.maximum(np.count_nonzero(chosen, axis=(1, 2, 3)), 1)
        rms = [
            np.sqrt(np.sum(squares / self._unit**2, axis=(1, 2, 3), where=chosen) / number) / light
            for squares in (residual**2, variance)
        ]
        parts = residual, _significant(residual, shown, usable)
        frames, quiet = (self._ideal(solved.phase, missing / scale) for missing in parts)
        push, sigma = _push(raw - residual, residual, (usable & grid.watched) / variance)
        moved = np.any(np.abs(push) > np.maximum(_MOVED_BY, _SURE * sigma), axis=1)
        return Corrected(frames, quiet, solved._replace(n_iterations=n_iterations), rms[0], rms[1], moved)

    def _ideal(self, phase: NDArray, missing: NDArray) -> NDArray[np.float32]:
        """Frames of an ideal sensor, (k, 2, ny, nx): those of phases, and counts of the boxes that they miss."""
        grid, modelled = self._grid, self._grid.modelled(phase)
        values = grid.resampled(missing.astype(np.float32)).reshape(modelled.shape) / self._unit
        return modelled + grid.weights[:, 0] * values[:, :1] + grid.weights[:, 1] * values[:, 1:]

    def _interfering(self, phase: NDArray) -> NDArray[np.float32]:
        """Counts (2, ny, nx) of the mean field of each point with a phase (n, n), without the background."""
        flat, camera, optics = self._flat, self._flat.camera, self._flat.optics
        fine = self._fine(phase)
        field = np.empty(fine.shape, np.complex64)
        field.real, field.imag = flat.maps.mean * np.cos(fine), flat.maps.mean * np.sin(fine)
        spectra, inputs = flat._source(field)
        images = np.empty((2, *camera.shape), np.float32)
        for group in camera.groups:
            field = fft.ifft2(optics.transfer[group.arm] * spectra, overwrite_x=True)
            light = flat._dimple_light(group, inputs, 0)
            first, second = (numbers[group.mask].item() for numbers in optics.coefficients[:2])
            intensity = np.abs(field) ** 2 + 2 * (first * field.conj() * light).real + second * np.abs(light) ** 2
            images[group.images] = flat._on_camera(group.arm, fft.rfft2(flat._cells(intensity)))
        return images

    def _fine(self, phase: NDArray) -> NDArray[np.float32]:
        """Phase on the fine grid: a plane in each pixel, which neither jumps nor wraps make steep."""
        wide, f = phase.ravel()[self._continued], self._flat.camera.f
        places = ((np.arange(f) + 0.5) / f - 0.5).astype(np.float32)
        fine = wide[:, None, :, None]
        for axis, pairs in enumerate(self._pairs):
            slope = _slopes(wide.swapaxes(0, axis), pairs.swapaxes(0, axis)).swapaxes(0, axis)
            fine = fine + slope[:, None, :, None] * (places[:, None, None] if axis == 0 else places)
        return fine.reshape(f * len(wide), -1)

    def _residual(self, raw: NDArray, scale: NDArray, phase: NDArray, usable: NDArray) -> NDArray[np.float32]:
        return np.where(usable, raw - scale * np.stack([self.counts(single) for single in phase]), 0)

    def _under(self, points: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Pixels of the boxes, (2, h, w), from which points (ny, nx) are made."""
        flat = points.ravel().astype(np.float32)
        return np.stack([matrix.T @ flat for matrix in self._grid.touching]).reshape(self._grid.dark.shape) > 0


def _cuts(grid: Grid, windows: Windows) -> list[tuple[NDArray[np.int64], ...]]:
    """Pixels of the predicted frames that the boxes cover; beyond the edge they are repeated."""
    cuts = []
    for (_, *spans), corner in zip(grid.boxes, windows.corners, strict=True):
        lines = [np.arange(span.start, span.stop) if isinstance(span, slice) else span for span in spans]
        places = zip(lines, corner, windows.size, strict=True)
        cuts.append(np.ix_(*(np.clip(line - first, 0, size - 1) for line, first, size in places)))
    return cuts


def _slopes(phase: NDArray, pairs: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Slopes along the first axis: the mean of both sides, but at most twice the smaller one; 0 at an extremum.

    Of points whose next one is outside, (ny - 1, nx), the only side counts.
    """
    steps = np.diff(phase, axis=0)
    steps = pairs * (steps - np.float32(2 * np.pi) * np.rint(steps / np.float32(2 * np.pi)))
    ahead, behind = (np.pad(steps, (side, (0, 0))) for side in ((0, 1), (1, 0)))
    has_ahead, has_behind = (np.pad(pairs, (side, (0, 0))) for side in ((0, 1), (1, 0)))
    ahead, behind = np.where(has_ahead, ahead, behind), np.where(has_behind, behind, ahead)
    least = 2 * np.minimum(np.abs(ahead), np.abs(behind))
    return np.where(ahead * behind > 0, np.clip((ahead + behind) / 2, -least, least), 0)


def _excess(pulls: NDArray, where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Variance of differences of neighbouring pixels over that of their noise, at least 1, (k, 1, 1, 1)."""
    pairs = where[..., 1:] & where[..., :-1]
    steps = np.abs(np.diff(pulls, axis=3))
    medians = [np.median(step[pair]) if pair.any() else 0.0 for step, pair in zip(steps, pairs, strict=True)]
    return np.maximum(1, 1.4826**2 / 2 * np.square(medians))[:, None, None, None]


def _push(predicted: NDArray, residual: NDArray, weight: NDArray) -> tuple[NDArray, NDArray]:
    """Displacement in pixels, (k, 2), that explains residuals (k, 2, h, w) best, and its standard error."""
    k = len(residual)
    slopes = np.stack([-np.gradient(predicted, axis=axis) for axis in (2, 3)], axis=1).reshape(k, 2, -1)
    weighted = slopes * weight.reshape(k, 1, -1)
    inverse = np.linalg.inv((weighted @ slopes.transpose(0, 2, 1)).astype(float) + 1e-9 * np.eye(2))
    along = weighted @ residual.reshape(k, -1, 1)
    number = np.maximum(np.count_nonzero(weight, axis=(1, 2, 3)), 1)
    misfit = np.maximum(np.sum(weight * residual**2, axis=(1, 2, 3)) / number, 1)
    return (inverse @ along)[..., 0], np.sqrt(misfit[:, None] * np.diagonal(inverse, axis1=1, axis2=2))


def _significant(residual: NDArray, variance: NDArray, usable: NDArray) -> NDArray[np.float64]:
    """Residuals, (k, 2, h, w), less the share that noise makes up among their neighbours (Wiener's filter)."""
    smooth = ndimage.gaussian_filter(residual, _SMOOTHING, axes=(2, 3))
    squares, weight = (
        ndimage.gaussian_filter(values, _AROUND, axes=(2, 3))
        for values in (usable * smooth**2 / (_passed() * variance), usable.astype(np.float32))
    )
    ratio = squares / np.maximum(weight, 1e-3)
    return smooth * np.maximum(0, 1 - 1 / np.maximum(ratio, 1e-3))


def _passed() -> float:
    """Share of the variance of white noise that the smoothing passes."""
    impulse = np.zeros((15, 15))
    impulse[7, 7] = 1
    return float(np.sum(ndimage.gaussian_filter(impulse, _SMOOTHING) ** 2))
