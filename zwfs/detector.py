"""A camera: photons, noise, saturation and quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check

_BRIGHTEST = 9e18  # electrons in a pixel: 64 bits count no more
_FAINTEST = 1e-12  # photons of a point, or electrons in a count: other numbers are divided by them


@dataclass(frozen=True)
class Detector:
    """Camera that turns frames into counts, and counts back into frames.

    By default a camera adds photon noise only. Light is detected first (photon noise), then the electronics add
    read noise, then the converter saturates and rounds.

    Parameters
    ----------
    photons : float
        Photons per pupil point and image: those that an intensity of 1 puts into a pixel. At least 1e-12.
    photon_noise : bool
        Draw the number of electrons of each pixel from the Poisson distribution.
    read_noise : float, electrons rms / pixel
    background : float, electrons / pixel
        Dark and stray light; it has photon noise, too.
    full_well : float, electrons / pixel
        A pixel holds no more than this.
    gain : float, electrons / count
        Counts are rounded to integers; 0 leaves electrons as they are. Otherwise at least 1e-12.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2))
    >>> camera = zwfs.Detector(photons=1000, read_noise=1.0)
    >>> counts = camera.expose(sensor.measure(np.zeros(pupil.shape)), seed=1)
    >>> camera.normalise(counts).shape
    (1, 32, 32)
    """

    photons: float
    photon_noise: bool = True
    read_noise: float = 0.0
    background: float = 0.0
    full_well: float = np.inf
    gain: float = 0.0

    def __post_init__(self) -> None:
        _check.number_field(self, "photons", _FAINTEST, _check.LARGEST)
        _check.flag("photon_noise", self.photon_noise)
        _check.number_field(self, "read_noise", 0, _BRIGHTEST)
        _check.number_field(self, "background", 0, _BRIGHTEST)
        if not (isinstance(self.full_well, float) and self.full_well == np.inf):
            _check.number_field(self, "full_well", 0, _BRIGHTEST, open_low=True)
        _check.number_field(self, "gain", 0, _BRIGHTEST)
        if self.gain:
            _check.number_field(self, "gain", _FAINTEST, _BRIGHTEST)

    def expose(
        self, frames: ArrayLike, seed: int | np.random.Generator | np.random.SeedSequence | None = None
    ) -> NDArray[np.float64]:
        """Counts of a camera that looks at noiseless frames.

        Parameters
        ----------
        frames : array_like, any shape
            Intensity, 1 = mean of the pupil with the mask out.
        seed : int, Generator or SeedSequence, optional

        Returns
        -------
        ndarray, the shape of `frames`
            Counts, or electrons where `gain` is 0. `saturated` marks pixels at the full well.

        Raises
        ------
        ValueError
            If a frame is negative, or brighter than 9e18 electrons in a pixel.
        """
        frames = _check.real_array("frames", frames)
        _check.finite("frames", frames)
        _check.non_negative("frames", frames)
        rng = _check.generator("seed", seed)
        with np.errstate(over="ignore"):
            electrons = frames.astype(np.float64) * self.photons + self.background
        brightest = electrons.max(initial=0.0)
        if not brightest < _BRIGHTEST:
            raise ValueError(
                f"frames reach {brightest:.3g} electrons in a pixel: expected less than {_BRIGHTEST:g}"
            )
        if self.photon_noise:
            electrons = np.asarray(rng.poisson(electrons), np.float64)
        if self.read_noise:
            electrons += rng.normal(0, self.read_noise, electrons.shape)
        electrons = np.minimum(electrons, self.full_well)
        return np.rint(electrons / self.gain) if self.gain else electrons

    def saturated(self, counts: ArrayLike) -> NDArray[np.bool_]:
        """Where the full well is reached, to half a count."""
        counts = _check.real_array("counts", counts)
        _check.finite("counts", counts)
        return counts * (self.gain or 1.0) >= self.full_well - self.gain / 2

    def normalise(self, counts: ArrayLike, floor: float | None = None) -> NDArray[np.float64]:
        """Frames of counts: background taken off, 1 = mean intensity of the pupil with the mask out.

        Parameters
        ----------
        counts : array_like, any shape
        floor : float, optional
            Raise intensities below this value to it. Noise makes some negative; they stay as they are by default,
            since a floor biases what is estimated from the frames.

        Returns
        -------
        ndarray, the shape of `counts`
        """
        counts = _check.real_array("counts", counts).astype(np.float64, copy=False)
        _check.moderate("counts", counts)
        frames = (counts * (self.gain or 1.0) - self.background) / self.photons
        return frames if floor is None else np.maximum(frames, _check.number("floor", floor))
