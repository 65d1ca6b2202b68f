"""A second stage of adaptive optics: a screen that drifts, a sensor, an integrator and a mirror of modes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from studies.kit.loops import (
    ALIKE,
    ONE_IMAGE,
    TWO_IMAGES,
    BestMethods,
    TunedLoops,
    method_name,
    one_over_two,
    paired_ratio,
    short_name,
    two_digits,
    typical,
)
from studies.kit.parameters import USUAL, parameter_limits
from studies.kit.results import rounded, screen_columns
from studies.kit.style import LOOKS
from studies.kit.tables import Table
from zwfs.detector import Detector
from zwfs.loop import Mirror, close_loop
from zwfs.reconstructors import Arcsine, Linear, MaximumLikelihood, PhaseShifted
from zwfs.sensor import ZernikeSensor
from zwfs.turbulence import FrozenFlow

LIMITS = parameter_limits(
    "n_modes diameter phase_shift n_screens exponent rms",
    n_pixels=(16, 200),
    read_noise=(0.0, 100.0),
    n_screens_linear=(1, 1000),
    speed=(0.0, 100.0),
    cutoff=(1.0, 16.0),  # a pupil of the fewest pixels shows no higher frequency
    rate=(1.0, 1e5),
    n_steps=(6, 100000),
    gain=(0.01, 1.99),
    gains=[(0.01, 1.99)],
    delay=(1, 10),
    stroke=(0.1, 100.0),
    other_diameter=USUAL["diameter"],
    other_shift=USUAL["phase_shift"],
    photons=[(0.01, 1e9)],
    photons_zero=(1.0, 1e12),
    inputs=[(0.01, 4.0)],
)
QUICK = {"inputs": [0.7], "n_screens": 3, "n_screens_linear": 4}

PLANTS = {
    "the sensor": {},
    "reference wave kept": {"keep_wave": True},
    "signs kept": {"keep_signs": True},
}
"""Keywords of `AlteredSensor`, for each panel of the figure."""


_SIDEWAYS = 0.085  # between the markers of one start, over the distance of two starts
_GRAY = "#666666"


@dataclass(frozen=True)
class LoopRun:
    """Residual of a closed loop, step by step."""

    times: NDArray[np.float64]  # (n_steps,), second
    open_loop: NDArray[np.float64]  # (n_screens, n_steps), radian rms
    residual: NDArray[np.float64]  # (n_screens, n_steps), radian rms

    def settled(self) -> NDArray[np.float64]:
        """Rms of the residual over the last third of the steps, shape (n_screens,), radian rms."""
        return np.sqrt(np.mean(self.residual[:, -max(1, self.times.size // 3) :] ** 2, axis=1))

    def closed(self) -> NDArray[np.bool_]:
        """Whether each loop settled below half of the error at its start, shape (n_screens,)."""
        return self.settled() < self.open_loop[:, 0] / 2


def follow_flow(
    reconstructor: Any,
    modes: NDArray,
    flow: FrozenFlow,
    n_steps: int,
    *,
    plant: Any = None,
    rate: float = 1000.0,
    photons: float | None = None,
    read_noise: float = 0.0,
    **settings: Any,
) -> LoopRun:
    """Correct drifting screens with a Zernike sensor and a mirror of modes; `settings` are those of `close_loop`.

    `photons` are detected in each step, and the images share them; each pixel adds read noise, electrons rms.
    Without `photons` the frames have no noise.
    """
    sensor = reconstructor.sensor
    camera = None
    if photons is not None:
        camera = Detector(photons / sensor.n_masks / sensor.pupil.n_points, read_noise=read_noise)
    times = np.arange(n_steps) / rate
    mirror = Mirror(sensor.pupil, modes)
    record = close_loop(plant or sensor, mirror, reconstructor, map(flow, times), camera=camera, **settings)
    return LoopRun(times, record.open_loop, record.residual)


class AlteredSensor:
    """Sensor with one dimple whose reference wave keeps its strength, or whose response keeps its sign.

    The intensity of a point rises with sin(a), where a + theta / 2 is its phase relative to the reference wave.
    Its response is reversed where cos(a) < 0. To keep the sign, a stays within a quarter of a turn.
    """

    def __init__(self, sensor: ZernikeSensor, *, keep_wave: bool = False, keep_signs: bool = False) -> None:
        self.sensor, self.keep_wave, self.keep_signs = sensor, keep_wave, keep_signs
        dimple: Any = sensor.masks[0]
        self._theta = dimple.phase
        self._flat = np.abs(self.wave(np.zeros(sensor.pupil.shape)))
        self.reversed: list[NDArray] = []  # of each measurement: share of reversed points, (n_screens,)

    def wave(self, phase: NDArray) -> NDArray[np.complexfloating]:
        """Reference wave, (..., ny, nx)."""
        return self.sensor.reference_wave(self.sensor.pupil.field(phase))[..., 0, :, :]

    def measure(self, phase: NDArray) -> NDArray[np.float64]:
        """Frames of phases, (k, 1, ny, nx)."""
        pupil, wave = self.sensor.pupil, self.wave(phase)
        zero = np.angle(wave * np.exp(-0.5j * (self._theta + np.pi)))  # phase of the wave but for its mask
        angle = phase - zero - self._theta / 2
        self.reversed.append(np.mean(np.cos(pupil.gather(angle)) < 0, axis=-1))
        if self.keep_wave:
            wave = wave * (self._flat / np.maximum(np.abs(wave), 1e-12))
        if self.keep_signs:
            phase = np.clip(angle, -np.pi / 2, np.pi / 2) + zero + self._theta / 2
        return (np.abs(pupil.field(phase) + wave) ** 2 * pupil.inside)[:, np.newaxis]


def loop_growth(
    reconstructor: Any, modes: NDArray, phase: NDArray, gain: float, delay: int
) -> NDArray[np.float64]:
    """Largest factor per step by which a small change of the residual grows around each phase, (k, ny, nx).

    The change of the commands is x' = x - g R J(phase) x. After a delay of d steps an eigenvalue m of R J gives
    the factors z^d - z^(d-1) + g m = 0. R is an affine reconstructor, J the derivative of the frames.
    """
    sensor, mirror = reconstructor.sensor, Mirror(reconstructor.sensor.pupil, modes)
    growth = []
    for one in phase:
        frames = sensor.measure(one)
        pushed = frames + sensor.jacobian(np.broadcast_to(one, modes.shape), modes)
        response = np.nan_to_num(reconstructor(pushed).phase - reconstructor(frames).phase)
        factors = np.zeros((len(modes), delay + 1), complex)
        factors[:, 0] = 1
        factors[:, 1] -= 1
        factors[:, -1] += gain * np.linalg.eigvals(mirror.fit(response))
        growth.append(max(np.abs(np.roots(some)).max() for some in factors))
    return np.array(growth)


@dataclass(frozen=True)
class Divergence:
    """Linear loops with the sensor and with altered ones, and what the first frame shows of their end."""

    runs: Mapping[str, LoopRun]  # for each of PLANTS
    reversed: NDArray[np.float64]  # (n_screens, n_steps), share of the points, with the sensor
    growth: NDArray[np.float64]  # (n_screens,), at the start
    wave: NDArray[np.float64]  # (n_screens,), mean strength of the reference wave at the start; flat: 1

    def ranking(self, values: NDArray) -> float:
        """Return how probably a loop that diverges has a higher value than one that closes: 0.5 by chance."""
        closed = self.runs["the sensor"].closed()
        difference = values[~closed, np.newaxis] - values[closed]
        return float(np.mean((difference > 0) + 0.5 * (difference == 0))) if difference.size else np.nan


def linear_loops(
    linear: Any, modes: NDArray, flow: FrozenFlow, n_steps: int, *, gain: float, delay: int, **settings: Any
) -> Divergence:
    """Close linear loops with the sensor and with altered ones, without noise."""
    plants = {name: AlteredSensor(linear.sensor, **keywords) for name, keywords in PLANTS.items()}
    runs = {
        name: follow_flow(linear, modes, flow, n_steps, plant=plant, gain=gain, delay=delay, **settings)
        for name, plant in plants.items()
    }
    sensor, start = plants["the sensor"], flow(0.0)
    waves = np.abs(linear.sensor.pupil.gather(np.stack([*sensor.wave(start), sensor.wave(0 * start[0])])))
    strength = waves.mean(axis=-1)
    growth = loop_growth(linear, modes, start, gain=gain, delay=delay)
    return Divergence(runs, np.stack(sensor.reversed, axis=1), growth, strength[:-1] / strength[-1])


def loop_methods(
    sensors: Sequence[ZernikeSensor], modes: NDArray, photons: float, read_noise: float
) -> dict[str, Any]:
    """Return reconstructors for one and two images (`sensors`); `photons` are those per point and image of two."""
    one, two = sensors
    methods = (
        Linear(one, modes),
        Arcsine(one, n_iterations=5, tolerance=0),
        Linear(two, modes),
        PhaseShifted(two, n_iterations=3, tolerance=0, accelerate=True),
        MaximumLikelihood(two, photons=photons, read_noise=read_noise, n_iterations=3, n_starts=1),
    )
    return dict(zip((*ONE_IMAGE, *TWO_IMAGES), methods, strict=True))


def tuned_loops(
    sensors: Sequence[ZernikeSensor],
    modes: NDArray,
    start: float,
    photons: float,
    gains: Sequence[float],
    n_screens: int,
    n_steps: int,
    *,
    wind: Mapping[str, float],
    seed: int,
    read_noise: float = 0.0,
    only: Sequence[str] = (*ONE_IMAGE, *TWO_IMAGES),
    **settings: Any,
) -> TunedLoops:
    """Choose the gain of each method on a sixth as many screens, and evaluate it on new screens and noise."""
    pupil = sensors[0].pupil
    first, then = map(int, np.random.SeedSequence(seed).generate_state(2))
    few = FrozenFlow(pupil, start, max(1, n_screens // 6), **wind, seed=first)
    many = FrozenFlow(pupil, start, n_screens, **wind, seed=then)
    settings |= {"photons": 2 * photons * pupil.n_points, "read_noise": read_noise}

    def settle(name: str, flow: FrozenFlow, gain: float, noise: int) -> NDArray:
        return follow_flow(made[name], modes, flow, n_steps, gain=gain, seed=noise, **settings).settled()

    made = {name: one for name, one in loop_methods(sensors, modes, photons, read_noise).items() if name in only}
    scores = {name: {gain: typical(settle(name, few, gain, first)) for gain in gains} for name in made}
    best = {name: min(tried, key=lambda gain: tried[gain]) for name, tried in scores.items()}
    settled = {name: settle(name, many, gain, then) for name, gain in best.items()}
    chosen = {name: tried[best[name]] for name, tried in scores.items()}
    return TunedLoops(start, photons, best, chosen, settled)


def best_methods(trials: Iterable[TunedLoops]) -> list[BestMethods]:
    """Compare the best method with one image to that with two, screen by screen.

    The screens that chose the gains also choose the methods: the simplest one within `ALIKE` of the best.
    """
    rows = []
    for loops in trials:
        one, two = (_simplest(loops.chosen, names) for names in (ONE_IMAGE, TWO_IMAGES))
        rows.append(BestMethods.of(loops, one, two))
    return rows


def compare_dimples(usual: Iterable[TunedLoops], other: TunedLoops) -> BestMethods:
    """Compare linear loops with two images behind other dimples with those behind the usual ones."""
    [same] = (one for one in usual if (one.start, one.photons) == (other.start, other.photons))
    settled = {"usual": same.settled["LinearTwo"], "other": other.settled["LinearTwo"]}
    return BestMethods.of(replace(same, settled=settled), "usual", "other")


def _simplest(residual: Mapping[str, float], names: Sequence[str]) -> str:
    """First method whose residual is within `ALIKE` of the smallest one, of those that were tried."""
    tried = [name for name in names if name in residual]
    limit = ALIKE * min(residual[name] for name in tried)
    return next(name for name in tried if residual[name] <= limit)


def draw_linear_loops(found: Divergence) -> Figure:
    """Residual of linear loops against time: a panel for the sensor and each altered one, a line for a screen."""
    figure, panels = plt.subplots(1, len(found.runs), figsize=(7, 3), sharex=True, sharey=True, squeeze=False)
    for axes, (name, run) in zip(panels[0], found.runs.items(), strict=True):
        closed = run.closed()
        for screen in np.argsort(~closed, kind="stable"):  # those that do not close last
            style = (
                {"lw": 0.8, "color": "#999999"} if closed[screen] else {"lw": 2, "color": LOOKS["Linear"].color}
            )
            axes.semilogy(1e3 * run.times, run.residual[screen], label=f"_screen {screen}", **style)
        axes.set_title(f"{name}:\n{closed.sum()} of {closed.size} close", fontsize=10)
        axes.set(xlabel="time (ms)", xlim=(0, 1e3 * run.times[-1]))
    panels[0, 0].set_ylabel("residual (rad rms)")
    panels[0, 0].yaxis.set_major_formatter("{x:g}")
    return figure


def draw_tuned_loops(trials: Sequence[TunedLoops]) -> Figure:
    """Residual against the error at the start: a panel for each star, a curve for each method at its best gain.

    Markers are filled for one image and open for two, and moved sideways so that none hides another; bars are two
    standard errors either way. Above each panel stands how many loops close.
    """
    stars = sorted({one.photons for one in trials})
    figure, panels = plt.subplots(1, len(stars), figsize=(7, 4.4), sharex=True, sharey=True, squeeze=False)
    for axes, photons in zip(panels[0], stars, strict=True):
        some = sorted((one for one in trials if one.photons == photons), key=lambda one: one.start)
        starts = np.arange(len(some))  # in equal steps: the small ones, which lie close together, matter most
        drawn = [name for name in (*TWO_IMAGES, *ONE_IMAGE) if name in some[0].settled]
        for index, name in enumerate(drawn):
            style = LOOKS["Linear" if name == "LinearTwo" else name].style
            if name in TWO_IMAGES:
                style["markerfacecolor"] = "white"
            if name == "LinearTwo":
                style["linestyle"] = "--"
            means = np.array([paired_ratio(one.settled[name], np.ones_like(one.settled[name])) for one in some])
            places = starts + _SIDEWAYS * (index - len(drawn) // 2)
            axes.semilogy(places, means[:, 0], label=method_name(name), **style)
            if np.isfinite(means).all():  # more than one screen
                axes.vlines(places, *means[:, 1:].T, color=style["color"], lw=1)
        _mark_closed(axes, some)
        light = f"{photons:g} photon{'s' * (photons != 1)} per point, image and step"
        n_loops = next(iter(some[0].settled.values())).size
        axes.set_title(f"{light}\nloops that close, of {n_loops}:", fontsize=10, pad=30)
        axes.set(xlabel="error at the start (rad rms)", xticks=starts)
        axes.set_xticklabels([f"{one.start:g}" for one in some])
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
    panels[0, 0].set_ylabel("residual (rad rms)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _mark_closed(axes: Axes, some: Sequence[TunedLoops]) -> None:
    """Draw the limit below which a loop is closed; count the closed loops above the panel, for each start."""
    limits = [one.start / 2 for one in some]
    axes.semilogy(range(len(some)), limits, color=_GRAY, lw=1, zorder=1)
    style: dict[str, Any] = {"textcoords": "offset points", "color": _GRAY, "fontsize": 9}
    axes.annotate("closed: below half\nof the start", (0, limits[0]), (-6, 16), **style)
    axes.margins(y=0.17)
    place = axes.get_xaxis_transform()  # places on the axis, and heights in units of the panel
    for number, one in enumerate(some):
        lines = []
        for label, names in (("one", ONE_IMAGE), ("two", TWO_IMAGES)):
            closed = sorted({one.closed(name).sum() for name in names if name in one.settled})
            lines.append(f"{label}: " + "\N{EN DASH}".join(map(str, dict.fromkeys((closed[0], closed[-1])))))
        axes.text(number, 1.02, "\n".join(lines), transform=place, ha="center", fontsize=9)


def tuned_screens(trials: Sequence[TunedLoops]) -> dict[str, NDArray]:
    """Residuals of every single screen, for each input and star."""
    names = trials[0].settled
    residuals = {f"{name}: residual (rad rms)": np.stack([one.settled[name] for one in trials]) for name in names}
    columns = screen_columns({"start (rad rms)": [one.start for one in trials]}, residuals)
    n_screens = columns["screen"].max()
    return {"photons per point and image": np.repeat([one.photons for one in trials], n_screens)} | columns


def best_table(rows: Sequence[BestMethods]) -> Table:
    """Return the best method with two images and with one for each input and star, and how its loops end."""
    header = "start; photons per point and image", "two images", "one image", "one over two"
    cells = []
    for row in rows:
        loops = row.loops
        ends = []
        for name in (row.two, row.one):
            n, closed = loops.settled[name].size, loops.closed(name).sum()
            few = f"; {closed} of {n} close" if closed < n else ""
            ends.append(
                f"{short_name(name)}: {two_digits(typical(loops.settled[name]))}; gain {loops.gains[name]:g}{few}"
            )
        light = f"{loops.photons:g} photon{'s' * (loops.photons != 1)}"
        cells.append([f"{loops.start:g} rad rms; {light}", *ends, one_over_two(row)])
    return Table(header, cells)


def numbers(
    found: Divergence, rows: Sequence[BestMethods], noisy: Sequence[BestMethods], settings: Mapping[str, float]
) -> dict[str, float | str]:
    """Return the loops that close, what ranks them, and what the second image gains, without and with read noise.

    Those with read noise are ordered by the error at the start.
    """
    small, large = noisy[0], noisy[-1]
    names = dict(zip(("sensor", "wave", "signs"), PLANTS, strict=True))
    closed = {key: found.runs[name].closed() for key, name in names.items()}
    residual = [{name: typical(one) for name, one in row.loops.settled.items()} for row in rows]
    starts = {row.loops.start for row in rows}
    unequal = [row.loops.start for row in rows if row.best is not None]
    others = [row.loops.start for row in rows if row.best != row.two]
    excess = max(one["LinearTwo"] / min(one.values()) for one in residual) - 1
    equal = max((start for start in starts if start < min(unequal, default=np.inf)), default=np.nan)
    two_from = min((start for start in starts if start > max(others, default=0)), default=np.nan)
    first = [row.loops for row in rows if row.loops.start == two_from]
    lost_loops = [np.count_nonzero(~one.closed(name)) for one in first for name in ONE_IMAGE]
    return rounded(
        dict(settings)
        | {f"closed_{key}": np.count_nonzero(one) for key, one in closed.items()}
        | {
            "n_loops": closed["sensor"].size,
            "rank_growth": found.ranking(found.growth),
            "rank_wave": found.ranking(-found.wave),
            "equal_to": equal,
            "two_from": two_from,
            "lost_least": min(lost_loops, default=np.nan),
            "lost_most": max(lost_loops, default=np.nan),
            "linear_two_excess": np.ceil(100 * excess) / 100,  # an upper limit, in whole percents
            "noisy_small": small.loops.start,
            "noisy_small_span": one_over_two(small),
            "noisy_large": large.loops.start,
            "noisy_large_one": typical(large.loops.settled[large.one]),
            "noisy_large_two": typical(large.loops.settled[large.two]),
        }
    )


def dimple_numbers(trials: Mapping[str, BestMethods]) -> dict[str, float | str]:
    """Residuals with the usual dimples and with others, and their ratio, for each star by name."""
    found: dict[str, float | str] = {}
    for star, one in trials.items():
        found[f"dimple_{star}_span"] = one_over_two(one)
        found |= {f"dimple_{star}_{name}": typical(left) for name, left in one.loops.settled.items()}
    return rounded(found)
