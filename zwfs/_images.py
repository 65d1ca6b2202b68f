"""Geometry of images, and what takes the place of their bad pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage


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


def mean_light(images: NDArray, inside: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of two clear frames (2, ny, nx), less the background, and the counts that make an intensity of 1.

    Each frame is scaled to a mean of 1 inside. No intensity is below 0.
    """
    if np.any((scale := images[:, inside].mean(axis=1)) <= 0):
        raise ValueError(f"the pupils of the clear frames hold {scale} counts on average: expected light")
    return np.maximum((images / scale[:, None, None]).mean(axis=0), 0), scale
