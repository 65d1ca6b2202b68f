"""Linear reconstruction with an interaction matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind, read_only
from zwfs._propagator import square
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors.base import ClosedForm, check_frames, check_phase
from zwfs.sensor import ZernikeSensor


class Linear(ClosedForm):
    """Phase from the difference to the frames of a reference phase, by one matrix product.

    Each mode is pushed and pulled by a small amount around the reference phase, and half the difference of the
    frames, inside the pupil, makes its column of the interaction matrix. The frames are those of the model, or,
    with `calibration`, those of a bench. The pseudo-inverse leaves out singular values below `conditioning` times
    the largest.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
        With any number of masks.
    modes : array_like, shape (n_modes, ny, nx)
        Modes that the phase is made of, such as those of `zernike_basis`.
    poke : float, radian
        Coefficient by which each mode is pushed and pulled, from 1e-10 to pi.
    conditioning : float
        Smallest singular value that is inverted, relative to the largest one.
    reference : array_like, shape (ny, nx), radian, optional
        Phase around which the sensor is linearised; flat if left out.
    amplitude : array_like, shape (ny, nx), optional
        Measured amplitude A_in in the pupil; that of the sensor's pupil if left out.
    calibration : (flat, pushed, pulled), optional
        Frames recorded with the reference phase, (n_masks, ny', nx'), and with each mode pushed and pulled,
        (n_modes, n_masks, ny', nx'). Any unit will do if the frames to reconstruct come in the same.

    Attributes
    ----------
    modes : ndarray, shape (n_modes, n_points)
        At the points of the pupil.
    interaction_matrix : ndarray, shape (n_masks * n_points, n_modes), 1 / radian
    inverse : ndarray, shape (n_modes, n_masks * n_points), radian
        Pseudo-inverse of the interaction matrix.
    n_inverted : int
        Singular values above the conditioning.

    Raises
    ------
    ValueError
        If the sensor sees none of the modes.

    References
    ----------
    Chambouleyron et al. 2024, section 4.1 ("interaction matrix approach").

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2))
    >>> truth = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 20), 0.05, 1, seed=1)[0]
    >>> estimate = zwfs.Linear(sensor, zwfs.zernike_basis(pupil, 20))(sensor.measure(truth))
    >>> float(zwfs.reconstruction_error(pupil, estimate.phase, truth)) < 0.01
    True
    """

    polychromatic = True

    def __init__(
        self,
        sensor: ZernikeSensor | PolychromaticSensor,
        modes: ArrayLike,
        *,
        poke: float = 0.01,
        conditioning: float = 1e-3,
        reference: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
        calibration: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    ) -> None:
        super().__init__(sensor, amplitude=amplitude)
        self.modes = _check.modes("modes", modes, sensor.pupil)
        poke = _check.number("poke", poke, 1e-10, np.pi)
        conditioning = _check.number("conditioning", conditioning, 0, 1, open_high=True)
        flat = np.zeros(sensor.pupil.shape) if reference is None else reference
        self._reference = read_only(check_phase("reference", flat, sensor, (), Kind.numpy())[0])
        if calibration is not None:  # the unit of the frames is then that of the interaction matrix
            self._light = math.inf
        signal, difference = self._simulated(poke) if calibration is None else self._recorded(calibration)
        self._reference_signal = signal
        self.interaction_matrix = read_only(difference.T / (2 * poke))
        u, strength, vt = np.linalg.svd(self.interaction_matrix, full_matrices=False)
        # A frame of unit intensity is rounded at 1e-16, which the poke divides.
        if strength[0] <= 1e-14 * np.sqrt(len(u)) / poke:
            around = "" if reference is None else " around the reference"
            raise ValueError(f"modes: the sensor sees none of them{around}: expected modes other than piston")
        self.n_inverted = int(np.count_nonzero(strength > conditioning * strength[0]))
        kept = slice(0, self.n_inverted)
        self.inverse = read_only((vt[kept].T / strength[kept]) @ u[:, kept].T)

    def coefficients(self, frames: ArrayLike) -> NDArray[np.floating]:
        """Return the coefficients of the modes: (..., n_masks, ny', nx') to (..., n_modes), radian."""
        checked, batch, _ = self.accept(frames, None)
        return self._coefficients(checked).reshape(*batch, -1)

    def invert(self, frames: NDArray) -> tuple[NDArray, int]:
        """Return the phase of the modes that explain the difference to the frames of the reference best."""
        pupil = self.sensor.pupil
        phase = self._coefficients(frames) @ self.modes + pupil.gather(self._reference)
        return pupil.scatter(phase, fill=0), 0

    def _coefficients(self, frames: NDArray) -> NDArray[np.floating]:
        return (self._signal(frames) - self._reference_signal) @ self.inverse.T

    def _before(self) -> NDArray[np.float64]:
        return self._reference

    def _simulated(self, poke: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signal of the reference phase, and push less pull of each mode, (n_modes, n_masks * n_points)."""
        pupil = self.sensor.pupil
        difference = np.empty((len(self.modes), self.sensor.n_masks * pupil.n_points))
        for row, mode in zip(difference, self.modes, strict=True):
            push = pupil.scatter(np.stack([poke * mode, -poke * mode]), fill=0)
            pushed, pulled = self._signal(self._model(self._reference + push))
            np.subtract(pushed, pulled, out=row)
        return self._signal(self._model(self._reference[np.newaxis]))[0], difference

    def _recorded(
        self, calibration: tuple[ArrayLike, ArrayLike, ArrayLike]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The same from frames of a bench."""
        if not isinstance(calibration, tuple | list):
            raise TypeError(f"calibration is a {type(calibration).__name__}: expected (flat, pushed, pulled)")
        if len(calibration) != 3:
            raise ValueError(f"calibration has {len(calibration)} parts: expected (flat, pushed, pulled)")
        flat, pushed, pulled = calibration
        signals = []
        for name, frames, n_frames in (("flat", flat, 1), ("pushed", pushed, None), ("pulled", pulled, None)):
            name = f"calibration {name}"
            checked, batch = check_frames(self.sensor, _check.real_array(name, frames), name)
            if len(checked) != (n_frames or len(self.modes)):
                raise ValueError(f"{name} has a batch of {batch}: expected {n_frames or len(self.modes)}")
            signals.append(self._signal(checked.astype(np.float64)))
        return signals[0][0], signals[1] - signals[2]

    def _model(self, phase: NDArray) -> NDArray:
        model = self.settings.model(Kind.numpy())
        return square(model.propagate(model.incoming(phase)))

    def _signal(self, frames: NDArray) -> NDArray:
        """Values at the points of the pupil, all masks in a row: (k, n_masks * n_points)."""
        window = frames[(..., *self.sensor.window)]
        return self.sensor.pupil.gather(window).reshape(len(frames), -1)
