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
