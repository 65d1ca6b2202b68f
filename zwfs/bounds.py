"""Bounds of the error that no unbiased reconstructor can beat."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs._arrays import Kind
from zwfs._information import Response
from zwfs._likelihood import Estimator, Noise, require_information, require_one_wavelength
from zwfs._propagator import amplitude_map, propagator, pupil_maps
from zwfs.polychromatic import PolychromaticSensor
from zwfs.sensor import ZernikeSensor


def cramer_rao(
    sensor: ZernikeSensor | PolychromaticSensor,
    phase: ArrayLike,
    *,
    photons: float,
    read_noise: float = 0.0,
    modes: ArrayLike | None = None,
    amplitude: ArrayLike | None = None,
    amplitude_known: bool = True,
) -> NDArray[np.float64]:
    """Cramer-Rao bound: smallest standard deviation of an unbiased estimate of a phase.

    The frames do not show the piston. The bound of a point is therefore that of the phase without its piston.
    Other directions that the frames hardly show, such as tilt for a dimple near 2.44 lambda/D, raise the bound of
    every point. With modes the phase is known to be a sum of them, which lowers the bound.

    Parameters
    ----------
    sensor : ZernikeSensor or PolychromaticSensor
        With any number of masks. The phase is that at its reference wavelength.
    phase : array_like, shape (..., ny, nx), radian
        True phase; only the points of the pupil count.
    photons : float
        Photons per pupil point and image, `Detector.photons`.
    read_noise : float, electrons rms / pixel
    modes : array_like, shape (n_modes, ny, nx), optional
        Modes whose coefficients are estimated; the phases of all points if left out.
    amplitude : array_like, shape (ny, nx), optional
        True amplitude A_in in the pupil; that of the sensor's pupil if left out.
    amplitude_known : bool
        Whether the amplitude is known. If not, it is estimated at every point, too. This takes three masks or
        more; a clear frame is that of a mask that changes nothing.

    Returns
    -------
    ndarray, shape (..., ny, nx) or (..., n_modes), radian
        Standard deviation of every point, NaN outside the pupil, or of every coefficient.

    Raises
    ------
    ValueError
        If no mask changes the light, or the masks do not determine an unknown amplitude.

    References
    ----------
    Kay 1993, section 3.7; `eq-bound` and `eq-information` of the book.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> masks = [zwfs.Dimple(1.06, phase) for phase in (np.pi / 2, -np.pi / 2)]
    >>> sensor = zwfs.ZernikeSensor(pupil, *masks)
    >>> bound = zwfs.cramer_rao(sensor, np.zeros(pupil.shape), photons=1000)
    >>> round(float(np.nanmean(bound)), 4)  # radian
    0.0161
    """
    _check.instance("sensor", sensor, ZernikeSensor, PolychromaticSensor)
    if photons is None:
        raise TypeError("photons = None: expected a number, since the bound is that of photon noise")
    noise = Noise.checked(photons, read_noise, sensor.recorded)
    unknown = not _check.flag("amplitude_known", amplitude_known)
    if unknown and modes is not None:
        raise ValueError("amplitude_known = False: expected True with modes, which describe the phase only")
    if unknown:
        require_one_wavelength(sensor)
    require_information(sensor, unknown)
    pupil = sensor.pupil
    basis = None if modes is None else pupil.scatter(_check.modes("modes", modes, pupil, distinct=True), fill=0)
    maps, batch = pupil_maps("phase", _check.real_array("phase", phase), sensor)
    estimator = Estimator(Response.of(sensor), noise, unknown, basis)
    model = propagator(sensor, Kind.numpy())
    if amplitude is not None:
        model = model.with_amplitude(amplitude_map(amplitude, sensor))
    sigma = []
    for single in maps.astype(np.float64):  # one at a time: the memory does not grow with the batch
        psi = model.incoming(single[np.newaxis])
        points, coefficients = estimator.variance(psi, model.propagate(psi))
        sigma.append(np.sqrt(points[0, 0] if coefficients is None else coefficients[0]))
    result = np.array(sigma)
    if modes is None:
        result = np.where(pupil.inside, result, np.nan)
    return result.reshape(*batch, *result.shape[1:])
