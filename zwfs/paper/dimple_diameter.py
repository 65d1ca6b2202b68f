"""Diameter of the dimple, section 4.2 of the paper: errors of the reconstructors, and why the iteration diverges.

Everything rests on one identity. With beta the part of the field psi that passes through the dimple and
c_k = exp(i theta_k) - 1, the frame of mask k is |psi|^2 + 2 Re(conj(c_k) W) with

    W = conj(beta) (psi - beta),

because |c_k|^2 = -2 Re(c_k). Two frames of an allowed pair are equivalent to the complex map W, whatever the pair.
A step of the phase-shifted iteration therefore solves conj(beta) (psi' - beta) = W for psi', with the beta of the
estimate before, and keeps its phase: the phase shifts drop out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._lowrank import factorise
from zwfs.companion import sweeps
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.paper.curves import ErrorCurves, crossing
from zwfs.paper.linearity import check_reconstructors, own_reconstructors, paper_reconstructors
from zwfs.paper.setups import NOISELESS, Noise
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

DARK_RING = 2 * 1.2196698912665045
"""Diameter of the first dark ring of the Airy pattern, lambda/D: twice the first zero of J1(pi r)."""

TABLED = (1.06, 1.5, 2.0, 2.2, 2.4, 2.6, 3.0, 3.5)
"""Diameters of the table on the causes of Figure 4, lambda/D."""

FEW = (0.5, 1.0, 1.06, 1.5, 1.6, 1.75, 2.0, 2.2, 2.4, 2.6, 3.0, 3.5, 4.0)
"""Diameters at which the costly methods are compared, lambda/D."""

_MODES = {"tilt": 0, "defocus": 2, "high order (Noll 150)": 148}  # by their place among the modes
_TOLERANCE = 1e-12  # of the low-rank factors, as the spectrum is to be exact where the iteration is


@dataclass(frozen=True)
class DiameterCurves(ErrorCurves):
    """Errors of several reconstructors against the diameter of the dimple, on screens of one rms.

    Attributes
    ----------
    diameters : ndarray, shape (n_diameters,), lambda/D
    """

    diameters: NDArray[np.floating]

    def at(self, name: str, diameter: float) -> float:
        """Mean error at the sampled diameter (lambda/D) that is nearest to `diameter`, radian rms."""
        return float(self.mean(name)[np.argmin(np.abs(self.diameters - _check.number("diameter", diameter)))])

    def exceeds(self, name: str, limit: float, start: float = 0.0) -> float:
        """Diameter, from `start` on, at which the mean error exceeds `limit` (radian rms); see `crossing`."""
        used = self.diameters >= _check.number("start", start) - 1e-9
        if not used.any():
            raise ValueError(f"start = {start:g}: expected at most the last diameter, {self.diameters[-1]:g}")
        return crossing(self.diameters[used], self.mean(name)[used], limit)


def diameter_curves(
    make: Callable[[float], Mapping[str, Any]],
    diameters: ArrayLike,
    screens: NDArray,
    *,
    noise: Noise = NOISELESS,
    seed: int = 0,
) -> DiameterCurves:
    """Errors of reconstructors on the same screens for dimples of several diameters: the experiment of Figure 4.

    A diameter is a task of the sweep "diameter_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    make : callable
        `make(diameter)` returns reconstructors by name, for sensors with dimples of that diameter (lambda/D).
    diameters : array_like, shape (n_diameters,), lambda/D
    screens : ndarray, shape (n_screens, ny, nx), radian
    noise : Noise
        Of the camera.
    seed : int
        Of the noise, which is the same at all diameters.

    Returns
    -------
    DiameterCurves

    Raises
    ------
    ValueError
        If there are no screens, or the diameters are not a list of positive, increasing numbers.

    References
    ----------
    Chambouleyron et al. 2024, section 4.2 and Figure 4.
    """
    _check.function("make", make)
    diameters = _check_diameters(diameters)
    screens = _check.screens("screens", screens)
    _check.instance("noise", noise, Noise)
    seed = _check.integer_seed("seed", seed)
    points = sweeps.run(_diameter_point, diameters.tolist(), make, screens, noise, seed, name="diameter_curves")
    rms, errors = zip(*points, strict=True)
    return DiameterCurves(
        np.array(rms), {name: np.array([point[name] for point in errors]) for name in errors[0]}, diameters
    )


def _diameter_point(
    diameter: float, make: Callable[[float], Mapping[str, Any]], screens: NDArray, noise: Noise, seed: int
) -> tuple[float, dict[str, NDArray[np.floating]]]:
    """One diameter of the curves: rms of the screens, and errors on each of them, (n_screens,)."""
    reconstructors = make(diameter)
    check_reconstructors(reconstructors)
    errors = {}
    for name, reconstructor in reconstructors.items():
        sensor = reconstructor.sensor
        screens = _check.screens("screens", screens, sensor.pupil)
        estimate = reconstructor(noise(sensor, screens, seed))
        errors[name] = reconstruction_error(sensor.pupil, estimate.phase, screens)
    return float(np.mean(sensor.pupil.rms(screens))), errors


def sampled_diameters(step: float, diameter_max: float, step_fine: float) -> NDArray[np.float64]:
    """Diameters of Figure 4 (lambda/D): every `step`, every `step_fine` from 2 to 2.6, and those of the table."""
    step, step_fine = _check.number("step", step, 0.01), _check.number("step_fine", step_fine, 0.001)
    diameter_max = _check.number("diameter_max", diameter_max, 0.01, 100)
    coarse = np.arange(step, diameter_max + step / 2, step)
    fine = np.arange(2.0, 2.6 + step_fine / 2, step_fine)
    return np.unique(np.round([*coarse, *fine, *TABLED], 9))


def iteration_curves(
    pupil: Pupil, phase_shift: float, n_iterations: int, diameters: ArrayLike, screens: NDArray, **noise: Any
) -> DiameterCurves:
    """Errors of the phase-shifted iteration, without an early stop; `noise` and `seed` as in `diameter_curves`."""
    phase_shift = _check.number("phase_shift", phase_shift, 0.01, 3.13)

    def make(diameter: float) -> dict[str, Any]:
        sensor = ZernikeSensor(pupil, Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift))
        return {"PhaseShifted": PhaseShifted(sensor, n_iterations=n_iterations, tolerance=0.0)}

    return diameter_curves(make, diameters, screens, **noise)


def other_curves(
    pupil: Pupil,
    modes: NDArray,
    phase_shift: float,
    screens: NDArray,
    *,
    own: Sequence[str] = (),
    noise: Noise = NOISELESS,
    seed: int = 0,
    **settings: Any,
) -> DiameterCurves:
    """Errors of the other methods, at few diameters.

    Settings are those of `paper_reconstructors`, `own` are the paths of `own_reconstructors`. See
    `diameter_curves` for `noise` and `seed`.
    """
    _check.sequence("own", own, expected="a list of 'module:Class'")

    def make(diameter: float) -> dict[str, Any]:
        methods = paper_reconstructors(pupil, modes, diameter, phase_shift, **settings)
        methods |= own_reconstructors(own, methods)
        del methods["PhaseShifted"]
        return methods

    return diameter_curves(make, FEW, screens, noise=noise, seed=seed)


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


def iteration_spectrum(pupil: Pupil, diameter: float, phase: ArrayLike | None = None) -> NDArray[np.complex128]:
    """Eigenvalues of the linearised phase-shifted step, piston left out.

    The iteration converges to the true phase from nearby if the first eigenvalue is inside the unit circle. Its
    modulus is the factor by which an iteration then multiplies the error.

    Parameters
    ----------
    pupil : Pupil
    diameter : float, lambda/D
    phase : array_like, shape (ny, nx), radian, optional
        True phase; flat if left out.

    Returns
    -------
    ndarray of complex, shape (2 rank - 1,)
        Largest modulus first; all others are 0.

    Raises
    ------
    ValueError
        If the shape of the phase is wrong.
    """
    light, psi, beta = _linearised(pupil, diameter, phase)
    # A step maps an error to the few coefficients of the change of beta, and these to the next error. Its
    # eigenvalues other than 0 are those of the two maps in the opposite order: a small matrix.
    unit = light.functions()
    # The map is linear over the real numbers only: real and imaginary parts of the coefficients count separately.
    errors = _error_after(psi, beta, np.concatenate([unit, 1j * unit]))
    coefficients = light.project(1j * psi * errors)
    values = np.linalg.eigvals(np.concatenate([coefficients.real, coefficients.imag], axis=1))
    # A piston returns unchanged: its eigenvalue is exactly 1, and no frame shows a piston.
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
    diameter = _linearised(pupil, diameter, phase)[0].diameter  # checked
    phase, away = _check.map_inside("phase", phase, pupil), _check.map_inside("away", away, pupil)
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
    """Sensitivity of the frames to each mode, the change of the reference wave included.

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
    direct = 1j * psi * _check.values_inside("modes", modes, pupil).reshape(-1, pupil.n_points)
    through = light(direct)
    power = np.zeros(len(direct))
    for theta in _check.real_map("phase_shifts", phase_shifts, 1):
        strength = np.exp(1j * theta) - 1
        out = psi + strength * beta
        power += np.mean((2 * np.real(out.conj() * (direct + strength * through))) ** 2, axis=-1)
    return np.sqrt(power)


@dataclass(frozen=True)
class Contraction:
    """Factor by which an iteration multiplies a small error, and sensitivity to modes, against the diameter.

    Attributes
    ----------
    diameters : ndarray, shape (n_diameters,), lambda/D
    flat : ndarray, shape (n_diameters,)
        Factor around a flat wavefront.
    aberrated : ndarray, shape (n_diameters, n_screens)
        Factor around each screen.
    observed : dict of float
        Factor that `PhaseShifted` shows on the first screen, by diameter.
    sensitivity : dict of ndarray, shape (n_diameters,), 1 / radian
        See `mode_sensitivity`, by the name of the mode.
    """

    diameters: NDArray[np.floating]
    flat: NDArray[np.float64]
    aberrated: NDArray[np.float64]
    observed: dict[float, float]
    sensitivity: dict[str, NDArray[np.float64]]

    def index(self, diameter: float) -> int:
        """Index of the sampled diameter that is nearest to `diameter` (lambda/D)."""
        return int(np.argmin(np.abs(self.diameters - _check.number("diameter", diameter))))


def contraction(
    pupil: Pupil, modes: NDArray, diameters: ArrayLike, screens: NDArray, away: NDArray
) -> Contraction:
    """Return the causes of Figure 4: the linearised iteration and the sensitivity, at each diameter.

    The first dark ring is added to the diameters. At least 149 modes are needed, from Noll 2 on. `away` is the
    small error (radian) from which the observed iteration starts, see `measured_factor`.
    """
    _check.instance("pupil", pupil, Pupil)
    diameters = np.unique(np.append(_check_diameters(diameters), DARK_RING))
    screens = _check.screens("screens", screens, pupil)
    modes = _check.real_array("modes", modes)
    _check.maps("modes", modes, pupil.shape)
    if modes.ndim != 3 or len(modes) <= max(_MODES.values()):
        raise ValueError(f"modes has shape {modes.shape}: expected at least {max(_MODES.values()) + 1} modes")
    chosen = modes[list(_MODES.values())]
    observed = {diameter: measured_factor(pupil, diameter, screens[0], away) for diameter in TABLED}

    def factor(diameter: float, phase: NDArray | None = None) -> float:
        return float(np.abs(iteration_spectrum(pupil, diameter, phase)[0]))

    sensitivity = np.array([mode_sensitivity(pupil, diameter, chosen) for diameter in diameters]).T
    return Contraction(
        diameters,
        np.array([factor(diameter) for diameter in diameters]),
        np.array([[factor(diameter, screen) for screen in screens] for diameter in diameters]),
        observed,
        dict(zip(_MODES, sensitivity, strict=True)),
    )


def _check_diameters(diameters: ArrayLike) -> NDArray[np.floating]:
    """Return diameters as an array, shape (n_diameters,), positive and increasing."""
    diameters = _check.real_map("diameters", diameters, 1)
    if diameters[0] <= 0 or np.any(np.diff(diameters) <= 0):
        raise ValueError(f"diameters = {_check.shown(diameters)}: expected positive, increasing values")
    return diameters


_light = lru_cache(maxsize=64)(DimpleLight)  # one for all wavefronts


def _linearised(pupil: Pupil, diameter: float, phase: ArrayLike | None) -> tuple[DimpleLight, NDArray, NDArray]:
    """Light in the dimple, and the field and its beta at the points of the pupil, (n_points,) each."""
    _check.instance("pupil", pupil, Pupil)
    phase = np.zeros(pupil.shape) if phase is None else _check.map_inside("phase", phase, pupil)
    psi = pupil.gather(pupil.field(phase))
    light = _light(pupil, _check.number("diameter", diameter))
    beta = light(psi[np.newaxis])[0]
    if not beta.any():
        raise ValueError(f"diameter = {diameter}: no light passes through the dimple: expected a larger one")
    return light, psi, beta


def _error_after(psi: NDArray, beta: NDArray, change: NDArray) -> NDArray[np.float64]:
    """Error of the phase after a step that uses beta + change in place of beta.

    An error before the step changes beta by K[i psi error], with K the dimple. Around a flat wavefront and a real
    positive beta = b the error after the step is K[A error] / b: a weighted mean where the kernel is positive.
    """
    relative = change / beta
    return relative.imag - 2 * relative.real * np.imag(beta.conj() * psi) / np.abs(psi) ** 2
