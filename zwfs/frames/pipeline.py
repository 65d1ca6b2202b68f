"""Camera frames to phase: normalise them, model the sensor from its own pupil, compare frames with the model.

The images come from `zwfs.frames.files`, their places from `zwfs.frames.registration`. Uncertain properties of the
sensor are parameters of `Optics`, which `zwfs.frames.refine` fits. `predict_other` tests a phase on unseen data.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._images import mean_light, nearest_good, radius
from zwfs.frames._grid import iterated
from zwfs.frames._outline import NEAR, UNEVEN, gains
from zwfs.frames.registration import CLEAR_FRAMES, FRAMES, Image, RegisteredFrames, correlations, register_frames
from zwfs.masks import Dimple, Mask
from zwfs.pupil import Pupil
from zwfs.reconstructors import Arcsine, PhaseShifted
from zwfs.sensor import ZernikeSensor

if TYPE_CHECKING:
    from zwfs.frames.phases import Phases

__all__ = [
    "Agreement",
    "Measurement",
    "Optics",
    "phase_of",
    "predict_other",
    "recover_phase",
    "reduce_frames",
]

MOST_ITERATIONS = 10_000  # of a pair of frames: more take minutes and change nothing
_DARK = 0.1  # of the largest amplitude: a point with less is outside
_LIT = 0.85  # of the amplitude around it: a point with less is dark or partly lit
_HALF = 0.7  # of the amplitude around it: a point with less is lit in half or less
_ROUGHLY = 10  # iterations
_SURELY = 0.92  # of the misfit: another split of the gain must come below it
_DOUBTFUL, _UNLIKE = 0.08, 4.0  # of the light, and of the noise of the frames: a larger residual is worth a word
_SECOND = 1.0, -2.0, 1.0  # a smooth phase hardly changes the second differences
MOST_BAD = 0.2  # of the points of the pupil: with more bad ones, the reference wave is guesswork


@dataclass(frozen=True)
class Optics:
    """Properties of the sensor other than its pupil; all but the phase shifts may be fitted.

    Parameters
    ----------
    diameter : float, lambda/D
        Diameter of the dimple.
    phase_shifts : (float,) or (float, float), radian
        Of the images. With two, exchanging them changes the sign of the phase, and nothing else: the frames do not
        show which image is which.
    background : float
        Stray light in the frames that remains after the dark, in units of the mean intensity of the pupil.
    pupil_background : float
        The same for the clear frames. Below 0, it lowers the contrast of the amplitude.
    scale : float
        Factor on the frames: flux of the clear frames over that of the frames.
    leakage : float
        Fraction of the light of each image that belongs to the other one, as in `zwfs.bench.model.Bench`.
    unmasked : float
        Fraction of the light that the mask does not shift, because its retardance is not half a wave. It is added
        as an intensity, which is right for unpolarised light. In linearly polarised light it interferes with the
        shifted light, which changes the frames by some tenths of the mean intensity and is not modelled.
    masks : tuple of one or two Mask, optional
        Masks other than two dimples of one diameter. Their largest diameter and their phase shifts on the axis
        take the place of `diameter` and `phase_shifts`. The light of their images is not balanced, and a
        calibration with them cannot be saved.

    Raises
    ------
    TypeError, ValueError
        If there are not one or two phase shifts or masks, phase shifts are the same, or one of them is 0.
    """

    diameter: float = 1.06
    phase_shifts: tuple[float, ...] = (np.pi / 2, -np.pi / 2)
    background: float = 0.0
    pupil_background: float = 0.0
    scale: float = 1.0
    leakage: float = 0.0
    unmasked: float = 0.0
    masks: tuple[Mask, ...] = ()

    def __post_init__(self) -> None:
        _check.sequence("masks", self.masks)
        if len(self.masks):
            self._take_masks()
        _check.number("diameter", self.diameter, 1e-3)
        _check.sequence("phase_shifts", self.phase_shifts, expected="a list of one or two numbers")
        if len(self.phase_shifts) not in (1, 2):
            raise ValueError(f"phase_shifts has {len(self.phase_shifts)} values: expected one or two")
        shifts = tuple(_check.number("phase_shifts", shift) for shift in self.phase_shifts)
        object.__setattr__(self, "phase_shifts", shifts)
        first, second = np.exp(1j * np.array([shifts[0], shifts[-1]]))
        apart = min(abs(first - second) if len(shifts) == 2 else 1, abs(first - 1), abs(second - 1))
        if apart < 1e-9 and not self.masks:
            expected = "one, or two that differ by other than 0 mod 2 pi, none of them 0"
            raise ValueError(f"phase_shifts = {_check.shown(self.phase_shifts)}: expected {expected}")
        _check.number("scale", self.scale, 0, open_low=True)
        ends = {"background": (-1, 1), "pupil_background": (-1, 1), "leakage": (0, 0.5), "unmasked": (0, 1)}
        for name, limits in ends.items():
            _check.number(name, getattr(self, name), *limits, open_high=True)
        if len(shifts) == 1 and self.leakage:
            raise ValueError(f"leakage = {self.leakage:g}: expected 0 with one phase shift, and so one image")

    def _take_masks(self) -> None:
        for mask in self.masks:
            if not (callable(getattr(mask, "transmission", None)) and hasattr(mask, "diameter")):
                raise TypeError(f"masks holds a {type(mask).__name__}: expected masks, such as Dimple or Patch")
        axis = np.zeros(1)
        shifts = tuple(float(np.angle(mask.transmission(axis, axis))[0]) for mask in self.masks)
        object.__setattr__(self, "masks", tuple(self.masks))
        object.__setattr__(self, "phase_shifts", shifts)
        object.__setattr__(self, "diameter", max(float(mask.diameter) for mask in self.masks))

    @property
    def focal_masks(self) -> tuple[Mask, ...]:
        """What `masks` gives, or dimples of the phase shifts, one for each image."""
        return self.masks or tuple(Dimple(self.diameter, shift) for shift in self.phase_shifts)

    @property
    def exchanged(self) -> Optics:
        """The same with the masks in the other order."""
        return replace(self, phase_shifts=self.phase_shifts[::-1], masks=self.masks[::-1])

    @property
    def single(self) -> bool:
        """Whether there is one mask, and one image."""
        return len(self.phase_shifts) == 1

    @property
    def opposite(self) -> bool:
        """Whether the images are those of two dimples with +theta and -theta, modulo 2 pi."""
        return not self.single and not self.masks and abs(np.exp(1j * sum(self.phase_shifts)) - 1) < 1e-9


@dataclass(frozen=True, eq=False)
class Measurement:
    """Registered and normalised frames, and the pupil that goes with them.

    Attributes
    ----------
    registered : RegisteredFrames
    optics : Optics
    intensity : ndarray, shape (2, ny', nx')
        Frames; 1 is the mean squared amplitude of the pupil. May be negative where there is noise.
    pupil : Pupil
        Its amplitude is the mean over a pixel. A pixel that is lit in part has two areas, of which one is dark.
    rest : ndarray, shape (ny, nx)
        Light of a pixel less its squared amplitude: 0 where it is fully lit.
    bad : ndarray of bool, shape (2, ny', nx')
        Where a frame, or in the pupil a clear frame, has a bad pixel.
    margin : int, pixels
        Of the frames around the grid of the pupil.
    counts : ndarray, shape (2,)
        Counts of the clear frames that make an intensity of 1.
    background : ndarray, shape (4,)
        Counts subtracted, of frames first, then of clear frames.
    flux_ratio : (float, float)
        Light of the first image in the pupil over that of the second: with the mask in, before the balance, and
        with the mask out.
    gain : ndarray, shape (2, ny', nx') or (2, 1, 1)
        Smooth gain of each arm, by the ratio of the clear frames; `intensity` still contains it.
    share : float or None
        Share of the first arm in the ratio of the gains; None if the light before the masks is even.
    """

    registered: RegisteredFrames
    optics: Optics
    intensity: NDArray[np.float64]
    pupil: Pupil
    rest: NDArray[np.float64]
    bad: NDArray[np.bool_]
    margin: int
    counts: NDArray[np.float64]
    background: NDArray[np.float64]
    flux_ratio: tuple[float, float]
    gain: NDArray[np.float64] = field(default_factory=lambda: np.ones((2, 1, 1)))
    share: float | None = 0.5

    def __post_init__(self) -> None:
        _check.declared(self)

    @cached_property
    def good(self) -> NDArray[np.bool_]:
        """Points of the pupil at which both frames and both clear frames are good, (ny, nx)."""
        return self.pupil.inside & ~self.bad[(..., *self.window)].any(axis=0)

    @property
    def n_bad(self) -> int:
        """Points of the pupil that are bad."""
        return self.pupil.n_points - int(np.count_nonzero(self.good))

    @property
    def window(self) -> tuple[slice, slice]:
        """Where the grid of the pupil lies in a frame."""
        ny, nx = self.pupil.shape
        return slice(self.margin, self.margin + ny), slice(self.margin, self.margin + nx)

    @cached_property
    def surroundings(self) -> NDArray[np.bool_]:
        """Good points of the frames next to the pupil, clear of its edge, (2, ny', nx')."""
        center = self.margin + self.pupil.center[0], self.margin + self.pupil.center[1]
        return ~self.bad & (radius(self.bad.shape[1:], center) > 0.53 * self.registered.diameter)

    @property
    def light(self) -> NDArray[np.float64]:
        """Light of a clear frame on the grid of the frames, without that of partly lit pixels, (ny', nx')."""
        light = np.zeros(self.intensity.shape[1:])
        light[self.window] = self.pupil.amplitude**2
        return light

    @property
    def measured(self) -> NDArray[np.float64]:
        """Frames as those of equal arms, with the scale and the background of the optics, (2, ny', nx')."""
        return self.intensity / self.gain * self.optics.scale - self.optics.background

    def modelled(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Frames that the model predicts for a phase, (2, ny', nx').

        Parameters
        ----------
        phase : array_like, shape (ny, nx), radian
            What is NaN, or not good, has the value of the nearest good point.
        """
        phase = _check.real_array("phase", phase).astype(float)
        if phase.shape != self.pupil.shape:
            raise ValueError(f"phase has shape {phase.shape}: expected {self.pupil.shape}, the grid of the pupil")
        filled = nearest_good(np.nan_to_num(phase), self.good & np.isfinite(phase))
        frames = mixed(model(self).measure(filled), self.optics.leakage, self.optics.unmasked, self.light)
        frames = np.broadcast_to(frames, self.intensity.shape).copy()
        frames[(..., *self.window)] += self.rest
        return frames

    def agreement(self, phase: ArrayLike) -> Agreement:
        """Agreement of the frames with those of a phase, see `modelled`."""
        return Agreement(self, self.measured, self.modelled(phase))


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreement of measured frames with those that a model predicts for a phase.

    Attributes
    ----------
    measurement : Measurement
    measured, modelled : ndarray, shape (2, ny', nx')
        Frames: the measured ones as normalised for the optics of the measurement.
    """

    measurement: Measurement
    measured: NDArray[np.float64]
    modelled: NDArray[np.float64]

    def __post_init__(self) -> None:
        _check.declared(self)

    @cached_property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation of measured and modelled frames over the good points of the pupil, (2,)."""
        return correlations(self._inside(self.measured), self._inside(self.modelled))

    @cached_property
    def residual(self) -> NDArray[np.float64]:
        """Rms difference of the frames over the good points of the pupil, (2,); 1 = mean of a clear frame."""
        return np.sqrt(np.mean((self._inside(self.measured) - self._inside(self.modelled)) ** 2, axis=1))

    @cached_property
    def excess_light(self) -> float:
        """Mean of measured less modelled light next to the pupil, where no phase was fitted."""
        around = self.measurement.surroundings
        return float(np.mean((self.measured - self.modelled)[around])) if around.any() else float("nan")

    @cached_property
    def mismatch(self) -> NDArray[np.float64]:
        """Measured less modelled frames over the contrast, the rms variation of the frames, shape (2, ny', nx').

        Its squares sum up to that of `misfit`. Pupil and surroundings weigh the same, however many pixels they
        have; what belongs to neither is 0.
        """
        around, inside = self.measurement.surroundings, np.zeros(self.measured.shape, bool)
        inside[(..., *self.measurement.window)] = self.measurement.good
        weight = inside / np.count_nonzero(inside) + around / max(1, int(np.count_nonzero(around)))
        return (self.measured - self.modelled) * np.sqrt(weight / self._inside(self.measured).var(axis=1).mean())

    @property
    def misfit(self) -> float:
        """Rms difference of the frames in the pupil and around it, over their contrast; `fit` minimises it."""
        return float(np.sqrt(np.sum(self.mismatch**2)))

    def _inside(self, frames: NDArray) -> NDArray:
        return frames[(..., *self.measurement.window)][:, self.measurement.good]


def phase_of(
    frames: ArrayLike, clear_frames: ArrayLike, dark: ArrayLike | None = None, *,
    saturation: float = np.inf, exposure: float = 1.0, **optics: Any,
) -> Phases:  # fmt: skip
    """Phase of a pair of camera frames, for a first look.

    Parameters
    ----------
    frames, clear_frames, dark, saturation, exposure, **optics
        As for `zwfs.frames.Calibration.from_arrays`, whose calibration is called on the same frames.

    Returns
    -------
    Phases
        Of shape (), without a batch.

    Examples
    --------
    >>> from zwfs.bench.model import Bench
    >>> from zwfs.frames import phase_of
    >>> bench = Bench(n_pixels=40)
    >>> bool(phase_of(bench.frames(), bench.clear_frames(), diameter=bench.diameter).converged)
    True
    """
    from zwfs.frames.calibration import Calibration  # late: it needs this module

    frames = _plain(frames)
    measurement = measured(frames, clear_frames, dark, Optics(**optics), saturation, exposure)
    return replace(Calibration.of(measurement, saturation=saturation)(frames), measurement=measurement)


def recover_phase(measurement: Measurement, n_iterations: int = 25, tolerance: float = 1e-3) -> Phases:
    """Phase of a measurement: that of its camera images by its own calibration.

    Bad pixels take no part, and are NaN in the result. One image is reconstructed by the iterated arcsine.

    Parameters
    ----------
    measurement : Measurement
    n_iterations : int
        Largest number of iterations.
    tolerance : float, radian
        Rms of the change of the phase at which the iteration ends.

    Returns
    -------
    Phases
        Of shape (), without a batch.
    """
    from zwfs.frames.calibration import Calibration  # late: it needs this module

    n_iterations = _check.integer("n_iterations", n_iterations, 1, MOST_ITERATIONS)
    calibration = Calibration.of(measurement, n_iterations=n_iterations, tolerance=tolerance)
    calibration = replace(calibration, dark=np.zeros_like(calibration.dark))  # which the images lack already
    counts = np.stack([image.counts for image in measurement.registered.camera_images])
    return replace(calibration(counts if len(counts) == 2 else counts[0]), measurement=measurement)


def measured(
    frames: ArrayLike, clear_frames: ArrayLike, dark: ArrayLike | None, optics: Optics,
    saturation: float = np.inf, exposure: float = 1.0,
) -> Measurement:  # fmt: skip
    """Measurement from arrays, see `zwfs.frames.Calibration.from_arrays`."""
    saturation = _check.number_or_inf("saturation", saturation, open_low=True)
    unlit, pair = 0 if dark is None else _check.real_array("dark", dark), []
    for name, counts in (("frames", frames), ("clear_frames", clear_frames)):
        images = _check.real_array(name, _plain(counts))
        images = np.where(images >= saturation, np.nan, images)
        if images.ndim not in (2, 3) or images.shape[:-2] not in ((), (2,)):
            expected = "(ny, nx), or (2, ny, nx) for two images; average several exposures first"
            raise ValueError(f"{name} has shape {images.shape}: expected {expected}")
        if np.shape(unlit) not in ((), images.shape[-2:], images.shape):
            expected = f"{images.shape}, that of {name}; average several exposures first"
            raise ValueError(f"dark has shape {np.shape(unlit)}: expected {expected}")
        maps = np.stack(np.broadcast_arrays(images - unlit, unlit)).reshape(2, -1, *images.shape[-2:])
        pair.append([Image.of(counts, name, lightless) for counts, lightless in zip(*maps, strict=True)])
    registered = register_frames(*pair, n_pupils=len(optics.phase_shifts), exposure=exposure)
    return reduce_frames(registered, optics)


def _plain(counts: ArrayLike) -> ArrayLike:
    """Counts with NaN in the place of what a masked array masks."""
    return np.ma.filled(counts.astype(float), np.nan) if isinstance(counts, np.ma.MaskedArray) else counts


def reduce_frames(registered: RegisteredFrames, optics: Optics, margin: int | None = None) -> Measurement:
    """Bring frames on the grid of the pupil and normalise them.

    The amplitude is common to both images, and follows from the mean of the clear frames, each scaled to the same
    flux. If their ratio varies smoothly over the pupil, the arms are lit differently, and all images of an arm are
    divided by its gain. Clear frames show the ratio of the gains. Both arms share it, unless the frames behind the
    masks agree better with a gain in one arm alone, or with light that is even before the masks.

    A pixel that is lit in part has an area s with the amplitude A of its neighbours. With the reference wave
    r its mean intensity is s |A exp(i phi) + r|^2 + (1 - s) |r|^2, which is |s A exp(i phi) + r|^2 plus the
    constant `rest` = s (1 - s) A^2: the amplitude of the pixel is s A, and s A^2 is its light in the clear frames.

    The light of the two frames is balanced where their phase shifts are opposite: the light that two such masks
    send into the pupil differs by 4 sin(theta) Im <psi, b>, and that is 0 for any field psi, because b is its
    projection on the dimple.

    Parameters
    ----------
    registered : RegisteredFrames
    optics : Optics
        Of the model; here `pupil_background` is subtracted, and the balance depends on the phase shifts.
    margin : int, pixels, optional
        Of the frames around the grid of the pupil; by default the largest that both frames hold.

    Raises
    ------
    ValueError
        If too much of the pupil is bad, or a clear frame is dark.
    """
    _check.instance("registered", registered, RegisteredFrames)
    _check.instance("optics", optics, Optics)
    margin = registered.margin if margin is None else _check.integer("margin", margin, 0)
    if optics.diameter > registered.diameter:
        raise ValueError(
            f"diameter = {optics.diameter:g} lambda/D: expected at most {registered.diameter:.4g} (pixels of D)"
        )
    best = reduce_with(clear_light(registered, optics.pupil_background), registered, optics, margin)
    least = None
    for share in (0.0, 1.0, None):
        clear = clear_light(registered, optics.pupil_background, share)
        if np.ptp(clear.gain, axis=(1, 2)).max() > UNEVEN:
            least = least or _rough_misfit(best)
            rival = reduce_with(clear, registered, optics, margin)
            if (error := _rough_misfit(rival)) < _SURELY * least:
                best, least = rival, error
    return best


class ClearLight(NamedTuple):
    """What the clear frames give: the pupil, and the units of the frames."""

    pupil: Pupil
    rest: NDArray[np.float64]  # see `Measurement`
    bad: NDArray[np.bool_]  # (ny, nx), points of the pupil at which a clear frame has a bad pixel
    counts: NDArray[np.float64]  # (2,), see `Measurement`
    background: NDArray[np.float64]  # (4,), see `Measurement`
    gain: NDArray[np.float64]  # (2, ny, nx), of the arms
    share: float | None  # see `Measurement`


def clear_light(registered: RegisteredFrames, pupil_background: float, share: float | None = 0.5) -> ClearLight:
    """Amplitude of the pupil, and units of the frames, from the clear frames alone."""
    n, center = registered.n_pixels, registered.center
    clear, bad = registered._on_grid(CLEAR_FRAMES)
    background = _backgrounds(registered) if registered.background else np.zeros(4)
    stop = radius((n, n), center) <= registered.diameter / 2
    clear -= background[2:, None, None]
    gain = gains(clear, stop & ~bad.any(axis=0), center, registered.diameter, share)
    light, scale = mean_light(clear / gain, stop)
    light = np.where(stop, np.maximum(light - pupil_background, 0), 0)
    amplitude = _amplitude(light, registered.diameter)
    pupil = Pupil.from_amplitude(amplitude, registered.diameter, center, _DARK)
    unit = float(np.mean(amplitude[pupil.inside] ** 2))
    rest = np.where(pupil.inside, light / unit - pupil.amplitude**2, 0)
    return ClearLight(pupil, rest, bad.any(axis=0) & pupil.inside, scale * unit, background, gain, share)


def reduce_with(clear: ClearLight, registered: RegisteredFrames, optics: Optics, margin: int) -> Measurement:
    """Bring the frames on the grid of the pupil and normalise them, see `reduce_frames`."""
    pupil, counts, n = clear.pupil, clear.counts, registered.n_pixels
    frames, bad = registered._on_grid(FRAMES, margin)
    frames = frames - clear.background[:2, None, None]
    inner = (..., slice(margin, margin + n), slice(margin, margin + n))
    bad[inner] |= clear.bad
    good = pupil.inside & ~bad[inner].any(axis=0)
    n_bad = pupil.n_points - np.count_nonzero(good)
    if n_bad > MOST_BAD * pupil.n_points:
        raise ValueError(
            f"{n_bad} of the {pupil.n_points} points of the pupil are bad or saturated: "
            f"expected at most {MOST_BAD:.0%}"
        )
    intensity = frames / (counts[:, None, None] * registered.exposure)
    flux = (intensity[inner] / clear.gain)[:, good].mean(axis=1)
    if np.any(flux <= 0):
        raise ValueError(f"the frames hold {flux} of the light of the clear frames: expected more than 0")
    if registered.balance and optics.opposite:
        intensity = intensity * (flux.mean() / flux)[:, None, None]
    flux = flux * counts
    ratio = flux[0] / flux[1], counts[0] / counts[1]
    around = (0, 0), (margin, margin), (margin, margin)
    return Measurement(
        registered, optics, intensity, pupil, clear.rest, bad, margin, counts, clear.background, ratio,
        np.pad(clear.gain, around, "edge"), clear.share,
    )  # fmt: skip


def _fully_lit(amplitude: NDArray, diameter: float, least: float, apart: int) -> NDArray[np.bool_]:
    """Points more than `apart` pixels from one with less than a part of the amplitude of its surroundings."""
    around = ndimage.median_filter(amplitude, max(3, round(diameter / 8)))
    return np.asarray(ndimage.binary_erosion(amplitude > least * around, np.ones((3, 3)), iterations=apart))


def near_edges(measurement: Measurement) -> NDArray[np.bool_]:
    """Points within 2 pixels of one that is dark or partly lit, (ny, nx)."""
    amplitude = np.where(measurement.pupil.inside, measurement.pupil.amplitude, 0)
    return ~_fully_lit(amplitude, measurement.registered.diameter, _LIT, NEAR)


def _amplitude(light: NDArray, diameter: float) -> NDArray[np.float64]:
    """Mean amplitude of pixels with this light: where they are partly lit, neighbours give the amplitude."""
    root = np.sqrt(light)
    full = _fully_lit(np.where(root > _DARK * root.max(), root, 0), diameter, _HALF, 1)
    return np.minimum(root, light / nearest_good(root, full)) if full.any() else root


def iterated_phase(measurement: Measurement, n_iterations: int, tolerance: float) -> NDArray[np.float64]:
    """Phase of a measurement in double precision, (ny, nx), filled at bad points: a smooth function of the optics.

    The searches use it; `recover_phase` converges in fewer steps, in single precision.
    """
    sensor, window = model(measurement), measurement.window
    inside = ZernikeSensor(sensor.pupil, *sensor.masks, tolerance=1e-6)
    method = Arcsine if measurement.optics.single else PhaseShifted
    frames = np.maximum(ideal_frames(measurement), 0)[np.newaxis, : sensor.n_masks, *window]
    solver = method(inside, n_iterations=n_iterations, tolerance=tolerance)
    return iterated(solver, frames, measurement.good[np.newaxis]).phase[0]


def model(measurement: Measurement) -> ZernikeSensor:
    """Sensor with the measured pupil, on the detector of the frames."""
    _check.instance("measurement", measurement, Measurement)
    extent = 1 + 2 * measurement.margin / measurement.registered.diameter
    return ZernikeSensor(measurement.pupil, *measurement.optics.focal_masks, extent=extent, tolerance=1e-6)


def ideal_frames(measurement: Measurement) -> NDArray[np.float64]:
    """Frames of a measurement as those of an ideal sensor: its optics are undone. They may be negative."""
    _check.instance("measurement", measurement, Measurement)
    frames, optics = measurement.measured, measurement.optics
    frames[(..., *measurement.window)] -= measurement.rest
    return unmixed(frames, optics.leakage, optics.unmasked, measurement.light)


def mixed(frames: NDArray, leakage: float, unmasked: float, light: NDArray | float) -> NDArray[np.float64]:
    """Frames (..., 2, ny, nx) with leakage, and unmasked light of a clear frame `light`, from ideal ones.

    It holds for one mask, too, which has no leakage.
    """
    leaking = (1 - leakage) * frames + leakage * frames[..., ::-1, :, :]
    return (1 - unmasked) * leaking + unmasked * light


def unmixed(frames: NDArray, leakage: float, unmasked: float, light: NDArray | float) -> NDArray[np.float64]:
    """Inverse of `mixed`."""
    pure = (frames - unmasked * light) / (1 - unmasked)
    return ((1 - leakage) * pure - leakage * pure[..., ::-1, :, :]) / (1 - 2 * leakage)


def predict_other(measurement: Measurement, n_iterations: int = 25) -> NDArray[np.float64]:
    """Correlation of each frame with the one that the other frame alone predicts, (2,); NaN with one image.

    Parameters, as for `recover_phase`.
    """
    _check.instance("measurement", measurement, Measurement)
    if measurement.optics.single:
        return np.full(2, np.nan)
    good = measurement.good
    frames = np.maximum(ideal_frames(measurement), 0)[(..., *measurement.window)]
    return correlations(frames[:, good], predicted_frames(measurement, n_iterations)[:, good])


def predicted_frames(measurement: Measurement, n_iterations: int = 25) -> NDArray[np.float64]:
    """Ideal frames on the grid of the pupil, (2, ny, nx), each of them predicted from the other one alone.

    The phase-shifted iteration sees both frames, and could explain part of their noise. Here the arcsine
    reconstruction sees one frame, and the model predicts the other one from its phase.
    """
    n_iterations = _check.integer("n_iterations", n_iterations, 1, MOST_ITERATIONS)
    both, frames = model(measurement), np.maximum(ideal_frames(measurement), 0)
    predicted = []
    for number in (1, 0):
        sensor = ZernikeSensor(measurement.pupil, both.masks[number], extent=both.extent, tolerance=1e-6)
        estimate = Arcsine(sensor, n_iterations=n_iterations, tolerance=1e-4)(frames[number : number + 1])
        predicted.append(both.measure(estimate.phase)[1 - number][measurement.window])
    return np.stack(predicted)


def prediction_error(measurement: Measurement, where: NDArray, n_iterations: int = 25) -> NDArray[np.float64]:
    """Squared error at some points of each frame predicted from the other one, over the variance, (2,)."""
    frames = ideal_frames(measurement)[(..., *measurement.window)][:, where]
    predicted = predicted_frames(measurement, n_iterations)[:, where]
    return np.mean((predicted - frames) ** 2, axis=1) / np.maximum(frames.var(axis=1), 1e-300)


def upside_down(measurement: Measurement) -> Measurement:
    """Control of a measurement: its second frame upside down, so that the frames no longer belong together."""
    _check.instance("measurement", measurement, Measurement)
    maps = measurement.intensity, measurement.bad, measurement.gain
    intensity, bad, gain = (np.stack([first, second[::-1]]) for first, second in maps)
    return replace(measurement, intensity=intensity, bad=bad, gain=gain)


def doubt(measurement: Measurement, phase: NDArray) -> str:
    """Say that frames do not belong to their model with a phase (ny, nx); empty if they do, off the edges."""
    far = measurement.good & ~near_edges(measurement)
    if not far.any():
        return ""
    residual = _misfit_far(measurement, phase)
    measured = measurement.measured[(..., *measurement.window)]
    rough = [ndimage.convolve(frame, np.outer(_SECOND, _SECOND) / 6, mode="nearest") for frame in measured]
    noise = 1.48 * np.median(np.abs(rough)[:, far])
    if residual < max(_DOUBTFUL, _UNLIKE * noise):
        return ""
    return (
        f"The frames differ from their model by {residual:.2g} of the mean light, and noise explains {noise:.2g}: "
        "look at exposure, dark, the order and the orientation of the images, and bad pixels."
    )


def _misfit_far(measurement: Measurement, phase: NDArray) -> float:
    """Rms difference of frames and model with a phase (ny, nx), far from edges; infinite if there are none."""
    agreement, far = measurement.agreement(phase), measurement.good & ~near_edges(measurement)
    missing = (agreement.measured - agreement.modelled)[(..., *measurement.window)][:, far]
    return float(np.sqrt(np.mean(missing**2))) if far.any() else np.inf


def _rough_misfit(measurement: Measurement) -> float:
    return _misfit_far(measurement, iterated_phase(measurement, _ROUGHLY, 1e-3))


def _backgrounds(registered: RegisteredFrames) -> NDArray[np.float64]:
    """Counts around the pupils of the clear frames, for frames and clear frames, (4,); 0 where cut."""
    levels = []
    for image in registered.clear_frames:
        far = ~image.bad
        for circle, holder in zip(registered.pupils, registered.clear_frames, strict=True):
            if holder is image:  # both pupils may be on one image
                far &= radius(far.shape, circle[:2]) > 0.58 * circle.diameter
        enough = np.count_nonzero(far) >= 100 and not image.cut
        levels.append(float(np.median(image.counts[far])) if enough else 0.0)
    dark = np.array(levels) * registered.areas[2:]
    return np.concatenate([dark * registered.exposure, dark])
