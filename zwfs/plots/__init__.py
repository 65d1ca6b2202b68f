"""The figures: one function for each, and the style that they share. Only this subpackage needs matplotlib."""

from zwfs.plots.at_a_glance import at_a_glance
from zwfs.plots.bandwidth import band_errors
from zwfs.plots.bench import bench_linearity, budget, measured_and_modelled, reference_intensities, segment_errors
from zwfs.plots.calibration import calibration_errors, calibration_frames
from zwfs.plots.closed_loop import capture, loop_runs
from zwfs.plots.dark_zone import held_drift
from zwfs.plots.dimple_diameter import diameter_methods, diameter_reasons, dimple_diameter
from zwfs.plots.frames import explained, gains, phase_map, signs
from zwfs.plots.grids import grid_slice
from zwfs.plots.identities import approximation, diversity
from zwfs.plots.layouts import bench_layout, sensor_layout, vector_sensor
from zwfs.plots.linearity import convergence, estimates, linearity, saxton_widths
from zwfs.plots.one_pixel import one_or_two_images, pixel_phasors, sensor_steps
from zwfs.plots.phase_amplitude import amplitude_errors, phase_and_amplitude
from zwfs.plots.phase_shifts import all_pairs, pair_noise
from zwfs.plots.photon_noise import design_maps, error_bars, photon_noise
from zwfs.plots.recovery import dimple_limits, dimple_recovery, range_recovery, range_starts
from zwfs.plots.style import (
    INTENSITY_MAP,
    LOOKS,
    OTHER_STYLES,
    PHASE_MAP,
    Look,
    show_intensity,
    show_phase,
    use_style,
)

__all__ = [
    "INTENSITY_MAP",
    "LOOKS",
    "OTHER_STYLES",
    "PHASE_MAP",
    "Look",
    "all_pairs",
    "amplitude_errors",
    "approximation",
    "at_a_glance",
    "band_errors",
    "bench_layout",
    "bench_linearity",
    "budget",
    "calibration_errors",
    "calibration_frames",
    "capture",
    "convergence",
    "design_maps",
    "diameter_methods",
    "diameter_reasons",
    "dimple_diameter",
    "dimple_limits",
    "dimple_recovery",
    "diversity",
    "error_bars",
    "estimates",
    "explained",
    "gains",
    "grid_slice",
    "held_drift",
    "linearity",
    "loop_runs",
    "measured_and_modelled",
    "one_or_two_images",
    "pair_noise",
    "phase_and_amplitude",
    "phase_map",
    "photon_noise",
    "pixel_phasors",
    "range_recovery",
    "range_starts",
    "reference_intensities",
    "saxton_widths",
    "segment_errors",
    "sensor_layout",
    "sensor_steps",
    "show_intensity",
    "show_phase",
    "signs",
    "use_style",
    "vector_sensor",
]
