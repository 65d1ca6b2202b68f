"""First chapter: columns of its figures, the numbers of its text, and the pixel whose phase a reader moves."""

from __future__ import annotations

import json

import numpy as np
from IPython.display import HTML
from numpy.typing import NDArray

from zwfs.companion.results import glue_numbers
from zwfs.metrics import reconstruction_error, strehl
from zwfs.paper.one_pixel import Pixel
from zwfs.pupil import Pupil


def columns(pupil: Pupil, phase: NDArray, frames: NDArray, pixel: Pixel) -> dict[str, NDArray]:
    """Columns along the row of the pixel."""
    return {
        "x (D)": pupil.x,
        "phase (rad)": np.where(pupil.inside, phase, np.nan)[pixel.row],
        "image 1": frames[0, pixel.row],
        "image 2": frames[1, pixel.row],
    }


def curves(pixel: Pixel) -> dict[str, NDArray]:
    """Columns of both intensities against the phase of the pixel."""
    phases = np.linspace(-np.pi, np.pi, 361)
    first, second = pixel.intensities(phases)
    return {"phase of the pixel (rad)": phases, "image 1": first, "image 2": second}


def cut(pupil: Pupil, truth: NDArray, one: NDArray, two: NDArray, pixel: Pixel) -> dict[str, NDArray]:
    """Columns of the reconstructed phases along the row of the pixel; also glue the numbers of the text."""
    glue_numbers(
        {
            "pixel_phase": pixel.phase,
            "mirrored_a": pixel.mirrored[0],
            "mirrored_b": pixel.mirrored[1],
            "one_at_pixel": one[pixel.row, pixel.column],
            "one_error": float(reconstruction_error(pupil, one, truth)),
            "fold": np.angle(-np.exp(1j * np.angle(pixel.waves[0]))),
            "strehl": float(strehl(pupil, truth)),
        }
    )
    return {
        "x (D)": pupil.x,
        "true phase (rad)": np.where(pupil.inside, truth, np.nan)[pixel.row],
        "phase from one image (rad)": one[pixel.row],
        "phase from two images (rad)": two[pixel.row],
    }


def explorer(pixel: Pixel) -> HTML:
    """Place of the interactive phasors, with the computed reference waves; book/_static/phasor.js draws them."""
    waves = json.dumps([[round(wave.real, 4), round(wave.imag, 4)] for wave in pixel.waves.tolist()])
    return HTML(
        f'<div id="phasor" class="d-print-none" data-waves="{waves}" data-phase="{pixel.phase:.2f}" hidden></div>'
    )
