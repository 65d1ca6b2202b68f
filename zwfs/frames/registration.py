"""Positions of the pupils on a camera: find them, and register them to a fraction of a pixel.

The second image may be shifted, rotated and magnified with respect to the first. `register_frames` measures
all of it, and each image is interpolated once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import nearest_good, radius, turning
from zwfs.frames._outline import UNEVEN, Circle, Details, gains, outline, threshold

__all__ = ["Placement", "RegisteredFrames", "register_frames"]

_REACH = 6  # pixels by which an image may be off its neighbour before sub-pixel registration
_GAPS = 6, 2  # half of the pixels by which parts of a pupil are apart; less where two pupils are as close
_MANY_BAD = 0.05  # of the pixels of an image: worth a word where no pupil is found
_SMALLEST = 8  # pixels across a pupil: with fewer there is no outline
_MARGIN = 0.25  # of the diameter: more of the dark surroundings adds nothing
_TOUCHED = 0.01  # weight of a bad pixel from which on a point is bad
_ORDER = 3  # of the splines that interpolate an image
_BLUR = 2.0  # pixels rms: finest detail that counts for registration
# A rotation or magnification is fitted if its standard error is below so many pixels at the edge of the pupil, or
# below this part of its value.
_SURE, _SIGNIFICANT = 0.05, 0.1
_EDGE, _AROUND = 3, 8  # pixels around the pupil: those that take part where the surroundings are there, and all
# A pixel beyond all neighbours but one, by so many times their spread and noise: on frame and clear frame, on one.
_ODD_ON_BOTH, _ODD = 0.5, 3.0
_FAINT = 0.01  # of the brightest light: a pixel that is off by less does no harm
_BRIGHTER = 1.5  # light of hot pixels that stand together over that of a pupil
_UNLIT, _MOST_OF_IT = 0.05, 0.6  # light of a dead line over that around it, and part of a hot line that is hot
_FEW_LINES = 4
# Why an image holds one pupil, or two.
_WHY = {
    1: "because another image holds the other pupil, or phase_shifts has one value; with both pupils on each "
    "exposure, set n_images = 1",
    2: "because two images are needed, with different phase shifts, and some pixels apart",
}
FRAMES, CLEAR_FRAMES = slice(0, 2), slice(2, 4)  # of the four images
_LARGEST_TURN, _LARGEST_STRETCH = 6.0, 0.06  # degrees, and relative, of the second image


@dataclass(frozen=True, eq=False)
class Image:
    """One image of a camera.

    Attributes
    ----------
    counts : ndarray of float, shape (ny, nx)
        Finite everywhere; pixels that are `bad` hold the value of their nearest good neighbour.
    bad : ndarray of bool, shape (ny, nx)
        Pixels that are NaN, saturated, or named by a bad-pixel map.
    name : str
        For messages.
    cut : bool
        Whether the surroundings of the pupil were set to 0 by software, so that they do not show the background.
    dark : ndarray, shape (ny, nx), or float
        Counts without light, which were subtracted; NaN where they are not known.
    window : (int, int), optional
        First row and column of the image on the detector, where they are known; counted from any number.

    Raises
    ------
    ValueError
        If a count is not finite or beyond 1e38, or the dark has another shape.
    """

    counts: NDArray[np.float64]
    bad: NDArray[np.bool_]
    name: str = "image"
    cut: bool = False
    dark: NDArray[np.float64] | float = 0.0
    window: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        counts = _check.real_map("counts", self.counts, 2)
        object.__setattr__(self, "counts", counts)
        object.__setattr__(self, "bad", _check.flag_map("bad", self.bad, counts.shape))
        _check.instance("name", self.name, str)
        _check.flag("cut", self.cut)
        dark = _check.real_array("dark", self.dark)
        if dark.shape not in ((), counts.shape):
            raise ValueError(f"dark has shape {dark.shape}: expected {counts.shape}, that of counts")
        object.__setattr__(self, "dark", np.broadcast_to(dark, counts.shape))

    @classmethod
    def of(cls, counts: NDArray, name: str, dark: Any = 0.0) -> Image:
        """Image of counts, (ny, nx), less the dark, in which bad pixels are not finite."""
        good = np.isfinite(counts)
        if not good.any():
            raise ValueError(f"{name} less the dark: all pixels are NaN or infinite: expected an image")
        return cls(nearest_good(counts, good), ~good, name, dark=dark)


@dataclass(frozen=True, eq=False)
class Placement:
    """Shift, rotation and magnification of an image with respect to a reference.

    A point that stands at p on the reference, counted from the centre of the pupil, stands at shift + matrix p on
    the image, counted from the same pixel.

    Attributes
    ----------
    shift : ndarray, shape (2,), pixels
        Of the centre of the pupil: rows, columns.
    rotation : float, degrees
        Positive from the axis of the columns (x) to that of the rows (y).
    magnification : float
        Size of the image over that of the reference.
    sigma : ndarray, shape (4,)
        Standard errors of row, column, rotation and magnification. NaN for a value that the images do not
        determine and that was not fitted, such as the rotation of a plain disc.
    """

    shift: NDArray[np.float64]
    rotation: float = 0.0
    magnification: float = 1.0
    sigma: NDArray[np.float64] = field(default_factory=lambda: np.full(4, np.nan))

    def __post_init__(self) -> None:
        _check.declared(self)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Rotation and magnification, for (row, column), shape (2, 2)."""
        return turning(self.rotation, self.magnification)


@dataclass(frozen=True, eq=False)
class RegisteredFrames:
    """Two frames and two clear frames on the camera, and where the pupils stand on them.

    Make one with `register_frames`.

    Attributes
    ----------
    frames, clear_frames : (Image, Image)
        Counts, less the dark. One camera image with two pupils stands here twice.
    pupils : (Circle, Circle)
        On the clear frames.
    origins : ndarray, shape (4, 2), pixels
        How far the centre of the pupil stands on each image from its place on the first clear frame, by
        registration: frames first, then clear frames.
    background, balance : bool
        Whether to subtract the light around the pupils of the clear frames, and whether to balance.
    exposure : float
        Exposure of the frames over that of the clear frames.
    placement : Placement
        Of the second clear frame with respect to the first. Its rotation and magnification are also those of the
        second frame.
    n_odd : int
        Hot and dead pixels of all images that were not marked as bad when given, and now are.
    """

    frames: tuple[Image, Image]
    clear_frames: tuple[Image, Image]
    pupils: tuple[Circle, Circle]
    origins: NDArray[np.float64]
    background: bool = True
    balance: bool = True
    exposure: float = 1.0
    placement: Placement = Placement(np.zeros(2))
    n_odd: int = 0

    def __post_init__(self) -> None:
        _check.declared(self)

    @property
    def images(self) -> tuple[Image, ...]:
        """Frames, then clear frames."""
        return self.frames + self.clear_frames

    @property
    def camera_images(self) -> tuple[Image, ...]:
        """Frames, one of them if it holds both pupils."""
        return self.frames[: 1 if self.frames[0] is self.frames[1] else 2]

    @cached_property
    def diameter(self) -> float:
        """Diameter of the pupil in pixels of the first image, as the mean of both less the magnification."""
        first, second = self.pupils
        return (first.diameter + second.diameter / self.placement.magnification) / 2

    @cached_property
    def matrices(self) -> NDArray[np.float64]:
        """Rotation and magnification of each image, (4, 2, 2), in the sense of `Placement`."""
        return np.stack([np.eye(2), self.placement.matrix] * 2)

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """Area of a point of the grid on each image, (4,), in pixels."""
        return np.linalg.det(self.matrices)

    @cached_property
    def n_pixels(self) -> int:
        """Rows and columns of the grid of the pupil."""
        return math.ceil(self.diameter) + 2

    @cached_property
    def corner(self) -> NDArray[np.int64]:
        """First row and column of the grid of the pupil on the first clear frame."""
        first = self.pupils[0]
        return np.round(np.array([first.row, first.column]) - (self.n_pixels - 1) / 2).astype(int)

    @property
    def center(self) -> tuple[float, float]:
        """Row and column of the centre of the pupil on its grid."""
        first = self.pupils[0]
        return first.row - self.corner[0], first.column - self.corner[1]

    @cached_property
    def margin(self) -> int:
        """Pixels around the grid of the pupil that both frames hold."""
        half = (self.n_pixels - 1) / 2
        room = [_MARGIN * self.diameter]
        for image, places, matrix in zip(self.frames, self.places(), self.matrices, strict=False):
            middle = places.mean(axis=(1, 2))
            ends = np.minimum(middle, np.array(image.counts.shape) - 1 - middle)
            room += list(ends / np.abs(matrix).sum(axis=1) - half)
        if self.frames[0] is self.frames[1]:
            # Light of the neighbour begins half-way.
            room.append((np.abs(self.origins[1] - self.origins[0]).max() - self.n_pixels) / 2)
        return max(0, math.floor(min(room)))

    def places(self, margin: int = 0) -> NDArray[np.float64]:
        """Row and column of each point of the grid with a margin around it, on each image, (4, 2, ny', nx')."""
        margin = _check.integer("margin", margin, 0, max(max(image.counts.shape) for image in self.images))
        start = -np.array(self.center) - margin
        grid = np.indices((self.n_pixels + 2 * margin,) * 2) + start[:, np.newaxis, np.newaxis]
        centers = self.origins + self.corner + self.center
        return np.einsum("kij,jyx->kiyx", self.matrices, grid) + centers[..., np.newaxis, np.newaxis]

    def _on_grid(self, which: slice, margin: int = 0) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """`FRAMES` or `CLEAR_FRAMES`, and their bad pixels, on the grid with a margin, (2, ny', nx').

        They are interpolated once. Counts are those of a pixel of the first image.
        """
        places = self.places(margin)[which]
        counts, bad = np.empty((2, *places.shape[2:])), np.empty((2, *places.shape[2:]), bool)
        for index, image in enumerate(self.images[which]):
            # Beyond an image its edge is repeated.
            counts[index] = ndimage.map_coordinates(image.counts, places[index], order=_ORDER, mode="nearest")
            # A bad pixel spoils the points on all its sides.
            spoiled = ndimage.map_coordinates(image.bad.astype(float), places[index], order=1, mode="nearest")
            bad[index] = spoiled > _TOUCHED
        return counts * self.areas[which, np.newaxis, np.newaxis], bad


def register_frames(
    frames: Sequence[Image],
    clear_frames: Sequence[Image],
    *,
    pupil_centers: Sequence[Sequence[float]] | None = None,
    pupil_diameter: float | None = None,
    exposure: float = 1.0,
    subpixel: bool = True,
    background: bool = True,
    balance: bool = True,
    n_pupils: int = 2,
) -> RegisteredFrames:
    """Find the pupils on the images and register these to each other.

    The second clear frame is registered to the first. Frames are taken to stand at the same place of the detector
    as the clear frames: the camera has not moved. If they are of another format and the windows of both on the
    detector are not known, the pupils are located on them, too. Where one image holds both pupils, both have moved
    by the same number of whole pixels. Otherwise each frame is registered to its clear frame. That is less
    reliable, because the phase changes the look of gaps and edges.

    Hot and dead pixels that are not yet marked as bad are found and marked: they are brighter or darker than all
    their neighbours but one, by much on one image or by less on frame and clear frame alike.

    Parameters
    ----------
    frames : sequence of one or two Images
        With the mask in: one that holds both pupils, side by side or one above the other, or one for each.
    clear_frames : sequence of one or two Images
        The same with the mask taken out. May be cropped closer than the frames.
    pupil_centers : sequence of two (row, column), pixels, optional
        Centres of the pupils on the clear frames; by default those of their outlines.
    pupil_diameter : float, pixels, optional
        Diameter of the pupils; by default that of the outlines.
    exposure : float
        Exposure of the frames over that of the clear frames.
    subpixel : bool
        Register to a fraction of a pixel. If not, pupils are put on each other by their outlines, to whole pixels.
    background, balance : bool
        See `RegisteredFrames`.
    n_pupils : int
        1 for a sensor with one mask and one image. The result holds this image twice.

    Raises
    ------
    TypeError, ValueError
        If the number of images is wrong, the pupils are not found, cut, or of different size.
    """
    exposure = _check.number("exposure", exposure, 0, open_low=True)
    subpixel = _check.flag("subpixel", subpixel)
    n_pupils = _check.integer("n_pupils", n_pupils, 1, 2)
    background, balance = _check.flag("background", background), _check.flag("balance", balance)
    for name, images in (("frames", frames), ("clear_frames", clear_frames)):
        _check.sequence(name, images, Image)
        if len(images) not in (1, n_pupils):
            raise ValueError(f"{name} holds {len(images)} images: expected 1{' or 2' * (n_pupils == 2)}")
    n_marked = _n_bad(*frames, *clear_frames)
    # The clear frames are judged alone, so that a pupil stands at the same place for all frames.
    frames, clear_frames = (
        _without_odd(frames, clear_frames, clear=False),
        _without_odd(clear_frames, frames, clear=True),
    )
    n_odd = _n_bad(*frames, *clear_frames) - n_marked
    if n_pupils == 1:
        frames, clear_frames = frames * 2, clear_frames * 2
    shape = clear_frames[0].counts.shape
    diameter = None if pupil_diameter is None else check_diameter(pupil_diameter, shape)
    centers = None if pupil_centers is None else check_centers(pupil_centers, n_pupils)
    if centers is not None and diameter is None:
        raise ValueError("pupil_centers without a pupil_diameter: expected both, or neither")
    clear, pupils = _locate(clear_frames, centers, diameter)
    _check_alike(clear, pupils)
    masked, circles = (frames[0], frames[-1]), pupils
    formats = [(pair[0] is pair[1], *(image.counts.shape for image in pair)) for pair in (masked, clear)]
    windows = [[image.window or () for image in pair] for pair in (masked, clear)]
    stated = all(image.window for image in (*masked, *clear))
    moved = formats[0] != formats[1] and not stated
    if moved or (stated and windows[0] != windows[1]):
        centers = np.array([circle[:2] for circle in pupils]) + windows[1] - windows[0] if stated else None
        masked, circles = _locate(frames, centers, diameter or pupils[0].diameter)
    for image in masked:
        if not np.ptp(image.counts) > 0:
            raise ValueError(f"{image.name}: every pixel is {image.counts.flat[0]:.6g}: expected light")
    places = np.array([circle[:2] for circle in (*circles, *pupils)])
    origins = np.round(places - places[2])
    if moved and masked[0] is masked[1] and clear[0] is clear[1]:
        origins[:2] = origins[2:] + np.mean(places[:2] - places[2:], axis=0)
    rough = RegisteredFrames(masked, clear, pupils, origins, background, balance, exposure, n_odd=n_odd)
    return _register(rough, frames_too=moved) if subpixel else rough


def _check_alike(images: Sequence[Image], pupils: Sequence[Circle]) -> None:
    """Require that the pupils on two images are about equally large."""
    small, large = sorted(circle.diameter for circle in pupils)
    if large - small > max(2.0, _LARGEST_STRETCH * large):
        names = " and ".join(dict.fromkeys(image.name for image in images))
        raise ValueError(
            f"{names}: the two pupils are {small:.1f} and {large:.1f} pixels wide: "
            f"expected the same size, to {_LARGEST_STRETCH:.0%}"
        )


def check_centers(centers: Any, n_pupils: int = 2) -> NDArray[np.float64]:
    """Return the centres of two pupils, (2, 2); one stands there twice."""
    centers = _check.real_map("pupil_centers", centers)
    if centers.shape != (n_pupils, 2):
        pupils = "one pupil" if n_pupils == 1 else "each of two pupils"
        raise ValueError(f"pupil_centers has shape {centers.shape}: expected (row, column) of {pupils}")
    return np.concatenate([centers] * (3 - n_pupils))


def check_diameter(diameter: Any, shape: tuple[int, ...]) -> float:
    """Return a diameter of pupils that stand on a clear frame of a shape."""
    return _check.number("pupil_diameter", diameter, _SMALLEST, min(shape) + 4)  # cut by 2 pixels on each side


def find_pupils(image: Image, n_pupils: int, diameter: float | None = None) -> list[Circle]:
    """Find the bright discs on an image, from left to right, or from top to bottom if they stand so.

    A threshold between dark and bright (Otsu's) gives the outline, and the circle around it is the pupil. Its
    diameter, in pixels, may be given.
    """
    smooth = ndimage.gaussian_filter(image.counts, 1.0)
    remark = _on_bad(image)
    if np.ptp(smooth) <= 1e-9 * np.abs(smooth).max(initial=1e-300):
        raise ValueError(f"{image.name}: every pixel is {smooth.flat[0]:.6g}: expected light in a pupil{remark}")
    level, numbers = threshold(smooth), list[int]()
    bright = np.pad(ndimage.binary_opening(smooth > level, iterations=2), 8)
    for n_closed in _GAPS:
        labels, n_found = ndimage.label(ndimage.binary_closing(bright, iterations=n_closed)[8:-8, 8:-8])
        areas = ndimage.sum_labels(labels > 0, labels, np.arange(1, n_found + 1))
        largest = np.flatnonzero((areas > 0.25 * areas.max(initial=0)) & (areas.max(initial=0) >= 50)) + 1
        numbers.append(len(largest))
        if len(largest) == n_pupils:
            break
    else:
        raise ValueError(
            f"{image.name}: {numbers[0]} bright regions as large as a pupil: expected {n_pupils}, "
            f"{_WHY[n_pupils]}; give the positions, or look for stray light{remark}"
        )
    circles = [outline(smooth, labels == label, level, diameter) for label in largest]
    axis = int(np.argmax(np.ptp([circle[:2] for circle in circles], axis=0)))
    return sorted(circles, key=lambda circle: circle[axis])


def _on_bad(image: Image) -> str:
    """Remark for a message on an image with many bad pixels."""
    share = image.bad.mean()
    if share <= _MANY_BAD:
        return ""
    expected = "a map that is 0 where good, and a saturation above the light"
    return f" ({share:.0%} of its pixels are marked as bad: expected {expected})"


def register(
    image: NDArray,
    reference: NDArray,
    inside: NDArray,
    center: tuple[float, float] | None = None,
    *,
    turn: bool = False,
    magnification: float = 1.0,
) -> Placement:
    """Shift of an image from a reference (ny, nx), to a fraction of a pixel; with `turn` also how it is turned.

    Maximises the correlation of the two at the points `inside` the reference, after a band-pass that keeps gaps,
    vanes and edges but takes away noise, the illumination, and the grid of a deformable mirror, whose contrast
    depends on the focus of the camera. With `turn`, a rotation or magnification that the images do not determine
    stays out: its standard error exceeds 0.05 pixels at the edge of `inside`, and a tenth of its value unless that
    is larger than allowed.
    """
    center = center or ((len(reference) - 1) / 2, (len(reference[0]) - 1) / 2)
    # Details of three times the width, at every third point, draw the search from farther away.
    thin = np.zeros_like(inside)
    thin[::3, ::3] = True
    coarse = Details(image, reference, inside & thin if np.any(inside & thin) else inside, center, 3 * _BLUR)
    details = Details(image, reference, inside, center, _BLUR)
    stretch = (magnification - 1) * details.reach if turn else 0.0
    steps = range(-_REACH, _REACH + 1)
    moves = [(y, x, 0.0, stretch) for y in steps for x in steps]
    start = min(moves, key=lambda move: float(np.sum(coarse.difference(move) ** 2)))
    if max(map(abs, start[:2])) == _REACH:
        reason = f"the best shift of the images is {start[:2]} pixels, the end of the search"
        raise ValueError(f"{reason}: expected less than {_REACH}, and images that look alike")
    turns = np.array([False, False, True, True])
    free = turn | ~turns
    best, _ = coarse.search(np.array(start), free)
    best, sigma = details.search(best, free)
    most = details.reach * np.array([np.inf, np.inf, np.radians(_LARGEST_TURN), _LARGEST_STRETCH])

    def undetermined() -> NDArray[np.bool_]:
        significant = np.where(np.abs(best) < most, _SIGNIFICANT * np.abs(best), 0)
        return turns & free & ~(sigma < np.maximum(_SURE, significant))

    while (unsure := undetermined()).any():
        worst = np.argmax(np.where(unsure, np.nan_to_num(sigma, nan=np.inf), -1))
        free[worst], best[worst] = False, 0
        best, sigma = details.search(best, free)
    scale = np.array([1, 1, np.degrees(1 / details.reach), 1 / details.reach])
    rows, columns, rotation, stretch = best * scale
    return Placement(np.array([rows, columns]), float(rotation), float(1 + stretch), sigma * scale)


def correlations(first: NDArray, second: NDArray) -> NDArray[np.float64]:
    """Correlation coefficient of each row, (k, n) and (k, n) to (k,); 0 where one is constant."""
    first, second = (rows - rows.mean(axis=1, keepdims=True) for rows in (first, second))
    scale = np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))
    return np.divide(np.sum(first * second, axis=1), scale, out=np.zeros(len(scale)), where=scale > 0)


def _locate(
    images: Sequence[Image], centers: NDArray | None, diameter: float | None
) -> tuple[tuple[Image, Image], tuple[Circle, Circle]]:
    """Two images and the pupil on each; surroundings that software cut out are continued."""
    n_pupils, shared = 3 - len(images), images[0] is images[-1]
    if centers is not None and diameter is not None:
        circles = [Circle(row, column, diameter) for row, column in centers.tolist()]
    else:
        circles = [circle for image in images for circle in find_pupils(image, n_pupils, diameter)]
    pair = images[0], images[-1]
    origin = "of pupil_centers " if centers is not None else ""
    for circle, image in zip(circles, pair, strict=True):
        room = [*circle[:2], *np.subtract(image.counts.shape, 1) - circle[:2]]
        if min(room) < circle.diameter / 2 - 2.5:  # it reaches more than 2 pixels beyond the image
            side = ("top", "left", "bottom", "right")[int(np.argmin(room))]
            raise ValueError(
                f"{image.name}: the pupil {origin}at row {circle.row:.1f}, column {circle.column:.1f}, "
                f"{circle.diameter:.1f} pixels wide, is cut off at the {side} (row 0 is the top): "
                f"expected all of it on the image{_on_bad(image)}"
            )
    first = _extend(pair[0], circles if shared else circles[:1])
    return (first, first if shared else _extend(pair[1], circles[1:])), (circles[0], circles[1])


def _n_bad(*images: Image) -> int:
    return sum(int(np.count_nonzero(image.bad)) for image in images)


def _without_odd(images: Sequence[Image], others: Sequence[Image], *, clear: bool) -> tuple[Image, ...]:
    """Images with hot and dead pixels and lines marked as bad; `others` show them without or with the mask.

    A group of bright pixels may be a poke on a frame, but is hot on a clear frame. A line without light may be a
    vane on a clear frame, but is dead on a frame, where the mask sends light into it.
    """
    alike = [image.counts.shape for image in images] == [image.counts.shape for image in others]
    marked = []
    for index, image in enumerate(images):
        sizes, (hot, dead) = _outstanding(image), _lines(image)
        odd = (sizes.max(axis=0) > _ODD) | hot
        if alike and clear:
            odd |= _groups(image) | (dead & _lines(others[index])[1])
        elif alike:
            odd |= (np.minimum(sizes, _outstanding(others[index])) > _ODD_ON_BOTH).any(axis=0)
            odd |= _groups(others[index])
        odd |= dead & (not clear)
        bad = image.bad | odd
        marked.append(replace(image, counts=nearest_good(image.counts, ~bad), bad=bad) if odd.any() else image)
    return tuple(marked)


def _outstanding(image: Image) -> NDArray[np.float64]:
    """How far each pixel is above, and below, its neighbours, (2, ny, nx), in units of their spread and noise."""
    counts, ring = image.counts, np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    # One neighbour may be as hot.
    low, middle, high = (ndimage.rank_filter(counts, rank, footprint=ring) for rank in (1, 4, -2))
    unit = high - low + ndimage.uniform_filter(np.abs(counts - middle), 7) + _FAINT * np.ptp(middle)
    return np.array([counts - high, low - counts]) / np.maximum(unit, 1e-300)


def _groups(image: Image) -> NDArray[np.bool_]:
    """Pixels of groups of a few that are brighter than those around them, and than the light of a pupil."""
    counts, light = _above_dark(image)
    ring = np.pad(np.zeros((3, 3)), 1, constant_values=1)
    return (counts > _BRIGHTER * light) & (counts - ndimage.rank_filter(counts, -4, footprint=ring) > light / 2)


def _lines(image: Image) -> NDArray[np.bool_]:
    """Pixels of lines that are brighter than those around them, and of lines without light, (2, ny, nx).

    Many lines are the gaps of a mirror of segments, and not faults of a camera.
    """
    counts, light = _above_dark(image)
    odd = np.zeros((2, *counts.shape), bool)
    for axis in (0, 1):
        lines = np.moveaxis(counts, axis, 0)
        sides = [np.roll(lines, step, axis=0) for step in (-3, -2, 2, 3)]
        lowest, highest = np.min(sides, axis=0), np.max(sides, axis=0)
        lit = lowest > light / 2
        hot = np.mean(lines - highest > light / 2, axis=1) > _MOST_OF_IT
        dead = np.sum(lines, axis=1, where=lit) < _UNLIT * np.sum(lowest, axis=1, where=lit)
        for which, index in ((hot, 0), (dead & (np.count_nonzero(lit, axis=1) >= _SMALLEST), 1)):
            if np.count_nonzero(which) <= _FEW_LINES:
                np.moveaxis(odd[index], axis, 0)[which] = True
    return odd


def _above_dark(image: Image) -> tuple[NDArray[np.float64], float]:
    """Counts above those of dark pixels, and those of a typical lit one."""
    lit = image.counts > threshold(image.counts)
    dark, light = (float(np.median(image.counts[which])) if which.any() else 0.0 for which in (~lit, lit))
    return image.counts - dark, light - dark


def _extend(image: Image, circles: Sequence[Circle]) -> Image:
    """An image whose surroundings were set to 0 by software, continued by its edge: splines dislike steps."""
    apart = [radius(image.counts.shape, circle[:2]) / circle.diameter for circle in circles]
    unlit = (image.counts == 0) & (np.min(apart, axis=0) > 0.5)
    if np.count_nonzero(unlit) < 0.05 * unlit.size:
        return image
    return replace(image, counts=nearest_good(image.counts, ~unlit), cut=True)


def _register(rough: RegisteredFrames, frames_too: bool) -> RegisteredFrames:
    """Register the second clear frame to the first, and each frame to, or with, its clear frame."""
    first, second = rough.pupils
    # The outline takes part, unless software cut it out of its surroundings.
    cut = any(image.cut for image in rough.clear_frames)
    reach = 0.45 * rough.diameter if cut else rough.diameter / 2 + _EDGE
    images, bad = rough._on_grid(CLEAR_FRAMES, _AROUND)
    center = rough.center[0] + _AROUND, rough.center[1] + _AROUND
    inside = radius(images.shape[1:], center) <= reach
    gain = gains(images, inside & ~bad.any(axis=0), center, rough.diameter)
    if np.ptp(gain[1]) > UNEVEN:  # the edge of unevenly lit arms looks moved and stretched
        images = images / gain
    ratio = second.diameter / first.diameter
    placement = register(images[1], images[0], inside, center, turn=True, magnification=ratio)
    if abs(placement.rotation) > _LARGEST_TURN or abs(placement.magnification - 1) > _LARGEST_STRETCH:
        raise ValueError(
            f"the second image is rotated by {placement.rotation:.1f} degrees and magnified by "
            f"{placement.magnification:.3f}: expected at most {_LARGEST_TURN:g} degrees and {_LARGEST_STRETCH:.0%}"
        )
    origins = rough.origins.copy()
    origins[[1, 3]] += placement.shift
    placed = replace(rough, origins=origins, placement=replace(placement, shift=origins[3]))
    if not frames_too:
        return placed
    (frames, _), (images, _) = (placed._on_grid(which) for which in (FRAMES, CLEAR_FRAMES))
    if placed.frames[0] is placed.frames[1] and placed.clear_frames[0] is placed.clear_frames[1]:
        # What opposite phase shifts change at the edge of the pupil, and in it, is smaller in the mean.
        inside = radius(images.shape[1:], placed.center) <= placed.diameter / 2 + _EDGE
        move = register(frames.mean(axis=0), images.mean(axis=0), inside, placed.center).shift
        # The outlines err in other ways than the content, so that their mean is better than each.
        origins[:2] = origins[2:] + np.round(origins[0] - origins[2] + move / 2)
        return replace(placed, origins=origins)
    # Off the edge, which the mask makes bright or dark.
    inside = radius(images.shape[1:], placed.center) <= 0.45 * placed.diameter
    moves = [
        register(frame, image, inside, placed.center).shift for frame, image in zip(frames, images, strict=True)
    ]
    turned = np.einsum("kij,kj->ki", placed.matrices[:2], moves)
    return replace(placed, origins=origins + np.concatenate([turned, np.zeros((2, 2))]))
