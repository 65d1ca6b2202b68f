"""The simulated bench in an experiment: random commands of the segments, and the errors of their estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.curves import ErrorCurves
from studies.kit.parameters import within
from zwfs import Arcsine, GerchbergSaxton, GradientDescent, Linear, PhaseShifted, ZernikeSensor
from zwfs.bench import Bench, BenchModel, segment_residual, segment_screens

ARMS = ("1 (+θ)", "2 (−θ)")  # of the bench, for labels

UNITS = {
    "leakage": "of the light",
    "focus_difference": "D²/λ",
    "misregistration": "pixels",
    "blur": "pixels rms",
    "flux_imbalance": "of the mean flux",
    "dimple_error": "of the diameter",
    "static": "rad rms",
    "quilting": "rad rms",
    "photons_per_image": "photons in an image",
    "read_noise": "electrons rms",
    "background": "electrons in a pixel",
}
"""Units of the errors of the bench."""

# Smallest singular value of the interaction matrix that is inverted, over the largest. No sensor sees the piston
# of all segments together: its singular value is the noise of the calibration, and is left out. That of the mode
# that dimples of 1.8 lambda/D see least, on a bench with blur, is 0.07.
_CONDITIONING = 0.05


def check_bench(bench: Mapping[str, Any], **others: Any) -> None:
    """Refuse fields of the bench that contradict each other, or the pixels and extent of a notebook."""
    own = {name: others[name] for name in ("n_pixels", "extent") if name in others}
    with within("bench", bench):
        Bench(**own, **bench)


@dataclass(frozen=True)
class BenchCurves(ErrorCurves):
    """Errors of several reconstructors on random segment commands."""

    errors: dict[str, NDArray[np.float64]] = field(init=False)  # (n_rms, n_screens) each, rad rms
    commanded: NDArray[np.float64]  # (n_rms, n_screens, n_segments), rad
    residuals: dict[str, NDArray[np.float64]]  # the same shape each, rad

    def __post_init__(self) -> None:
        errors = {name: np.sqrt(np.mean(values**2, axis=-1)) for name, values in self.residuals.items()}
        object.__setattr__(self, "errors", errors)

    def gain(self, name: str) -> NDArray[np.float64]:
        """Slope of the measured pistons against the commanded ones, (n_rms,); below 1 they are underestimated."""
        residuals = self.residuals[name]
        if np.any(self.rms == 0):
            residuals = residuals - residuals[self.rms == 0].mean(axis=(0, 1))
        power = np.sum(self.commanded**2, axis=(1, 2))
        slope = np.sum(self.commanded * residuals, axis=(1, 2))
        return 1 + np.divide(slope, power, out=np.full_like(power, np.nan), where=power > 0)


def poked_frames(bench: Bench, model: BenchModel, poke: float, seed: int) -> list[NDArray[np.float64]]:
    """Normalised frames of the flat command, and of each segment pushed and pulled."""
    rng = np.random.default_rng(seed)
    pokes = poke * np.eye(bench.n_segments)
    return [model.normalise(bench.frames(command, rng)) for command in (None, pokes, -pokes)]


def poked_linear(sensor: ZernikeSensor, model: BenchModel, poked: Sequence[NDArray], poke: float) -> Linear:
    """Return the linear reconstructor whose interaction matrix was recorded on the bench, for one image or two."""
    flat, pushed, pulled = (frames[..., : sensor.n_masks, :, :] for frames in poked)
    recorded = flat, pushed, pulled
    return Linear(sensor, model.modes, poke=poke, conditioning=_CONDITIONING, calibration=recorded)


def bench_reconstructors(
    bench: Bench, model: BenchModel, *, n_iterations: int = 25, poke: float = 0.1, seed: int = 0
) -> dict[str, Any]:
    """Return the paper's reconstructors for the model of a bench; the linear one is calibrated on the bench."""
    poked = poked_frames(bench, model, poke, seed)
    return {
        "Linear": poked_linear(model.classic, model, poked, poke),
        "Arcsine": Arcsine(model.classic, n_iterations=n_iterations),
        "GerchbergSaxton": GerchbergSaxton(model.shifted, n_iterations=n_iterations),
        "GradientDescent": GradientDescent(model.shifted, model.modes, n_iterations=n_iterations),
        "PhaseShifted": PhaseShifted(model.shifted, n_iterations=n_iterations),
    }


def find_pistons(reconstructor: Any, model: BenchModel, frames: NDArray) -> NDArray[np.float64]:
    """Estimate the pistons of normalised frames of the bench, (..., 2, ny', nx') to (..., n_segments)."""
    n_images = reconstructor.sensor.n_masks
    return model.pistons(reconstructor(frames[..., :n_images, :, :]).phase)


def bench_curves(
    bench: Bench,
    model: BenchModel,
    reconstructors: Mapping[str, Any],
    rms: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> BenchCurves:
    """Errors of reconstructors on random segment commands of growing rms: the experiment of section 5.2."""
    rms = np.asarray(rms, dtype=float)
    shared = bench, model, dict(reconstructors), n_screens, exponent, seed
    return BenchCurves(rms, **sweeps.table(_bench_point, enumerate(rms.tolist()), *shared, name="bench_curves"))


def _bench_point(
    point: tuple[int, float],
    bench: Bench,
    model: BenchModel,
    reconstructors: Mapping[str, Any],
    n_screens: int,
    exponent: float,
    seed: int,
) -> dict[str, Any]:
    """One input of the bench curves: what is commanded, and the residuals, (n_screens, n_segments) each."""
    task, rms = point
    screens, noise = np.random.SeedSequence(seed, spawn_key=(task,)).spawn(2)
    commanded = segment_screens(bench, rms, n_screens, exponent, screens)
    frames = model.normalise(bench.frames(commanded, noise))
    residuals = {
        name: segment_residual(find_pistons(reconstructor, model, frames), commanded)
        for name, reconstructor in reconstructors.items()
    }
    return {"commanded": commanded, "residuals": residuals}
