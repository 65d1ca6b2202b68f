"""Likelihood of frames with photon noise and read noise, and what the frames determine."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._information import Information, Response
from zwfs._propagator import along_phase, square
from zwfs.sensor import Sensor

_DARK = 1e-12  # electrons: a modelled pixel that is darker counts as this bright
_DISTINCT = 1e-6  # difference of two masks, relative to the strongest response, from which on they are different
_SIGMAS = 5.0  # excess of the misfit, in its standard deviations, up to which noise explains it
_RESIDUAL = 1e-5  # rms, in units of the mean intensity, up to which frames without noise are explained
_SINGULAR = 1e-14  # eigenvalue of the information about modes, relative to the largest, that counts as 0


@dataclass(frozen=True)
class Noise:
    """Noise of a frame: photon noise and read noise.

    The electrons of a pixel plus the variance of the read noise are taken to follow the Poisson distribution
    (Snyder et al. 1995; `eq-likelihood`). Mean and variance are right. The likelihood is exact without read noise.

    Attributes
    ----------
    photons : float or None
        Photons per pupil point and image. None stands for an unknown variance that is
        the same in all pixels: ordinary least squares.
    read_noise : float, electrons rms / pixel
    recorded : ndarray of bool, shape (ny', nx'), or None
        Pixels that the frames hold; the others have no weight. None stands for all.
    """

    photons: float | None
    read_noise: float
    recorded: NDArray[np.bool_] | None = None

    @classmethod
    def checked(cls, photons: Any, read_noise: Any, recorded: NDArray[np.bool_] | None = None) -> Noise:
        """Check the arguments."""
        read_noise = _check.number("read_noise", read_noise, 0, 1e6)
        if photons is not None:
            return cls(_check.number("photons", photons, 1e-18, 1e12), read_noise, recorded)
        if read_noise:
            raise ValueError(f"read_noise = {read_noise:g}: expected 0, since there is no number of photons")
        return cls(None, 0.0, recorded)

    def n_values(self, frames: NDArray) -> int:
        """Values that a set of frames (k, n_masks, ny', nx') holds."""
        return prod(frames.shape[1:] if self.recorded is None else (frames.shape[1], self.recorded.sum()))

    def electrons(self, light: NDArray) -> NDArray:
        """Mean of the Poisson distribution in each pixel, above 0."""
        return self.photons * light + (self.read_noise**2 + _DARK)

    def weights(self, light: NDArray) -> NDArray | None:
        """Inverse variance of frames whose mean is `light`; None if it is the same in all pixels."""
        if self.photons is None:
            kind = Kind.of(light)
            return None if self.recorded is None else kind.xp.broadcast_to(kind.array(self.recorded), light.shape)
        weights = self.photons**2 / self.electrons(light)
        return weights if self.recorded is None else weights * Kind.of(light).array(self.recorded)

    def deviance(self, light: NDArray, frames: NDArray) -> NDArray:
        """Twice the logarithm of the best possible likelihood over that of a mean `light`: (k, ...) to (k,).

        Read noise may bring a pixel below 0 electrons plus variance, where no mean is the best: that of 1 electron
        takes its place. Without a number of photons it is the sum of squares.
        """
        terms, kind = self.terms(light, frames), Kind.of(light)
        if self.recorded is not None:
            terms = terms * kind.array(self.recorded)
        return kind.xp.sum(terms, axis=(-2, -1))

    def terms(self, light: NDArray, frames: NDArray) -> NDArray:
        """Sum over the masks of the terms of `deviance`: (k, n_masks, ny, nx) to (k, ny, nx)."""
        xp = Kind.of(light).xp
        if self.photons is None:
            difference = light - frames
            return xp.sum(difference * difference, axis=1)
        expected, measured = self.electrons(light), self.electrons(frames)
        best = xp.where(measured > 0, measured, 1.0)
        return 2 * xp.sum(expected - measured + measured * xp.log(best / expected), axis=1)

    def misfit(self, light: NDArray, frames: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Sum of squared differences over the variance, its expectation, and the variance of the sum: (k,) each.

        The variance m of a pixel counts as 1 electron at least. A far darker pixel would rarely hold a photon, and
        one photon would then count as much as all bright pixels. The fourth moment of a Poisson distribution is
        3 m^2 + m.
        """
        xp, axes = Kind.of(light).xp, tuple(range(1, light.ndim))
        expected = self.electrons(light)
        difference, scale = self.electrons(frames) - expected, 1 / xp.clip(expected, 1, None)
        expected = expected * scale
        terms = difference * difference * scale, expected, (2 * expected + scale) * expected
        if self.recorded is not None:
            recorded = Kind.of(light).array(self.recorded)
            terms = tuple(term * recorded for term in terms)
        misfit, mean, variance = (xp.sum(term, axis=axes) for term in terms)
        return misfit, mean, variance

    def explains(self, light: NDArray, frames: NDArray, n_unknowns: int = 0) -> NDArray[np.bool_]:
        """Whether noise explains the misfit of frames after a fit of so many unknowns: (k, ...) to (k,).

        Without a number of photons, the difference must be within rounding.
        """
        xp, axes = Kind.of(light).xp, tuple(range(1, light.ndim))
        if self.photons is None:
            weights, difference = self.weights(light), light - frames
            squares = difference * difference * (1 if weights is None else weights)
            return xp.sum(squares, axis=axes) <= _RESIDUAL**2 * self.n_values(frames)
        misfit, expected, variance = self.misfit(light, frames)
        freedom = xp.clip(expected - n_unknowns, 0, None)
        return misfit <= freedom + _SIGMAS * xp.sqrt(variance)


def tangents(
    psi: NDArray, stop: NDArray, unknown_amplitude: bool, xp: Any, ratios: tuple[float, ...] = (1.0,)
) -> NDArray:
    """Change of the field per radian of phase, and per unit of amplitude: (k, p, ny, nx) to (k, c, p, ny, nx).

    The amplitude is that of one wavelength.
    """
    turned = along_phase(psi, ratios, xp)
    if not unknown_amplitude:
        return turned[:, np.newaxis, ...]
    modulus = xp.sqrt(square(psi))[:, np.newaxis, ...]
    dark = modulus == 0
    # The phase of a dark point is undefined: any direction will do.
    flat = xp.stack([stop, xp.zeros_like(stop)])[np.newaxis, ...]
    return xp.stack([turned, xp.where(dark, flat, psi / xp.where(dark, modulus + 1, modulus))], axis=1)


def require_information(sensor: Sensor, unknown_amplitude: bool) -> None:
    """Require masks that determine the phase, or the phase and the amplitude.

    With a reference wave t_k R behind mask k, each point of the frame gives |psi|^2 + 2 Re(conj(t_k R) psi). Three
    different t_k determine psi. Two allow another field at every point (`eq-circles`).

    Raises
    ------
    ValueError
        If no mask changes the light, or the amplitude is unknown and fewer than three masks are different.
    """
    cores = sensor.factors.core.reshape(sensor.n_masks, -1)
    strongest = float(np.linalg.norm(cores, axis=1).max())
    if not strongest > 1e-12:
        raise ValueError("sensor: none of its masks changes the light: expected at least one that does")
    different: list[NDArray] = []
    for core in cores:
        if all(np.linalg.norm(core - earlier) > _DISTINCT * strongest for earlier in different):
            different.append(core)
    if unknown_amplitude and len(different) < 3:
        raise ValueError(
            f"amplitude is unknown and the sensor has {len(different)} different "
            f"mask{'s' * (len(different) > 1)}: expected at least 3, since two frames allow two fields at every "
            "point; a clear frame is that of a mask that changes nothing, such as Dimple(1, 0)"
        )


def require_one_wavelength(sensor: Sensor) -> None:
    """Require one wavelength, for an unknown amplitude."""
    if len(sensor.channels.ratios) > 1:
        raise ValueError(
            f"amplitude is unknown and the sensor has {len(sensor.channels.ratios)} wavelengths: expected a known "
            "amplitude, or a ZernikeSensor"
        )


@dataclass(frozen=True, eq=False)
class Estimator:
    """Unknowns of a fit and the noise of the frames: the information and its inverse at any field."""

    response: Response
    noise: Noise
    unknown_amplitude: bool = False  # at every point
    modes: NDArray | None = None  # (m, ny, nx), whose coefficients are the unknowns
    precision: NDArray | None = None  # (m, m), inverse of their covariance before the measurement

    def information(self, psi: NDArray, waves: NDArray) -> Information:
        """Information at split fields: (k, p, ny, nx) in the pupil, (k, n_masks, p, ny', nx') on the detector."""
        kind = Kind.of(psi)
        constants = self.response.constants(kind)
        change = tangents(psi, constants.stop, self.unknown_amplitude, kind.xp, constants.ratios)
        return self.response.information(change, waves, self.noise.weights(square(waves)))

    def of_modes(self, information: Information) -> NDArray:
        """Information about the coefficients, that of the prior included: (k, m, m)."""
        kind = information.constants.kind
        result = information.onto(kind.array(self.modes))
        return result if self.precision is None else result + kind.array(self.precision)

    def variance(self, psi: NDArray, waves: NDArray) -> tuple[NDArray, NDArray | None]:
        """Variance of every point, (k, c, ny, nx), and of the coefficients, (k, m), if there are modes.

        Directions that the frames do not show have a large variance.
        """
        information = self.information(psi, waves)
        if self.modes is None:
            return information.constants.kind.xp.stack(information.inverse().variance(), axis=1), None
        xp, kind = information.constants.kind.xp, information.constants.kind
        modes = kind.array(self.modes)
        values, vectors = xp.linalg.eigh(self.of_modes(information))
        values = xp.maximum(values, _SINGULAR * values[:, -1:])
        vectors = vectors / xp.sqrt(values)[:, np.newaxis, :]
        flat = xp.reshape(modes, (modes.shape[0], -1))
        points = xp.sum((xp.matrix_transpose(vectors) @ flat) ** 2, axis=1)
        return xp.reshape(points, (-1, 1, *modes.shape[1:])), xp.sum(vectors**2, axis=2)
