"""Figure 5: the layout of the bench in numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zwfs.bench.model import Bench
from zwfs.companion.tables import Table
from zwfs.metrics import strehl
from zwfs.pupil import Pupil


def layout(bench: Bench, pistons: NDArray, wavelength: float) -> Table:
    """Return the sizes of the segments, and the pistons (radian) compared with the wavelength (nm)."""
    pupil = Pupil.from_segments(bench.segments)
    number = pupil.gather(bench.segments)
    share = np.bincount(number)[bench.numbers] / np.bincount(number).max()
    center = {one: pupil.points[number == one].mean(axis=0) for one in (1, 3)}
    pitch = float(np.hypot(*(center[3] - center[1])))  # segment 3 touches segment 1
    rms = float(pistons.std())
    return Table(
        ["quantity", "value"],
        [
            ["segments of the mirror", bench.n_segments + len(bench.missing)],
            ["segments in use", bench.n_segments],
            ["segments across the stop", 1 / pitch],
            ["width of a gap (% of a segment)", bench.gap / pitch * 100],
            ["segments with more than 95 % of their area in the stop", int((share > 0.95).sum())],
            ["smallest share of a segment in the stop", float(share.min())],
            ["fill factor of the stop", pupil.n_points / Pupil.circular(bench.n_pixels).n_points],
            ["pistons (rad rms)", rms],
            ["pistons, wavefront (nm rms)", rms * wavelength / (2 * np.pi)],
            ["Strehl ratio with these pistons", float(strehl(pupil, bench.commanded_phase(pistons)))],
        ],
    )
