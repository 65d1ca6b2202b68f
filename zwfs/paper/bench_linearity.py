"""The experiments of section 5 on the simulated bench: commands go in, errors of the segments come out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bench.model import Bench, BenchModel, Seed, segment_screens
from zwfs.bench.segments import segment_residual
from zwfs.companion import sweeps
from zwfs.companion.parameters import within
from zwfs.paper.curves import ErrorCurves
from zwfs.paper.linearity import check_reconstructors, check_rms
from zwfs.reconstructors import RECONSTRUCTORS, Arcsine, GerchbergSaxton, GradientDescent, Linear, PhaseShifted

# Smallest singular value of the interaction matrix that is inverted, over the largest. No sensor sees the piston
# of all segments together: its singular value is the noise of the calibration, and is left out.
_CONDITIONING = 0.1


def check_bench(bench: Mapping[str, Any], **others: Any) -> None:
    """Refuse fields of the bench that contradict each other, or the pixels and extent of a notebook.

    Raises
    ------
    TypeError, ValueError
        As `Bench` does; the message begins with the path of the field.
    """
    _check.instance("bench", bench, Mapping)
    own = {name: others[name] for name in ("n_pixels", "extent") if name in others}
    with within("bench", bench):
        Bench(**own, **bench)


@dataclass(frozen=True)
class BenchCurves(ErrorCurves):
    """Errors of several reconstructors of the segment pistons that are commanded on a bench.

    Attributes
    ----------
    errors : dict of ndarray, shape (n_rms, n_screens), radian rms
        Rms of the residuals over the segments.
    commanded : ndarray, shape (n_rms, n_screens, n_segments), radian
    residuals : dict of ndarray, shape (n_rms, n_screens, n_segments), radian
        Reconstructed less commanded pistons, wrapped and without piston, for each reconstructor.
    """

    errors: dict[str, NDArray[np.float64]] = field(init=False)
    commanded: NDArray[np.float64]
    residuals: dict[str, NDArray[np.float64]]

    def __post_init__(self) -> None:
        errors = {name: np.sqrt(np.mean(values**2, axis=-1)) for name, values in self.residuals.items()}
        object.__setattr__(self, "errors", errors)

    def gain(self, name: str) -> NDArray[np.float64]:
        """Slope of the measured pistons against the commanded ones, (n_rms,); below 1 they are underestimated.

        The offset of each segment, which is its residual at an input of 0 where there is one, is taken off first.
        NaN at an input of 0.
        """
        _check.choice("name", name, self.residuals)
        residuals = self.residuals[name]
        if np.any(self.rms == 0):
            residuals = residuals - residuals[self.rms == 0].mean(axis=(0, 1))
        power = np.sum(self.commanded**2, axis=(1, 2))
        slope = np.sum(self.commanded * residuals, axis=(1, 2))
        return 1 + np.divide(slope, power, out=np.full_like(power, np.nan), where=power > 0)


def bench_reconstructors(
    bench: Bench, model: BenchModel, *, n_iterations: int = 25, poke: float = 0.1, seed: Seed = 0
) -> dict[str, Any]:
    """Return the paper's reconstructors for the model of a bench; the linear one is calibrated on the bench.

    Parameters
    ----------
    bench : Bench
        Gives frames of each segment pushed and pulled.
    model : BenchModel
    n_iterations : int
        Of the iterative reconstructors.
    poke : float, radian
        Piston by which each segment is pushed and pulled for the interaction matrix.
    seed : int, Generator or SeedSequence, optional
        Of the noise of the calibration.

    Returns
    -------
    dict of reconstructor
        "Linear" and "Arcsine" use the image of one mask, the others both. Gradient descent seeks segment pistons.
    """
    _check.instance("bench", bench, Bench)
    _check.instance("model", model, BenchModel)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    rng = _check.generator("seed", seed)
    pokes = _check.number("poke", poke, 0, open_low=True) * np.eye(bench.n_segments)
    flat, pushed, pulled = (
        model.normalise(bench.frames(command, rng))[..., :1, :, :] for command in (None, pokes, -pokes)
    )
    steps: dict[str, Any] = {"n_iterations": n_iterations}
    return {
        "Linear": Linear(
            model.classic, model.modes, poke=poke, conditioning=_CONDITIONING, calibration=(flat, pushed, pulled)
        ),
        "Arcsine": Arcsine(model.classic, **steps),
        "GerchbergSaxton": GerchbergSaxton(model.shifted, **steps),
        "GradientDescent": GradientDescent(model.shifted, model.modes, **steps),
        "PhaseShifted": PhaseShifted(model.shifted, **steps),
    }


def find_pistons(reconstructor: Any, model: BenchModel, frames: ArrayLike) -> NDArray[np.float64]:
    """Segment pistons that a reconstructor sees in normalised frames, (..., 2, ny', nx') to (..., n_segments)."""
    n_images = _check.sensor_of("reconstructor", reconstructor).n_masks
    _check.instance("model", model, BenchModel)
    frames = _check.real_array("frames", frames)
    _check.trailing_shape("frames", frames, model.dark.shape, "the two images of the bench")
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
    """Errors of reconstructors on random segment commands of growing rms: the experiment of section 5.2.

    An input is a task of the sweep "bench_curves", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    bench : Bench
    model : BenchModel
        Of that bench, or of another one, to see the effect of a wrong model.
    reconstructors : mapping of str to reconstructor
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
        Screens for each rms.
    exponent : float
        Exponent of the power spectral density of the screens.
    seed : int
        Of screens and noise.

    Returns
    -------
    BenchCurves

    References
    ----------
    Chambouleyron et al. 2024, section 5.2 and Figure 9.
    """
    _check.instance("bench", bench, Bench)
    _check.instance("model", model, BenchModel)
    check_reconstructors(reconstructors)
    rms = check_rms(rms)
    n_screens = _check.integer("n_screens", n_screens, 1)
    exponent = _check.number("exponent", exponent)
    seed = _check.integer_seed("seed", seed)
    shared = bench, model, dict(reconstructors), n_screens, exponent, seed
    points = sweeps.run(_bench_point, enumerate(rms.tolist()), *shared, name="bench_curves")
    commanded, residuals = zip(*points, strict=True)
    return BenchCurves(
        rms, np.array(commanded), {name: np.array([point[name] for point in residuals]) for name in reconstructors}
    )


def _bench_point(
    point: tuple[int, float],
    bench: Bench,
    model: BenchModel,
    reconstructors: Mapping[str, Any],
    n_screens: int,
    exponent: float,
    seed: int,
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """One input of the bench curves: what is commanded, and the residuals, (n_screens, n_segments) each."""
    task, rms = point
    screens, noise = np.random.SeedSequence(seed, spawn_key=(task,)).spawn(2)
    commanded = segment_screens(bench, rms, n_screens, exponent, screens)
    frames = model.normalise(bench.frames(commanded, noise))
    return commanded, {
        name: segment_residual(find_pistons(reconstructor, model, frames), commanded)
        for name, reconstructor in reconstructors.items()
    }


def error_budget(
    benches: Mapping[Any, Bench],
    names: Sequence[str],
    rms: ArrayLike,
    n_screens: int,
    *,
    n_iterations: int = 25,
    seed: int = 0,
) -> dict[str, BenchCurves]:
    """Curves of benches that differ in their errors, each with its model and reconstructors.

    A bench is a task of the sweep "error_budget", see `zwfs.companion.sweeps`.

    Parameters
    ----------
    benches : mapping to Bench
        Such as `Bench.single_errors` returns.
    names : sequence of str
        Reconstructors to run.
    rms : array_like, shape (n_rms,), radian rms
    n_screens : int
    n_iterations : int
    seed : int
        The same screens are commanded on every bench.

    Returns
    -------
    dict of BenchCurves
        Under the keys of `benches`.
    """
    _check.instance("benches", benches, Mapping)
    for key, bench in benches.items():
        _check.instance(f"benches[{key!r}]", bench, Bench)
    known = sorted(method.__name__ for method in RECONSTRUCTORS)
    _check.sequence("names", names, str, f"a list with some of {known}")
    if not names:
        raise ValueError(f"names is empty: expected a list with some of {known}")
    for name in names:
        _check.choice("names", name, known)
    rms = check_rms(rms)
    n_screens = _check.integer("n_screens", n_screens, 1)
    n_iterations = _check.integer("n_iterations", n_iterations, 1)
    seed = _check.integer_seed("seed", seed)
    shared = list(names), rms, n_screens, n_iterations, seed
    curves = sweeps.run(_bench_case, benches.values(), *shared, name="error_budget")
    return dict(zip(benches, curves, strict=True))


def _bench_case(
    bench: Bench, names: Sequence[str], rms: ArrayLike, n_screens: int, n_iterations: int, seed: int
) -> BenchCurves:
    """Model one bench, build its reconstructors, and return their curves."""
    model = BenchModel.from_images(bench, seed)
    methods = bench_reconstructors(bench, model, n_iterations=n_iterations, seed=seed)
    return bench_curves(bench, model, {name: methods[name] for name in names}, rms, n_screens, seed=seed)
