"""Sensor models and reconstructors for the phase-shifted Zernike wavefront sensor."""

from zwfs.detector import Detector
from zwfs.masks import Dimple, Patch
from zwfs.metrics import dynamic_range, reconstruction_error, strehl, wrapped_residual
from zwfs.modes import noll_to_nm, power_law_screens, zernike_basis
from zwfs.pupil import Pupil
from zwfs.reconstructors import (
    RECONSTRUCTORS,
    Arcsine,
    GerchbergSaxton,
    GradientDescent,
    Linear,
    PhaseShifted,
    Reconstruction,
)
from zwfs.sensor import ZernikeSensor

__version__ = "0.1.0"

__all__ = [
    "RECONSTRUCTORS",
    "Arcsine",
    "Detector",
    "Dimple",
    "GerchbergSaxton",
    "GradientDescent",
    "Linear",
    "Patch",
    "PhaseShifted",
    "Pupil",
    "Reconstruction",
    "ZernikeSensor",
    "dynamic_range",
    "noll_to_nm",
    "power_law_screens",
    "reconstruction_error",
    "strehl",
    "wrapped_residual",
    "zernike_basis",
]
