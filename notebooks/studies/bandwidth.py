"""Cost of a wide band: reconstructors that ignore the bandwidth, and one that knows it. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter
from numpy.typing import ArrayLike, NDArray

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded, screen_errors, stacked
from studies.kit.style import LOOKS
from studies.kit.tables import Table, Text, two_digits
from zwfs.bounds import cramer_rao
from zwfs.metrics import reconstruction_error
from zwfs.polychromatic import PolychromaticSensor
from zwfs.reconstructors import MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes diameter phase_shift inputs n_screens exponent",
    n_pixels=(16, 200),
    bandwidths=[(0.0, 1.0)],
    photons=(1.0, 1e9),
)
QUICK = {"n_screens": 1, "bandwidths": [0.0, 0.1, 0.25]}

SHIFTED, IGNORED, KNOWN = "PhaseShifted, ignored", "MaximumLikelihood, ignored", "MaximumLikelihood, known"
"""Ways to reconstruct frames of a band: method, and whether it knows the bandwidth."""
WAYS = {SHIFTED: "PhaseShifted", IGNORED: "MaximumLikelihood", KNOWN: "MaximumLikelihood"}
"""Method of each way."""
IGNORANT = SHIFTED, IGNORED

_WAVELENGTHS = 9  # of the simulated light
_KNOWN_WAVELENGTHS = 3  # of the reconstructor that knows the band: fewer, since it has no exact model of the light
_TOLERANCE = 1e-4  # of the sensor of the bound, which it changes by less than 1e-3


@dataclass(frozen=True)
class BandCurves:
    """Errors against the bandwidth, radian rms."""

    bandwidths: NDArray[np.float64]  # (n,), full width over central wavelength
    errors: dict[str, NDArray[np.float64]]  # (n, n_screens) of each way, with photon noise
    biases: dict[str, NDArray[np.float64]]  # the same of the ways that ignore the bandwidth, without noise
    bound: NDArray[np.float64]  # (n,), over all screens
    photons: float  # per point and image

    def error(self, way: str) -> NDArray[np.float64]:
        """Error of a way, over all screens, (n,)."""
        return _rms(self.errors[way])

    def bias(self, way: str) -> NDArray[np.float64]:
        """Error of a way without noise, over all screens, (n,)."""
        return _rms(self.biases[way])

    def at(self, bandwidth: float) -> int:
        """Place of the sampled bandwidth, but 0, nearest to `bandwidth`: text on it names the sampled one."""
        return int(np.argmin(np.where(self.bandwidths > 0, np.abs(self.bandwidths - bandwidth), np.inf)))


def band_curves(
    sensor: ZernikeSensor,
    screens: NDArray,
    bandwidths: ArrayLike,
    photons: float,
    *,
    chromatic: bool = False,
    seed: int = 0,
) -> BandCurves:
    """Reconstruct frames of a flat spectrum, with and without photon noise."""
    widths = np.asarray(bandwidths, float)
    shared = sensor, screens, photons, chromatic, seed
    points = sweeps.table(_band_point, widths.tolist(), *shared, name="bandwidth")
    return BandCurves(widths, **points, photons=photons)


def _band_point(
    bandwidth: float, sensor: ZernikeSensor, screens: NDArray, photons: float, chromatic: bool, seed: int
) -> dict[str, Any]:
    """Errors with and without noise, (n_screens,) each, and the bound, at one bandwidth."""
    light = PolychromaticSensor.flat_band(sensor, bandwidth, _WAVELENGTHS, chromatic=chromatic)
    informed = PolychromaticSensor.flat_band(sensor, bandwidth, _KNOWN_WAVELENGTHS, chromatic=chromatic)
    methods = {
        SHIFTED: PhaseShifted(sensor, n_iterations=100, accelerate=True),
        IGNORED: MaximumLikelihood(sensor, photons=photons, n_starts=1),
        KNOWN: MaximumLikelihood(informed, photons=photons, n_starts=1),
    }

    def errors(ways: tuple[str, ...], frames: NDArray) -> dict[str, NDArray]:
        return {way: reconstruction_error(sensor.pupil, methods[way](frames).phase, screens) for way in ways}

    clean = light.measure(screens)
    noisy = np.random.default_rng(seed).poisson(photons * clean) / photons
    rough = PolychromaticSensor.flat_band(
        sensor.with_tolerance(_TOLERANCE), bandwidth, _KNOWN_WAVELENGTHS, chromatic=chromatic
    )
    bound = float(_rms(sensor.pupil.gather(cramer_rao(rough, screens, photons=photons)).ravel()))
    return {"errors": errors(tuple(WAYS), noisy), "biases": errors(IGNORANT, clean), "bound": bound}


def _rms(values: NDArray) -> NDArray[np.float64]:
    return np.sqrt(np.mean(values**2, axis=-1))


CaseCurves = Mapping[tuple[float, bool], BandCurves]  # of each input, radian rms, and chromatic or not
_LINES = {"ignored": ("-", None), "known": ("--", "white")}  # and faces of the markers


def draw_band_errors(curves: CaseCurves) -> Figure:
    """Error of each way over the bound: one panel for each input and kind of phase shift."""
    n_columns = len({chromatic for _, chromatic in curves})
    n_rows = len(curves) // n_columns
    figure, panels = plt.subplots(
        n_rows, n_columns, figsize=(7, 1.2 + 2.5 * n_rows), sharex=True, sharey=True, squeeze=False
    )
    for axes, ((rms, chromatic), curve) in zip(panels.flat, curves.items(), strict=True):
        axes.axhline(1, color="#999999", lw=5, solid_capstyle="round", label="bound in the band", zorder=0)
        for name, method in WAYS.items():
            look, way = LOOKS[method], name.rpartition(" ")[2]
            line, face = _LINES[way]
            axes.plot(
                100 * curve.bandwidths, curve.error(name) / curve.bound, label=f"{look.name}, bandwidth {way}",
                color=look.color, marker=look.marker, linestyle=line, markerfacecolor=face, ms=6,
            )  # fmt: skip
        axes.set_title(f"{rms:g} rad rms, {_kind(chromatic)} shifts", fontsize=10)
        axes.set(yscale="log")
    panels[0, 0].yaxis.set_major_locator(FixedLocator([1, 1.5, 2, 3, 5, 10]))
    panels[0, 0].yaxis.set_major_formatter(FormatStrFormatter("%g"))
    panels[0, 0].yaxis.set_minor_formatter(NullFormatter())
    for axes in panels[-1]:
        axes.set_xlabel("bandwidth (%)")
    for axes in panels[:, 0]:
        axes.set_ylabel("error / bound")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _kind(chromatic: bool) -> str:
    return "chromatic" if chromatic else "achromatic"


def band_screens(curves: CaseCurves) -> dict[str, NDArray]:
    """Errors of every single screen."""
    tables = {}
    for (rms, chromatic), curve in curves.items():
        errors = curve.errors | {f"{way}, without noise": bias for way, bias in curve.biases.items()}
        tables[f"{rms:g} rad rms, {_kind(chromatic)}"] = screen_errors("bandwidth", curve.bandwidths, errors)
    return stacked("case", tables)


def findings(curves: CaseCurves) -> Text:
    """Return the cost of an ignored and of a known band."""
    any_curves = next(iter(curves.values()))
    costs = []
    for place in sorted({any_curves.at(0.10), int(np.argmax(any_curves.bandwidths))}):
        least, most = (two_digits(100 * value) for value in _biases(curves, place))
        costs.append(f"{least} to {most} % in a band of {_width(any_curves, place)}")
    worst = max((curve.error(KNOWN) / curve.bound).max() for curve in curves.values())
    return Text(
        "**If the band is ignored, the error of the phase-shifted iteration without noise is, over the input, "
        f"{', and '.join(costs)}. A reconstructor that knows the band stays within {worst:.3g} times the photon "
        "limit.**"
    )


def _biases(curves: CaseCurves, place: int) -> tuple[float, float]:
    """Smallest and largest error without noise of the phase-shifted iteration, over the input."""
    shares = [float(curve.bias(SHIFTED)[place]) / rms for (rms, _), curve in curves.items()]
    return min(shares), max(shares)


def _width(curves: BandCurves, place: int) -> str:
    return f"{100 * curves.bandwidths[place]:g} %"


def costs_table(curves: CaseCurves) -> Table:
    """Error without noise of the reconstructors that ignore the bandwidth, over the input, at three bandwidths."""
    short = {SHIFTED: "phase-shifted", IGNORED: "max. lik."}
    any_curves = next(iter(curves.values()))
    places = sorted({any_curves.at(width) for width in (0.05, 0.10, 0.25)})
    header = [f"{short[way]}, {_width(any_curves, place)}" for way in IGNORANT for place in places]
    rows = [
        [
            f"{rms:g} rad, {_kind(chromatic)}",
            *(f"{curve.bias(way)[place] / rms:.2%}" for way in IGNORANT for place in places),
        ]
        for (rms, chromatic), curve in curves.items()
    ]
    return Table(["input, shifts", *header], rows)


def numbers(curves: CaseCurves) -> dict[str, float | str]:
    """Return the largest error without noise over the input, at each bandwidth but 0."""
    widths = enumerate(next(iter(curves.values())).bandwidths)
    return rounded({f"most_{100 * width:g}": _biases(curves, place)[1] for place, width in widths if width}, ".3g")
