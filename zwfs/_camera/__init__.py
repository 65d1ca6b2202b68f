"""One model of a camera behind two masks, its calibration from known commands, and the phases that it measures."""

from zwfs._camera.bench import BenchFit, Estimate, fit_bench
from zwfs._camera.sensor import FittedPhase, FittedSensor

__all__ = ["BenchFit", "Estimate", "FittedPhase", "FittedSensor", "fit_bench"]
