"""Reconstructors: built once for a sensor, then called on frames; all return a `Reconstruction`.

A new method is a module here, its import and its place in `RECONSTRUCTORS`.
"""

from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.base import Reconstruction
from zwfs.reconstructors.gerchberg_saxton import GerchbergSaxton
from zwfs.reconstructors.gradient_descent import GradientDescent
from zwfs.reconstructors.linear import Linear
from zwfs.reconstructors.maximum_likelihood import LikelihoodReconstruction, MaximumLikelihood
from zwfs.reconstructors.phase_shifted import PhaseShifted

RECONSTRUCTORS = (Arcsine, GerchbergSaxton, GradientDescent, Linear, MaximumLikelihood, PhaseShifted)
"""All reconstructors of the package."""

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "GerchbergSaxton",
    "GradientDescent",
    "LikelihoodReconstruction",
    "Linear",
    "MaximumLikelihood",
    "PhaseShifted",
    "Reconstruction",
]
