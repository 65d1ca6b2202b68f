"""Camera frames to phase: normalise, model the sensor from its own pupil, reconstruct, and judge.

The images come from `zwfs.frames.files`, their places from `zwfs.frames.registration`. What an
experimenter does not know for sure is a parameter of `Optics`. `fit` seeks values that explain the frames better,
which need not make the phase better: with two images for one unknown at each point, the iteration explains much of
any pair of frames. `predict_other` is the sterner test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from zwfs import _check
from zwfs.frames.registration import Image, Recording, correlations, nearest_good, radius, record, resample
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import Arcsine, PhaseShifted
from zwfs.sensor import ZernikeSensor

_MOST_BAD = 0.2  # of the pupil's points: with more of them masked, the reference wave is guesswork


@dataclass(frozen=True)
class Optics:
    """What a model of the sensor needs to know beside the pupil; all but the first two may be fitted.

    Parameters
    ----------
    diameter : float, lambda/D
        Diameter of the dimple.
    phase_shifts : (float, float), radian
        Of the two images. Exchanging them changes the sign of the phase found, and nothing else: the frames
        cannot tell which image is which.
    background : float
        Stray light in the frames that is left after the dark, in units of the mean intensity of the pupil.
    pupil_background : float
        The same for the mask-out images. Below 0, it lowers the contrast of the amplitude.
    scale : float
        Factor on the frames: flux of the mask-out images over that of the frames.
    leakage : float
        Fraction of the light of each image that belongs to the other one, as in `zwfs.bench.model.Bench`.
    unmasked : float
        Fraction of the light that the mask leaves as it is: its retardance is not half a wave.

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind or out of range, or the phase shifts are the same or one of them is 0.
    """

    diameter: float = 1.06
    phase_shifts: tuple[float, float] = (np.pi / 2, -np.pi / 2)
    background: float = 0.0
    pupil_background: float = 0.0
    scale: float = 1.0
    leakage: float = 0.0
    unmasked: float = 0.0

    def __post_init__(self) -> None:
        _check.number("diameter", self.diameter, 0, open_low=True)
        _check.pair("phase_shifts", self.phase_shifts, _check.number)
        first, second = np.exp(1j * np.array(self.phase_shifts))
        if min(abs(first - second), abs(first - 1), abs(second - 1)) < 1e-9:
            expected = "two that differ by other than 0 mod 2 pi, none of them 0"
            raise ValueError(f"phase_shifts = {_check.shown(self.phase_shifts)}: expected {expected}")
        _check.number("background", self.background, -1, 1, open_high=True)
        _check.number("pupil_background", self.pupil_background, -1, 1, open_high=True)
        _check.number("scale", self.scale, 0, open_low=True)
        _check.number("leakage", self.leakage, 0, 0.5, open_high=True)
        _check.number("unmasked", self.unmasked, 0, 1, open_high=True)

    @property
    def opposite(self) -> bool:
        """Whether the two phase shifts are +theta and -theta, modulo 2 pi."""
        return abs(np.exp(1j * sum(self.phase_shifts)) - 1) < 1e-9


# Lowest and highest value, and a typical change, of each parameter that `fit` knows.
_RANGES = {
    "background": (-0.5, 0.9, 0.05),
    "pupil_background": (-0.9, 0.9, 0.1),
    "scale": (0.2, 5.0, 0.1),
    "diameter": (0.3, 3.0, 0.05),
    "leakage": (0.0, 0.45, 0.05),
    "unmasked": (0.0, 0.9, 0.1),
}


@dataclass(frozen=True, eq=False)
class Measurement:
    """Registered and normalised frames, and the pupil that goes with them.

    Attributes
    ----------
    intensity : ndarray, shape (2, ny', nx')
        Frames; 1 is the mean intensity of the pupil with the mask out. May be negative where there is noise.
    pupil : Pupil
        Of the mean of the two mask-out images, each scaled to the same flux.
    bad : ndarray of bool, shape (2, ny', nx')
        Where a frame, or in the pupil a mask-out image, has a bad pixel.
    margin : int, pixels
        Of the frames around the grid of the pupil.
    diameter : float, pixels
        Of the pupil.
    counts : ndarray, shape (2,)
        Counts of the mask-out images that make an intensity of 1.
    background : ndarray, shape (4,)
        Counts subtracted, of frames first, then of mask-out images.
    flux_ratio : (float, float)
        Light of the first image in the pupil over that of the second: with the mask in, before the balance, and
        with the mask out.
    """

    intensity: NDArray[np.float64]
    pupil: Pupil
    bad: NDArray[np.bool_]
    margin: int
    diameter: float
    counts: NDArray[np.float64]
    background: NDArray[np.float64]
    flux_ratio: tuple[float, float]

    @cached_property
    def good(self) -> NDArray[np.bool_]:
        """Points of the pupil at which both frames and both mask-out images are good, (ny, nx)."""
        return self.pupil.inside & ~self.bad[(..., *self.window)].any(axis=0)

    @property
    def n_masked(self) -> int:
        """Points of the pupil that are masked."""
        return self.pupil.n_points - int(np.count_nonzero(self.good))

    @property
    def window(self) -> tuple[slice, slice]:
        """Where the grid of the pupil lies in a frame."""
        ny, nx = self.pupil.shape
        return slice(self.margin, self.margin + ny), slice(self.margin, self.margin + nx)

    @cached_property
    def beside(self) -> NDArray[np.bool_]:
        """Good points of the frames beside the pupil, clear of its edge, (2, ny', nx')."""
        axes = (np.arange(n) - self.margin - c for n, c in zip(self.bad.shape[1:], self.pupil.center, strict=True))
        radius = np.hypot(*np.meshgrid(*axes, indexing="ij"))
        return ~self.bad & (radius > 0.53 * self.diameter)


@dataclass(frozen=True, eq=False)
class Found:
    """A phase, and how well the frames that it makes agree with the measured ones.

    Attributes
    ----------
    phase : ndarray, shape (ny, nx), radian
        Wrapped to (-pi, pi], NaN outside the pupil and where a pixel is masked.
    measured, modelled : ndarray, shape (2, ny', nx')
        Frames: the measured ones as normalised for these `optics`.
    measurement : Measurement
    optics : Optics
    converged : bool
    n_unsolved : int
        Points whose equations had no unique solution.
    """

    phase: NDArray[np.float64]
    measured: NDArray[np.float64]
    modelled: NDArray[np.float64]
    measurement: Measurement
    optics: Optics
    converged: bool
    n_unsolved: int

    @cached_property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation of measured and modelled frames over the good points of the pupil, (2,)."""
        return correlations(self._inside(self.measured), self._inside(self.modelled))

    @cached_property
    def residual(self) -> NDArray[np.float64]:
        """Rms difference of the frames over the good points of the pupil, (2,), 1 = mean intensity mask out."""
        return np.sqrt(np.mean((self._inside(self.measured) - self._inside(self.modelled)) ** 2, axis=1))

    @cached_property
    def contrast(self) -> NDArray[np.float64]:
        """Standard deviation of the measured frames over the good points of the pupil, (2,)."""
        return self._inside(self.measured).std(axis=1)

    @cached_property
    def offset_beside(self) -> float:
        """Mean of measured less modelled light beside the pupil, where no phase was fitted."""
        beside = self.measurement.beside
        return float(np.mean((self.measured - self.modelled)[beside])) if beside.any() else float("nan")

    @cached_property
    def mismatch(self) -> NDArray[np.float64]:
        """Measured less modelled frames over the contrast, shape (2, ny', nx').

        Its squares sum up to that of `misfit`. Pupil and surroundings weigh the same, however many pixels they
        have; what belongs to neither is 0.
        """
        beside, inside = self.measurement.beside, np.zeros(self.measured.shape, bool)
        inside[(..., *self.measurement.window)] = self.measurement.good
        weight = inside / np.count_nonzero(inside) + beside / max(1, int(np.count_nonzero(beside)))
        return (self.measured - self.modelled) * np.sqrt(weight / np.mean(self.contrast**2))

    @property
    def misfit(self) -> float:
        """What `fit` makes small: rms difference in the pupil and beside it, over the contrast of the frames."""
        return float(np.sqrt(np.sum(self.mismatch**2)))

    def _inside(self, frames: NDArray) -> NDArray:
        return frames[(..., *self.measurement.window)][:, self.measurement.good]


def measure(recording: Recording, optics: Optics, margin: int | None = None) -> Measurement:
    """Bring a recording on one grid and normalise it.

    The amplitude is common to both images: the mean of the mask-out images, each scaled to the same flux. The
    light of the two frames is balanced where their phase shifts are opposite: what two such masks send into the
    pupil differs by 4 sin(theta) Im <psi, b>, and that is 0 for any field psi, because b is its projection on the
    dimple.

    Parameters
    ----------
    recording : Recording
    optics : Optics
        Its `pupil_background` and whether the phase shifts are opposite count here.
    margin : int, pixels, optional
        Of the frames around the grid of the pupil; all that both frames hold if left out, which is the most.

    Returns
    -------
    Measurement

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind or out of range, too much of the pupil is masked, or the mask-out images
        are dark.
    """
    _check.instance("recording", recording, Recording)
    _check.instance("optics", optics, Optics)
    margin = recording.margin if margin is None else _check.integer("margin", margin, 0, recording.margin)
    return _measure(recording, optics, margin)


def _measure(recording: Recording, optics: Optics, margin: int) -> Measurement:
    """Measure as `measure` does; the frames may end a little before the margin does."""
    n = recording.n_pixels
    frames, frames_bad = resample(recording, recording.frames, recording.origins[:2], margin)
    images, images_bad = resample(recording, recording.pupil_images, recording.origins[2:], 0)
    levels = _backgrounds(recording) if recording.background else np.zeros(4)
    frames, images = frames - levels[:2, None, None], images - levels[2:, None, None]
    center = tuple(np.array([recording.pupils[0].row, recording.pupils[0].column]) - recording.corner)
    stop = radius((n, n), center) <= recording.diameter / 2
    light = images[:, stop].mean(axis=1)
    if np.any(light <= 0):
        names = " and ".join(dict.fromkeys(image.name for image in recording.pupil_images))
        raise ValueError(f"{names}: the pupils hold {light} counts on average: expected light")
    images = images - optics.pupil_background * light[:, None, None]
    pupil, counts = measured_pupil(images, stop, recording.diameter, center)
    intensity = frames / (counts[:, None, None] * recording.exposure)
    bad = frames_bad.copy()
    inner = slice(margin, margin + n)
    bad[..., inner, inner] |= images_bad.any(axis=0) & pupil.inside
    result = Measurement(
        intensity, pupil, bad, margin, recording.diameter, counts, levels, (1.0, light[0] / light[1])
    )
    if result.n_masked > _MOST_BAD * pupil.n_points:
        raise ValueError(
            f"{result.n_masked} of the {pupil.n_points} points of the pupil are bad or saturated: "
            f"expected at most {_MOST_BAD:.0%}"
        )
    flux = intensity[..., inner, inner][:, result.good].mean(axis=1)
    if np.any(flux <= 0):
        raise ValueError(f"the frames hold {flux} of the light of the mask-out images: expected more than 0")
    if recording.balance and optics.opposite:
        intensity = intensity * (flux.mean() / flux)[:, None, None]
    return replace(
        result, intensity=intensity, flux_ratio=((flux * counts)[0] / (flux * counts)[1], light[0] / light[1])
    )


def measured_pupil(
    images: NDArray, inside: NDArray, n_pixels: float, center: tuple[float, float] | None = None
) -> tuple[Pupil, NDArray[np.float64]]:
    """Pupil of two mask-out images, and their counts that make an intensity of 1.

    Parameters
    ----------
    images : ndarray, shape (2, ny, nx)
        Counts, less the background.
    inside : ndarray of bool, shape (ny, nx)
        Where the flux of the two is compared.
    n_pixels : float, pixels
        Diameter. What is outside that circle is stopped, and what has less than a tenth of the largest amplitude
        within it counts as dark.
    center : (float, float), pixels, optional
        The middle of the images if left out.

    Returns
    -------
    Pupil
    ndarray, shape (2,)

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind or shape, or an image is dark.
    """
    images = _check.real_map("images", images, 3)
    if len(images) != 2:
        raise ValueError(f"images has shape {images.shape}: expected (2, ny, nx)")
    inside = _check.flag_map("inside", inside, images.shape[1:], some=True)
    n_pixels = _check.number("n_pixels", n_pixels, 0, open_low=True)
    if np.any((scale := images[:, inside].mean(axis=1)) <= 0):
        raise ValueError("images hold no light inside: expected more than 0 counts on average")
    center = None if center is None else _check.pair("center", center, _check.number)
    amplitude = np.sqrt(np.maximum((images / scale[:, None, None]).mean(axis=0), 0))
    middle = center or tuple((n - 1) / 2 for n in amplitude.shape)
    stop = radius(amplitude.shape, middle) <= n_pixels / 2
    pupil = Pupil.from_amplitude(np.where(stop, amplitude, 0), n_pixels, center, threshold=0.1)
    return pupil, scale * np.mean(amplitude[pupil.inside] ** 2)


def reconstruct(measurement: Measurement, optics: Optics, n_iterations: int = 25) -> Found:
    """Phase of a measurement by the phase-shifted iteration, and the frames that it makes in the model.

    Masked pixels take no part: their intensity is that of the model, with the phase of the nearest good point, so
    that the reference wave has no hole. They are NaN in the result.

    Parameters
    ----------
    measurement : Measurement
    optics : Optics
    n_iterations : int
        Largest number of iterations.

    Returns
    -------
    Found

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind or out of range.
    """
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    sensor = model(measurement, optics)
    iterate = PhaseShifted(sensor, n_iterations=n_iterations, tolerance=1e-4)
    measured = measurement.intensity * optics.scale - optics.background
    frames = np.maximum(_unmix(measured, measurement, optics), 0)
    masked = measurement.pupil.inside & ~measurement.good
    for _ in range(2 if masked.any() else 1):
        estimate = iterate(frames)
        phase = nearest_good(estimate.phase, measurement.good)
        clean = sensor.measure(phase)
        frames[(..., *sensor.window)] = np.where(
            masked, clean[(..., *sensor.window)], frames[(..., *sensor.window)]
        )
    phase = np.where(measurement.good, estimate.phase, np.nan)
    return Found(
        phase, measured, _mix(clean, measurement, optics), measurement, optics,
        bool(estimate.converged), int(estimate.n_unsolved),
    )  # fmt: skip


def model(measurement: Measurement, optics: Optics) -> ZernikeSensor:
    """Sensor with the measured pupil, on the detector of the frames."""
    _check.instance("measurement", measurement, Measurement)
    _check.instance("optics", optics, Optics)
    masks = tuple(Dimple(optics.diameter, shift) for shift in optics.phase_shifts)
    extent = 1 + 2 * measurement.margin / measurement.diameter
    return ZernikeSensor(measurement.pupil, *masks, extent=extent, tolerance=1e-6)


def predict_other(measurement: Measurement, optics: Optics, n_iterations: int = 25) -> NDArray[np.float64]:
    """Correlation of each frame with the one that the other frame alone predicts, (2,).

    The phase-shifted iteration sees both frames, and could explain part of their noise. Here the arcsine
    reconstruction sees one frame, and its phase is asked for the other, which it has never seen.

    Parameters, as for `reconstruct`.
    """
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    both = model(measurement, optics)
    frames = np.maximum(_unmix(measurement.intensity * optics.scale - optics.background, measurement, optics), 0)
    good, window = measurement.good, measurement.window
    predicted = np.empty((2, np.count_nonzero(good)))
    for seen in (0, 1):
        sensor = ZernikeSensor(measurement.pupil, both.masks[seen], extent=both.extent, tolerance=1e-6)
        estimate = Arcsine(sensor, n_iterations=n_iterations, tolerance=1e-4)(frames[seen : seen + 1])
        predicted[1 - seen] = both.measure(estimate.phase)[1 - seen][window][good]
    return correlations(frames[(..., *window)][:, good], predicted)


def fit(
    recording: Recording,
    optics: Optics,
    names: Sequence[str],
    n_iterations: int = 25,
    n_steps: int = 8,
) -> tuple[Recording, Optics]:
    """Seek parameters of the model, and the registration, for which the modelled frames agree best.

    A handful of numbers against some ten thousand pixels: what is made small is `Found.misfit`, which counts the
    light beside the pupil as much as that in it, because there no phase can hide an error of the model.

    Parameters
    ----------
    recording : Recording
    optics : Optics
        Where to start.
    names : sequence of str
        Parameters of `Optics` other than the phase shifts; "registration" stands for the shifts of all images
        but the first mask-out image, six numbers.
    n_iterations : int
        As for `reconstruct`.
    n_steps : int
        Of the least-squares search, at most.

    Returns
    -------
    Recording, Optics

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind, a name is unknown or there twice, or `optics` begins out of the range of a
        fit.
    """
    _check.instance("recording", recording, Recording)
    _check_fit("names", names, optics)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    n_steps = _check.integer("n_steps", n_steps, 1)
    if not names:
        return recording, optics
    scalars = [name for name in names if name in _RANGES]
    moved = [0, 1, 3] if "registration" in names else []
    low, high, scale = np.array([_RANGES[name] for name in scalars] + [(-3, 3, 0.3)] * (2 * len(moved))).T

    def trial(values: NDArray) -> tuple[Recording, Optics]:
        changes: dict[str, Any] = dict(zip(scalars, map(float, values), strict=False))
        found = replace(optics, **changes)
        origins = recording.origins.copy()
        origins[moved] += values[len(scalars) :].reshape(-1, 2)
        return replace(recording, origins=origins), found

    # The window must stay the same, and with it the number of residuals.
    fixed = recording.margin

    def mismatch(values: NDArray) -> NDArray:
        images, found = trial(values)
        return reconstruct(_measure(images, found, fixed), found, n_iterations).mismatch.ravel()

    start = np.array([getattr(optics, name) for name in scalars] + [0.0] * (2 * len(moved)))
    best = optimize.least_squares(
        mismatch, start, bounds=(low, high), x_scale=scale, diff_step=1e-4, max_nfev=n_steps
    )
    return trial(best.x)


def _check_fit(argument: str, names: Any, optics: Any) -> None:
    """Require names of different parameters that `fit` knows, and optics from which it can start."""
    _check.instance("optics", optics, Optics)
    known = (*_RANGES, "registration")
    listed = isinstance(names, Sequence) and not isinstance(names, str | bytes)
    if not listed or not all(isinstance(name, str) and name in known for name in names):
        raise ValueError(f"{argument} = {_check.shown(names)}: expected a list with some of {list(known)}")
    if len(set(names)) < len(names):
        raise ValueError(f"{argument} = {_check.shown(names)}: expected each name once")
    for name in set(names) & set(_RANGES):
        low, high, _ = _RANGES[name]
        if not low <= getattr(optics, name) <= high:
            raise ValueError(
                f"{argument} holds {name!r}, and {name} = {getattr(optics, name)}: "
                f"expected a start in [{low:g}, {high:g}] for a fit"
            )


def _backgrounds(recording: Recording) -> NDArray[np.float64]:
    """Counts beside the pupils of the mask-out images, for frames and mask-out images, (4,); 0 where cut."""
    levels = []
    for index, image in enumerate(recording.pupil_images):
        shared = recording.pupil_images[0] is recording.pupil_images[1]
        circles = recording.pupils if shared else recording.pupils[index : index + 1]
        far = ~image.bad
        for circle in circles:
            far &= radius(far.shape, (circle.row, circle.column)) > 0.58 * circle.diameter
        enough = np.count_nonzero(far) >= 100 and not image.cut
        levels.append(float(np.median(image.counts[far])) if enough else 0.0)
    dark = np.array(levels)
    return np.concatenate([dark * recording.exposure, dark])


def _mix(frames: NDArray, measurement: Measurement, optics: Optics) -> NDArray[np.float64]:
    """What leakage and the unmasked light make of ideal frames."""
    mixed = (1 - optics.leakage) * frames + optics.leakage * frames[::-1]
    mixed *= 1 - optics.unmasked
    mixed[(..., *measurement.window)] += optics.unmasked * measurement.pupil.amplitude**2
    return mixed


def _unmix(frames: NDArray, measurement: Measurement, optics: Optics) -> NDArray[np.float64]:
    """Inverse of `_mix`."""
    pure = frames.copy()
    pure[(..., *measurement.window)] -= optics.unmasked * measurement.pupil.amplitude**2
    pure /= 1 - optics.unmasked
    return ((1 - optics.leakage) * pure - optics.leakage * pure[::-1]) / (1 - 2 * optics.leakage)


@dataclass(frozen=True, eq=False)
class Step:
    """One more step of the work, and what it gains.

    Attributes
    ----------
    name : str
    recording : Recording
    optics : Optics
    found : Found
    predicted : ndarray, shape (2,)
        Correlation of each frame with what the other one alone predicts, see `predict_other`.
    """

    name: str
    recording: Recording
    optics: Optics
    found: Found
    predicted: NDArray[np.float64]


def steps(
    frames: Sequence[Image],
    pupil_images: Sequence[Image],
    optics: Optics,
    fitted: Sequence[str] = ("registration", "background", "scale"),
    n_iterations: int = 25,
    **settings: Any,
) -> list[Step]:
    """All the work on a pair of frames, one step after the other, each judged.

    Parameters
    ----------
    frames, pupil_images : sequence of one or two Images
    optics : Optics
    fitted : sequence of str
        What is fitted, see `fit`: with each step one more, and all before it again.
    n_iterations : int
        As for `reconstruct`.
    **settings
        Of `record`: pupil_centers, pupil_diameter, exposure.

    Returns
    -------
    list of Step
        The last one holds the result.

    Raises
    ------
    TypeError, ValueError
        As `record`, `measure` and `fit` do.
    """
    _check_fit("fitted", fitted, optics)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    switches: dict[str, Any] = {"subpixel": False, "background": False, "balance": False}
    work = []

    def add(name: str, recording: Recording, model: Optics) -> None:
        measurement = measure(recording, model)
        found = reconstruct(measurement, model, n_iterations)
        work.append(Step(name, recording, model, found, predict_other(measurement, model, n_iterations)))

    add("outlines of the pupils", record(frames, pupil_images, **settings, **switches), optics)
    for name, switch in (
        ("registration by content", "subpixel"),
        ("background beside the pupils", "background"),
        ("balance of the flux", "balance"),
    ):
        switches[switch] = True
        add(name, record(frames, pupil_images, **settings, **switches), optics)
    for number in range(1, len(fitted) + 1):
        last = work[-1]
        found = fit(last.recording, last.optics, fitted[:number], n_iterations)
        add(f"fit of {fitted[number - 1].replace('_', ' ')}", *found)
    return work
