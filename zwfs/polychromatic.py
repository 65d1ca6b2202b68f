"""The Zernike wavefront sensor in light of several wavelengths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import read_only
from zwfs._lowrank import Factors, factorise
from zwfs._propagator import Channels
from zwfs.masks import Dimple, Mask, Outline
from zwfs.sensor import Sensor, ZernikeSensor

_MOST_WAVELENGTHS = 64
_WIDEST = 4.0  # ratio of two wavelengths


class PolychromaticSensor(Sensor):
    """A Zernike wavefront sensor in light of several wavelengths, whose intensities add up.

    The phase is that at the reference wavelength. A wavefront is an optical path difference (OPD), so its phase at
    another wavelength is `phase * reference_wavelength / wavelength`. A mask has a fixed size in the focal plane:
    its diameter in lambda/D scales in the same way. Its phase shift is the same at all wavelengths (achromatic, as
    that of a vector mask) or scales with the OPD of an etched depth (chromatic; the dispersion of the glass is
    neglected). With the weights w, whose sum is 1, the frame of a mask is

        I(phase) = sum over wavelengths of w I_wavelength(phase * reference_wavelength / wavelength).

    A reconstructor knows the bandwidth if it is built with this sensor, and ignores it if it is built with
    `reference`, the sensor at the reference wavelength. `Linear`, `GradientDescent`, `MaximumLikelihood` and
    `cramer_rao` accept both. The other reconstructors need one wavelength, since they solve for one field at every
    point.

    No frame shows the piston, as with one wavelength. Phases that differ by 2 pi give different frames, if only
    slightly.

    Parameters
    ----------
    sensor : ZernikeSensor
        Sensor at the reference wavelength.
    wavelengths : array_like, shape (n_wavelengths,), nm
        Or of another unit: only their ratios count. At most 64, within a factor of 4.
    weights : array_like, shape (n_wavelengths,), optional
        Light that is detected at each wavelength, in any unit; the same at all if left out.
    reference_wavelength : float, nm, optional
        Mean of the wavelengths with these weights if left out.
    chromatic : bool
        Whether the phase shifts of the dimples are those of an etched depth.

    Attributes
    ----------
    reference : ZernikeSensor
        Sensor at the reference wavelength; a reconstructor with this sensor ignores the bandwidth.
    wavelengths, weights : ndarray, shape (n_wavelengths,)
        Wavelengths, nm, and the share of the light at each.
    reference_wavelength : float, nm
        Wavelength at which phases are in radian and masks in lambda/D.
    chromatic : bool

    Raises
    ------
    ValueError
        If a dimple is too wide at the shortest wavelength, or masks other than a `Dimple` are to be chromatic.

    References
    ----------
    `eq-band` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    >>> band = zwfs.PolychromaticSensor(sensor, wavelengths=[600.0, 650.0, 700.0])
    >>> phase = zwfs.opd_to_phase(30.0 * pupil.inside * pupil.x, band.reference_wavelength)  # 30 nm of tilt
    >>> band.measure(phase).shape
    (2, 32, 32)
    """

    def __init__(
        self,
        sensor: ZernikeSensor,
        wavelengths: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        reference_wavelength: float | None = None,
        chromatic: bool = False,
    ) -> None:
        _check.instance("sensor", sensor, ZernikeSensor)
        self.wavelengths, self.weights = _checked_light(wavelengths, weights)
        mean = float(self.weights @ self.wavelengths)
        self.reference_wavelength = (
            mean
            if reference_wavelength is None
            else _check.number("reference_wavelength", reference_wavelength, mean / _WIDEST, mean * _WIDEST)
        )
        self.chromatic = _check.flag("chromatic", chromatic)
        self.reference, self.recorded = sensor, sensor.recorded
        ratios = tuple((self.reference_wavelength / self.wavelengths).tolist())
        super().__init__(
            sensor.pupil,
            sensor.masks,
            sensor.extent,
            sensor.tolerance,
            Channels(ratios, tuple(self.weights.tolist())),
        )
        self.factors = self._factorise()

    @classmethod
    def flat_band(
        cls, sensor: ZernikeSensor, bandwidth: float, n_wavelengths: int = 5, *, chromatic: bool = False
    ) -> PolychromaticSensor:
        """Return a sensor in light of a flat spectrum, the same detected light at all wavelengths of a band.

        The wavelengths are Gauss-Legendre nodes: the error of the integral over the band falls exponentially with
        their number. They are stated in units of the central wavelength, which is the reference wavelength.

        Parameters
        ----------
        sensor : ZernikeSensor
            Sensor at the central wavelength.
        bandwidth : float
            Full width of the band over its central wavelength, in [0, 1]; 0 is one wavelength.
        n_wavelengths : int
        chromatic : bool
            Whether the phase shifts of the dimples are those of an etched depth.

        Examples
        --------
        >>> import numpy as np, zwfs
        >>> sensor = zwfs.ZernikeSensor(zwfs.Pupil.circular(32), zwfs.Dimple(1.06, np.pi / 2))
        >>> zwfs.PolychromaticSensor.flat_band(sensor, 0.1, n_wavelengths=3).wavelengths.round(4).tolist()
        [0.9613, 1.0, 1.0387]
        """
        bandwidth = _check.number("bandwidth", bandwidth, 0, 1)
        n_wavelengths = _check.integer("n_wavelengths", n_wavelengths, 1, _MOST_WAVELENGTHS)
        nodes, weights = np.polynomial.legendre.leggauss(n_wavelengths if bandwidth else 1)
        return cls(sensor, 1 + bandwidth / 2 * nodes, weights, reference_wavelength=1.0, chromatic=chromatic)

    def __repr__(self) -> str:
        low, high = self.wavelengths.min(), self.wavelengths.max()
        shifts = "chromatic" if self.chromatic else "achromatic"
        return (
            f"PolychromaticSensor({self.reference!r}, {self.wavelengths.size} wavelengths from {low:g} to "
            f"{high:g}, {shifts})"
        )

    def _factorise(self) -> Factors:
        ratios = self.channels.ratios
        masks = [_at(mask, ratio, self.chromatic) for mask in self.masks for ratio in ratios]
        factors = factorise(masks, *self._axes(), self.pupil.n_pixels**-2.0, self.tolerance)
        core = factors.core.reshape(self.n_masks, len(ratios), *factors.core.shape[1:])
        return Factors(factors.pupil, factors.detector, core)

    def with_tolerance(self, tolerance: float) -> PolychromaticSensor:
        """Return the same sensor with another error of the reference wave."""
        return PolychromaticSensor(
            self.reference.with_tolerance(tolerance),
            self.wavelengths,
            self.weights,
            reference_wavelength=self.reference_wavelength,
            chromatic=self.chromatic,
        )


def _checked_light(
    wavelengths: ArrayLike, weights: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Checked wavelengths, and weights whose sum is 1."""
    waves = _check.real_map("wavelengths", wavelengths, 1)
    if waves.size > _MOST_WAVELENGTHS:
        raise ValueError(f"wavelengths has {waves.size} values: expected at most {_MOST_WAVELENGTHS}")
    if not waves.min() > 0 or waves.max() > _WIDEST * waves.min():
        raise ValueError(
            f"wavelengths = {_check.shown(waves.tolist())}: expected values above 0, within a factor of "
            f"{_WIDEST:g}"
        )
    light = np.ones(waves.size) if weights is None else _check.real_map("weights", weights, 1)
    if light.shape != waves.shape:
        raise ValueError(f"weights has shape {light.shape}: expected {waves.shape}, one for each wavelength")
    _check.non_negative("weights", light)
    if not light.any():
        raise ValueError("weights is 0 at all wavelengths: expected some light")
    return read_only(waves.copy()), read_only(light / light.sum())


def _at(mask: Mask, ratio: float, chromatic: bool) -> Mask:
    """Mask of a fixed size in the focal plane, in lambda/D of another wavelength."""
    if isinstance(mask, Dimple):
        return replace(mask, diameter=mask.diameter * ratio, phase=mask.phase * (ratio if chromatic else 1.0))
    if chromatic:
        raise ValueError(
            f"chromatic = True: expected Dimples, whose depth is known, got {_check.shown(mask)}; for another "
            "mask, only the phase modulo 2 pi is known"
        )
    return mask if ratio == 1 else _Scaled(mask, ratio)


@dataclass(frozen=True)
class _Scaled:
    """Mask in lambda/D of another wavelength."""

    mask: Mask
    ratio: float

    @property
    def diameter(self) -> float:
        return self.mask.diameter * self.ratio

    @property
    def breaks(self) -> tuple[float | Outline, ...]:
        return tuple(
            self._wider(outline) if callable(outline) else outline * self.ratio for outline in self.mask.breaks
        )

    @property
    def n_samples(self) -> int:
        return self.mask.n_samples

    def transmission(self, u: NDArray, v: NDArray) -> NDArray[np.complex128]:
        return self.mask.transmission(u / self.ratio, v / self.ratio)

    def _wider(self, outline: Outline) -> Outline:
        return lambda angle: outline(angle) * self.ratio
