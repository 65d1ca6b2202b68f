"""Reconstructors: built once for a sensor, then called on frames; all give a `Reconstruction`."""

from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.base import Reconstruction
from zwfs.reconstructors.gerchberg_saxton import GerchbergSaxton
from zwfs.reconstructors.gradient_descent import GradientDescent
from zwfs.reconstructors.linear import Linear
from zwfs.reconstructors.phase_shifted import PhaseShifted

RECONSTRUCTORS = (Linear, Arcsine, PhaseShifted, GerchbergSaxton, GradientDescent)
"""All reconstructors, in the order in which the book lists them."""

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "GerchbergSaxton",
    "GradientDescent",
    "Linear",
    "PhaseShifted",
    "Reconstruction",
]
