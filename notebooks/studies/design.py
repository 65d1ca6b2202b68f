"""Photons that an error in nanometres takes, with which dimples and which method. Not in the paper."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.parameters import parameter_limits
from studies.kit.style import LOOKS
from studies.kit.tables import Table, Text, with_zeros
from zwfs.bounds import cramer_rao
from zwfs.design import SensorDesign, method_errors

LIMITS = parameter_limits(
    wanted_error=(0.01, 1000.0),
    input_error=(0.0, 10000.0),
    wavelength=(100.0, 20000.0),
    n_modes=(1, 300),
    read_noise=(0.0, 100.0),
    frame_rate=(1e-3, 1e6),
    telescope=(0.01, 100.0),
    throughput=(1e-3, 1.0),
    zero_point=(1e3, 1e15),
    n_pixels=(24, 64),
    n_screens=(2, 1000),
)
QUICK = {"n_pixels": 24, "n_screens": 8}

_LIGHTS = np.logspace(-0.75, 1.25, 7)  # of the figure, over the light of the answer


def CHECK_TOGETHER(*, wanted_error: float, input_error: float, wavelength: float, **_: Any) -> None:
    """Refuse errors that are too large for their wavelength."""
    for name, value, most in (("wanted_error", wanted_error, 0.1), ("input_error", input_error, 1.0)):
        if value > most * wavelength:
            raise ValueError(f"{name} = {value:g}: expected at most {most:g} of the wavelength, {wavelength:g} nm")


@dataclass(frozen=True)
class LightCurves:
    """Errors against the light, nm rms."""

    photons: NDArray[np.float64]  # (n,), per exposure
    errors: dict[str, NDArray[np.float64]]  # (n,) by method, means over screens
    bound: NDArray[np.float64]  # (n,)


def light_curves(
    answer: SensorDesign, wanted_error: float, *, wavelength: float, read_noise: float, seed: int
) -> LightCurves:
    """Errors of the methods for the dimples of an answer, with less light and with more."""
    unit, sensor = wavelength / (2 * np.pi), answer.sensor
    per_point = sensor.n_masks * sensor.pupil.n_points
    middle = answer.photons_per_point
    if not isfinite(middle):  # of the bound alone
        middle = 3 * (_bound(answer, 1.0, 0.0) * unit / wanted_error) ** 2
    lights = middle * _LIGHTS
    points = sweeps.table(_at_light, lights.tolist(), answer, read_noise, seed, name="light_curves")
    bound = points.pop("bound") * unit
    return LightCurves(lights * per_point, {name: errors * unit for name, errors in points.items()}, bound)


def _at_light(light: float, answer: SensorDesign, read_noise: float, seed: int) -> dict[str, float]:
    """Mean error of each method at photons per point and image, and the bound, radian rms."""
    errors = method_errors(
        answer.sensor, answer.screens, photons=light, read_noise=read_noise, modes=answer.modes, seed=seed
    )
    means = {name: float(np.mean(values)) for name, values in errors.items()}
    return means | {"bound": _bound(answer, light, read_noise)}


def _bound(answer: SensorDesign, light: float, read_noise: float) -> float:
    """Cramer-Rao bound of the modes, mean over the screens, radian rms."""
    sigma = cramer_rao(answer.sensor, answer.screens, photons=light, read_noise=read_noise, modes=answer.modes)
    return float(np.mean(np.sqrt(np.sum(sigma**2, axis=-1))))


def findings(answer: SensorDesign, *, wanted_error: float, frame_rate: float, telescope: float) -> Text:
    """Answer in plain sentences."""
    shifts = f"phase shifts of ±{answer.phase_shift / np.pi:.2g}π"
    dimples = f"two dimples of {answer.diameter:.2g} λ/D and {shifts}"
    if answer.method == "none":
        closest = min(answer.errors_nm, key=answer.errors_nm.__getitem__)
        return Text(
            f"**No light is enough for {wanted_error:.3g} nm.** With {dimples}, none of the three methods "
            "reaches this error, even with a thousand times the light that the bound asks for. The closest is "
            f"{_METHODS[closest]}, with {with_zeros(answer.errors_nm[closest])} nm. Reduce the input, or "
            "measure at a longer wavelength."
        )
    return Text(
        f"**{with_zeros(answer.photons_per_exposure)} photons per exposure give an error of "
        f"{with_zeros(answer.errors_nm[answer.method])} nm.** Use {dimples}, and {_METHODS[answer.method]}. "
        f"Each pupil point then has {with_zeros(answer.photons_per_point)} photons in each of the two images. "
        f"At {frame_rate:g} Hz, a telescope of {telescope:g} m collects this light from a star of magnitude "
        f"{answer.magnitude:.1f}. No unbiased method has an error below {with_zeros(answer.bound_nm)} nm at "
        "this light."
    )


def methods_table(answer: SensorDesign, wanted_error: float) -> Table:
    """Error of each method at the light of the answer, and whether it is within 10 % of the wanted one."""
    rows = [
        [LOOKS[name].name, f"zwfs.{name}", with_zeros(error), error <= 1.1 * wanted_error]
        for name, error in answer.errors_nm.items()
    ]
    return Table(["method", "class", "error (nm rms)", "is enough"], rows)


def draw_light(curves: LightCurves, answer: SensorDesign, wanted_error: float) -> Figure:
    """Error of each method, and the bound, against the photons of an exposure, with the answer."""
    figure, axes = plt.subplots(figsize=(7, 4))
    axes.plot(curves.photons, curves.bound, color="#777777", linestyle="--", label="bound")
    for name, errors in curves.errors.items():
        axes.plot(curves.photons, errors, label=LOOKS[name].name, **LOOKS[name].style)
    axes.set(xscale="log", yscale="log", xlabel="photons per exposure", ylabel="error (nm rms)")
    axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}", minor_formatter="")
    axes.axhline(wanted_error, color="#777777", linewidth=1)
    axes.annotate(
        "wanted error",
        (curves.photons[0], wanted_error),
        (0, -4),
        textcoords="offset points",
        va="top",
        fontsize=9,
    )
    if answer.method != "none":
        place = answer.photons_per_exposure, answer.errors_nm[answer.method]
        axes.plot(*place, "o", ms=13, mfc="none", mec="#000000", mew=2, label="answer")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def numbers(answer: SensorDesign, **question: float) -> dict[str, float | str]:
    """Question and answer, for other pages."""
    return {
        **question,
        "photons": with_zeros(answer.photons_per_exposure),
        "method": _METHODS[answer.method],
        "diameter": round(answer.diameter, 2),
        "shift": round(answer.phase_shift / np.pi, 2),
    }


_METHODS = {
    "Linear": "the linear method",
    "PhaseShifted": "the accelerated phase-shifted iteration",
    "MaximumLikelihood": "maximum likelihood",
    "none": "none",
}
