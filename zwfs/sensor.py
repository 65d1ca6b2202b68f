"""The Zernike wavefront sensor: one pupil, one or more masks, one detector plane."""

from __future__ import annotations

from abc import abstractmethod
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Immutable, Kind, is_jax, read_only
from zwfs._lowrank import Factors, factorise
from zwfs._propagator import (
    ONE_WAVELENGTH,
    Channels,
    Propagator,
    along_phase,
    amplitude_maps,
    parts_sum,
    propagator,
    pupil_maps,
    square,
    warn_of_degrees,
)
from zwfs.masks import Mask
from zwfs.pupil import Pupil

_MOST_PIXELS = 2**14  # across the detector: a frame of them takes 2 GiB


class Sensor(Immutable):
    """Base of the sensors: a pupil, masks and a detector, and the frames of a phase.

    The constructors of `ZernikeSensor` and `PolychromaticSensor` check its arguments and set its factors.

    Attributes
    ----------
    pupil : Pupil
    masks : tuple of Mask
        In the order of the frames.
    extent : float
        Width of the detector plane in D, after rounding to whole pixels.
    tolerance : float
        Error of the reference wave, relative to the strongest response of the masks.
    detector_shape : (int, int)
        Rows and columns of a frame.
    window : (slice, slice)
        Rows and columns of a frame in which the grid of the pupil lies.
    recorded : ndarray of bool, shape (ny_detector, nx_detector), or None
        Pixels that the frames hold; None stands for all. What a frame holds in the others has no weight.
    channels : Channels
        Ratio and weight of each wavelength.
    factors : Factors
        Matrices of `eq-low-rank`, read-only, to compute with them elsewhere. `pupil` and `detector` hold the
        functions of the two planes, r and q of them, which all masks share: `along_y`, shape (a, ny), `along_x`,
        shape (b, nx), and `combine`, shape (a * b, r), which combines their products. `core` has the shape
        (n_masks, q, r), or (n_masks, n_wavelengths, q, r).
    """

    factors: Factors
    recorded: NDArray[np.bool_] | None = None

    def __init__(
        self, pupil: Pupil, masks: tuple[Mask, ...], extent: float, tolerance: float, channels: Channels
    ) -> None:
        self.tolerance = _check.number("tolerance", tolerance, 1e-16, 0.1)
        self._margin = m = _margin(extent, pupil)
        self.pupil, self.masks, self.channels = pupil, masks, channels
        self.extent = 1 + 2 * m / pupil.n_pixels
        ny, nx = pupil.shape
        self.detector_shape = ny + 2 * m, nx + 2 * m
        self.window = slice(m, m + ny), slice(m, m + nx)

    @property
    def n_masks(self) -> int:
        """Number of masks, and of frames that one measurement makes."""
        return len(self.masks)

    @property
    def rank(self) -> int:
        """Number of coefficients that the reference waves are made of."""
        return self.factors.pupil.rank

    def measure(self, phase: ArrayLike, amplitude: ArrayLike | None = None) -> NDArray[np.floating]:
        """Frames without noise.

        Parameters
        ----------
        phase : array_like, shape (..., ny, nx), radian
            Only the points of the pupil count; NaN or anything else is allowed outside.
        amplitude : array_like, shape (..., ny, nx), optional
            Field amplitude; that of the pupil if left out. Points outside the pupil stay dark.

        Returns
        -------
        ndarray, shape (..., n_masks, ny_detector, nx_detector)
            Intensity; 1 is the mean intensity in the pupil with the mask taken out. float32 if the phase is.

        Warns
        -----
        UserWarning
            If the rms of a phase is above 20 rad: it may be in degrees or nanometres. If JAX makes every array
            float32, with an error of the frames of about 1e-6.

        References
        ----------
        Chambouleyron et al. 2024, equation (5).
        """
        if is_jax(phase) or is_jax(amplitude):
            from zwfs import _jax

            return _jax.measure(self, phase, amplitude)
        maps, batch = pupil_maps("phase", phase, self)
        kind = Kind.of(maps)
        warn_of_degrees(maps, self.pupil, stacklevel=3)
        strength, strength_batch = amplitude_maps(amplitude, self, kind)
        if strength_batch:
            xp, shape = kind.xp, self.pupil.shape
            maps, strength = xp.reshape(maps, (*batch, *shape)), xp.reshape(strength, (*strength_batch, *shape))
            full = _check.broadcast(phase=maps, amplitude=strength)
            maps, strength = (
                xp.reshape(xp.broadcast_to(values, full), (-1, *shape)) for values in (maps, strength)
            )
            batch = full[:-2]
        model = propagator(self, kind)
        frames = square(model.propagate(model.incoming(maps, strength)))
        return kind.xp.reshape(frames, (*batch, self.n_masks, *self.detector_shape))

    def jacobian(self, phase: ArrayLike, change: ArrayLike) -> NDArray[np.floating]:
        """Change of the frames per change of the phase: the derivative of the frames at a phase, times a change.

        Parameters
        ----------
        phase, change : array_like, shape (..., ny, nx), radian
            Of one batch.

        Returns
        -------
        ndarray, shape (..., n_masks, ny_detector, nx_detector)

        References
        ----------
        `eq-jacobian` of the book.
        """
        maps, batch = pupil_maps("phase", phase, self)
        kind = Kind.of(maps)
        changes, change_batch = pupil_maps(
            "change", _check.in_kind("change", _check.real_any("change", change), kind), self
        )
        if change_batch != batch:
            raise ValueError(f"change has shape {(*change_batch, *self.pupil.shape)}: expected that of phase")
        model, psi, waves = self._waves(maps)
        turned = along_phase(psi, self.channels.ratios, kind.xp) * changes[:, np.newaxis, ...]
        result = 2 * parts_sum(waves * model.propagate(turned))
        return kind.xp.reshape(result, (*batch, *result.shape[1:]))

    def jacobian_adjoint(self, phase: ArrayLike, frames: ArrayLike) -> NDArray[np.floating]:
        """Exact adjoint of `jacobian`: the gradient of sum(frames * measure(phase)) with respect to the phase.

        Parameters
        ----------
        phase : array_like, shape (..., ny, nx), radian
        frames : array_like, shape (..., n_masks, ny_detector, nx_detector)

        Returns
        -------
        ndarray, shape (..., ny, nx)
            0 outside the pupil.

        References
        ----------
        Chambouleyron et al. 2024, equation (16); `eq-gradient` of the book.
        """
        maps, batch = pupil_maps("phase", phase, self)
        kind, shape = Kind.of(maps), (self.n_masks, *self.detector_shape)
        frames = _check.in_kind("frames", _check.real_any("frames", frames), kind)
        if tuple(frames.shape) != (*batch, *shape):
            raise ValueError(f"frames has shape {tuple(frames.shape)}: expected {(*batch, *shape)}")
        _check.moderate("frames", frames)
        model, psi, waves = self._waves(maps)
        back = model.adjoint(waves * kind.xp.reshape(frames, (-1, *shape))[:, :, np.newaxis, ...])
        gradient = 2 * parts_sum(along_phase(psi, self.channels.ratios, kind.xp) * back)
        return kind.xp.reshape(gradient, (*batch, *self.pupil.shape))

    @abstractmethod
    def _factorise(self) -> Factors:
        """Factors of the reference waves."""

    def _waves(self, maps: NDArray) -> tuple[Propagator, NDArray, NDArray]:
        """Model, and the fields of checked phases in the pupil and on the detector."""
        model = propagator(self, Kind.of(maps))
        psi = model.incoming(maps)
        return model, psi, model.propagate(psi)

    def _axes(self) -> tuple[tuple[NDArray, NDArray], tuple[NDArray, NDArray]]:
        """Coordinates (y, x) of the pupil and of the detector, D."""
        pupil, m = self.pupil, self._margin
        y, x = (axis[0] + (np.arange(axis.size + 2 * m) - m) / pupil.n_pixels for axis in (pupil.y, pupil.x))
        return (pupil.y, pupil.x), (y, x)


class ZernikeSensor(Sensor):
    """A Zernike wavefront sensor with any number of masks.

    Fields and phases may be arrays of NumPy or of any library that follows the Python array API and lets arrays be
    changed in place, such as PyTorch and CuPy; results are of the same library and on the same device. Gradients
    of PyTorch pass through all methods. Those of JAX pass through `measure`, also in `jax.jit` and `jax.vmap`.

    One mask makes the classic sensor, two make the phase-shifted one. Detector pixels are as large as pupil
    pixels and stand at the same places, so the detector of an extent of 1 D is the grid of the pupil.

    A sensor cannot be changed, and its arrays are read-only.

    Parameters
    ----------
    pupil : Pupil
    *masks : Dimple, Patch or any Mask
    extent : float, D
        Width of the detector plane, at least 1 (rounded to whole pixels on each side) and at most 16384 pixels.
        The masks diffract light out of the geometric pupil; a wider detector records more of that light.
    tolerance : float
        Error of the reference wave, relative to the strongest response of the masks (spectral norm). It decides
        the rank; the speed hardly depends on it. At 1e-14 the kernel is exact to rounding.
    recorded : array_like of bool, shape (ny_detector, nx_detector), optional
        True where a pixel of the frames counts, as it must at all points of the pupil. The reconstructors ignore
        the others, such as those outside the pupil where a camera sees stray light. By default all count.

    Raises
    ------
    ValueError
        If a mask is wider, in lambda/D, than there are pixels across D. On a wide detector the limit is lower.

    Warns
    -----
    UserWarning
        If the transmission of a `Patch` varies so fast that the error of its reference wave exceeds the tolerance;
        the warning states an estimate of the error.

    References
    ----------
    Chambouleyron et al. 2024, equations (1) to (5); `eq-low-rank` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(64)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(diameter=1.06, phase=np.pi / 2))
    >>> sensor.measure(np.zeros(pupil.shape)).shape
    (1, 64, 64)
    """

    def __init__(
        self, pupil: Pupil, *masks: Mask, extent: float = 1.0, tolerance: float = 1e-10,
        recorded: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        _check.instance("pupil", pupil, Pupil)
        if not masks:
            raise ValueError("masks is empty: expected at least one mask, such as Dimple(1.06, np.pi / 2)")
        super().__init__(pupil, masks, extent, tolerance, ONE_WAVELENGTH)
        if recorded is not None:
            pixels = _check.flag_map("recorded", recorded, self.detector_shape)
            if n_missing := int(np.count_nonzero(pupil.inside & ~pixels[self.window])):
                raise ValueError(
                    f"recorded is False at {n_missing} points of the pupil: expected True at all of them"
                )
            self.recorded = None if pixels.all() else read_only(pixels)
        self.factors = self._factorise()

    def __repr__(self) -> str:
        masks = ", ".join(map(repr, self.masks))
        return f"ZernikeSensor({self.pupil.n_points} points, {masks}, extent={self.extent:g}, rank={self.rank})"

    def _factorise(self) -> Factors:
        return factorise(self.masks, *self._axes(), self.pupil.n_pixels**-2.0, self.tolerance)

    def with_tolerance(self, tolerance: float) -> ZernikeSensor:
        """Return the same sensor with another error of the reference wave."""
        return ZernikeSensor(
            self.pupil, *self.masks, extent=self.extent, tolerance=tolerance, recorded=self.recorded
        )

    def propagate(self, field: ArrayLike) -> NDArray[np.complexfloating]:
        """Field on the detector behind each mask.

        Parameters
        ----------
        field : array_like of complex, shape (..., ny, nx)
            Field in the pupil plane. The stop blocks what lies outside the pupil.

        Returns
        -------
        ndarray of complex, shape (..., n_masks, ny_detector, nx_detector)

        References
        ----------
        Chambouleyron et al. 2024, equations (1) to (3).
        """
        model, psi, batch = self._pupil_field(field)
        waves = model.operator.complex_reference(psi)
        waves[(..., *self.window)] += psi[:, np.newaxis, ...]
        return model.kind.xp.reshape(waves, (*batch, *waves.shape[1:]))

    def reference_wave(self, field: ArrayLike) -> NDArray[np.complexfloating]:
        """Reference wave of each mask: `propagate` less the field itself.

        Parameters and shapes are those of `propagate`.

        References
        ----------
        Chambouleyron et al. 2024, equation (4).
        """
        model, psi, batch = self._pupil_field(field)
        waves = model.operator.complex_reference(psi)
        return model.kind.xp.reshape(waves, (*batch, *waves.shape[1:]))

    def adjoint(self, field: ArrayLike) -> NDArray[np.complexfloating]:
        """Exact adjoint of `propagate`: back-propagation from the detector planes to the pupil.

        Parameters
        ----------
        field : array_like of complex, shape (..., n_masks, ny_detector, nx_detector)

        Returns
        -------
        ndarray of complex, shape (..., ny, nx)
            Sum over the masks, 0 outside the pupil. With a mask of modulus 1 and an infinite detector it would
            be the inverse, too.

        References
        ----------
        Chambouleyron et al. 2024, equation (14); `eq-adjoint` of the book.
        """
        shape = (self.n_masks, *self.detector_shape)
        model, waves, batch = self._field(field, shape, "masks and detector")
        xp, psi = model.kind.xp, model.operator.complex_adjoint(waves)
        psi += xp.sum(waves[(..., *self.window)], axis=1)
        psi *= model.stop
        return xp.reshape(psi, (*batch, *self.pupil.shape))

    def _pupil_field(self, field: ArrayLike) -> tuple[Propagator, NDArray, tuple[int, ...]]:
        """Model, checked complex fields (k, ny, nx) with 0 outside the pupil, and the batch."""
        model, psi, batch = self._field(field, self.pupil.shape, "the shape of the pupil")
        return model, psi * model.stop, batch

    def _field(
        self, field: ArrayLike, shape: tuple[int, ...], meaning: str
    ) -> tuple[Propagator, NDArray, tuple[int, ...]]:
        """Model, checked complex fields with one batch axis, and the batch."""
        field = _check.complex_any("field", field)
        _check.trailing_shape("field", field, shape, meaning)
        batch = tuple(field.shape[: -len(shape)])
        if not prod(batch):
            raise ValueError(f"field has shape {tuple(field.shape)}: expected at least one field")
        _check.moderate("field", field)
        kind = Kind.of(field).real
        return propagator(self, kind), kind.xp.reshape(field, (-1, *shape)), batch


def _margin(extent: float, pupil: Pupil) -> int:
    """Pixels of the detector beyond the grid of the pupil, on each side."""
    extent = _check.number("extent", extent, 1)
    width = max(pupil.shape) + (extent - 1) * pupil.n_pixels
    if width > _MOST_PIXELS and extent > 1:
        raise ValueError(
            f"extent = {extent:g}: expected less, as it makes a detector of {width:.3g} pixels across; at most "
            f"{_MOST_PIXELS} are possible"
        )
    return round((extent - 1) * pupil.n_pixels / 2)
