"""Phase screens of turbulence, with the covariance of Kolmogorov or von Karman, and frozen flow."""

from __future__ import annotations

from math import ceil, gamma, inf, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.special import kv

from zwfs import _check
from zwfs._arrays import Immutable, read_only
from zwfs.modes import _STRONGEST
from zwfs.pupil import Pupil

_KOLMOGOROV = 2 * (24 / 5 * gamma(6 / 5)) ** (5 / 6)  # 6.88
_REACH = 2.0  # distance at which the embedded covariance ends, in units of the largest distance in the pupil

_BOX = 3.0  # D; screens in the wind repeat after this length


def structure_function(separation: ArrayLike, r0: float = 1.0, outer_scale: float = inf) -> NDArray[np.float64]:
    """Mean square of the phase difference between two points: 6.88 (r / r0)^(5/3) without an outer scale.

    Parameters
    ----------
    separation : array_like, any shape, D
        Distances of at least 0; `r0` and `outer_scale` may also share another unit with them.
    r0 : float, D
        Fried's parameter.
    outer_scale : float, D
        Outer scale of von Karman's spectrum, from 1e-9 to 1e5; infinity for Kolmogorov's.

    Returns
    -------
    ndarray, the shape of `separation`, radian^2

    References
    ----------
    Fried 1966, J. Opt. Soc. Am. 56, 1372; Conan 2008, J. Opt. Soc. Am. A 25, 527, equation (2).

    Examples
    --------
    >>> from zwfs.turbulence import structure_function
    >>> structure_function([0.0, 1.0], r0=0.5).round(3)
    array([ 0.   , 21.855])
    """
    distance = _check.real_array("separation", separation).astype(np.float64, copy=False)
    _check.moderate("separation", distance)
    _check.non_negative("separation", distance)
    r0, outer_scale = _scales(r0, outer_scale)
    if outer_scale == inf:
        return _KOLMOGOROV * (distance / r0) ** (5 / 3)
    x = 2 * pi * np.where(distance > 0, distance, 1.0) / outer_scale
    rise = gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x)
    return np.where(distance > 0, _plateau(r0, outer_scale) * rise, 0.0)


def turbulent_screens(
    pupil: Pupil,
    r0: float,
    n_screens: int,
    outer_scale: float = inf,
    seed: int | np.random.Generator | np.random.SeedSequence | None = None,
) -> NDArray[np.float64]:
    """Random screens whose structure function is exactly that of Kolmogorov or von Karman on the pupil.

    The covariance is continued beyond the largest distance in the pupil and ends at twice this distance. On a
    periodic grid the Fourier transform makes it diagonal, so that a screen is one transform of random numbers and
    a random tilt. No frequency is left out, in contrast to screens from a sampled spectrum.

    Parameters
    ----------
    pupil : Pupil
    r0 : float, D
        Fried's parameter, in pupil diameters: D / r0 = 10 is 0.1.
    n_screens : int
    outer_scale : float, D
        From 0.2 to 1e5; infinity for Kolmogorov's spectrum.
    seed : int, Generator or SeedSequence, optional
        Fewer screens from the same integer seed are the first of more.

    Returns
    -------
    ndarray, shape (n_screens, ny, nx), radian
        Piston removed, 0 outside the pupil.

    References
    ----------
    Stein 2002, J. Comput. Graph. Stat. 11, 587; Gneiting et al. 2006, J. Comput. Graph. Stat. 15, 483.

    Examples
    --------
    >>> import zwfs
    >>> from zwfs.turbulence import turbulent_screens
    >>> pupil = zwfs.Pupil.circular(32)
    >>> screens = turbulent_screens(pupil, r0=0.1, n_screens=10, outer_scale=20.0, seed=1)
    >>> screens.shape
    (10, 32, 32)
    """
    _check.instance("pupil", pupil, Pupil)
    r0, outer_scale = _scales(r0, outer_scale, smallest=0.2)
    n_screens = _check.count("n_screens", n_screens, pupil.amplitude.size)
    rng = _check.generator("seed", seed)
    rows, columns = np.unravel_index(pupil.indices, pupil.shape)
    # All points lie within half of this distance from the middle of their bounding box.
    middle = [(axis.min() + axis.max()) / 2 for axis in (rows, columns)]
    largest = max(2 * np.hypot(rows - middle[0], columns - middle[1]).max(), 1.0)
    unit = largest / pupil.n_pixels
    n = fft.next_fast_len(ceil(2 * _REACH * largest))
    steps = np.minimum(np.arange(n), n - np.arange(n)) / largest
    covariance, t = _continued(np.hypot(steps[:, np.newaxis], steps), r0 / unit, outer_scale / unit)
    # Rounding makes eigenvalues near 0 negative.
    scale = np.sqrt(np.maximum(fft.fft2(covariance).real, 0)) / n
    places = np.stack([rows, columns]) * sqrt(2 * t) / largest
    screens = np.empty((n_screens + n_screens % 2, pupil.n_points))
    for pair in range(0, n_screens, 2):  # the real and the imaginary part are independent
        noise = rng.standard_normal((2, n, n))
        field = fft.fft2(scale * (noise[0] + 1j * noise[1]))[rows, columns]
        screens[pair : pair + 2] = np.stack([field.real, field.imag]) + rng.standard_normal((2, 2)) @ places
    values = screens[:n_screens]
    return pupil.scatter(values - values.mean(axis=1, keepdims=True), fill=0.0)


class FrozenFlow(Immutable):
    """Random screens that a wind carries across the pupil without a change of form.

    Parameters
    ----------
    pupil : Pupil
    rms : float, radian
        Of each screen at the start.
    n_screens : int
    speed : float, D/s
        Of the wind; its direction is random. The screens repeat after 3 D.
    cutoff : float, cycles/D
        Largest spatial frequency, from 0.5 to half of the pixels across D.
    exponent : float
        Of the power spectral density.
    seed : int, Generator or SeedSequence, optional

    Attributes
    ----------
    velocity : ndarray, shape (n_screens, 2), D/s
        Along y and x.

    Examples
    --------
    Screens at a rate of 1 kHz, for `zwfs.close_loop`:

    >>> import zwfs
    >>> from zwfs.turbulence import FrozenFlow
    >>> pupil = zwfs.Pupil.circular(24)
    >>> flow = FrozenFlow(pupil, rms=0.5, n_screens=12, seed=1)
    >>> screens = [flow(step / 1000) for step in range(40)]
    >>> screens[0].shape, pupil.rms(screens[0]).round(6)[0]
    ((12, 24, 24), np.float64(0.5))
    """

    def __init__(
        self,
        pupil: Pupil,
        rms: float,
        n_screens: int,
        *,
        speed: float = 2.5,
        cutoff: float = 5.0,
        exponent: float = -2.0,
        seed: int | np.random.Generator | np.random.SeedSequence | None = None,
    ) -> None:
        _check.instance("pupil", pupil, Pupil)
        rms = _check.number("rms", rms, 0, _STRONGEST)
        n_screens = _check.count("n_screens", n_screens, pupil.amplitude.size)
        speed = _check.number("speed", speed, 0, 1e6)
        cutoff = _check.number("cutoff", cutoff, 0.5, pupil.n_pixels / 2)
        exponent = _check.number("exponent", exponent, -20, 20)
        rng = _check.generator("seed", seed)
        self.pupil = pupil
        n = int(cutoff * _BOX)
        u = np.arange(-n, n + 1) / _BOX  # frequencies along x, cycles / D
        v = u[:, np.newaxis]  # the same along y
        amplitudes = _random_amplitudes(np.hypot(u, v), cutoff, exponent, n_screens, rng)
        # A screen is the sum of a(v, u) exp(2 pi i (v y + u x)): two matrix products.
        self._waves_y = read_only(np.exp(2j * np.pi * np.outer(pupil.y, u)))
        self._waves_x = read_only(np.exp(2j * np.pi * np.outer(u, pupil.x)))
        # A wind (wy, wx) moves it to y - wy t, x - wx t: each amplitude turns by -2 pi (wy v + wx u) t.
        direction = rng.uniform(0, 2 * np.pi, n_screens)
        self.velocity = read_only(speed * np.stack([np.sin(direction), np.cos(direction)], axis=-1))
        wy, wx = self.velocity.T[..., np.newaxis, np.newaxis]
        self._turn = read_only(-2j * np.pi * (wy * v + wx * u))
        scale = rms / pupil.rms(self._screens(amplitudes))
        self._amplitudes = read_only(amplitudes * scale[:, np.newaxis, np.newaxis])

    def __call__(self, time: float) -> NDArray[np.float64]:
        """Screens at a time.

        Parameters
        ----------
        time : float, second

        Returns
        -------
        ndarray, shape (n_screens, ny, nx), radian
            Piston removed, 0 outside the pupil.
        """
        return self._screens(self._amplitudes * np.exp(self._turn * _check.number("time", time, -1e9, 1e9)))

    def _screens(self, amplitudes: NDArray) -> NDArray[np.float64]:
        inside = self.pupil.gather((self._waves_y @ amplitudes @ self._waves_x).real)
        return self.pupil.scatter(inside - inside.mean(axis=-1, keepdims=True), fill=0)


def _random_amplitudes(
    frequency: NDArray, cutoff: float, exponent: float, n_screens: int, rng: np.random.Generator
) -> NDArray[np.complex128]:
    """Gaussian amplitudes whose power falls as a power of the frequency; 0 for piston and beyond the cutoff."""
    used = (frequency > 0) & (frequency <= cutoff)
    scale = np.where(used, np.where(used, frequency, 1) ** (exponent / 2), 0)
    real, imaginary = rng.standard_normal((2, n_screens, *frequency.shape))
    return scale * (real + 1j * imaginary)


def _continued(distance: NDArray, r0: float, outer_scale: float) -> tuple[NDArray[np.float64], float]:
    """Covariance that gives the structure function D up to a distance of 1 and is 0 from R = `_REACH` on.

    It is c0 + t r^2 - D(r) / 2 up to 1, then s (R - r)^3 / r. A random tilt of variance 2 t makes up for t r^2.
    Value and first derivative agree at 1; the second derivative agrees, too, unless t would be negative.

    Returns
    -------
    covariance : ndarray, the shape of `distance`
    t : float
    """
    R = _REACH
    steepness = (R - 1) ** 2 * (R + 2)
    first, second = _derivatives(r0, outer_scale)
    s = (first - second) / (6 * R * (R**2 - 1))
    t = (first / 2 - s * steepness) / 2
    if t < 0:
        s, t = first / 2 / steepness, 0.0
    c0 = s * (R - 1) ** 3 + float(structure_function(1.0, r0, outer_scale)) / 2 - t
    near = c0 + t * distance**2 - structure_function(distance, r0, outer_scale) / 2
    far = s * (R - np.minimum(distance, R)) ** 3 / np.maximum(distance, 1.0)
    return np.where(distance <= 1, near, far), t


def _derivatives(r0: float, outer_scale: float) -> tuple[float, float]:
    """First and second derivative of the structure function at a separation of 1."""
    if outer_scale == inf:
        first = 5 / 3 * _KOLMOGOROV * r0 ** (-5 / 3)
        return first, 2 / 3 * first
    x = 2 * pi / outer_scale
    plateau = _plateau(r0, outer_scale)
    first = plateau * x ** (11 / 6) * kv(1 / 6, x)
    second = plateau * x**2 * (2 / 3 * x ** (-1 / 6) * kv(1 / 6, x) - x ** (5 / 6) * kv(5 / 6, x))
    return float(first), float(second)


def _plateau(r0: float, outer_scale: float) -> float:
    """Factor of von Karman's structure function, radian^2."""
    factor = 2 ** (1 / 6) * gamma(11 / 6) / pi ** (8 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    return factor * (outer_scale / r0) ** (5 / 3)


def _scales(r0: float, outer_scale: float, smallest: float = 1e-9) -> tuple[float, float]:
    """Return checked scales."""
    r0 = _check.number("r0", r0, 1e-9)
    if isinstance(outer_scale, float) and outer_scale == inf:
        return r0, inf
    return r0, _check.number("outer_scale", outer_scale, smallest, 1e5)
