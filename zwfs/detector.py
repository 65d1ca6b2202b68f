"""A camera: photons, read noise and background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check

_BRIGHTEST = 9e18  # electrons in a pixel: 64 bits count no more
_FAINTEST = 1e-12  # photons of a point, by which electrons are divided


@dataclass(frozen=True)
class Detector:
    """Camera that turns frames into electrons, and electrons back into frames.

    The electrons of a pixel follow the Poisson distribution; the electronics add read noise.

    Parameters
    ----------
    photons : float
        Photons per pupil point and image: those that an intensity of 1 puts into a pixel. At least 1e-12.
    read_noise : float, electrons rms / pixel
    background : float, electrons / pixel
        Dark and stray light; it has photon noise, too.

    Examples
    --------
    >>> import numpy as np, zwfs
    >>> pupil = zwfs.Pupil.circular(32)
    >>> sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2))
    >>> camera = zwfs.Detector(photons=1000, read_noise=1.0)
    >>> electrons = camera.expose(sensor.measure(np.zeros(pupil.shape)), seed=1)
    >>> camera.normalise(electrons).shape
    (1, 32, 32)
    """

    photons: float
    read_noise: float = 0.0
    background: float = 0.0

    def __post_init__(self) -> None:
        _check.number_field(self, "photons", _FAINTEST, _check.LARGEST)
        _check.number_field(self, "read_noise", 0, _BRIGHTEST)
        _check.number_field(self, "background", 0, _BRIGHTEST)

    def expose(
        self, frames: ArrayLike, seed: int | np.random.Generator | np.random.SeedSequence | None = None
    ) -> NDArray[np.float64]:
        """Electrons of a camera that looks at noiseless frames.

        Parameters
        ----------
        frames : array_like, any shape
            Intensity, 1 = mean of the pupil with the mask out.
        seed : int, Generator or SeedSequence, optional

        Returns
        -------
        ndarray, the shape of `frames`
            Electrons; read noise makes some negative.

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
        electrons = np.asarray(rng.poisson(electrons), np.float64)
        if self.read_noise:
            electrons += rng.normal(0, self.read_noise, electrons.shape)
        return electrons

    def normalise(self, electrons: ArrayLike) -> NDArray[np.float64]:
        """Frames of electrons: background taken off, 1 = mean intensity of the pupil with the mask out.

        Parameters
        ----------
        electrons : array_like, any shape

        Returns
        -------
        ndarray, the shape of `electrons`
            Noise makes some values negative: to raise them to 0 would bias what is estimated from the frames.
        """
        electrons = _check.real_array("electrons", electrons).astype(np.float64, copy=False)
        _check.moderate("electrons", electrons)
        return (electrons - self.background) / self.photons
