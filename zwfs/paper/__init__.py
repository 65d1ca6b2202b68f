"""The experiments of the paper, and those beyond it: one module for each section or group of figures."""

from zwfs.paper import (
    bandwidth,
    bench_linearity,
    calibration,
    closed_loop,
    dark_zone,
    design,
    dimple_diameter,
    identities,
    linearity,
    one_pixel,
    phase_amplitude,
    phase_shifts,
    photon_noise,
    recovery,
)

__all__ = [
    "bandwidth",
    "bench_linearity",
    "calibration",
    "closed_loop",
    "dark_zone",
    "design",
    "dimple_diameter",
    "identities",
    "linearity",
    "one_pixel",
    "phase_amplitude",
    "phase_shifts",
    "photon_noise",
    "recovery",
]
