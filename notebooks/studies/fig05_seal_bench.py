"""Figure 5: the layout of the bench, drawn and in numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.bench import check_bench
from studies.kit.drawings import Picture, draw_layout, focal_light, mask_picture, shift_label
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from zwfs import Dimple, Pupil, strehl
from zwfs.bench import Bench

LIMITS = parameter_limits("rms exponent", wavelength=(100.0, 20000.0), bench=bench_fields())
CHECK_TOGETHER = check_bench


def draw_bench_layout(bench: Bench, pistons: NDArray, frames: NDArray, wavelength: float) -> Figure:
    """Figure 5: simplified layout of the SEAL bench, folded at its two deformable mirrors; wavelength in nm."""
    pupil = Pupil.from_segments(bench.segments)
    phase = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    limit = np.nanmax(np.abs(phase))
    none: dict[str, Any] = dict.fromkeys((*bench.errors(), "photons_per_image", "read_noise", "background"), 0)
    quilted = replace(bench, **none | {"quilting": bench.quilting}).frames()[0]
    plus, minus = (Dimple(bench.diameter, sign * bench.phase) for sign in (1, -1))
    pictures = {
        "stop": Picture(pupil.amplitude**2, "gray", 0, pupil.amplitude.max() ** 2, "segments in stop"),
        "pistons": Picture(phase, PHASE_MAP, -limit, limit, "pistons (rad)"),
        "quilting": Picture(quilted, INTENSITY_MAP, 0, quilted.max(), "quilting"),
        "dimple": mask_picture(plus, focal_light(pupil, pupil.field(phase), _REACH), _REACH),
        "image_1": Picture(frames[0], INTENSITY_MAP, 0, frames.max(), "image 1"),
        "image_2": Picture(frames[1], INTENSITY_MAP, 0, frames.max(), "image 2"),
    }
    texts = {"plus": shift_label(plus, plus=True), "minus": shift_label(minus, plus=True)}
    texts["wavelength"] = f"{wavelength:g}"
    return draw_layout("fig05_seal_bench.svg", "fig05_seal_bench_narrow.svg", pictures, texts)


_REACH = 4  # of the picture of the dimple, lambda/D from its centre


def layout_table(bench: Bench, pistons: NDArray, wavelength: float) -> Table:
    """Sizes of the segments, and the pistons (rad) compared with the wavelength (nm)."""
    pupil = Pupil.from_segments(bench.segments)
    number = pupil.gather(bench.segments)
    share = np.bincount(number)[bench.numbers] / np.bincount(number).max()
    center = {one: pupil.points[number == one].mean(axis=0) for one in (1, 3)}
    pitch = float(np.hypot(*(center[3] - center[1])))  # segment 3 touches segment 1
    rms, phase = float(pistons.std()), bench.commanded_phase(pistons)
    return Table(
        ["quantity", "value"],
        [
            ["segments of the mirror", bench.n_segments + len(bench.missing)],
            ["segments in use", bench.n_segments],
            ["segments across the stop", 1 / pitch],
            ["width of a gap (% of a segment)", bench.gap / pitch * 100],
            ["segments with more than 95 % of their area in the stop", int((share > 0.95).sum())],
            ["smallest share of a segment in the stop", float(share.min())],
            ["share of the stop that segments cover", pupil.n_points / Pupil.circular(bench.n_pixels).n_points],
            ["pistons (rad rms over the segments)", rms],
            ["pistons, wavefront (nm rms over the segments)", rms * wavelength / (2 * np.pi)],
            ["pistons (rad rms over the stop, which cuts the outer segments)", float(pupil.gather(phase).std())],
            ["Strehl ratio with these pistons", float(strehl(pupil, phase))],
        ],
    )
