"""Calibration of the simulated bench: a fitted model of its optics, and segments measured with and without it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bench.model import Bench, BenchModel, segment_screens
from zwfs.bench.segments import segment_pistons, segment_residual
from zwfs.companion import sweeps
from zwfs.frames.bench_fit import FittedSensor, fit_bench
from zwfs.frames.joint import JointFit
from zwfs.paper.bench_linearity import BenchCurves
from zwfs.paper.linearity import check_rms
from zwfs.reconstructors import PhaseShifted

WAYS = {
    "design": "model of the design",
    "design, less flat": "model of the design, less its flat",
    "calibrated": "calibrated model",
    "shuffled": "control: calibrated with shuffled commands",
}
"""Ways to measure the segments, and their descriptions."""

_N_DARKS = 16  # averaged
_FIT: dict[str, Any] = {"n_inner": 30, "tolerance": 5e-4}
_CONTROL_STEPS = 4  # of a fit that cannot succeed


class Shot(NamedTuple):
    """A frame set of the camera.

    Attributes
    ----------
    counts : ndarray, shape (..., 2, ny, nx), photoelectrons
        Less the dark.
    sigma : ndarray of the same shape, photoelectrons rms
        Noise of each pixel.
    """

    counts: NDArray[np.float64]
    sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames with which a bench is calibrated.

    Attributes
    ----------
    bench : Bench
    commands : ndarray, shape (n_states, n_segments), radian
        Of which the first is flat.
    frames : ndarray, shape (n_states, 2, ny, nx), photoelectrons
    clear : ndarray, shape (2, ny, nx), photoelectrons
    dark : ndarray, shape (2, ny, nx), photoelectrons
        Mean of several; subtracted from `frames` and `clear`.
    """

    bench: Bench
    commands: NDArray[np.float64]
    frames: NDArray[np.float64]
    clear: NDArray[np.float64]
    dark: NDArray[np.float64]

    @property
    def noise(self) -> float:
        """Noise of a pixel without light, photoelectrons rms."""
        return float(np.hypot(np.sqrt(self.bench.background), self.bench.read_noise))

    def shot(self, command: ArrayLike, seed: np.random.SeedSequence) -> Shot:
        """Return frames of other commands, less the dark."""
        counts = self.bench.frames(command, seed) - self.dark
        return Shot(counts, np.sqrt(np.maximum(counts, 0) + self.noise**2))


def dimmed(bench: Bench, photons: float) -> Bench:
    """Return the bench with other exposures: photons per pixel of the pupil, and background and noise to match.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.bench import Bench
    >>> from zwfs.paper.calibration import dimmed
    >>> bench = dimmed(Bench(n_pixels=40), 1e5)
    >>> bool(np.isclose(bench.photons, 1e5 * np.count_nonzero(bench.segments)))
    True
    """
    _check.instance("bench", bench, Bench)
    total = _check.number("photons", photons, 0, open_low=True) * np.count_nonzero(bench.segments)
    share = total / bench.photons
    return replace(
        bench,
        photons=total,
        background=share * bench.background,
        read_noise=np.sqrt(share) * bench.read_noise,
    )


def record(bench: Bench, n_commands: int, rms: float, seed: int = 0) -> Recording:
    """Record frames of a flat and of random segment commands, clear frames and darks.

    Parameters
    ----------
    bench : Bench
    n_commands : int
        Besides the flat one.
    rms : float, radian
        Standard deviation of the commands, which are independent from segment to segment.
    seed : int
        Of commands and noise.
    """
    _check.instance("bench", bench, Bench)
    n_commands = _check.integer("n_commands", n_commands, 2)
    rms = _check.number("rms", rms, 0, open_low=True)
    draws, masked, clear, *darks = np.random.SeedSequence(_check.integer_seed("seed", seed)).spawn(3 + _N_DARKS)
    commands = rms * np.random.default_rng(draws).normal(size=(n_commands + 1, bench.n_segments))
    commands[0] = 0
    dark = np.mean([bench.dark(one) for one in darks], axis=0)
    return Recording(
        bench, commands, bench.frames(commands, masked) - dark, bench.clear_frames(clear) - dark, dark
    )


def calibrate(recording: Recording) -> dict[str, JointFit]:
    """Fit the model of the optics to a recording, and for control to the recording with shuffled commands.

    Each of the two fits is a task of the sweep "calibrate", see `zwfs.companion.sweeps`.

    Returns
    -------
    dict of JointFit
        "calibrated", and "shuffled" without errors of the parameters.
    """
    _check.instance("recording", recording, Recording)
    names = "calibrated", "shuffled"
    return dict(zip(names, sweeps.run(_calibrate, names, recording, name="calibrate"), strict=True))


def _calibrate(name: str, recording: Recording) -> JointFit:
    bench, commands, settings = recording.bench, recording.commands, _FIT
    if name == "shuffled":
        commands, settings = np.roll(commands, 1, axis=0), {**_FIT, "errors": False, "n_steps": _CONTROL_STEPS}
    known = bench.commanded_phase(commands)
    return fit_bench(
        recording.frames, recording.clear, known, n_pixels=bench.n_pixels, noise=recording.noise, **settings
    )


class Recovered(NamedTuple):
    """A parameter of the bench, put in and fitted."""

    name: str
    true: float
    value: float
    sigma: float

    @property
    def deviation(self) -> float:
        """Error over its standard deviation."""
        return (self.value - self.true) / self.sigma


def recovered(bench: Bench, fit: JointFit) -> list[Recovered]:
    """Parameters of the bench next to those of a fit.

    The focus and the places of the images are differences of the two images.
    """
    _check.instance("bench", bench, Bench)
    _check.instance("fit", fit, JointFit)
    index = {one.name: number for number, one in enumerate(fit.estimates)}
    values = np.array([one.value for one in fit.estimates])

    def row(name: str, true: float, plus: str, minus: str | None = None) -> Recovered:
        weights = np.zeros(len(values))
        weights[index[plus]] = 1
        if minus is not None:
            weights[index[minus]] = -1
        return Recovered(name, true, float(weights @ values), float(np.sqrt(weights @ fit.covariance @ weights)))

    return [
        row("diameter of the dimple (λ/D)", bench.diameter * (1 + bench.dimple_error), "diameter"),
        row("phase shift of the first image (rad)", bench.phase, "first"),
        row("phase shift of the second image (rad)", -bench.phase, "second"),
        row("leakage", bench.leakage, "leakage"),
        row("blur (pixels rms)", bench.blur, "blur"),
        row("focus difference (D²/λ)", bench.focus_difference, "arm 0 focus", "arm 1 focus"),
        row("distance of the images, rows (pixels)", bench.misregistration, "arm 0 row", "arm 1 row"),
        row("distance of the images, columns (pixels)", bench.misregistration, "arm 0 column", "arm 1 column"),
    ]


@dataclass(frozen=True, eq=False)
class Example:
    """One screen: its frames, those that the measured phases make in the models, and the errors of the segments.

    Attributes
    ----------
    commanded : ndarray, shape (n_segments,), radian
    measured : Shot
        Shape (2, ny, nx).
    modelled : dict of ndarray, shape (2, ny, nx), photoelectrons
        For "design", "calibrated" and "shuffled".
    residuals : dict of ndarray, shape (n_segments,), radian
        For each of `WAYS`.
    """

    commanded: NDArray[np.float64]
    measured: Shot
    modelled: dict[str, NDArray[np.float64]]
    residuals: dict[str, NDArray[np.float64]]


def measure_segments(
    recording: Recording,
    fits: Mapping[str, JointFit],
    rms: ArrayLike,
    n_screens: int,
    *,
    n_iterations: int = 25,
    seed: int = 0,
) -> tuple[BenchCurves, list[list[Example]]]:
    """Measure random segment commands, which no calibration has seen, with each of `WAYS`.

    A screen is a task of the sweep "measure_segments", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    recording : Recording
    fits : mapping of str to JointFit
        See `calibrate`.
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
        For each rms.
    n_iterations : int
        Of the phase-shifted iteration with the model of the design.
    seed : int
        Of screens and noise.

    Returns
    -------
    BenchCurves, list of list of Example
        Examples by input and screen.
    """
    _check.instance("recording", recording, Recording)
    rms, n_screens = check_rms(rms), _check.integer("n_screens", n_screens, 1)
    seed = _check.integer_seed("seed", seed)
    bench = recording.bench
    model = BenchModel.from_images(bench, seed)
    finders: dict[str, _Finder] = {
        "design": _Design(model, PhaseShifted(model.shifted, n_iterations=n_iterations))
    }
    finders |= {name: _Fitted(FittedSensor(fit, n_steps=2)) for name, fit in fits.items()}
    flat = recording.shot(np.zeros(bench.n_segments), np.random.SeedSequence(seed, spawn_key=(0,)))
    references = {name: finder.reference(flat) for name, finder in finders.items()}
    tasks = [(row, column) for row in range(len(rms)) for column in range(n_screens)]
    shared = rms, seed, recording, finders, references
    examples = sweeps.run(_measure, tasks, *shared, name="measure_segments")
    rows = [examples[start : start + n_screens] for start in range(0, len(examples), n_screens)]
    commanded = np.array([[one.commanded for one in row] for row in rows])
    residuals = {
        name: np.array([[one.residuals[name] for one in row] for row in rows]) for name in examples[0].residuals
    }
    return BenchCurves(rms, commanded, residuals), rows


@dataclass(frozen=True, eq=False)
class _Design:
    """The phase-shifted iteration with the model of the design."""

    model: BenchModel
    reconstruct: Callable

    def __call__(self, shot: Shot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Phase of a frame set and the frames that it makes in the model."""
        estimate = self.reconstruct(shot.counts / self.model.scale)
        return estimate.phase, self.model.shifted.measure(estimate.phase) * self.model.scale

    def reference(self, flat: Shot) -> NDArray[np.float64]:
        """Phase of a flat command."""
        return self(flat)[0]


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A fitted model."""

    sensor: FittedSensor

    def __call__(self, shot: Shot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        phase = self.sensor(*shot)
        return phase, self.sensor.frames(phase)

    def reference(self, flat: Shot) -> NDArray[np.float64]:
        return self.sensor.flat


_Finder = _Design | _Fitted


def _measure(
    task: tuple[int, int],
    rms: NDArray,
    seed: int,
    recording: Recording,
    finders: Mapping[str, _Finder],
    references: Mapping[str, NDArray],
) -> Example:
    """Measure one screen with each model."""
    bench = recording.bench
    screen, noise = np.random.SeedSequence(seed, spawn_key=(1, *task)).spawn(2)
    [command] = segment_screens(bench, rms[task[0]], 1, seed=screen)
    shot = recording.shot(command, noise)
    modelled, residuals = {}, {}
    for name, finder in finders.items():
        phase, modelled[name] = finder(shot)
        pistons, flat = (segment_pistons(one, bench.segments, bench.numbers) for one in (phase, references[name]))
        if name == "design":
            residuals[name] = segment_residual(pistons, command)
            residuals["design, less flat"] = segment_residual(pistons - flat, command)
        else:
            residuals[name] = segment_residual(pistons - flat, command)
    return Example(command, shot, modelled, residuals)
