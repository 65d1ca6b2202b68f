"""Camera files to phase.

`files` reads and writes, `registration` locates the pupils, `pipeline` reconstructs a pair of frames, `verdict`
judges the result, and `order` finds which image has which phase shift. `calibration` keeps the constants of a
bench, and `telemetry` reconstructs files of any length with them. The command is `python -m zwfs.frames`.
"""

from zwfs.frames import calibration, files, order, pipeline, registration, telemetry, verdict
from zwfs.frames.calibration import Calibration, calibrate
from zwfs.frames.order import order_of_images
from zwfs.frames.telemetry import reconstruct
from zwfs.frames.verdict import CameraNoise, judge

__all__ = [
    "Calibration",
    "CameraNoise",
    "calibrate",
    "calibration",
    "files",
    "judge",
    "order",
    "order_of_images",
    "pipeline",
    "reconstruct",
    "registration",
    "telemetry",
    "verdict",
]
