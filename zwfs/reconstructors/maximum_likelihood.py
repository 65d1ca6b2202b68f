"""Maximum-likelihood reconstruction with error bars. It is not in the paper."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, read_only
from zwfs._information import Response
from zwfs._likelihood import Estimator, Noise, require_information, require_one_wavelength
from zwfs._propagator import Propagator, angle, split, square
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors._descent import Descent
from zwfs.reconstructors._fit import Fit
from zwfs.reconstructors._unknowns import BandPoints, Modes, Points, PointsAndAmplitude
from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.base import FixedPoint, Reconstruction, Reconstructor, Solution, pieces
from zwfs.reconstructors.phase_shifted import PhaseShifted
from zwfs.sensor import ZernikeSensor

_COARSE = 1e-2  # error of the responses in the Hessian; gradient and cost are those of the sensor
_FIRST_ITERATIONS = 2  # of the first start; more of them help small dimples and harm large ones
_KICK, _SHIFT = 1.0, 0.5  # radian rms, random phases of the other starts
_KICK_MODES = 20


@dataclass(frozen=True, eq=False, repr=False)
class LikelihoodReconstruction(Reconstruction):
    """Result of `MaximumLikelihood`: a `Reconstruction` with error bars; `...` is the batch of the frames.

    Attributes
    ----------
    amplitude : ndarray, shape (..., ny, nx), or None
        Estimated amplitude, NaN outside the pupil; None if it was known.
    coefficients : ndarray, shape (..., n_modes), radian, or None
        Estimated coefficients of the modes, if there are any.
    chi2 : ndarray, shape (...)
        Reduced chi-square: about 1 where the model explains the frames. NaN without a number of photons, and where
        the frames have no more information than there are unknowns, as for one mask.
    explained : ndarray of bool, shape (...)
        Whether the noise explains the misfit of the frames on the whole detector, see `consistent`.
    n_starts : ndarray of int, shape (...)
        Number of starts that were tried.
    estimator : Estimator
        Unknowns and noise, from which `sigma` is computed.
    """

    amplitude: NDArray[np.floating] | None
    coefficients: NDArray[np.floating] | None
    chi2: NDArray[np.floating]
    explained: NDArray[np.bool_]
    n_starts: NDArray[np.int64]
    noise_variance: NDArray[np.floating]
    estimator: Estimator

    def __post_init__(self) -> None:
        super().__post_init__()
        _check.instance("estimator", self.estimator, Estimator)
        batch = tuple(self.converged.shape)
        if self.amplitude is not None:
            _check.array_of("amplitude", self.amplitude, "real floating", tuple(self.phase.shape))
        if self.coefficients is not None:
            _check.array_of("coefficients", self.coefficients, "real floating", (*batch, "n_modes"))
        _check.array_of("chi2", self.chi2, "real floating", batch)
        _check.array_of("explained", self.explained, "bool", batch)
        _check.array_of("n_starts", self.n_starts, "integral", batch)
        _check.array_of("noise_variance", self.noise_variance, "real floating", batch)

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Whether the fit converged and explains the frames to within its noise, shape (...).

        See `Reconstruction.explains`. The expected misfit is that of frames to which so many unknowns were fitted,
        and all pixels of the detector count. For one mask many phases explain a frame.
        """
        return self.converged & self.explained

    @property
    def sigma(self) -> NDArray[np.floating]:
        """Standard error of the phase, shape (..., ny, nx), radian, NaN outside the pupil.

        From the Fisher information at the estimate, computed at the first use. It is that of the phase without its
        piston. Directions that the frames hardly show make it large.
        """
        return self._errors[0][..., 0, :, :]

    @property
    def sigma_amplitude(self) -> NDArray[np.floating] | None:
        """Standard error of the amplitude, shape (..., ny, nx); None if the amplitude was known."""
        return None if self.amplitude is None else self._errors[0][..., 1, :, :]

    @property
    def sigma_coefficients(self) -> NDArray[np.floating] | None:
        """Standard error of the coefficients, shape (..., n_modes), radian; None without modes."""
        return self._errors[1]

    @cached_property
    def _errors(self) -> tuple[NDArray[np.floating], NDArray[np.floating] | None]:
        kind = Kind.of(self.phase)
        double = kind._replace(dtype=kind.xp.float64)
        model, xp = self.settings.model(double), kind.xp
        batch = tuple(self.converged.shape)
        points, coefficients = [], []
        for psi in self._fields(model):  # one at a time: the memory does not grow with the batch
            of_points, of_modes = self.estimator.variance(psi, model.propagate(psi))
            points.append(of_points)
            coefficients.append(of_modes)
        scale = xp.reshape(self.noise_variance, (-1, 1))
        sigma = xp.sqrt(xp.concat(points) * scale[..., np.newaxis, np.newaxis]) + model.no_data
        sigma = xp.reshape(xp.astype(sigma, kind.dtype), (*batch, *sigma.shape[1:]))
        if self.coefficients is None:
            return sigma, None
        of_modes = xp.astype(xp.sqrt(xp.concat(coefficients) * scale), kind.dtype)
        return sigma, xp.reshape(of_modes, (*batch, of_modes.shape[1]))

    def _fields(self, model: Propagator) -> Iterator[NDArray[np.floating]]:
        """Estimated field of each frame set, split, (1, 2 n_wavelengths, ny, nx)."""
        if self.amplitude is None:
            yield from super()._fields(model)
            return
        maps = (self._singles(batch, model) for batch in (self.phase, self.amplitude))
        for phase, amplitude in zip(*maps, strict=True):
            yield split(phase, amplitude)


class MaximumLikelihood(Reconstructor):
    """Phase that makes the measured frames most likely, with its standard error at every point.

    Levenberg-Marquardt steps on the phase of every point of the pupil. The Hessian is the Fisher information: a
    diagonal plus a matrix of low rank, which Woodbury's identity inverts (`eq-woodbury`). The first start is two
    accelerated iterations of `PhaseShifted`, or of `Arcsine` for one mask. With modes, it is their fit to the most
    likely phase of every point (`eq-unwrap`). Where a solution does not explain the frames, other starts follow:
    in turn, the best solution so far plus a random phase of 1 rad rms, made of the 20 lowest Zernike modes, and
    two iterations that begin at half such a phase. The most likely solution counts.

    Some directions are invisible or nearly so. No frame shows the piston: each step keeps it, and `sigma` is that
    of the phase without piston. A dimple near 2.44 lambda/D hardly shows small tilts. A single mask hardly shows
    phases at which its intensity is extreme. The damping holds such directions, and `sigma` reports a large error.

    With a `PolychromaticSensor` the phase is that at its reference wavelength, and is not wrapped. The first
    iterations ignore the bandwidth. Their phase is unwrapped about a smooth one, since the frames hardly show
    multiples of 2 pi.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
        With any number of masks.
    modes : array_like, shape (n_modes, ny, nx), optional
        Modes whose coefficients are estimated; the phases of all points if left out.
    photons : float, optional
        Photons per pupil point and image, `Detector.photons`. If left out,
        all pixels have the same weight, and `sigma` follows from the residual of the frames.
    read_noise : float, electrons rms / pixel
        That of the frames, with the noise of a background that was subtracted.
    prior : array_like, shape (n_modes, n_modes), radian^2, optional
        Covariance of the coefficients before the measurement, of mean 0. The estimate then is the most probable
        one, not the most likely (maximum a posteriori).
    amplitude : array_like, shape (ny, nx), or "unknown", optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out. If unknown, the amplitude of
        every point is estimated, too. This takes three different masks or more; a clear frame is that of a mask
        that changes nothing, such as `Dimple(1, 0)`; and one wavelength.
    n_iterations : int
        Largest number of steps from one start.
    tolerance : float, radian
        A step that changes the phase by no more than this (rms over the pupil) is the last one. Near the solution
        each step is about 100 times smaller than the one before. With a number of photons, a step of less than a
        thousandth of the standard error is the last one, too.
    n_starts : int
        Largest number of starts. Frames that no phase explains, such as noisy ones without a number of photons,
        use all of them: set 1 for those.
    seed : int
        Of the random phases of the other starts.

    Raises
    ------
    ValueError
        If there is read noise or a prior without a number of photons, or a prior without modes, or if the masks do
        not determine the unknowns.

    References
    ----------
    Levenberg 1944; Marquardt 1963; Paxman, Schulz & Fienup 1992; Nielsen 1999; `eq-likelihood` to
    `eq-unwrap` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> masks = [zwfs.Dimple(2.4, phase * np.pi) for phase in (0.30, -0.68)]
    >>> sensor = zwfs.ZernikeSensor(pupil, *masks)
    >>> phase = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 50), rms=0.5, n_screens=1, exponent=-2, seed=1)[0]
    >>> result = zwfs.MaximumLikelihood(sensor)(sensor.measure(phase))
    >>> bool(result.consistent), bool(zwfs.reconstruction_error(pupil, result.phase, phase) < 1e-6)
    (True, True)
    """

    any_library = True
    polychromatic = True

    def __init__(
        self,
        sensor: ZernikeSensor | PolychromaticSensor,
        modes: ArrayLike | None = None,
        *,
        photons: float | None = None,
        read_noise: float = 0.0,
        prior: ArrayLike | None = None,
        amplitude: ArrayLike | str | None = None,
        n_iterations: int = 50,
        tolerance: float = 1e-5,
        n_starts: int = 8,
        seed: int = 0,
    ) -> None:
        if isinstance(amplitude, str) and amplitude != "unknown":
            raise ValueError(f"amplitude = {_check.shown(amplitude)}: expected an array or 'unknown'")
        unknown = isinstance(amplitude, str)
        measured = None if isinstance(amplitude, str) else amplitude
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=measured)
        noise = Noise.checked(photons, read_noise, sensor.recorded)
        n_starts = _check.integer("n_starts", n_starts, 1, 1000)
        seed = _check.integer("seed", seed, 0)
        if unknown and modes is not None:
            raise ValueError(
                "amplitude = 'unknown': expected a known one with modes, which describe the phase only"
            )
        if unknown:
            require_one_wavelength(sensor)
        require_information(sensor, unknown)
        pupil = sensor.pupil
        # A prior decides between modes that the frames do not tell apart.
        values = None if modes is None else _check.modes("modes", modes, pupil, distinct=prior is None)
        basis = None if values is None else read_only(pupil.scatter(values, fill=0))
        precision = _precision(prior, values, noise)
        self._estimator = Estimator(Response.of(sensor), noise, unknown, basis, precision)
        self._unknowns = _unknowns(sensor, basis, precision, unknown)
        rough = sensor.with_tolerance(max(_COARSE, sensor.tolerance))
        self._descent = Descent(self.settings, self._unknowns, noise, Response.of(rough))
        self._first = self._first_method()
        self._points: MaximumLikelihood | None = None
        if basis is not None:  # the start does not depend on how the fit of the modes stops
            self._points = MaximumLikelihood(
                sensor, photons=photons, read_noise=read_noise, amplitude=measured, n_starts=n_starts, seed=seed
            )
        n_low = min(_KICK_MODES, pupil.n_points - 1)
        self._kicks: NDArray[np.float64] = np.zeros((0, *pupil.shape))
        if n_starts > 1 and n_low:
            low = zernike_basis(pupil, n_low)
            kicks = power_law_screens(low, rms=_KICK, n_screens=n_starts - 1, exponent=-2, seed=seed)
            self._kicks = read_only(np.where(pupil.inside, kicks, 0))

    @property
    def n_starts(self) -> int:
        """Largest number of starts."""
        return 1 + len(self._kicks)

    def __call__(
        self, frames: ArrayLike, start: ArrayLike | None = None, *, history: bool = False
    ) -> LikelihoodReconstruction:
        """Reconstruct the phase of each frame set: parameters and errors are those of `Reconstructor`."""
        frames, batch, start = self.accept(frames, start)
        fit = self._fit(frames, start, _check.flag("history", history))
        kind, result = Kind.of(frames), vars(self.report(frames, batch, self._solution(fit, Kind.of(frames))))

        def shaped(values: NDArray) -> NDArray:
            return kind.xp.reshape(values, (*batch, *values.shape[1:]))

        amplitude, coefficients, misfit = None, fit.coefficients, self._descent.misfit
        if self._estimator.unknown_amplitude:
            amplitude = shaped(kind.xp.astype(kind.xp.sqrt(square(fit.psi)), kind.dtype))
            amplitude += self.settings.model(kind).no_data
        if coefficients is not None:
            coefficients = shaped(kind.xp.astype(coefficients, kind.dtype))
        return LikelihoodReconstruction(
            **result,
            amplitude=amplitude,
            coefficients=coefficients,
            chi2=shaped(misfit.chi2(fit)),
            explained=shaped(misfit.explained(fit)),
            n_starts=shaped(fit.n_starts),
            noise_variance=shaped(misfit.noise_variance(fit)),
            estimator=self._estimator,
        )

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Return the phase that makes the frames most likely."""
        return self._solution(self._fit(frames, start, history), Kind.of(frames))

    def _solution(self, fit: Fit, kind: Kind) -> Solution:
        xp, history = kind.xp, fit.history
        phase = xp.astype(self._unknowns.phase(fit) if history is None else history[:, -1, ...], kind.dtype)
        history = None if history is None else xp.astype(history, kind.dtype)
        return Solution(phase, fit.n_iterations, fit.converged, xp.zeros_like(fit.n_iterations), history)

    def _fit(self, frames: NDArray, start: NDArray | None, history: bool) -> Fit:
        """Fit all frame sets, in double precision."""
        kind = Kind.of(frames)
        frames = kind.xp.astype(frames, kind.xp.float64)
        start = None if start is None else kind.xp.astype(start, kind.xp.float64)
        fits = [
            self._search(frames[piece, ...], None if start is None else start[piece, ...], history)
            for piece in pieces(frames, kind, 1 if history else None)
        ]
        return Fit.joined(fits, kind.xp)

    def _search(self, frames: NDArray, start: NDArray | None, history: bool) -> Fit:
        """Fit from start after start, until every frame set is explained or the starts are used up."""
        kind = Kind.of(frames)
        xp, explained = kind.xp, self._descent.misfit.explained
        first, quick = (start, None) if start is not None else self._first_phase(frames)
        fit = self._descent.run(frames, first, history)
        if fit.history is not None and start is not None:
            fit.history[:, 0, ...] = start  # as it was given: modes may not represent it
        if quick is not None and xp.any(poor := quick & ~explained(fit)):
            best = fit.at(poor)
            trial = self._descent.run(best.frames, self._phase_of_points(best.frames), history)
            best.take(trial.cost < best.cost, trial, xp)
            fit.put(poor, best)
        for attempt in range(1, self.n_starts):
            poor = ~explained(fit)
            if not xp.any(poor):
                break
            best = fit.at(poor)
            trial = self._descent.run(best.frames, self._next_start(attempt, best), history)
            n_starts = best.n_starts + 1
            best.take(trial.cost < best.cost, trial, xp)
            best.n_starts = n_starts
            fit.put(poor, best)
        return fit

    def _first_phase(self, frames: NDArray) -> tuple[NDArray, NDArray[np.bool_] | None]:
        """Phase of the first start, (k, ny, nx), and with modes, where it is a fit to the first iterations, (k,).

        Where every point of the first iterations is near the fit, none is a multiple of 2 pi off.
        """
        rough, unknowns, kind = self._rough_phase(frames, None), self._unknowns, Kind.of(frames)
        if not isinstance(unknowns, Modes):
            return rough, None
        coefficients, near = unknowns.unwrapping.direct(rough, kind)
        start = unknowns.sum(coefficients)
        if not kind.xp.all(near):
            start[~near] = self._phase_of_points(frames[~near])
        return start, near

    def _phase_of_points(self, frames: NDArray) -> NDArray:
        """Fit of the modes to the most likely phase of every point, (k, ny, nx)."""
        assert self._points is not None
        assert isinstance(self._unknowns, Modes)
        points, unknowns = self._points, self._unknowns
        fit = points._search(frames, None, False)
        phase, sigma = points._unknowns.phase(fit), points._sigma(fit)
        return unknowns.sum(unknowns.unwrapping.fit(phase, Kind.of(frames), sigma))

    def _sigma(self, fit: Fit) -> NDArray:
        """Standard error of the phase of every point, (k, ny, nx)."""
        xp = Kind.of(fit.psi).xp
        singles = (slice(i, i + 1) for i in range(fit.psi.shape[0]))  # one at a time, for the memory
        variance = [self._estimator.variance(fit.psi[i, ...], fit.waves[i, ...])[0][:, 0, ...] for i in singles]
        scale = self._descent.misfit.noise_variance(fit)
        return xp.sqrt(xp.concat(variance) * scale[:, np.newaxis, np.newaxis])

    def _rough_phase(self, frames: NDArray, start: NDArray | None) -> NDArray:
        """Phase after the first iterations, (k, ny, nx)."""
        if self._first is not None:
            return self._unknowns.unwrapped(self._first.solve(frames, start, False).phase)
        return Kind.of(frames).zeros(frames.shape[0], *self.sensor.pupil.shape) if start is None else start

    def _next_start(self, attempt: int, fit: Fit) -> NDArray:
        """Phase from which the next attempt begins, (k, ny, nx); it depends on no other frame set."""
        kind = Kind.of(fit.psi)
        kick = kind.array(self._kicks[attempt - 1])
        if attempt % 2:
            return (angle(fit.psi, kind.xp) if fit.phase is None else fit.phase) + kick
        shift = kind.zeros(fit.psi.shape[0], 1, 1) + _SHIFT * kick
        return self._rough_phase(fit.frames, shift)

    def _first_method(self) -> FixedPoint | None:
        """Method of the first iterations; None for masks that no iteration of this package handles."""
        sensor = self.sensor.reference if isinstance(self.sensor, PolychromaticSensor) else self.sensor
        method, options = (PhaseShifted, {"accelerate": True}) if sensor.n_masks > 1 else (Arcsine, {})
        try:
            return method(
                sensor,
                n_iterations=_FIRST_ITERATIONS,
                tolerance=0,
                amplitude=self.settings.amplitude,
                **options,
            )
        except ValueError:  # such as the same mask twice, which still determines a phase as one mask does
            return None


def _unknowns(
    sensor: ZernikeSensor | PolychromaticSensor,
    modes: NDArray[np.float64] | None,
    precision: NDArray[np.float64] | None,
    unknown_amplitude: bool,
) -> Points:
    """Kind of the unknowns of a fit."""
    pupil = sensor.pupil
    if modes is not None:
        return Modes(pupil.inside, modes, precision)
    if unknown_amplitude:
        return PointsAndAmplitude(pupil.n_points)
    return BandPoints(pupil) if isinstance(sensor, PolychromaticSensor) else Points(pupil.n_points)


def _precision(prior: ArrayLike | None, modes: NDArray | None, noise: Noise) -> NDArray[np.float64] | None:
    """Inverse of the checked covariance of the coefficients."""
    if prior is None:
        return None
    if modes is None:
        raise ValueError("prior: expected None without modes, whose covariance it is")
    if noise.photons is None:
        raise ValueError("prior: expected a number of photons, which weighs the frames against the prior")
    covariance = _check.real_map("prior", prior)
    if covariance.shape != 2 * (len(modes),):
        raise ValueError(f"prior has shape {covariance.shape}: expected {2 * (len(modes),)}, that of the modes")
    if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=0):
        raise ValueError("prior is not symmetric: expected a covariance")
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    if not values[0] > 1e-14 * values[-1]:
        raise ValueError(
            f"prior has eigenvalues from {values[0]:.3g} to {values[-1]:.3g}: expected a positive definite matrix"
        )
    return read_only((vectors / values) @ vectors.T)
