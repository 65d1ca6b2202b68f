"""A second stage of adaptive optics: a screen that drifts, a sensor, an integrator and a mirror of modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import LOOKS
from studies.kit.tables import Table
from zwfs.detector import Detector
from zwfs.loop import Mirror, close_loop
from zwfs.pupil import Pupil

LIMITS = parameter_limits(
    "n_modes diameter phase_shift n_screens exponent n_iterations",
    n_pixels=(16, 200),
    rms=(0.01, 4.0),
    speed=(0.0, 100.0),
    cutoff=(1.0, 16.0),  # a pupil of the fewest pixels shows no higher frequency
    rate=(1.0, 1e5),
    n_steps=(3, 100000),
    gain=(0.01, 1.99),
    delay=(1, 10),
    stroke=(0.1, 100.0),
    magnitudes=[(-5.0, 20.0)],
    photons_zero=(1.0, 1e12),
    inputs=[(0.01, 4.0)],
    n_steps_capture=(3, 100000),
)

_BOX = 3.0  # D; the screens repeat after this length


class FrozenFlow:
    """Random screens that a wind carries across the pupil without a change of form."""

    def __init__(
        self,
        pupil: Pupil,
        rms: float,
        n_screens: int,
        *,
        speed: float = 2.5,
        cutoff: float = 5.0,
        exponent: float = -2.0,
        seed: int | np.random.Generator | np.random.SeedSequence | None = None,
    ) -> None:
        self.pupil = pupil
        rng = np.random.default_rng(seed)
        n = int(cutoff * _BOX)
        u = np.arange(-n, n + 1) / _BOX  # frequencies along x, cycles / D
        v = u[:, np.newaxis]  # the same along y
        self._amplitudes = _random_amplitudes(np.hypot(u, v), cutoff, exponent, n_screens, rng)
        # A screen is the sum of a(v, u) exp(2 pi i (v y + u x)): two matrix products.
        self._waves_y = np.exp(2j * np.pi * np.outer(pupil.y, u))
        self._waves_x = np.exp(2j * np.pi * np.outer(u, pupil.x))
        # A wind (wy, wx) moves it to y - wy t, x - wx t: each amplitude turns by -2 pi (wy v + wx u) t.
        direction = rng.uniform(0, 2 * np.pi, n_screens)
        self.velocity = speed * np.stack([np.sin(direction), np.cos(direction)], axis=-1)
        wy, wx = self.velocity.T[..., np.newaxis, np.newaxis]
        self._turn = -2j * np.pi * (wy * v + wx * u)
        self._amplitudes *= (rms / pupil.rms(self(0.0)))[:, np.newaxis, np.newaxis]

    def __call__(self, time: float) -> NDArray[np.float64]:
        """Screens at a time in seconds, (n_screens, ny, nx), radian: without piston, 0 outside the pupil."""
        amplitudes = self._amplitudes * np.exp(self._turn * time)
        inside = self.pupil.gather((self._waves_y @ amplitudes @ self._waves_x).real)
        return self.pupil.scatter(inside - inside.mean(axis=-1, keepdims=True), fill=0)


def _random_amplitudes(
    frequency: NDArray, cutoff: float, exponent: float, n_screens: int, rng: np.random.Generator
) -> NDArray[np.complex128]:
    """Gaussian amplitudes whose power falls as a power of the frequency; 0 for piston and beyond the cutoff."""
    used = (frequency > 0) & (frequency <= cutoff)
    scale = np.where(used, np.where(used, frequency, 1) ** (exponent / 2), 0)
    real, imaginary = rng.standard_normal((2, n_screens, *frequency.shape))
    return scale * (real + 1j * imaginary)


@dataclass(frozen=True)
class LoopRun:
    """Residual of a closed loop, step by step."""

    times: NDArray[np.float64]  # (n_steps,), second
    open_loop: NDArray[np.float64]  # (n_screens, n_steps), radian rms
    residual: NDArray[np.float64]  # (n_screens, n_steps), radian rms
    strehl: NDArray[np.float64]  # (n_screens, n_steps)

    @property
    def last_third(self) -> slice:
        """Last third of the steps, in which a loop counts as settled."""
        return slice(self.times.size - max(1, self.times.size // 3), None)

    def settled(self) -> NDArray[np.float64]:
        """Rms of the residual over the last third of the steps, shape (n_screens,), radian rms."""
        return np.sqrt(np.mean(self.residual[:, self.last_third] ** 2, axis=1))

    def closed(self) -> NDArray[np.bool_]:
        """Whether each loop settled below half of the error at its start, shape (n_screens,)."""
        return self.settled() < self.open_loop[:, 0] / 2

    def held(self) -> float:
        """Median residual (radian rms) at which the closed loops settled, NaN if none closed."""
        settled = self.settled()[self.closed()]
        return float(np.median(settled)) if settled.size else np.nan


def follow_flow(
    reconstructor: Any,
    modes: NDArray,
    flow: FrozenFlow,
    n_steps: int,
    *,
    rate: float = 1000.0,
    photons: float | None = None,
    **settings: Any,
) -> LoopRun:
    """Correct drifting screens with a Zernike sensor and a mirror of modes; `settings` are those of `close_loop`.

    `photons` are those of a step; there is no noise if they are left out.
    """
    sensor = reconstructor.sensor
    camera = None if photons is None else Detector(sensor.pupil, photons / sensor.n_masks)
    times = np.arange(n_steps) / rate
    mirror = Mirror(sensor.pupil, modes)
    record = close_loop(sensor, mirror, reconstructor, map(flow, times), camera=camera, **settings)
    return LoopRun(times, record.open_loop, record.residual, record.strehl)


def compare_loops(
    reconstructors: Mapping[str, Any], modes: NDArray, flow: FrozenFlow, n_steps: int, **settings: Any
) -> dict[str, LoopRun]:
    """Close the loop with each of several reconstructors, on the same screens; see `follow_flow`."""
    return {name: follow_flow(one, modes, flow, n_steps, **settings) for name, one in reconstructors.items()}


StarRuns = Mapping[float, Mapping[str, LoopRun]]  # for each magnitude and method
CaptureRuns = Sequence[Mapping[str, LoopRun]]  # for each error at the start, and for each method


def draw_loop_runs(runs: StarRuns) -> Figure:
    """Residual against time: a column for each star, a row for each method, and a line for each screen."""
    n_rows = len(next(iter(runs.values())))
    figure, panels = plt.subplots(
        n_rows, len(runs), figsize=(7, 0.8 + 2.1 * n_rows), sharex=True, sharey=True, squeeze=False
    )
    for column, (magnitude, methods) in zip(panels.T, runs.items(), strict=True):
        column[0].set_title(f"magnitude {magnitude:g}", fontsize=10)
        column[-1].set_xlabel("time (ms)")
        for axes, (name, run) in zip(column, methods.items(), strict=True):
            time = 1e3 * run.times
            axes.semilogy(time, run.residual.T, lw=1, color=LOOKS[name].color)
            axes.semilogy(time, np.median(run.open_loop, axis=0), color="#777777", lw=1.5, ls="--")
            axes.set_xlim(0, time[-1])
    for axes, name in zip(panels[:, 0], methods, strict=True):
        axes.set_ylabel(f"{LOOKS[name].name}\nresidual (rad rms)")
    place = 0.97 * time[-1], 1.25 * run.open_loop.mean()
    panels[-1, 0].text(*place, "no correction", ha="right", va="bottom", color="#777777")
    return figure


def draw_capture(inputs: Sequence[float], runs: CaptureRuns) -> Figure:
    """Fraction of the loops that close, and the residual of these, against the wavefront error at the start."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.8))
    for name in runs[0]:
        look = LOOKS[name]
        closed = [100 * np.mean(methods[name].closed()) for methods in runs]
        left.plot(inputs, closed, label=look.label, **look.style)
        right.semilogy(inputs, [methods[name].held() for methods in runs], label=look.label, **look.style)
        points = [(start, value) for start, one in zip(inputs, runs, strict=True) for value in one[name].settled()]
        right.plot(*np.transpose(points), ".", color=look.color, ms=4, alpha=0.5)
    right.plot(inputs, inputs, color="#777777", lw=1, label="as at the start")
    left.set(xlabel="error at the start (rad rms)", ylabel="loops that close (%)", ylim=(-3, 103))
    right.set(xlabel="error at the start (rad rms)", ylabel="settled residual (rad rms)")
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def star_columns(runs: StarRuns) -> dict[str, NDArray]:
    """Columns of the figure: the median residual for each star and method."""
    columns = {}
    for magnitude, methods in runs.items():
        for name, run in methods.items():
            columns["time (s)"] = run.times
            columns[f"{name}, magnitude {magnitude:g}: median (rad rms)"] = np.median(run.residual, axis=0)
    return columns


def capture_columns(inputs: Sequence[float], runs: CaptureRuns) -> dict[str, Sequence[float]]:
    """Columns of the figure: the fraction of loops that close, and their residual, for each start."""
    columns = {"start (rad rms)": inputs}
    for name in runs[0]:
        columns[f"{name}: loops that close"] = [float(np.mean(one[name].closed())) for one in runs]
        columns[f"{name}: median residual of these (rad rms)"] = [one[name].held() for one in runs]
    return columns


def stars_table(runs: StarRuns, photons: Mapping[float, float]) -> Table:
    """Return how many loops close, and the residual and the Strehl ratio of these, for each star and method."""
    return Table(
        [
            "magnitude",
            "photons per step",
            "reconstructor",
            "loops that close",
            "their residual (rad rms)",
            "their Strehl ratio",
        ],
        [
            [
                f"{magnitude:g}",
                f"{photons[magnitude]:.2g}",
                LOOKS[name].name,
                f"{np.count_nonzero(run.closed())} of {len(run.residual)}",
                f"{run.held():.2g}",
                f"{np.median(run.strehl[run.closed(), run.last_third]):.2f}" if run.closed().any() else "–",
            ]
            for magnitude, methods in runs.items()
            for name, run in methods.items()
        ],
    )


def numbers(
    stars: StarRuns, lag: LoopRun, inputs: Sequence[float], runs: CaptureRuns, settings: Mapping[str, float]
) -> dict[str, float | str]:
    """Return settings, share and residual of the loops that close, and the error up to which all close.

    `lag` is the loop without noise.
    """
    found = dict(settings) | {"faintest": max(stars), "n_screens": len(lag.residual), "lag": lag.held()}
    bright, faint = stars[min(stars)], stars[max(stars)]
    for name in bright:
        found |= {
            f"closed_{name}": max(int(one[name].closed().sum()) for one in stars.values()),
            f"bright_{name}": bright[name].held(),
            f"faint_{name}": faint[name].held(),
        }
    for name in runs[0]:
        closing = [value for value, one in zip(inputs, runs, strict=True) if one[name].closed().all()]
        found[f"all_close_{name}"] = max(closing, default=0.0)
    return rounded(found)
