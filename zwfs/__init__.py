"""Sensor models and reconstructors for the phase-shifted Zernike wavefront sensor."""

import importlib
import pkgutil
from types import ModuleType
from typing import TYPE_CHECKING

from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.loop import LoopRecord, Mirror, close_loop, hold_drift
from zwfs.masks import Dimple, Patch
from zwfs.metrics import dynamic_range, reconstruction_error, strehl, wrapped_residual
from zwfs.modes import noll_to_nm, power_law_screens, zernike_basis
from zwfs.polychromatic import PolychromaticSensor
from zwfs.pupil import Pupil
from zwfs.reconstructors import (
    RECONSTRUCTORS,
    Arcsine,
    GerchbergSaxton,
    GradientDescent,
    LikelihoodReconstruction,
    Linear,
    MaximumLikelihood,
    PhaseShifted,
    Reconstruction,
)
from zwfs.sensor import ZernikeSensor
from zwfs.units import opd_to_phase, phase_to_opd

# The modules, for type checkers and editors. At run time each one is imported at its first use, see `__getattr__`.
if TYPE_CHECKING:
    from zwfs import bench as bench
    from zwfs import bounds as bounds
    from zwfs import companion as companion
    from zwfs import detector as detector
    from zwfs import focal as focal
    from zwfs import frames as frames
    from zwfs import loop as loop
    from zwfs import masks as masks
    from zwfs import metrics as metrics
    from zwfs import modes as modes
    from zwfs import paper as paper
    from zwfs import plots as plots
    from zwfs import polychromatic as polychromatic
    from zwfs import pupil as pupil
    from zwfs import reconstructors as reconstructors
    from zwfs import sensor as sensor
    from zwfs import turbulence as turbulence
    from zwfs import units as units

    __version__: str

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "Detector",
    "Dimple",
    "GerchbergSaxton",
    "GradientDescent",
    "LikelihoodReconstruction",
    "Linear",
    "LoopRecord",
    "MaximumLikelihood",
    "Mirror",
    "Patch",
    "PhaseShifted",
    "PolychromaticSensor",
    "Pupil",
    "Reconstruction",
    "ZernikeSensor",
    "close_loop",
    "cramer_rao",
    "dynamic_range",
    "hold_drift",
    "noll_to_nm",
    "opd_to_phase",
    "phase_to_opd",
    "power_law_screens",
    "reconstruction_error",
    "strehl",
    "wrapped_residual",
    "zernike_basis",
]


def _modules() -> list[str]:
    return [module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith("_")]


if not TYPE_CHECKING:  # A type checker would take any misspelt name for a module.

    def __getattr__(name: str) -> ModuleType | str:
        if name == "__version__":  # pyproject.toml is its only place
            return importlib.import_module("importlib.metadata").version(__name__)
        if name in _modules():
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_modules(), "__version__"})
