"""Variations of the phase-shifted sensor, section 4.2 of the paper: diameter of the dimple, pair of phase shifts.

Everything rests on one identity. With beta the part of the field psi that passes through the dimple and
c_k = exp(i theta_k) - 1, the frame of mask k is |psi|^2 + 2 Re(conj(c_k) W) with

    W = conj(beta) (psi - beta),

because |c_k|^2 = -2 Re(c_k). Two frames of an allowed pair are equivalent to the complex map W, whatever the pair.
A step of the phase-shifted iteration therefore solves conj(beta) (psi' - beta) = W for psi', with the beta of the
estimate before, and keeps its phase: the phase shifts drop out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.companion import sweeps
from zwfs.lowrank import factorise
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

DARK_RING = 2 * 1.2196698912665045
"""Diameter of the first dark ring of the Airy pattern, lambda/D: twice the first zero of J1(pi r)."""

_TOLERANCE = 1e-12  # of the low-rank factors, as the spectrum is to be exact where the iteration is


@dataclass(frozen=True)
class DiameterCurve:
    """Error of a reconstructor against the diameter of the dimple.

    Attributes
    ----------
    diameters : ndarray, shape (n_diameters,), lambda/D
    errors : ndarray, shape (n_diameters, n_screens), radian rms
    """

    diameters: NDArray[np.float64]
    errors: NDArray[np.float64]

    @property
    def mean(self) -> NDArray[np.float64]:
        """Mean error over the screens, shape (n_diameters,), radian rms."""
        return self.errors.mean(axis=1)

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviation of the error over the screens, shape (n_diameters,), radian rms."""
        return self.errors.std(axis=1)

    def at(self, diameter: float) -> float:
        """Mean error at the sampled diameter (lambda/D) next to `diameter`, radian rms."""
        return float(self.mean[np.argmin(np.abs(self.diameters - _check.number("diameter", diameter)))])

    def leaves(self, limit: float, start: float = 0.0) -> float:
        """Diameter, from `start` on, at which the mean error rises above `limit`; see `crossing`."""
        used = self.diameters >= _check.number("start", start) - 1e-9
        if not used.any():
            raise ValueError(f"start = {start:g}: expected at most the last diameter, {self.diameters[-1]:g}")
        return crossing(self.diameters[used], self.mean[used], limit)


def crossing(x: ArrayLike, y: ArrayLike, limit: float) -> float:
    """Where a sampled positive curve rises above a limit for the first time.

    Parameters
    ----------
    x : array_like, shape (n,)
        Increasing.
    y : array_like, shape (n,)
        Positive; its logarithm is interpolated linearly.
    limit : float
        In the unit of `y`.

    Returns
    -------
    float
        In the unit of `x`; `x[0]` if the curve starts above the limit, infinity if it never gets there.

    Raises
    ------
    ValueError
        If the shapes differ, `x` does not increase or is not finite, or a value of `y` is not positive and finite.
    """
    x, y = _check.real_array("x", x), _check.real_array("y", y)
    if x.ndim != 1 or x.shape != y.shape or not x.size:
        raise ValueError(f"x and y have shapes {x.shape} and {y.shape}: expected the same (n,)")
    limit = _check.number("limit", limit, 0, open_low=True)
    _check.finite("x", x)
    _check.finite("y", y)
    if np.any(np.diff(x) <= 0) or np.any(y <= 0):
        raise ValueError("x, y: expected increasing x and positive y")
    above = np.flatnonzero(y > limit)
    if not above.size:
        return np.inf
    last = above[0]
    if last == 0:
        return float(x[0])
    low, high = np.log(y[last - 1 : last + 1])
    return float(x[last - 1] + (np.log(limit) - low) / (high - low) * (x[last] - x[last - 1]))


def diameter_curve(make: Callable[[float], Any], diameters: ArrayLike, screens: NDArray) -> DiameterCurve:
    """Error of a reconstructor on the same screens for dimples of several diameters: the experiment of Figure 4.

    A diameter is a task of the sweep "diameter_curve", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    make : callable
        `make(diameter)` gives a reconstructor for a sensor with dimples of that diameter (lambda/D).
    diameters : array_like, shape (n_diameters,), lambda/D
    screens : ndarray, shape (n_screens, ny, nx), radian

    Returns
    -------
    DiameterCurve

    Raises
    ------
    ValueError
        If there are no screens, or the diameters are not a list of positive, increasing numbers.

    References
    ----------
    Chambouleyron et al. 2024, section 4.2 and Figure 4.
    """
    _check.function("make", make)
    diameters = _check.real_array("diameters", diameters)
    _check.finite("diameters", diameters)
    if diameters.ndim != 1 or not diameters.size or diameters[0] <= 0 or np.any(np.diff(diameters) <= 0):
        raise ValueError(f"diameters = {_check.shown(diameters)}: expected positive, increasing values")
    screens = _check_screens(screens)
    rows = sweeps.run(_diameter_point, diameters.tolist(), make, screens, name="diameter_curve")
    return DiameterCurve(diameters, np.array(rows))


def _diameter_point(diameter: float, make: Callable[[float], Any], screens: NDArray) -> NDArray[np.floating]:
    """One diameter of the curve: error on each screen, (n_screens,)."""
    reconstructor = make(diameter)
    sensor = _check.sensor_of("make", reconstructor)
    screens = sensor.pupil.scatter(_check.values_inside("screens", screens, sensor.pupil), fill=0)
    return reconstruction_error(sensor.pupil, reconstructor(sensor.measure(screens)).phase, screens)


class DimpleLight:
    """The part of a field that passes through a dimple, beta, at the points of the pupil.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D

    References
    ----------
    Chambouleyron et al. 2024, equation (11); `eq-dimple-reference` and `eq-low-rank` of the book.
    """

    def __init__(self, pupil: Pupil, diameter: float) -> None:
        _check.instance("pupil", pupil, Pupil)
        # The focal field of a sampled pupil repeats after as many lambda/D as there are pixels across D.
        self.diameter = diameter = _check.number("diameter", diameter, 0, pupil.n_pixels, open_low=True)
        self.pupil = pupil
        axes = (pupil.y, pupil.x)
        # For a phase shift of pi the reference wave is -2 beta.
        factors = factorise((Dimple(diameter, np.pi),), axes, axes, pupil.n_pixels**-2.0, _TOLERANCE)
        self._factors = factors
        self._core = factors.core[0].T.real / -2

    @property
    def rank(self) -> int:
        """Number of coefficients that beta is made of."""
        return self._factors.pupil.rank

    def __call__(self, field: NDArray) -> NDArray[np.complex128]:
        """Beta of complex fields at the points of the pupil, (k, n_points) to (k, n_points)."""
        return self.expand(self.project(field) @ self._core)

    def project(self, field: NDArray) -> NDArray[np.complex128]:
        """Coefficients of fields, (k, n_points) to (k, rank)."""
        field = self._rows("field", field, self.pupil.n_points).astype(np.complex128)
        return self._factors.pupil.project(self.pupil.scatter(field, fill=0))

    def expand(self, coefficients: NDArray) -> NDArray:
        """Fields of coefficients on the detector side, (k, rank) to (k, n_points)."""
        coefficients = self._rows("coefficients", coefficients, self.rank)
        return self.pupil.gather(self._factors.detector.expand(coefficients))

    def _rows(self, name: str, values: NDArray, n: int) -> NDArray:
        """Checked numbers, real or complex, shape (k, n)."""
        values = _check.plain_array(name, values)
        values = (_check.complex_array if values.dtype.kind == "c" else _check.real_array)(name, values)
        if values.ndim != 2 or values.shape[1] != n:
            raise ValueError(f"{name} has shape {values.shape}: expected (k, {n})")
        _check.finite(name, values)
        return values

    def functions(self) -> NDArray[np.float64]:
        """Beta of a unit coefficient each, shape (rank, n_points)."""
        return self.expand(np.ascontiguousarray(self._core))


def linearised_step(pupil: Pupil, diameter: float, phase: ArrayLike, error: ArrayLike) -> NDArray[np.float64]:
    """What one phase-shifted step makes of a small error of its estimate, whatever the pair of phase shifts.

    With delta = i K[psi error], the change of beta (K being the dimple), the error after the step is
    Im(delta / beta) - 2 Re(delta / beta) Im(conj(beta) psi) / |psi|^2. Around a flat wavefront and a real
    positive beta = b this is K[A error] / b, a weighted mean of the error where the kernel is positive.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    phase : array_like, shape (ny, nx), radian
        True phase, at which the iteration is linearised.
    error : array_like, shape (..., ny, nx), radian
        Error of the estimate before the step.

    Returns
    -------
    ndarray, shape (..., ny, nx), radian
        Error after it, NaN outside the pupil. A piston comes back unchanged.

    Raises
    ------
    ValueError
        If a shape is wrong.

    References
    ----------
    Chambouleyron et al. 2024, section 3.1; `eq-linear-system` of the book.
    """
    phase = _check_map(pupil, "phase", phase)
    light, psi, beta = _linearised(pupil, diameter, phase)
    error = _check.real_array("error", error)
    _check.maps("error", error, pupil.shape)
    change = pupil.gather(error).reshape(-1, pupil.n_points)
    _check.finite("error", change, " inside the pupil")
    after = _after(psi, beta, light(1j * psi * change))
    return pupil.scatter(after.reshape(*error.shape[:-2], -1))


def iteration_spectrum(pupil: Pupil, diameter: float, phase: ArrayLike | None = None) -> NDArray[np.complex128]:
    """Eigenvalues of the linearised phase-shifted step, piston left out.

    The step only sees the few coefficients of beta, so all eigenvalues but zeros are those of a matrix of twice
    their number. The iteration converges to the true phase from nearby if the first one is inside the unit
    circle, and its modulus is the factor by which an iteration then multiplies the error.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    phase : array_like, shape (ny, nx), radian, optional
        True phase; flat if left out.

    Returns
    -------
    ndarray of complex, shape (2 rank - 1,)
        Largest modulus first.

    Raises
    ------
    ValueError
        If the shape of the phase is wrong.
    """
    light, psi, beta = _linearised(pupil, diameter, phase)
    functions = light.functions()
    # Real and imaginary parts of the coefficients of the change of the field, before and after.
    after = np.concatenate([_after(psi, beta, functions), _after(psi, beta, 1j * functions)])
    coefficients = light.project(1j * psi * after)
    values = np.linalg.eigvals(np.concatenate([coefficients.real, coefficients.imag], axis=1))
    # A piston comes back unchanged: its eigenvalue is exactly 1, and no frame shows a piston.
    values = np.delete(values, np.argmin(np.abs(values - 1)))
    return values[np.argsort(-np.abs(values), kind="stable")]


def measured_factor(
    pupil: Pupil, diameter: float, phase: ArrayLike, away: ArrayLike, n_iterations: int = 400
) -> float:
    """Factor by which an iteration of `PhaseShifted` multiplies a small error, observed.

    After each iteration the error is scaled back to the size that it had at the start, so that it stays small
    where the iteration diverges and above rounding where it converges.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    phase : array_like, shape (ny, nx), radian
        True phase.
    away : array_like, shape (ny, nx), radian
        Small error of the start.
    n_iterations : int

    Returns
    -------
    float
        Geometric mean over the second half of the iterations.

    Raises
    ------
    ValueError
        If the error of the start is 0, or an argument is out of range.
    """
    n_iterations = _check.integer("n_iterations", n_iterations, 2)
    phase, away = _check_map(pupil, "phase", phase), _check_map(pupil, "away", away)
    diameter = _linearised(pupil, diameter, phase)[0].diameter  # checked
    size = float(pupil.rms(away))
    if size == 0:
        raise ValueError("away is the same everywhere: expected an error of some size")
    sensor = ZernikeSensor(pupil, *(Dimple(diameter, theta) for theta in (np.pi / 2, -np.pi / 2)), tolerance=1e-13)
    method = PhaseShifted(sensor, n_iterations=1)
    frames, error, factors = sensor.measure(phase), away, []
    for _ in range(n_iterations):
        error = wrapped_residual(pupil, method(frames, start=phase + error).phase, phase)
        error = np.where(pupil.inside, error, 0)
        factors.append(float(pupil.rms(error)) / size)
        error /= factors[-1]
    return float(np.exp(np.mean(np.log(factors[n_iterations // 2 :]))))


def mode_sensitivity(
    pupil: Pupil,
    diameter: float,
    modes: ArrayLike,
    phase_shifts: tuple[float, ...] = (np.pi / 2, -np.pi / 2),
    phase: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """How strongly the frames answer to each mode, the change of the reference wave included.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    modes : array_like, shape (n_modes, ny, nx)
        Of unit rms, as `zernike_basis` gives them.
    phase_shifts : tuple of float, radian
        One for each mask.
    phase : array_like, shape (ny, nx), radian, optional
        Around which the sensor is linearised; flat if left out.

    Returns
    -------
    ndarray, shape (n_modes,), 1 / radian
        Norm of the derivatives of the intensities: root of the sum over the masks of the mean square over the
        points of the pupil. Around a flat wavefront and for the pair (pi/2, -pi/2) it is
        sqrt(8) rms(b mode - K[mode]).

    Raises
    ------
    ValueError
        If a shape is wrong.

    References
    ----------
    Chambouleyron et al. 2024, section 4.2.
    """
    light, psi, beta = _linearised(pupil, diameter, phase)
    modes = _check.real_array("modes", modes)
    _check.maps("modes", modes, pupil.shape)
    modes = pupil.gather(modes).reshape(-1, pupil.n_points)
    _check.finite("modes", modes, " inside the pupil")
    shifts = _check.real_array("phase_shifts", phase_shifts)
    if shifts.ndim != 1 or not shifts.size:
        raise ValueError(f"phase_shifts has shape {shifts.shape}: expected (n_masks,)")
    _check.finite("phase_shifts", shifts)
    direct = 1j * psi * modes
    through = light(direct)
    power = np.zeros(len(direct))
    for theta in shifts:
        strength = np.exp(1j * theta) - 1
        out = psi + strength * beta
        power += np.mean((2 * np.real(out.conj() * (direct + strength * through))) ** 2, axis=-1)
    return np.sqrt(power)


def _check_map(pupil: Pupil, name: str, values: ArrayLike) -> NDArray[np.floating]:
    """Return one map that is finite inside the pupil."""
    _check.instance("pupil", pupil, Pupil)
    values = _check.real_array(name, values)
    if values.shape != pupil.shape:
        raise ValueError(f"{name} has shape {values.shape}: expected {pupil.shape}")
    _check.finite(name, pupil.gather(values), " inside the pupil")
    return values


def _check_screens(screens: ArrayLike) -> NDArray[np.floating]:
    """Return screens as an array, shape (n_screens, ny, nx)."""
    screens = _check.real_array("screens", screens)
    if screens.ndim != 3 or 0 in screens.shape:
        raise ValueError(f"screens has shape {screens.shape}: expected (n_screens, ny, nx)")
    return screens


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _linearised(pupil: Pupil, diameter: float, phase: ArrayLike | None) -> tuple[DimpleLight, NDArray, NDArray]:
    """Light in the dimple, and the field and its beta at the points of the pupil, (n_points,) each."""
    _check.instance("pupil", pupil, Pupil)
    phase = np.zeros(pupil.shape) if phase is None else _check_map(pupil, "phase", phase)
    psi = pupil.gather(pupil.field(phase))
    light = DimpleLight(pupil, diameter)
    beta = light(psi[np.newaxis])[0]
    if not beta.any():
        raise ValueError(f"diameter = {diameter}: no light passes through the dimple: expected a larger one")
    return light, psi, beta


def _after(psi: NDArray, beta: NDArray, change: NDArray) -> NDArray[np.float64]:
    """Error of the phase after a step that was made with beta + change in the place of beta."""
    relative = change / beta
    return relative.imag - 2 * relative.real * np.imag(beta.conj() * psi) / np.abs(psi) ** 2
