"""Experiments of section 4.1: errors of reconstructors on random screens, and their causes and cost."""

from __future__ import annotations

import cProfile
import pstats
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.companion import sweeps
from zwfs.masks import Dimple
from zwfs.metrics import reconstruction_error, strehl
from zwfs.modes import power_law_screens
from zwfs.paper.curves import ErrorCurves
from zwfs.paper.setups import NOISELESS, Noise, Screens
from zwfs.pupil import Pupil
from zwfs.reconstructors import (
    Arcsine,
    GerchbergSaxton,
    GradientDescent,
    Linear,
    PhaseShifted,
    Reconstruction,
)
from zwfs.reconstructors.base import load
from zwfs.sensor import ZernikeSensor

PAPER = "Linear", "Arcsine", "GerchbergSaxton", "GradientDescent", "GradientDescentPoints", "PhaseShifted"
"""Names of `paper_reconstructors`."""

_PASSES = ("split_expand", "split_adjoint")  # functions that pass through the low-rank model of the sensor


@dataclass(frozen=True)
class LinearityCurves(ErrorCurves):
    """Errors of several reconstructors against the input, and properties of the screens.

    Attributes
    ----------
    converged : dict of ndarray of bool, shape (n_rms, n_screens)
    wrapped : ndarray, shape (n_rms, n_screens)
        Fraction of the points of each screen whose phase, piston removed, is outside (-pi, pi].
    folded : ndarray, shape (n_rms, n_screens)
        Fraction of the points of each screen below -pi/4, which an arcsine at +pi/2 folds back.
    strehl : ndarray, shape (n_rms, n_screens)
        Strehl ratio of each screen: the share of the light in the core, which makes the reference wave.
    """

    converged: dict[str, NDArray[np.bool_]]
    wrapped: NDArray[np.float64]
    folded: NDArray[np.float64]
    strehl: NDArray[np.float64]


def screens_at(
    modes: NDArray | Screens, rms: float, n_screens: int, seed: int, task: int, exponent: float = -2.0
) -> NDArray[np.floating]:
    """Screens of one task of an experiment: they depend on the seed and the task's number, not on the order.

    `modes` are Zernike modes of power-law screens, or a source of screens, such as `make_screens` returns.
    """
    seed, task = _check.integer_seed("seed", seed), _check.integer("task", task, 0)
    sequence = np.random.SeedSequence(seed, spawn_key=(task,))
    if isinstance(modes, Screens):
        return modes(rms, n_screens, sequence)
    return power_law_screens(modes, rms, n_screens, exponent, sequence)


def check_rms(rms: ArrayLike) -> NDArray[np.floating]:
    """Return the inputs of an experiment as an array, shape (n_rms,)."""
    rms = _check.real_array("rms", rms)
    if rms.ndim != 1 or not rms.size:
        raise ValueError(f"rms has shape {rms.shape}: expected (n_rms,), at least one")
    for value in rms.tolist():
        _check.number("rms", value, 0)
    return rms


def check_reconstructors(reconstructors: Mapping[str, Any]) -> None:
    """Require a mapping of at least one reconstructor."""
    _check.instance("reconstructors", reconstructors, Mapping)
    if not reconstructors:
        raise ValueError("reconstructors is empty: expected at least one")
    for name, reconstructor in reconstructors.items():
        _check.sensor_of(f"reconstructors[{name!r}]", reconstructor)


def paper_reconstructors(
    pupil: Pupil,
    modes: NDArray,
    diameter: float,
    phase_shift: float,
    *,
    extent: float = 2.0,
    **settings: Any,
) -> dict[str, Any]:
    """Return the paper's reconstructors by name, each for the sensor that it needs.

    "Linear" and "Arcsine" use one dimple, the others two of opposite phase shifts. "GradientDescentPoints", which
    is not in the paper, is gradient descent on the points of the pupil in place of modes.

    Parameters
    ----------
    pupil : Pupil
    modes : ndarray, shape (n_modes, ny, nx)
        Modes of the linear reconstructor and of gradient descent.
    diameter : float, lambda/D
        Diameter of the dimples.
    phase_shift : float, radian
        Phase shift of the first dimple; that of the second one is opposite.
    extent : float, pupil diameters
        Width of the detector for Gerchberg-Saxton.
    **settings
        For the iterative reconstructors, such as `n_iterations`.

    Returns
    -------
    dict of reconstructor
    """
    _check.instance("pupil", pupil, Pupil)
    diameter = _check.number("diameter", diameter, 0.01, pupil.n_pixels)
    phase_shift = _check.number("phase_shift", phase_shift, 0.01, 3.13)  # the pair is singular at 0 and pi
    plus, minus = Dimple(diameter, phase_shift), Dimple(diameter, -phase_shift)
    classic, shifted = ZernikeSensor(pupil, plus), ZernikeSensor(pupil, plus, minus)
    wide = ZernikeSensor(pupil, plus, minus, extent=extent)
    return {
        "Linear": Linear(classic, modes),
        "Arcsine": Arcsine(classic, **settings),
        "GerchbergSaxton": GerchbergSaxton(wide, **settings),
        "GradientDescent": GradientDescent(shifted, modes, **settings),
        "GradientDescentPoints": GradientDescent(shifted, **settings),
        "PhaseShifted": PhaseShifted(shifted, **settings),
    }


@dataclass(frozen=True)
class _Started:
    """Reconstructor that starts from the phase of another one for the same frames.

    Attributes
    ----------
    first, then : reconstructor
    """

    first: Any
    then: Any

    @property
    def sensor(self) -> ZernikeSensor:
        """Sensor of both reconstructors."""
        return _check.sensor_of("then", self.then)

    def __call__(self, frames: ArrayLike) -> Reconstruction:
        """Reconstruct the phase of each frame set."""
        return self.then(frames, start=self.first(frames).phase)


def repaired_reconstructors(reconstructors: Mapping[str, Any]) -> dict[str, Any]:
    """Return variants of `paper_reconstructors`, with their settings, that avoid a failure of the originals.

    "GerchbergSaxtonModel" keeps the modelled field where nothing is measured, on a detector as wide as the pupil.
    "GradientDescentStarted" starts from the phase of five phase-shifted iterations.
    """
    check_reconstructors(reconstructors)
    for name in ("GerchbergSaxton", "GradientDescent", "PhaseShifted"):
        _check.choice("reconstructors", name, dict(reconstructors))
    shifted, original = reconstructors["PhaseShifted"].sensor, reconstructors["GerchbergSaxton"].settings
    steps = {"n_iterations": original.n_iterations, "tolerance": original.tolerance}
    start = PhaseShifted(shifted, n_iterations=5)
    return {
        "GerchbergSaxtonModel": GerchbergSaxton(shifted, **steps, unmeasured="model"),
        "GradientDescentStarted": _Started(start, reconstructors["GradientDescent"]),
    }


def own_reconstructors(paths: Sequence[str], reconstructors: Mapping[str, Any]) -> dict[str, Any]:
    """Return a reader's reconstructors by the names of their classes, for sensors of the paper's reconstructors.

    Each path is "module:Class", see `zwfs.reconstructors.base.load`. A class is called with the sensor of one
    dimple if its `n_masks` is 1, else with that of two.

    Raises
    ------
    TypeError, ValueError
        If a path leads to no class of a reconstructor, or its name is one of `reconstructors`.
    """
    check_reconstructors(reconstructors)
    own: dict[str, Any] = {}
    for method in _own_classes(paths, reconstructors):
        like = "Arcsine" if getattr(method, "n_masks", 2) == 1 else "PhaseShifted"
        own[method.__name__] = method(reconstructors[like].sensor)
    return own


def _own_classes(paths: Sequence[str], taken: Iterable[str] = PAPER) -> list[Any]:
    """Return the classes behind the paths of `own_reconstructors`; their names differ from those taken."""
    _check.sequence("paths", paths, expected="a list of 'module:Class'")
    own, names = [], list(taken)
    for index, path in enumerate(paths):
        try:
            own.append(load(path))
        except (TypeError, ValueError) as error:
            raise type(error)(f"paths[{index}]: {error}") from error
        if own[-1].__name__ in names:
            raise ValueError(f"path = {path!r}: expected a name other than {', '.join(names)}")
        names.append(own[-1].__name__)
    return own


def linearity_curves(
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    rms: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
    noise: Noise = NOISELESS,
) -> LinearityCurves:
    """Error of reconstructors on random screens of growing rms: the experiment of section 4.1.

    Each input rms has different screens. All reconstructors see the same screens, each through its own sensor. An
    input is a task of the sweep "linearity_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    reconstructors : mapping of str to reconstructor
        For sensors on the same pupil. Anything with a `sensor` counts that takes the frames of that sensor and
        returns an object with `phase`, (n_screens, ny, nx), and `converged`, (n_screens,).
    modes : ndarray, shape (n_modes, ny, nx), or Screens
        Zernike modes that the screens are made of, or a source of screens.
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
        Screens for each rms.
    exponent : float
        Exponent of the power spectral density of the screens; a source of screens has its own.
    seed : int
    noise : Noise
        Of the camera; reconstructors with the same sensor see the same frames.

    Returns
    -------
    LinearityCurves

    References
    ----------
    Chambouleyron et al. 2024, section 4.1 and Figure 3.
    """
    rms = check_rms(rms)
    n_screens = _check.integer("n_screens", n_screens, 1)
    exponent = _check.number("exponent", exponent)
    seed = _check.integer_seed("seed", seed)
    check_reconstructors(reconstructors)
    _check.instance("noise", noise, Noise)
    shared = dict(reconstructors), modes, n_screens, exponent, seed, noise
    points = sweeps.run(_linearity_point, enumerate(rms.tolist()), *shared, name="linearity_curves")
    errors, converged, *light = zip(*points, strict=True)
    return LinearityCurves(
        rms,
        {name: np.array([point[name] for point in errors]) for name in reconstructors},
        {name: np.array([point[name] for point in converged]) for name in reconstructors},
        *map(np.array, light),
    )


def _linearity_point(
    point: tuple[int, float],
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    n_screens: int,
    exponent: float,
    seed: int,
    noise: Noise,
) -> tuple[dict[str, NDArray], dict[str, NDArray], NDArray, NDArray, NDArray]:
    """One input of the linearity curves: errors, converged, wrapped, folded and Strehl, (n_screens,) each."""
    task, rms = point
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    pupil = next(iter(reconstructors.values())).sensor.pupil
    phase = pupil.gather(screens)
    errors, converged = {}, {}
    for name, reconstructor in reconstructors.items():
        drawn = np.random.SeedSequence(seed, spawn_key=(task, 0))
        estimate = reconstructor(noise(reconstructor.sensor, screens, drawn))
        errors[name] = reconstruction_error(pupil, estimate.phase, screens)
        converged[name] = estimate.converged
    wrapped, folded = np.mean(np.abs(phase) > np.pi, axis=-1), np.mean(phase < -np.pi / 4, axis=-1)
    return errors, converged, wrapped, folded, strehl(pupil, screens)


def iteration_errors(
    reconstructor: Any, modes: NDArray, rms: float, n_screens: int, *, exponent: float = -2.0, seed: int = 0
) -> NDArray[np.float64]:
    """Error of a reconstructor on random screens, iteration by iteration.

    Parameters
    ----------
    reconstructor : reconstructor
    modes : ndarray, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    rms : float, radian rms
    n_screens : int
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    ndarray, shape (n_screens, n_iterations + 1), radian rms
        Before the first iteration (a flat wavefront) and after each one.
    """
    sensor = _check.sensor_of("reconstructor", reconstructor)
    screens = screens_at(modes, rms, n_screens, seed, 0, exponent)
    errors = np.empty((n_screens, reconstructor.settings.n_iterations + 1))
    # One screen at a time: the history of all of them would take much memory.
    for index, screen in enumerate(screens):
        history = reconstructor(sensor.measure(screen), history=True).history
        errors[index] = reconstruction_error(sensor.pupil, history, screen)
    return errors


def saxton_by_width(
    reconstructors: Mapping[str, Any],
    modes: NDArray | Screens,
    extents: ArrayLike,
    n_screens: int,
    **settings: Any,
) -> tuple[dict[str, GerchbergSaxton], LinearityCurves]:
    """Error of variants of Gerchberg-Saxton on detectors of several widths, and of the linear method.

    The first variants take the unmeasured field as "zero", one for each of `extents` (D). The last two keep the
    "model" on the narrowest of these detectors, with the usual number of iterations and with eight times as many.

    Parameters
    ----------
    reconstructors : mapping of str to reconstructor
        With "Linear" and "GerchbergSaxton", whose masks and settings the variants have.
    modes, n_screens, **settings
        As for `linearity_curves`.
    extents : array_like, shape (n_extents,), pupil diameters

    Returns
    -------
    variants : dict of GerchbergSaxton
    curves : LinearityCurves
        Of the variants and "Linear", at inputs from 0.1 to 0.8 rad rms.
    """
    check_reconstructors(reconstructors)
    _check.choice("reconstructors", "Linear", dict(reconstructors))
    original: Any = reconstructors.get("GerchbergSaxton")
    _check.instance("reconstructors['GerchbergSaxton']", original, GerchbergSaxton)
    extents = _check.real_array("extents", extents)
    if extents.ndim != 1 or not extents.size or not np.all((extents >= 1) & (extents <= 100)):
        raise ValueError(f"extents = {_check.shown(extents)}: expected a list of values between 1 and 100")
    sensor, n_iterations = original.sensor, original.settings.n_iterations
    chosen = [(extent, "zero", n_iterations) for extent in extents.tolist()]
    chosen += [(float(extents.min()), "model", n) for n in (n_iterations, 8 * n_iterations)]
    variants = {
        f"{extent:g} D, {unmeasured}, {n}": GerchbergSaxton(
            ZernikeSensor(sensor.pupil, *sensor.masks, extent=extent), n_iterations=n, unmeasured=unmeasured
        )
        for extent, unmeasured, n in chosen
    }
    methods, inputs = {"Linear": reconstructors["Linear"], **variants}, [0.1, 0.2, 0.3, 0.5, 0.8]
    return variants, linearity_curves(methods, modes, inputs, n_screens, **settings)


def light_lost(sensor: ZernikeSensor) -> float:
    """Fraction of the light of a flat wavefront that misses the detector behind the first mask."""
    _check.instance("sensor", sensor, ZernikeSensor)
    return 1 - float(sensor.measure(np.zeros(sensor.pupil.shape))[0].sum()) / sensor.pupil.n_points


def count_work(reconstructors: Mapping[str, Any], phase: NDArray) -> tuple[dict[str, int], set[str]]:
    """Count how often reconstructors pass through the model of the sensor, for one wavefront (ny, nx) in radian.

    Returns the passes of each reconstructor, forward or back, and all functions for Fourier transforms that any of
    them calls.
    """
    check_reconstructors(reconstructors)
    passes, fourier = {}, set()
    for name, reconstructor in reconstructors.items():
        frames = reconstructor.sensor.measure(phase)
        reconstructor(frames)  # the first call also builds what later calls use again
        profile = cProfile.Profile()
        profile.runcall(reconstructor, frames)
        calls = pstats.Stats(profile).stats  # type: ignore[attr-defined]
        places = {place: f"{place[0]}:{place[2]}" for place in calls}
        fourier |= {text for text in places.values() if "fft" in text}
        passes[name] = sum(calls[place][1] for place in places if place[2] in _PASSES)
    return passes, fourier


def run_out(reconstructor: PhaseShifted, phase: NDArray) -> float:
    """Error (radian rms) of 200 phase-shifted iterations without a stopping rule, for one wavefront in radian."""
    _check.instance("reconstructor", reconstructor, PhaseShifted)
    sensor = reconstructor.sensor
    estimate = PhaseShifted(sensor, n_iterations=200, tolerance=0)(sensor.measure(phase))
    return float(reconstruction_error(sensor.pupil, estimate.phase, phase))


def model_accuracy(sensor: ZernikeSensor, phase: NDArray, tolerances: ArrayLike) -> NDArray[np.float64]:
    """Rank of the low-rank model of a sensor and error of the reference wave, for several tolerances.

    Returns rows (n, 3): tolerance, rank, and largest error on the detector for a phase (radian), relative to the
    largest modulus of the wave. The model with a tolerance of 1e-14 is the truth.
    """
    _check.instance("sensor", sensor, ZernikeSensor)
    tolerances = _check.real_array("tolerances", tolerances)
    if tolerances.ndim != 1 or not tolerances.size or not np.all((tolerances >= 1e-14) & (tolerances <= 0.1)):
        raise ValueError(
            f"tolerances = {_check.shown(tolerances)}: expected a list of values between 1e-14 and 0.1"
        )
    phase = _check.real_array("phase", phase)
    _check.maps("phase", phase, sensor.pupil.shape)
    field = sensor.pupil.field(phase)
    exact = ZernikeSensor(sensor.pupil, *sensor.masks, tolerance=1e-14).reference_wave(field)
    rows = []
    for tolerance in tolerances.tolist():
        model = ZernikeSensor(sensor.pupil, *sensor.masks, tolerance=tolerance)
        error = np.abs(model.reference_wave(field) - exact).max() / np.abs(exact).max()
        rows.append((tolerance, model.rank, error))
    return np.array(rows)
