"""Outline of a pupil on an image, and the gain and the details by which two images of it differ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from zwfs._images import turning

_NEARLY_ALL = 0.98  # of the points of an outline: a few may be noise
_LIT = 0.2  # of the light of most rays: one with less ends in the dark
NEAR = 2  # pixels from a gap, vane or edge that count as near it
_DEGREE = 4  # of the polynomials that describe how unlike the two arms are
UNEVEN = 0.02  # relative difference of the gain of two arms over the pupil that counts
_CERTAIN = 3.0  # standard errors: less of a difference between the arms is noise
_OUTER = 0.75  # pixels from the outermost points: those with less are on the circle around the pupil


class Circle(NamedTuple):
    """Position of a pupil: row and column of its centre, and its diameter, all in pixels."""

    row: float
    column: float
    diameter: float


def threshold(image: NDArray) -> float:
    """Otsu's level: it parts the pixels in two classes of the least variance."""
    number, edges = np.histogram(image, 256)
    middle = (edges[1:] + edges[:-1]) / 2
    below, moment = np.cumsum(number), np.cumsum(number * middle)
    above = below[-1] - below
    between = (moment[-1] * below / below[-1] - moment) ** 2 / np.maximum(below * above, 1)
    return float(middle[np.argmax(np.where(above > 0, between, 0))])


def outline(image: NDArray, region: NDArray, level: float, diameter: float | None) -> Circle:
    """Circle around a pupil, to a fraction of a pixel; its diameter may be known.

    The edge lies where the light along a ray from the centre, less half of its bright level, sums up to the most:
    neither a gap nor the noise of one sample moves it. A ray that ends in a missing segment has no edge. A region
    of bright pixels gives the first centre and radius. Each pass then takes both from the circle around the edges.
    """
    region = ndimage.binary_fill_holes(region)
    row, column = ndimage.center_of_mass(region)
    size = diameter / 2 if diameter else np.sqrt(np.count_nonzero(region) / np.pi)
    dark = np.median(image[image <= level])
    angles = np.arange(720) * np.pi / 360
    sine, cosine = np.sin(angles), np.cos(angles)
    for _ in range(5):
        # Not beyond 1.08 radii: the next pupil may begin close to this one.
        reach = np.arange(0.7 * size, 1.08 * size, 0.05)
        rays = np.array([row + np.outer(sine, reach), column + np.outer(cosine, reach)])
        light = ndimage.map_coordinates(image, rays, order=1, mode="constant", cval=dark) - dark
        # The bright level belongs to the ray, because the pupil may be lit unevenly.
        bright = np.median(light[:, reach < 0.93 * size], axis=1)
        last = reach[np.argmax(np.cumsum(light - bright[:, np.newaxis] / 2, axis=1), axis=1)]
        edge = np.stack([row + last * sine, column + last * cosine], axis=1)[bright > _LIT * np.median(bright)]
        if not len(edge):
            break
        row, column, size = _circle_along(edge, size) if diameter else _circle_around(edge)
    return Circle(float(row), float(column), float(2 * size))


def _circle_along(points: NDArray, size: float) -> tuple[float, float, float]:
    """Circle (row, column, radius) of a known radius, from which the points differ least on average."""
    return *_least(lambda center: np.abs(_apart(points, center) - size).mean(), points), size


def _circle_around(points: NDArray) -> tuple[float, float, float]:
    """Circle (row, column, radius) through the outermost points.

    The smallest circle around nearly all points decides which ones are outermost: all points of a disc, and the
    corners of a pupil of segments. The result is the least-squares circle through them.
    """
    middle = _least(lambda center: np.quantile(_apart(points, center), _NEARLY_ALL), points)
    apart = _apart(points, middle)
    outer = points[apart > np.quantile(apart, _NEARLY_ALL) - _OUTER]
    a, b, c = np.linalg.lstsq(np.c_[2 * outer, np.ones(len(outer))], np.sum(outer**2, axis=1), rcond=None)[0]
    return a, b, np.sqrt(c + a**2 + b**2)


def _apart(points: NDArray, center: NDArray) -> NDArray[np.float64]:
    return np.hypot(*(points - center).T)


def _least(cost: Callable[[NDArray], Any], points: NDArray) -> NDArray[np.float64]:
    """Centre of the least cost, from that of the points."""
    return optimize.minimize(cost, points.mean(axis=0), method="Nelder-Mead", options={"xatol": 0.01}).x


def gains(
    images: NDArray, inside: NDArray, center: tuple[float, float], diameter: float, share: float | None = 0.5
) -> NDArray[np.float64]:
    """Gains of two arms, (2, ny, nx), whose ratio is that of their clear frames; the first has a share of it.

    With a share of None, the light before the masks is even, and the clear frames are the gains.

    The logarithm is a polynomial in the pupil, and constant along a ray beyond it. Coefficients of
    orthonormal polynomials shrink by their noise, to 0 below 3 standard errors.
    """
    mean = np.where(inside, images.mean(axis=0), 0)
    lit = ndimage.binary_erosion(mean > np.median(mean[inside]) / 2, np.ones((3, 3)), NEAR)
    lit &= (images > 0).all(axis=0)
    rows, columns = (np.indices(lit.shape) - np.reshape(center, (2, 1, 1))) * 2 / diameter
    beyond = np.maximum(np.hypot(rows, columns), 1)
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    terms = np.stack([(rows / beyond) ** i * (columns / beyond) ** j for i, j in powers], axis=-1)
    if np.count_nonzero(lit) < 4 * len(powers):
        return np.ones_like(images)
    values = np.log(images[:, lit])
    if share is not None:
        values = np.outer([-share, 1 - share], values[1] - values[0])
    basis, triangle = np.linalg.qr(terms[lit])
    coefficients = values @ basis
    noise = 1.48 * np.median(np.abs(values - coefficients @ basis.T), axis=1, keepdims=True)  # robust deviation
    coefficients *= np.maximum(1 - (_CERTAIN * noise) ** 2 / np.maximum(coefficients**2, 1e-300), 0)
    coefficients[:, 0] = 0  # the scale of each image is measured apart
    return np.exp(np.moveaxis(terms @ np.linalg.solve(triangle, coefficients.T), -1, 0))


class Details:
    """Band-passed image and reference, and their difference after a move.

    A move is (rows, columns, rotation, stretch), all in pixels; the last two at the edge of the points.
    """

    def __init__(
        self, image: NDArray, reference: NDArray, inside: NDArray, center: tuple[float, float], blur: float
    ) -> None:
        bands = (
            ndimage.gaussian_filter(one, blur) - ndimage.gaussian_filter(one, 4 * blur)
            for one in (image, reference)
        )
        self.image, self.reference = (ndimage.spline_filter(band, order=3, mode="nearest") for band in bands)
        places = np.argwhere(inside).T
        self.center = np.reshape(center, (2, 1))
        self.points = places - self.center
        self.reach = float(np.hypot(*self.points).max())  # pixels from the centre to the farthest point
        # Errors of neighbours go together: those of different blocks hardly do.
        size = max(1, round(8 * blur))
        self.block = np.unique(places[0] // size * inside.shape[1] + places[1] // size, return_inverse=True)[1]

    def search(self, start: NDArray, free: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Best move and its standard errors, pixels; what is not free keeps its start."""

        def move(values: NDArray) -> NDArray[np.float64]:
            full = start.copy()
            full[free] = values
            return full

        best = optimize.least_squares(
            lambda values: self.difference(move(values)), start[free], x_scale=0.1, xtol=1e-5, ftol=1e-9, gtol=1e-9
        )
        sigma = np.full(4, np.nan)
        sigma[free] = self._errors(best.jac, best.fun, free)
        return move(best.x), sigma

    def difference(self, move: Any) -> NDArray[np.float64]:
        """Moved image less the reference, each of mean 0 and norm 1."""
        return self._at(self.image, move) - self._at(self.reference, np.zeros(4))

    def _at(self, spline: NDArray, move: Any) -> NDArray[np.float64]:
        turned = turning(np.degrees(move[2] / self.reach), 1 + move[3] / self.reach) @ self.points
        places = self.center + np.reshape(move[:2], (2, 1)) + turned
        values = ndimage.map_coordinates(spline, places, order=3, mode="nearest", prefilter=False)
        values -= values.mean()
        return values / max(float(np.linalg.norm(values)), 1e-300)

    def _errors(self, slopes: NDArray, difference: NDArray, free: NDArray) -> NDArray[np.float64]:
        """Standard errors of the free values: the curvature, and the scatter of the gradient between blocks.

        The curvature is the product of the slopes of image and reference. Their noise is independent, so that
        noise alone makes no curvature.
        """
        moves = 0.1 * np.eye(4)[free]
        other = [(self._at(self.reference, one) - self._at(self.reference, -one)) / 0.2 for one in moves]
        curvature = slopes.T @ np.transpose(other)
        curvature += 1e-9 * np.trace(slopes.T @ slopes) * np.eye(len(moves))
        gradient = np.zeros((self.block.max() + 1, len(moves)))
        np.add.at(gradient, self.block, slopes * difference[:, np.newaxis])
        weight = np.linalg.pinv(curvature)
        return np.sqrt(np.diag(weight @ (gradient.T @ gradient) @ weight.T))
