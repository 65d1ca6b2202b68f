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
from zwfs._likelihood import Estimator, Noise, require_information, require_one_wavelength, tangents
from zwfs._propagator import Propagator, angle, parts_sum, split, square
from zwfs.modes import power_law_screens, zernike_basis
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors._fit import Fit, Hessian, Unwrapping, linear_field, points_step, reflected, turned
from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.base import FixedPoint, Reconstruction, Reconstructor, Solution, pieces
from zwfs.reconstructors.phase_shifted import PhaseShifted
from zwfs.sensor import ZernikeSensor

_COARSE = 1e-2  # error of the responses in the Hessian; gradient and cost are those of the sensor
_FIRST_ITERATIONS = 2  # of the first start; more of them help small dimples and harm large ones
_DAMPING = 1e-3  # of the first step, relative to the mean of the information's diagonal
_LEAST_CUT = 0.1  # of the damping after a good step
_KICK, _SHIFT = 1.0, 0.5  # radian rms, random phases of the other starts
_KICK_MODES = 20
_UNWRAPPED_MODES = 40  # of the smooth part of a phase that is known up to multiples of 2 pi
_GROWTH = 2.0  # of the damping after a first step that raises the cost
_NOTHING = 1e-300  # keeps quotients finite
_NEGLIGIBLE = 1e-3  # of the mean standard error: a smaller step is the last one
_REFLECTIONS = 3  # largest number of times that points of one start are reflected
_GAIN = 0.01  # of twice the logarithm of the likelihood, from which on a reflection counts
_GAIN_TURN = 10.0  # the same, from which on a point is turned by 2 pi: a smooth phase is more probable
_LINEAR_ITERATIONS = 5  # of the start of an unknown amplitude


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
        maps = (self._singles(one, model) for one in (self.phase, self.amplitude))
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
        Photons that an intensity of 1 puts into a pixel of each frame, `Detector.photons_per_pixel`. If left out,
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
        known = None if isinstance(amplitude, str) else amplitude
        super().__init__(sensor, n_iterations=n_iterations, tolerance=tolerance, amplitude=known)
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
        rough = sensor.with_tolerance(max(_COARSE, sensor.tolerance))
        self._exact, self._rough = (
            Estimator(Response.of(one), noise, unknown, basis, precision) for one in (sensor, rough)
        )
        self._first = self._first_method()
        self._unwrapping = None if basis is None else Unwrapping.of(pupil.inside, basis)
        self._points = (
            None
            if basis is None
            else MaximumLikelihood(
                sensor, photons=photons, read_noise=read_noise, amplitude=known, n_starts=n_starts, seed=seed
            )
        )  # the start does not depend on how the fit of the modes stops
        self._smooth: NDArray[np.float64] | None = None
        if basis is None and isinstance(sensor, PolychromaticSensor):
            smooth = zernike_basis(pupil, min(_UNWRAPPED_MODES, pupil.n_points - 1))
            self._smooth = read_only(np.where(pupil.inside, smooth, 0))
            self._unwrapping = Unwrapping.of(pupil.inside, self._smooth)
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

        amplitude, coefficients = None, fit.coefficients
        if self._exact.unknown_amplitude:
            amplitude = shaped(kind.xp.astype(kind.xp.sqrt(square(fit.psi)), kind.dtype))
            amplitude += self.settings.model(kind).no_data
        if coefficients is not None:
            coefficients = shaped(kind.xp.astype(coefficients, kind.dtype))
        return LikelihoodReconstruction(
            **result,
            amplitude=amplitude,
            coefficients=coefficients,
            chi2=shaped(self._chi2(fit)),
            explained=shaped(self._explained(fit)),
            n_starts=shaped(fit.n_starts),
            noise_variance=shaped(self._noise_variance(fit)),
            estimator=self._exact,
        )

    def solve(self, frames: NDArray, start: NDArray | None, history: bool) -> Solution:
        """Return the phase that makes the frames most likely."""
        return self._solution(self._fit(frames, start, history), Kind.of(frames))

    def _solution(self, fit: Fit, kind: Kind) -> Solution:
        xp, history = kind.xp, fit.history
        phase = xp.astype(self._phase(fit) if history is None else history[:, -1, ...], kind.dtype)
        history = None if history is None else xp.astype(history, kind.dtype)
        return Solution(phase, fit.n_iterations, fit.converged, 0 * fit.n_iterations, history)

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
        xp = kind.xp
        first, quick = (start, None) if start is not None else self._first_phase(frames, kind)
        fit = self._descend(frames, first, history)
        if fit.history is not None and start is not None:
            fit.history[:, 0, ...] = start  # as it was given: modes may not represent it
        if quick is not None and xp.any(poor := quick & ~self._explained(fit)):
            best = fit.at(poor)
            other = self._descend(best.frames, self._phase_of_points(best.frames, kind), history)
            best.take(other.cost < best.cost, other, xp)
            fit.put(poor, best)
        for attempt in range(1, self.n_starts):
            poor = ~self._explained(fit)
            if not xp.any(poor):
                break
            best = fit.at(poor)
            other = self._descend(best.frames, self._other_start(attempt, best), history)
            n_starts = best.n_starts + 1
            best.take(other.cost < best.cost, other, xp)
            best.n_starts = n_starts
            fit.put(poor, best)
        return fit

    def _first_phase(self, frames: NDArray, kind: Kind) -> tuple[NDArray, NDArray[np.bool_] | None]:
        """Phase of the first start, (k, ny, nx), and with modes, where it is a fit to the first iterations, (k,).

        Where every point of the first iterations is near the fit, none is a multiple of 2 pi off.
        """
        rough = self._rough_phase(frames, None)
        if self._unwrapping is None or self._exact.modes is None:
            return rough, None
        coefficients, near = self._unwrapping.direct(rough, kind)
        start = self._of_modes(coefficients)
        if not kind.xp.all(near):
            start[~near] = self._phase_of_points(frames[~near], kind)
        return start, near

    def _phase_of_points(self, frames: NDArray, kind: Kind) -> NDArray:
        """Fit of the modes to the most likely phase of every point, (k, ny, nx)."""
        assert self._points is not None
        assert self._unwrapping is not None
        fit = self._points._search(frames, None, False)
        sigma = self._points._sigma(fit)
        return self._of_modes(self._unwrapping.fit(self._points._phase(fit), kind, sigma))

    def _sigma(self, fit: Fit) -> NDArray:
        """Standard error of the phase of every point, (k, ny, nx)."""
        xp = Kind.of(fit.psi).xp
        singles = (slice(i, i + 1) for i in range(fit.psi.shape[0]))  # one at a time, for the memory
        variance = [self._exact.variance(fit.psi[i, ...], fit.waves[i, ...])[0][:, 0, ...] for i in singles]
        return xp.sqrt(xp.concat(variance) * self._noise_variance(fit)[:, np.newaxis, np.newaxis])

    def _rough_phase(self, frames: NDArray, start: NDArray | None) -> NDArray:
        """Phase after the first iterations, (k, ny, nx)."""
        if self._first is None:
            flat = 0 * frames[(..., *self.sensor.window)][:, 0, ...]
            return flat if start is None else start
        return self._unwrapped(self._first.solve(frames, start, False).phase)

    def _unwrapped(self, phase: NDArray) -> NDArray:
        """Phase (k, ny, nx) with the multiples of 2 pi that bring it nearest to a smooth one, in a band."""
        if self._smooth is None or self._unwrapping is None:
            return phase
        kind = Kind.of(phase)
        flat = kind.xp.reshape(kind.array(self._smooth), (self._smooth.shape[0], -1))
        smooth = kind.xp.reshape(self._unwrapping.sloped(phase, kind) @ flat, phase.shape)
        return phase - 2 * np.pi * kind.xp.round((phase - smooth) / (2 * np.pi))

    def _other_start(self, attempt: int, fit: Fit) -> NDArray:
        """Phase from which the next attempt begins, (k, ny, nx); it depends on no other frame set."""
        kind, some = Kind.of(fit.psi), 0 * fit.psi[:, 0, ...]
        kick = kind.array(self._kicks[attempt - 1])
        if attempt % 2:
            return (angle(fit.psi, kind.xp) if fit.phase is None else fit.phase) + kick
        return self._rough_phase(fit.frames, some + _SHIFT * kick)

    def _descend(self, frames: NDArray, start: NDArray, history: bool) -> Fit:
        """Take steps from one start. Frame sets that are done leave, so no result depends on the others."""
        kind, n_iterations = Kind.of(frames), self.settings.n_iterations
        xp = kind.xp
        fit = self._begin(frames, start)
        places, ended, path = kind.integers(np.arange(frames.shape[0])), [], [self._phase(fit)]
        for iteration in range(1, n_iterations + 1):
            self._step(fit)
            if iteration < n_iterations and xp.any(fit.converged):
                self._reflect(fit)
            if history:
                path.append(self._phase(fit))
            n_done = int(xp.count_nonzero(fit.converged))
            if iteration == n_iterations or n_done == places.shape[0]:
                break
            if n_done:
                ended.append((places[fit.converged], fit.at(fit.converged)))
                places, fit = places[~fit.converged], fit.at(~fit.converged)
        if history:
            fit.history = xp.stack(path + path[-1:] * (n_iterations + 1 - len(path)), axis=1)
        ended.append((places, fit))
        order = xp.argsort(xp.concat([some for some, _ in ended]))
        return Fit.joined([part for _, part in ended], xp).at(order)

    def _begin(self, frames: NDArray, start: NDArray) -> Fit:
        """Return the fit at a starting phase, (k, ny, nx)."""
        kind, k = Kind.of(frames), frames.shape[0]
        model, coefficients = self.settings.model(kind), None
        if self._exact.modes is not None and self._unwrapping is not None:
            coefficients = self._unwrapping.fit(start, kind)
            start = self._of_modes(coefficients)
        psi = model.incoming(start)
        for _ in range(_LINEAR_ITERATIONS if self._exact.unknown_amplitude else 0):
            psi = linear_field(frames, psi, model)
        fit = self._at(psi, coefficients, frames, None if self._smooth is None else start)
        zeros = kind.integers([0] * k)
        fit.damping, fit.growth = _DAMPING + kind.zeros(k), _GROWTH + kind.zeros(k)
        fit.n_iterations, fit.converged, fit.n_starts, fit.n_reflections = zeros, zeros > 0, zeros + 1, zeros
        return fit

    def _at(
        self, psi: NDArray, coefficients: NDArray | None, frames: NDArray, phase: NDArray | None = None
    ) -> Fit:
        """Return the model of the frames at a field, and its cost."""
        waves = self.settings.model(Kind.of(psi)).propagate(psi)
        light = square(waves)
        cost = self._exact.noise.deviance(light, frames)
        if coefficients is not None and self._exact.precision is not None:
            precision = Kind.of(cost).array(self._exact.precision)
            cost = cost + Kind.of(cost).xp.vecdot(coefficients @ precision, coefficients)
        return Fit(frames, psi, waves, light, cost, coefficients, phase)

    def _step(self, fit: Fit) -> None:
        """Try a step (`eq-step`) on every frame set; take it where the cost falls.

        The next step is about the square of this one. Where that square is within the tolerance, the next step is
        taken at once with the same Hessian. It costs less than a new Hessian, and mostly confirms the solution.

        The damping follows Nielsen 1999: it falls the more, the better the quadratic model predicted the cost.
        """
        xp = Kind.of(fit.psi).xp
        hessian = self._hessian(fit)
        cost = fit.cost
        better, promised, size = self._try(fit, hessian, fit.n_iterations >= 0)
        ratio = (cost - fit.cost) / (promised + _NOTHING)
        cut = xp.clip(1 - (2 * ratio - 1) ** 3, _LEAST_CUT, None)
        fit.damping = fit.damping * xp.where(better, cut, fit.growth)
        fit.growth = xp.where(better, _GROWTH + 0 * fit.growth, 2 * fit.growth)
        last = self.settings.tolerance + 0 * size
        if self._exact.noise.photons is not None:
            last = xp.maximum(last, _NEGLIGIBLE / xp.sqrt(hessian.scale))
        near = (size > last) & (size * size <= last)
        if xp.any(near):
            size = xp.where(near, self._try(fit, hessian, near)[2], size)
        fit.converged = size <= last
        fit.n_iterations = fit.n_iterations + 1

    def _hessian(self, fit: Fit) -> Hessian:
        """Damped information at the field of a fit."""
        estimator, kind = self._exact, Kind.of(fit.psi)
        xp = kind.xp
        weights = estimator.noise.weights(fit.light)
        information = self._rough.response.information(self._tangents(fit), fit.waves, weights)
        scale = information.scale[:, 0, 0]
        if estimator.modes is None:
            absolute = fit.damping[:, np.newaxis, np.newaxis] * information.scale
            return Hessian(scale, absolute, information.inverse(absolute))
        modes = kind.array(estimator.modes)
        matrix = self._rough.of_modes(information)
        eye = kind.array(np.eye(modes.shape[0]))
        absolute = (fit.damping * xp.sum(matrix * eye, axis=(1, 2)) / modes.shape[0])[:, np.newaxis, np.newaxis]
        return Hessian(scale, absolute, matrix + absolute * eye)

    def _try(
        self, fit: Fit, hessian: Hessian, some: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray, NDArray]:
        """Take a step on some frame sets, (k,), where the cost falls.

        Returns
        -------
        better : array of bool, shape (k,)
            Whether the cost falls.
        promised : array, shape (k,)
            Fall of the cost that the quadratic model promises.
        size : array, shape (k,), radian rms
            Length of the step.
        """
        kind, estimator = Kind.of(fit.psi), self._exact
        xp, model = kind.xp, self.settings.model(kind)
        change = self._tangents(fit)
        gradient = self._gradient(fit, change)
        coefficients, phase = fit.coefficients, fit.phase
        if coefficients is None:
            step, promised = points_step(hessian, gradient)
        else:
            jump, promised = self._modes_step(hessian, gradient, coefficients)
            coefficients = coefficients + jump
            step = self._of_modes(jump)[:, np.newaxis, ...]
        if estimator.unknown_amplitude:
            psi = fit.psi + xp.sum(change * step[:, :, np.newaxis, ...], axis=1)
        elif coefficients is not None:
            psi = model.incoming(self._of_modes(coefficients))
        elif phase is not None:
            phase = phase + 2 * xp.atan(step[:, 0, ...] / 2)  # the angle of `turned`
            psi = model.incoming(phase)
        else:
            psi = turned(fit.psi, step[:, 0, ...], xp)
        trial = self._at(psi, coefficients, fit.frames, phase)
        better = some & (trial.cost < fit.cost)
        fit.take(better, trial, xp)
        return better, promised, xp.sqrt(xp.sum(step * step, axis=(1, 2, 3)) / model.pupil.n_points)

    def _gradient(self, fit: Fit, change: NDArray) -> NDArray:
        """Half the gradient of the cost for changes of the field (k, c, 2, ny, nx): (k, c, ny, nx)."""
        weights, difference = self._exact.noise.weights(fit.light), fit.light - fit.frames
        weighted = difference if weights is None else weights * difference
        back = self.settings.model(Kind.of(fit.psi)).adjoint(fit.waves * weighted[:, :, np.newaxis, ...])
        return 2 * parts_sum(change * back[:, np.newaxis, ...])

    def _tangents(self, fit: Fit) -> NDArray:
        """Change of the field per unit of the unknowns, (k, c, 2 n_wavelengths, ny, nx)."""
        model = self.settings.model(Kind.of(fit.psi))
        return tangents(fit.psi, model.stop, self._exact.unknown_amplitude, model.kind.xp, model.channels.ratios)

    def _reflect(self, fit: Fit) -> None:
        """Try to leave local minima of single points, where frame sets have converged.

        The intensity of a point depends on the angle between its field psi and the reference wave r of a mask. Its
        reflection at r gives the same intensity behind this mask (`eq-reflection`). A point may have converged to
        the wrong one of the two, mostly where a frame is dark. With the reference waves held, each point takes the
        reflection that makes its frames most likely. Frame sets whose cost falls by this continue. In a band of
        light the reflections of the wavelengths differ. There a point may be 2 pi off, and the two phases at that
        distance take their place.
        """
        estimator = self._exact
        if estimator.unknown_amplitude or estimator.modes is not None:
            return
        xp = Kind.of(fit.psi).xp
        some = fit.converged & (fit.n_reflections < _REFLECTIONS)
        if estimator.noise.photons is None:
            some = some & ~self._explained(fit)
        if not xp.any(some):
            return
        part = fit.at(some)
        gain = (_GAIN if part.phase is None else _GAIN_TURN) * self._noise_variance(part)
        trial = self._at(*self._best_points(part, gain[:, np.newaxis, np.newaxis]))
        better = trial.cost < part.cost - gain
        part.take(better, trial, xp)
        part.converged = ~better
        part.damping = xp.where(better, _DAMPING + 0 * part.damping, part.damping)
        part.n_reflections = part.n_reflections + 1
        fit.put(some, part)

    def _best_points(self, fit: Fit, gain: NDArray) -> tuple[NDArray, None, NDArray, NDArray | None]:
        """Arguments of `_at` for the field in which points take another phase that is more likely by `gain`."""
        xp, noise, window = Kind.of(fit.psi).xp, self._exact.noise, self.sensor.window
        frames = fit.frames[(..., *window)]
        references = fit.waves[(..., *window)] - fit.psi[:, np.newaxis, ...]
        least, psi, phase = noise.terms(fit.light[(..., *window)], frames), fit.psi, fit.phase
        for other, other_phase in self._other_points(fit, references):
            terms = noise.terms(square(other[:, np.newaxis, ...] + references), frames)
            better = terms < least - gain
            psi = xp.where(better[:, np.newaxis, ...], other, psi)
            phase = None if other_phase is None else xp.where(better, other_phase, phase)
            least = xp.where(better, terms, least)
        return psi, None, fit.frames, phase

    def _other_points(self, fit: Fit, references: NDArray) -> Iterator[tuple[NDArray, NDArray | None]]:
        """Fields whose points may be more likely than those of a fit, and their phases in a band of light."""
        if fit.phase is None:
            for mask in range(self.sensor.n_masks):
                yield reflected(fit.psi, references[:, mask, ...]), None
            return
        model = self.settings.model(Kind.of(fit.psi))
        for turn in (2 * np.pi, -2 * np.pi):
            phase = fit.phase + turn
            yield model.incoming(phase), phase

    def _modes_step(self, hessian: Hessian, gradient: NDArray, coefficients: NDArray) -> tuple[NDArray, NDArray]:
        """Step of the coefficients, (k, m), and the fall of the cost that it promises, (k,)."""
        kind = Kind.of(gradient)
        xp, modes = kind.xp, kind.array(self._exact.modes)
        slope = xp.reshape(gradient, (gradient.shape[0], -1)) @ xp.reshape(modes, (modes.shape[0], -1)).T
        if self._exact.precision is not None:
            slope = slope + coefficients @ kind.array(self._exact.precision)
        step = -xp.linalg.solve(hessian.inverse, slope[..., np.newaxis])[..., 0]
        return step, xp.vecdot(step, hessian.damping[:, 0, ...] * step - slope)

    def _phase(self, fit: Fit) -> NDArray:
        """Phase of fits, (k, ny, nx)."""
        if fit.coefficients is not None:
            return self._of_modes(fit.coefficients)
        return angle(fit.psi, Kind.of(fit.psi).xp) if fit.phase is None else fit.phase

    def _of_modes(self, coefficients: NDArray) -> NDArray:
        """Phase of coefficients: (k, m) to (k, ny, nx)."""
        kind = Kind.of(coefficients)
        modes = kind.array(self._exact.modes)
        flat = coefficients @ kind.xp.reshape(modes, (modes.shape[0], -1))
        return kind.xp.reshape(flat, (-1, *modes.shape[1:]))

    def _n_unknowns(self) -> int:
        if self._exact.modes is not None:
            return len(self._exact.modes)
        return (1 + self._exact.unknown_amplitude) * self.sensor.pupil.n_points - 1  # no frame shows the piston

    def _chi2(self, fit: Fit) -> NDArray:
        """Reduced chi-square, (k,)."""
        xp = Kind.of(fit.light).xp
        if self._exact.noise.photons is None:
            return fit.cost * np.nan
        misfit, expected, _ = self._exact.noise.misfit(fit.light, fit.frames)
        freedom = expected - self._n_unknowns()
        return xp.where(freedom > 0, misfit, np.nan) / freedom

    def _explained(self, fit: Fit) -> NDArray[np.bool_]:
        """Whether the noise explains the misfit, (k,)."""
        return self._exact.noise.explains(fit.light, fit.frames, self._n_unknowns())

    def _noise_variance(self, fit: Fit) -> NDArray:
        """Variance by which the inverse of the information is multiplied, (k,): 1 with a number of photons."""
        if self._exact.noise.photons is not None:
            return 1 + 0 * fit.cost
        return fit.cost / max(self._exact.noise.n_values(fit.frames) - self._n_unknowns(), 1)

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
