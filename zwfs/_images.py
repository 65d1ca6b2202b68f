"""Geometry of images, and what takes the place of their bad pixels."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_GAPS = 0.0, 0.5, 0.7, 0.8, 0.9, 0.95  # amplitude of gaps over that of their surroundings
_BRIDGES = 0, 1, 2  # points by which parts shrink while they are counted
_LEAST_PART = 0.2  # points of a part, over those of the largest
_ALIKE = 0.35  # standard deviation of the sizes of parts, over their mean


def radius(shape: tuple[int, int], center: tuple[float, float]) -> NDArray[np.float64]:
    """Distance of every pixel from the centre (row, column), in pixels."""
    rows, columns = (np.arange(n) - middle for n, middle in zip(shape, center, strict=True))
    return np.hypot(rows[:, np.newaxis], columns)


def turning(rotation: float, magnification: float) -> NDArray[np.float64]:
    """Matrix of a rotation (degrees) and a magnification, for (row, column)."""
    sine, cosine = np.sin(np.radians(rotation)), np.cos(np.radians(rotation))
    return magnification * np.array([[cosine, sine], [-sine, cosine]])


def nearest_good(image: NDArray, good: NDArray) -> NDArray:
    """An image (..., ny, nx) with every pixel that is not good replaced by the nearest good one."""
    if good.all():
        return image
    index = ndimage.distance_transform_edt(~good, return_distances=False, return_indices=True)
    return image[(..., *index)]


def parts_of(amplitude: NDArray) -> NDArray[np.intp]:
    """Number of the part of a measured pupil that each point belongs to, from 1 on; 0 where the amplitude is 0.

    A gap is where the amplitude is less than a share of that of its surroundings; an erosion cuts bridges across
    it. Of several shares and erosions, those count that make the most parts of similar sizes. Points of gaps go to
    the nearest part.
    """
    inside, around, most = amplitude > 0, ndimage.median_filter(amplitude, 5), 1
    best = inside.astype(int)
    for share, cut in product(_GAPS, _BRIDGES):
        bright = inside & (amplitude > share * around)
        parts, n = ndimage.label(ndimage.binary_erosion(bright, iterations=cut) if cut else bright)
        sizes = np.bincount(parts.ravel(), minlength=n + 1)
        large = (sizes > _LEAST_PART * sizes[1:].max(initial=0)) & (np.arange(n + 1) > 0)
        if np.count_nonzero(large) <= most:
            continue
        numbers = np.where(large, np.cumsum(large), 0)[parts]
        nearest = ndimage.distance_transform_edt(numbers == 0, return_distances=False, return_indices=True)
        grown = np.where(inside, numbers[tuple(nearest)], 0)
        sizes = np.bincount(grown.ravel())[1:]
        if sizes.min() > _LEAST_PART * sizes.max() and sizes.std() < _ALIKE * sizes.mean():
            best, most = grown, len(sizes)
    return best


def mean_light(images: NDArray, inside: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of two clear frames (2, ny, nx), less the background, and the counts that make an intensity of 1.

    Each frame is scaled to a mean of 1 inside. No intensity is below 0.
    """
    if np.any((scale := images[:, inside].mean(axis=1)) <= 0):
        raise ValueError(f"the pupils of the clear frames hold {scale} counts on average: expected light")
    return np.maximum((images / scale[:, None, None]).mean(axis=0), 0), scale
