"""Reconstructors: built once for a sensor, then called on frames; all return a `Reconstruction`.

Every module of this package is imported, and the reconstructors that it defines are names of the package. A new
method needs a module here and nothing else.
"""

import inspect
import pkgutil
from importlib import import_module

from zwfs.reconstructors.arcsine import Arcsine
from zwfs.reconstructors.base import Reconstruction, Reconstructor
from zwfs.reconstructors.gerchberg_saxton import GerchbergSaxton
from zwfs.reconstructors.gradient_descent import GradientDescent
from zwfs.reconstructors.linear import Linear
from zwfs.reconstructors.maximum_likelihood import LikelihoodReconstruction, MaximumLikelihood
from zwfs.reconstructors.phase_shifted import PhaseShifted


def _defined() -> tuple[type[Reconstructor], ...]:
    """Reconstructors of all modules of this package."""
    modules = [import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    return tuple(
        thing
        for module in modules
        for thing in vars(module).values()
        if inspect.isclass(thing) and issubclass(thing, Reconstructor)
        and thing.__module__ == module.__name__ and not inspect.isabstract(thing)
    )  # fmt: skip


RECONSTRUCTORS = _defined()
"""All reconstructors of the package, in the order of their modules."""

globals().update({method.__name__: method for method in RECONSTRUCTORS})

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
