"""Order of the two images, from one known poke: exchanging the images changes the sign of the phase."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.frames.pipeline import MeasuredPhase, Measurement, Optics, recover_phase

_LEAST = 0.5  # skewness of the change of phase: that of noise is about 0, that of one poke 1


@dataclass(frozen=True)
class ImageOrder:
    """Result of `order_of_images`.

    Attributes
    ----------
    optics : Optics
        Those of the measurement, with the phase shifts in the right order.
    exchanged : bool
        Whether the phase shifts of the measurement were in the wrong order.
    score, other : float
        For the right order and for the wrong one: the sum of the cubed change of phase over that of its absolute
        cube, times the sign of the poke. It is 1 for a change of one sign.
    """

    optics: Optics
    exchanged: bool
    score: float
    other: float


def order_of_images(flat: Measurement, poked: Measurement, sign: int = 1, n_iterations: int = 25) -> ImageOrder:
    """Find which image has which phase shift, from a poke of known sign.

    No frame shows which image belongs to +theta and which to -theta: the exchange changes the sign of the phase
    and nothing else. One known change decides it. Record the frames twice, the second time with one actuator or
    segment poked by about 0.3 to 1 rad; where the poke stands need not be known.

    Parameters
    ----------
    flat, poked : Measurement
        From `reduce_frames`, before and after the poke, with the same optics and clear frames.
    sign : int
        1 if the poke lengthens the optical path, that is if it pulls a mirror away from the incoming light and so
        raises the phase; -1 if it shortens it.
    n_iterations : int
        As for `recover_phase`.

    Returns
    -------
    ImageOrder

    Raises
    ------
    TypeError, ValueError
        If a value is of the wrong kind, the measurements do not fit together, or the change of phase between them
        is not that of one poke.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.bench.model import Bench
    >>> from zwfs.frames.order import order_of_images
    >>> from zwfs.frames.pipeline import Optics, reduce_frames
    >>> from zwfs.frames.registration import Image, record
    >>> bench = Bench(n_pixels=40)
    >>> wrong = Optics(bench.diameter, (-bench.phase, bench.phase))
    >>> def measured(pistons):
    ...     pairs = bench.frames(pistons), bench.clear_frames()
    ...     frame, clear = (Image(counts, bad=counts < 0) for counts in map(np.hstack, pairs))
    ...     return reduce_frames(record([frame], [clear]), wrong)
    ...
    >>> poke = 0.5 * (np.arange(bench.n_segments) == 5)
    >>> order_of_images(measured(0 * poke), measured(poke)).exchanged
    True
    """
    _check.instance("flat", flat, Measurement)
    _check.instance("poked", poked, Measurement)
    if not (sign := _check.integer("sign", sign, -1, 1)):
        raise ValueError("sign = 0: expected 1 or -1")
    if flat.pupil.shape != poked.pupil.shape or flat.optics != poked.optics:
        raise ValueError("flat and poked differ in optics or in the grid of the pupil: expected the same")
    optics = flat.optics
    choices = [optics, replace(optics, phase_shifts=optics.phase_shifts[::-1])]
    scores = [
        sign * _skewness(*(recover_phase(replace(one, optics=choice), n_iterations) for one in (flat, poked)))
        for choice in choices
    ]
    best = int(np.argmax(scores))
    score, other = scores[best], scores[1 - best]
    if score < _LEAST or score - other < _LEAST:
        raise ValueError(
            f"flat and poked: the change of phase scores {scores[0]:.2f} and {scores[1]:.2f} for the two orders: "
            f"expected one above {_LEAST}, from a poke of one sign on less than half of the pupil"
        )
    return ImageOrder(choices[best], best == 1, score, other)


def _skewness(flat: MeasuredPhase, poked: MeasuredPhase) -> float:
    """How far the change of phase has one sign, in [-1, 1]; the cube weights the poke and not the noise."""
    both = np.isfinite(flat.phase) & np.isfinite(poked.phase)
    waves = np.exp(1j * (poked.phase - flat.phase)[both])
    change: NDArray[np.float64] = np.angle(waves * np.exp(-1j * np.angle(waves.mean())))
    cubes = (change - np.median(change)) ** 3
    return float(cubes.sum() / max(np.abs(cubes).sum(), 1e-300))
