"""Section 2 of the paper: its equations as printed, tested on simulated waves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.setups import screens_at
from studies.kit.style import OTHER_STYLES
from studies.kit.tables import Table, Text, two_digits
from zwfs.masks import Dimple, Mask
from zwfs.metrics import reconstruction_error, strehl
from zwfs.pupil import Pupil
from zwfs.reconstructors import PhaseShifted
from zwfs.sensor import ZernikeSensor

LIMITS = parameter_limits(
    "n_pixels n_modes diameter rms inputs n_screens",
    patch_diameter=(0.1, 8.0),
    n_shifts=(4, 96),
    largest_phase=(0.1, 3.14),
    resolution=(1e-15, 0.001),
)

BEST, LITERAL = "amplitude × √S", "intensity × √S"
POWERS = {BEST: 0.5, LITERAL: 0.25, "not scaled": 0.0}
"""Powers of the Strehl ratio S by which the common approximation may scale the amplitude of the reference wave."""
QUOTED = {0.1: "01", 0.3: "03", 0.5: "05"}
"""Inputs whose errors the text shows (rad rms), and the ends of the names of these numbers."""


def two_waves(incoming: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Right-hand side of equation (5): intensity of two interfering waves."""
    i_in, i_ref = np.abs(incoming) ** 2, np.abs(reference) ** 2
    return i_ref + i_in + 2 * np.sqrt(i_ref * i_in) * np.cos(np.angle(incoming) - np.angle(reference))


def fourier_waves(pupil: Pupil, mask: Mask, field: NDArray, padding: int = 8) -> tuple[NDArray, NDArray, NDArray]:
    """Equations (1) and (4) word by word, by Fourier transforms of a padded pupil."""
    n = round(padding * pupil.n_pixels)
    incoming = np.zeros((n, n), complex)
    incoming[: pupil.shape[0], : pupil.shape[1]] = np.where(pupil.inside, field, 0)
    u = np.fft.fftfreq(n, 1 / pupil.n_pixels)
    v = u[:, np.newaxis]
    patch = np.hypot(u, v) <= mask.diameter / 2
    transmission = np.where(patch, mask.transmission(u + 0 * v, v + 0 * u), 1)
    spectrum = np.fft.fft2(incoming)
    return np.fft.ifft2(spectrum * transmission), incoming, np.fft.ifft2(spectrum * (transmission - 1))


def direct_reference_wave(pupil: Pupil, mask: Mask, field: NDArray, n_samples: int = 24) -> NDArray[np.complex128]:
    """Equation (4) as a sum over the patch, node by node: exact for a smooth patch, and slow."""
    light = np.where(pupil.inside, field, 0) / pupil.n_pixels**2
    nodes, weights = np.polynomial.legendre.leggauss(n_samples)
    radius = (nodes + 1) * mask.diameter / 4
    angles = np.arange(2 * n_samples) * np.pi / n_samples
    u, v = np.outer(radius, np.cos(angles)).ravel(), np.outer(radius, np.sin(angles)).ravel()
    area = np.outer(weights * radius * mask.diameter / 4, np.full(angles.size, np.pi / n_samples)).ravel()
    waves_x, waves_y = np.exp(2j * np.pi * np.outer(u, pupil.x)), np.exp(2j * np.pi * np.outer(v, pupil.y))
    spectrum = np.einsum("ky,yx,kx->k", waves_y.conj(), light, waves_x.conj(), optimize=True)
    return (waves_y.T * (area * (mask.transmission(u, v) - 1) * spectrum)) @ waves_x


def two_wave_errors(pupil: Pupil, mask: Mask, field: NDArray) -> tuple[float, float]:
    """Largest error of equation (5), and largest difference of the low-rank model from `direct_reference_wave`."""
    outgoing, incoming, reference = fourier_waves(pupil, mask, field)
    intensity_error = np.abs(outgoing) ** 2 - two_waves(incoming, reference)
    low_rank = ZernikeSensor(pupil, mask, tolerance=1e-14).reference_wave(field)[0]
    model_error = low_rank - direct_reference_wave(pupil, mask, field)
    return float(np.abs(intensity_error).max()), float(np.abs(model_error).max())


def arccosine_phase(frame: NDArray, amplitude: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Equation (6): phase from one frame and its reference wave."""
    return np.angle(reference) - np.arccos(np.clip(_cosine(frame, amplitude, reference), -1, 1))


def matrix_determinant(first: NDArray, second: NDArray) -> NDArray[np.floating]:
    """Determinant of the matrix M of equation (9), from its elements."""
    a, b = np.angle(first), np.angle(second)
    return np.cos(a) * np.sin(b) - np.sin(a) * np.cos(b)


def pair_phase(frames: NDArray, amplitude: NDArray, references: NDArray) -> NDArray[np.floating]:
    """Equation (9): phase from two frames and their reference waves."""
    c = _cosine(frames, amplitude, references)
    a, b = np.moveaxis(np.angle(references), -2, 0)
    determinant = matrix_determinant(references[..., 0, :], references[..., 1, :])
    cosine = (np.sin(b) * c[..., 0, :] - np.sin(a) * c[..., 1, :]) / determinant
    sine = (np.cos(a) * c[..., 1, :] - np.cos(b) * c[..., 0, :]) / determinant
    return np.arctan2(sine, cosine)


def _cosine(frame: NDArray, amplitude: NDArray, reference: NDArray) -> NDArray[np.floating]:
    """Cosine of the phase between two waves, as equations (6) and (9) take it from the intensity."""
    amplitude, reference = np.abs(amplitude), np.abs(reference)
    return (frame - reference**2 - amplitude**2) / (2 * reference * amplitude)


@dataclass(frozen=True)
class ApproximationErrors:
    """Errors of an approximate reference wave; means over the screens."""

    phase: float  # of the wave, radian rms
    amplitude: float  # of the wave, relative
    wave: float  # but for a constant phase, relative
    one_image: float  # of one step of reconstruction, radian rms
    two_images: float  # of the same with two images


def approximation_errors(sensor: ZernikeSensor, screens: NDArray, power: float = 0.5) -> ApproximationErrors:
    """Test the common approximation: the wave of a flat wavefront, scaled with a power of the Strehl ratio S."""
    pupil = sensor.pupil
    amplitude = pupil.gather(pupil.amplitude)
    frames = pupil.gather(sensor.measure(screens))
    field = pupil.field(screens)
    true = pupil.gather(sensor.reference_wave(field))
    flat = pupil.gather(sensor.reference_wave(pupil.amplitude))
    guess = strehl(pupil, screens)[:, np.newaxis, np.newaxis] ** power * flat
    first, first_guess = true[:, 0], guess[:, 0]

    def phase_error(phase: NDArray, truth: NDArray) -> float:
        return float(reconstruction_error(pupil, pupil.scatter(phase), truth).mean())

    def relative(gap: NDArray) -> NDArray:
        return np.linalg.norm(gap, axis=-1) / np.linalg.norm(first, axis=-1)

    overlap = np.mean(first * first_guess.conj(), axis=-1, keepdims=True)
    wave = relative(first_guess * overlap / np.abs(overlap) - first)
    return ApproximationErrors(
        phase=phase_error(np.angle(first_guess), pupil.scatter(np.angle(first))),
        amplitude=float(relative(np.abs(first_guess) - np.abs(first)).mean()),
        wave=float(wave.mean()),
        one_image=phase_error(arccosine_phase(frames[:, 0], amplitude, first_guess), screens),
        two_images=phase_error(pair_phase(frames, amplitude, guess), screens),
    )


def claimed_wave_error(
    sensor: ZernikeSensor, modes: NDArray, n_screens: int, seed: int, n_sets: int = 50
) -> tuple[float, float]:
    """Error of the wave at 0.5 rad rms, mean over many sets of screens, and its standard error."""
    sets = (screens_at(modes, 0.5, n_screens, seed, 3 + number) for number in range(n_sets))
    errors = [approximation_errors(sensor, screens).wave for screens in sets]
    return float(np.mean(errors)), float(np.std(errors, ddof=1) / np.sqrt(n_sets))


def approximation_curves(
    sensor: ZernikeSensor, screens: NDArray, inputs: Sequence[float]
) -> dict[str, list[ApproximationErrors]]:
    """Errors of the common approximation with each of `POWERS`, for screens of 1 rad rms scaled to each input."""
    return {
        name: [approximation_errors(sensor, value * screens, power) for value in inputs]
        for name, power in POWERS.items()
    }


@dataclass(frozen=True)
class DimplePairs:
    """Determinants of all pairs of phase shifts on a grid round the circle; means over the pupil."""

    difference: NDArray[np.float64]  # (n_pairs,), second less first, 0 to 2 pi
    determinant: NDArray[np.float64]  # (n_pairs,), modulus, equation (10)
    off_by_pi: float  # share of the points where the waves differ by pi more than half of the difference
    sine_error: float  # largest error of the determinant as a sine
    half_error: float  # largest error of half of the difference, modulo pi


def dimple_pairs(pupil: Pupil, diameter: float, n_shifts: int, field: NDArray) -> DimplePairs:
    """Take the determinant of every pair of dimples of `n_shifts` phase shifts, at every point of the pupil."""
    shifts = 2 * np.pi * np.arange(n_shifts) / n_shifts - np.pi
    shifts = shifts[np.abs(shifts) > 1e-9]
    sensor = ZernikeSensor(pupil, *(Dimple(diameter, theta) for theta in shifts))
    waves = pupil.gather(sensor.reference_wave(field))
    pairs = list(product(range(len(shifts)), repeat=2))
    size, off_by_pi, sine_error, half_error = np.empty((4, len(pairs)))
    for index, (a, b) in enumerate(pairs):
        determinant = matrix_determinant(waves[a], waves[b])
        between = np.angle(waves[b]) - np.angle(waves[a])
        beyond_half = between - (shifts[b] - shifts[a]) / 2
        size[index] = np.abs(determinant).mean()
        off_by_pi[index] = np.mean(np.cos(beyond_half) < 0)
        sine_error[index] = np.abs(determinant - np.sin(between)).max()
        half_error[index] = np.abs(np.sin(beyond_half)).max()
    difference = np.array([shifts[b] - shifts[a] for a, b in pairs]) % (2 * np.pi)
    return DimplePairs(difference, size, float(off_by_pi.mean()), float(sine_error.max()), float(half_error.max()))


def true_wave_errors(sensor: ZernikeSensor, screens: NDArray) -> dict[str, NDArray[np.float64]]:
    """Absolute errors of the phase at each point, from two frames and from one, with the true reference waves."""
    pupil = sensor.pupil
    amplitude, truth = pupil.gather(pupil.amplitude), pupil.gather(screens)
    frames = sensor.measure(screens)
    inside, waves = pupil.gather(frames), pupil.gather(sensor.reference_wave(pupil.field(screens)))
    one_step = PhaseShifted(sensor, n_iterations=1)(frames, start=screens)
    phases = {
        "two images, equation (9)": pair_phase(inside, amplitude, waves),
        "two images, one iteration": pupil.gather(one_step.phase),
        "one image, equation (6)": arccosine_phase(inside[:, 0], amplitude, waves[:, 0]),
    }
    return {name: np.abs(np.angle(np.exp(1j * (phase - truth)))) for name, phase in phases.items()}


Curves = Mapping[str, Sequence[float]]
Errors = Mapping[str, Sequence[ApproximationErrors]]

_FIFTH: dict[str, Any] = {"color": "#777777", "marker": "s", "linestyle": (0, (4, 1))}


def approximation_panels(inputs: Sequence[float], errors: Errors) -> tuple[Curves, Curves]:
    """Errors of the reference wave by what is drawn, and errors of one step with it over the input."""

    def over_input(values: list[float]) -> list[float]:
        return [value / rms for value, rms in zip(values, inputs, strict=True)]

    wave = {"phase (rad rms)": [error.phase for error in errors[BEST]]}
    wave |= {name: [error.amplitude for error in errors[name]] for name in (BEST, LITERAL)}
    steps = {name: over_input([error.two_images for error in case_errors]) for name, case_errors in errors.items()}
    steps[f"{BEST}, one image"] = over_input([error.one_image for error in errors[BEST]])
    return wave, steps


def draw_approximation(rms: Sequence[float], wave: Curves, steps: Curves) -> Figure:
    """Error of approximate reference waves against the input, and of one step of reconstruction with each."""
    figure, panels = plt.subplots(1, 2, figsize=(7.2, 4.0))
    styles = dict(zip(dict.fromkeys([*steps, *wave]), cycle((*OTHER_STYLES, _FIFTH)), strict=False))
    for axes, curves in zip(panels, (wave, steps), strict=True):
        for label, values in curves.items():
            axes.plot(rms, values, markersize=4.5, label=label, **styles[label])
        top = max(max(values) for values in curves.values())
        axes.set(xlabel="input phase (rad rms)", xlim=(0, None), ylim=(0, 1.4 * top))  # room for the legend
        axes.legend(fontsize=8)
    panels[0].set_ylabel("error of the reference wave")
    panels[1].set_ylabel("error of the phase / input")
    return figure


def numbers(
    wave_errors: Mapping[str, tuple[float, float]],
    inputs: Sequence[float],
    approximate: Errors,
    claimed: tuple[float, float],
    pairs: DimplePairs,
    true_wave: Mapping[str, NDArray],
    largest_phase: float,
    resolution: float,
) -> dict[str, float | str]:
    """Numbers that the claims of section 2 rest on."""
    best_pair = int(np.argmax(pairs.determinant.round(9)))
    two_images, one_step, one_image = true_wave.values()
    errors: dict[str, ArrayLike] = {
        "dimple_two_wave_error": wave_errors["dimple"][0],
        "patch_two_wave_error": wave_errors["patch"][0],
        "patch_model_error": wave_errors["patch"][1],
        "determinant_error": pairs.sine_error,
        "half_difference_error": pairs.half_error,
        "diversity_at_0": pairs.determinant[pairs.difference < 1e-9],
        "true_wave_error": two_images,
        "one_step_error": one_step,
    }
    values = {name: _at_least(error, resolution) for name, error in errors.items()} | {
        "pairs_off_by_pi": pairs.off_by_pi,
        "largest_diversity": pairs.determinant[best_pair],
        "best_difference": pairs.difference[best_pair],
        "largest_phase": largest_phase,
        "one_image_error": np.sqrt(np.mean(one_image**2)),
        "claimed_wave_error": claimed[0],
        "claimed_wave_error_error": claimed[1],
    }
    for value, ending in QUOTED.items():
        quoted = approximate[BEST][inputs.index(value)]
        values |= {f"wave_error_{ending}": quoted.wave, f"step_error_{ending}": quoted.two_images}
    for name, short in ((BEST, "wave"), (LITERAL, "literal")):
        values[f"{short}_amplitude_error_05"] = approximate[name][inputs.index(0.5)].amplitude
    return rounded(values, ".5g")


IDENTITIES = {
    "dimple_two_wave_error": "(5): two waves interfere, behind a dimple",
    "patch_two_wave_error": "(5), behind a patch of uneven phase and amplitude",
    "patch_model_error": "low-rank model of the reference wave of this patch",
    "determinant_error": "(10): the determinant is the sine of the difference of the reference phases",
    "half_difference_error": "reference phases differ by half as much as the phase shifts, modulo π (rad)",
    "diversity_at_0": "determinant of equal phase shifts",
    "true_wave_error": "(9): phase from two images and their true reference waves (rad)",
    "one_step_error": "phase from two images by one iteration from the true phase (rad)",
}
"""Titles of the identities, by the names of their errors in `numbers`."""


def findings(values: Mapping[str, float | str], resolution: float) -> Text:
    """Return the largest error of the equations and that of the common approximation."""
    worst = max(float(values[name]) for name in IDENTITIES)
    how = (
        f"hold to rounding error, {resolution:.0e}" if worst <= resolution else f"have errors of up to {worst:.2g}"
    )
    return Text(
        f"**The equations {how}.** The common approximation is not exact: after one step with two images, the "
        f"error is {two_digits(float(values['step_error_01']))} rad for an input of 0.1 rad rms."
    )


def findings_one_image(values: Mapping[str, float | str]) -> Text:
    """Return the errors of two images and of one with their true reference waves."""
    return Text(
        f"For phases of up to {float(values['largest_phase']):.3g} rad, two images have an error of at most "
        f"{float(values['true_wave_error']):.2g} rad, and one image an error of "
        f"{two_digits(float(values['one_image_error']))} rad rms."
    )


def identities_table(values: Mapping[str, float | str], resolution: float) -> Table:
    """Largest error of each identity, from `numbers`."""
    rows = [[title, _text(float(values[name]), resolution)] for name, title in IDENTITIES.items()]
    return Table(["equation", "largest error"], rows)


def _at_least(errors: ArrayLike, resolution: float) -> float:
    """Largest error, or the resolution, below which errors are rounding."""
    return max(float(np.max(errors)), resolution)


def _text(errors: ArrayLike, resolution: float) -> str:
    error = _at_least(errors, resolution)
    return f"<{error:.0e}" if error <= resolution else f"{error:.2g}"
