"""One solve with a learned reference wave: its error, a bench with unknown errors, and what it says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.methods import ACCELERATED, LIKELY, PLAIN, method_look
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded, screen_columns, screen_errors
from studies.kit.setups import Screens, screens_at
from studies.kit.style import LOOKS, OTHER_STYLES
from studies.kit.tables import Text, small
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.metrics import reconstruction_error
from zwfs.reconstructors import LearnedReference, MaximumLikelihood, PhaseShifted
from zwfs.reconstructors.learned import BenchValues
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes inputs n_screens exponent n_iterations rms",
    n_pixels=(24, 200),
    photons=(1.0, 1e9),
    leakages=[(0.0, 0.4)],
    leakage=(0.0, 0.4),
    flux_ratio=(0.25, 4.0),
    rms_pairs=[(0.001, 4.0)],
    pairs=[(1, 1000)],
)
QUICK = {"n_pixels": 40, "inputs": [0.2, 0.8, 1.3, 2.0], "n_screens": 6}

LEARNED = "LearnedReference"
ONE, TWO, TWO_FASTER = "one solve", "two solves", "two accelerated solves"
SOLVES: dict[str, dict[str, Any]] = {
    ONE: {"n_iterations": 1, "tolerance": 0.0},
    TWO: {"n_iterations": 2, "tolerance": 0.0},
    TWO_FASTER: {"n_iterations": 2, "tolerance": 0.0, "accelerate": True},
}
"""Settings of the iteration that stops early."""
NOMINAL, TRUE, UNTRAINED = "iteration, nominal model", "iteration, true values", "learned, trained without errors"
WAYS = NOMINAL, TRUE, UNTRAINED, LEARNED
"""Ways to reconstruct a phase on a bench with leakage and unequal light."""


@dataclass(frozen=True)
class LookCurves:
    """Errors of one learned solve and of other methods, next to the bound."""

    rms: NDArray[np.floating]  # (n,), input, radian rms
    errors: dict[str, NDArray[np.float64]]  # (n, n_screens) of each method, radian rms
    bound: NDArray[np.float64]  # (n, n_screens), rms over the points, radian

    def error(self, name: str) -> NDArray[np.float64]:
        """Error of a method, median over the screens, (n,), radian rms."""
        return np.median(self.errors[name], axis=1)

    def screens(self) -> dict[str, NDArray]:
        """Input and errors of every single screen, as columns for `publish`."""
        return screen_errors("input (rad rms)", self.rms, self.errors)


def look_curves(
    sensor: ZernikeSensor, modes: NDArray | Screens, rms: ArrayLike, photons: float, n_screens: int,
    n_iterations: int, *, exponent: float = -2.0, seed: int = 0,
) -> LookCurves:  # fmt: skip
    """Error of each method against the input, for photons per point and image."""
    rms = np.asarray(rms, float)
    shared = sensor, modes, photons, n_screens, n_iterations, exponent, seed
    points = sweeps.table(_look_point, enumerate(rms.tolist()), *shared, name="look_curves")
    return LookCurves(rms, points["errors"], points["bound"])


def _look_point(
    numbered: tuple[int, float], sensor: ZernikeSensor, modes: NDArray | Screens, photons: float, n_screens: int,
    n_iterations: int, exponent: float, seed: int,
) -> dict[str, Any]:  # fmt: skip
    task, rms = numbered
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    frames = _noisy(sensor.measure(screens), photons, seed, task)
    methods: dict[str, Any] = {name: PhaseShifted(sensor, **settings) for name, settings in SOLVES.items()}
    methods[PLAIN] = PhaseShifted(sensor, n_iterations=n_iterations)
    methods[LEARNED] = LearnedReference(sensor)
    methods[LIKELY] = MaximumLikelihood(sensor, photons=photons)
    bound = sensor.pupil.gather(cramer_rao(sensor, screens, photons=photons))
    return {
        "errors": {
            name: reconstruction_error(sensor.pupil, method(frames).phase, screens)
            for name, method in methods.items()
        },
        "bound": np.sqrt(np.mean(bound**2, axis=-1)),
    }


@dataclass(frozen=True)
class BenchCurves:
    """Errors on benches of some leakages, whose images share the light unequally."""

    leakages: NDArray[np.floating]  # (n,)
    rms: float  # of the screens, radian
    errors: dict[str, NDArray[np.float64]]  # (n, n_screens) of each of `WAYS`, radian rms

    def error(self, way: str) -> NDArray[np.float64]:
        """Error of a way, median over the screens, (n,), radian rms."""
        return np.median(self.errors[way], axis=1)

    def screens(self) -> dict[str, NDArray]:
        """Leakage and errors of every single screen, as columns for `publish`."""
        errors = {f"{way}: error (rad rms)": error for way, error in self.errors.items()}
        return screen_columns({"leakage": self.leakages}, errors)


def bench_curves(
    sensor: ZernikeSensor, modes: NDArray, leakages: Sequence[float], flux_ratio: float, rms: float,
    photons: float, n_screens: int, n_iterations: int, *, exponent: float = -2.0, seed: int = 0,
) -> BenchCurves:  # fmt: skip
    """Error of each of `WAYS` against the leakage of the bench, on the same screens."""
    screens = screens_at(modes, rms, n_screens, seed, 0, exponent)
    shared = sensor, screens, flux_ratio, photons, n_iterations, seed
    points = sweeps.table(_bench_point, enumerate(leakages), *shared, name="bench_curves")
    return BenchCurves(np.array(leakages, float), rms, points)


def _bench_point(
    numbered: tuple[int, float], sensor: ZernikeSensor, screens: NDArray, flux_ratio: float, photons: float,
    n_iterations: int, seed: int,
) -> dict[str, NDArray]:  # fmt: skip
    task, leakage = numbered
    frames = _noisy(bench_images(sensor.measure(screens), leakage, flux_ratio), photons, seed, task)
    iteration = PhaseShifted(sensor, n_iterations=n_iterations)
    truth = BenchValues.of(np.array([leakage, flux_ratio, 0, 0, 0, 0, 0]))
    phases = {
        NOMINAL: iteration(frames).phase,
        TRUE: iteration(LearnedReference(sensor, bench=truth)(frames).frames).phase,
        UNTRAINED: LearnedReference(sensor)(frames).phase,
        LEARNED: LearnedReference(sensor, "bench")(frames).phase,
    }
    return {way: reconstruction_error(sensor.pupil, phase, screens) for way, phase in phases.items()}


class FoundBench(NamedTuple):
    """Values of one bench from several numbers of pairs of images."""

    pairs: NDArray[np.int64]  # (n_pairs,)
    rms: NDArray[np.floating]  # (n_rms,), of the screens, radian
    true: dict[str, float]  # leakage and flux ratio
    values: dict[str, NDArray[np.float64]]  # (n_rms, n_pairs) of both
    errors: dict[str, NDArray[np.float64]]  # (n_rms, n_pairs) of both, standard errors


def find_bench(
    sensor: ZernikeSensor, modes: NDArray, leakage: float, flux_ratio: float, rms: Sequence[float],
    pairs: Sequence[int], photons: float, *, exponent: float = -2.0, seed: int = 0,
) -> FoundBench:  # fmt: skip
    """Read leakage and flux ratio of a bench from the first images of a series of random screens."""
    learned, true = LearnedReference(sensor, "bench"), {"leakage": leakage, "flux ratio": flux_ratio}
    results = []
    for task, value in enumerate(rms):
        screens = screens_at(modes, value, max(pairs), seed, task, exponent)
        frames = _noisy(bench_images(sensor.measure(screens), leakage, flux_ratio), photons, seed, task)
        results.append([learned.average(frames[:n]) for n in pairs])

    def of(place: int) -> dict[str, NDArray[np.float64]]:
        """Leakages and flux ratios of the values (place 0), or of their errors (place 1)."""
        columns = np.array(
            [[(result[place].leakage, result[place].flux_ratio) for result in row] for row in results]
        )
        return dict(zip(true, np.moveaxis(columns, -1, 0), strict=True))

    return FoundBench(np.array(pairs), np.array(rms, float), true, of(0), of(1))


def bench_images(frames: NDArray, leakage: float, flux_ratio: float) -> NDArray[np.float64]:
    """Frames (..., 2, ny, nx) of a bench that mixes two images and shares the light unequally."""
    first, second = np.moveaxis(frames, -3, 0)
    mixed = (1 - leakage) * first + leakage * second, ((1 - leakage) * second + leakage * first) / flux_ratio
    return np.stack(mixed, axis=-3)


def _noisy(frames: NDArray, photons: float, seed: int, task: int) -> NDArray[np.float64]:
    """Frames with photon noise, for a number of photons per point and image."""
    camera = Detector(photons)
    return camera.normalise(camera.expose(frames, np.random.SeedSequence(seed, spawn_key=(task, 1))))


def draw_look(curves: Mapping[str, LookCurves]) -> Figure:
    """Error of each method against the input, one panel for each kind of screens."""
    figure, panels = plt.subplots(1, len(curves), figsize=(7.2, 4.6), sharey=True, squeeze=False)
    for axes, (kind, shown) in zip(panels[0], curves.items(), strict=True):
        for name, style in _lines().items():
            axes.semilogy(shown.rms, shown.error(name), **style)
        bound = np.median(shown.bound, axis=1)
        axes.semilogy(shown.rms, bound, color="#999999", lw=6, zorder=1, label="bound")
        axes.set(xlabel="input (rad rms)", title=kind, xlim=(0, None))
    panels[0, 0].set_ylabel("error (rad rms)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def _lines() -> dict[str, dict[str, Any]]:
    """How each method is drawn: fewer solves with finer dashes."""
    plain = LOOKS[PLAIN]
    early = {
        ONE: {"linestyle": ":", "marker": "1"},
        TWO: {"linestyle": "--", "marker": "2"},
        TWO_FASTER: {"linestyle": "-", "marker": plain.marker, "mfc": "#ffffff"},
    }
    styles = {
        LIKELY: LOOKS[LIKELY].style | {"ms": 8, "lw": 3, "zorder": 1.9, "label": LOOKS[LIKELY].label},
        **{
            name: {"color": plain.color, "ms": 6, "label": f"phase-shifted, {name}"} | early[name]
            for name in SOLVES
        },
        PLAIN: plain.style | {"ms": 5, "label": "phase-shifted, converged"},
        LEARNED: LOOKS[LEARNED].style | {"ms": 6, "lw": 2, "label": "learned reference wave, one solve"},
    }
    return styles


def draw_bench(curves: BenchCurves) -> Figure:
    """Error of each of `WAYS` against the leakage."""
    figure, axes = plt.subplots(figsize=(6.8, 4.2))
    styles = {
        NOMINAL: LOOKS[PLAIN].style,
        UNTRAINED: LOOKS[LEARNED].style | {"linestyle": ":", "mfc": "#ffffff"},
        LEARNED: LOOKS[LEARNED].style | {"lw": 2},
        TRUE: method_look(ACCELERATED).style | {"mfc": "#ffffff"},
    }
    labels = {LEARNED: "learned, trained with bench errors"}
    for way, style in styles.items():
        axes.plot(100 * curves.leakages, curves.error(way), ms=6, label=labels.get(way, way), **style)
    axes.set(xlabel="leakage of the bench (%)", ylabel="error (rad rms)", ylim=(0, None))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def draw_found(found: FoundBench) -> Figure:
    """Leakage and flux ratio with their standard errors, against the number of pairs of images."""
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.8))
    shift = 1.12 ** (np.arange(found.rms.size) - (found.rms.size - 1) / 2)
    for axes, (name, true) in zip(panels, found.true.items(), strict=True):
        unit, label = (100, f"{name} (%)") if name == "leakage" else (1, name)
        axes.axhline(unit * true, color="#999999", lw=3, zorder=1, label="true value")
        for row, rms in enumerate(found.rms):
            style = OTHER_STYLES[row % len(OTHER_STYLES)] | {"linestyle": "none"}
            values, errors = unit * found.values[name][row], unit * found.errors[name][row]
            axes.errorbar(shift[row] * found.pairs, values, errors, label=f"input {rms:g} rad rms", ms=6, **style)
        axes.set_xscale("log")
        axes.set(xlabel="pairs of images", ylabel=label)
        axes.set_xticks(found.pairs, [f"{number}" for number in found.pairs])
        axes.set_xticks([], minor=True)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def findings(curves: Mapping[str, LookCurves], photons: float) -> Text:
    """Say how near one learned solve comes to the other methods and to the bound, for each kind of screens."""
    rms = next(iter(curves.values())).rms
    middle, last = _at(rms, 0.8), int(np.argmax(rms))
    ratios = [f"{shown.error(LEARNED)[middle] / shown.error(PLAIN)[middle]:.2f}" for shown in curves.values()]
    times = " and ".join(f"{ratio} times ({kind})" for kind, ratio in zip(curves, ratios, strict=True))
    lead = (
        f"**At {rms[middle]:g} rad rms and {photons:g} photons per point and image, one solve with the learned "
        f"reference wave has {times} the error of the converged iteration.**"
    )
    errors = "; ".join(
        f"{small(shown.error(LEARNED)[last])} rad ({kind}, converged iteration: {small(shown.error(PLAIN)[last])})"
        for kind, shown in curves.items()
    )
    return Text(f"{lead} At {rms[last]:g} rad rms it has {errors}.")


def findings_bench(curves: BenchCurves, flux_ratio: float) -> Text:
    """Say what the errors of the bench cost with each of `WAYS`, at the largest leakage."""
    last = int(np.argmax(curves.leakages))
    errors = {way: f"{small(curves.error(way)[last])} rad" for way in WAYS}
    return Text(
        f"**With a leakage of {100 * curves.leakages[last]:.3g} % and a flux ratio of {flux_ratio:.3g}, the "
        f"iteration with the nominal model has an error of {errors[NOMINAL]}, and one learned solve that reads "
        f"the bench from the same two images has {errors[LEARNED]}.** With the true values of the bench, the "
        f"iteration has {errors[TRUE]}. The network that was trained without errors of the bench has "
        f"{errors[UNTRAINED]}."
    )


def findings_found(found: FoundBench) -> Text:
    """Say how well the most pairs of images give the values, at the middle input."""
    row, place = found.rms.size // 2, int(np.argmax(found.pairs))
    ratio = found.true["flux ratio"]

    def written(values: dict[str, NDArray[np.float64]], place: int) -> tuple[str, str]:
        leakage, flux_ratio = (abs(float(values[name][row, place])) for name in found.true)
        return f"{small(100 * leakage)} percentage points", f"{small(100 * flux_ratio / ratio)} %"

    wrong = {name: found.values[name] - value for name, value in found.true.items()}
    (leakage, flux), (off, off_flux) = written(found.errors, place), written(wrong, place)
    return Text(
        f"**From {_counted(int(found.pairs[place]))} of images at {found.rms[row]:g} rad rms, the standard "
        f"error is {leakage} for the leakage and {flux} for the flux ratio; the values differ from the true "
        f"ones by {off} and {off_flux}.**"
    )


def _counted(n_pairs: int) -> str:
    return "one pair" if n_pairs == 1 else f"{n_pairs} pairs"


def _at(values: NDArray, value: float) -> int:
    """Place of the value that is nearest to `value`."""
    return int(np.argmin(np.abs(values - value)))


def numbers(curves: LookCurves, turbulence: LookCurves, bench: BenchCurves) -> dict[str, float | str]:
    """Return the numbers that the claims quote."""
    middle, last = _at(curves.rms, 0.8), int(np.argmax(bench.leakages))
    return rounded(
        {
            "look_input": curves.rms[middle],
            "look_error": curves.error(LEARNED)[middle],
            "look_ratio": curves.error(LEARNED)[middle] / curves.error(PLAIN)[middle],
            "look_turbulence_ratio": turbulence.error(LEARNED)[middle] / turbulence.error(PLAIN)[middle],
            "look_bench_leakage": bench.leakages[last],
            "look_bench_ratio": bench.error(LEARNED)[last] / bench.error(TRUE)[last],
            "look_nominal_ratio": bench.error(NOMINAL)[last] / bench.error(TRUE)[last],
        }
    )
