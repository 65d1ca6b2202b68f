"""Phase and amplitude from two masks and a clear frame, and the cost of a wrong amplitude. Not in the paper."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from zwfs import _check
from zwfs.bounds import cramer_rao
from zwfs.companion import sweeps
from zwfs.detector import Detector
from zwfs.metrics import reconstruction_error
from zwfs.modes import power_law_screens
from zwfs.paper.linearity import screens_at
from zwfs.pupil import Pupil
from zwfs.reconstructors import LikelihoodReconstruction, MaximumLikelihood, PhaseShifted, Reconstruction
from zwfs.sensor import ZernikeSensor

KINDS = ("scintillation", "dips")
"""Kinds of amplitude maps, see `amplitude_maps`."""

_SPOTS, _WIDTH = 12, 0.05  # dips of one map, and their standard deviation, D
_LARGEST = 0.4  # variation; dips cannot vary much more


class Way(NamedTuple):
    """Method, by the name of its class, and its amplitude: "ignored" (uniform), "measured" or "estimated"."""

    method: str
    amplitude: str


WAYS = {
    f"{method}, {amplitude}": Way(method, amplitude)
    for method, amplitude in (
        ("PhaseShifted", "ignored"),
        ("MaximumLikelihood", "ignored"),
        ("PhaseShifted", "measured"),
        ("MaximumLikelihood", "measured"),
        ("MaximumLikelihood", "estimated"),
    )
}
"""Ways to reconstruct a phase from two masks and a clear frame, by name."""


@dataclass(frozen=True)
class AmplitudeCurves:
    """Errors of the ways of `WAYS` against the variation of the amplitude, next to the bound.

    Attributes
    ----------
    variations : ndarray, shape (n,)
        Standard deviation of the amplitude over the pupil, relative to its mean.
    errors : dict of ndarray, shape (n, n_screens), radian rms
        Error of the phase on each screen, by the name of the way.
    consistent : dict of ndarray of bool, shape (n, n_screens)
        `consistent` of `MaximumLikelihood` for each screen, by the name of the way.
    bound : ndarray, shape (n,), radian rms
        Cramer-Rao bound of the phase where the amplitude is unknown, rms over pupil and screens.
    """

    variations: NDArray[np.floating]
    errors: dict[str, NDArray[np.float64]]
    consistent: dict[str, NDArray[np.bool_]]
    bound: NDArray[np.float64]

    def error(self, way: str) -> NDArray[np.float64]:
        """Error of a way, rms over the screens, shape (n,), radian rms."""
        _check.choice("way", way, self.errors)
        return np.sqrt(np.mean(self.errors[way] ** 2, axis=1))

    def at(self, variation: float) -> int:
        """Place of the sampled variation that is nearest to `variation`."""
        return int(np.argmin(np.abs(self.variations - _check.number("variation", variation))))


def amplitude_maps(
    pupil: Pupil,
    modes: ArrayLike,
    kind: str,
    variation: float,
    n_maps: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Random maps of an amplitude whose mean square over the pupil is 1.

    The logarithm of the amplitude is a random screen of `power_law_screens` ("scintillation"), or the negative sum
    of 12 Gaussian spots with a standard deviation of 0.05 D at random points of the pupil ("dips"). It is scaled
    so that the amplitude has the stated variation.

    Parameters
    ----------
    pupil : Pupil
    modes : array_like, shape (n_modes, ny, nx)
        Modes that the screens are made of.
    kind : str
        "scintillation" or "dips".
    variation : float
        Standard deviation over the pupil, relative to the mean, from 0 to 0.4.
    n_maps : int
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    ndarray, shape (n_maps, ny, nx)
        0 outside the pupil.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    _check.instance("pupil", pupil, Pupil)
    _check.modes("modes", modes, pupil)
    _check.choice("kind", kind, KINDS)
    variation = _check.number("variation", variation, 0, _LARGEST)
    n_maps = _check.integer("n_maps", n_maps, 1)
    rng = np.random.default_rng([_check.integer_seed("seed", seed), KINDS.index(kind)])
    if kind == "scintillation":
        logarithms = pupil.gather(power_law_screens(modes, 1.0, n_maps, exponent, rng))
    else:
        centers = pupil.points[rng.integers(pupil.n_points, size=(n_maps, _SPOTS))]
        squares = np.sum((pupil.points[:, np.newaxis] - centers[:, np.newaxis]) ** 2, axis=-1)
        logarithms = -np.sum(np.exp(-squares / (2 * _WIDTH**2)), axis=-1)
    return pupil.scatter(np.array([_varied(one, variation) for one in logarithms]), fill=0)


def _varied(logarithm: NDArray, variation: float) -> NDArray[np.float64]:
    """Amplitude of a variation and a mean square of 1 whose logarithm is a multiple of a map, plus a constant."""
    logarithm = (logarithm - logarithm.max()) / logarithm.std()

    def amplitude(scale: float) -> NDArray:
        values = np.exp(scale * logarithm)
        return values / np.sqrt(np.mean(values**2))

    def excess(scale: float) -> float:  # increases with the scale
        values = amplitude(scale)
        return float(values.std() / values.mean()) - variation

    return amplitude(brentq(excess, 0, 20)) if variation else amplitude(0)


def amplitude_curves(
    sensor: ZernikeSensor,
    modes: NDArray,
    variations: ArrayLike,
    rms: float,
    n_screens: int,
    photons: float,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> dict[str, AmplitudeCurves]:
    """Error of the phase against the variation of the amplitude, for each way of `WAYS` and each kind of `KINDS`.

    All ways see the same noisy frames. "ignored" and "measured" use the frames of the masks, with a uniform
    amplitude or with the root of the clear frame. "estimated" is `MaximumLikelihood` on all frames. A wrong
    amplitude explains no frame, so other starts would not help: "ignored" and "measured" have one start. A kind
    with a variation is a task of the sweep "amplitude_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    sensor : ZernikeSensor
        With three masks or more, the last of which changes nothing.
    modes : ndarray, shape (n_modes, ny, nx)
        Modes of the phase and of the logarithm of a scintillating amplitude.
    variations : array_like, shape (n,)
        From 0 to 0.4.
    rms : float, radian rms
        Of the phase screens.
    n_screens : int
        Pairs of a phase screen and an amplitude map.
    photons : float
        Per point of the pupil, all frames together; at least 1.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int

    Returns
    -------
    dict of AmplitudeCurves
        By kind.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, shape or range.
    """
    _check_sensor(sensor)
    _check.modes("modes", modes, sensor.pupil)
    variations = _check.real_map("variations", variations, 1)
    for value in variations.tolist():
        _check.number("variations", value, 0, _LARGEST)
    rms, n_screens = _check.number("rms", rms, 0), _check.integer("n_screens", n_screens, 1)
    photons = _check.number("photons", photons, 1, 1e9)
    exponent, seed = _check.number("exponent", exponent), _check.integer_seed("seed", seed)
    shared = sensor, modes, rms, n_screens, photons, exponent, seed
    cells = list(product(KINDS, enumerate(variations.tolist())))
    points = dict(zip(cells, sweeps.run(_point, cells, *shared, name="amplitude_curves"), strict=True))
    curves = {}
    for kind in KINDS:
        some = [point for (of, _), point in points.items() if of == kind]
        errors, consistent = (
            {way: np.array([one[part][way] for one in some]) for way in some[0][part]} for part in (0, 1)
        )
        curves[kind] = AmplitudeCurves(variations, errors, consistent, np.array([bound for _, _, bound in some]))
    return curves


def _point(
    cell: tuple[str, tuple[int, float]],
    sensor: ZernikeSensor,
    modes: NDArray,
    rms: float,
    n_screens: int,
    photons: float,
    exponent: float,
    seed: int,
) -> tuple[dict[str, NDArray], dict[str, NDArray], float]:
    """One kind and variation: errors and consistent, (n_screens,) each, by way, and the bound."""
    kind, (place, variation) = cell
    phases = screens_at(modes, rms, n_screens, seed, 0, exponent)
    amplitudes = amplitude_maps(sensor.pupil, modes, kind, variation, n_screens, exponent=exponent, seed=seed)
    noise = np.random.SeedSequence(seed, spawn_key=(KINDS.index(kind), place))
    frames = noisy_frames(sensor, phases, amplitudes, photons, noise)
    errors, consistent = {}, {}
    for way in WAYS:
        results = reconstruct(way, sensor, frames, photons)
        errors[way] = reconstruction_error(sensor.pupil, np.concatenate([one.phase for one in results]), phases)
        known = [one.consistent for one in results if isinstance(one, LikelihoodReconstruction)]
        if known:
            consistent[way] = np.concatenate(known)
    per_frame = photons / sensor.n_masks
    bounds = [
        cramer_rao(sensor, phase, photons=per_frame, amplitude=amplitude, amplitude_known=False)
        for phase, amplitude in zip(phases, amplitudes, strict=True)
    ]
    return errors, consistent, float(np.sqrt(np.nanmean(np.square(bounds))))


def noisy_frames(
    sensor: ZernikeSensor, phases: ArrayLike, amplitudes: ArrayLike, photons: float, seed: Any = 0
) -> NDArray[np.float64]:
    """Frames with photon noise; the photons per point of the pupil are divided equally between the frames."""
    _check.instance("sensor", sensor, ZernikeSensor)
    photons = _check.number("photons", photons, 1, 1e9)
    camera = Detector(sensor.pupil, photons * sensor.pupil.n_points / sensor.n_masks)
    return camera.normalise(camera.expose(sensor.measure(phases, amplitudes), _check.generator("seed", seed)))


def reconstruct(way: str, sensor: ZernikeSensor, frames: NDArray, photons: float) -> list[Reconstruction]:
    """Reconstruct frame sets (k, n_masks, ny, nx) in a way of `WAYS`; `photons` as for `noisy_frames`.

    The results are those of one or several batches, in order: a measured amplitude makes each frame set its own.
    """
    _check.choice("way", way, WAYS)
    _check_sensor(sensor)
    method, source = WAYS[way]
    per_frame = photons / sensor.n_masks
    if source == "estimated":
        return [MaximumLikelihood(sensor, photons=per_frame, amplitude="unknown")(frames)]
    pair = ZernikeSensor(sensor.pupil, *sensor.masks[:-1], extent=sensor.extent, tolerance=sensor.tolerance)
    batches: list[tuple[NDArray | None, NDArray]] = [(None, frames)]
    if source == "measured":
        batches = [(np.sqrt(one[-1][sensor.window]), one[np.newaxis]) for one in frames]
    if method == "PhaseShifted":
        return [PhaseShifted(pair, amplitude=amplitude)(some[:, :-1]) for amplitude, some in batches]
    return [
        MaximumLikelihood(pair, photons=per_frame, amplitude=amplitude, n_starts=1)(some[:, :-1])
        for amplitude, some in batches
    ]


def _check_sensor(sensor: ZernikeSensor) -> None:
    """Require a sensor whose last frame, and no other, is a clear one."""
    _check.instance("sensor", sensor, ZernikeSensor)
    strength = np.abs(sensor.factors.core).max(axis=(1, 2))
    if sensor.n_masks < 3 or strength[-1] > 1e-12 * strength.max() or np.any(strength[:-1] == 0):
        raise ValueError(
            f"sensor = {_check.shown(sensor)}: expected two masks or more and a last one that changes nothing, "
            "such as Dimple(1, 0)"
        )
