"""Camera files to phase.

A `Calibration` holds all that is known of a bench: made from files, from arrays, or from known commands, it
reconstructs a pair of frames or a stack, and `reconstruct` with it files of any length. Its result is `Phases`,
with flags. Its `controller` turns camera counts into commands of a mirror. `phase_of` gives a first look in one
call. The command is `python -m zwfs.frames`.

Step by step: `files` reads and writes, `registration` locates the pupils, `pipeline` reduces a pair of frames,
`refine` fits single parameters of the optics to it, `recover_phase` reconstructs it, and `judge` judges the
result.

Examples
--------
From files of the simulated bench to a phase:

>>> import tempfile
>>> from zwfs.bench import Bench, write_bench
>>> from zwfs.frames import recover_phase
>>> from zwfs.frames.files import read_all, write_phase
>>> from zwfs.frames.pipeline import Optics, predict_other, reduce_frames, upside_down
>>> from zwfs.frames.refine import fit, steps
>>> from zwfs.frames.registration import register_frames
>>> bench, folder = Bench(n_pixels=40), tempfile.TemporaryDirectory()
>>> files = write_bench(folder.name, bench, seed=1)
>>> frames, clear_frames, sources = read_all([files["frame"]], [files["pupils"]], [files["dark"]])
>>> registered = register_frames(frames, clear_frames)
>>> round(registered.diameter), registered.n_pixels
(40, 43)
>>> optics = Optics(bench.diameter, (bench.phase, -bench.phase))
>>> measurement = reduce_frames(registered, optics)
>>> bool((predict_other(measurement) > predict_other(upside_down(measurement))).all())
True
>>> phases = recover_phase(measurement)
>>> bool(phases.converged), phases.phase.shape
(True, (43, 43))
>>> write_phase(f"{folder.name}/phase.fits", phases, 635.0, sources)
>>> bool(0.8 < fit(registered, optics, ["scale"], n_steps=2)[1].scale < 1.2)
True
>>> [step.name for step in steps(frames, clear_frames, optics, fitted=())][-1]
'balance of the flux'
>>> folder.cleanup()
"""

from typing import TYPE_CHECKING

from zwfs import _lazy

if TYPE_CHECKING:
    from zwfs.frames import (
        calibration,
        controller,
        files,
        phases,
        pipeline,
        refine,
        registration,
        telemetry,
        verdict,
    )
    from zwfs.frames._blocks import FileError
    from zwfs.frames._fit import BenchFit, Estimate
    from zwfs.frames.calibration import Calibration
    from zwfs.frames.controller import Controller, PhaseController
    from zwfs.frames.phases import Phases
    from zwfs.frames.pipeline import phase_of, recover_phase
    from zwfs.frames.telemetry import reconstruct
    from zwfs.frames.verdict import CameraNoise, judge, order_of_images
else:
    __getattr__, __dir__ = _lazy.offer(__name__)

__all__ = [
    "BenchFit",
    "Calibration",
    "CameraNoise",
    "Controller",
    "Estimate",
    "FileError",
    "PhaseController",
    "Phases",
    "calibration",
    "controller",
    "files",
    "judge",
    "order_of_images",
    "phase_of",
    "phases",
    "pipeline",
    "reconstruct",
    "recover_phase",
    "refine",
    "registration",
    "telemetry",
    "verdict",
]
