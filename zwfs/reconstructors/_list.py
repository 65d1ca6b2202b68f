"""The list of the reconstructors, apart from the package, which imports none before its use."""

from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.gerchberg_saxton import GerchbergSaxton
from zwfs.reconstructors.gradient_descent import GradientDescent
from zwfs.reconstructors.linear import Linear
from zwfs.reconstructors.maximum_likelihood import MaximumLikelihood
from zwfs.reconstructors.phase_shifted import PhaseShifted

RECONSTRUCTORS = (Arcsine, GerchbergSaxton, GradientDescent, Linear, MaximumLikelihood, PhaseShifted)
"""All reconstructors that need no training."""
