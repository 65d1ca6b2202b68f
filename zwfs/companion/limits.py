"""The limits of the parameters of the notebooks, by notebook; see `zwfs.companion.parameters.check_parameters`."""

from __future__ import annotations

from typing import Any

from zwfs.companion.parameters import Fields

_CUT = {"obstruction": (0.0, 0.9), "vanes": [[(-6.2832, 6.2832)], ...]}
_RINGS = _CUT | {"n_rings": (1, 50), "gap": (0.0, 0.1), "missing": [(1, 10000), ...], "stop": (0.1, 1.0)}
_BASIS = {"basis": ("zernike", "fourier", "hexagonal", "kl")}
_SETUP = {
    "pupil": Fields(
        "zwfs.paper.setups.make_pupil",
        kinds={
            "circular": _CUT,
            "vlt": _CUT,
            "hexagonal": _RINGS,
            "keck": _RINGS,
            "elt": _RINGS,
            "seal": _RINGS,
            "file": {"file": str},
        },
    ),
    "screens": Fields(
        "zwfs.paper.setups.make_screens",
        _BASIS,
        {
            "power_law": {},
            "kolmogorov": {},
            "von_karman": {"outer_scale": (0.2, 1e5)},
            "segments": {},
            "file": {"file": str},
        },
    ),
    "noise": Fields("zwfs.paper.setups.Noise", {"photons": (0.0, 1e12), "read_noise": (0.0, 1e6)}),
    "reconstructors": [str, ...],
}


_BENCH = {
    "n_pixels": (32, 1024),
    "extent": (1.0, 4.0),
    "n_rings": (1, 10),
    "gap": (0.0, 0.2),
    "missing": [(1, 1000), ...],
    "stop": (0.1, 1.0),
    "diameter": (0.1, 8.0),
    "phase": (0.01, 3.13),
    "illumination": (0.0, 1.9),
    "leakage": (0.0, 0.5),
    "focus_difference": (0.0, 0.01),
    "misregistration": (0.0, 10.0),
    "blur": (0.0, 20.0),
    "flux_imbalance": (-0.9, 0.9),
    "dimple_error": (-0.9, 10.0),
    "static": (0.0, 3.0),
    "quilting": (0.0, 3.0),
    "photons": (0.0, 1e18),
    "read_noise": (0.0, 1e6),
    "background": (0.0, 1e12),
    "seed": (0, 4294967295),
    "focus": [(-0.01, 0.01), ...],
    "astigmatism": (-0.01, 0.01),
    "unmodulated": (0.0, 0.9),
    "coherent": (0.0, 0.49),
    "halo": (0.0, 10.0),
    "subpixels": (1, 16),
}


def _bench(*others: str) -> Fields:
    """Limits of the fields of the bench, but for those that are parameters of the notebook."""
    return Fields("zwfs.bench.model.Bench", {name: limit for name, limit in _BENCH.items() if name not in others})


_USUAL = {
    "n_pixels": (16, 1024),
    "n_modes": (1, 1000),
    "diameter": (0.1, 8.0),
    "phase_shift": (0.01, 3.13),
    "rms": (0.0, 4.0),
    "rms_max": (0.05, 4.0),
    "n_rms": (2, 200),
    "rms_fine": [(0.0, 4.0), ...],
    "inputs": [(0.001, 4.0)],
    "n_screens": (1, 1000),
    "exponent": (-6.0, 0.0),
    "n_iterations": (1, 10000),
    "extent": (1.0, 8.0),
    "threshold": (0.001, 1.0),
}
_FITTED = "registration", "scale", "background", "diameter", "leakage", "unmasked", "pupil_background"


def _limits(usual: str = "", **own: Any) -> dict[str, Any]:
    """Limits of one notebook: the usual ones of the named parameters, its own ones, and those of the seed."""
    return {name: _USUAL[name] for name in usual.split()} | own | {"seed": (0, 4294967295)}


LIMITS: dict[str, dict[str, Any]] = {
    "at_a_glance": _limits("n_pixels n_modes diameter phase_shift rms exponent n_iterations"),
    "bandwidth": _limits(
        "n_modes diameter phase_shift inputs n_screens exponent",
        n_pixels=(16, 200),
        bandwidths=[(0.0, 1.0)],
        photons=(1.0, 1e9),
    ),
    "beyond_dimple": _limits(
        "n_pixels n_modes phase_shift inputs n_screens exponent n_iterations threshold",
        step=(0.05, 2.0),
        diameter_min=(0.1, 1.0),
        diameter_max=(3.5, 8.0),
        step_fine=(0.01, 0.3),
        n_screens_few=(1, 100),
    ),
    "beyond_range": _limits(
        "n_pixels n_modes phase_shift inputs n_screens exponent n_iterations threshold", diameters=[(0.1, 8.0)]
    ),
    "calibration": _limits(
        "inputs n_screens n_iterations",
        n_pixels=(32, 200),
        extent=(1.1, 2.0),
        n_commands=(2, 50),
        rms_commands=(0.05, 2.0),
        photons=(100.0, 1e9),
    ),
    "closed_loop": _limits(
        "n_modes diameter phase_shift n_screens exponent n_iterations",
        n_pixels=(16, 200),
        rms=(0.01, 4.0),
        speed=(0.0, 100.0),
        cutoff=(1.0, 20.0),
        rate=(1.0, 1e5),
        n_steps=(3, 100000),
        gain=(0.01, 1.99),
        delay=(1, 10),
        stroke=(0.1, 100.0),
        magnitudes=[(-5.0, 20.0)],
        photons_zero=(1.0, 1e12),
        inputs=[(0.01, 4.0)],
        n_steps_capture=(3, 100000),
    ),
    "dark_zone": _limits(
        "n_modes diameter phase_shift",
        n_pixels=(16, 100),
        diameter_best=(0.1, 8.0),
        phase_shift_best=(0.01, 3.13),
        drift=(0.001, 1000.0),
        wavelength=(100.0, 20000.0),
        photons=[(1e4, 1e16)],
        photons_gain=[(1e4, 1e16)],
        gains=[(0.01, 1.5)],
        n_cycles=(4, 10000),
        n_screens=(1, 1000),
    ),
    "design": _limits(
        "n_modes inputs n_screens exponent",
        n_pixels=(16, 200),
        step=(0.05, 1.0),
        diameter_max=(2.0, 8.0),
        n_angles=(2, 100),
        added=(-1.0, 1.0),
    ),
    "error_budget": _limits(
        "inputs n_screens n_iterations",
        n_pixels=(32, 1024),
        leakages=[(0.0, 0.49), ...],
        bench=_bench("n_pixels"),
    ),
    "fig01_sensor_layout": _limits("n_pixels diameter rms", phase_shift=(-6.2832, 6.2832)),
    "fig02_vector_sensor": _limits("n_pixels diameter phase_shift rms"),
    "fig03_dynamic_range": _limits(
        "n_pixels n_modes diameter phase_shift rms_max n_rms rms_fine n_screens exponent n_iterations extent "
        "threshold",
        rms_beyond=[(0.0, 4.0), ...],
        extents=[(1.0, 8.0)],
        **_SETUP,
    ),
    "fig04_dimple_diameter": _limits(
        "n_pixels phase_shift n_screens exponent n_iterations extent threshold",
        n_modes=(149, 1000),
        rms=(0.01, 4.0),
        more_iterations=[(1, 10000)],
        step=(0.05, 2.0),
        diameter_max=(3.5, 8.0),
        step_fine=(0.01, 0.3),
        n_screens_few=(1, 1000),
        claimed=(0.1, 8.0),
        **_SETUP,
    ),
    "fig05_seal_bench": _limits("rms exponent", wavelength=(100.0, 20000.0), bench=_bench()),
    "fig06_reference": _limits(n_pixels=(32, 1024), bench=_bench("n_pixels")),
    "fig07_frames": _limits("rms exponent n_iterations", n_pixels=(32, 1024), bench=_bench("n_pixels")),
    "fig08_segments": _limits("rms exponent n_iterations", n_pixels=(32, 1024), bench=_bench("n_pixels")),
    "fig09_bench_linearity": _limits(
        "rms_max n_rms rms_fine n_screens exponent n_iterations",
        n_pixels=(32, 1024),
        extent=(1.0, 4.0),
        poke=(0.001, 1.5),
        bench=_bench("n_pixels", "extent"),
    ),
    "identities": _limits(
        "n_pixels n_modes diameter rms inputs n_screens",
        patch_diameter=(0.1, 8.0),
        n_shifts=(4, 96),
        largest_phase=(0.1, 3.14),
        resolution=(1e-15, 0.001),
    ),
    "own_frames": _limits(
        "n_iterations rms",
        frame_files=[str, ...],
        pupil_files=[str, ...],
        dark_files=[str, ...],
        bad_pixel_files=[str, ...],
        wavelength=(0.0, 1e5),
        diameter=(0.0, 8.0),
        phase_shifts=[(-6.2832, 6.2832), ...],
        pupil_centers=[[(0.0, 1e5)], ...],
        pupil_diameter=(0.0, 1e5),
        exposure_ratio=(1e-6, 1e6),
        saturation=(0.0, 1e12),
        gain=(0.0, 1e6),
        read_noise=(0.0, 1e6),
        fitted=[_FITTED, ...],
        accept_fits=bool,
        output=str,
        overwrite=bool,
        n_bad=(0, 2000),
    ),
    "phase_amplitude": _limits(
        "n_modes diameter phase_shift rms n_screens exponent",
        n_pixels=(16, 200),
        variations=[(0.0, 0.4)],
        shown=(0.0, 0.4),
        photons=(1.0, 1e9),
    ),
    "phase_shift_pairs": _limits(
        "n_pixels n_modes diameter rms n_screens exponent",
        n_quarter=(1, 50),
        n_iterations=(2, 10000),
        photons=(1.0, 1e12),
        n_draws=(2, 10000),
    ),
    "photon_noise": _limits(
        "n_modes diameter phase_shift inputs n_screens exponent n_iterations extent",
        n_pixels=(16, 200),
        diameter_wide=(0.1, 8.0),
        photons=[(1.0, 1e9)],
        photons_bars=(10.0, 1e9),
        wrong=[(0.01, 100.0)],
    ),
    "reconstructors": _limits(
        "n_pixels n_modes diameter phase_shift inputs n_screens exponent n_iterations extent"
    ),
    "zernike_sensor": {name: _USUAL[name] for name in ("n_pixels", "diameter", "phase_shift")}
    | {"height": (0.1, 3.0)},
}

TOGETHER = dict.fromkeys(("fig03_dynamic_range", "fig04_dimple_diameter"), "zwfs.paper.setups.check_setup") | {
    name: "zwfs.paper.bench_linearity.check_bench" for name, limits in LIMITS.items() if "bench" in limits
}
"""Full name of the function that refuses contradictory values, by notebook; it is called with all parameters."""
