"""From known commands to phases: a calibration, and unseen screens, on a bench that HCIPy simulates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.parameters import USUAL
from studies.kit.results import rounded
from studies.kit.style import LOOKS, OTHER_STYLES
from studies.kit.tables import Table, Text
from zwfs.frames import BenchFit, Calibration, recover_phase
from zwfs.frames.phases import Flag
from zwfs.frames.pipeline import Optics, reduce_frames
from zwfs.frames.registration import Image, register_frames

LIMITS = {
    "n_commands": (1, 4),
    "n_steps": (1, 30),
    "oversampling": (1, 4),
    "largest": (0.1, 1.2),
    "n_screens": (1, 6),
    "n_iterations": USUAL["n_iterations"],
}
QUICK = {
    "n_commands": 2,
    "n_steps": 2,
    "oversampling": 1,
    "largest": 0.3,
    "n_screens": 1,
}

_UNIT = 1e-4  # rad, of the phases in the file
_SHORT = 1.5  # errors over error bars beyond which these count as too small


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of a bench in known states and of screens that the calibration has not seen, less the dark.

    `tests/calibration_frames.py` makes the file.
    """

    arrays: Mapping[str, NDArray]

    @classmethod
    def read(cls) -> Recording:
        """Read the file next to this one."""
        with np.load(Path(__file__).with_suffix(".npz")) as file:
            return cls(dict(file))

    @property
    def frames(self) -> NDArray[np.float64]:
        """Frames of the flat and of known commands, counts, (n_states, 2, ny, nx)."""
        return self.arrays["frames"].astype(float)

    @property
    def clear_frames(self) -> NDArray[np.float64]:
        """Frames with the mask out, counts, (2, ny, nx)."""
        return self.arrays["clear_frames"].astype(float)

    @property
    def commands(self) -> NDArray[np.float64]:
        """Known phases, mean over each pixel, radian, (n_states, n, n)."""
        return self.arrays["commands"] * _UNIT

    @property
    def gain(self) -> float:
        """Electrons per count."""
        return float(self.arrays["gain"])

    @property
    def noise(self) -> float:
        """Noise of a pixel without light, counts rms."""
        return self.noise_at(float(self.arrays["photons"]))

    def noise_at(self, photons: float) -> float:
        """The same for an exposure with other photons per pixel."""
        share = photons / float(self.arrays["photons"])
        return float(np.sqrt(self.arrays["read_noise"] ** 2 + share * self.arrays["background"]) / self.gain)

    def unseen(self, rms: float, photons: float) -> list[int]:
        """Numbers of the unseen screens with this error (rad rms) and light (photons per pixel)."""
        same = (self.arrays["unseen_rms"] == rms) & (self.arrays["unseen_photons"] == photons)
        return np.flatnonzero(same).tolist()

    @cached_property
    def photons(self) -> list[float]:
        """Light of the unseen screens, photons per pixel, the brightest first."""
        return sorted(set(self.arrays["unseen_photons"].tolist()), reverse=True)

    def inputs(self, largest: float) -> NDArray[np.float64]:
        """Errors of the bright unseen screens up to the largest, rad rms."""
        bright = self.arrays["unseen_photons"] == self.photons[0]
        inputs = np.unique(self.arrays["unseen_rms"][bright])
        return inputs[inputs <= largest]

    def shot(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Frames of an unseen screen and their noise, in counts of an exposure as long as the calibration's."""
        photons = float(self.arrays["unseen_photons"][number])
        counts = self.arrays["unseen_frames"][number].astype(float)
        sigma = np.sqrt(np.maximum(counts, 0) / self.gain + self.noise_at(photons) ** 2)
        share = photons / float(self.arrays["photons"])
        return counts / share, sigma / share


def calibrate(recording: Recording, n_commands: int = 4, n_steps: int = 3, oversampling: int = 2) -> Calibration:
    """Fit the bench to the frames of the flat and of known commands."""
    states = slice(n_commands + 1)
    return Calibration.fit(
        recording.frames[states],
        recording.clear_frames,
        recording.commands[states],
        n_pixels=recording.commands.shape[-1],
        noise=recording.noise,
        gain=recording.gain,
        n_steps=n_steps,
        oversampling=oversampling,
    )


class Measured(NamedTuple):
    """Errors of an unseen screen over the pixels that are fully lit, rad rms, and what the calibrated fit says."""

    plain: float
    calibrated: float
    same_prior: float  # with the values of the design and the prior of the calibrated route; NaN without a control
    sigma: float  # error bar that the fit states, rms over the same pixels
    inside: float  # share of these pixels with an error below the error bar
    misfit: float
    consistent: bool
    prior: Any = None  # of the calibrated route


def measure(
    recording: Recording,
    calibration: Calibration,
    series: Sequence[Sequence[int]],
    n_iterations: int = 25,
    *,
    control: bool = False,
) -> list[list[Measured]]:
    """Measure series of unseen screens by the plain route with the design's values, and with the fitted optics.

    The first screen of each series chooses the prior of the others. A control measures this screen again with the
    maps, places and prior of the fit, and the optics of the design.
    """
    benches = calibration, designed(calibration) if control else None
    return sweeps.run(_measure_series, series, recording, *benches, n_iterations, name="calibrated_errors")


def designed(calibration: Calibration) -> Calibration:
    """Return a calibration with a bench of the design: no leakage, no focus, and a blur far below a pixel."""
    design, shares = Optics(), {"leakage": 0.0, "unmasked": 0.0}
    optics = shares | {"blur": 0.02, "arm 0 focus": 0.0, "arm 1 focus": 0.0}
    first, second = design.phase_shifts
    values = optics | {"diameter": design.diameter, "first": first, "second": second}
    return replace(calibration, bench=fitted_bench(calibration).replaced(values))


def fitted_bench(calibration: Calibration) -> BenchFit:
    """Fit of a calibration with known commands."""
    if calibration.bench is None:
        raise ValueError("calibration has no bench: expected a fit to known commands")
    return calibration.bench


def _measure_series(
    numbers: Sequence[int],
    recording: Recording,
    calibration: Calibration,
    design: Calibration | None,
    n_iterations: int,
) -> list[Measured]:
    prior: Any = True
    measured: list[Measured] = []
    for number in numbers:
        measured.append(
            _measure(number, recording, calibration, None if measured else design, n_iterations, prior)
        )
        prior = measured[-1].prior
    return measured


def _measure(
    number: int,
    recording: Recording,
    calibration: Calibration,
    design: Calibration | None,
    n_iterations: int,
    prior: Any,
) -> Measured:
    counts, sigma = recording.shot(number)
    truth, lit = recording.arrays["unseen"][number] * _UNIT, recording.arrays["lit"]
    estimate = calibration(counts, smooth=prior, noise=sigma)
    [prior] = estimate.priors
    residual, bars, same_prior = _error(estimate.phase, truth, lit), np.asarray(estimate.sigma)[lit], np.nan
    if design:
        same_prior = float(_error(design(counts, smooth=prior, noise=sigma).phase, truth, lit).std())
    consistent = not estimate.flags & Flag.INCONSISTENT
    plain = float(_plain(counts, recording, number, n_iterations).std())
    inside = float(np.mean(np.abs(residual) < bars))
    stated = float(np.sqrt(np.mean(bars**2)))
    calibrated = float(residual.std())
    return Measured(
        plain, calibrated, same_prior, stated, inside, float(np.asarray(estimate.misfit)), consistent, prior
    )


def _plain(counts: NDArray, recording: Recording, number: int, n_iterations: int) -> NDArray[np.float64]:
    """Error of the phase-shifted iteration with the values of the design, on the pixels of the first image."""
    frames, clear = (
        [Image(image, np.zeros(image.shape, bool)) for image in pair] for pair in (counts, recording.clear_frames)
    )
    registered = register_frames(frames, clear)
    phase = recover_phase(reduce_frames(registered, Optics()), n_iterations).phase
    window = tuple(slice(first, first + registered.n_pixels) for first in registered.corner)
    lit = recording.arrays["lit_on_camera"][window] & np.isfinite(phase)
    return _error(phase, recording.arrays["unseen_on_camera"][number][window] * _UNIT, lit)


def _error(phase: NDArray, truth: NDArray, lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Error without piston of the pixels that are fully lit."""
    residual = np.exp(1j * (phase - truth)[lit])
    return np.angle(residual * np.conj(residual.mean()))


def known_values(recording: Recording) -> dict[str, float]:
    """Values of the bench by their names in a fit."""
    bench = recording.arrays
    values = {name: float(bench[name]) for name in ("diameter", "leakage", "blur")} | {"unmasked": 0.0}
    values |= {name: float(value) for name, value in zip(("first", "second"), bench["shifts"], strict=True)}
    for arm in (0, 1):
        values[f"arm {arm} focus"] = float(bench["focus"][arm])
        values[f"arm {arm} row"], values[f"arm {arm} column"] = map(float, bench["offsets"][arm])
    return values


_TITLES = {
    "diameter": "diameter of the dimple (λ/D)",
    "first": "phase shift of the first image (rad)",
    "second": "phase shift of the second image (rad)",
    "leakage": "leakage",
    "unmasked": "share of light that no mask shifts",
    "blur": "blur (pixels rms)",
    "arm 0 focus": "focus of the first image (D²/λ)",
    "arm 0 row": "row of the first image (pixels)",
}


def estimate_table(recording: Recording, fit: BenchFit) -> Table:
    """Values of the bench, those fitted, and their differences in units of the error bar."""
    true = known_values(recording)
    rows = []
    for name, title in _TITLES.items():
        value, sigma = fit[name].value, fit[name].sigma
        deviation = (value - true[name]) / sigma
        digits = max(1 - int(np.floor(np.log10(sigma))), 0)
        shown = f"{value:.{digits}f}"
        fitted = f"{shown if float(shown) else 0} ± {sigma:.{digits}f}"
        rows.append([title, f"{true[name]:.5g}", fitted, f"{deviation:+.1f}"])
    return Table(["parameter", "of the bench", "fitted", "deviation (error bars)"], rows)


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors against the input."""

    rms: NDArray[np.float64]  # (n,) rad
    measured: list[list[Measured]]  # for each input, one for each screen

    def single(self, name: str) -> NDArray[np.float64]:
        """Attribute of each screen, (n, n_screens)."""
        return np.array([[getattr(screen, name) for screen in row] for row in self.measured])

    def column(self, name: str) -> NDArray[np.float64]:
        """Root mean square of an attribute over the screens for which it was measured, (n,)."""
        return np.sqrt(np.nanmean(self.single(name) ** 2, axis=1))


def measure_inputs(
    recording: Recording,
    calibration: Calibration,
    largest: float,
    n_screens: int,
    n_iterations: int = 25,
    *,
    control: bool = False,
) -> Errors:
    """Measure the bright unseen screens up to an error, on demand with a control."""
    inputs = recording.inputs(largest)
    series = [recording.unseen(rms, recording.photons[0])[:n_screens] for rms in inputs]
    return Errors(inputs, measure(recording, calibration, series, n_iterations, control=control))


def measure_faint(
    recording: Recording, calibration: Calibration, n_screens: int, n_iterations: int = 25
) -> Errors:
    """Measure the unseen screens with the least light."""
    rms = recording.arrays["unseen_rms"][recording.arrays["unseen_photons"] == recording.photons[-1]][:1]
    series = [recording.unseen(rms[0], recording.photons[-1])[:n_screens]]
    return Errors(rms, measure(recording, calibration, series, n_iterations))


def bulk_errors(recording: Recording, calibration: Calibration, errors: Errors) -> NDArray[np.float64]:
    """Errors of the same screens without a prior, as by `reconstruct`, rad rms."""

    def error(number: int) -> float:
        phase = calibration(recording.shot(number)[0]).phase.astype(float)
        lit = recording.arrays["lit"] & np.isfinite(phase)
        return float(_error(phase, recording.arrays["unseen"][number] * _UNIT, lit).std())

    shots = [recording.unseen(rms, recording.photons[0])[: len(errors.measured[0])] for rms in errors.rms]
    return np.array([np.sqrt(np.mean([error(number) ** 2 for number in series])) for series in shots])


def draw_calibration_errors(errors: Errors, not_smooth: NDArray) -> Figure:
    """Error against the input, with the values of the design and calibrated, and the error bar that is stated.

    `not_smooth` are the errors of the calibrated bench without the assumption of smooth phases.
    """
    figure, axes = plt.subplots(figsize=(6, 4.2))
    names = "plain", "calibrated", "same_prior", "sigma"
    plain, calibrated, control, stated = (errors.column(name) for name in names)
    axes.plot(errors.rms, control, "s--", color="#777777", ms=5, label="design, smooth phases")
    axes.plot(errors.rms, plain, **LOOKS["PhaseShifted"].style, label="design, any phase (iteration)")
    [line] = axes.plot(errors.rms, not_smooth, "D:", color="#333333", mfc="none", ms=6)
    line.set_label("calibrated, any phase (iteration)")
    best = OTHER_STYLES[1]["color"]
    axes.plot(errors.rms, calibrated, "*-", color=best, ms=9, label="calibrated, smooth phases")
    axes.plot(errors.rms, stated, "o", color=best, mfc="none", ms=8, label="error bar that this fit states")
    for name, color in (("plain", LOOKS["PhaseShifted"].color), ("calibrated", best)):
        axes.plot(errors.rms, errors.single(name), "_", color=color, ms=9, label=f"_{name}, single screens")
    axes.set(xlabel="input (rad rms)", ylabel="error (rad rms)", yscale="log", xlim=(0, None))
    axes.yaxis.set(major_formatter="{x:g}", minor_locator=LogLocator(subs=(2, 4, 6)), minor_formatter="{x:g}")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    return figure


def _verdict(fit: BenchFit) -> str:
    return "consistent" if fit.consistent else "not consistent"


def findings(errors: Errors, faint: Errors, photons: Sequence[float], not_smooth: NDArray) -> Text:
    """Say what the fitted model gains on unseen screens, and whether its error bars hold."""
    plain, calibrated = errors.column("plain"), errors.column("calibrated")
    gains, bulk = plain / calibrated, plain / not_smooth
    every = [screen for row in errors.measured for screen in row]
    [faint_plain], [faint_calibrated] = faint.column("plain"), faint.column("calibrated")
    short = errors.rms[calibrated > _SHORT * errors.column("sigma")]
    ratio = calibrated / errors.column("sigma")
    bars = ""
    if short.size:
        listed = ", ".join(f"{rms:.2g}" for rms in short)
        bars = f" At {listed} rad rms the bars are too short: the error is up to {ratio.max():.2g} times the bar."
    return Text(
        f"In bright light ({photons[0]:.0f} photons per point and image), the fitted model and the assumption of "
        "smooth phases together change the error of unseen *screens* (random phase maps) by a factor of "
        f"{1 / gains.max():.2g} to {1 / gains.min():.2g}, compared with the phase-shifted iteration and the "
        "mask's design values. Without the assumption (`calibrate --commands`, diamonds) the factor is "
        f"{1 / bulk.max():.2g} to {1 / bulk.min():.2g}. In faint light ({photons[-1]:.0f} photons), at "
        f"{faint.rms[0]:.2g} rad rms, the error is {faint_calibrated:.2g} instead of {faint_plain:.2g} rad "
        f"rms.\n\nOf the pixels of all bright screens, {np.mean([screen.inside for screen in every]):.0%} have "
        f"an error below their error bar; 68 % are expected.{bars} The verdict is *consistent* for "
        f"{sum(screen.consistent for screen in every)} of {len(every)} bright screens. It tests whether the "
        "model explains the frames, not whether the phase is right."
    )


def numbers(errors: Errors, not_smooth: NDArray) -> dict[str, float | str]:
    """Numbers that other pages quote: an input, its errors, and the pixels within their error bars."""
    place = int(np.argmin(np.abs(errors.rms - 0.8)))
    return rounded(
        {
            "shown": errors.rms[place],
            "plain_error": errors.column("plain")[place],
            "bulk_error": not_smooth[place],
            "calibrated_error": errors.column("calibrated")[place],
            "inside": 100 * float(np.mean([screen.inside for row in errors.measured for screen in row])),
        },
        ".2g",
    )


def fit_findings(fit: BenchFit) -> Text:
    """Say whether the fit explains its frames."""
    remarks = f" Its remarks: {' '.join(fit.remarks)}" if fit.remarks else ""
    return Text(f"The misfit is {np.mean(fit.misfit):.2g}, and the verdict is *{_verdict(fit)}*.{remarks}")
