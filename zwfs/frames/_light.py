"""Light of the pupil on the grid of the model, and how it divides into the two areas of a point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from zwfs._images import nearest_good
from zwfs.frames._optics import Maps

_WIDTH = 1.5  # pixels rms, of the weights with which neighbours give the light of a fully lit pixel
_STIFF = 0.1  # pixels squared: with few pixels on a line, a slope across it is that of noise
# Steps of the grid over which an edge crosses a point: 1 for an edge along the grid. A half takes away the bias of
# the light of edges and vanes that does not interfere.
_CROSSED = 0.5
_DARKER = 0.1, 0.5  # least and most by which a pixel that is lit in part is darker than its surroundings


@dataclass(frozen=True, eq=False)
class Light:
    """Where light is, and how it divides into the two areas of a point, on the fine grid."""

    start: NDArray[np.float64]  # light of no change
    amplitude: NDArray[np.float64]  # A of the lit part
    full: NDArray[np.bool_]  # points that are fully lit
    support: NDArray[np.bool_]  # points that may have light

    @classmethod
    def of(cls, start: NDArray, pixels: NDArray, oversampling: int) -> Light:
        """Divide a fine map of light; `pixels` is the light of each pixel, 1 on average where it is lit."""
        full = ndimage.binary_erosion(_fully_lit(pixels))
        near = _continued(pixels, full)
        power = np.maximum(nearest_good(near, ~np.isnan(near)), 0.05)
        support = ndimage.binary_dilation(pixels > 0.1, iterations=2)
        flat, inner = (np.kron(one, np.ones((oversampling,) * 2)) > 0 for one in (full, support))
        return cls(start, np.sqrt(_stretched(power, oversampling)), flat, inner)

    @classmethod
    def sharp(cls, pixels: NDArray, oversampling: int) -> Light:
        """Divide the light of each pixel as an edge of the pupil does: the side of its lit neighbours is lit."""
        n, f = len(pixels), oversampling
        fine = 2 * f if f < 4 else f
        plain = cls.of(np.kron(pixels, np.ones((fine, fine))), pixels, fine)
        blocks = _blocks(plain.amplitude**2, fine)
        share = np.clip(pixels / blocks.mean(axis=-1), 0, 1)
        height = _blocks(_stretched(ndimage.gaussian_filter(share, 0.7), fine), fine)
        filled = blocks * _beyond_edge(height, share)
        flat = filled.reshape(n, n, fine, fine).transpose(0, 2, 1, 3).reshape(n * fine, n * fine)
        fine_light = np.where(plain.full, plain.start, flat)
        start = fine_light.reshape(n * f, fine // f, n * f, fine // f).mean(axis=(1, 3))
        return cls.of(start, pixels, f)

    def changed(self, change: NDArray) -> NDArray[np.float64]:
        """Light of a change, in units of that of a fully lit point."""
        return self.support * (self.start + self.amplitude**2 * change)

    def maps(self, light: NDArray, phase: NDArray) -> Maps:
        least = np.maximum(light, self._least)
        # The tangent of the root where a fully lit point would be much too dark.
        root = np.sqrt(least) + (light - least) / (2 * np.sqrt(least))
        mean = np.where(self.full, root, light / self.amplitude)
        return Maps(mean, np.where(self.full, 0, light - mean**2), phase, self.support & ~self.full)

    def slopes(self, light: NDArray) -> tuple[NDArray, NDArray]:
        """Derivatives of mean field and rest by the change of the light."""
        power = self.amplitude**2
        slope = self.support * power
        root = 0.5 / np.sqrt(np.maximum(light, self._least))
        mean = np.where(self.full, root, 1 / self.amplitude)
        return slope * mean, slope * np.where(self.full, 0, 1 - 2 * light / power)

    @property
    def _least(self) -> NDArray[np.float64]:
        return 0.5 * self.amplitude**2


def _continued(pixels: NDArray, full: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Smooth light of fully lit pixels, continued along its slope; NaN far from them."""
    if not full.any():  # a pupil of a few pixels
        return pixels
    near = _plane(pixels, full)
    return near + _plane(np.where(full, pixels - near, 0), full)  # the plane alone lowers a maximum


def _plane(image: NDArray, full: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fit a plane to the chosen pixels near each pixel, and return its value there; NaN far from them."""

    def mean(values: NDArray) -> NDArray[np.float64]:
        return ndimage.gaussian_filter(values * full, _WIDTH) / weight

    weight = np.maximum(ndimage.gaussian_filter(full.astype(float), _WIDTH), 1e-12)
    places = np.indices(image.shape, float)
    level, middle = mean(image), np.stack([mean(one) for one in places])
    spread = np.array([[mean(one * other) for other in places] for one in places]) - middle[:, None] * middle
    spread += _STIFF * np.eye(2)[..., None, None]
    along = np.stack([mean(one * image) for one in places]) - middle * level
    slope = np.linalg.solve(spread.transpose(2, 3, 0, 1), along.transpose(1, 2, 0)[..., None])[..., 0]
    change = np.sum(slope.transpose(2, 0, 1) * (places - middle), axis=0)
    return np.where(weight > 1e-3, level + change, np.nan)


def _fully_lit(pixels: NDArray) -> NDArray[np.bool_]:
    """Pixels as bright as their surroundings, but for the scatter of noise and of a mottled illumination."""
    typical = ndimage.percentile_filter(pixels, 60, 5)
    lit = typical > 0.5 * np.maximum(ndimage.maximum_filter(typical, 7), 0.2)
    ratio = pixels / np.where(lit, typical, np.inf)
    middle = np.median(ratio[lit]) if lit.any() else 1.0
    scatter = 1.4826 * np.median(np.abs(ratio[lit] - middle)) if lit.any() else 0.0
    return np.asarray(ratio > 1 - np.clip(3 * scatter, *_DARKER))


def _beyond_edge(height: NDArray, share: NDArray) -> NDArray[np.float64]:
    """Part of each point that is lit, (..., f * f), if a share of a pixel lies on the higher side of a level.

    A point that the level crosses is lit in part.
    """
    step = np.ptp(height, axis=-1) / (math.isqrt(height.shape[-1]) - 1)
    width = np.maximum(_CROSSED * step, 1e-12)[..., None]
    low, high = height.min(axis=-1, keepdims=True) - width, height.max(axis=-1, keepdims=True) + width
    for _ in range(40):
        level = (low + high) / 2
        lit = np.clip((height - level) / width + 0.5, 0, 1)
        more = lit.mean(axis=-1) > share
        low[more], high[~more] = level[more], level[~more]
    return lit


def _blocks(fine: NDArray, f: int) -> NDArray[np.float64]:
    """Points of each pixel, (n, n, f * f)."""
    n = len(fine) // f
    return fine.reshape(n, f, n, f).transpose(0, 2, 1, 3).reshape(n, n, f * f)


def _stretched(pixels: NDArray, factor: int) -> NDArray[np.float64]:
    """A map of pixels on a grid that is finer by a factor, linear between the pixels."""
    return ndimage.zoom(pixels, factor, order=1, mode="nearest", grid_mode=True)
