"""Sensor models and reconstructors for the phase-shifted Zernike wavefront sensor.

`zwfs.turbulence`, `zwfs.bench` and `zwfs.frames` are imported by their own names. Every public function checks its
arguments: a TypeError or a ValueError names the argument, its value and what was expected.
"""

from typing import TYPE_CHECKING

from zwfs import _lazy

if TYPE_CHECKING:
    from zwfs.bounds import cramer_rao
    from zwfs.design import SensorDesign, design_sensor
    from zwfs.detector import Detector
    from zwfs.loop import LoopRecord, Mirror, close_loop
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
        LearnedReference,
        LikelihoodReconstruction,
        Linear,
        MaximumLikelihood,
        PhaseShifted,
        Reconstruction,
    )
    from zwfs.sensor import ZernikeSensor
    from zwfs.units import opd_to_phase, phase_to_opd
else:
    __getattr__, __dir__ = _lazy.offer(__name__)

__version__ = "0.1.0"

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "Detector",
    "Dimple",
    "GerchbergSaxton",
    "GradientDescent",
    "LearnedReference",
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
    "SensorDesign",
    "ZernikeSensor",
    "close_loop",
    "cramer_rao",
    "design_sensor",
    "dynamic_range",
    "noll_to_nm",
    "opd_to_phase",
    "phase_to_opd",
    "power_law_screens",
    "reconstruction_error",
    "strehl",
    "wrapped_residual",
    "zernike_basis",
]
