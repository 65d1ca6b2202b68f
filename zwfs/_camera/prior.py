"""Prior of a map: a power law of the spatial frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from zwfs import _check


@dataclass(frozen=True)
class MapPrior:
    """Gaussian prior of a map: a power law of the spatial frequency.

    Parameters
    ----------
    rms : float
        Standard deviation of a pixel; radian for a phase, 1 = mean amplitude for an amplitude.
    exponent : float
        The power spectral density falls with the frequency to this power; 0 for pixels that are independent.
    outer_scale : float, D
        Below one cycle over this length the density is flat.

    Examples
    --------
    >>> from zwfs._camera.prior import MapPrior
    >>> spectrum = MapPrior(rms=0.5, exponent=2.0).spectrum(32, n_pixels=24)
    >>> spectrum.shape, bool(spectrum[0, 1] > spectrum[0, 2])
    ((32, 17), True)
    """

    rms: float
    exponent: float = 0.0
    outer_scale: float = 2.0

    def __post_init__(self) -> None:
        _check.number("rms", self.rms, 0, open_low=True)
        _check.number("exponent", self.exponent, 0, 10)
        _check.number("outer_scale", self.outer_scale, 0, open_low=True)

    def spectrum(self, size: int, n_pixels: float) -> NDArray[np.float64]:
        """Variance of each frequency on a periodic grid, on half the plane, (size, size // 2 + 1)."""
        v, u = fft.fftfreq(size)[:, None], fft.rfftfreq(size)
        bend = 1 / (self.outer_scale * n_pixels)
        shape = (u**2 + v**2 + bend**2) ** (-self.exponent / 2)
        twice = np.where((u == 0) | (u == 0.5), 1.0, 2.0)  # half the plane stands for all of it
        return shape * self.rms**2 * size**2 / np.sum(shape * twice)
