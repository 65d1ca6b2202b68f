"""Reconstruction as a task of a grid: `zwfs.companion.sweeps.grid`."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error
from zwfs.paper.setups import NOISELESS, Noise, Screens
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

# Relative error of the reference waves, by the precision of the frames.
_TOLERANCES = {"float64": 1e-10, "float32": 1e-6}


@dataclass(frozen=True)
class Recovery:
    """Errors of a reconstructor on random screens, for a dimple and an rms.

    Parameters
    ----------
    source : Screens
        Pupil and random screens.
    method : callable
        Called with the sensor of a pair of dimples of opposite phase shifts; returns a reconstructor.
    noise : Noise
    dtype : "float64" or "float32"
        Precision of screens, sensor and frames. Single precision takes half the time, and limits errors to
        1e-5 rad or more.

    Raises
    ------
    TypeError
        If `dtype` is another one.

    Examples
    --------
    >>> from zwfs.companion.sweeps import grid
    >>> from zwfs.paper.grids import Recovery
    >>> from zwfs.paper.setups import make_pupil, make_screens
    >>> source = make_screens(make_pupil(24), 20, exponent=-2.0)
    >>> result = grid(Recovery(source), diameter=[1.0, 2.0], rms=[0.1, 0.3], n_screens=2)
    >>> result.values["error"].shape
    (2, 2, 2)
    """

    source: Screens
    method: Callable[[ZernikeSensor], Any] = PhaseShifted
    noise: Noise = NOISELESS
    dtype: str = "float64"

    def __post_init__(self) -> None:
        _check.float_dtype("dtype", self.dtype)

    def __call__(
        self,
        *,
        n_screens: int,
        seed: np.random.SeedSequence,
        rms: float = 0.5,
        diameter: float = 1.06,
        phase_shift: float = np.pi / 2,
    ) -> dict[str, NDArray]:
        """Return "error" (radian rms) and "converged" of each screen."""
        tolerance = _TOLERANCES[np.dtype(self.dtype).name]
        method = _built(self.method, pickle.dumps(self.source.pupil), diameter, phase_shift, tolerance)
        screens = self.source(rms, n_screens, seed).astype(self.dtype)
        drawn = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0))
        estimate = method(self.noise(method.sensor, screens, drawn))
        error = reconstruction_error(self.source.pupil, estimate.phase, screens)
        return {"error": error, "converged": np.asarray(estimate.converged)}


@lru_cache(maxsize=64)
def _built(
    method: Callable[[ZernikeSensor], Any], pupil: bytes, diameter: float, phase_shift: float, tolerance: float
) -> Any:
    """Return the reconstructor of a dimple; tasks of the same process share it."""
    masks = Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift)
    return method(ZernikeSensor(pickle.loads(pupil), *masks, tolerance=tolerance))
