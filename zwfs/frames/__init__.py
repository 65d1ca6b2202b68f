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
From arrays of a simulated bench to a phase:

>>> from zwfs.bench import Bench
>>> from zwfs.frames import Calibration
>>> bench = Bench(n_pixels=40)
>>> calibration = Calibration.from_arrays(bench.frames(), bench.clear_frames(), diameter=bench.diameter)
>>> phases = calibration([bench.frames(seed=seed) for seed in range(3)])
>>> phases.phase.shape, phases.flags.tolist()
((3, 43, 43), [0, 0, 0])
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
