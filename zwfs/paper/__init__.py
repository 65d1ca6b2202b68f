"""The experiments of the paper: one module for each section or group of figures."""

from zwfs.paper import (
    bench_linearity,
    closed_loop,
    dimple_diameter,
    identities,
    linearity,
    phase_shifts,
    recovery,
)

__all__ = [
    "bench_linearity",
    "closed_loop",
    "dimple_diameter",
    "identities",
    "linearity",
    "phase_shifts",
    "recovery",
]
