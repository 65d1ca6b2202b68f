"""Reconstructors of the figures: those of the paper, repaired variants, and those of a reader."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.kit.style import LOOKS, Look
from zwfs import _check
from zwfs.masks import Dimple
from zwfs.pupil import Pupil
from zwfs.reconstructors import (
    RECONSTRUCTORS,
    Arcsine,
    GerchbergSaxton,
    GradientDescent,
    Linear,
    MaximumLikelihood,
    PhaseShifted,
)
from zwfs.sensor import ZernikeSensor

PAPER = ("Linear", "Arcsine", "GerchbergSaxton", "GradientDescent", "GradientDescentPoints", "PhaseShifted")
MODEL_SAXTON = "GerchbergSaxtonModel"
OWN_CHAPTER = ("MaximumLikelihood",)  # reconstructors of the package that Figures 3 and 4 leave to other chapters


def paper_reconstructors(
    pupil: Pupil,
    modes: NDArray,
    diameter: float,
    phase_shift: float,
    *,
    extent: float = 2.0,
    **settings: Any,
) -> dict[str, Any]:
    """Return the paper's reconstructors by name, each for the sensor that it needs."""
    plus, minus = Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift)
    classic, shifted = ZernikeSensor(pupil, plus), ZernikeSensor(pupil, plus, minus)
    wide = ZernikeSensor(pupil, plus, minus, extent=extent)
    methods = (
        Linear(classic, modes),
        Arcsine(classic, **settings),
        GerchbergSaxton(wide, **settings),
        GradientDescent(shifted, modes, **settings),
        GradientDescent(shifted, **settings),
        PhaseShifted(shifted, **settings),
    )
    return dict(zip(PAPER, methods, strict=True))


def model_saxton(reconstructors: Mapping[str, Any]) -> dict[str, Any]:
    """Return the variant of Gerchberg-Saxton, with its settings, that keeps the field off the detector."""
    settings = reconstructors["GerchbergSaxton"].settings
    steps = {"n_iterations": settings.n_iterations, "tolerance": settings.tolerance}
    return {MODEL_SAXTON: GerchbergSaxton(reconstructors["PhaseShifted"].sensor, **steps, unmeasured="model")}


def own_reconstructors(paths: Sequence[str], reconstructors: Mapping[str, Any], modes: NDArray) -> dict[str, Any]:
    """Return the reconstructors that a reader names or adds to the package, for sensors of the paper's."""
    added = {method.__name__: method for method in RECONSTRUCTORS}
    for name in (*PAPER, *OWN_CHAPTER):
        added.pop(name, None)
    classic, shifted = (reconstructors[name].sensor for name in ("Arcsine", "PhaseShifted"))
    offered = {"modes": modes, "n_iterations": reconstructors["PhaseShifted"].settings.n_iterations}
    return {
        name: method(shifted if _accepts_two_masks(method) else classic, **_asked(method, offered))
        for name, method in (added | _own_classes(paths)).items()
    }


def _accepts_two_masks(method: Any) -> bool:
    """Whether a class accepts a sensor with two masks; its `n_masks` is a number, or (fewest, most)."""
    n_masks = getattr(method, "n_masks", 2)
    fewest, most = n_masks if isinstance(n_masks, tuple) else (n_masks, n_masks)
    return fewest <= 2 <= most


def _asked(method: Any, offered: Mapping[str, Any]) -> dict[str, Any]:
    """Return the offered settings that the constructor of a class asks for by name."""
    return {name: value for name, value in offered.items() if name in inspect.signature(method).parameters}


def _load(path: str) -> type:
    """Return the class of a reconstructor from its path, "module:Class", in any module that can be imported."""
    if not isinstance(path, str):
        raise TypeError(f"path = {_check.shown(path)}: expected a string 'module:Class'")
    module, colon, name = path.partition(":")
    if not (colon and name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
        raise ValueError(f"path = {path!r}: expected 'module:Class', such as 'my_method:MyMethod'")
    try:
        method = getattr(import_module(module), name, None)
    except (Exception, SystemExit) as error:  # whatever code raises
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"path = {path!r}: expected a module that can be imported ({reason})") from error
    if not isinstance(method, type) or "__call__" not in dir(method):
        raise ValueError(f"path = {path!r}: expected the class of a reconstructor, got {_check.shown(method)}")
    return method


def _own_classes(paths: Sequence[str]) -> dict[str, Any]:
    """Return a reader's classes by their names, which differ from those of the paper's reconstructors."""
    package = {f"zwfs:{method.__name__}": method for method in RECONSTRUCTORS}
    own: dict[str, Any] = {}
    for path in paths:
        method = package.get(path) or _load(path)
        reserved = (*PAPER, MODEL_SAXTON, *own)
        if method.__name__ in reserved:
            raise ValueError(f"path = {path!r}: expected a name other than {', '.join(reserved)}")
        own[method.__name__] = method
    return own


def check_own(paths: Sequence[str]) -> None:
    """Refuse paths that `own_reconstructors` would refuse, before any work."""
    _own_classes(paths)


MASKS = {
    "Keck": (Dimple(2.4, 0.30 * np.pi), Dimple(2.4, -0.68 * np.pi)),
    "OZIRIIS, on the sky": (Dimple(1.96, 0.33 * np.pi), Dimple(1.96, -0.74 * np.pi)),
    "OZIRIIS, in the laboratory": (Dimple(2.14, 0.33 * np.pi), Dimple(2.14, -0.74 * np.pi)),
}
"""Pairs of dimples in instruments.

Keck's are those of Salama et al. 2024, OZIRIIS's those of its telemetry software (Motte 2026).
"""


def opposite_dimples(pupil: Pupil, diameter: float, phase_shift: float) -> ZernikeSensor:
    """Return the sensor with two dimples of one diameter (lambda/D) and opposite phase shifts (radian)."""
    return ZernikeSensor(pupil, Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift))


PLAIN, ACCELERATED, LIKELY, MODES = (
    "PhaseShifted", "PhaseShiftedAccelerated", "MaximumLikelihood", "MaximumLikelihoodModes",
)  # fmt: skip
"""Names of the compared methods."""


def compared_methods(
    sensor: ZernikeSensor, n_iterations: int, photons: float = 0.0, n_starts: int = 8
) -> dict[str, Any]:
    """Return the paper's iteration, its accelerated form, and maximum likelihood, by name."""
    return {
        PLAIN: PhaseShifted(sensor, n_iterations=n_iterations),
        ACCELERATED: PhaseShifted(sensor, n_iterations=n_iterations, accelerate=True),
        LIKELY: MaximumLikelihood(sensor, photons=photons or None, n_starts=n_starts),
    }


def method_look(name: str) -> Look:
    """Look of a compared method: variants of a method have its colour."""
    if name == ACCELERATED:
        return replace(LOOKS[PLAIN], name="phase-shifted, accelerated", line="-")
    if name == MODES:
        return replace(LOOKS[LIKELY], name="maximum likelihood on modes", line="--", marker="o")
    return LOOKS[name]


def method_line(name: str) -> dict[str, Any]:
    """How a method is drawn: maximum likelihood wide and below, the accelerated iteration with hollow marks."""
    look = method_look(name)
    style = look.style | {"label": look.label}
    if name == LIKELY:
        return style | {"ms": 8, "lw": 3, "zorder": 1.9}
    return style | {"ms": 5, "lw": 1.6, "mfc": "#ffffff" if name == ACCELERATED else look.color}
