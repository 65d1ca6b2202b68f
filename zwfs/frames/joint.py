"""Joint fit: maps of phase and amplitude and the parameters of the optics, from all images of a recording at once.

`fit_jointly` minimises one sum of squares over all pixels of all images, with Gaussian priors on maps and
parameters. `held_out_blocks` and `predict_image` judge a fit by pixels that it has not seen, next to the same fit
with one image turned upside down, which must fail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from zwfs import _check
from zwfs.frames.optics_model import (
    Arm,
    ArmValues,
    Forward,
    Linearised,
    MaskPair,
    MaskValues,
    Parameter,
    Picture,
    parameters,
)
from zwfs.frames.registration import correlations

__all__ = ["JointFit", "fit_jointly"]

_FLAT: Any = None
_BINS = 24  # of spatial frequency, for the preconditioner
_ROUGHLY, _WELL = 0.1, 0.03  # relative errors of a step, and of the solutions that make the covariance
_FAINTEST = 0.02  # response of a spatial frequency, over the largest: a random probe measures no smaller ones
_WEAK = 10.0  # a combination that is so many times less certain than its parameters are one by one is reported


@dataclass(frozen=True)
class MapPrior:
    """Gaussian prior of a map: a power law of the spatial frequency.

    Parameters
    ----------
    rms : float
        Standard deviation of a pixel; radian for a phase, 1 = mean amplitude for an amplitude.
    exponent : float
        The power spectral density falls with the frequency to this power; 0 for pixels that are independent.
    outer_scale : float, D
        Below one cycle over this length the density is flat.

    Examples
    --------
    >>> from zwfs.frames.joint import MapPrior
    >>> spectrum = MapPrior(rms=0.5, exponent=2.0).spectrum(32, n_pixels=24)
    >>> spectrum.shape, bool(spectrum[0, 1] > spectrum[0, 2])
    ((32, 17), True)
    """

    rms: float
    exponent: float = 0.0
    outer_scale: float = 2.0

    def __post_init__(self) -> None:
        _check.number("rms", self.rms, 0, open_low=True)
        _check.number("exponent", self.exponent, 0, 10)
        _check.number("outer_scale", self.outer_scale, 0, open_low=True)

    def spectrum(self, size: int, n_pixels: float) -> NDArray[np.float64]:
        """Variance of each frequency on a periodic grid, on half the plane, (size, size // 2 + 1)."""
        v, u = fft.fftfreq(size)[:, None], fft.rfftfreq(size)
        bend = 1 / (self.outer_scale * n_pixels)
        shape = (u**2 + v**2 + bend**2) ** (-self.exponent / 2)
        twice = np.where((u == 0) | (u == 0.5), 1.0, 2.0)  # half the plane stands for all of it
        return shape * self.rms**2 * size**2 / np.sum(shape * twice)


@dataclass(frozen=True, eq=False)
class JointProblem:
    """All images of a recording, and the model with which to explain them.

    Parameters
    ----------
    pictures : sequence of Picture
    arms : sequence of Arm
    mask : MaskPair
    amplitude : array_like, shape (n, n)
        Mean of the prior of the amplitude, such as the square root of a clear frame. Light comes through where it
        is above 0.
    n_pixels : float, pixels
        Diameter D.
    phase_prior, amplitude_prior : MapPrior
        Of the difference from `phase` and `amplitude`. For differences of more than 0.5 rad the phase stands for
        its sine. A prior is an assumption: choose it by `held_out_blocks`.
    phase : array_like, shape (n, n), radian, optional
        Mean of the prior of the phase, 0 by default.

    Raises
    ------
    ValueError
        If nothing is to be fitted.

    Notes
    -----
    Some combinations of maps and parameters change no image, and need a fixed parameter: the flux of one arm where
    the amplitude is free, and, without known states of the mirror, the shift and the focus of one arm.
    """

    pictures: Sequence[Picture]
    arms: Sequence[Arm]
    mask: MaskPair
    amplitude: NDArray[np.float64]
    n_pixels: float
    phase_prior: MapPrior = MapPrior(0.5, 2.0)
    amplitude_prior: MapPrior = MapPrior(0.3, 1.0)
    phase: NDArray[np.float64] = _FLAT

    def __post_init__(self) -> None:
        _check.sequence("pictures", self.pictures, Picture, "a list of Pictures")
        _check.sequence("arms", self.arms, Arm, "a list of Arms")
        if not self.pictures or not self.arms:
            raise ValueError("pictures or arms is empty: expected at least one of each")
        _check.instance("mask", self.mask, MaskPair)
        amplitude = _check.real_map("amplitude", self.amplitude, 2)
        _check.non_negative("amplitude", amplitude)
        if amplitude.shape[0] != amplitude.shape[1] or not amplitude.any():
            raise ValueError(f"amplitude has shape {amplitude.shape}: expected (n, n), with light")
        phase = np.zeros(amplitude.shape) if self.phase is None else _check.real_map("phase", self.phase, 2)
        if phase.shape != amplitude.shape:
            raise ValueError(f"phase has shape {phase.shape}: expected {amplitude.shape}, as amplitude")
        _check.number("n_pixels", self.n_pixels, 1)
        for name in ("phase_prior", "amplitude_prior"):
            _check.instance(name, getattr(self, name), MapPrior)
        for name, value in {
            "amplitude": amplitude,
            "phase": phase,
            "pictures": tuple(self.pictures),
            "arms": tuple(self.arms),
        }.items():
            object.__setattr__(self, name, value)
        _ = self.forward  # which checks that the pictures fit

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Where light comes through the pupil, (n, n)."""
        return self.amplitude > 0

    @cached_property
    def named(self) -> list[tuple[str, Parameter]]:
        """All parameters and their names."""
        return parameters(self.arms, self.mask)

    @cached_property
    def values(self) -> NDArray[np.float64]:
        """Where a fit starts, (n_values,)."""
        return np.array([parameter.value for _, parameter in self.named])

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Which of the values are free."""
        return np.flatnonzero([parameter.free for _, parameter in self.named])

    @cached_property
    def forward(self) -> Forward:
        """Model of the images."""
        diameter = self.mask.diameter
        largest = max(1.3 * diameter.value, diameter.high if math.isfinite(diameter.high) else 0)
        return Forward(self.pictures, self.arms, self.inside, self.n_pixels, largest)

    @cached_property
    def weights(self) -> list[NDArray[np.float64]]:
        """One over the noise of each pixel, 0 where it does not count."""
        return [picture.weight for picture in self.pictures]

    def with_picture(self, index: int, **changes: Any) -> JointProblem:
        """Return the problem with one picture changed."""
        pictures = list(self.pictures)
        pictures[index] = replace(pictures[index], **changes)
        return replace(self, pictures=pictures)

    def upside_down(self, index: int) -> JointProblem:
        """Return the problem with one image turned upside down: a control, which no right model explains."""
        picture = self.pictures[_check.integer("index", index, 0, len(self.pictures) - 1)]
        return self.with_picture(
            index,
            counts=picture.counts[::-1],
            good=picture.good[::-1],
            sigma=np.asarray(picture.sigma)[::-1] if np.ndim(picture.sigma) else picture.sigma,
        )

    def of_pupil(self, index: int) -> NDArray[np.bool_]:
        """Pixels of a picture that stand in the pupil, but for the shift of its arm."""
        shape = self.pictures[index].counts.shape
        n = self.inside.shape[0]
        rows, columns = ((length - n) // 2 for length in shape)
        whole = np.pad(self.inside, max(0, rows, columns))
        spare = [(length - have) // 2 for length, have in zip(whole.shape, shape, strict=True)]
        return whole[spare[0] : spare[0] + shape[0], spare[1] : spare[1] + shape[1]]


@dataclass(frozen=True)
class FittedParameter:
    """Value of a free parameter.

    Attributes
    ----------
    name : str
    value : float
        Less the bias, see `JointFit.bias`.
    sigma : float
        One standard deviation, with the maps and all other parameters free. NaN if it was not computed.
    at_limit : bool
        Whether the value is one of the limits, so that the error does not hold.
    """

    name: str
    value: float
    sigma: float
    at_limit: bool


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of `fit_jointly`.

    Attributes
    ----------
    problem : JointProblem
    amplitude, phase : ndarray, shape (n, n)
        0 where no light comes through.
    values : ndarray, shape (n_values,)
        Of all parameters: with the maps, they minimise the cost.
    covariance : ndarray, shape (n_free, n_free)
        Of the free parameters, with the maps marginalised; NaN if it was not computed.
    bias : ndarray, shape (n_free,)
        Mean error of the free parameters that the noise of the maps causes; 0 if it was not computed. In units of
        the error bars it grows with the root of the number of pixels, and falls with the root of the light.
        `estimates` subtracts it. `values` keeps it, since these values belong to the noisy maps.
    images : list of ndarray, counts
    misfit : ndarray, shape (n_pictures,)
        Mean square of the difference of image and model over the noise: 1 for a right model with a right noise.
    cost : float
        Half the sum of squares, priors included.
    n_steps : int
    converged : bool
    unknowns : ndarray
        White maps and values, from which another fit may start.
    """

    problem: JointProblem
    amplitude: NDArray[np.float64]
    phase: NDArray[np.float64]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    bias: NDArray[np.float64]
    images: list[NDArray[np.float64]]
    misfit: NDArray[np.float64]
    cost: float
    n_steps: int
    converged: bool
    unknowns: NDArray[np.float64]

    @cached_property
    def arms(self) -> list[ArmValues]:
        """Values of the arms."""
        return self.problem.forward.split(self.values)[0]

    @cached_property
    def mask(self) -> MaskValues:
        """Values that all images share."""
        return self.problem.forward.split(self.values)[1]

    @cached_property
    def estimates(self) -> list[FittedParameter]:
        """Free parameters, with their errors."""
        sigma = np.sqrt(np.diagonal(self.covariance)).tolist()
        return [
            FittedParameter(name, value - bias, error, not parameter.low < value < parameter.high)
            for (name, parameter), value, bias, error in zip(
                (self.problem.named[index] for index in self.problem.free),
                self.values[self.problem.free].tolist(),
                self.bias.tolist(),
                sigma,
                strict=True,
            )
        ]

    @cached_property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation matrix of the free parameters."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        return self.covariance / np.outer(sigma, sigma)

    @cached_property
    def limits_hit(self) -> list[str]:
        """Names of the parameters that stand at a limit."""
        return [one.name for one in self.estimates if one.at_limit]

    @cached_property
    def agreement(self) -> NDArray[np.float64]:
        """Correlation of each image and its model in the pupil; in sample, so it proves little."""
        return np.array([_correlation(self.problem, self.images, index) for index in range(len(self.images))])

    def undetermined(self, factor: float = _WEAK) -> list[str]:
        """Combinations of parameters that the images hardly determine, each as a sentence.

        The errors of the parameters one by one, with all others known, are the units. A combination is listed if
        its standard deviation is more than `factor` of these units.
        """
        factor = _check.number("factor", factor, 0, open_low=True)
        if not np.all(np.isfinite(self.covariance)):
            raise ValueError("covariance is NaN: expected a fit with errors=True")
        alone = 1 / np.sqrt(np.diagonal(linalg.inv(self.covariance)))
        size, directions = linalg.eigh(self.covariance / np.outer(alone, alone))
        sentences = []
        for variance, direction in zip(size[::-1], directions.T[::-1], strict=True):
            if variance <= factor**2:
                break
            parts = [index for index in np.argsort(-np.abs(direction)) if abs(direction[index]) > 0.3]
            sign = np.sign(direction[parts[0]])
            change = ", ".join(
                f"{self.estimates[index].name} by {sign * direction[index] * alone[index] * variance**0.5:+.2g}"
                for index in parts
            )
            sentences.append(
                f"A change of {change} together is one standard deviation, {variance**0.5:.0f} times that of each "
                "alone."
            )
        return sentences


def fit_jointly(
    problem: JointProblem,
    *,
    start: JointFit | None = None,
    n_steps: int = 30,
    n_inner: int = 60,
    tolerance: float = 1e-4,
    errors: bool = True,
) -> JointFit:
    """Fit maps and parameters to all images at once.

    Levenberg and Marquardt's method on all unknowns. A map of the phase enters as the part of the
    field in quadrature with `amplitude` * exp(i `phase`), that of the amplitude as the part in phase: dark points
    then need no phase, and the field is linear in the unknowns. The linear equations of a step are solved by
    conjugate gradients: each product with the matrix is one pass of the derivative of the model and one of its
    adjoint, so no matrix is stored. The unknowns of a map are white under its prior, and their preconditioner is
    the mean response of the images at each spatial frequency.

    Parameters
    ----------
    problem : JointProblem
    start : JointFit, optional
        Of a problem with the same maps and parameters.
    n_steps : int
        Largest number of steps.
    n_inner : int
        Largest number of conjugate gradients in a step.
    tolerance : float
        The fit has converged when a step lowers the cost by less than this fraction.
    errors : bool
        Compute the covariance of the parameters, which costs as many solutions as there are free parameters, and
        their bias.

    Returns
    -------
    JointFit

    References
    ----------
    M. J. Box, Bias in nonlinear estimation, J. R. Stat. Soc. B 33, 171 (1971): the bias of the parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis
    >>> from zwfs.frames.joint import JointProblem, MapPrior, fit_jointly, held_out_blocks, predict_image
    >>> from zwfs.frames.optics_model import Arm, MaskPair, Parameter, Picture
    >>> pupil = Pupil.circular(12)
    >>> sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=1.5)
    >>> phase = 0.1 * zernike_basis(pupil, 6).sum(axis=0)
    >>> pictures = [Picture(counts, 0, side, sigma=0.02) for side, counts in enumerate(sensor.measure(phase))]
    >>> mask = MaskPair(diameter=Parameter.fitted(1.0))
    >>> problem = JointProblem(pictures, [Arm()], mask, pupil.amplitude, 12, amplitude_prior=MapPrior(0.01))
    >>> fit = fit_jointly(problem, n_inner=20, errors=False)
    >>> fit.converged, round(fit.mask.diameter, 2)
    (True, 1.06)
    >>> score = held_out_blocks(problem, block=2, n_steps=4, n_inner=15)
    >>> control = held_out_blocks(problem.upside_down(1), block=2, n_steps=4, n_inner=15)
    >>> other = predict_image(problem, 1, fit, n_steps=3, n_inner=10)
    >>> [bool(one.correlation[1] > 0.7) for one in (score, control, other)]
    [True, False, True]
    """
    _check.instance("problem", problem, JointProblem)
    n_steps = _check.integer("n_steps", n_steps, 1)
    n_inner = _check.integer("n_inner", n_inner, 1)
    tolerance = _check.number("tolerance", tolerance, 0, 1)
    errors = _check.flag("errors", errors)
    unknowns = _Unknowns(problem)
    x = unknowns.start
    if start is not None:
        _check.instance("start", start, JointFit)
        if start.unknowns.shape != unknowns.shape_of_all:
            raise ValueError("start belongs to a problem with other maps or parameters: expected the same ones")
        x = unknowns.from_all(start.unknowns)
    point = _Point(unknowns, x)
    damping, converged, step = 1.0, False, 0
    while step < n_steps and not converged:
        step += 1
        normal = _Normal(point)
        stuck = unknowns.stuck(point.x, normal.gradient)
        for _ in range(8):
            change = normal.solve(-normal.gradient, stuck, n_inner, _ROUGHLY, damping)
            trial = _Point(unknowns, unknowns.within(point.x + change))
            gain = point.cost - trial.cost
            if gain >= 0:
                break
            damping *= 4
        else:
            converged = True
            break
        converged = gain <= tolerance * point.cost
        point, damping = trial, max(damping / 8, 1e-5)
    covariance, bias = np.full((len(problem.free),) * 2, np.nan), np.zeros(len(problem.free))
    if errors and len(problem.free):
        normal = _Normal(point)
        covariance, bias = _covariance(normal, 10), _bias(normal, 60)
    return JointFit(
        problem,
        np.abs(point.field),
        np.where(problem.inside, problem.phase + np.angle(point.field * np.exp(-1j * problem.phase)), 0),
        point.values,
        covariance,
        bias,
        point.model.images,
        np.array([_mean_square(r, w) for r, w in zip(point.residuals, problem.weights, strict=True)]),
        point.cost,
        step,
        converged,
        unknowns.all_of(point.x),
    )


class _Unknowns:
    """The vector of unknowns: white amplitude, white phase, free parameters."""

    def __init__(self, problem: JointProblem) -> None:
        self.problem = problem
        self.n = len(problem.inside)
        self.size = fft.next_fast_len(round(1.2 * self.n), real=True)
        self.filters = [
            np.sqrt(prior.spectrum(self.size, problem.n_pixels))
            for prior in (problem.amplitude_prior, problem.phase_prior)
        ]
        self.n_white = 2 * self.size**2
        self.along = np.exp(1j * problem.phase) * problem.inside
        self.across = 1j * problem.amplitude * self.along
        free = [problem.named[index][1] for index in problem.free]
        self.center = np.array([one.value for one in free])
        self.precision = np.array([1 / one.sigma for one in free])
        self.low, self.high = (np.array([getattr(one, end) for one in free]) for end in ("low", "high"))
        self.start = np.concatenate([np.zeros(self.n_white), self.center])
        self.shape_of_all = (self.n_white + len(problem.values),)

    def all_of(self, x: NDArray) -> NDArray:
        """White maps and all values, free or not."""
        return np.concatenate([x[: self.n_white], self.values(x)])

    def from_all(self, everything: NDArray) -> NDArray:
        """Unknowns among white maps and all values."""
        values = everything[self.n_white :][self.problem.free]
        return self.within(np.concatenate([everything[: self.n_white], values]))

    def within(self, x: NDArray) -> NDArray:
        """Unknowns with the parameters brought into their limits."""
        x = x.copy()
        x[self.n_white :] = np.clip(x[self.n_white :], self.low, self.high)
        return x

    def stuck(self, x: NDArray, gradient: NDArray) -> NDArray[np.bool_]:
        """Parameters at a limit beyond which the cost would fall."""
        stuck = np.zeros(x.shape, bool)
        values, slope = x[self.n_white :], gradient[self.n_white :]
        stuck[self.n_white :] = ((values <= self.low) & (slope > 0)) | ((values >= self.high) & (slope < 0))
        return stuck

    def field(self, x: NDArray) -> NDArray[np.complex128]:
        """Field on the pupil, less its mean, of white maps, (n, n)."""
        white = x[: self.n_white].reshape(2, self.size, self.size)
        along, across = (
            fft.irfft2(colour * fft.rfft2(one), s=one.shape)[: self.n, : self.n]
            for colour, one in zip(self.filters, white, strict=True)
        )
        return along * self.along + across * self.across

    def adjoint(self, field: NDArray) -> NDArray[np.float64]:
        """Adjoint of `field`."""
        white = []
        for colour, unit in zip(self.filters, (self.along, self.across), strict=True):
            whole = np.zeros((self.size, self.size))
            whole[: self.n, : self.n] = (unit.conj() * field).real
            white.append(fft.irfft2(colour * fft.rfft2(whole), s=whole.shape).ravel())
        return np.concatenate(white)

    def values(self, x: NDArray) -> NDArray[np.float64]:
        """All values: the free ones of the unknowns, the others fixed."""
        values = self.problem.values.copy()
        values[self.problem.free] = x[self.n_white :]
        return values


class _Point:
    """Model, cost and gradient at given unknowns."""

    def __init__(self, unknowns: _Unknowns, x: NDArray) -> None:
        self.unknowns, self.x = unknowns, x
        problem = unknowns.problem
        self.field = problem.amplitude * unknowns.along + unknowns.field(x)
        self.values = unknowns.values(x)
        self.model: Linearised = problem.forward.at(self.field, self.values)
        self.residuals = [
            weight * (image - picture.counts)
            for weight, image, picture in zip(problem.weights, self.model.images, problem.pictures, strict=True)
        ]
        self.excess = (x[unknowns.n_white :] - unknowns.center) * unknowns.precision
        squares = sum(np.vdot(one, one) for one in self.residuals)
        white = x[: unknowns.n_white]
        self.cost = float(squares + np.vdot(white, white) + np.vdot(self.excess, self.excess)) / 2


class _Normal:
    """Gauss and Newton's matrix at a point, and its preconditioner."""

    def __init__(self, point: _Point) -> None:
        self.point, self.unknowns = point, point.unknowns
        self._white = self.unknowns.n_white
        self._columns = [self._slopes(index) for index in range(len(point.residuals))]
        self.block = np.diag(self.unknowns.precision**2 + 1e-300)
        for which, slopes in self._columns:
            self.block[np.ix_(which, which)] += slopes @ slopes.T
        self._response = self._probe()

    @cached_property
    def gradient(self) -> NDArray[np.float64]:
        """Of the cost."""
        gradient = self.back(self.point.residuals)
        gradient[: self._white] += self.point.x[: self._white]
        gradient[self._white :] += self.point.excess * self.unknowns.precision
        return gradient

    def _slopes(self, index: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Free parameters that change an image, and its changes over the noise with each, (k, ny * nx)."""
        problem = self.unknowns.problem
        arm = problem.pictures[index].arm
        own = f"arm {arm} "
        names = [problem.named[one][0] for one in problem.free]
        which = np.array(
            [k for k, name in enumerate(names) if not name.startswith("arm ") or name.startswith(own)], int
        )
        unit = np.eye(len(problem.values))[problem.free[which]]
        slopes = [(problem.weights[index] * self.point.model.slope(index, values)).ravel() for values in unit]
        return which, np.reshape(slopes, (len(which), problem.weights[index].size))

    def change(self, d: NDArray) -> list[NDArray[np.float64]]:
        """Change of the images, over the noise, with the unknowns."""
        images = self.point.model.apply(self.unknowns.field(d))
        changes = [weight * image for weight, image in zip(self.unknowns.problem.weights, images, strict=True)]
        values = d[self._white :]
        if values.any():
            for change, (which, slopes) in zip(changes, self._columns, strict=True):
                change += (values[which] @ slopes).reshape(change.shape)
        return changes

    def back(self, images: Sequence[NDArray]) -> NDArray[np.float64]:
        """Adjoint of `change`."""
        values = np.zeros(len(self.unknowns.center))
        for image, (which, slopes) in zip(images, self._columns, strict=True):
            values[which] += slopes @ image.ravel()
        weights = self.unknowns.problem.weights
        field = self.point.model.adjoint([weight * image for weight, image in zip(weights, images, strict=True)])
        return np.concatenate([self.unknowns.adjoint(field), values])

    def product(self, d: NDArray) -> NDArray[np.float64]:
        """Matrix times a vector."""
        out = self.back(self.change(d))
        out[: self._white] += d[: self._white]
        out[self._white :] += d[self._white :] * self.unknowns.precision**2
        return out

    def solve(
        self, right: NDArray, stuck: NDArray[np.bool_], n_inner: int, tolerance: float, damping: float = 0.0
    ) -> NDArray[np.float64]:
        """Solution of the damped equations with a right side; what is stuck stays."""

        def damped(d: NDArray) -> NDArray:
            return self.product(d) + damping * self.scale(d) if damping else self.product(d)

        def precondition(r: NDArray) -> NDArray:
            return np.where(stuck, 0, self.precondition(r)) / (1 + damping)

        return _conjugate_gradients(damped, np.where(stuck, 0, right), precondition, n_inner, tolerance)

    def scale(self, d: NDArray) -> NDArray[np.float64]:
        """Damping times a vector: the preconditioner for maps, the diagonal for parameters."""
        return np.concatenate([*self._filtered(d, 1), np.diagonal(self.block) * d[self._white :]])

    def precondition(self, r: NDArray) -> NDArray[np.float64]:
        """Approximate inverse of the matrix times a vector."""
        unit = np.sqrt(np.diagonal(self.block))
        scaled = self.block / np.outer(unit, unit) + 1e-9 * np.eye(len(unit))
        parameters = linalg.solve(scaled, r[self._white :] / unit, assume_a="pos") / unit if unit.size else unit
        return np.concatenate([*self._filtered(r, -1), parameters])

    def _filtered(self, d: NDArray, power: int) -> list[NDArray[np.float64]]:
        """White maps through a power of their mean response."""
        white = d[: self._white].reshape(2, self.unknowns.size, self.unknowns.size)
        return [
            fft.irfft2(fft.rfft2(one) * (1 + response) ** power, s=one.shape).ravel()
            for one, response in zip(white, self._response, strict=True)
        ]

    def _probe(self) -> list[NDArray[np.float64]]:
        """Mean response of the images at each spatial frequency, for both maps, by a random probe."""
        unknowns, problem = self.unknowns, self.unknowns.problem
        rng = np.random.default_rng(0)  # the choice hardly changes the number of steps, and no result
        size, n, responses = unknowns.size, unknowns.n, []
        v, u = fft.fftfreq(size)[:, None], fft.rfftfreq(size)
        bins = np.minimum(np.hypot(u, v) * 2 * _BINS, _BINS - 1).astype(int)
        for colour, unit in zip(unknowns.filters, (unknowns.along, unknowns.across), strict=True):
            probe = rng.choice([-1.0, 1.0], (n, n)) * problem.inside
            images = self.point.model.apply(probe * unit)
            weighted = [weight**2 * image for weight, image in zip(problem.weights, images, strict=True)]
            answer = (unit.conj() * self.point.model.adjoint(weighted)).real
            padded = np.zeros((2, size, size))
            padded[:, :n, :n] = probe, answer
            sent, got = fft.rfft2(padded)
            power = np.bincount(bins.ravel(), (np.abs(sent) ** 2).ravel(), _BINS)
            heard = np.bincount(bins.ravel(), (sent.conj() * got).real.ravel(), _BINS)
            response = heard / np.maximum(power, 1e-300)
            responses.append(colour**2 * np.maximum(response, _FAINTEST * response.max())[bins])
        return responses


def _conjugate_gradients(
    product: Callable[[NDArray], NDArray],
    right: NDArray,
    precondition: Callable[[NDArray], NDArray],
    n_steps: int,
    tolerance: float,
) -> NDArray[np.float64]:
    """Solution of a positive definite system, to a relative error of the preconditioned residual.

    `scipy.sparse.linalg.cg` would measure the residual without the preconditioner, in units that differ between
    the parameters by many orders of magnitude.
    """
    x, r = np.zeros_like(right), right
    z = precondition(r)
    d, size = z, float(np.vdot(r, z))
    goal = tolerance**2 * size
    for _ in range(n_steps):
        if size <= goal or size <= 0:
            break
        along = product(d)
        step = size / float(np.vdot(d, along))
        x, r = x + step * d, r - step * along
        z = precondition(r)
        before, size = size, float(np.vdot(r, z))
        d = z + size / before * d
    return x


def _covariance(normal: _Normal, n_inner: int) -> NDArray[np.float64]:
    """Covariance of the free parameters: the inverse of Schur's complement of the maps.

    S = H_pp - 2 H_pm X + X^T H_mm X with an approximate X = H_mm^-1 H_mp: its error is of second order in that
    of X. With ten conjugate gradients the standard deviations come out a few percent too small.
    """
    unknowns = normal.unknowns
    n_white, n_all = unknowns.n_white, len(unknowns.start)
    parameters = np.arange(n_all) >= n_white
    left, solved, products = [], [], []
    for index in range(n_white, n_all):
        right = normal.product(np.eye(1, n_all, index)[0])
        solution = normal.solve(right, parameters, n_inner, _WELL)
        left.append(right[:n_white])
        solved.append(solution[:n_white])
        products.append(normal.product(solution)[:n_white])
    cross = np.array(left) @ np.array(solved).T
    schur = normal.block - cross - cross.T + np.array(solved) @ np.array(products).T
    unit = np.sqrt(np.diagonal(normal.block))
    schur = (schur + schur.T) / 2 / np.outer(unit, unit)
    return linalg.pinvh(schur, rtol=1e-13) / np.outer(unit, unit)


def _bias(normal: _Normal, n_inner: int) -> NDArray[np.float64]:
    """Mean error of the free parameters that is caused by the noise of the maps, of second order in the noise.

    Noise d of the maps changes the images by F d + q. The mean of q is not 0: noise of the maps adds light,
    most of it at the frequencies that the blur hides, and this light does not interfere with that of the dimple.
    The fit compensates for it by -H^-1 F^T q. One draw of d suffices, since q is summed over all pixels.
    """
    point, unknowns = normal.point, normal.unknowns
    rng = np.random.default_rng(0)  # the choice changes the result by a small part of an error bar
    parameters = np.arange(len(point.x)) >= unknowns.n_white
    noise = [rng.choice([-1.0, 1.0], weight.shape) * (weight > 0) for weight in unknowns.problem.weights]
    change = normal.solve(normal.back(noise), parameters, n_inner, _WELL)
    both = [_Point(unknowns, point.x + sign * change).residuals for sign in (1, -1)]
    added = [(plus + minus) / 2 - here for plus, minus, here in zip(*both, point.residuals, strict=True)]
    stuck = unknowns.stuck(point.x, normal.gradient)
    return -normal.solve(normal.back(added), stuck, n_inner, _WELL)[parameters]


def _mean_square(residual: NDArray, weight: NDArray) -> float:
    return float(np.vdot(residual, residual) / max(1, np.count_nonzero(weight)))


def _correlation(
    problem: JointProblem, images: Sequence[NDArray], index: int, where: NDArray[np.bool_] | None = None
) -> float:
    """Correlation of an image and its model over the good pixels of the pupil, or over some of them."""
    picture = problem.pictures[index]
    pixels = problem.of_pupil(index) & picture.good
    pixels = pixels if where is None else pixels & where
    if np.count_nonzero(pixels) < 3:
        return float("nan")
    return float(correlations(picture.counts[pixels][np.newaxis], images[index][pixels][np.newaxis])[0])


class Score(NamedTuple):
    """Agreement of images with predictions from pixels other than these.

    Attributes
    ----------
    correlation : ndarray, shape (n_pictures,)
        Over the held-out pixels in the pupil; NaN where none was held out.
    misfit : ndarray, shape (n_pictures,)
        Rms difference over the standard deviation of the image there: 1 is no better than a constant.
    fit : JointFit
    """

    correlation: NDArray[np.float64]
    misfit: NDArray[np.float64]
    fit: JointFit


def _score(problem: JointProblem, fit: JointFit, held: Sequence[NDArray[np.bool_]]) -> Score:
    correlation, misfit = np.full((2, len(held)), np.nan)
    for index, where in enumerate(held):
        picture = problem.pictures[index]
        pixels = problem.of_pupil(index) & picture.good & where
        if np.count_nonzero(pixels) < 3:
            continue
        correlation[index] = _correlation(problem, fit.images, index, where)
        difference = (picture.counts - fit.images[index])[pixels]
        misfit[index] = np.sqrt(np.mean(difference**2)) / picture.counts[pixels].std()
    return Score(correlation, misfit, fit)


def held_out_blocks(
    problem: JointProblem,
    *,
    fraction: float = 0.1,
    block: int = 6,
    seed: int | np.random.Generator | np.random.SeedSequence | None = 0,
    start: JointFit | None = None,
    **settings: Any,
) -> Score:
    """Fit without random blocks of pixels, which differ from image to image, and compare with these.

    Parameters
    ----------
    problem : JointProblem
    fraction : float
        Of the pixels of each image that are held out.
    block : int, pixels
        Rows and columns of a block.
    seed : int, Generator or SeedSequence, optional
        Of the places of the blocks.
    start : JointFit, optional
        Where the parameters start. The maps start anew: those of a fit have seen the pixels.
    **settings
        Of `fit_jointly`.

    Returns
    -------
    Score
    """
    _check.instance("problem", problem, JointProblem)
    fraction = _check.number("fraction", fraction, 0, 0.9, open_low=True)
    block = _check.integer("block", block, 1)
    rng = _check.generator("seed", seed)
    held, pictures = [], []
    for picture in problem.pictures:
        blocks = rng.random([-(-length // block) for length in picture.counts.shape]) < fraction
        ny, nx = picture.counts.shape
        held.append(np.repeat(np.repeat(blocks, block, 0), block, 1)[:ny, :nx])
        pictures.append(replace(picture, good=picture.good & ~held[-1]))
    seen = replace(problem, pictures=pictures)
    fit = fit_jointly(_started(seen, start), errors=False, **settings)
    return _score(problem, fit, held)


def predict_image(problem: JointProblem, index: int, fit: JointFit, n_steps: int = 30, n_inner: int = 60) -> Score:
    """Predict one image from the others.

    The image itself is left out, so that it shows neither the place nor the flux of its arm: these are those of a
    fit of all images, and fixed. The maps start anew.

    Parameters
    ----------
    problem : JointProblem
    index : int
        Of the picture.
    fit : JointFit
        Of all images.
    n_steps, n_inner : int
        See `fit_jointly`.

    Returns
    -------
    Score
    """
    _check.instance("problem", problem, JointProblem)
    _check.instance("fit", fit, JointFit)
    picture = problem.pictures[_check.integer("index", index, 0, len(problem.pictures) - 1)]
    started = _started(problem, fit)
    alone = all(other.arm != picture.arm for other in problem.pictures if other is not picture)
    arms = list(started.arms)
    if alone:
        arm = arms[picture.arm]
        fixed = {name: replace(getattr(arm, name), free=False) for name in ArmValues._fields}
        arms[picture.arm] = replace(arm, **fixed)
    # A picture without weight is modelled, but not fitted.
    rest = replace(started.with_picture(index, sigma=1e30), arms=arms)
    result = fit_jointly(rest, n_steps=n_steps, n_inner=n_inner, errors=False)
    held = [np.full(one.counts.shape, number == index) for number, one in enumerate(problem.pictures)]
    return _score(problem, result, held)


def _started(problem: JointProblem, fit: JointFit | None) -> JointProblem:
    """The problem with the parameters of a fit as start; those with a prior start at its centre."""
    if fit is None:
        return problem

    def moved(owner: Any, values: ArmValues | MaskValues) -> Any:
        changes = {}
        for name, value in values._asdict().items():
            one = getattr(owner, name)
            if one.free and math.isinf(one.sigma):
                changes[name] = replace(one, value=float(np.clip(value, one.low, one.high)))
        return replace(owner, **changes)

    arms = [moved(arm, values) for arm, values in zip(problem.arms, fit.arms, strict=True)]
    return replace(problem, arms=arms, mask=moved(problem.mask, fit.mask))
