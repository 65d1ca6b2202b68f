"""A simulated bench: a vector-Zernike sensor behind a segmented mirror, with the errors of a real one.

The bench stands for the one of section 5 of the paper. It returns the images of a camera in counts: frames,
clear frames and darks. The errors of the bench stay inside. `BenchModel` is the sensor that an experimenter would
model from the images alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from zwfs import _check
from zwfs._arrays import Immutable
from zwfs._images import mean_light, radius
from zwfs.bench.relay import Relay
from zwfs.detector import Detector
from zwfs.masks import Dimple
from zwfs.metrics import without_piston
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.sensor import ZernikeSensor

__all__ = ["Bench", "BenchModel", "segment_residual", "segment_screens"]

_NOISE = "photons_per_image", "read_noise", "background"
_N_MODES = 200  # that random segment commands are made of
_REACH = 6.0  # standard deviations of the blur
_SIGNS = np.array([1, -1])[:, np.newaxis, np.newaxis]  # of the mask's phase shift for the two polarisations

Seed = int | np.random.Generator | np.random.SeedSequence | None


def _error(size: float) -> Any:
    """Field of `Bench` that is an error: 0 is ideal."""
    return field(default=size, metadata={"error": True})


@dataclass(frozen=True, eq=False)
class Bench:
    """A vector-Zernike sensor with a segmented mirror, imperfect in ways that can be switched on one by one.

    The first group of parameters is the layout, the second the errors: 0 is ideal for each of them.

    Parameters
    ----------
    n_pixels : int, pixels
        Camera pixels across a pupil image: 136 on the real bench.
    extent : float, D
        Width of what the camera records of each pupil image, at most 10: 180 pixels of 136 on the real bench.
    n_rings, gap, missing, stop
        Layout of the segmented mirror, see `Pupil.hexagonal`. The defaults look like the real one: 37 segments,
        5.5 across the stop, gaps of two pixels (those of the real mirror are narrower), and one segment missing
        at the top right.
    diameter : float, lambda/D
        Diameter of the dimple by design.
    phase : float, radian
        Phase shift of the mask, of opposite sign for the two polarisations.
    illumination : float
        Change of the intensity from the left edge of the pupil to the right one, as a fraction of the mean. The
        clear frame shows it, so it does not count as an error.
    leakage : float
        Fraction of the light of each polarisation that ends in the image of the other. 3 % is what a quarter-wave
        plate makes that is turned by 10 degrees (sin^2), or 20 degrees short of a quarter wave.
    focus_difference : float
        Distance between the planes that are in focus in the two images, times lambda / D^2; the camera is halfway.
        3e-4 is 12 mm for a beam of 5 mm at 635 nm; much more would put bright rims on the segments, which the real
        frames do not have.
    misregistration : float, pixels
        Distance between the pupil images, along both axes, that is left after registration; those of the real
        bench are 0.8 and 0.35 pixels apart.
    blur : float, pixels rms
        Gaussian blur of the relay optics and the camera. The power spectrum of the real frames asks for 0.8.
    flux_imbalance : float
        The two images hold 1 + and 1 - this of the mean flux. The clear frames show it.
    dimple_error : float
        Relative error of the dimple's diameter. The real frames are explained best by 1.1 lambda/D, 4 % above the
        design.
    static : float, radian rms
        Low-order aberration of the bench at the flat command.
    quilting : float, radian rms
        Grid that the actuators print on the surface of the deformable mirror; 22 of them across the pupil, as seen
        in the real frames. 6 nm at 635 nm is 0.06 rad.
    photons_per_image : float
        Photons of each image with the mask out, in all the exposures that make a frame: a hundred of 1e8 each, for
        the high signal-to-noise ratio of the paper. 0 for frames without noise.
    read_noise : float, electrons rms
        Read noise of a pixel.
    background : float, electrons
        Stray light and dark current of a pixel, 7 % of the light of one in the pupil; darks show it.
    seed : int
        Of the static aberration, which belongs to the bench.

    References
    ----------
    Chambouleyron et al. 2024, sections 2.3 and 5.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.bench.model import Bench
    >>> bench = Bench(n_pixels=40)
    >>> frames = bench.frames(np.zeros(bench.n_segments), seed=1)
    >>> frames.shape, bench.n_segments
    ((2, 52, 52), 36)
    """

    n_pixels: int = 136
    extent: float = 180 / 136
    n_rings: int = 3
    gap: float = 0.015
    missing: tuple[int, ...] = (21,)
    stop: float | None = 0.78
    diameter: float = 1.06
    phase: float = np.pi / 2
    illumination: float = 0.5
    leakage: float = _error(0.03)
    focus_difference: float = _error(3e-4)
    misregistration: float = _error(0.5)
    blur: float = _error(0.8)
    flux_imbalance: float = _error(0.05)
    dimple_error: float = _error(0.04)
    static: float = _error(0.05)
    quilting: float = _error(0.06)
    photons_per_image: float = 1e10
    read_noise: float = 30.0
    background: float = 60000.0
    seed: int = 0
    _dimples: ZernikeSensor = field(init=False, repr=False)  # its reference waves are the light of the dimple

    def __post_init__(self) -> None:
        _check.integer_field(self, "n_pixels", 2)
        _check.number_field(self, "extent", 1, 10)
        _check.sequence("missing", self.missing, expected="segment numbers, such as (21,)")
        _check.number_field(self, "dimple_error", -0.9, 10)
        _check.number_field(self, "diameter", 0, self.n_pixels / (1 + self.dimple_error), open_low=True)
        _check.number_field(self, "phase")
        _check.number_field(self, "illumination", 0, 2, open_high=True)
        _check.number_field(self, "leakage", 0, 0.5)
        _check.number_field(self, "focus_difference", 0, 1e-2)
        _check.number_field(self, "misregistration", 0, 10)
        _check.number_field(self, "flux_imbalance", -1, 1, open_low=True, open_high=True)
        _check.number_field(self, "blur", 0, self.n_pixels)
        for name in ("static", "quilting", *_NOISE):
            _check.number_field(self, name, 0)
        _check.integer_field(self, "seed", 0, math.inf)
        if not self.photons_per_image and (self.read_noise or self.background):
            raise ValueError(
                f"photons_per_image = 0 with read_noise = {self.read_noise:g} and background = "
                f"{self.background:g}: expected 0 for both where frames are to be without noise"
            )
        self._make_parts()

    def _make_parts(self) -> None:
        """Make the pupil and the sensor of the light of the dimple, which refuse what else is out of range."""
        dimples = ZernikeSensor(self._pupil, *self._relays, extent=1 + 2 * self._margin / self.n_pixels)
        object.__setattr__(self, "_dimples", dimples)

    @classmethod
    def errors(cls) -> tuple[str, ...]:
        """Names of the parameters that are errors: 0 is ideal for each."""
        return tuple(field.name for field in fields(cls) if "error" in field.metadata)

    @classmethod
    def ideal(cls, **changes: Any) -> Bench:
        """A bench without any error or noise, but for the `changes`."""
        perfect: dict[str, Any] = dict.fromkeys(
            (*cls.errors(), "photons_per_image", "read_noise", "background"), 0
        )
        return cls(**{**perfect, **changes})

    def single_errors(self) -> dict[str, Bench]:
        """Benches with each error of this one alone, "none" of them (first), the "noise", and "all" (last)."""
        layout = {field.name: getattr(self, field.name) for field in fields(self) if field.init}
        cases: dict[str, dict[str, float]] = {"none": {}}
        cases |= {name: {name: layout.pop(name)} for name in self.errors()}
        cases["noise"] = {name: layout.pop(name) for name in _NOISE}
        return {name: Bench.ideal(**layout, **case) for name, case in cases.items()} | {"all": self}

    @cached_property
    def segments(self) -> NDArray[np.int64]:
        """Number of the segment seen by each point of the pupil's grid, 0 in gaps and outside, (ny, nx)."""
        return self._pupil.segments

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the segments that can be commanded, in the order of the commands, (n_segments,)."""
        numbers = np.unique(self.segments)
        return numbers[numbers > 0]

    @property
    def n_segments(self) -> int:
        """Number of segments that can be commanded."""
        return len(self.numbers)

    def commanded_phase(self, pistons: ArrayLike) -> NDArray[np.float64]:
        """Phase that segment commands ask for.

        Parameters
        ----------
        pistons : array_like, shape (..., n_segments), radian
            Wavefront piston of each segment in the order of `numbers`.

        Returns
        -------
        ndarray, shape (..., ny, nx), radian
            0 in gaps and outside.
        """
        values = _check.real_array("pistons", pistons).astype(np.float64)
        _check.trailing_shape("pistons", values, (self.n_segments,), "a command for each usable segment")
        if not values.size:
            raise ValueError(f"pistons has shape {values.shape}: expected at least one command")
        _check.finite("pistons", values)
        index = np.searchsorted(self.numbers, self.segments)
        return np.where(self.segments > 0, values[..., np.minimum(index, self.n_segments - 1)], 0.0)

    def frames(self, pistons: ArrayLike | None = None, seed: Seed = None) -> NDArray:
        """Counts of the camera with the mask in.

        Parameters
        ----------
        pistons : as for `commanded_phase`, optional
            Flat if left out.
        seed : int, Generator or SeedSequence, optional
            Of the noise.

        Returns
        -------
        ndarray, shape (..., 2, ny', nx')
            Image of the polarisation that sees +`phase`, then of the other one.
        """
        rng = _check.generator("seed", seed)
        field = self._field * (1.0 if pistons is None else np.exp(1j * self.commanded_phase(pistons)))
        flat = field.reshape(-1, *field.shape[-2:])
        images = np.stack([self._image(single) for single in flat])
        return self._expose(images.reshape(*field.shape[:-2], *images.shape[1:]), rng)

    def clear_frames(self, seed: Seed = None) -> NDArray:
        """Counts of the camera with the mask taken out and a flat command, shape (2, ny', nx')."""
        rng = _check.generator("seed", seed)
        return self._expose(self._image(self._field, clear=True), rng)

    def dark(self, seed: Seed = None) -> NDArray:
        """Counts of the camera without light, shape (2, ny', nx')."""
        return self._expose(np.zeros((2, *self._camera_shape)), _check.generator("seed", seed))

    @cached_property
    def _pupil(self) -> Pupil:
        layout = Pupil.hexagonal(self.n_pixels, self.n_rings, self.gap, self.missing, self.stop)
        return Pupil.from_segments(layout.segments, np.sqrt(1 + self.illumination * layout.x))

    @cached_property
    def _relays(self) -> list[Relay]:
        """Relays of the two images."""
        diameter = self.diameter * (1 + self.dimple_error)
        shift = self.misregistration / 2 / self.n_pixels
        return [Relay(diameter, sign * self.focus_difference / 2, sign * shift) for sign in (1, -1)]

    @property
    def _spill(self) -> int:
        """Pixels beyond the camera whose light the blur moves onto it."""
        return math.ceil(_REACH * self.blur)

    @property
    def _margin(self) -> int:
        return self._spill + round((self.extent - 1) * self.n_pixels / 2)

    @cached_property
    def _field(self) -> NDArray[np.complex128]:
        """Field of the flat command."""
        phase = np.zeros(self._pupil.shape)
        if self.static:
            phase += power_law_screens(zernike_basis(self._pupil, 27), self.static, 1, seed=self.seed)[0]
        if self.quilting:
            x, y = np.meshgrid(self._pupil.x, self._pupil.y)
            phase += self.quilting * (np.cos(2 * np.pi * 22 * x) + np.cos(2 * np.pi * 22 * y))
        return self._pupil.field(phase)

    @property
    def _camera_shape(self) -> tuple[int, int]:
        return (self.n_pixels + 2 * (self._margin - self._spill),) * 2

    def _image(self, field: NDArray[np.complexfloating], *, clear: bool = False) -> NDArray[np.float64]:
        """Intensity on the camera of the two polarisations, (ny, nx) to (2, ny', nx')."""
        size = self.n_pixels + 2 * self._margin
        waves = np.array([relay.direct(field, size, self.n_pixels) for relay in self._relays])
        images = np.abs(waves) ** 2 if clear else self._behind_mask(waves, self._dimples.reference_wave(field))
        blurred = ndimage.gaussian_filter(images, (0, self.blur, self.blur), mode="nearest", truncate=_REACH)
        camera = slice(self._spill, size - self._spill)
        return blurred[:, camera, camera]

    def _behind_mask(self, waves: NDArray, light: NDArray) -> NDArray[np.float64]:
        """Intensity of both images: the light of the dimple is shifted, and joins the waves past it."""
        own, crossed = (
            np.abs(waves + (np.exp(1j * sign * _SIGNS * self.phase) - 1) * light) ** 2 for sign in (1, -1)
        )
        return (1 - self.leakage) * own + self.leakage * crossed

    def _expose(self, images: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        flux = np.array([1 + self.flux_imbalance, 1 - self.flux_imbalance])[:, np.newaxis, np.newaxis]
        if not self.photons_per_image:
            return images * flux
        photons = self.photons_per_image / self._pupil.n_points
        camera = Detector(photons, read_noise=self.read_noise, background=self.background)
        return camera.expose(images * flux, rng)


@dataclass(frozen=True, eq=False)
class BenchModel(Immutable):
    """The sensor as an experimenter models it: clear frames, the design of the mask, Fraunhofer diffraction.

    Make one with `from_images`.

    Attributes
    ----------
    shifted, classic : ZernikeSensor
        The sensor with both masks, and with the first one only.
    segments : ndarray of int, shape (ny, nx)
    numbers : ndarray of int, shape (n_segments,)
    scale : ndarray, shape (2, 1, 1)
        Counts of each image that make an intensity of 1.
    dark : ndarray, shape (2, ny', nx')

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs import PhaseShifted
    >>> from zwfs.bench.model import Bench, BenchModel
    >>> bench = Bench.ideal(n_pixels=40)
    >>> model = BenchModel.from_images(bench, seed=1)
    >>> pistons = np.linspace(-0.5, 0.5, bench.n_segments)
    >>> frames = model.normalise(bench.frames(pistons, seed=2))
    >>> measured = model.pistons(PhaseShifted(model.shifted)(frames).phase)
    >>> float(np.std(measured - pistons)) < 0.05
    True
    """

    shifted: ZernikeSensor
    classic: ZernikeSensor
    segments: NDArray[np.int64]
    numbers: NDArray[np.int64]
    scale: NDArray[np.float64]
    dark: NDArray[np.float64]

    def __post_init__(self) -> None:
        _check.instance("shifted", self.shifted, ZernikeSensor)
        _check.instance("classic", self.classic, ZernikeSensor)
        _check.array_of("segments", self.segments, "integral", self.shifted.pupil.shape)
        _check.array_of("numbers", self.numbers, "integral", ("n_segments",))
        _check.array_of("scale", self.scale, "real floating", (2, 1, 1))
        _check.array_of("dark", self.dark, "real floating", (2, *self.shifted.detector_shape))

    @classmethod
    def from_images(cls, bench: Bench, seed: Seed = None) -> BenchModel:
        """Record clear frames and a dark on a bench, and model the sensor from them.

        The amplitude is the square root of the mean of the two images, each scaled to the same flux. The layout of
        the segments, the dimple's design and its phase shifts are taken as known.

        Parameters
        ----------
        bench : Bench
        seed : int, Generator or SeedSequence, optional
            Of the noise of the images.
        """
        _check.instance("bench", bench, Bench)
        rng = _check.generator("seed", seed)
        dark = bench.dark(rng)
        images = bench.clear_frames(rng) - dark
        ny, nx = bench.segments.shape
        top, side = (images.shape[-2] - ny) // 2, (images.shape[-1] - nx) // 2
        inner = images[:, top : top + ny, side : side + nx]
        # The stop of the bench is known; what is dark within it, gaps and missing segments, the images show.
        light, scale = mean_light(inner, bench.segments > 0)
        stop = radius((ny, nx), ((ny - 1) / 2, (nx - 1) / 2)) <= bench.n_pixels / 2
        pupil = Pupil.from_amplitude(np.where(stop, np.sqrt(light), 0), bench.n_pixels, threshold=0.1)
        unit = scale * np.mean(light[pupil.inside])
        plus, minus = Dimple(bench.diameter, bench.phase), Dimple(bench.diameter, -bench.phase)
        return cls(
            shifted=ZernikeSensor(pupil, plus, minus, extent=bench.extent),
            classic=ZernikeSensor(pupil, plus, extent=bench.extent),
            segments=bench.segments,
            numbers=bench.numbers,
            scale=unit[:, np.newaxis, np.newaxis],
            dark=dark,
        )

    def normalise(self, counts: ArrayLike) -> NDArray[np.float64]:
        """Frames of counts, 1 = mean intensity of the model's pupil; noise makes some of them negative."""
        counts = _check.real_array("counts", counts)
        _check.trailing_shape("counts", counts, self.dark.shape, "the two images of the bench")
        _check.finite("counts", counts)
        return (counts - self.dark) / self.scale

    @cached_property
    def modes(self) -> NDArray[np.float64]:
        """Map of each segment, 1 on it and 0 elsewhere, (n_segments, ny, nx)."""
        return (self.segments == self.numbers[:, np.newaxis, np.newaxis]).astype(float)

    def pistons(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Piston of each segment in a phase: the argument of its mean phasor.

        Parameters
        ----------
        phase : array_like, shape (..., ny, nx), radian
            Points that are NaN, since they are dark to the model, do not count.

        Returns
        -------
        ndarray, shape (..., n_segments), radian

        Raises
        ------
        ValueError
            If no point of a segment is finite.
        """
        return segment_pistons(phase, self.segments, self.numbers)


def segment_screens(
    bench: Bench, rms: float, n_screens: int, exponent: float = -2.0, seed: Seed = None
) -> NDArray[np.float64]:
    """Random segment commands: power-law screens averaged over each segment.

    Parameters
    ----------
    bench : Bench
        Its layout is used, nothing else.
    rms : float, radian
        Every screen is scaled to exactly this rms over the segments, piston removed.
    n_screens : int
    exponent : float
        Exponent of the power spectral density, see `power_law_screens`.
    seed : int, Generator or SeedSequence, optional

    Returns
    -------
    ndarray, shape (n_screens, n_segments), radian

    Raises
    ------
    ValueError
        If the bench has a single segment, or fewer points than the modes that the screens are made of.

    References
    ----------
    Chambouleyron et al. 2024, section 5.2.

    Examples
    --------
    >>> from zwfs.bench.model import Bench, segment_screens
    >>> segment_screens(Bench(n_pixels=40), rms=0.5, n_screens=3, seed=1).shape
    (3, 36)
    """
    _check.instance("bench", bench, Bench)
    if bench.n_segments < 2:
        raise ValueError(f"bench has {bench.n_segments} segment: expected two or more, which differ in piston")
    rms = _check.number("rms", rms, 0)
    layout = Pupil.circular(bench.n_pixels)
    if layout.n_points <= _N_MODES:
        raise ValueError(f"bench has n_pixels = {bench.n_pixels}: expected enough points for {_N_MODES} modes")
    screens = power_law_screens(zernike_basis(layout, _N_MODES), 1.0, n_screens, exponent, seed)
    flat = screens.reshape(len(screens), -1)
    members = bench.segments.ravel() == bench.numbers[:, np.newaxis]
    pistons = flat @ (members / members.sum(axis=1, keepdims=True)).T
    pistons -= pistons.mean(axis=1, keepdims=True)
    return pistons * (rms / pistons.std(axis=1, keepdims=True))


def segment_pistons(phase: ArrayLike, segments: NDArray, numbers: NDArray) -> NDArray[np.float64]:
    """Piston of each segment in a phase, see `BenchModel.pistons`: on a map of segment numbers (ny, nx)."""
    phase = _check.real_array("phase", phase)
    segments = _check.integer_array("segments", segments)
    if segments.ndim != 2:
        raise ValueError(f"segments has shape {segments.shape}: expected (ny, nx)")
    numbers = _check.integer_array("numbers", numbers)
    if numbers.ndim != 1 or not numbers.size:
        raise ValueError(f"numbers has shape {numbers.shape}: expected (n_segments,), at least one")
    _check.maps("phase", phase, segments.shape, "the grid of the segments")
    on_segment = segments.ravel() > 0
    flat = phase.reshape(*phase.shape[:-2], -1)[..., on_segment]
    members = (segments.ravel()[on_segment] == numbers[:, np.newaxis]).astype(float)
    sums = np.where(np.isfinite(flat), np.exp(1j * np.nan_to_num(flat)), 0) @ members.T
    if not np.all(np.abs(sums) > 0):
        raise ValueError(
            "phase is NaN all over a segment, or segments lacks one of numbers: expected finite values"
        )
    return np.angle(sums)


def segment_residual(pistons: ArrayLike, commanded: ArrayLike) -> NDArray[np.float64]:
    """Difference of segment pistons on the circle, without their common piston.

    Parameters
    ----------
    pistons, commanded : array_like, shapes (..., n_segments) that broadcast, radian

    Returns
    -------
    ndarray, shape (..., n_segments), radian
        In (-pi, pi].
    """
    pistons, commanded = _check.real_array("pistons", pistons), _check.real_array("commanded", commanded)
    shape = _check.broadcast(pistons=pistons, commanded=commanded)
    if not shape or 0 in shape:
        raise ValueError(f"pistons and commanded have shape {shape}: expected (..., n_segments), at least one")
    _check.finite("pistons", pistons)
    _check.finite("commanded", commanded)
    return without_piston(pistons - commanded)
