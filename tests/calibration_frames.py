"""Make the frames of the notebook `calibration`: a bench that HCIPy simulates, recorded with 16 bits.

python -m tests.calibration_frames
"""

from dataclasses import replace

import numpy as np

from .conftest import ROOT
from .hcipy_bench import CASES

FILE = ROOT / "notebooks" / "studies" / "calibration.npz"
BENCH = replace(CASES["disc"], pixels=40, side=52)
GAIN = 4.0  # electrons / count
N_SCREENS = 6  # unseen screens of each error and light
RMS, PHOTONS = (0.1, 0.3, 0.5, 0.8, 1.2, 0.5), (1e4, 1e4, 1e4, 1e4, 1e4, 100.0)  # of these screens: rad, per pixel
UNIT = 1e-4  # rad, of the phases
SETTINGS = ("photons", "read_noise", "background", "diameter", "shifts", "leakage", "blur", "focus", "offsets")


def exposed(photons):
    """The bench with a shorter exposure."""
    return replace(BENCH, photons=photons, background=BENCH.background * photons / BENCH.photons)


def made():
    """All arrays of the file."""
    frames, clear, commands = BENCH.recording()
    errors, photons = np.repeat([RMS, PHOTONS], N_SCREENS, axis=1)
    screens = [BENCH.smooth(rms, seed=300 + number) for number, rms in enumerate(errors)]
    exposures = enumerate(zip(screens, photons, strict=True))
    # The plain route has the grid of the first image, where the pupil is not in the middle.
    first = replace(BENCH, blur=0.0, fluxes=(1.0, 1.0))
    return {
        "frames": _counts(frames),
        "clear_frames": _counts(clear),
        "commands": _phases(commands),
        "unseen_frames": _counts([exposed(light).counts(screen, (8, k)) for k, (screen, light) in exposures]),
        "unseen": _phases([BENCH.on_pupil(screen + BENCH.flat) for screen in screens]),
        "unseen_on_camera": _phases([first._recorded(screen + BENCH.flat, 0) for screen in screens]),
        "lit": BENCH.fully_lit,
        "lit_on_camera": first._recorded(BENCH.lit, 0) > 0.999,
        "unseen_rms": errors,
        "unseen_photons": photons,
        "gain": np.array(GAIN),
        **{name: np.array(getattr(BENCH, name)) for name in SETTINGS},
    }


def _counts(electrons):
    return np.rint(np.asarray(electrons) / GAIN).astype(np.int16)


def _phases(phases):
    return np.rint(np.asarray(phases) / UNIT).astype(np.int16)


if __name__ == "__main__":
    np.savez_compressed(FILE, **made())
    print(f"{FILE.name}: {FILE.stat().st_size} bytes")
