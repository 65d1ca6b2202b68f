"""One learned solve after the other, in a control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._lowrank import Plane
from zwfs.pupil import Pupil

if TYPE_CHECKING:
    from zwfs.reconstructors.learned import LearnedReference, _Constants

__all__ = ["Look"]

_WEAK = 1e-6  # weight of the power of the disc wave, below which the solve cannot be scaled by it


class Look:
    """Phase of one set of frames after the other by one learned solve: `LearnedReference.look` makes it.

    The phase is that of `LearnedReference` with one solve, in single precision. No number is checked, and all
    arrays are used again. Frames with NaN have a phase of NaN.
    """

    # The phase is that of (W s + l A^2 - e |D|^2) D with the disc wave D and s = frames - A^2. Here D is scaled by
    # the root of |e| and turned by the angle of e, and W and l are turned back: then e is 1.

    def __init__(self, method: LearnedReference) -> None:
        kind, sensor, training = Kind.numpy(np.float32), method.sensor, method.training
        solve, constants = method._fixed(kind), method._constants(kind)
        if solve is None or sensor.n_masks < 2:
            raise ValueError("bench = None: expected known errors of the bench, and two masks, for one look")
        weight = complex(*solve.of_power[0, :, 0])
        if abs(weight) < _WEAK:
            raise ValueError("sensor: expected dimples for which the frames depend on the power of the wave")
        turn, n_masks = np.conj(weight) / abs(weight), sensor.n_masks
        brightest = int(np.argmax(constants.light))
        light = solve.light[0, :, brightest] / constants.light[brightest]
        of_light = solve.of_frames[0].sum(axis=1) - light
        self._of_signal = _real(turn) @ np.column_stack([solve.of_frames[0], of_light])
        self._of_outputs = _real(np.sqrt(abs(weight)) * np.conj(turn) * np.linalg.norm(training.flat))
        self._light, self._network = constants.light.reshape(sensor.pupil.shape), training.network
        self._whitening, self._farthest = training.whitening, training.farthest
        self._no_data = method.settings.model(kind).no_data
        self._shape, self._window = (n_masks, *sensor.detector_shape), (slice(None), *sensor.window)
        self._weight = (constants.root**2).reshape(sensor.pupil.shape)
        self._plane = _separable(sensor.pupil, constants.maps, training.order)
        n_means = n_masks * self._plane.rank
        means, products = np.split(np.eye(n_means + n_masks**2, dtype=np.float32), [n_means], axis=1)
        means, products = means.reshape(-1, n_masks, self._plane.rank), products.reshape(-1, n_masks, n_masks)
        self._to_inputs = mixed_moments(means, products, constants)
        self._scaled = np.zeros(len(self._network.scale), np.float32)
        self._signal = np.tile(constants.light, (n_masks + 1, 1))  # of each mask, and the light
        self._inside = np.empty((n_masks, *sensor.pupil.shape), np.float32)
        self._field, self._parts = np.empty((2, 2, constants.light.size), np.float32)

    @property
    def distance(self) -> float:
        """How unusual the last frames are; above 1 the training has seen nothing like them."""
        return float(np.sqrt(np.mean((self._scaled @ self._whitening) ** 2)) / self._farthest)

    def __call__(self, frames: ArrayLike, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Phase of one set of frames.

        Parameters
        ----------
        frames : array_like, shape (n_masks, ny', nx')
        out : ndarray of float32, shape (ny, nx), optional
            Where the phase goes; a new array if left out.

        Returns
        -------
        ndarray, shape (ny, nx), radian
            NaN outside the pupil.

        Raises
        ------
        TypeError, ValueError
            If frames or `out` have another shape or type.
        """
        frames = _check.real_frame("frames", frames, self._shape)
        out = _check.destination("out", out, self._no_data.shape)
        self._scaled = self._network.scaled(self._inputs(frames[self._window]))
        outputs = self._network(self._scaled)[: 2 * self._plane.rank].reshape(2, -1)
        disc = self._plane.expand(self._of_outputs @ outputs).reshape(2, -1)
        field, parts = np.dot(self._of_signal, self._signal, out=self._field), self._parts
        np.multiply(disc, disc, out=parts)
        field[0] -= parts[0]
        field[0] -= parts[1]
        np.multiply(field, disc, out=parts)
        real = np.subtract(parts[0], parts[1], out=out.reshape(-1))
        np.multiply(field, disc[::-1], out=parts)
        imag = np.add(parts[0], parts[1], out=parts[0])
        np.arctan2(imag, real, out=real)
        out += self._no_data
        return out

    def _inputs(self, frames: NDArray) -> NDArray[np.float32]:
        """Inputs of the network from frames on the grid of the pupil, whose signal is stored."""
        n_masks, inside = len(frames), self._inside
        signal = self._signal[:n_masks]
        np.subtract(frames, self._light, out=signal.reshape(frames.shape))
        np.multiply(signal.reshape(frames.shape), self._weight, out=inside)
        products = inside.reshape(n_masks, -1) @ signal.T
        return np.concatenate([self._plane.project(inside).ravel(), products.ravel()]) @ self._to_inputs


def mixed_moments(means: NDArray, products: NDArray, constants: _Constants) -> NDArray:
    """Inputs (k, n_inputs) from means (k, n_masks, n_polynomials) of signals and of products of two of them."""
    squares = constants.mixed @ products @ constants.mixed.T
    upper = squares[:, *constants.upper]
    return np.concatenate([(constants.mixed @ means).reshape(len(means), -1), upper], axis=1)


def _separable(pupil: Pupil, polynomials: NDArray, order: int) -> Plane:
    """Polynomials (n, ny * nx) up to an order as sums of products of those of y and of x."""
    along_y, along_x = (np.linalg.qr(np.vander(axis, order + 1))[0].T for axis in (pupil.y, pupil.x))
    products = (along_y[:, np.newaxis, :, np.newaxis] * along_x[:, np.newaxis]).reshape((order + 1) ** 2, -1)
    inside = pupil.inside.ravel()
    combine = np.linalg.lstsq(products[:, inside].T, polynomials[:, inside].T)[0]
    return Plane(along_y, along_x, combine).to(Kind.numpy(np.float32))


def _real(factor: complex) -> NDArray[np.float32]:
    """Real matrix that multiplies a real and an imaginary part, one below the other, by a complex number."""
    return np.array([[factor.real, -factor.imag], [factor.imag, factor.real]], np.float32)
