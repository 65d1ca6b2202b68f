"""Whether a measured phase can be trusted: misfit over noise, a score on unseen data, and where to look.

The sign of the phase depends on the order of the two images, which `order_of_images` finds from one poke.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._results import Result
from zwfs.bounds import cramer_rao
from zwfs.frames._outline import NEAR
from zwfs.frames.phases import Phases
from zwfs.frames.pipeline import (
    Agreement,
    Measurement,
    Optics,
    iterated_phase,
    model,
    near_edges,
    predict_other,
    prediction_error,
    upside_down,
)
from zwfs.frames.registration import CLEAR_FRAMES, FRAMES, Placement, RegisteredFrames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CameraNoise", "ImageOrder", "Verdict", "judge", "order_of_images"]

_EXPLAINED = 1.25  # misfit over the noise up to which noise explains the frames
_LEAST_LEAD = 0.2  # of the score over that of the control
_FACTORS = 0.5, 0.6, 0.7, 0.83, 1.0, 1.2, 1.4, 1.7, 2.0  # on the frames
_AS_WELL = 0.15  # a prediction whose squared error is larger than the least one by this part is as good
_STRONGER = 1.5  # times the weakest phase that is possible: the scale of the phase is not determined
_UNEVEN = 0.03  # difference of the two flux ratios that is worth a word
_EXCESS = 0.02  # light around the pupil, 1 = mean of the pupil, that is worth a word
_MANY = 0.01  # of the points
_MOST_LIGHT = 1.1  # in the pupil, 1 = that of the clear frames
_FEW, _MOST = 0.02, 0.9  # part of the points that is worth a word if it holds most of the squared misfit
_TURNED = 5.0  # standard errors: a rotation or magnification beyond them is real
_ONE_IMAGE = (
    "Not decided: one image fits nearly any phase. It cannot show whether the phase is on the right branch of the "
    "arcsine, nor an error of dimple, light or background. Poke a known phase, or take a second image with "
    "another phase shift."
)
_TOLERANCE = 1e-4  # radian, of an iteration
_LEAST_SKEW = 0.5  # skewness of the change of phase: that of noise is about 0, that of one poke 1


@dataclass(frozen=True)
class CameraNoise:
    """Noise of a camera.

    Parameters
    ----------
    gain : float, electrons / count
    read_noise : float, electrons rms / pixel
    """

    gain: float
    read_noise: float = 0.0

    def __post_init__(self) -> None:
        _check.number("gain", self.gain, 0, open_low=True)
        _check.number("read_noise", self.read_noise, 0)

    def photons(self, measurement: Measurement) -> float:
        """Photons that an intensity of 1 puts into a pixel of a frame, the mean of both images."""
        _check.instance("measurement", measurement, Measurement)
        return float(measurement.counts.mean() * measurement.registered.exposure * self.gain)


@dataclass(frozen=True, eq=False, repr=False)
class Verdict(Result):
    """Judgement of a measured phase.

    Attributes
    ----------
    score, control : ndarray, shape (2,)
        Correlation of each frame with its prediction from the other one alone; and the same with the second frame
        turned upside down, which must fail.
    inner, edge : float
        Rms misfit of the frames over that of the noise: far from gaps, vanes and edges, and within 2 pixels of
        them. 1 if noise is all of it; NaN if the noise of the camera is not known.
    sigma : ndarray, shape (ny, nx), radian, or None
        Error bar of the phase: the smallest that photon and read noise allow, without errors of the model.
    placed : bool
        Whether the images determine the rotation and the magnification between them.
    scales, strengths : (float, float), 1 and radian rms
        Smallest and largest factor on the frames with which they are predicted as well, and the phases they give.
    findings : dict of str
        Sentences by their topic: fit, unseen data, scale, light, registration, and warnings if there are any.
    """

    panels = (("sigma", "standard error (rad)"), ("score", "correlation with the prediction"))
    score: NDArray[np.float64]
    control: NDArray[np.float64]
    inner: float
    edge: float
    sigma: NDArray[np.float64] | None
    placed: bool
    scales: tuple[float, float]
    strengths: tuple[float, float]
    findings: dict[str, str]

    def __repr__(self) -> str:
        return f"Verdict(explained={self.explained}, score={self.score.round(2)}, control={self.control.round(2)})"

    def plot(self) -> Figure:
        """Draw the scores of both images next to those of the control, which must fail, and the error bar."""
        figure = super().plot()
        [axes] = (panel for panel in figure.axes if panel.get_xlabel() == "number")
        axes.plot([1, 2], self.control, "s", mfc="none", label="control")
        axes.lines[0].set_label("score")
        axes.set(xlabel="image", xlim=(0.5, 2.5), ylim=(min(-0.1, *self.control), 1))
        axes.legend()
        return figure

    @property
    def explained(self) -> bool | None:
        """Whether noise explains the misfit far from the edges.

        None if that cannot be decided: the noise is not known, or noise explains the misfit, but the images do not
        determine the rotation or the magnification between them, and an error of these changes the phase.
        """
        if np.isnan(self.inner) or (self.inner <= _EXPLAINED and not self.placed):
            return None
        return bool(self.inner <= _EXPLAINED)


def judge(phases: Phases, noise: CameraNoise | None = None, n_iterations: int = 25) -> Verdict:
    """Judge a measured phase, in words and numbers.

    Parameters
    ----------
    phases : Phases
        Of `recover_phase` or `phase_of`.
    noise : CameraNoise, optional
        Without it there is no error bar, and the misfit is not compared with the noise.
    n_iterations : int
        Of the predictions of one frame from the other one.

    Examples
    --------
    >>> from zwfs.bench.model import Bench
    >>> from zwfs.frames import CameraNoise, judge, phase_of
    >>> bench = Bench(n_pixels=40, n_rings=1, missing=(), photons_per_image=1e8)
    >>> pistons = [-0.5, -0.3, -0.2, 0.0, 0.2, 0.3, 0.5]
    >>> phases = phase_of(bench.frames(pistons, seed=1), bench.clear_frames(seed=2))
    >>> verdict = judge(phases, CameraNoise(gain=1.0, read_noise=bench.read_noise))
    >>> bool((verdict.score > verdict.control + 0.2).all()), verdict.sigma.shape == phases.phase.shape
    (True, True)
    """
    _check.instance("phases", phases, Phases)
    phase, agreement = phases.phase, phases.agreement
    measurement = agreement.measurement
    score = predict_other(measurement, n_iterations)
    control = predict_other(upside_down(measurement), n_iterations)
    near, single = near_edges(measurement), measurement.optics.single
    inner, edge, sigma = np.nan, np.nan, None
    if noise is not None:
        _check.instance("noise", noise, CameraNoise)
        filled = nearest_good(np.nan_to_num(phase), measurement.good)
        sigma = _error_bar(measurement, filled, noise)
        if not single:
            ratio = _over_noise(agreement, filled, noise)
            inner, edge = _rms(ratio[measurement.good & ~near]), _rms(ratio[measurement.good & near])
    placed = not np.isnan(measurement.registered.placement.sigma[2:]).any()
    if single:
        strength = float(np.nanstd(phase, dtype=float))
        scales, strengths, findings = (1.0, 1.0), (strength, strength), {"fit": _ONE_IMAGE}
    else:
        scales, strengths = _scales(measurement, n_iterations)
        findings = {
            "fit": _of_fit(agreement, inner, edge, near, placed),
            "unseen data": _of_score(score, control),
            "scale": _of_scale(scales, strengths),
            "light": _of_light(measurement),
            "registration": _of_place(measurement.registered.placement),
        }
    if warnings := " ".join(_warnings(agreement, phases, near)):
        findings["warnings"] = warnings
    return Verdict(score, control, inner, edge, sigma, placed, scales, strengths, findings)


def _error_bar(measurement: Measurement, phase: NDArray, noise: CameraNoise) -> NDArray[np.float64]:
    """Smallest standard error of a phase without NaN that photon and read noise allow, (ny, nx).

    Noise of the clear frames and errors of the model are not part of it.
    """
    sigma = cramer_rao(model(measurement), phase, photons=noise.photons(measurement), read_noise=noise.read_noise)
    return np.where(measurement.good, sigma, np.nan)


def _over_noise(agreement: Agreement, phase: NDArray, noise: CameraNoise) -> NDArray[np.float64]:
    """Misfit of the two frames at each point over its standard deviation, (ny, nx).

    Two intensities share one phase, which takes up the part of the misfit along its slopes. The rest is normal to
    them: one number at each point. It holds the noise of both frames, as interpolation leaves it, and of the clear
    frames, which changes the squared amplitude of the model.
    """
    measurement = agreement.measurement
    sensor, pupil, photons = model(measurement), measurement.pupil, noise.photons(measurement)
    field = np.where(pupil.inside, pupil.amplitude * np.exp(1j * phase), 0)
    waves = sensor.propagate(field)[(..., *sensor.window)]
    slopes = 2 * np.real(np.conj(waves) * 1j * field)
    normal = np.stack([slopes[1], -slopes[0]]) / np.maximum(np.hypot(*slopes), 1e-300)
    growth = np.real(np.conj(waves) * field) / np.maximum(np.abs(field) ** 2, 1e-300)
    frames, clear = _noise_kept(measurement.registered)
    dark = noise.read_noise**2 / photons
    of_frames = frames[:, np.newaxis, np.newaxis] * (np.abs(waves) ** 2 + measurement.rest + dark) / photons
    exposure = measurement.registered.exposure
    of_amplitude = clear.sum() / 4 * exposure * (np.abs(field) ** 2 + dark * exposure) / photons
    variance = np.sum(normal**2 * of_frames, axis=0) + np.sum(normal * growth, axis=0) ** 2 * of_amplitude
    misfit = (agreement.measured - agreement.modelled)[(..., *measurement.window)]
    return np.sum(normal * misfit, axis=0) / np.sqrt(np.maximum(variance, 1e-300))


def _noise_kept(registered: RegisteredFrames) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Part of the variance of white noise that interpolation keeps, in the two frames and the clear frames."""
    rng = np.random.default_rng(0)

    def noise(images: Any) -> Any:
        return tuple(replace(image, counts=rng.normal(size=image.counts.shape)) for image in images)

    white = replace(registered, frames=noise(registered.frames), clear_frames=noise(registered.clear_frames))
    frames, clear = (white._on_grid(which)[0].var(axis=(1, 2)) for which in (FRAMES, CLEAR_FRAMES))
    return frames, clear


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan


def _scales(measurement: Measurement, n_iterations: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Range of the factors on the frames with which these are predicted as well, and of the phases, radian rms.

    The squared error of a prediction that counts as well is up to 1.15 times the least one. It is up to twice the
    least one if that is as large as the variance of the frames: then the model is too wrong to decide.
    """
    errors, strengths = [], []
    for factor in _FACTORS:
        scaled = replace(measurement, optics=replace(measurement.optics, scale=factor * measurement.optics.scale))
        errors.append(float(prediction_error(scaled, scaled.good, n_iterations).mean()))
        waves = np.exp(1j * iterated_phase(scaled, n_iterations, _TOLERANCE)[scaled.good])
        strengths.append(float(np.angle(waves * np.conj(waves.mean())).std()))
    least, here = min(errors), errors[_FACTORS.index(1.0)]
    well = np.array(errors) <= max(here, least * (1 + np.clip(least, _AS_WELL, 1)))
    factors, phases = np.array(_FACTORS)[well], np.array(strengths)[well]
    return (float(factors.min()), float(factors.max())), (float(phases.min()), float(phases.max()))


def _of_scale(scales: tuple[float, float], strengths: tuple[float, float]) -> str:
    """Whether the frames determine how strong the phase is."""
    if scales == (1.0, 1.0):
        return "Determined: frames that are a fifth brighter or darker are predicted worse."
    word = "is not" if strengths[1] > _STRONGER * strengths[0] else "is"
    return (
        f"The scale of the phase {word} determined: with the frames scaled by {scales[0]:.2f} to {scales[1]:.2f}, "
        f"they are predicted as well, and the phase has {strengths[0]:.2f} to {strengths[1]:.2f} rad rms."
    )


def _of_fit(agreement: Agreement, inner: float, edge: float, near: NDArray[np.bool_], placed: bool) -> str:
    """Whether the model explains the frames, and where it does not."""
    good = agreement.measurement.good
    squares = np.sum((agreement.measured - agreement.modelled)[(..., *agreement.measurement.window)] ** 2, axis=0)
    share, area = squares[good & near].sum() / squares[good].sum(), np.mean(near[good])
    edges = "gaps, vanes and edges"
    look = "dimple, leakage and background"
    if share > 1.2 * area:
        look = "registration, focus, blur and partly lit pixels"
    part = "More than 99.5%" if share > 0.995 else f"{share:.0%}"  # 100% would deny the misfit elsewhere
    where = (
        f"{part} of the squared misfit lies within {NEAR} pixels of {edges} ({area:.0%} of the points): "
        f"look at {look}."
    )
    if np.isnan(inner):
        size = f"the rms misfit is {np.mean(agreement.residual):.3f} of the mean light"
        return f"Not compared with the noise of the camera, which is not known: {size}. {where}"
    far = f"from {edges} the misfit is {inner:.3g} times what noise alone would cause"
    if inner > _EXPLAINED:
        return f"Not explained. {where} Far {far}."
    verdict = f"Explained to within the noise: far {far}."
    if not placed:
        verdict = (
            f"Not decided: far {far}, but the images do not determine the rotation or the magnification "
            "between them, which change the phase."
        )
    if edge <= _EXPLAINED:
        return verdict
    return f"{verdict} Near them it is {edge:.3g} times the noise: look at partly lit pixels, focus and blur."


def _of_score(score: NDArray, control: NDArray) -> str:
    """Score on data that the phase has not seen, and its control."""
    lead = float(np.min(score - control))
    trust = "The frames belong together." if lead >= _LEAST_LEAD else "The frames hardly support this phase."
    return (
        f"Predicted from the other frame alone, the frames correlate by {score[0]:.2f} and {score[1]:.2f} with "
        f"the measured ones. Control, with the second frame upside down: {control[0]:.2f} and {control[1]:.2f}. "
        f"{trust}"
    )


def _of_light(measurement: Measurement) -> str:
    """Flux ratios of the images, which should be equal with and without the mask."""
    masked, clear = measurement.flux_ratio
    facts = (
        f"The light of image 1 is {masked:.3f} times that of image 2 behind the mask, and {clear:.3f} times "
        "without it. "
    )
    if not (measurement.registered.balance and measurement.optics.opposite):
        return facts + "The frames are not balanced."
    facts += "For opposite phase shifts the two ratios should be equal. "
    difference = abs(masked / clear - 1)
    if difference < _UNEVEN:
        return f"{facts}They agree within {max(math.ceil(1e3 * difference), 1) / 10:.1f} %."
    look = "look for leakage, light that one mask does not shift, and stray light"
    return f"{facts}They differ by {difference:.0%}, which the scaling of the frames hides: {look}."


def _of_place(placement: Placement) -> str:
    """Rotation and magnification between the images."""
    facts = []
    for name, unit, value, sigma in (
        ("rotation", "degrees", placement.rotation, placement.sigma[2]),
        ("magnification", "%", 100 * (placement.magnification - 1), 100 * placement.sigma[3]),
    ):
        if np.isnan(sigma):
            facts.append(f"its {name} is not determined and taken as none")
        else:
            real = "undone" if abs(value) > _TURNED * sigma else "consistent with none"
            facts.append(f"its {name} is {value:+.3f} ± {sigma:.3f} {unit} ({real})")
    return "The second image, compared with the first: " + "; ".join(facts) + "."


def _warnings(agreement: Agreement, phases: Phases, near: NDArray[np.bool_]) -> list[str]:
    """Facts that lower the trust in the phase; `near` are the points near edges."""
    measurement, remarks = agreement.measurement, []
    n_points = measurement.pupil.n_points
    if not phases.converged:
        remarks.append("The iteration has not converged: raise n_iterations, or the phase is beyond its range.")
    if phases.n_unsolved > _MANY * n_points:
        remarks.append(f"At {phases.n_unsolved} of {n_points} points the equations have no unique solution.")
    if measurement.n_bad > _MANY * n_points:
        remarks.append(f"{measurement.n_bad} of {n_points} points are bad and have no phase.")
    light = float(np.mean(agreement.measured[(..., *measurement.window)][:, measurement.good]))
    if light > _MOST_LIGHT:
        remarks.append(
            f"The pupil holds {light:.2f} times the light of the clear frames, and a mask makes no light: look at "
            "the exposures and the dark."
        )
    missing = (agreement.measured - agreement.modelled)[(..., *measurement.window)][:, measurement.good & ~near]
    squares = np.sort(np.sum(missing**2, axis=0))
    share = squares[squares.size - math.ceil(_FEW * squares.size) :].sum() / max(squares.sum(), 1e-300)
    if share > _MOST:
        remarks.append(
            f"{_FEW:.0%} of the points far from edges hold {share:.0%} of the squared misfit there: look for "
            "cosmic rays and bad pixels."
        )
    if abs(agreement.excess_light) > _EXCESS:
        remarks.append(
            f"Around the pupil the frames differ from the model by {agreement.excess_light:+.3f} of the mean "
            "light: look at the dark, stray light and the diameter of the dimple."
        )
    return remarks


@dataclass(frozen=True)
class ImageOrder:
    """Result of `order_of_images`.

    Attributes
    ----------
    optics : Optics
        Those of the measurement, with the phase shifts in the right order.
    exchanged : bool
        Whether the phase shifts of the measurement were in the wrong order.
    score, other : float
        For the right order and for the wrong one: the sum of the cubed change of phase over that of its absolute
        cube, times the sign of the poke. It is 1 for a change of one sign.
    """

    optics: Optics
    exchanged: bool
    score: float
    other: float

    def __post_init__(self) -> None:
        _check.declared(self)


def order_of_images(flat: Measurement, poked: Measurement, sign: int = 1, n_iterations: int = 25) -> ImageOrder:
    """Find which image has which phase shift, from a poke of known sign.

    No frame shows which image belongs to +theta and which to -theta: the exchange changes the sign of the phase
    and nothing else. One known change decides it. Record the frames twice, the second time with one actuator or
    segment poked by about 0.3 to 1 rad; where the poke stands need not be known.

    Parameters
    ----------
    flat, poked : Measurement
        From `reduce_frames`, before and after the poke, with the same optics and clear frames.
    sign : int
        1 if the poke lengthens the optical path, that is if it pulls a mirror away from the incoming light and so
        raises the phase; -1 if it shortens it.
    n_iterations : int
        As for `recover_phase`.

    Raises
    ------
    ValueError
        If the measurements do not fit together, or the change of phase between them
        is not that of one poke.

    Examples
    --------
    >>> import numpy as np
    >>> from zwfs.bench.model import Bench
    >>> from zwfs.frames import order_of_images, phase_of
    >>> bench, wrong = Bench(n_pixels=40), {"phase_shifts": (-np.pi / 2, np.pi / 2)}
    >>> poke = 0.5 * (np.arange(bench.n_segments) == 5)
    >>> flat, poked = (
    ...     phase_of(bench.frames(pistons), bench.clear_frames(), **wrong).measurement
    ...     for pistons in (0 * poke, poke)
    ... )
    >>> order_of_images(flat, poked).exchanged
    True
    """
    _check.instance("flat", flat, Measurement)
    _check.instance("poked", poked, Measurement)
    if not (sign := _check.integer("sign", sign, -1, 1)):
        raise ValueError("sign = 0: expected 1 or -1")
    if flat.optics.single:
        raise ValueError("flat has one image: expected two, whose order is sought")
    if flat.pupil.shape != poked.pupil.shape or flat.optics != poked.optics:
        raise ValueError("flat and poked differ in optics or in the grid of the pupil: expected the same")
    optics = flat.optics
    choices = [optics, optics.exchanged]
    scores = [
        sign * _skewness(replace(flat, optics=choice), replace(poked, optics=choice), n_iterations)
        for choice in choices
    ]
    best = int(np.argmax(scores))
    score, other = scores[best], scores[1 - best]
    if score < _LEAST_SKEW or score - other < _LEAST_SKEW:
        raise ValueError(
            f"flat and poked: the change of phase scores {scores[0]:.2f} and {scores[1]:.2f} for the two orders: "
            f"expected one above {_LEAST_SKEW}, from a poke of one sign on less than half of the pupil"
        )
    return ImageOrder(choices[best], best == 1, score, other)


def _skewness(flat: Measurement, poked: Measurement, n_iterations: int) -> float:
    """How far the change of phase has one sign, in [-1, 1]; the cube weights the poke and not the noise."""
    first, second = (iterated_phase(measurement, n_iterations, _TOLERANCE) for measurement in (flat, poked))
    waves = np.exp(1j * (second - first)[flat.good & poked.good])
    change: NDArray[np.float64] = np.angle(waves * np.exp(-1j * np.angle(waves.mean())))
    cubes = (change - np.median(change)) ** 3
    return float(cubes.sum() / max(np.abs(cubes).sum(), 1e-300))
