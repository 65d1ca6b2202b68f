"""A simulated bench: a segmented mirror and a vector-Zernike sensor with the errors that the paper names."""

from typing import TYPE_CHECKING

from zwfs import _lazy

if TYPE_CHECKING:
    from zwfs.bench.files import bench_error, write_bench
    from zwfs.bench.model import Bench, BenchModel, segment_residual, segment_screens
else:
    __getattr__, __dir__ = _lazy.offer(__name__)

__all__ = [
    "Bench",
    "BenchModel",
    "bench_error",
    "segment_residual",
    "segment_screens",
    "write_bench",
]
