"""The pupil: what part of the plane the light comes through, and how much of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._pickle import uncached_state


@dataclass(frozen=True, eq=False)
class Pupil:
    """A sampled pupil. Make one with `circular`, `hexagonal` or `from_amplitude`.

    Attributes
    ----------
    amplitude : ndarray, shape (ny, nx)
        Field amplitude, 0 outside. Its mean square over the points inside is 1, so that an intensity of 1 is
        the mean intensity inside the pupil with the mask taken out of the beam.
    n_pixels : float, pixels
        Pupil diameter D; a pixel is D / `n_pixels` wide.
    segments : ndarray of int, shape (ny, nx)
        Number of the segment that a point belongs to, 0 outside. A pupil of one piece is segment 1.
    center : (float, float), pixels
        Row and column of the optical axis.
    """

    amplitude: NDArray[np.float64]
    n_pixels: float
    segments: NDArray[np.int64]
    center: tuple[float, float]

    __getstate__ = uncached_state

    def __repr__(self) -> str:
        return f"Pupil({self.n_points} points, {self.n_pixels:g} pixels across, shape={self.shape})"

    @classmethod
    def circular(
        cls,
        n_pixels: int,
        central_obscuration: float = 0.0,
        spiders: Sequence[tuple[float, float]] = (),
    ) -> Pupil:
        """Disc of diameter D, with an obscuration and spider vanes if asked for.

        Parameters
        ----------
        n_pixels : int, pixels
            Samples across the diameter; a point is inside where its centre is.
        central_obscuration : float, D
            Diameter of the central obscuration.
        spiders : sequence of (angle, width), radian and D
            Vanes from the centre to the edge; the angle is counted from +x towards +y.

        Raises
        ------
        ValueError
            If a value is out of range, or if nothing is left of the pupil.
        """
        n_pixels = _check.integer("n_pixels", n_pixels, 2)
        obscuration = _check.number("central_obscuration", central_obscuration, 0, 1, open_high=True)
        x, y = _square_grid(n_pixels)
        radius = np.hypot(x, y)
        inside = (radius <= 0.5) & (radius >= obscuration / 2)
        for index, spider in enumerate(spiders):
            inside &= ~_vane(x, y, index, spider)
        return _assemble(inside.astype(float), n_pixels, inside.astype(int))

    @classmethod
    def hexagonal(
        cls,
        n_pixels: int,
        n_rings: int = 3,
        gap: float = 0.0,
        missing: Iterable[int] = (),
        stop: float | None = None,
    ) -> Pupil:
        """Hexagonal segments in rings around a central one.

        Segments have a horizontal edge at the top, like the pupil of a segmented telescope. Number 1 is the
        central one; each ring is counted counter-clockwise (from +x towards +y) from its corner at 30 degrees.

        Parameters
        ----------
        n_pixels : int, pixels
            Samples across D, the diameter of the circle around all segments, or of the stop where there is one.
        n_rings : int
            Rings around the central segment: 3 make 37 segments.
        gap : float, D
            Width of the gap between neighbours.
        missing : iterable of int
            Numbers of the segments that send no light.
        stop : float, optional
            Diameter of a circular stop as a fraction of the circle around all segments, in (0, 1]. The stop then
            is the pupil: it is D wide, and outer segments are cut by it.

        Raises
        ------
        ValueError
            If a value is out of range, a missing segment does not exist, or nothing is left of the pupil.
        """
        n_pixels = _check.integer("n_pixels", n_pixels, 2)
        n_rings = _check.integer("n_rings", n_rings, 0)
        whole = 1.0 if stop is None else 1 / _check.number("stop", stop, 0, 1, open_low=True)
        # A corner segment is n_rings pitches out; its farthest corner is at 30 degrees to that direction.
        pitch = whole / 2 / np.sqrt(n_rings**2 + n_rings + 1 / 3)
        gap = _check.number("gap", gap, 0, pitch, open_high=True)
        centers = _hexagon_centers(n_rings) * pitch
        if not isinstance(missing, Iterable):
            raise TypeError(f"missing = {missing!r}: expected segment numbers, such as (21,)")
        missing = {_check.integer("missing", number, 1) for number in missing}
        if missing and max(missing) > len(centers):
            raise ValueError(f"missing = {sorted(missing)}: expected segment numbers from 1 to {len(centers)}")
        x, y = _square_grid(n_pixels)
        segments = np.zeros(x.shape, int)
        for number, (cx, cy) in enumerate(centers, start=1):
            if number not in missing:
                segments[_inside_hexagon(x - cx, y - cy, (pitch - gap) / 2)] = number
        if stop is not None:
            segments[np.hypot(x, y) > 0.5] = 0
        return _assemble((segments > 0).astype(float), n_pixels, segments)

    @classmethod
    def from_amplitude(
        cls,
        image: ArrayLike,
        n_pixels: float | None = None,
        center: tuple[float, float] | None = None,
        threshold: float = 0.0,
    ) -> Pupil:
        """Pupil of a measured amplitude, uniform or not.

        Parameters
        ----------
        image : array_like, shape (ny, nx)
            Field amplitude: the square root of an off-mask pupil image. Scaled to a mean square of 1 inside.
        n_pixels : float, pixels, optional
            Pupil diameter D; the longer side of the image if left out.
        center : (float, float), pixels, optional
            Row and column of the optical axis; the middle of the image if left out.
        threshold : float
            A point counts as outside where its amplitude is at most this fraction of the largest one.

        Raises
        ------
        ValueError
            If the image is not two-dimensional, holds NaN, infinite or negative values, or is dark everywhere.
        """
        image = _check.real_array("image", image).astype(np.float64)
        if image.ndim != 2 or not image.size:
            raise ValueError(f"image has shape {image.shape}: expected (ny, nx), not empty")
        threshold = _check.number("threshold", threshold, 0, 1, open_high=True)
        n_pixels = max(image.shape) if n_pixels is None else _check.number("n_pixels", n_pixels, 0, open_low=True)
        _check.finite("image", image)
        _check.non_negative("image", image)
        inside = image > threshold * image.max(initial=0.0)
        return _assemble(np.where(inside, image, 0.0), n_pixels, inside.astype(int), center)

    @classmethod
    def from_segments(cls, segments: ArrayLike, amplitude: ArrayLike = 1.0) -> Pupil:
        """Pupil of a given map of segment numbers, D wide.

        Parameters
        ----------
        segments : array_like of int, shape (n, n)
            0 where there is no light.
        amplitude : array_like, broadcasts to (n, n)
            Field amplitude on the segments.

        Raises
        ------
        TypeError, ValueError
            If the numbers are no integers, or an amplitude on a segment is not positive.
        """
        segments = np.asarray(segments)
        if segments.dtype.kind not in "iu" or segments.ndim != 2:
            raise TypeError(
                f"segments is {segments.ndim}-dimensional {segments.dtype}: expected a map of integers"
            )
        if segments.min(initial=0) < 0:
            raise ValueError(f"segments reaches down to {segments.min()}: expected numbers from 0 on")
        amplitude = _check.real_array("amplitude", amplitude)
        try:
            amplitude = np.broadcast_to(amplitude, segments.shape)
        except ValueError:
            raise ValueError(f"amplitude has shape {amplitude.shape}: expected {segments.shape}") from None
        _check.finite("amplitude", amplitude)
        lowest = amplitude[segments > 0].min(initial=np.inf)
        if lowest <= 0:
            raise ValueError(f"amplitude reaches down to {lowest:.6g} on a segment: expected positive values")
        return _assemble(np.where(segments > 0, amplitude, 0.0), max(segments.shape), segments.astype(np.int64))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a map on this pupil."""
        return self.amplitude.shape

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """True at the points inside, shape (ny, nx)."""
        return self.amplitude > 0

    @cached_property
    def indices(self) -> NDArray[np.intp]:
        """Positions of the points inside in a flattened map, shape (n_points,)."""
        return np.flatnonzero(self.mask)

    @property
    def n_points(self) -> int:
        """Number of points inside."""
        return self.indices.size

    @cached_property
    def x(self) -> NDArray[np.float64]:
        """Horizontal coordinate of each column, in D, shape (nx,)."""
        return (np.arange(self.shape[1]) - self.center[1]) / self.n_pixels

    @cached_property
    def y(self) -> NDArray[np.float64]:
        """Vertical coordinate of each row, in D, shape (ny,)."""
        return (np.arange(self.shape[0]) - self.center[0]) / self.n_pixels

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Coordinates (x, y) of the points inside, in D, shape (n_points, 2)."""
        row, column = np.unravel_index(self.indices, self.shape)
        return np.stack([self.x[column], self.y[row]], axis=-1)

    def gather(self, maps: NDArray[Any]) -> NDArray[Any]:
        """Take the values inside: (..., ny, nx) to (..., n_points)."""
        return maps.reshape(*maps.shape[:-2], -1).take(self.indices, axis=-1)

    def scatter(self, values: NDArray[Any], fill: float = np.nan) -> NDArray[Any]:
        """Put values back into maps: (..., n_points) to (..., ny, nx), `fill` outside."""
        maps = np.full((*values.shape[:-1], self.amplitude.size), fill, values.dtype)
        maps[..., self.indices] = values
        return maps.reshape(*values.shape[:-1], *self.shape)

    def rms(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Rms over the points inside, piston removed: (..., ny, nx) to (...), in the unit of `phase`."""
        phase = _check.real_array("phase", phase)
        _check.trailing_shape("phase", phase, self.shape, "the shape of the pupil")
        return self.gather(phase).std(axis=-1)


def _assemble(
    amplitude: NDArray, n_pixels: float, segments: NDArray, center: tuple[float, float] | None = None
) -> Pupil:
    inside = amplitude > 0
    if not inside.any():
        raise ValueError("the pupil is empty: expected at least one point with an amplitude above 0")
    if center is None:
        center = tuple((n - 1) / 2 for n in amplitude.shape)
    if np.shape(center) != (2,):
        raise ValueError(f"center = {center!r}: expected a pair (row, column)")
    center = tuple(_check.number("center", value) for value in center)
    amplitude = amplitude / np.sqrt(np.mean(amplitude[inside] ** 2))
    for array in (amplitude, segments):
        array.setflags(write=False)
    return Pupil(amplitude, n_pixels, segments, center)


def _square_grid(n_pixels: int) -> tuple[NDArray, NDArray]:
    axis = (np.arange(n_pixels) - (n_pixels - 1) / 2) / n_pixels
    return np.meshgrid(axis, axis)


def _vane(x: NDArray, y: NDArray, index: int, spider: tuple[float, float]) -> NDArray:
    try:
        angle, width = spider
    except (TypeError, ValueError):
        raise TypeError(f"spiders[{index}] = {spider!r}: expected a pair (angle, width)") from None
    angle = _check.number(f"spiders[{index}] angle", angle)
    width = _check.number(f"spiders[{index}] width", width, 0, 1)
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    # Rounding must not decide on which side of the centre a point lies.
    return (along >= -1e-12) & (np.abs(across) < width / 2)


def _hexagon_centers(n_rings: int) -> NDArray:
    """Centres of the segments in units of the pitch, shape (n_segments, 2)."""
    # Centres of neighbours stand at 30, 90, ... degrees when the segments have a horizontal edge.
    corners = np.exp(1j * np.pi * (np.arange(7) / 3 + 1 / 6))
    centers = [0j]
    for ring in range(1, n_rings + 1):
        for corner, following in pairwise(corners):
            centers += [ring * corner + step * (following - corner) for step in range(ring)]
    centers = np.array(centers)
    return np.stack([centers.real, centers.imag], axis=-1)


def _inside_hexagon(x: NDArray, y: NDArray, apothem: float) -> NDArray:
    inside = np.abs(y) <= apothem
    for angle in (np.pi / 6, -np.pi / 6):
        inside &= np.abs(x * np.cos(angle) + y * np.sin(angle)) <= apothem
    return inside
