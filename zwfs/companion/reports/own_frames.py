"""Your own frames: the files, the result, and the gain of each step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs.companion.reports import middle_rows
from zwfs.companion.results import glue_numbers
from zwfs.companion.tables import Table
from zwfs.frames._fits import fits_module
from zwfs.frames.files import CameraFile
from zwfs.frames.pipeline import MeasuredPhase, Step
from zwfs.frames.registration import Image
from zwfs.frames.verdict import CameraNoise, Verdict
from zwfs.units import phase_to_opd

SHOWN = ("BUNIT", "WAVELEN", "PUPDIAM", "DIMPLE", "ROTATE", "MAGNIF", "NBAD")  # keywords of the phase map


def camera_noise(source: CameraFile, gain: float, read_noise: float) -> CameraNoise | None:
    """Return the noise of the camera by these values, or by EGAIN and RDNOISE of a header; None without a gain."""
    gain = gain or (source.keyword("EGAIN") if "EGAIN" in source.header else 0.0)
    read_noise = read_noise or (source.keyword("RDNOISE") if "RDNOISE" in source.header else 0.0)
    return CameraNoise(gain, read_noise) if gain else None


def verdict(verdict: Verdict) -> Table:
    """Return the findings in words."""
    return Table(["question", "answer"], [[topic, sentence] for topic, sentence in verdict.findings.items()])


def images(frames: Sequence[Image], clear_frames: Sequence[Image]) -> Table:
    """Return the size, the brightest good pixel and the number of bad pixels of each image."""
    rows = [
        [one.name, *one.counts.shape, f"{one.counts[~one.bad].max():.5g}", int(one.bad.sum())]
        for one in (*frames, *clear_frames)
    ]
    return Table(["image", "rows", "columns", "brightest good pixel", "bad pixels"], rows)


def frame_columns(result: MeasuredPhase) -> dict[str, NDArray]:
    """Return the columns to publish: the middle rows of the frames."""
    return middle_rows({"measured": result.measured, "modelled": result.modelled})


def phase_columns(result: MeasuredPhase, verdict: Verdict, wavelength: float) -> dict[str, NDArray]:
    """Return the columns to publish: the phase and its error bar on the middle row, in radian and in nm."""
    middle = result.phase.shape[0] // 2
    row = result.phase[middle]
    sigma = np.full(row.shape, np.nan) if verdict.sigma is None else verdict.sigma[middle]
    return {
        "column (pixel)": np.arange(row.size),
        "phase on the middle row (rad)": row,
        "the same (nm)": phase_to_opd(row, wavelength),
        "error bar (rad)": sigma,
    }


def poke_columns(result: MeasuredPhase) -> dict[str, NDArray]:
    """Return the columns to publish with the sketch of the signs."""
    shifts = np.array(result.measurement.optics.phase_shifts)
    return {"image": np.array([1, 2]), "phase shift (rad)": shifts}


def result(result: MeasuredPhase) -> Table:
    """Return the places of the pupils, the counts, and the agreement of the frames."""
    measurement, recording = result.measurement, result.measurement.recording
    placement = recording.placement
    pupils = [f"{one.row:.2f}, {one.column:.2f}, {one.diameter:.2f}" for one in recording.pupils]
    return Table(
        ["quantity", "value"],
        [
            ["first pupil: row, column, diameter (pixels)", pupils[0]],
            ["second pupil: row, column, diameter (pixels)", pupils[1]],
            [
                "shift of the second image (rows, columns; pixels)",
                _with_error(placement.shift, placement.sigma[:2], 3),
            ],
            ["its rotation, x to y (degrees)", _with_error([placement.rotation], placement.sigma[2:3], 3)],
            ["its magnification", _with_error([placement.magnification], placement.sigma[3:], 5)],
            ["background of the clear frames (counts)", _pair(measurement.background[2:], 1)],
            ["counts that make an intensity of 1", _pair(measurement.counts, 0)],
            ["light of image 1 over 2, frames", f"{measurement.flux_ratio[0]:.3f}"],
            ["the same, clear frames", f"{measurement.flux_ratio[1]:.3f}"],
            ["points of the pupil", measurement.pupil.n_points],
            ["of these, bad", measurement.n_bad],
            ["points without a unique solution", result.n_unsolved],
            ["correlation of the frames with their fit (too optimistic)", _pair(result.correlation, 3)],
            ["rms difference of the frames (mean = 1)", _pair(result.residual, 3)],
            ["excess light around the pupil (mean = 1)", f"{result.excess_light:.3f}"],
        ],
    )


def step_columns(work: Sequence[Step], errors: Sequence[float] | None) -> dict[str, Any]:
    """Return the columns to publish: the scores of each step."""
    columns: dict[str, Any] = {"step": [step.name for step in work]}
    columns |= {f"score, image {i + 1}": [step.predicted[i] for step in work] for i in range(2)}
    columns |= {f"control, image {i + 1}": [step.control[i] for step in work] for i in range(2)}
    columns |= {"misfit over contrast": [step.result.misfit for step in work]}
    return columns | {"error of the segments (rad rms)": errors or np.nan}


def steps(work: Sequence[Step], errors: Sequence[float] | None) -> Table:
    """Return the scores of each step, and the fitted optics."""
    rows = []
    for index, step in enumerate(work):
        optics = step.result.measurement.optics
        rows.append(
            [
                step.name,
                _pair(step.predicted, 2),
                _pair(step.control, 2),
                f"{step.result.misfit:.3f}",
                f"{optics.scale:.2f}",
                f"{optics.diameter:.2f}",
                f"{optics.leakage:.2f}",
                f"{errors[index]:.3f}" if errors else "unknown",
            ]
        )
    scores = ["score", "control", "misfit over contrast"]
    return Table(["step", *scores, "scale", "dimple", "leakage", "error (rad rms)"], rows)


def phase_file(path: str) -> Table:
    """Return some keywords of the phase map."""
    header = fits_module().getheader(path)
    return Table(["keyword", "value"], [[key, header[key]] for key in SHOWN], digits=5)


def claims(chosen: MeasuredPhase, verdict: Verdict, work: Sequence[Step], errors: Sequence[float] | None) -> None:
    """Glue the score, the misfit over the noise, and the errors of the chosen result and of the last one."""
    known = errors or [np.nan] * len(work)
    index = [step.result for step in work].index(chosen)
    numbers = {"score": verdict.score.min(), "control": verdict.control.max(), "inner": verdict.inner}
    numbers |= {"edge": verdict.edge, "misfit": chosen.misfit, "misfit_last": work[-1].result.misfit}
    sigma = np.nan if verdict.sigma is None else np.nanmedian(verdict.sigma)
    glue_numbers(numbers | {"sigma": sigma, "error": known[index], "error_last": known[-1]})


def _with_error(values: Sequence[float] | NDArray, errors: NDArray, digits: int) -> str:
    """Values with their standard errors; a value without one was not determined."""
    pairs = zip(values, errors, strict=True)
    return ", ".join(
        f"{value:.{digits}f} ± {error:.{digits}f}"
        if np.isfinite(error)
        else f"{value:.{digits}f} (not determined)"
        for value, error in pairs
    )


def _pair(values: Sequence[float] | NDArray, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
