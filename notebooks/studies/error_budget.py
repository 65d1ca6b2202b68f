"""The error budget of the bench: the effect of each of its errors alone, and of leakage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.bench import UNITS, BenchCurves, bench_curves, check_bench
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.results import rounded
from studies.kit.style import LOOKS
from studies.kit.tables import Table, Text
from zwfs.bench import Bench, BenchModel
from zwfs.reconstructors import PhaseShifted

LIMITS = parameter_limits(
    "inputs n_screens n_iterations",
    n_pixels=(32, 1024),
    leakages=[(0.0, 0.49), ...],
    bench=bench_fields("n_pixels"),
)
CHECK_TOGETHER = check_bench
QUICK = {"n_pixels": 68, "inputs": [0.8], "n_screens": 1, "leakages": [0.0, 0.1, 0.3]}

_NO_OFFSET = 1e-6  # rad rms, below which digits are rounding errors
_LOWERED = 0.99  # gain below which an error counts as lowering it
NAME = "PhaseShifted"  # the reconstructor of the page
Curves = Mapping[str, BenchCurves]  # by the error that is switched on


def error_budget(
    benches: Mapping[Any, Bench], rms: ArrayLike, n_screens: int, *, n_iterations: int = 25, seed: int = 0
) -> dict[Any, BenchCurves]:
    """Curves of the phase-shifted iteration on benches that differ in their errors, each with its own model."""
    shared = np.asarray(rms, dtype=float), n_screens, n_iterations, seed
    curves = sweeps.run(_bench_case, benches.values(), *shared, name="error_budget")
    return dict(zip(benches, curves, strict=True))


def _bench_case(bench: Bench, rms: NDArray, n_screens: int, n_iterations: int, seed: int) -> BenchCurves:
    """Curves of one bench."""
    model = BenchModel.from_images(bench, seed)
    methods = {NAME: PhaseShifted(model.shifted, n_iterations=n_iterations)}
    return bench_curves(bench, model, methods, rms, n_screens, seed=seed)


def effects(budget: Curves, name: str = NAME) -> tuple[NDArray, NDArray, NDArray]:
    """Offset, and gain and error at the first input after 0, of each case."""
    curves = budget.values()
    return (
        np.array([case.mean(name)[0] for case in curves]),
        np.array([case.gain(name)[1] for case in curves]),
        np.array([case.mean(name)[1] for case in curves]),
    )


def standard_errors(budget: Curves, name: str = NAME) -> tuple[NDArray, NDArray, NDArray]:
    """Standard errors of `effects`, from the scatter of the screens."""
    rows = []
    for curves in budget.values():
        commanded = curves.commanded[1]
        residuals = curves.residuals[name][1] - curves.residuals[name][0].mean(axis=0)
        gains = np.sum(commanded * residuals, axis=-1) / np.sum(commanded**2, axis=-1)
        rows.append([values.std() / np.sqrt(len(gains)) for values in (*curves.errors[name][:2], gains)])
    offset, error, gain = np.array(rows).T
    return offset, gain, error


def draw_budget(budget: Curves, name: str) -> Figure:
    """Effect of each error alone: offset at a flat command, gain and error at the first other input."""
    figure, panels = plt.subplots(1, 3, figsize=(7, 3.6), sharey=True)
    rows = np.arange(len(budget))[::-1]
    value = next(iter(budget.values())).rms[1]
    offsets, gains, errors = effects(budget, name)
    offset_scatter, gain_scatter, error_scatter = standard_errors(budget, name)
    for axes, label, values, scatter in zip(
        panels,
        (
            "error at a flat\ncommand (rad rms)",
            f"change of the gain at\n{value:g} rad rms (%)",
            f"error at {value:g} rad\nrms (rad rms)",
        ),
        (offsets, 100 * (gains - 1), errors),
        (offset_scatter, 100 * gain_scatter, error_scatter),
        strict=True,
    ):
        axes.barh(rows, values, xerr=scatter, ecolor="#555555", color=LOOKS[name].color, height=0.65)
        axes.axvline(0, color="#555555", lw=1)
        axes.set(xlabel=label)
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks(rows, [_words(error) for error in budget])
    return figure


def effect_table(budget: Curves, bench: Bench) -> Table:
    """Size of each error of a bench, and offset, gains and errors with this error alone."""
    sizes = {name: f" ({getattr(bench, name):g} {unit})" for name, unit in UNITS.items()}
    rows = [
        [
            _words(error) + sizes.get(error, ""),
            f"{offset:.2g}" if (offset := curves.mean(NAME)[0]) > _NO_OFFSET else "0",
            *_cells(curves),
        ]
        for error, curves in budget.items()
    ]
    return Table(["error switched on", "offset (rad rms)", *_header(budget)], rows)


def leakage_table(swept: Mapping[float, BenchCurves]) -> Table:
    """Gains and errors with nothing but leakage."""
    return Table(
        ["leakage", *_header(swept)], [[f"{value:.0%}", *_cells(curves)] for value, curves in swept.items()]
    )


def _header(cases: Mapping[Any, BenchCurves]) -> list[str]:
    inputs = next((curves.rms[curves.rms > 0] for curves in cases.values()), ())
    return [f"{quantity} at {value:g} rad rms" for quantity in ("gain", "error (rad rms)") for value in inputs]


def _cells(curves: BenchCurves) -> list[str]:
    used = curves.rms > 0
    errors = (f"{value:.2g}" if value > 1e-6 else "0" for value in curves.mean(NAME)[used])
    return [*(f"{value:.3f}" for value in curves.gain(NAME)[used]), *errors]


def _words(error: str) -> str:
    return error.replace("_", " ")


def findings(budget: Curves) -> Text:
    """Say which errors alone cause an offset, and which lower the gain."""
    offsets, gains, _ = (dict(zip(budget, values, strict=True)) for values in effects(budget))
    alone = [error for error in budget if error not in ("none", "all")]
    worst = max(alone, key=lambda error: offsets[error])
    lowering = sorted((error for error in alone if gains[error] < _LOWERED), key=lambda error: gains[error])
    rms = next(iter(budget.values())).rms[1]
    if offsets[worst] > _NO_OFFSET:
        text = (
            f"At a flat command the error of the simulated bench is {offsets['all']:.2g} rad rms; "
            f"with *{_words(worst)}* alone it is {offsets[worst]:.2g}."
        )
    else:
        text = "No error of the simulated bench alone causes an error at a flat command."
    if lowering:
        listed = ", ".join(f"*{_words(error)}* ({gains[error]:.2f})" for error in lowering)
        text += f" At {rms:.2g} rad rms these errors alone lower the gain to the number in brackets: {listed}."
    else:
        text += f" At {rms:.2g} rad rms no error alone lowers the gain by more than 1 %."
    return Text(text)


def numbers(budget: Curves, swept: Mapping[float, BenchCurves]) -> dict[str, float | str]:
    """Numbers for the claims: gains with single errors, and with 10 % leakage."""
    gains = dict(zip(budget, effects(budget)[1], strict=True))
    named = {f"gain_{error}": gains[error] for error in ("leakage", "focus_difference")}
    return rounded(named | {"gain_leakage_10": swept[0.1].gain(NAME)[1] if 0.1 in swept else np.nan})
