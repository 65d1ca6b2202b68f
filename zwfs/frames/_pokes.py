"""Frames of pokes: their signals and phases, whether they make sense, and the inverse of the responses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._system import path_of
from zwfs.frames._grid import pixels_around
from zwfs.frames._stack import Stack
from zwfs.frames.phases import Flag

if TYPE_CHECKING:
    from zwfs.frames.calibration import Calibration
    from zwfs.frames.phases import Phases

_UNMOVED = 1.2  # response to a poke, in squares and over its noise, below which it shows nothing
_CONTRARY = 0.8  # mean change of push and pull over half their difference: 1 if one of the two did not move
_ALIKE = 0.05  # difference of two responses over their sizes, in squares
_CLEAR = 4.0  # response over its noise, in squares, from which on two responses can be compared
_SILENT = 1e-6  # response to a poke over that of a typical one, in squares: nothing, where there is no noise
_UNSEEN = 1.05  # singular value over that of noise alone, below which a direction is noise
_LOST = 5.0  # standard errors of the light, below which a frame has none
_MOST_AROUND = 128  # pixels that show the background
_FLAT = 0.01  # variance of their light over its mean square: with less, light and background look the same
_FEWEST = 0.8  # of the pixels that the pupil covers, which are good in all frames of the pokes


class Inverse(NamedTuple):
    """Inverse of an interaction matrix, without the directions that it hardly shows."""

    matrix: NDArray[np.float64]  # (n_commands, n_values)
    directions: NDArray[np.float64]  # (n_kept, n_commands), orthonormal

    @classmethod
    def of(cls, interaction: NDArray, rcond: float, noise: float = 0.0) -> Inverse:
        """Inverse of a matrix (n_values, n_commands) whose numbers have an error of `noise`.

        The error adds noise**2 * n_values to each eigenvalue of J^T J. That is subtracted, because it would lower
        the gain of weak directions. A direction that is no stronger than that is left out, as is one below `rcond`
        times the strongest.
        """
        values, vectors = np.linalg.eigh(interaction.T @ interaction)
        floor = noise**2 * len(interaction)
        strength = values - floor
        least = max(rcond**2 * strength[-1], (_UNSEEN**2 - 1) * floor, 1e-14 * values[-1])
        shown = strength > least
        ways = vectors[:, shown].T
        return cls((ways.T / strength[shown]) @ (ways @ interaction.T), ways)


class Pokes(NamedTuple):
    """Frames of a flat mirror, and means of those of pokes, counts, the dark included."""

    flats: NDArray  # (n, ..., ny, nx)
    pushed: NDArray[np.float64]  # (n_commands, ..., ny, nx)
    pulled: NDArray[np.float64]
    n_averaged: int  # frames of each poke
    good: NDArray[np.bool_]  # (..., ny, nx), pixels that are good in all frames

    @classmethod
    def of(cls, calibration: Calibration, flat: Any, pushed: Any, pulled: Any) -> Pokes:
        """Check and average frames, which are arrays or files."""
        image = image_shape(calibration)
        flat, pushed, pulled = (
            _frames_of(name, frames, calibration)
            for name, frames in (("flat", flat), ("pushed", pushed), ("pulled", pulled))
        )
        if pushed.ndim == len(image):
            raise ValueError(f"pushed has shape {pushed.shape}: expected one frame, or several, for each command")
        if pushed.shape != pulled.shape:
            raise ValueError(f"pulled has shape {pulled.shape}: expected {pushed.shape}, that of pushed")
        good = np.ones(image, bool)
        with np.errstate(invalid="ignore"):
            for frames in (flat, pushed, pulled):
                usable = (frames < calibration.saturation) & (frames > -_check.LARGEST)
                good &= usable.reshape(-1, *image).all(axis=0)
        pushed, pulled = (frames.reshape(len(frames), -1, *image) for frames in (pushed, pulled))
        push, pull = (frames.mean(axis=1, dtype=float) for frames in (pushed, pulled))
        return cls(flat.reshape(-1, *image), push, pull, pushed.shape[1], good)

    @property
    def flat(self) -> NDArray[np.float64]:
        """Mean frame of the flat mirror."""
        return self.flats.mean(axis=0, dtype=float)

    def modes(self, calibration: Calibration) -> NDArray[np.float32]:
        """Half the difference of the phases of push and pull, without its mean, (n, ny, nx)."""
        pushed, pulled = (
            phases_of(name, np.where(self.good, images, np.nan), calibration).filled
            for name, images in (("pushed", self.pushed), ("pulled", self.pulled))
        )
        half = np.angle(np.exp(1j * (pushed.astype(float) - pulled))) / 2
        half -= half[:, calibration.good].mean(axis=1)[:, np.newaxis, np.newaxis]
        return np.where(calibration.amplitude > 0, half, 0).astype(np.float32)


def phases_of(name: str, counts: NDArray, calibration: Calibration) -> Phases:
    """Phases of frames that must have light."""
    phases = calibration(counts)
    lost = np.flatnonzero(np.atleast_1d(phases.flags & Flag.LOST))
    if lost.size:
        raise ValueError(f"{name}: its frames {lost.tolist()} are lost: expected light in all of them")
    return phases


class Signals(NamedTuple):
    """Frames over their own light, at the pixels that count."""

    mask: NDArray[np.bool_]
    dark: NDArray[np.float64]  # (n_pixels,), counts
    light: float  # of the flat mirror, counts
    reference: NDArray[np.float64]  # (n_pixels,)
    difference: NDArray[np.float64]  # (n_commands, n_pixels), half of that of push and pull
    asymmetry: NDArray[np.float64]  # their mean, less the reference
    noise: float  # of one pixel in one frame of the flat mirror
    shares: tuple[float, float]  # of the variance of a frame, in those of difference and asymmetry

    @classmethod
    def of(cls, calibration: Calibration, pokes: Pokes) -> Signals:
        """Signals of pokes."""
        mask = _pixels(calibration)
        n_pixels = np.count_nonzero(mask)
        mask &= pokes.good
        if np.count_nonzero(mask) < _FEWEST * n_pixels:
            raise ValueError(
                f"flat, pushed, pulled: {np.count_nonzero(mask)} of the {n_pixels} pixels of the pupils are good "
                f"in all frames: expected {100 * _FEWEST:.0f} % of them, none of them NaN or saturated"
            )
        dark = dark_of(calibration)[mask]
        signals, lights = [], []
        for name, images in (("flat", pokes.flats), ("pushed", pokes.pushed), ("pulled", pokes.pulled)):
            values = images[:, mask] - dark
            light = values.sum(axis=1)
            if np.any(dim := light <= 0):
                raise ValueError(
                    f"{name}: frames {np.flatnonzero(dim).tolist()} have no light: expected some in all"
                )
            signals.append(values / light[:, np.newaxis])
            lights.append(light)
        flats, pushed, pulled = signals
        reference = lights[0] @ flats / lights[0].sum()
        asymmetry = (pushed + pulled) / 2 - reference
        shares = 1 / (2 * pokes.n_averaged), 1 / (2 * pokes.n_averaged) + 1 / len(flats)
        if len(flats) > 2:
            noise = float(np.sqrt(flats.var(axis=0, ddof=1).mean()))
        else:
            noise = roughness(asymmetry, np.flatnonzero(mask)) / np.sqrt(shares[1])
        light = float(lights[0].mean())
        return cls(mask, dark, light, reference, (pushed - pulled) / 2, asymmetry, noise, shares)

    @property
    def faintest(self) -> float:
        """Light of a frame, over that of the flat mirror, below which it is lost."""
        return faintest(self.noise, len(self.reference))

    def check(self) -> None:
        """Refuse pokes that do not move the frames, contradict themselves, or equal each other."""
        variance = self.noise**2 * len(self.reference)
        size, skew = (np.sum(signal**2, axis=1) for signal in (self.difference, self.asymmetry))
        noise, noise_skew = (share * variance for share in self.shares)
        # Noise of three neighbours on a row averages out; a response does not.
        middle = _middles(np.flatnonzero(self.mask))
        smooth = sum(self.difference[:, middle + step] for step in (-1, 0, 1)) / 3
        response, expected = np.sum(smooth**2, axis=1), noise * len(middle) / (3 * len(self.reference))
        still = response < max(_UNMOVED * expected, _SILENT * np.median(response))
        what = "pokes that do, brighter frames, more of them, or none of these commands"
        _refuse(still, "do not move the frames beyond their noise", what)
        moved = size - noise
        contrary = skew - noise_skew > _CONTRARY**2 * moved + 0.1 * (noise + noise_skew)
        _refuse(contrary, "contradict each other", "opposite changes of the frames of the flat mirror")
        product = np.abs(self.difference @ self.difference.T)
        both = np.add.outer(moved, moved)
        apart = np.add.outer(size, size) - 2 * product - 2 * noise
        clear = np.minimum.outer(moved, moved) > _CLEAR * noise
        alike = np.triu(clear & (apart < _ALIKE * both), 1)
        if alike.any():
            first, second = np.argwhere(alike)[0]
            raise ValueError(
                f"pushed and pulled: pokes {first} and {second} move the frames in the same way: expected "
                "different actuators, each of them once"
            )


def _refuse(which: NDArray[np.bool_], what: str, expected: str) -> None:
    if which.any():
        raise ValueError(
            f"pushed and pulled of pokes {np.flatnonzero(which).tolist()} {what}: expected {expected}"
        )


def _middles(pixels: NDArray) -> NDArray[np.intp]:
    """Numbers of those pixels, given in order, whose neighbours on both sides of the row are among them."""
    return np.flatnonzero(pixels[2:] - pixels[:-2] == 2) + 1


def roughness(values: NDArray, pixels: NDArray) -> float:
    """Noise of maps, (n, n_pixels), rms: second differences along rows of the smoothest map show it."""
    middle = _middles(pixels)
    if not middle.size:
        return 0.0
    rough = values[:, middle - 1] - 2 * values[:, middle] + values[:, middle + 1]
    return float(1.4826 * np.median(np.abs(rough), axis=1).min() / np.sqrt(6))


def faintest(noise: float, n_pixels: int) -> float:
    """Light, over that of the flat mirror, below which a frame is lost, from the noise of its signal."""
    return max(_LOST * noise * np.sqrt(n_pixels), 1e-12)


def _pixels(calibration: Calibration) -> NDArray[np.bool_]:
    """Good pixels of the camera next to a point of the pupil, in either image."""
    places = calibration.places[:, :, calibration.amplitude > 0]
    around = pixels_around(places, calibration.n_images, calibration.shape)
    return (around & ~calibration.bad).reshape(image_shape(calibration))


def surroundings(calibration: Calibration, flat: NDArray, good: NDArray) -> tuple[NDArray[np.float32], float]:
    """Weights with which a frame sums up to its background, and that sum of the dark, counts, to subtract.

    The background is the constant of a line: the light of far pixels against that in the frame of the flat mirror.
    All weights are 0 if these pixels cannot show it.
    """
    pixels = np.unique(calibration._work.far_on_camera)
    pixels = pixels[good.ravel()[pixels]]
    pixels = pixels[:: 1 + len(pixels) // _MOST_AROUND]
    dark, around = dark_of(calibration), np.zeros(good.shape, np.float32)
    light = (flat - dark).ravel()[pixels]
    weights = 1 - light * light.sum() / max(light @ light, 1e-30)
    if weights.sum() > _FLAT * len(pixels):
        around.ravel()[pixels] = weights / weights.sum()
    return around, float(np.vdot(around.astype(float), dark))


def dark_of(calibration: Calibration) -> NDArray[np.float64]:
    """Counts without light, with the stray light, of the shape of an exposure."""
    stray = calibration.background if calibration.n_images == 2 else calibration.background.mean(keepdims=True)
    dark = calibration.dark.astype(float) + stray[:, np.newaxis, np.newaxis]
    return dark.reshape(image_shape(calibration))


def beyond_noise(level: float, weights: NDArray, far: NDArray) -> bool:
    """Whether a background exceeds 5 standard errors, by the scatter of its pixels."""
    return level > _LOST * float(np.linalg.norm(weights) * far.std())


def _frames_of(name: str, value: Any, calibration: Calibration) -> NDArray:
    """Camera images from an array or a file."""
    if isinstance(value, str | Path):
        stack = Stack([path_of(name, value)], [], calibration.n_images, calibration.shape)
        value = stack.read(0, stack.n).reshape(stack.n, *image_shape(calibration))
    array = _check.plain_array(name, value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} has dtype {array.dtype}: expected real numbers")
    _check.trailing_shape(name, array, image_shape(calibration), "the camera image of the calibration")
    if not array.size:
        raise ValueError(f"{name} has shape {array.shape}: expected at least one frame")
    return array


def image_shape(calibration: Calibration) -> tuple[int, ...]:
    """Shape of one exposure."""
    return calibration.shape if calibration.n_images == 1 else (2, *calibration.shape)
