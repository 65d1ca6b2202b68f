"""Pupils, screens and noise that the nested parameters of a notebook choose, such as ``pupil={"kind": "vlt"}``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit.parameters import within
from zwfs.detector import Detector
from zwfs.modes import fourier_basis, mode_frequencies, noll_to_nm, power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor
from zwfs.turbulence import structure_function, turbulent_screens

_CROSS = [[0.785, 0.005], [2.356, 0.005], [3.927, 0.005], [5.498, 0.005]]
_MAX_BYTES = 2**31  # of a file of screens: 1000 of them on 512 pixels
_LARGEST = 1e38  # value of a screen: its square is a number
_STAR = [[0.524 + 1.0472 * n, 0.013] for n in range(6)]
PUPILS: dict[str, dict[str, Any]] = {
    "circular": {},
    "vlt": {"obstruction": 0.14, "vanes": _CROSS},
    "hexagonal": {"n_rings": 3},
    "keck": {"n_rings": 3, "missing": [1], "obstruction": 0.24},
    "elt": {"n_rings": 17, "missing": list(range(1, 62)), "stop": 0.93, "vanes": _STAR},
    "seal": {"n_rings": 3, "gap": 0.015, "missing": [21], "stop": 0.78},
    "file": {},
}
"""Kinds of pupils, with the arguments of `make_pupil` that differ from its defaults.

Those of telescopes are approximate: a vane narrower than a pixel may fall between the samples.
"""


def make_pupil(n_pixels: int, kind: str = "circular", **changes: Any) -> Pupil:
    """Pupil of a kind, see `PUPILS`.

    Parameters
    ----------
    n_pixels : int, pixels
        Samples across D.
    kind : str
        Kind of the pupil; the other parameters change its values.
    obstruction : float, D
        Diameter of the central obscuration.
    vanes : list of [angle, width]
        Spider vanes from the centre to the edge: angle (rad) and width (D).
    n_rings : int
        Rings of segments around the central one.
    gap : float, D
        Width of the gaps between segments.
    missing : list of int
        Numbers of the missing segments.
    stop : float
        Diameter of the stop over that of the circle around all segments.
    file : str
        FITS or NPY file of the field amplitude; its longer side has `n_pixels`.
    """
    values = PUPILS[kind] | changes
    cut = {"obstruction": values.pop("obstruction", 0.0), "vanes": values.pop("vanes", ())}
    window = Pupil.circular(n_pixels, cut["obstruction"], [tuple(vane) for vane in cut["vanes"]])
    if kind == "file":
        return _pupil_of_file(n_pixels, **values)
    if "n_rings" not in values:
        return window
    segments = Pupil.hexagonal(n_pixels, **values).segments
    return Pupil.from_segments(np.where(window.inside, segments, 0))


def _pupil_of_file(n_pixels: int, file: str = "") -> Pupil:
    from zwfs.frames.files import read  # late: few notebooks need it, and it imports all of zwfs.frames

    recording = read(file, max_images=1)
    (image,) = recording.images
    if max(image.shape) != n_pixels:
        raise ValueError(f"{recording.name} is {max(image.shape)} pixels wide: expected n_pixels = {n_pixels}")
    with within(recording.name, ()):
        return Pupil.from_amplitude(image)


@dataclass(frozen=True)
class Screens:
    """Random screens of a kind, made by `make_screens`.

    Each screen is scaled to the rms of the input. With `d_over_r0` the screens keep the scatter of turbulence: an
    input is then the root mean square over all screens, and the largest input is that of this D/r0.
    """

    pupil: Pupil
    modes: NDArray
    frequencies: NDArray
    kind: str
    exponent: float
    outer_scale: float = inf
    recorded: NDArray | None = None
    d_over_r0: float = 0.0  # of the largest input; 0: each screen is scaled

    def __call__(self, rms: float, n_screens: int, seed: Any) -> NDArray[np.floating]:
        """Return screens of an rms (radian), shape (n_screens, ny, nx), 0 outside the pupil."""
        if self.kind == "power_law":
            return power_law_screens(self.modes, rms, n_screens, self.exponent, seed, frequencies=self.frequencies)
        if self.d_over_r0:
            return self._shapes(n_screens, seed) * (rms / self.unit)
        values = self.pupil.gather(self._shapes(n_screens, seed))
        values = values - values.mean(axis=-1, keepdims=True)
        return self.pupil.scatter(values * (rms / values.std(axis=-1, keepdims=True)), fill=0.0)

    @cached_property
    def unit(self) -> float:
        """Root mean square (radian) of turbulence with r0 = D on the pupil, 1.016 on a circle."""
        return turbulent_rms(self.pupil, self.outer_scale)

    def rms_of(self, d_over_r0: ArrayLike) -> NDArray[np.float64]:
        """Root mean square (radian) of turbulence of some D/r0."""
        return self.unit * np.asarray(d_over_r0, float) ** (5 / 6)

    def d_over_r0_of(self, rms: ArrayLike) -> NDArray[np.float64]:
        """D/r0 of turbulence of some root mean square (radian), which is not negative."""
        return (np.maximum(rms, 0) / self.unit) ** (6 / 5)

    def largest(self, rms: float) -> float:
        """Return the largest input (radian rms): that of `d_over_r0`, or the given one without it."""
        return float(f"{self.rms_of(self.d_over_r0):.4g}") if self.d_over_r0 else rms

    def inputs(self, rms: Sequence[float]) -> list[float]:
        """Return inputs of at most the largest one (radian rms), and with `d_over_r0` the largest itself."""
        largest = self.largest(max(rms))
        return sorted({*(value for value in rms if value < largest), largest})

    def mark(self, figure: Figure) -> Figure:
        """Add an axis of D/r0 to the panels of a figure against the input, if the screens have one."""
        panels = [axes for axes in figure.axes if axes.get_xlabel().startswith("input")] if self.d_over_r0 else []
        for axes in panels:
            axes.secondary_xaxis("top", functions=(self.d_over_r0_of, self.rms_of)).set_xlabel("$D/r_0$")
        return figure

    def _shapes(self, n_screens: int, seed: Any) -> NDArray:
        """Screens before they are scaled."""
        if self.recorded is not None:
            _require_screens(self.recorded, n_screens)
            return self.recorded[np.random.default_rng(seed).permutation(len(self.recorded))[:n_screens]]
        if self.kind == "segments":
            smooth = power_law_screens(
                self.modes, 1.0, n_screens, self.exponent, seed, frequencies=self.frequencies
            )
            numbers = self.pupil.gather(self.pupil.segments)
            members = (numbers == np.unique(numbers)[:, np.newaxis]).astype(float)
            means = self.pupil.gather(smooth) @ (members / members.sum(axis=1, keepdims=True)).T
            return self.pupil.scatter(means @ members)
        return turbulent_screens(self.pupil, 1.0, n_screens, self.outer_scale, seed)


def turbulent_rms(pupil: Pupil, outer_scale: float = inf) -> float:
    """Root mean square (radian) of turbulence with r0 = D on a pupil, piston removed: half the mean of D(r).

    The mean is over all pairs of points, whose distances the autocorrelation of the pupil counts.
    """
    shape = [2 * n - 1 for n in pupil.shape]
    pairs = np.fft.irfft2(np.abs(np.fft.rfft2(pupil.inside, shape)) ** 2, shape)
    rows, columns = (np.fft.fftfreq(n, 1 / n) / pupil.n_pixels for n in shape)
    differences = structure_function(np.hypot(rows[:, np.newaxis], columns), 1.0, outer_scale)
    return float(np.sqrt(np.sum(pairs * differences) / (2 * pupil.n_points**2)))


def make_screens(
    pupil: Pupil,
    n_modes: int,
    exponent: float,
    kind: str = "power_law",
    basis: str = "zernike",
    outer_scale: float = 10.0,
    file: str = "",
    d_over_r0: float = 0.0,
) -> Screens:
    """Source of random screens of a kind.

    Parameters
    ----------
    pupil : Pupil
    n_modes : int
        Number of modes of the basis.
    exponent : float
        Exponent of the power spectral density of the kinds "power_law" and "segments".
    kind : str
        Kind of the screens; without `d_over_r0` each screen is scaled to the rms of the input.
    basis : str
        Modes of power-law screens and of the modal reconstructors, see `BASES`.
    outer_scale : float, D
        Outer scale of von Karman's spectrum.
    file : str
        FITS or NPY file of screens (n, ny, nx) in radian; the seed chooses among them.
    d_over_r0 : float
        Strength D/r0 of the turbulence at the largest input, which replaces that in rad rms; 0 keeps the latter.
        An input is then the root mean square over all screens, and single screens scatter around it.
    """
    _require_segments(pupil, kind)
    scale = outer_scale if kind == "von_karman" else inf
    modes, frequencies = _modes(pupil, n_modes, basis)
    recorded = _screens_of_file(pupil, file) if kind == "file" else None
    return Screens(pupil, modes, frequencies, kind, exponent, scale, recorded, d_over_r0)


def screens_at(
    modes: NDArray | Screens, rms: float, n_screens: int, seed: int, task: int, exponent: float = -2.0
) -> NDArray[np.floating]:
    """Screens of one task of an experiment: they depend on the seed and the task's number, not on the order."""
    sequence = np.random.SeedSequence(seed, spawn_key=(task,))
    if isinstance(modes, Screens):
        return modes(rms, n_screens, sequence)
    return power_law_screens(modes, rms, n_screens, exponent, sequence)


def check_setup(
    n_pixels: int,
    n_modes: int,
    pupil: Mapping[str, Any],
    screens: Mapping[str, Any],
    noise: Mapping[str, float],
    n_screens: int = 1,
    **_: Any,
) -> None:
    """Refuse parameters of a notebook that contradict each other, before any work."""
    Noise(**noise)
    with within("pupil", [*pupil, "missing"]):
        aperture = make_pupil(n_pixels, **pupil)
        if screens.get("basis", "zernike") in ("zernike", "hexagonal"):
            zernike_basis(aperture, 1)  # the pupil of a file may be larger than their circle
    _require_segments(aperture, screens.get("kind", SCREENS[0]))
    most = aperture.n_points - 1
    if n_modes > most:
        raise ValueError(
            f"n_modes = {n_modes}: expected at most {most} with the {aperture.n_points} points of pupil"
        )
    if screens.get("kind") == "file":
        with within("screens", ()):
            recorded = _screens_of_file(aperture, screens.get("file", ""))
        _require_screens(recorded, n_screens)


def _require_segments(pupil: Pupil, kind: str) -> None:
    if kind == "segments" and len(np.unique(pupil.segments)) < 3:
        raise ValueError('screens.kind = "segments": expected a pupil of two or more segments')


def _modes(pupil: Pupil, n_modes: int, basis: str) -> tuple[NDArray, NDArray]:
    """Return the modes of a basis and their spatial frequencies."""
    if basis in ("zernike", "hexagonal"):
        modes = zernike_basis(pupil, n_modes, orthonormal=basis == "hexagonal")
        return modes, np.array([noll_to_nm(j)[0] for j in range(2, n_modes + 2)]) / 2
    modes = fourier_basis(pupil, n_modes)
    return modes, mode_frequencies(pupil, modes)


def _screens_of_file(pupil: Pupil, file: str) -> NDArray:
    """Return the screens of a file, each of which can be scaled to an rms."""
    from zwfs.frames.files import read

    recording = read(file, max_bytes=_MAX_BYTES, max_images=_MAX_BYTES)
    if recording.images.shape[1:] != pupil.shape:
        raise ValueError(
            f"{recording.name} has shape {recording.images.shape}: expected (n_screens, ny, nx) with {pupil.shape}"
        )
    values = pupil.gather(recording.images)
    with np.errstate(invalid="ignore", over="ignore"):
        size, spread = np.abs(values).max(axis=-1), np.ptp(values, axis=-1)
    wrong = np.flatnonzero(~((size <= _LARGEST) & (spread >= 1 / _LARGEST)))  # NaN is wrong, too
    if wrong.size:
        raise ValueError(
            f"{recording.name}[{wrong[0]}] is flat, not finite or beyond {_LARGEST:g}: expected a wavefront"
        )
    return recording.images


def _require_screens(recorded: NDArray, n_screens: int) -> None:
    if n_screens > len(recorded):
        raise ValueError(f"n_screens = {n_screens}: expected at most the {len(recorded)} of the file")


SCREENS = ("power_law", "kolmogorov", "von_karman", "segments", "file")
"""Kinds of screens."""
BASES = ("zernike", "fourier", "hexagonal")
"""Bases of modes, each of unit rms and without piston.

- "zernike": Zernike modes in Noll's order, on any pupil those of the circle around it;
- "fourier": cosines and sines of whole cycles per D;
- "hexagonal": the hexagonal polynomials of Mahajan and Dai (2006, Opt. Lett. 31, 2462), which are Zernike modes
  made orthonormal on the pupil in Noll's order. The pupil may have any shape.
"""


@dataclass(frozen=True)
class Noise:
    """Noise of a camera, for every sensor.

    Parameters
    ----------
    photons : float, photons
        Photons per point of the pupil and image of two; any other number of images shares the light of these two.
        0 for frames without noise.
    read_noise : float, electrons
        Read noise of a pixel, rms.
    """

    photons: float = 0.0
    read_noise: float = 0.0

    def __post_init__(self) -> None:
        if self.read_noise and not self.photons:
            raise ValueError(f"noise.read_noise = {self.read_noise:g} with photons = 0: expected photons above 0")

    def __call__(self, sensor: ZernikeSensor, phase: NDArray, seed: Any) -> NDArray[np.floating]:
        """Return the normalised frames of phases, with the light of two images divided between the masks."""
        frames = sensor.measure(phase)
        if not self.photons:
            return frames
        camera = Detector(2 * self.photons / sensor.n_masks, read_noise=self.read_noise)
        return camera.normalise(camera.expose(frames, seed))


NOISELESS = Noise()
"""Frames as the model of the sensor returns them."""
