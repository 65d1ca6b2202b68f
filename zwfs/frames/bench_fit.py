"""Model of a bench: optics from frames of a mirror in known states, and phases of other frames with them.

`fit_bench` sets up the joint fit of `zwfs.frames.joint` for a camera behind two masks. `FittedSensor` keeps all
that was fitted, and seeks only the phase of a pair of frames.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.frames.joint import JointFit, JointProblem, MapPrior, fit_jointly
from zwfs.frames.optics_model import Arm, MaskPair, Parameter, Picture
from zwfs.frames.registration import radius
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

_RELAY = "focus", "astigmatism", "astigmatism_45"
_FARTHEST = 3e-3  # D^2 / lambda: with more defocus the model's grid would be too small
_ROUNDS = 4  # of a fit for small changes of the phase, which must not change the amplitude
_FEW = 3  # states in the first steps of a fit
_WIDE = MapPrior(0.5, 1.0)
_DARKEST = 1e-2  # of the mean intensity: where the amplitude starts in gaps and beyond the outline


def fit_bench(
    frames: ArrayLike,
    clear_frames: ArrayLike,
    known: ArrayLike,
    *,
    n_pixels: float,
    mask: MaskPair | None = None,
    noise: float = 0.0,
    gain: float = 1.0,
    phase_prior: MapPrior | None = None,
    amplitude_prior: MapPrior | None = None,
    **settings: Any,
) -> JointFit:
    """Fit a model of the optics to frames of a mirror in known states, and to clear frames.

    Each of the four images has its own focus, astigmatism, shift, flux and background. The plane and the place of
    the maps are those of the known phases, so they need more than one state. The flux of the first clear frame is
    fixed: it defines an amplitude of 1.

    Parameters
    ----------
    frames : array_like, shape (n_states, 2, ny, nx), counts
        Less the dark.
    clear_frames : array_like, shape (2, ny', nx'), counts
        Less the dark, with the mask out.
    known : array_like, shape (n_states, n, n), radian
        Phases that the commands add, on the grid of the pupil.
    n_pixels : float, pixels
        Diameter D.
    mask : MaskPair, optional
        Start of the masks; by default those of the paper, with diameter, phase shifts, leakage and blur free.
    noise : float, counts rms
        Of a pixel without light: read noise, and that of the background and the dark.
    gain : float, electrons / count
        For the photon noise.
    phase_prior, amplitude_prior : MapPrior, optional
        Of the maps; wide by default.
    **settings
        Of `fit_jointly`.

    Returns
    -------
    JointFit

    Raises
    ------
    ValueError
        If a clear frame holds no light.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis
    >>> from zwfs.frames.bench_fit import FittedSensor, fit_bench
    >>> from zwfs.frames.joint import MapPrior
    >>> from zwfs.frames.optics_model import MaskPair, Parameter
    >>> pupil = Pupil.circular(12)
    >>> sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1.5)
    >>> known = 0.4 * np.stack([0 * pupil.amplitude, zernike_basis(pupil, 3)[2]])
    >>> clear = np.stack([np.pad(pupil.amplitude**2, 3)] * 2)
    >>> settings = {"amplitude_prior": MapPrior(0.05), "n_steps": 2, "n_inner": 10, "errors": False}
    >>> mask = MaskPair(diameter=Parameter.fitted(1.0))
    >>> fit = fit_bench(sensor.measure(known), clear, known, n_pixels=12, mask=mask, noise=0.02, **settings)
    >>> round(fit.mask.diameter, 2)
    1.06
    >>> phase = 0.3 * zernike_basis(pupil, 5)[0]
    >>> error = FittedSensor(fit, n_steps=1)(sensor.measure(phase), 0.02) - phase
    >>> bool(error[pupil.inside].std() < 0.01)
    True
    """
    frames, clear = _check.real_map("frames", frames, 4), _check.real_map("clear_frames", clear_frames, 3)
    known = _check.real_map("known", known, 3)
    for name, array in (("frames", frames[0]), ("clear_frames", clear)):
        if len(array) != 2:
            raise ValueError(f"{name} has {len(array)} images: expected 2")
    if len(known) != len(frames) or known.shape[1] != known.shape[2]:
        raise ValueError(f"known has shape {known.shape}: expected ({len(frames)}, n, n), a phase for each state")
    if len(known) < 2:
        raise ValueError(
            "known holds 1 state: expected two or more, which fix the place and the plane of the maps"
        )
    noise, gain = _check.number("noise", noise, 0), _check.number("gain", gain, 0, open_low=True)
    n = known.shape[-1]
    stop = radius((n, n), ((n - 1) / 2,) * 2) <= n_pixels / 2
    rows, columns = ((length - n) // 2 for length in clear.shape[1:])
    if min(rows, columns) < 0:
        raise ValueError(f"clear_frames has shape {clear.shape}: expected at least the {n} pixels of known")
    inner = clear[:, rows : rows + n, columns : columns + n]
    flux = inner[:, stop].mean(axis=1)
    if np.any(flux <= 0):
        raise ValueError(f"clear_frames hold {flux} counts on average in the pupil: expected light")

    def picture(counts: NDArray, arm: int, side: int | None, phase: NDArray | None = None) -> Picture:
        sigma = np.sqrt(np.maximum(counts, 0) / gain + noise**2 + 1e-12 * flux[0] ** 2)
        return Picture(counts, arm, side, sigma, known=phase)

    pictures = [picture(clear[side], 2 + side, None) for side in (0, 1)]
    for pair, phase in zip(frames, known, strict=True):
        pictures += [picture(pair[side], side, side, phase) for side in (0, 1)]
    arms = [free_arm(flux[0]), free_arm(flux[1]), free_arm(flux[0], fixed_flux=True), free_arm(flux[1])]
    lit = np.maximum((inner / flux[:, None, None]).mean(axis=0), _DARKEST)
    problem = JointProblem(
        pictures,
        arms,
        free_masks() if mask is None else mask,
        np.sqrt(lit) * stop,
        n_pixels,
        phase_prior or _WIDE,
        amplitude_prior or MapPrior(0.5, 0.0),
    )
    # Before the maps are about right, clear frames are explained by any focus: it waits. The first states suffice.
    still = [replace(arm, **{name: replace(getattr(arm, name), free=False) for name in _RELAY}) for arm in arms]
    rough = replace(problem, pictures=pictures[: 2 + 2 * _FEW])
    quick = {**settings, "errors": False}
    fit = fit_jointly(replace(rough, arms=still), **{**quick, "n_inner": 15, "tolerance": 0.02})
    fit = fit_jointly(rough, start=fit, **{**quick, "n_inner": 20, "tolerance": 2e-3})
    return fit_jointly(problem, start=fit, **settings)


def free_arm(flux: float, *, fixed_flux: bool = False) -> Arm:
    """Arm with focus, astigmatism, shift, flux and background free, rotation and magnification fixed.

    Examples
    --------
    >>> from zwfs.frames.bench_fit import free_arm
    >>> arm = free_arm(2000.0)
    >>> arm.focus.free, arm.rotation.free, arm.flux.value
    (True, False, 2000.0)
    """
    flux = _check.number("flux", float(flux), 0, open_low=True)
    focus, shift = Parameter.fitted(0.0, -_FARTHEST, _FARTHEST), Parameter.fitted(0.0, -5.0, 5.0)
    return Arm(
        focus=focus,
        astigmatism=focus,
        astigmatism_45=focus,
        row=shift,
        column=shift,
        flux=Parameter(flux, not fixed_flux, low=0.0),
        background=Parameter.fitted(0.0),
    )


def free_masks(diameter: float = 1.06, first: float = np.pi / 2, second: float = -np.pi / 2) -> MaskPair:
    """Masks with diameter, phase shifts, leakage and blur free; they start at the design.

    Examples
    --------
    >>> from zwfs.frames.bench_fit import free_masks
    >>> mask = free_masks(diameter=1.06)
    >>> mask.diameter.free, mask.diameter.low, mask.diameter.high
    (True, 0.53, 1.59)
    """
    diameter = _check.number("diameter", diameter, 0, open_low=True)

    def shift(name: str, value: float) -> Parameter:
        value = _check.radian(name, value)
        low, high = (0.05, 2 * np.pi - 0.05) if value > 0 else (0.05 - 2 * np.pi, -0.05)
        return Parameter.fitted(value, low, high)

    return MaskPair(
        diameter=Parameter.fitted(diameter, 0.5 * diameter, 1.5 * diameter),
        first=shift("first", first),
        second=shift("second", second),
        leakage=Parameter.fitted(0.01, 0.0, 0.5),
        blur=Parameter.fitted(0.5, 0.05, 5.0),
    )


@dataclass(frozen=True, eq=False)
class FittedSensor:
    """A sensor whose optics are those of a fit: pairs of frames in, phases out.

    The phase-shifted iteration with the fitted mask and amplitude gives a start. Then the phase alone is fitted
    with all of the model: relay, blur, leakage.

    Parameters
    ----------
    fit : JointFit
        Such as `fit_bench` returns: the arms 0 and 1 are those of the two masks.
    prior : MapPrior
        Of the phase, less that of the start.
    n_steps : int
        Of each of the four rounds of the fit of a pair, at most.
    """

    fit: JointFit
    prior: MapPrior = _WIDE
    n_steps: int = 4

    def __post_init__(self) -> None:
        _check.instance("fit", self.fit, JointFit)
        _check.instance("prior", self.prior, MapPrior)
        _check.integer("n_steps", self.n_steps, 1)

    @property
    def flat(self) -> NDArray[np.float64]:
        """Phase of the optics at a flat command, (n, n)."""
        return self.fit.phase

    def __call__(self, frames: ArrayLike, sigma: ArrayLike) -> NDArray[np.float64]:
        """Phase of one pair of frames.

        Parameters
        ----------
        frames : array_like, shape (2, ny, nx), counts
            Less the dark.
        sigma : array_like, shape (2, ny, nx) or a number, counts rms
            Noise of the pixels.

        Returns
        -------
        ndarray, shape (n, n), radian
            That of the optics included; 0 where no light comes through.
        """
        frames = _check.real_map("frames", frames, 3)
        if len(frames) != 2:
            raise ValueError(f"frames has {len(frames)} images: expected 2")
        sigma = np.broadcast_to(_check.real_array("sigma", sigma), frames.shape)
        problem, phase = self._problem(frames, sigma), self._start(frames)
        for _ in range(_ROUNDS):
            problem = replace(problem, phase=phase)
            phase = fit_jointly(problem, n_steps=self.n_steps, n_inner=30, errors=False).phase
        return phase

    def frames(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Frames that the model predicts for a phase.

        Parameters
        ----------
        phase : array_like, shape (n, n), radian
            That of the optics included.

        Returns
        -------
        ndarray, shape (2, ny, nx), counts
        """
        phase = _check.real_map("phase", phase, 2)
        _check.trailing_shape("phase", phase, self.flat.shape, "the grid of the pupil")
        camera = next(picture.counts for picture in self.fit.problem.pictures if picture.mask is not None)
        blank = np.zeros((2, *camera.shape))
        problem = self._problem(blank, np.ones(blank.shape))
        field = (problem.amplitude * np.exp(1j * phase)).astype(complex)
        return np.stack(problem.forward.at(field, problem.values).images)

    def _problem(self, frames: NDArray, sigma: NDArray) -> JointProblem:
        """The problem of the phase alone of a pair of frames."""
        fit = self.fit
        return JointProblem(
            [Picture(frames[side], side, side, sigma[side]) for side in (0, 1)],
            [_frozen(arm, values) for arm, values in zip(fit.problem.arms[:2], fit.arms[:2], strict=True)],
            _frozen(fit.problem.mask, fit.mask),
            np.maximum(fit.amplitude, 1e-6) * fit.problem.inside,
            fit.problem.n_pixels,
            self.prior,
            MapPrior(1e-6),
        )

    def _start(self, frames: NDArray) -> NDArray[np.float64]:
        """Phase of the phase-shifted iteration, for which the light is unmixed and the images are shifted back."""
        fit, mask = self.fit, self.fit.mask
        pupil = Pupil.from_amplitude(np.maximum(fit.amplitude, 0), fit.problem.n_pixels, threshold=0.1)
        sensor = ZernikeSensor(pupil, Dimple(mask.diameter, mask.first), Dimple(mask.diameter, mask.second))
        n = len(fit.amplitude)
        power = np.mean(fit.amplitude[pupil.inside] ** 2)
        light = np.empty((2, n, n))
        for side, arm in enumerate(fit.arms[:2]):
            image = (frames[side] - arm.background) / (arm.flux * power)
            rows, columns = ((length - n) // 2 for length in image.shape)
            v, u = (np.fft.fftfreq(length) for length in image.shape)
            ramp = np.exp(2j * np.pi * (v[:, None] * arm.row + u * arm.column))
            light[side] = np.fft.ifft2(np.fft.fft2(image) * ramp).real[rows : rows + n, columns : columns + n]
        leaked = min(mask.leakage, 0.4)  # half of the light cannot be unmixed
        light = ((1 - leaked) * light - leaked * light[::-1]) / (1 - 2 * leaked)
        phase = PhaseShifted(sensor, tolerance=1e-3)(np.maximum(light, 0)).phase
        # Dim points hardly change the frames, so they keep the phase that explained the frames of the calibration.
        waves = np.exp(1j * np.stack([np.where(np.isfinite(phase), phase, 0), self.flat]))
        turns = np.mean(waves[:, pupil.inside], axis=1)[:, np.newaxis, np.newaxis]
        measured, flat = np.angle(waves * turns.conj())
        return np.where(pupil.inside, measured, flat)


def _frozen(owner: Any, values: Any) -> Any:
    """An `Arm` or `MaskPair` fixed at values."""
    return replace(owner, **{one.name: Parameter(getattr(values, one.name)) for one in fields(owner)})
