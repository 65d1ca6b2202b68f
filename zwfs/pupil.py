"""The pupil: the part of the plane through which light comes, and its amplitude."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from numbers import Complex, Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, read_only

_MOST_PIXELS = 2**14  # across the pupil: a map of them takes 2 GiB
_FARTHEST = 1000.0  # distance of the optical axis, in D, at which coordinates are still exact to 1e-12


@dataclass(frozen=True, eq=False)
class Pupil(Immutable):
    """Sampled pupil, made with `circular`, `hexagonal`, `from_amplitude` or `from_segments`.

    A pupil cannot be changed: its arrays are read-only copies.

    Attributes
    ----------
    amplitude : ndarray, shape (ny, nx)
        Field amplitude, 0 outside. It is scaled to a mean square of 1 over the points inside, so that an intensity
        of 1 is the mean intensity inside the pupil with the mask taken out of the beam.
    n_pixels : float, pixels
        Pupil diameter D; a pixel is D / `n_pixels` wide.
    segments : ndarray of int, shape (ny, nx)
        Number of the segment that a point belongs to, 0 outside. A pupil of one piece is segment 1.
    center : (float, float), pixels
        Row and column of the optical axis.
    measured : bool
        Whether the amplitude is that of an image (`from_amplitude`); then bases of modes are made orthonormal.

    Raises
    ------
    ValueError
        If the segments do not cover the points inside.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(100, central_obscuration=0.3)
    >>> pupil.shape, round(float(np.mean(pupil.amplitude[pupil.inside] ** 2)), 6)
    ((100, 100), 1.0)
    >>> int(zwfs.Pupil.hexagonal(100, n_rings=3, gap=0.02, missing=[21]).segments.max())
    37
    """

    amplitude: NDArray[np.float64]
    n_pixels: float
    segments: NDArray[np.int64]
    center: tuple[float, float]
    measured: bool = False

    def __post_init__(self) -> None:
        amplitude = _image("amplitude", self.amplitude)
        inside = amplitude > 0
        _require_light("amplitude", inside)
        n_pixels = _diameter(self.n_pixels)
        _check.flag("measured", self.measured)
        values = {
            "amplitude": read_only(_normalised(amplitude, inside)),
            "n_pixels": n_pixels,
            "segments": read_only(_segment_map(self.segments, inside)),
            "center": _checked_center(self.center, amplitude.shape, n_pixels),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"Pupil({self.n_points} points, {self.n_pixels:g} pixels across, shape={self.shape})"

    @classmethod
    def circular(
        cls, n_pixels: int, central_obscuration: float = 0.0, spiders: Sequence[tuple[float, float]] = ()
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
            If nothing is left of the pupil.
        """
        n_pixels = _check.integer("n_pixels", n_pixels, 2, _MOST_PIXELS)
        obscuration = _check.number("central_obscuration", central_obscuration, 0, 1, open_high=True)
        x, y = _square_grid(n_pixels)
        radius = np.hypot(x, y)
        inside = (radius <= 0.5) & (radius >= obscuration / 2)
        for index, spider in enumerate(_check.items("spiders", spiders, "pairs (angle, width)")):
            inside &= ~_vane(x, y, index, spider)
        _require_light("central_obscuration, spiders", inside)
        return cls(inside.astype(float), n_pixels, inside.astype(int), _middle(inside.shape))

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
            Rings around the central segment: 3 make 37 segments. At most half of `n_pixels`.
        gap : float, D
            Width of the gap between neighbours.
        missing : iterable of int
            Numbers of the segments that send no light.
        stop : float, optional
            Diameter of a circular stop as a fraction of the circle around all segments, in [1e-6, 1]. The stop
            then is the pupil: it is D wide, and outer segments are cut by it.

        Raises
        ------
        ValueError
            If a missing segment does not exist, or nothing is left of the pupil.
        """
        n_pixels = _check.integer("n_pixels", n_pixels, 2, _MOST_PIXELS)
        n_rings = _check.integer("n_rings", n_rings, 0)
        if n_rings > n_pixels // 2:
            raise ValueError(f"n_rings = {n_rings}: expected at most half of n_pixels = {n_pixels}")
        whole = 1.0 if stop is None else 1 / _check.number("stop", stop, 1e-6, 1)
        # A corner segment is n_rings pitches out; its farthest corner is at 30 degrees to that direction.
        pitch = whole / 2 / np.sqrt(n_rings**2 + n_rings + 1 / 3)
        gap = _check.number("gap", gap, 0, pitch, open_high=True)
        centers = _hexagon_centers(n_rings) * pitch
        missing = {
            _check.integer("missing", number, 1)
            for number in _check.items("missing", missing, "segment numbers, such as (21,)")
        }
        if missing and max(missing) > len(centers):
            raise ValueError(f"missing = {sorted(missing)}: expected segment numbers from 1 to {len(centers)}")
        x, y = _square_grid(n_pixels)
        segments = np.zeros(x.shape, int)
        for number, (cx, cy) in enumerate(centers, start=1):
            if number not in missing:
                # The box around a segment: on the whole grid, many rings would take hours.
                box = tuple(slice(*np.searchsorted(x[0], (c - pitch, c + pitch))) for c in (cy, cx))
                segments[box][_inside_hexagon(x[box] - cx, y[box] - cy, (pitch - gap) / 2)] = number
        if stop is not None:
            segments[np.hypot(x, y) > 0.5] = 0
        _require_light("missing, gap, stop", segments > 0)
        return cls((segments > 0).astype(float), n_pixels, segments, _middle(segments.shape))

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
            Pupil diameter D, at least 1; the longer side of the image if left out.
        center : (float, float), pixels, optional
            Row and column of the optical axis, at most 1000 D from the middle of the image; there if left out.
        threshold : float
            A point counts as outside where its amplitude is at most this fraction of the largest one.

        Raises
        ------
        ValueError
            If the image holds negative values, or is dark everywhere.
        """
        image = _image("image", image)
        threshold = _check.number("threshold", threshold, 0, 1, open_high=True)
        inside = image > threshold * image.max()
        _require_light("image", inside)
        n_pixels = max(image.shape) if n_pixels is None else _check.number("n_pixels", n_pixels)
        center = _middle(image.shape) if center is None else center
        return cls(np.where(inside, image, 0.0), n_pixels, inside.astype(int), center, measured=True)

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
        ValueError
            If an amplitude on a segment is not positive.
        """
        segments = _segment_map(segments)
        inside = segments > 0
        _require_light("segments", inside)
        amplitude = _check.real_array("amplitude", amplitude)
        try:
            amplitude = np.broadcast_to(amplitude, segments.shape)
        except ValueError:
            raise ValueError(f"amplitude has shape {amplitude.shape}: expected {segments.shape}") from None
        _check.finite("amplitude", amplitude)
        lowest = amplitude[inside].min()
        if lowest <= 0:
            raise ValueError(f"amplitude reaches down to {lowest:.6g} on a segment: expected positive values")
        return cls(np.where(inside, amplitude, 0.0), max(segments.shape), segments, _middle(segments.shape))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a map on this pupil."""
        return self.amplitude.shape

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Whether a point lies inside the pupil, shape (ny, nx)."""
        return read_only(self.amplitude > 0)

    @cached_property
    def indices(self) -> NDArray[np.intp]:
        """Positions of the points inside in a flattened map, shape (n_points,)."""
        return read_only(np.flatnonzero(self.inside))

    @property
    def n_points(self) -> int:
        """Number of points inside."""
        return self.indices.size

    @cached_property
    def x(self) -> NDArray[np.floating]:
        """Horizontal coordinate of each column, in D, shape (nx,)."""
        return read_only((np.arange(self.shape[1]) - self.center[1]) / self.n_pixels)

    @cached_property
    def y(self) -> NDArray[np.floating]:
        """Vertical coordinate of each row, in D, shape (ny,)."""
        return read_only((np.arange(self.shape[0]) - self.center[0]) / self.n_pixels)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Coordinates (x, y) of the points inside, in D, shape (n_points, 2)."""
        row, column = np.unravel_index(self.indices, self.shape)
        return read_only(np.stack([self.x[column], self.y[row]], axis=-1))

    def gather(self, maps: ArrayLike) -> NDArray[Any]:
        """Take the values inside: (..., ny, nx) to (..., n_points), of the same dtype."""
        maps = _check.any_numbers("maps", maps)
        _check.trailing_shape("maps", maps, self.shape, "the shape of the pupil")
        return maps.reshape(*maps.shape[:-2], self.amplitude.size).take(self.indices, axis=-1)

    def scatter(self, values: ArrayLike, fill: complex = np.nan) -> NDArray[Any]:
        """Put values back into maps: (..., n_points) to (..., ny, nx), `fill` outside, of the same dtype."""
        values = _check.any_numbers("values", values)
        _check.trailing_shape("values", values, (self.n_points,), "the points of the pupil")
        maps = np.full((*values.shape[:-1], self.amplitude.size), _fill(fill, values.dtype), values.dtype)
        maps[..., self.indices] = values
        return maps.reshape(*values.shape[:-1], *self.shape)

    def field(self, phase: ArrayLike) -> NDArray[np.complex128]:
        """Return the field amplitude * exp(i phase): (..., ny, nx), radian, to complex, 0 outside.

        Only the points inside count; NaN or anything else is allowed outside.
        """
        phase = _check.real_array("phase", phase)
        _check.trailing_shape("phase", phase, self.shape, "the shape of the pupil")
        phase = np.where(self.inside, phase, 0)
        _check.moderate("phase", phase, " inside the pupil")
        phasor: NDArray[np.complex128] = np.exp(1j * phase.astype(np.float64, copy=False))
        return self.amplitude * phasor

    def rms(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Rms over the points inside, piston removed: (..., ny, nx) to (...), in the unit of `phase`."""
        phase = _check.real_array("phase", phase)
        _check.trailing_shape("phase", phase, self.shape, "the shape of the pupil")
        values = self.gather(phase)
        _check.moderate("phase", values, " inside the pupil")
        return values.std(axis=-1)


def _image(name: str, value: ArrayLike) -> NDArray[np.float64]:
    image = _check.real_array(name, value).astype(np.float64)
    if image.ndim != 2 or not image.size:
        raise ValueError(f"{name} has shape {image.shape}: expected (ny, nx), not empty")
    _check.finite(name, image)
    _check.non_negative(name, image)
    return image


def _require_light(names: str, inside: NDArray[np.bool_]) -> None:
    if not inside.any():
        raise ValueError(f"{names}: the pupil is empty, expected at least one point with an amplitude above 0")


def _normalised(amplitude: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Scale to a mean square of 1 inside."""
    # A power of 2 changes no digit, and keeps the squares within the range of floats.
    amplitude = np.ldexp(amplitude, -np.frexp(amplitude.max())[1])
    return amplitude / np.sqrt(np.mean(amplitude[inside] ** 2))


def _diameter(n_pixels: float) -> float:
    checked = _check.number("n_pixels", n_pixels, 1, _MOST_PIXELS)
    return int(n_pixels) if isinstance(n_pixels, Integral) else checked


def _segment_map(segments: ArrayLike, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Checked map of segment numbers, which must cover the points inside where these are given."""
    segments = _check.any_numbers("segments", segments)
    if segments.dtype.kind not in "iu" or segments.ndim != 2:
        raise TypeError(f"segments is {segments.ndim}-dimensional {segments.dtype}: expected a map of integers")
    if not segments.size:
        raise ValueError(f"segments has shape {segments.shape}: expected (ny, nx), not empty")
    if segments.min() < 0:
        raise ValueError(f"segments reaches down to {segments.min()}: expected numbers from 0 on")
    if segments.max() > np.iinfo(np.int64).max:
        raise ValueError(f"segments reaches up to {segments.max()}: expected numbers below 2^63")
    if inside is not None:
        if segments.shape != inside.shape:
            raise ValueError(f"segments has shape {segments.shape}: expected {inside.shape}, as the amplitude")
        n_wrong = np.count_nonzero((segments > 0) != inside)
        if n_wrong:
            raise ValueError(
                f"segments differs from the amplitude at {n_wrong} points: expected 0 where the amplitude is 0, "
                "and a positive number elsewhere"
            )
    return segments.astype(np.int64)


def _middle(shape: tuple[int, ...]) -> tuple[float, float]:
    ny, nx = shape
    return (ny - 1) / 2, (nx - 1) / 2


def _checked_center(center: Any, shape: tuple[int, ...], n_pixels: float) -> tuple[float, float]:
    row, column = _check.pair("center", center, _check.number)
    if math.dist((row, column), _middle(shape)) > _FARTHEST * n_pixels:
        raise ValueError(
            f"center = {_check.shown(center)}: expected at most {_FARTHEST:g} D from the middle of the image"
        )
    return row, column


def _fill(fill: Any, dtype: np.dtype) -> Any:
    """Check a number that is to stand among values of a dtype."""
    fill = fill.item() if isinstance(fill, np.generic) else fill
    kind, meaning = {"c": (Complex, "a number"), "f": (Real, "a real number")}.get(
        dtype.kind, (Integral, "an integer")
    )
    expected = f"fill = {_check.shown(fill)}: expected {meaning} that fits among values of dtype {dtype}"
    if not isinstance(fill, kind):
        raise TypeError(expected)
    try:
        with np.errstate(over="ignore"):
            stored = np.array(fill, dtype)
    except OverflowError:
        raise ValueError(expected) from None
    if np.isinf(stored) and not cmath.isinf(fill):
        raise ValueError(expected)
    return stored


def _square_grid(n_pixels: int) -> tuple[NDArray, NDArray]:
    axis = (np.arange(n_pixels) - (n_pixels - 1) / 2) / n_pixels
    return np.meshgrid(axis, axis)


def _vane(x: NDArray, y: NDArray, index: int, spider: tuple[float, float]) -> NDArray:
    angle, width = _check.pair(f"spiders[{index}]", spider, _check.number)
    angle = _check.radian(f"spiders[{index}] angle", angle)
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
    plane = np.array(centers)
    return np.stack([plane.real, plane.imag], axis=-1)


def _inside_hexagon(x: NDArray, y: NDArray, apothem: float) -> NDArray:
    inside = np.abs(y) <= apothem
    for angle in (np.pi / 6, -np.pi / 6):
        inside &= np.abs(x * np.cos(angle) + y * np.sin(angle)) <= apothem
    return inside
