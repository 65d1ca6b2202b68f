"""The method that measures best: one image or two, much light or little, the bench known or only its design."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.bench import poked_frames, poked_linear
from studies.kit.loops import (
    ALIKE,
    BestMethods,
    TunedLoops,
    one_over_two,
    paired_ratio,
    short_name,
    two_digits,
    typical,
)
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import OTHER_STYLES, TALL
from studies.kit.tables import MISSING, Table
from zwfs import Arcsine, MaximumLikelihood, PhaseShifted, Pupil
from zwfs.bench import Bench, BenchModel, segment_residual, segment_screens
from zwfs.turbulence import FrozenFlow

LIMITS = parameter_limits(
    "n_iterations",
    **dict.fromkeys(("n_pixels", "n_pixels_fine"), (32, 136)),
    extent=(1.1, 2.0),
    photons_calibration=(100.0, 1e9),
    poke=(0.001, 1.5),
    **dict.fromkeys(("rms", "rms_small", "rms_loop", "rms_loop_middle", "rms_loop_small"), (0.01, 4.0)),
    **dict.fromkeys(("photons", "photons_faint"), (10.0, 1e9)),
    **dict.fromkeys(("photons_loop", "photons_loop_faint"), (0.01, 1e9)),
    **dict.fromkeys(("n_screens", "n_screens_fine", "n_screens_perfect", "n_loops"), (2, 1000)),
    other_diameter=(0.1, 2.2),
    other_shift=(0.05, 0.95),
)

QUICK = dict.fromkeys(("n_screens", "n_screens_fine", "n_screens_perfect", "n_loops"), 2)
QUICK |= {"n_pixels": 32, "n_pixels_fine": 32}

BENCHES = {"perfect": "perfect model", "real": "bench with errors", "fine": "bench, finer pixels"}
"""What is known of the bench, and its name in the table."""
ONE_IMAGE = {"Linear": "linear", "Arcsine": "arcsine", "LikelihoodOne": "maximum likelihood on pistons"}
TWO_IMAGES = {
    "LinearTwo": "linear",
    "PhaseShifted": "phase-shifted",
    "Accelerated": "phase-shifted, accelerated",
    "MaximumLikelihood": "maximum likelihood",
}
"""Methods, the simplest first, and their names in the table."""
UNCORRECTED = "PhaseShifted with the offset of its flat"

_N_DARKS = 16  # averaged


RATE, DELAY, N_STEPS = 1000.0, 2, 40  # of the loops: 1/s, steps, steps
WIND = {"speed": 2.5, "cutoff": 3.0, "exponent": -2.0}
GAINS = 0.1, 0.2, 0.6, 0.8
"""Settings of the chapter on closed loops."""
_ON_BENCH = {"Linear": "classic", "LinearTwo": "shifted"}
"""Methods of the loops, and their sensors in `BenchModel`."""
_MARKERS: dict[str, dict[str, Any]] = {
    "two images": {"color": OTHER_STYLES[0]["color"], "marker": "o", "ms": 11, "mfc": "none", "mew": 2},
    "one image": {"color": OTHER_STYLES[1]["color"], "marker": "X", "ms": 8},
}
_MUCH = 3.0  # ratio of errors beyond which one image fails
_DIAMETER = 8.0  # of the telescope that the wind speed in m/s belongs to, m


class Situation(NamedTuple):
    """A row of the table."""

    rms: float  # of the segments, or of the wavefront at the start of a loop, rad
    photons: float  # per point and image of two, in a loop of each step; one image gets the light of both


class Shot(NamedTuple):
    """Frames less the dark, photoelectrons."""

    counts: NDArray[np.float64]  # (..., n_images, ny, nx)
    share: float  # light of the exposure over that of the calibration


class Camera(NamedTuple):
    """A bench with the exposure of one image or of two."""

    bench: Bench
    dark: NDArray[np.float64]  # photoelectrons of the exposure, (2, ny, nx)
    share: float
    n_images: int

    @classmethod
    def of(cls, known: Known, photons: float, n_images: int) -> Camera:
        """Return the camera with photons per point and image of two; one image gets those of both."""
        light = photons if n_images == 2 else 2 * photons / (1 + known.bench.flux_imbalance)
        share = light * np.count_nonzero(known.bench.segments) / known.bench.photons_per_image
        return cls(dimmed(known.bench, light), share * known.dark, share, n_images)

    def shot(self, commands: NDArray, seed: np.random.SeedSequence | np.random.Generator) -> Shot:
        """Take frames of commands, (..., n_segments)."""
        return Shot((self.bench.frames(commands, seed) - self.dark)[..., : self.n_images, :, :], self.share)


@dataclass(frozen=True, eq=False)
class Known:
    """A bench, and what was recorded and modelled on it before the measurements."""

    bench: Bench
    dark: NDArray[np.float64]  # photoelectrons, (2, ny, nx)
    flat: NDArray[np.float64]  # frames of the flat command less the dark, the same
    model: BenchModel
    poked: Sequence[NDArray]
    poke: float

    @property
    def noise(self) -> float:
        """Noise of a pixel without light, photoelectrons rms."""
        return float(np.hypot(np.sqrt(self.bench.background), self.bench.read_noise))


def know_bench(bench: Bench, photons: float, poke: float, *, seed: int) -> Known:
    """Record what the methods know of a bench, with photons per pixel of the pupil in each frame."""
    bench = dimmed(bench, photons)
    masked, *darks = np.random.SeedSequence(seed).spawn(1 + _N_DARKS)
    dark = np.mean([bench.dark(one) for one in darks], axis=0)
    model = BenchModel.from_images(bench, seed)
    return Known(
        bench, dark, bench.frames(None, masked) - dark, model, poked_frames(bench, model, poke, seed), poke
    )


def dimmed(bench: Bench, photons: float) -> Bench:
    """Return the bench with other exposures: photons per pixel of the pupil, and background and noise to match."""
    total = photons * np.count_nonzero(bench.segments)
    share = total / bench.photons_per_image
    background, read_noise = share * bench.background, np.sqrt(share) * bench.read_noise
    return replace(bench, photons_per_image=total, background=background, read_noise=read_noise)


def shots(known: Known, photons: float, commands: NDArray, seed: np.random.SeedSequence) -> list[Shot]:
    """Take frames of commands with one image and with two.

    `photons` are those per point and image of two; one image gets those of both. On its own the first image would
    be brighter than the mean of the two by the imbalance of the bench.
    """
    cameras = [Camera.of(known, photons, n_images) for n_images in (1, 2)]
    return [camera.shot(commands, noise) for camera, noise in zip(cameras, seed.spawn(2), strict=True)]


def open_loop_errors(
    benches: Mapping[str, Known],
    situations: Mapping[str, Sequence[Situation]],
    n_screens: Mapping[str, int],
    n_iterations: int,
    seed: int,
) -> dict[str, list[dict[str, NDArray[np.float64]]]]:
    """Errors of all methods on each bench in its situations, (n_screens,) by name, rad rms over the segments."""
    tasks = [(name, row) for name in benches for row in range(len(situations[name]))]
    shared = benches, situations, n_screens, n_iterations, seed
    errors = iter(sweeps.run(_errors, tasks, *shared, name="open_loop_errors"))
    return {name: [next(errors) for _ in situations[name]] for name in benches}


def _errors(
    task: tuple[str, int],
    benches: Mapping[str, Known],
    situations: Mapping[str, Sequence[Situation]],
    n_screens: Mapping[str, int],
    n_iterations: int,
    seed: int,
) -> dict[str, NDArray[np.float64]]:
    """Errors of all methods in a situation, (n_screens,); each subtracts what it finds for the flat command."""
    name, row = task
    known, (rms, photons) = benches[name], situations[name][row]
    draws, noise = np.random.SeedSequence(seed, spawn_key=(row,)).spawn(2)
    model, bench = known.model, known.bench
    commands = segment_screens(bench, rms, n_screens[name], seed=draws)
    alone, pair = shots(known, photons, commands, noise)

    def errors(pistons: NDArray) -> NDArray[np.float64]:
        return np.sqrt(np.mean(segment_residual(pistons, commands) ** 2, axis=-1))

    found = {}
    for method, reconstruct in _methods(known, photons, n_iterations).items():
        n_images = reconstruct.sensor.n_masks
        shot = alone if n_images == 1 else pair
        counts = np.concatenate([known.flat[np.newaxis, :n_images], shot.counts / shot.share])
        pistons = model.pistons(reconstruct(counts / model.scale[:n_images]).phase)
        found[method] = errors(pistons[1:] - pistons[0])
        if method == "PhaseShifted":
            found[UNCORRECTED] = errors(pistons[1:])
    return found


def _methods(known: Known, photons: float, n_iterations: int) -> dict[str, Any]:
    """Return the methods that know the design of the mask, the clear frames, and the response to pokes."""
    one, two, modes = known.model.classic, known.model.shifted, known.model.modes
    share = photons * np.count_nonzero(known.bench.segments) / known.bench.photons_per_image
    noise = np.sqrt(share) * known.noise  # of a pixel without light, as in `shots`
    # Of maximum likelihood, the first start explains the frames or no start does.
    return {
        "Linear": poked_linear(one, known.model, known.poked, known.poke),
        "Arcsine": Arcsine(one, n_iterations=n_iterations),
        "LikelihoodOne": MaximumLikelihood(one, modes, photons=2 * photons, read_noise=noise * 2**0.5, n_starts=1),
        "LinearTwo": poked_linear(two, known.model, known.poked, known.poke),
        "PhaseShifted": PhaseShifted(two, n_iterations=n_iterations),
        "Accelerated": PhaseShifted(two, n_iterations=n_iterations, accelerate=True),
        "MaximumLikelihood": MaximumLikelihood(two, n_starts=1, photons=photons, read_noise=noise),
    }


def bench_loops(known: Known, situations: Sequence[Situation], n_screens: int, seed: int) -> list[BestMethods]:
    """Close linear loops on a bench, with the wind, the delay and the gains of the chapter on closed loops.

    The response to pokes calibrates the method, and the mirror is led to its flat command.
    """
    tasks = [(situation, name) for situation in situations for name in _ON_BENCH]
    found = iter(sweeps.run(_tuned_on_bench, tasks, known, n_screens, seed, name="bench_loops"))
    compared = []
    for rms, photons in situations:
        each = zip(*islice(found, len(_ON_BENCH)), strict=True)
        gains, chosen, settled = (dict(zip(_ON_BENCH, some, strict=True)) for some in each)
        loops = TunedLoops(rms, photons, gains, chosen, settled)
        compared.append(BestMethods.of(loops, "Linear", "LinearTwo"))
    return compared


def dimple_ratios(loops: Sequence[BestMethods], known: Known, n_screens: int, seed: int) -> list[float]:
    """Residual of two images on a bench with other dimples over that of these loops, which differ in nothing else.

    Each is the ratio of the geometric means over the loops that close with both; NaN if there are none.
    """
    tasks = [(Situation(one.loops.start, one.loops.photons), "LinearTwo") for one in loops]
    found = sweeps.run(_tuned_on_bench, tasks, known, n_screens, seed, name="dimple_ratios")
    ratios = []
    for one, (_, _, other) in zip(loops, found, strict=True):
        usual = one.loops.settled["LinearTwo"]
        both = np.maximum(usual, other) < one.loops.start / 2
        ratios.append(paired_ratio(other[both], usual[both])[0] if both.any() else np.nan)
    return ratios


def _tuned_on_bench(
    task: tuple[Situation, str], known: Known, n_screens: int, seed: int
) -> tuple[float, float, NDArray[np.float64]]:
    """Best gain on a sixth as many screens, the residual there, and the residuals on new screens, rad rms."""
    (rms, photons), name = task
    linear = poked_linear(getattr(known.model, _ON_BENCH[name]), known.model, known.poked, known.poke)
    camera = Camera.of(known, photons, linear.sensor.n_masks)
    first, then = map(int, np.random.SeedSequence(seed).generate_state(2))
    few = drifting_pistons(known.bench, rms, max(1, n_screens // 6), first)
    scores = {gain: typical(_close_loops(known, linear, camera, gain, few, first)) for gain in GAINS}
    best = min(scores, key=lambda gain: scores[gain])
    many = drifting_pistons(known.bench, rms, n_screens, then)
    return best, scores[best], _close_loops(known, linear, camera, best, many, then)


def drifting_pistons(bench: Bench, rms: float, n_screens: int, seed: int) -> NDArray[np.float64]:
    """Pistons of the segments under screens that the wind moves, (n_screens, n_steps, n_segments), rad.

    Each sequence starts with this error over the segments.
    """
    flow = FrozenFlow(Pupil.circular(bench.n_pixels), rms, n_screens, **WIND, seed=seed)
    members = bench.segments.ravel() == bench.numbers[:, np.newaxis]
    means = (members / members.sum(axis=1, keepdims=True)).T
    steps = range(N_STEPS)
    pistons = np.stack([flow(step / RATE).reshape(n_screens, -1) @ means for step in steps], axis=1)
    pistons -= pistons.mean(axis=-1, keepdims=True)
    return pistons * (rms / pistons[:, 0].std(axis=-1))[:, np.newaxis, np.newaxis]


def _close_loops(
    known: Known, linear: Any, camera: Camera, gain: float, pistons: NDArray, seed: int
) -> NDArray[np.float64]:
    """Residuals of loops over their last third, (n_screens,), rad rms over the segments."""
    model, k = known.model, linear.sensor.n_masks
    noise = np.random.default_rng([seed, 1])  # not that of the screens
    flat = model.pistons(linear(known.flat[:k] / model.scale[:k]).phase)
    mirror = [np.zeros(pistons[:, 0].shape)] * DELAY
    residual = []
    for wanted in pistons.swapaxes(0, 1):
        residual.append(wanted + mirror[-DELAY])
        counts, share = camera.shot(residual[-1], noise)
        found = model.pistons(linear(counts / share / model.scale[:k]).phase) - flat
        mirror.append(mirror[-1] - gain * found)
    # Not modulo 2 pi: a segment that is a wave off is not flat, though the sensor sees no error.
    return np.sqrt(np.mean(np.var(residual[-(len(residual) // 3) :], axis=-1), axis=0))


@dataclass(frozen=True)
class Cell:
    """Best method with one image and with two, and how they compare."""

    one: str
    two: str
    typical: tuple[float, float]  # errors with one and two images, rad rms: geometric mean, of loops that close
    ratio: float  # error with two images over that with one
    low: float  # the ratio less and plus twice its standard error
    high: float
    closed: tuple[int, int] | None = None  # loops that close with one and two images
    n_loops: int = 0

    @property
    def images(self) -> int | None:
        """Number of images that wins, None if the two differ by less than twice the standard error or `ALIKE`."""
        if max(self.ratio, 1 / self.ratio) <= ALIKE:
            return None
        return 2 if self.high < 1 else 1 if self.low > 1 else None

    @property
    def texts(self) -> dict[str, str]:
        """Errors with two images and with one, methods, and loops that close; no error where at most half do."""
        one, two = self._error(0), self._error(1)
        alike = self.one == self.two or one == MISSING
        method = self.two if alike else f"{self.two}; one image: {self.one}"
        first, both = self.closed or (MISSING, MISSING)
        closed = {"closed": f"{both} / {first}", "closed_one": f"{first}", "closed_two": f"{both}"}
        return {"two": two, "one": one, "method": method, **closed}

    def _error(self, place: int) -> str:
        few = self.closed is not None and self.closed[place] <= self.n_loops / 2
        return MISSING if few else two_digits(self.typical[place])


def simplest(errors: Mapping[str, NDArray], names: Iterable[str]) -> str:
    """Name of the first method that agrees with the best one within the scatter, or within `ALIKE`."""
    known = [name for name in names if name in errors]
    best = min(known, key=lambda name: typical(errors[name]))
    return next(name for name in known if name == best or paired_ratio(errors[name], errors[best])[1] <= ALIKE)


def open_cell(errors: Mapping[str, NDArray]) -> Cell:
    """Compare the methods in open loop."""
    one, two = simplest(errors, ONE_IMAGE), simplest(errors, TWO_IMAGES)
    both = typical(errors[one]), typical(errors[two])
    return Cell(ONE_IMAGE[one], TWO_IMAGES[two], both, *paired_ratio(errors[two], errors[one]))


def loop_cell(found: BestMethods) -> Cell:
    """Result of the study of closed loops."""
    loops, names = found.loops, (found.one, found.two)
    closed = [loops.closed(name) for name in names]
    left = [
        typical(loops.settled[name][ends if ends.any() else ~ends])
        for name, ends in zip(names, closed, strict=True)
    ]
    counts = int(closed[0].sum()), int(closed[1].sum())
    one, two = (f"{short_name(name)}, gain {loops.gains[name]:g}" for name in names)
    return Cell(one, two, (left[0], left[1]), found.ratio, found.low, found.high, counts, closed[0].size)


class Row(NamedTuple):
    """A row of the figure and of a table."""

    key: str
    bench: str  # in words; none for a loop
    at: Situation
    cell: Cell

    @property
    def start(self) -> str:
        """Wavefront error in words."""
        return f"{self.at.rms:g} rad rms"

    @property
    def photons(self) -> str:
        """Photons per point and image of two."""
        return f"{self.at.photons:g}"


def open_rows(
    situations: Mapping[str, Sequence[Situation]], errors: Mapping[str, Sequence[Mapping[str, NDArray]]]
) -> list[Row]:
    """Rows of the open loop, for each bench."""
    return [
        Row(f"{bench}_{index}", BENCHES[bench], situation, open_cell(some))
        for bench, rows in errors.items()
        for index, (situation, some) in enumerate(zip(situations[bench], rows, strict=True), 1)
    ]


def loop_rows(found: Sequence[BestMethods]) -> list[Row]:
    """Rows of the closed loops."""
    return [
        Row(f"closed_{index}", "", Situation(one.loops.start, one.loops.photons), loop_cell(one))
        for index, one in enumerate(found, 1)
    ]


def in_order(rows: Iterable[Row]) -> list[Row]:
    """Rows of the same bench one after the other, small errors and bright light first."""
    benches = ["", *BENCHES.values()]
    return sorted(rows, key=lambda row: (benches.index(row.bench), row.at.rms, -row.at.photons))


def draw_comparison(open_loop: Sequence[Row], loops: Sequence[Row]) -> Figure:
    """Errors in open loop and loops that close, with two images and with one."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 5), width_ratios=(1.25, 1))
    open_loop, loops = in_order(open_loop), in_order(loops)
    errors = [row.cell.typical for row in open_loop]
    _pairs(left, open_loop, errors, two_digits)
    room = np.min(errors) / 3, 3 * np.max(errors)  # for the numbers at the markers
    left.set(xscale="log", xlim=room, title="open loop", xlabel="error (rad rms)")
    n_loops = loops[0].cell.n_loops
    _pairs(right, loops, [row.cell.closed or (0, 0) for row in loops], str)
    right.set(xlim=(-0.1 * n_loops, 1.1 * n_loops), xticks=(0, n_loops / 2, n_loops))
    right.set(title="closed loop", xlabel=f"loops that close (of {n_loops})")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _pairs(axes: Axes, rows: Sequence[Row], values: Sequence[tuple[float, float]], text: Callable) -> None:
    """Mark the values in each row; that with two images is above its marker, that with one image below."""
    places = np.arange(len(rows))[::-1]
    one, two = np.transpose(values)
    axes.hlines(places, one, two, color="#999999", lw=2, zorder=1)
    for (label, style), xs in zip(_MARKERS.items(), (two, one), strict=True):
        axes.plot(xs, places, ls="none", label=label, **style)
    for place, (single, pair) in zip(places, values, strict=True):
        alike = text(single) == text(pair)
        _write(axes, pair, place, text(pair), "black" if alike else _MARKERS["two images"]["color"], up=True)
        if not alike:
            _write(axes, single, place, text(single), _MARKERS["one image"]["color"], up=False)
    axes.set_yticks(places, [_label(row) for row in rows])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.grid(axis="y", visible=False)
    axes.set_gid(TALL)


def _write(axes: Axes, x: float, y: float, text: str, color: str, *, up: bool) -> None:
    place: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom" if up else "top"}
    axes.annotate(text, (x, y), (0, 6 if up else -5), color=color, **place)


def _label(row: Row) -> str:
    light = f"{row.photons} photon{'' if row.photons == '1' else 's'}"
    first = f"{row.bench}\n" if row.bench else ""
    return f"{first}{row.at.rms:g} rad, {light}"


def open_table(rows: Sequence[Row]) -> Table:
    """Error of the best method with two images and with one, and their ratio, for each bench and wavefront."""
    header = ["situation", "photons per point and image", "error, two images", "error, one image", "one over two"]
    header += ["method"]
    return Table(header, [_cells(row, "two", "one", "ratio", "method") for row in in_order(rows)])


def loop_table(rows: Sequence[Row]) -> Table:
    """Loops that close, residual and gain with two images and with one."""
    n_loops = max((row.cell.n_loops for row in rows), default=0)
    header = [
        "initial error",
        "photons per point, image and step",
        f"loops that close (of {n_loops}), two / one image",
    ]
    header += ["error, two images", "error, one image", "method"]
    return Table(header, [_cells(row, "closed", "two", "one", "method") for row in in_order(rows)])


def _cells(row: Row, *names: str) -> list[str]:
    texts = row.cell.texts | {"ratio": one_over_two(row.cell)}
    situation = f"{row.bench}, {row.start}" if row.bench else row.start
    return [situation, row.photons, *(texts[name] for name in names)]


def _likelihood_ratios(errors: Sequence[Mapping[str, NDArray]]) -> list[float]:
    """Error of maximum likelihood over that of the phase-shifted iteration, in each situation of the open loop."""
    return [paired_ratio(one["MaximumLikelihood"], one["PhaseShifted"])[0] for one in errors]


def numbers(
    rows: Sequence[Row],
    errors: Mapping[str, Sequence[Mapping[str, NDArray]]],
    dimples: Sequence[float],
) -> dict[str, float | str]:
    """Situations and results in words, and extremes."""
    found: dict[str, float | str] = {}
    for row in rows:
        found |= {f"{row.key}_start": row.start, f"{row.key}_photons": row.photons}
        found |= {f"{row.key}_{name}": text for name, text in row.cell.texts.items()}
        found[f"{row.key}_span"] = one_over_two(row.cell)
    [cell] = (row.cell for row in rows if row.key == "real_3")
    small, bright = errors["real"][-1], errors["perfect"][0]
    ratio = bright[simplest(bright, ONE_IMAGE)] / bright[simplest(bright, TWO_IMAGES)]
    return rounded(
        found
        | {
            "gain_real_3": 1 / cell.ratio,
            "gain_real_3_least": 1 / cell.high,
            "gain_real_3_most": 1 / cell.low,
            "one_fails": float(np.mean(ratio > _MUCH)),
            "likelihood_least": min(_likelihood_ratios(errors["perfect"])),
            "likelihood_most": max(_likelihood_ratios(errors["perfect"])),
            "offset_ratio": paired_ratio(small[UNCORRECTED], small[simplest(small, ONE_IMAGE)])[0],
            "flat_ratio": paired_ratio(small["PhaseShifted"], small[simplest(small, ONE_IMAGE)])[0],
            "fine_iteration": typical(errors["fine"][0]["PhaseShifted"]),
            "dimple_least": min(dimples),
            "dimple_most": max(dimples),
            "loop_rate": RATE / 1e3,
            "loop_delay": DELAY,
            "loop_wind": WIND["speed"] * _DIAMETER,
            "loop_diameter": _DIAMETER,
            "loop_gain_least": min(GAINS),
            "loop_gain_most": max(GAINS),
        },
        ".3g",
    )
