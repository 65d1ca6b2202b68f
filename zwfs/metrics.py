"""Metrics of a reconstruction: errors, Strehl ratio, dynamic range."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.pupil import Pupil

__all__ = ["dynamic_range", "reconstruction_error", "strehl", "wrapped_residual"]


def wrapped_residual(pupil: Pupil, estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.floating]:
    """Difference of two phases, on the circle and without piston.

    Parameters
    ----------
    pupil : Pupil
    estimate, truth : array_like, shapes (..., ny, nx) that broadcast, radian

    Returns
    -------
    ndarray, shape (..., ny, nx), radian
        In (-pi, pi], NaN outside the pupil. The piston is the argument of the mean phasor of the difference.

    References
    ----------
    Chambouleyron et al. 2024, section 4.1; `eq-error` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> residual = zwfs.wrapped_residual(pupil, np.full(pupil.shape, 0.3), np.zeros(pupil.shape))
    >>> float(np.nanmax(np.abs(residual))) < 1e-12  # a piston is no error
    True
    """
    residual = _residual(pupil, estimate, truth)  # the pupil is checked
    return pupil.scatter(residual)


def reconstruction_error(pupil: Pupil, estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.floating]:
    """Rms over the pupil of the `wrapped_residual`; parameters and errors are the same.

    Returns
    -------
    ndarray, shape (...), radian rms

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> tilt = 0.1 * zwfs.zernike_basis(pupil, 1)[0]
    >>> round(float(zwfs.reconstruction_error(pupil, tilt, np.zeros(pupil.shape))), 3)
    0.1
    """
    return np.sqrt(np.mean(_residual(pupil, estimate, truth) ** 2, axis=-1))


def without_piston(phase: ArrayLike) -> NDArray[Any]:
    """Phases on the circle around their mean phasor: (..., n_points) to the same, radian, in (-pi, pi].

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> zwfs.metrics.without_piston(np.array([1.0, 1.2, 1.7])).round(3)
    array([-0.298, -0.098,  0.402])
    """
    phase = _check.real_array("phase", phase)
    if 0 in (phase.ndim, phase.size):
        raise ValueError(f"phase has shape {phase.shape}: expected (..., n_points), not empty")
    _check.finite("phase", phase)
    phasor = np.cos(phase) + 1j * np.sin(phase)  # np.exp of complex64 is 20 times slower
    return np.angle(phasor * np.conj(phasor.mean(axis=-1, keepdims=True)))


def strehl(pupil: Pupil, phase: ArrayLike) -> NDArray[np.floating]:
    """Strehl ratio: intensity on the axis of the focal plane over that of a flat wavefront.

    Parameters
    ----------
    pupil : Pupil
        Its amplitude weighs the points.
    phase : array_like, shape (..., ny, nx), radian

    Returns
    -------
    ndarray, shape (...)

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> tilt = 0.1 * zwfs.zernike_basis(pupil, 1)[0]
    >>> round(float(zwfs.strehl(pupil, tilt)), 3)  # close to exp(-0.1**2)
    0.99
    """
    _check.instance("pupil", pupil, Pupil)
    values = _check.values_inside("phase", phase, pupil)
    weight = pupil.gather(pupil.amplitude)
    return np.abs(np.exp(1j * values) @ weight / weight.sum()) ** 2


def dynamic_range(rms: ArrayLike, error: ArrayLike, threshold: float = 0.05) -> float:
    """Input rms at which the error of a reconstructor first exceeds a fraction of the input.

    The logarithm of the ratio of error to input is interpolated linearly between the samples where it crosses the
    threshold for the first time. Samples at an input of 0 have no ratio and are left out.

    Parameters
    ----------
    rms : array_like, shape (n,), radian rms
        Input, increasing.
    error : array_like, shape (n,), radian rms
        Error of the reconstruction, such as the mean over the screens.
    threshold : float
        Largest ratio of error to input that counts as satisfactory: 5 % in the paper.

    Returns
    -------
    float, radian rms
        0 if already the smallest input is above the threshold, infinity if no input is.

    Raises
    ------
    ValueError
        If `rms` does not increase, or no input is above 0.

    References
    ----------
    Chambouleyron et al. 2024, section 4.1.

    Examples
    --------
    >>> import zwfs
    >>> round(zwfs.dynamic_range([0.1, 0.2, 0.3], [0.001, 0.004, 0.03]), 3)
    0.257
    """
    rms, error = _check.real_array("rms", rms), _check.real_array("error", error)
    if rms.ndim != 1 or rms.shape != error.shape or not rms.size:
        raise ValueError(
            f"rms and error have shapes {rms.shape} and {error.shape}: expected the same (n,), with n at least 1"
        )
    threshold = _check.number("threshold", threshold, 0, open_low=True)
    _check.finite("rms", rms)
    _check.finite("error", error)
    _check.non_negative("rms", rms)
    _check.non_negative("error", error)
    if np.any(np.diff(rms) <= 0) or not np.any(rms > 0):
        raise ValueError(f"rms = {rms}: expected increasing values, some of them above 0")
    ratio = error[rms > 0] / rms[rms > 0]
    rms = rms[rms > 0]
    above = np.flatnonzero(ratio > threshold)
    if not above.size:
        return np.inf
    last = above[0]
    if last == 0:
        return 0.0
    low, high = np.log(np.maximum(ratio[last - 1 : last + 1], np.finfo(float).tiny))
    step = (np.log(threshold) - low) / (high - low)
    return float(rms[last - 1] + step * (rms[last] - rms[last - 1]))


def _residual(pupil: Pupil, estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.floating]:
    _check.instance("pupil", pupil, Pupil)
    estimate = _check.values_inside("estimate", estimate, pupil)
    truth = _check.values_inside("truth", truth, pupil)
    _check.broadcast(estimate=estimate, truth=truth)
    return without_piston(estimate - truth)
