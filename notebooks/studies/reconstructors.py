"""Convergence of the reconstructors: error after each iteration, one screen, accuracy of the model."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.results import screen_errors
from studies.kit.setups import screens_at
from studies.kit.style import ALONE, LOOKS, looks_of, show_phase
from studies.kit.tables import Table, small
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.pupil import Pupil
from zwfs.reconstructors import Reconstruction
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits("n_pixels n_modes diameter phase_shift inputs n_screens exponent n_iterations extent")
QUICK = {"n_pixels": 64, "n_screens": 4}


def iteration_errors(
    reconstructor: Any, modes: NDArray, rms: float, n_screens: int, *, exponent: float = -2.0, seed: int = 0
) -> NDArray[np.float64]:
    """Error of a reconstructor on random screens of an rms, (n_screens, n_iterations + 1), radian rms."""
    sensor = reconstructor.sensor
    screens = screens_at(modes, rms, n_screens, seed, 0, exponent)
    errors = np.empty((n_screens, reconstructor.settings.n_iterations + 1))
    # One screen at a time: the history of all of them would take much memory.
    for index, screen in enumerate(screens):
        history = reconstructor(sensor.measure(screen), history=True).history
        errors[index] = reconstruction_error(sensor.pupil, history, screen)
    return errors


def model_accuracy(sensor: ZernikeSensor, phase: NDArray, tolerances: Sequence[float]) -> NDArray[np.float64]:
    """Tolerance, rank of the low-rank model of a sensor, and relative error of the reference wave, in rows."""
    field = sensor.pupil.field(phase)
    exact = ZernikeSensor(sensor.pupil, *sensor.masks, tolerance=1e-14).reference_wave(field)
    rows = []
    for tolerance in tolerances:
        model = ZernikeSensor(sensor.pupil, *sensor.masks, tolerance=tolerance)
        error = np.abs(model.reference_wave(field) - exact).max() / np.abs(exact).max()
        rows.append((tolerance, model.rank, error))
    return np.array(rows)


def draw_convergence(errors: Mapping[str, Mapping[float, NDArray]]) -> Figure:
    """Error against iteration, one panel for each input."""
    inputs = list(next(iter(errors.values())))
    figure, panels = plt.subplots(1, len(inputs), figsize=(7.2, 4.2), sharey=True, squeeze=False)
    for axes, value in zip(panels[0], inputs, strict=True):
        for name, look in looks_of(errors):
            middle, low, high = (np.quantile(errors[name][value], q, axis=0) for q in (0.5, 0.1, 0.9))
            if middle.size == 2:
                axes.axhline(middle[1], color=look.color, linestyle=look.line, label=look.label)
                continue
            steps = np.arange(middle.size)
            axes.semilogy(
                steps, middle, color=look.color, linestyle=look.line, marker=look.marker, ms=3.5, label=look.label
            )
            axes.fill_between(
                steps, low, high, color=look.color, alpha=0.15, lw=0, label=f"_{look.label}, scatter"
            )
        axes.set(xlabel="iteration", title=f"input {value:g} rad")
        axes.xaxis.get_major_locator().set_params(integer=True)
    panels[0, 0].set_ylabel("error (rad rms)")
    panels[0, 0].set_ylim(3e-8, 2)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def draw_estimates(pupil: Pupil, truth: NDArray, phases: Mapping[str, NDArray]) -> Figure:
    """One screen, the phase (radian) that each method estimates, and the residual, on a scale four times finer."""
    truth = np.where(pupil.inside, truth, np.nan)
    limit = np.nanmax(np.abs(truth))
    figure, panels = plt.subplots(2, len(phases) + 1, figsize=(7.2, 4.6))
    image = show_phase(panels[0, 0], truth, limit)
    panels[0, 0].set_title("input", fontsize=9)
    panels[0, 0].set_gid(ALONE)
    panels[1, 0].remove()
    panels[1, 1].set_ylabel("residual")
    for column, (name, look) in enumerate(looks_of(phases), start=1):
        residual = wrapped_residual(pupil, phases[name], truth)
        show_phase(panels[0, column], phases[name], limit)
        shown = show_phase(panels[1, column], residual, limit / 4)
        short, rms = textwrap.fill(look.name, 10), float(np.sqrt(np.nanmean(residual**2)))
        panels[0, column].set_title(short, fontsize=9)
        panels[1, column].set_title(f"{short}\n{small(rms)} rad", fontsize=9)
    below: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "aspect": 40}
    figure.colorbar(image, ax=panels[0], label="phase (rad)", **below)
    figure.colorbar(shown, ax=list(panels[1, 1:]), label="residual (rad)", extend="both", **below)
    return figure


def convergence_screens(errors: Mapping[str, Mapping[float, NDArray]]) -> dict[str, NDArray]:
    """Errors of every single screen at the end."""
    last = {name: np.stack([error[:, -1] for error in one.values()]) for name, one in errors.items()}
    return screen_errors("input (rad rms)", list(next(iter(errors.values()))), last)


def results_table(pupil: Pupil, screen: NDArray, found: Mapping[str, Reconstruction]) -> Table:
    """Result that each method reports, and its error."""
    return Table(
        ["reconstructor", "iterations", "mismatch of the frames (rms)", "error (rad rms)"],
        [
            [
                LOOKS[name].name,
                int(result.n_iterations),
                small(float(result.residual)),
                small(float(reconstruction_error(pupil, result.phase, screen))),
            ]
            for name, result in found.items()
        ],
    )


def accuracy_table(rows: NDArray) -> Table:
    """Rank and error of the low-rank model, see `model_accuracy`."""
    return Table(
        ["tolerance", "rank", "error of the reference wave is below"],
        [
            [f"{tolerance:.0e}", int(rank), f"{10.0 ** np.ceil(np.log10(error)):.0e}"]
            for tolerance, rank, error in rows
        ],
    )
