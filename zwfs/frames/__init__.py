"""Camera files to phase.

`files` reads and writes, `registration` locates the pupils, `pipeline` reconstructs a pair of frames, `verdict`
judges the result, and `order` finds which image has which phase shift. `calibration` keeps the constants of a
bench, and `telemetry` reconstructs files of any length with them. The command is `python -m zwfs.frames`.
`joint` fits one model, `optics_model`, to all images of a recording; `bench_fit` takes a model of a bench from
frames of a mirror in known states.
"""

from zwfs.frames import (
    bench_fit,
    calibration,
    files,
    joint,
    optics_model,
    order,
    pipeline,
    registration,
    telemetry,
    verdict,
)
from zwfs.frames.bench_fit import FittedSensor, fit_bench
from zwfs.frames.calibration import Calibration, calibrate
from zwfs.frames.order import order_of_images
from zwfs.frames.telemetry import reconstruct
from zwfs.frames.verdict import CameraNoise, judge

__all__ = [
    "Calibration",
    "CameraNoise",
    "FittedSensor",
    "bench_fit",
    "calibrate",
    "calibration",
    "files",
    "fit_bench",
    "joint",
    "judge",
    "optics_model",
    "order",
    "order_of_images",
    "pipeline",
    "reconstruct",
    "registration",
    "telemetry",
    "verdict",
]
