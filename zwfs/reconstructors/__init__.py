"""Reconstructors: built once for a sensor, then called on frames; all return a `Reconstruction`.

A new method is a module here, its import below and its place in `RECONSTRUCTORS`, in `_list.py`.
"""

from typing import TYPE_CHECKING

from zwfs import _lazy

if TYPE_CHECKING:
    from zwfs.reconstructors._list import RECONSTRUCTORS
    from zwfs.reconstructors.arcsine import Arcsine
    from zwfs.reconstructors.base import Reconstruction
    from zwfs.reconstructors.gerchberg_saxton import GerchbergSaxton
    from zwfs.reconstructors.gradient_descent import GradientDescent
    from zwfs.reconstructors.learned import LearnedReference
    from zwfs.reconstructors.linear import Linear
    from zwfs.reconstructors.maximum_likelihood import LikelihoodReconstruction, MaximumLikelihood
    from zwfs.reconstructors.phase_shifted import PhaseShifted
else:
    __getattr__, __dir__ = _lazy.offer(__name__)

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "GerchbergSaxton",
    "GradientDescent",
    "LearnedReference",
    "LikelihoodReconstruction",
    "Linear",
    "MaximumLikelihood",
    "PhaseShifted",
    "Reconstruction",
]
