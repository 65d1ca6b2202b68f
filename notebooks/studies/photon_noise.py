"""Photon noise of the reconstructors next to the Cramer-Rao bound, and a check of error bars. Not in the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded, screen_columns
from studies.kit.setups import screens_at
from studies.kit.style import LOOKS, OTHER_STYLES
from studies.kit.tables import Table, Text
from zwfs.bounds import cramer_rao
from zwfs.detector import Detector
from zwfs.metrics import reconstruction_error, wrapped_residual
from zwfs.reconstructors import LikelihoodReconstruction, MaximumLikelihood
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_modes diameter phase_shift inputs n_screens exponent n_iterations extent",
    n_pixels=(16, 200),
    diameter_wide=(0.1, 8.0),
    photons=[(1.0, 1e9)],
    photons_bars=(10.0, 1e9),
    wrong=[(0.01, 100.0)],
)
QUICK = {"photons": [10.0, 1e3, 1e5], "n_screens": 2}

SIGMAS = np.arange(0.25, 3.01, 0.25)
"""Widths of the error bars whose share of the points is counted, in standard errors."""
EXPECTED = erf(SIGMAS / np.sqrt(2))
"""Share of the points within `SIGMAS`, for Gaussian errors and true standard errors."""


@dataclass(frozen=True)
class PhotonCurves:
    """Errors of reconstructors on noisy frames, next to the bound."""

    rms: NDArray[np.floating]  # (n_rms,), input, radian rms
    photons: NDArray[np.floating]  # (n_photons,), per point and image of the sensor with the bound
    errors: dict[str, NDArray[np.float64]]  # (n_rms, n_photons, n_screens), radian rms
    bound: NDArray[np.float64]  # (n_rms, n_photons, n_screens), rms over the points, radian
    within: NDArray[np.float64]  # (n_rms, n_photons), share of the points within one standard error

    def error(self, name: str) -> NDArray[np.float64]:
        """Error of a reconstructor, median over the screens, shape (n_rms, n_photons), radian rms."""
        return np.median(self.errors[name], axis=-1)

    def ratio(self, name: str) -> NDArray[np.float64]:
        """Error over the bound, median over the screens, shape (n_rms, n_photons)."""
        return np.median(self.errors[name] / self.bound, axis=-1)

    def screens(self) -> dict[str, NDArray]:
        """Input, photons and errors of every single screen, as columns for `publish`."""
        axes = {"input (rad rms)": self.rms, "photons per point and image": self.photons}
        return screen_columns(axes, {f"{name}: error (rad rms)": errors for name, errors in self.errors.items()})


def photon_curves(
    sensor: ZernikeSensor,
    reconstructors: Mapping[str, Any],
    modes: NDArray,
    rms: ArrayLike,
    photons: ArrayLike,
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> PhotonCurves:
    """Error of reconstructors against the photons per point and image of a sensor, and its bound.

    Other sensors get the same light in all their images together.
    """
    rms, photons = np.asarray(rms, float), np.asarray(photons, float)
    shared = sensor, dict(reconstructors), modes, n_screens, exponent, seed
    cells = product(enumerate(rms.tolist()), enumerate(photons.tolist()))
    points = sweeps.table(_photon_point, cells, *shared, name="photon_curves")
    shape = rms.size, photons.size
    errors = {name: error.reshape(*shape, n_screens) for name, error in points["errors"].items()}
    bound, within = points["bound"].reshape(*shape, n_screens), points["within"].reshape(shape)
    return PhotonCurves(rms, photons, errors, bound, within)


def _photon_point(
    cell: tuple[tuple[int, float], tuple[int, float]],
    sensor: ZernikeSensor,
    reconstructors: dict[str, Any],
    modes: NDArray,
    n_screens: int,
    exponent: float,
    seed: int,
) -> dict[str, Any]:
    """One input and number of photons: errors by name, and bound, (n_screens,), and share within one sigma."""
    (task, rms), (place, photons) = cell
    screens = screens_at(modes, rms, n_screens, seed, task, exponent)
    likely = MaximumLikelihood(sensor, photons=photons)
    errors = {}
    for name, method in (reconstructors | {"MaximumLikelihood": likely}).items():
        noise = np.random.SeedSequence(seed, spawn_key=(task, place))
        share = photons * sensor.n_masks / method.sensor.n_masks
        estimate = method(_noisy(method.sensor, screens, share, noise))
        errors[name] = reconstruction_error(sensor.pupil, estimate.phase, screens)
    within = np.mean(_in_sigmas(sensor, estimate, screens) < 1)
    bound = sensor.pupil.gather(cramer_rao(sensor, screens, photons=photons))
    return {"errors": errors, "bound": np.sqrt(np.mean(bound**2, axis=-1)), "within": float(within)}


class ErrorBars(NamedTuple):
    """Standard errors of `MaximumLikelihood`, compared with the errors."""

    assumed: float  # photons that the method assumes, over the right number
    within: NDArray[np.float64]  # share of the points within each of `SIGMAS`
    consistent: float  # share of the screens


def error_bars(
    sensor: ZernikeSensor,
    modes: NDArray,
    rms: Sequence[float],
    photons: float,
    assumed: Sequence[float],
    n_screens: int,
    *,
    exponent: float = -2.0,
    seed: int = 0,
) -> list[ErrorBars]:
    """Count the points within the error bars of `MaximumLikelihood`, with right and wrong numbers of photons."""
    inputs = enumerate(rms)
    screens = np.concatenate([screens_at(modes, value, n_screens, seed, task, exponent) for task, value in inputs])
    frames = _noisy(sensor, screens, photons, seed)
    rows = []
    for factor in assumed:
        method = MaximumLikelihood(sensor, photons=factor * photons, n_starts=1)
        estimate = method(frames)
        error = _in_sigmas(sensor, estimate, screens)
        within = np.mean(error[..., np.newaxis] < SIGMAS, axis=(0, 1))
        rows.append(ErrorBars(factor, within, float(estimate.consistent.mean())))
    return rows


def _noisy(sensor: ZernikeSensor, screens: NDArray, photons: float, seed: Any) -> NDArray[np.float64]:
    """Frames with photon noise, for a number of photons per point and image."""
    camera = Detector(photons)
    return camera.normalise(camera.expose(sensor.measure(screens), seed))


def _in_sigmas(
    sensor: ZernikeSensor, estimate: LikelihoodReconstruction, screens: NDArray
) -> NDArray[np.floating]:
    """Error of each point over its standard error, (n_screens, n_points)."""
    residual = wrapped_residual(sensor.pupil, estimate.phase, screens)
    return sensor.pupil.gather(np.abs(residual) / estimate.sigma)


_FINE = 1.3  # error over bound up to which the scale is linear, and wide; above it is logarithmic


def _stretch(ratio: NDArray) -> NDArray[np.float64]:
    """Position on the axis of an error over the bound."""
    return np.where(ratio < _FINE, (ratio - 1) / (_FINE - 1), 1 + 0.6 * np.log10(np.maximum(ratio, _FINE) / _FINE))


def _shrink(position: NDArray) -> NDArray[np.float64]:
    """Error over the bound at a position."""
    return np.where(position < 1, 1 + (_FINE - 1) * position, _FINE * 10 ** ((np.maximum(position, 1) - 1) / 0.6))


def draw_photon_noise(curves: PhotonCurves) -> Figure:
    """Error of each method over the bound, against the number of photons; one panel for each input."""
    size = curves.rms.size
    ratios = [curves.ratio(name) for name in curves.errors]
    lowest, highest = np.nanmin(ratios), np.nanmax(ratios)
    figure, panels = plt.subplots(1, size, figsize=(7, 3.6), sharex=True, sharey=True, squeeze=False)
    for place, axes in enumerate(panels[0]):
        axes.axhline(1, color="#999999", lw=5, label="bound", zorder=1)  # the grid is below
        axes.axhspan(_FINE, 1.5 * max(highest, _FINE), color="#eeeeee", lw=0, zorder=0)
        for name in sorted(curves.errors, key=list(LOOKS).index):
            look, ratio = LOOKS[name], curves.ratio(name)[place]
            axes.semilogx(curves.photons, ratio, ms=5, label=look.label, **look.style)
        axes.set_yscale("function", functions=(_stretch, _shrink))
        axes.set_yticks([1, 1.1, 1.2, _FINE, 10, 100], ["1", "1.1", "1.2", f"{_FINE:g}", "10", "100"])
        axes.set_ylim(0.95 * min(lowest, 0.98), 1.5 * max(highest, _FINE))
        axes.set_title(f"input {curves.rms[place]:g} rad rms", fontsize=10)
        axes.set_xlabel("photons per point\nand image")
    panels[0, 0].set_ylabel("error / bound")
    last = panels[0, -1]
    style: dict[str, Any] = {"transform": last.get_yaxis_transform(), "ha": "right", "color": "#444444"}
    last.text(0.97, _FINE * 1.06, "logarithmic", va="bottom", **style)
    last.text(0.97, _FINE - 0.01, "linear", va="top", **style)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def draw_error_bars(rows: Sequence[ErrorBars]) -> Figure:
    """Share of the points within a number of standard errors, next to that of Gaussian errors."""
    figure, axes = plt.subplots(figsize=(6.5, 4))
    axes.plot(SIGMAS, EXPECTED, color="#999999", lw=5, label="Gaussian errors", zorder=0)
    wrong = iter(OTHER_STYLES)
    for row in rows:
        style = LOOKS["MaximumLikelihood"].style if row.assumed == 1 else next(wrong)
        axes.plot(SIGMAS, row.within, ms=6, label=_label(row), **style)
    axes.axvline(1, color="#555555", lw=1, zorder=0.5)
    axes.set(xlabel="width of the error bar (standard errors)", ylabel="share of the points", ylim=(0, 1.02))
    axes.set_xlim(0, SIGMAS[-1] + 0.1)
    axes.legend(loc="lower right")
    return figure


def _label(row: ErrorBars) -> str:
    return "right number of photons" if row.assumed == 1 else f"{row.assumed:g} times the photons assumed"


TABLED = "MaximumLikelihood", "PhaseShifted"


def ratio_table(curves: Mapping[float, PhotonCurves]) -> Table:
    """Error over the bound of two methods, by the diameter of the dimples."""
    photons = next(iter(curves.values())).photons
    return Table(
        ["dimple, input", *(f"{value:g} photons" for value in photons)],
        [
            [f"{diameter:g} λ/D, {rms:g} rad rms", *cells]
            for diameter, case in curves.items()
            for rms, cells in zip(case.rms, _cells(*map(case.ratio, TABLED)), strict=True)
        ],
    )


def _cells(first: NDArray, second: NDArray) -> list[list[str]]:
    """Pairs of numbers, on one line each."""
    rows = zip(first, second, strict=True)
    return [[f"{a:.2f}/{b:.2f}" for a, b in zip(*row, strict=True)] for row in rows]


def findings(curves: PhotonCurves, diameter: float) -> Text:
    """Return how far the errors of the methods are above the bound."""
    bright = _bright(curves)
    likely, shifted = (f"{curves.ratio(name)[:, bright].max():.3g}" for name in TABLED)
    return Text(
        f"**With dimples of {diameter:g} λ/D and at least {curves.photons[bright].min():g} photons per point "
        f"and image, the error of maximum likelihood is at most {likely} times the bound, and that of the "
        f"phase-shifted iteration at most {shifted} times.**"
    )


def findings_wide(curves: Mapping[float, PhotonCurves]) -> Text:
    """Return the errors at the largest input with most photons, by the diameter of the dimples."""
    sentences = []
    for diameter, case in curves.items():
        row, column = np.argmax(case.rms), np.argmax(case.photons)
        likely, shifted = (f"{case.ratio(name)[row, column]:.3g}" for name in TABLED)
        worst = np.max((case.errors["PhaseShifted"] / case.bound)[row, column])
        sentences.append(
            f"- Dimples of {diameter:g} λ/D, at {case.rms[row]:g} rad rms and {case.photons[column]:g} "
            f"photons: the median error is {likely} times the bound with maximum likelihood and {shifted} times "
            f"with the iteration (worst screen: {worst:.3g})."
        )
    return Text("\n".join(sentences))


def findings_bars(rows: Sequence[ErrorBars]) -> Text:
    """Return the shares of the points within one standard error, and of the results called consistent."""
    place = int(np.argmin(np.abs(SIGMAS - 1)))
    shares = [
        f"- {_label(row)}: {row.within[place]:.0%} of the points, and {row.consistent:.0%} of the results are "
        "called consistent."
        for row in rows
    ]
    expected = f"The error should be below one standard error at {EXPECTED[place]:.0%} of the points. It is so at"
    return Text("\n".join([expected, "", *shares]))


def _bright(curves: PhotonCurves) -> NDArray[np.bool_]:
    """Which numbers of photons are at least 100, or the largest."""
    return curves.photons >= min(100, curves.photons.max())


def _more_photons(curves: PhotonCurves, place: int) -> float:
    """Share of photons that the phase-shifted iteration needs beyond those of an estimate at the bound."""
    return float(np.mean(curves.ratio("PhaseShifted")[place, _bright(curves)] ** 2) - 1)


def numbers(curves: PhotonCurves) -> dict[str, float | str]:
    """Return the numbers that pages of the book quote."""
    half = int(np.argmin(np.abs(curves.rms - 0.5)))
    return rounded({"shifted_photons": _more_photons(curves, half)})
