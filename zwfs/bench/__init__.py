"""A simulated bench: a segmented mirror and a vector-Zernike sensor with the errors that the paper names."""

from zwfs.bench.model import Bench, BenchModel, segment_screens
from zwfs.bench.recording import bench_error, write_bench
from zwfs.bench.segments import segment_pistons, segment_residual

__all__ = [
    "Bench",
    "BenchModel",
    "bench_error",
    "segment_pistons",
    "segment_residual",
    "segment_screens",
    "write_bench",
]
