"""Checked frames of a mirror in known states, their noise, and the known phases on the grid of the model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from zwfs import _check
from zwfs._images import nearest_good, radius

PAD = 2
"""Pixels of the maps around the grid of the known phases."""
_REACH = 3  # pixels over which a known phase is continued


@dataclass(frozen=True, eq=False)
class Recording:
    """Checked data: means of cubes, their bad pixels, and the noise of a mean."""

    counts: list[NDArray[np.float64]]  # clear frames first, then each pair
    good: list[NDArray[np.bool_]]
    n_frames: list[int]
    phases: NDArray[np.float64]  # (n_states, n + 2 pad, n + 2 pad), continued
    n_pixels: float
    noise: float
    gain: float

    @classmethod
    def of(
        cls,
        frames: ArrayLike,
        clear: ArrayLike,
        phases: ArrayLike,
        n_pixels: float,
        noise: float | None,
        gain: float,
    ) -> Recording:
        """Check data as `fit_bench` receives them."""
        masked, m = _mean_of("frames", frames, 4)
        clear, k = _mean_of("clear_frames", clear, 3)
        phases = _check.real_array("phases", phases)
        for name, array in (("frames", masked[0]), ("clear_frames", clear)):
            if len(array) != 2:
                raise ValueError(f"{name} has {len(array)} images: expected 2")
        if masked.shape[2:] != clear.shape[1:]:
            raise ValueError(
                f"clear_frames has shape {clear.shape}: expected (2, {masked.shape[2]}, {masked.shape[3]})"
            )
        if phases.ndim != 3 or len(phases) != len(masked) or phases.shape[1] != phases.shape[2]:
            raise ValueError(
                f"phases has shape {phases.shape}: expected ({len(masked)}, n, n), one for each state"
            )
        if len(phases) < 2:
            raise ValueError(
                "phases holds 1 state: expected two or more, which fix the place and the plane of the maps"
            )
        if unknown_in(phases).all():
            raise ValueError("phases is 0 in all states, or NaN, at every pixel: expected known phases")
        n_pixels = _check.number("n_pixels", n_pixels, 1)
        if any((length - phases.shape[1]) % 2 for length in clear.shape[1:]):
            raise ValueError(
                f"phases has shape {phases.shape} and frames {clear.shape[1:]}: expected even differences, so "
                "that the pixels stand at the same places"
            )
        gain = _check.number("gain", gain, 0, _check.LARGEST, open_low=True)
        images = [*clear, *masked.reshape(-1, *masked.shape[2:])]
        good = [np.isfinite(image) for image in images]
        if noise is None:
            noise = _dark_noise(images, n_pixels) * math.sqrt(m)
        counts = [np.where(ok, image, 0) for image, ok in zip(images, good, strict=True)]
        noise = _check.number("noise", noise, 0, _check.LARGEST, open_low=True)
        n_frames = [k, k] + [m] * (len(images) - 2)
        return cls(counts, good, n_frames, _continued(phases), n_pixels, noise, gain)

    @cached_property
    def light(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Light of each pixel of the maps, 1 on average where lit, and the counts of 1 in each clear frame."""
        n = self.phases.shape[-1]
        inner = np.stack([centred(image, n) for image in self.counts[:2]])
        mean = inner.mean(axis=0)
        lit = mean >= 0.5 * np.percentile(mean, 80)
        flux = inner[:, lit].mean(axis=1)
        if np.any(flux <= 0):
            raise ValueError(f"clear_frames hold {flux} counts on average in the pupil: expected light")
        return np.maximum((inner / flux[:, None, None]).mean(axis=0), 0), flux

    def weights(self, images: NDArray) -> NDArray[np.float64]:
        """One over the noise of each pixel, for the images of a model, (n_images, ny, nx)."""
        frames = np.array(self.n_frames)[:, None, None]
        return self.good * np.sqrt(frames / (np.maximum(images, 0) / self.gain + self.noise**2))


def _mean_of(name: str, images: ArrayLike, n_axes: int) -> tuple[NDArray[np.float64], int]:
    """Mean over the frames of cubes, and their number; NaN where all are bad."""
    array = _check.real_array(name, images)
    if array.ndim not in (n_axes, n_axes + 1) or not array.size:
        raise ValueError(f"{name} has shape {array.shape}: expected {n_axes} axes, or {n_axes + 1} with cubes")
    if array.ndim == n_axes:
        return array, 1
    axis = array.ndim - 4
    return array.mean(axis=axis), array.shape[axis]


def _dark_noise(images: list[NDArray], n_pixels: float) -> float:
    """Noise of the darkest pixels of the clear frames, from differences of neighbours."""
    levels = []
    for image in images[:2]:
        far = radius(image.shape, tuple((n - 1) / 2 for n in image.shape)) > 0.56 * n_pixels
        step = (np.diff(image, axis=1) / math.sqrt(2))[far[:, 1:] & far[:, :-1]]
        step = step[np.isfinite(step)]
        if step.size < 50:
            raise ValueError(
                "noise = None: expected the noise of a pixel, because the frames hold too few dark pixels"
            )
        levels.append(1.4826 * np.median(np.abs(step - np.median(step))))
    return float(np.mean(levels))


def centred(image: NDArray, n: int) -> NDArray:
    """The n middle rows and columns, with zeros where there are fewer."""
    margin = max(0, *(n - length for length in image.shape)) // 2 + 1
    whole = np.pad(image, margin)
    first = [(length - n) // 2 for length in whole.shape]
    return whole[first[0] : first[0] + n, first[1] : first[1] + n]


def with_neighbours(unknown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Unknown pixels and all that touch one, if only by a corner; beyond the grid all are unknown."""
    wide = np.pad(unknown, 1, constant_values=True)
    return np.asarray(ndimage.binary_dilation(wide, np.ones((3, 3))))[1:-1, 1:-1]


def unknown_in(phases: NDArray) -> NDArray[np.bool_]:
    """Pixels at which the phases of states are not known: one is NaN, or all are 0, (n_states, n, n) to (n, n)."""
    return ~np.isfinite(phases).all(axis=0) | (phases == 0).all(axis=0)


def aligned(waves: NDArray) -> NDArray[np.complex128]:
    """Waves of states, (n_states, n, n), less the piston of each with respect to their mean."""
    for _ in range(3):
        mean = waves.mean(axis=0)
        waves = waves * np.exp(-1j * np.angle(np.sum(waves * mean.conj(), axis=(1, 2), keepdims=True)))
    return waves


def _continued(phases: NDArray) -> NDArray[np.float64]:
    """Known phases on a wider grid, smoothly continued by a few pixels beyond where they are known."""
    bad = unknown_in(phases)
    wide = np.pad(np.nan_to_num(phases), ((0, 0), (PAD, PAD), (PAD, PAD)))
    regions, _ = ndimage.label(np.pad(bad, PAD, constant_values=True))
    unknown = regions == regions[0, 0]
    if np.any(bad & unknown[PAD:-PAD, PAD:-PAD]):  # a pixel of the outline mixes the phase with zeros
        unknown = with_neighbours(unknown)
    if unknown.all():
        return wide
    n = wide.shape[-1]
    # The least third derivative: a parabola goes on as one.
    same, *steps = sparse.eye_array(n), *(sparse.csr_array(np.diff(np.eye(n), k, axis=0)) for k in (1, 2, 3))
    parts = [sparse.kron(steps[2], same), sparse.kron(same, steps[2])]
    parts += [math.sqrt(3) * sparse.kron(*pair) for pair in (steps[:2], steps[1::-1])]
    bending = sum(part.T @ part for part in parts).tocsc()
    flat, rows = wide.reshape(len(wide), -1).copy(), unknown.ravel()
    right = -(bending[rows][:, ~rows] @ flat[:, ~rows].T)
    flat[:, rows] = splu(bending[rows][:, rows].tocsc()).solve(right).T
    far = ndimage.distance_transform_edt(unknown) > _REACH
    return nearest_good(flat.reshape(wide.shape), ~far)
