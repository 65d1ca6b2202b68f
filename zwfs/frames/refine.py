"""Uncertain properties of the optics: seek values that explain a pair of frames better, step by step.

A smaller misfit need not mean a better phase: with two images for one unknown at each point, the iteration
explains much of any pair of frames. Values are kept only if they predict pixels that the search has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from zwfs import _check
from zwfs.frames.phases import Phases
from zwfs.frames.pipeline import (
    MOST_ITERATIONS,
    Measurement,
    Optics,
    clear_light,
    iterated_phase,
    near_edges,
    predict_other,
    prediction_error,
    recover_phase,
    reduce_frames,
    reduce_with,
    upside_down,
)
from zwfs.frames.registration import _SURE, Image, RegisteredFrames, register_frames

# Lowest and highest value, and a typical change, of each parameter of `fit`, and of a shift in pixels.
_SHIFT_RANGE = (-3.0, 3.0, 0.3)
_RANGES = {
    "background": (-0.5, 0.9, 0.05),
    "pupil_background": (-0.9, 0.9, 0.1),
    "scale": (0.2, 5.0, 0.1),
    "diameter": (0.3, 3.0, 0.05),
    "leakage": (0.0, 0.45, 0.05),
    "unmasked": (0.0, 0.9, 0.1),
}
_BLOCKS = 8  # across the pupil: the search sees every second one
_GAIN = 0.1  # of the squared error on unseen blocks, by which each frame must be predicted better
_CHANGE = 0.1  # step of a derivative over the typical change: smaller steps amplify the jumps of single points


def fit(
    registered: RegisteredFrames, optics: Optics, names: Sequence[str], n_iterations: int = 25, n_steps: int = 8
) -> tuple[RegisteredFrames, Optics]:
    """Seek parameters of the model, and the registration, and keep those that predict unseen pixels better.

    A least-squares search makes the misfit of the frames small on every second block of pixels, far from edges.
    The light next to the pupil counts as much as that in it: there no phase can hide an error of the model. On the
    other blocks each frame is then predicted from the other frame alone. The values are kept if the squared error
    of both predictions falls by 10 %, and is also 10 % below that of a control: the second frame upside down. The
    misfit of both frames there, edges included, must fall, too.

    Parameters
    ----------
    registered : RegisteredFrames
    optics : Optics
        Start of the search.
    names : sequence of str
        Parameters of `Optics` other than the phase shifts; "registration" stands for the shifts of both frames,
        and of the second clear frame where registration was not sure of it to 0.05 pixels.
    n_iterations : int
        As for `recover_phase`.
    n_steps : int
        Of the least-squares search, at most.

    Returns
    -------
    RegisteredFrames, Optics
        Those given, if the values that were found predict the unseen blocks no better.

    Raises
    ------
    ValueError
        If a name is unknown or there twice, or `optics` begins out of the range of a fit.
    """
    _check.instance("registered", registered, RegisteredFrames)
    _check_fit("names", names, optics)
    n_iterations = _check.integer("n_iterations", n_iterations, 1, MOST_ITERATIONS)
    n_steps = _check.integer("n_steps", n_steps, 1)
    if not names:
        return registered, optics
    if optics.single:
        raise ValueError(f"names = {_check.shown(names)}: expected none with one image, which cannot test a fit")
    search = _Search(registered, optics, names, n_iterations)
    after = search.best(n_steps)
    return (after.registered, after.optics) if search.is_better(after) else (registered, optics)


class _Search:
    """Search of a fit: its unknowns are values of the optics, then a shift (rows, columns) of some images."""

    def __init__(
        self, registered: RegisteredFrames, optics: Optics, names: Sequence[str], n_iterations: int
    ) -> None:
        self.registered, self.optics, self.n_iterations = registered, optics, n_iterations
        self.values = [name for name in names if name in _RANGES]
        sure = np.all(registered.placement.sigma[:2] < _SURE)
        self.images = ([0, 1] if sure else [0, 1, 3]) if "registration" in names else []
        n_shifts = 2 * len(self.images)
        self.start = [*(getattr(optics, name) for name in self.values), *[0.0] * n_shifts]
        self.ranges = np.transpose([*(_RANGES[name] for name in self.values), *[_SHIFT_RANGE] * n_shifts])
        self.margin = registered.margin  # the same in each trial, so that the number of residuals stays
        self.before = before = reduce_frames(registered, optics, self.margin)
        rows, columns = np.indices(before.bad.shape[1:]) * _BLOCKS // before.pupil.shape[0]
        even, far = (rows + columns) % 2 == 0, before.good & ~near_edges(before)
        self.searched = even.copy()
        self.searched[before.window] &= far | ~before.pupil.inside
        self.tested = far & ~even[before.window]
        self.hidden = np.zeros_like(even)
        self.hidden[before.window] = before.good & ~even[before.window]
        self._clear: tuple[Any, Any] = None, None
        self._latest = np.empty(0), np.empty(0)

    def best(self, n_steps: int) -> Measurement:
        """Measurement with the values of the least misfit on the blocks of the search."""
        low, high, step = self.ranges
        solution = optimize.least_squares(
            self._residuals, self.start, self._jacobian, bounds=(low, high), x_scale=step, max_nfev=n_steps
        )
        return self._trial(solution.x)

    def is_better(self, after: Measurement) -> bool:
        """Whether a measurement explains the blocks that the search has not seen better than that of the start."""
        old, new, control = (
            prediction_error(pair, self.tested, self.n_iterations)
            for pair in (self.before, after, upside_down(after))
        )
        misfit, smaller = (
            np.sum(_mismatch(pair, self.n_iterations, 1e-4)[:, self.hidden] ** 2) for pair in (self.before, after)
        )
        return bool(smaller < misfit and np.all(new < (1 - _GAIN) * np.minimum(old, control)))

    def _trial(self, unknowns: NDArray) -> Measurement:
        changes: dict[str, Any] = dict(zip(self.values, unknowns.tolist(), strict=False))
        optics, shifts = replace(self.optics, **changes), unknowns[len(self.values) :].reshape(-1, 2)
        origins = self.registered.origins.copy()
        origins[self.images] += shifts
        registered = replace(self.registered, origins=origins)
        # Few trials change the clear frames: only the last of the images is one.
        of_clear = shifts[2:].tolist(), optics.pupil_background
        if of_clear != self._clear[0]:
            self._clear = of_clear, clear_light(registered, optics.pupil_background, self.before.share)
        return reduce_with(self._clear[1], registered, optics, self.margin)

    def _residuals(self, unknowns: NDArray) -> NDArray[np.float64]:
        if not np.array_equal(unknowns, self._latest[0]):  # a derivative begins where the search has just been
            # Finite differences need a smooth function: no trial may end an iteration earlier than its neighbours.
            mismatch = _mismatch(self._trial(unknowns), self.n_iterations, 1e-8)
            self._latest = unknowns.copy(), mismatch[:, self.searched].ravel()
        return self._latest[1]

    def _jacobian(self, unknowns: NDArray) -> NDArray[np.float64]:
        base, (_, high, step) = self._residuals(unknowns), self.ranges
        change = _CHANGE * step
        around = unknowns + np.diag(np.where(unknowns + change > high, -change, change))
        slopes = [(self._residuals(near) - base) / (near - unknowns)[index] for index, near in enumerate(around)]
        return np.transpose(slopes)


def _mismatch(measurement: Measurement, n_iterations: int, tolerance: float) -> NDArray[np.float64]:
    return measurement.agreement(iterated_phase(measurement, n_iterations, tolerance)).mismatch


def _check_fit(argument: str, names: Any, optics: Any) -> None:
    """Require names of different parameters that `fit` knows, and optics from which it can start."""
    _check.instance("optics", optics, Optics)
    choices = (*_RANGES, "registration")
    listed = isinstance(names, Sequence) and not isinstance(names, str | bytes)
    if not listed or not all(isinstance(name, str) and name in choices for name in names):
        raise ValueError(f"{argument} = {_check.shown(names)}: expected a list with some of {list(choices)}")
    if optics.masks and "diameter" in names:
        raise ValueError(f"{argument} holds 'diameter': expected a fit of other values with optics.masks")
    if len(set(names)) < len(names):
        raise ValueError(f"{argument} = {_check.shown(names)}: expected each name once")
    for name in set(names) & set(_RANGES):
        low, high, _ = _RANGES[name]
        if not low <= getattr(optics, name) <= high:
            raise ValueError(
                f"{argument} holds {name!r}, and {name} = {getattr(optics, name)}: "
                f"expected a start in [{low:g}, {high:g}] for a fit"
            )


@dataclass(frozen=True, eq=False)
class Step:
    """Result of one of the `steps`.

    Attributes
    ----------
    name : str
    result : Phases
        With its `measurement`.
    predicted : ndarray, shape (2,)
        Correlation of each frame with the prediction from the other one alone, see `predict_other`.
    control : ndarray, shape (2,)
        The same with the second frame upside down.
    """

    name: str
    result: Phases
    predicted: NDArray[np.float64]
    control: NDArray[np.float64]

    def __post_init__(self) -> None:
        _check.declared(self)


def steps(
    frames: Sequence[Image],
    clear_frames: Sequence[Image],
    optics: Optics,
    fitted: Sequence[str] = ("registration", "background", "scale"),
    n_iterations: int = 25,
    **settings: Any,
) -> list[Step]:
    """Reconstruct a pair of frames step by step, and judge each step.

    Parameters
    ----------
    frames, clear_frames : sequence of one or two Images
    optics : Optics
    fitted : sequence of str
        Parameters to fit, see `fit`: with each step one more, and all earlier ones again. The name of a step says
        if its values were not kept. One image is not fitted, and the last step says so.
    n_iterations : int
        As for `recover_phase`.
    **settings
        Of `register_frames`: pupil_centers, pupil_diameter, exposure.

    Returns
    -------
    list of Step
        The last one holds the result: what `fit` kept.

    Raises
    ------
    TypeError, ValueError
        As `register_frames`, `reduce_frames` and `fit` do.
    """
    _check_fit("fitted", fitted, optics)
    n_iterations = _check.integer("n_iterations", n_iterations, 1, MOST_ITERATIONS)
    work = []

    def add(name: str, registered: RegisteredFrames, optics: Optics) -> None:
        measurement = reduce_frames(registered, optics)
        scores = (predict_other(pair, n_iterations) for pair in (measurement, upside_down(measurement)))
        work.append(Step(name, recover_phase(measurement, n_iterations), *scores))

    names = "registration by content", "background around the pupils", "balance of the flux"
    for n_on, name in enumerate(("outlines of the pupils", *names)):
        switches: dict[str, Any] = {"subpixel": n_on > 0, "background": n_on > 1, "balance": n_on > 2}
        switches["n_pupils"] = len(optics.phase_shifts)
        add(name, register_frames(frames, clear_frames, **settings, **switches), optics)
    if optics.single and fitted:
        last = work[-1].result.agreement.measurement
        add("no fit: one image cannot test it", last.registered, last.optics)
        return work
    for number, name in enumerate(fitted, 1):
        last = work[-1].result.agreement.measurement
        fitted_values = fit(last.registered, last.optics, fitted[:number], n_iterations)
        verdict = "" if fitted_values[1] is not last.optics else " (not kept)"
        add(f"fit of {name.replace('_', ' ')}{verdict}", *fitted_values)
    return work
