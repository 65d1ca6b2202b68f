"""Zernike and Fourier modes, and random phase screens made of modes."""

from __future__ import annotations

from math import isqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.pupil import Pupil

_STRONGEST = 1e9  # radian rms of a screen: 100 m of optical path


def noll_to_nm(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of Noll's mode j.

    Positive m stands for cos(m theta), negative m for sin(|m| theta); j = 1 is piston.

    References
    ----------
    Noll 1976, J. Opt. Soc. Am. 66, 207, table I.

    Examples
    --------
    >>> import zwfs
    >>> zwfs.noll_to_nm(4)  # focus
    (2, 0)
    """
    j = _check.integer("j", j, 1)
    n = (isqrt(8 * j - 7) - 1) // 2
    position = j - n * (n + 1) // 2
    m = 2 * (position // 2) if n % 2 == 0 else 2 * ((position - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def zernike_basis(pupil: Pupil, n_modes: int, *, orthonormal: bool | None = None) -> NDArray[np.float64]:
    """Zernike modes on a pupil: Noll 2 to `n_modes` + 1.

    The radial part comes from the three-term recurrence of the Jacobi polynomials, the angular part from powers
    of x + iy: neither loses digits beyond 1000 modes, where factorials do.

    Parameters
    ----------
    pupil : Pupil
    n_modes : int
        Number of modes, piston not counted.
    orthonormal : bool, optional
        Make the modes orthonormal over the sampled pupil (Gram-Schmidt in Noll's order, piston first). On an
        obscured or segmented pupil the plain modes are not. The default is True for a measured pupil, see `Pupil`.

    Returns
    -------
    ndarray, shape (n_modes, ny, nx)
        0 outside. Each mode has zero mean and unit rms over the points inside.

    Raises
    ------
    ValueError
        If the modes are not independent on the points, or there are points farther than D/2 from the axis.

    References
    ----------
    Noll 1976, J. Opt. Soc. Am. 66, 207.

    Examples
    --------
    >>> import zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> modes = zwfs.zernike_basis(pupil, 10)
    >>> modes.shape, float(pupil.rms(modes[0]).round(6))
    ((10, 32, 32), 1.0)
    """
    _check.instance("pupil", pupil, Pupil)
    n_modes = _check.count("n_modes", n_modes, pupil.amplitude.size)
    orthonormal = pupil.measured if orthonormal is None else _check.flag("orthonormal", orthonormal)
    if n_modes >= pupil.n_points:
        raise ValueError(
            f"n_modes = {n_modes}: expected fewer modes than the {pupil.n_points} points of the pupil"
        )
    disc = 2 * (pupil.points[:, 0] + 1j * pupil.points[:, 1])
    reach = np.abs(disc).max() / 2
    if reach > 0.5 + 1 / pupil.n_pixels:
        raise ValueError(
            f"pupil reaches {reach:.4g} D from its axis: expected at most 0.5 D; "
            "give from_amplitude the n_pixels of the circle around it"
        )
    values = _unnormalised(disc, n_modes)
    values -= values.mean(axis=1, keepdims=True)
    if orthonormal:
        values = _orthonormalise(values)
    scale = values.std(axis=1, keepdims=True)
    if not scale.min() > 1e-12:
        raise ValueError(
            f"n_modes = {n_modes}: the modes are not independent on the {pupil.n_points} points of the pupil"
        )
    return pupil.scatter(values / scale, fill=0.0)


def power_law_screens(
    modes: ArrayLike,
    rms: float,
    n_screens: int,
    exponent: float = -2.0,
    seed: int | np.random.Generator | np.random.SeedSequence | None = None,
    *,
    frequencies: ArrayLike | None = None,
) -> NDArray[np.floating]:
    """Random phase screens whose power spectral density falls as a power of the spatial frequency.

    The paper defines "an f^-2 power spectral density defined on the first 200 Zernike polynomials". We read it so:
    the coefficients are independent normal numbers, and a mode of radial order n, which oscillates n/2 times
    across the diameter, has a variance proportional to n to the power of `exponent`. Modes are spread evenly over
    the plane of spatial frequencies, so the variance of a mode follows the density at its frequency.

    Parameters
    ----------
    modes : array_like, shape (n_modes, ny, nx)
        Modes of zero mean and unit rms, 0 outside the pupil. Without `frequencies` they are Zernike modes in
        Noll's order from 2 on, as `zernike_basis` returns them.
    rms : float, radian
        Every screen is scaled to exactly this rms over the pupil, piston removed.
    n_screens : int
    exponent : float
        Exponent of the power spectral density, in [-20, 20].
    seed : int, Generator or SeedSequence, optional
        Fewer screens from the same integer seed are the first of more.
    frequencies : array_like, shape (n_modes,), cycles / D, optional
        Spatial frequency of each mode, for modes in another order, see `mode_frequencies`. The variance of a mode
        is proportional to its frequency to the power of `exponent`.

    Returns
    -------
    ndarray, shape (n_screens, ny, nx), radian
        0 outside the pupil; the dtype of the modes.

    Raises
    ------
    ValueError
        If the modes have different rms, or are no Zernike modes and have no `frequencies`.

    References
    ----------
    Chambouleyron et al. 2024, section 4.1; `eq-screens` of the book.

    Examples
    --------
    >>> import zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> screens = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 50), rms=0.5, n_screens=3, seed=1)
    >>> pupil.rms(screens).round(6)
    array([0.5, 0.5, 0.5])
    """
    modes = _check.real_array("modes", modes)
    if modes.ndim != 3 or 0 in modes.shape:
        raise ValueError(f"modes has shape {modes.shape}: expected (n_modes, ny, nx)")
    rms = _check.number("rms", rms, 0, _STRONGEST)
    n_screens = _check.count("n_screens", n_screens, max(modes[0].size, len(modes)))
    exponent = _check.number("exponent", exponent, -20, 20)
    rng = _check.generator("seed", seed)
    _check.moderate("modes", modes)
    flat = modes.reshape(len(modes), -1)
    # The sum of squares of a mode of unit rms is the number of points inside.
    n_points = np.einsum("ij,ij->i", flat, flat, dtype=np.float64)
    if not (0 < n_points.min() < np.inf and np.allclose(n_points, n_points[0], rtol=1e-3)):
        raise ValueError("modes have different rms: expected unit rms each, as zernike_basis gives them")
    scales = _noll_orders(modes) if frequencies is None else _frequencies(frequencies, len(modes))
    coefficients = rng.standard_normal((n_screens, len(modes)))
    coefficients *= scales ** (exponent / 2)
    screens = coefficients.astype(modes.dtype) @ flat
    power = np.einsum("ij,ij->i", screens, screens, dtype=np.float64) / n_points[0]
    screens *= (rms / np.sqrt(power)).astype(modes.dtype)[:, np.newaxis]
    return screens.reshape(n_screens, *modes.shape[1:])


def _noll_orders(modes: NDArray) -> NDArray[np.float64]:
    """Radial orders of modes that must be Zernike modes: the first five are polynomials of their order."""
    y, x = np.nonzero(np.any(modes[:5] != 0, axis=0))
    u, v = (2 * axis / max(axis.max(initial=1), 1) - 1 for axis in (x, y))
    orders = np.array([noll_to_nm(j)[0] for j in range(2, len(modes) + 2)], np.float64)
    for order in (1, 2):
        first = modes[:5][orders[:5] == order][:, y, x].T
        terms = np.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], axis=-1)
        basis = np.linalg.qr(terms)[0]
        if np.linalg.norm(first - basis @ (basis.T @ first)) > 1e-3 * np.linalg.norm(first):
            raise ValueError(
                "modes are not Zernike modes in Noll's order: expected their frequencies, such as "
                "frequencies=mode_frequencies(pupil, modes)"
            )
    return orders


def _frequencies(values: ArrayLike, n_modes: int) -> NDArray[np.float64]:
    values = _check.real_map("frequencies", values, n_axes=1)
    if len(values) != n_modes or values.min() <= 0:
        expected = f"{n_modes} positive numbers, one for each of the modes"
        raise ValueError(f"frequencies = {_check.shown(values)}: expected {expected}")
    return values


def fourier_basis(pupil: Pupil, n_modes: int) -> NDArray[np.float64]:
    """Cosines and sines of whole cycles per D in each direction, by growing frequency.

    Parameters
    ----------
    pupil : Pupil
    n_modes : int
        Number of modes: a cosine, then a sine, of each frequency.

    Returns
    -------
    ndarray, shape (n_modes, ny, nx)
        0 outside. Each mode has zero mean and unit rms over the points inside.

    Raises
    ------
    ValueError
        If a frequency would exceed half a cycle per pixel.

    Examples
    --------
    >>> import zwfs
    >>> from zwfs.modes import fourier_basis, mode_frequencies
    >>> pupil = zwfs.Pupil.circular(64)
    >>> mode_frequencies(pupil, fourier_basis(pupil, 200))[[0, 50, 100, 198]].round(1)
    array([1.1, 4.1, 5.8, 7.9])
    """
    _check.instance("pupil", pupil, Pupil)
    n_modes = _check.count("n_modes", n_modes, pupil.amplitude.size)
    if n_modes >= pupil.n_points:
        raise ValueError(f"n_modes = {n_modes}: expected fewer than the {pupil.n_points} points of the pupil")
    reach = isqrt(n_modes) + 1
    # One of each pair of opposite frequencies, whose modes are the same.
    half = [(u, v) for u in range(reach + 1) for v in range(-reach, reach + 1) if u > 0 or v > 0]
    half = sorted(half, key=lambda uv: (uv[0] ** 2 + uv[1] ** 2, -uv[0], -uv[1]))[: (n_modes + 1) // 2]
    highest = max(max(abs(u), abs(v)) for u, v in half)
    if 2 * highest >= pupil.n_pixels:
        raise ValueError(f"n_modes = {n_modes}: expected fewer on a pupil of {pupil.n_pixels:g} pixels")
    phases = 2 * np.pi * pupil.points @ np.array(half, float).T
    values = np.stack([np.cos(phases), np.sin(phases)], axis=-1).reshape(pupil.n_points, -1)[:, :n_modes].T
    values = values - values.mean(axis=1, keepdims=True)
    return pupil.scatter(values / values.std(axis=1, keepdims=True), fill=0.0)


def mode_frequencies(pupil: Pupil, modes: ArrayLike) -> NDArray[np.float64]:
    """Spatial frequency of each mode: the rms of its slope over 2 pi times its rms.

    For cosines and sines of one cycle per D it is right to 10 %, for more cycles it is more accurate.

    Parameters
    ----------
    pupil : Pupil
    modes : array_like, shape (n_modes, ny, nx)

    Returns
    -------
    ndarray, shape (n_modes,), cycles / D

    Examples
    --------
    >>> import zwfs
    >>> from zwfs.modes import mode_frequencies
    >>> pupil = zwfs.Pupil.circular(64)
    >>> tilt, *_, last = mode_frequencies(pupil, zwfs.zernike_basis(pupil, 200))
    >>> print(f"{tilt:.2f}, {last:.2f}")
    0.64, 12.01
    """
    _check.instance("pupil", pupil, Pupil)
    at_points = _check.modes("modes", modes, pupil)
    if np.any(np.ptp(at_points, axis=1) <= 1e-12 * np.abs(at_points).max(axis=1)):
        raise ValueError("modes: some are constant in the pupil: expected modes other than piston")
    values = pupil.scatter(at_points)
    power = np.zeros(len(values))
    for axis in (-2, -1):
        slopes = np.diff(values, axis=axis) * pupil.n_pixels
        power += np.nanmean(slopes**2, axis=(-2, -1))
    return np.sqrt(power) / (2 * np.pi * np.nanstd(values, axis=(-2, -1)))


def _unnormalised(disc: NDArray[np.complex128], n_modes: int) -> NDArray[np.float64]:
    """Modes without their norm, at the points `disc` = x + iy of the unit disc: (n_modes, n_points)."""
    orders = [noll_to_nm(j) for j in range(2, n_modes + 2)]
    rows: dict[tuple[int, int], list[int]] = {}
    for row, (n, m) in enumerate(orders):
        rows.setdefault((n, abs(m)), []).append(row)
    n_max = orders[-1][0]
    t = 2 * np.abs(disc) ** 2 - 1
    values = np.empty((n_modes, disc.size))
    angular = np.ones_like(disc)
    for m in range(n_max + 1):
        for k, radial in enumerate(_jacobi(t, m, (n_max - m) // 2)):
            for row in rows.get((m + 2 * k, m), ()):
                values[row] = radial * (angular.real if orders[row][1] >= 0 else angular.imag)
        angular *= disc
    return values


def _jacobi(t: NDArray, m: int, k_max: int) -> list[NDArray]:
    """Jacobi polynomials P_k^(0,m)(t) for k = 0 to `k_max`, by their recurrence in k."""
    polynomials = [np.ones_like(t), (m + 2) / 2 * t - m / 2]
    for k in range(2, k_max + 1):
        c = 2 * k + m
        rise = (c - 1) * (c * (c - 2) * t - m * m) * polynomials[-1] - 2 * (k - 1) * (k + m - 1) * c * polynomials[
            -2
        ]
        polynomials.append(rise / (2 * k * (k + m) * (c - 2)))
    return polynomials[: k_max + 1]


def _orthonormalise(values: NDArray) -> NDArray:
    q, r = np.linalg.qr(values.T)
    diagonal = np.diagonal(r)
    if np.abs(diagonal).min() < 1e-10 * np.abs(diagonal).max():
        raise ValueError(f"n_modes = {len(values)}: the modes are not independent on the points of this pupil")
    # QR leaves the sign of each mode free: keep that of the mode it came from.
    return (q * np.sign(diagonal)).T
