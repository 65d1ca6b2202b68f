"""One image or two: the best method with each, in open loop and in closed loop, on a bench with errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.kit import sweeps
from studies.kit.bench import poked_frames, poked_linear
from studies.kit.parameters import parameter_limits
from studies.kit.results import rounded
from studies.kit.style import OTHER_STYLES, TALL
from studies.kit.tables import MISSING, Table, Text, with_zeros
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
_N_DARKS = 16  # averaged


RATE, DELAY, N_STEPS = 1000.0, 2, 40  # of the loops: 1/s, steps, steps
WIND = {"speed": 2.5, "cutoff": 3.0, "exponent": -2.0}
GAINS = 0.1, 0.2, 0.6, 0.8
"""Settings of the loops."""
_ON_BENCH = {"Linear": "classic", "LinearTwo": "shifted"}
"""Methods of the loops, and their sensors in `BenchModel`."""
_MARKERS: dict[str, dict[str, Any]] = {
    "two images": {"color": OTHER_STYLES[0]["color"], "marker": "o", "ms": 11, "mfc": "none", "mew": 2},
    "one image": {"color": OTHER_STYLES[1]["color"], "marker": "X", "ms": 8},
}
_ALIKE = 1.1  # ratio of errors up to which two methods count as equal


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
    def of(cls, recorded: RecordedBench, photons: float, n_images: int) -> Camera:
        """Return the camera with photons per point and image of two; one image gets those of both."""
        light = photons if n_images == 2 else 2 * photons / (1 + recorded.bench.flux_imbalance)
        share = light * np.count_nonzero(recorded.bench.segments) / recorded.bench.photons_per_image
        return cls(dimmed(recorded.bench, light), share * recorded.dark, share, n_images)

    def shot(self, commands: NDArray, seed: np.random.SeedSequence | np.random.Generator) -> Shot:
        """Take frames of commands, (..., n_segments)."""
        return Shot((self.bench.frames(commands, seed) - self.dark)[..., : self.n_images, :, :], self.share)


@dataclass(frozen=True, eq=False)
class RecordedBench:
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


def know_bench(bench: Bench, photons: float, poke: float, *, seed: int) -> RecordedBench:
    """Record what the methods know of a bench, with photons per pixel of the pupil in each frame."""
    bench = dimmed(bench, photons)
    masked, *darks = np.random.SeedSequence(seed).spawn(1 + _N_DARKS)
    dark = np.mean([bench.dark(draw) for draw in darks], axis=0)
    model = BenchModel.from_images(bench, seed)
    return RecordedBench(
        bench, dark, bench.frames(None, masked) - dark, model, poked_frames(bench, model, poke, seed), poke
    )


def dimmed(bench: Bench, photons: float) -> Bench:
    """Return the bench with other exposures: photons per pixel of the pupil, and background and noise to match."""
    total = photons * np.count_nonzero(bench.segments)
    share = total / bench.photons_per_image
    background, read_noise = share * bench.background, np.sqrt(share) * bench.read_noise
    return replace(bench, photons_per_image=total, background=background, read_noise=read_noise)


def shots(recorded: RecordedBench, photons: float, commands: NDArray, seed: np.random.SeedSequence) -> list[Shot]:
    """Take frames of commands with one image and with two.

    `photons` are those per point and image of two; one image gets those of both. On its own the first image would
    be brighter than the mean of the two by the imbalance of the bench.
    """
    cameras = [Camera.of(recorded, photons, n_images) for n_images in (1, 2)]
    return [camera.shot(commands, noise) for camera, noise in zip(cameras, seed.spawn(2), strict=True)]


def open_loop_errors(
    benches: Mapping[str, RecordedBench],
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
    benches: Mapping[str, RecordedBench],
    situations: Mapping[str, Sequence[Situation]],
    n_screens: Mapping[str, int],
    n_iterations: int,
    seed: int,
) -> dict[str, NDArray[np.float64]]:
    """Errors of all methods in a situation, (n_screens,); each subtracts its estimate of the flat command."""
    name, row = task
    recorded, (rms, photons) = benches[name], situations[name][row]
    draws, noise = np.random.SeedSequence(seed, spawn_key=(row,)).spawn(2)
    model, bench = recorded.model, recorded.bench
    commands = segment_screens(bench, rms, n_screens[name], seed=draws)
    alone, pair = shots(recorded, photons, commands, noise)

    errors = {}
    for method, reconstruct in _methods(recorded, photons, n_iterations).items():
        n_images = reconstruct.sensor.n_masks
        shot = alone if n_images == 1 else pair
        counts = np.concatenate([recorded.flat[np.newaxis, :n_images], shot.counts / shot.share])
        pistons = model.pistons(reconstruct(counts / model.scale[:n_images]).phase)
        residual = segment_residual(pistons[1:] - pistons[0], commands)
        errors[method] = np.sqrt(np.mean(residual**2, axis=-1))
    return errors


def _methods(recorded: RecordedBench, photons: float, n_iterations: int) -> dict[str, Any]:
    """Return the methods that know the design of the mask, the clear frames, and the response to pokes."""
    classic, shifted, modes = recorded.model.classic, recorded.model.shifted, recorded.model.modes
    share = photons * np.count_nonzero(recorded.bench.segments) / recorded.bench.photons_per_image
    noise = np.sqrt(share) * recorded.noise  # of a pixel without light, as in `shots`
    # Of maximum likelihood, the first start explains the frames or no start does.
    return {
        "Linear": poked_linear(classic, recorded.model, recorded.poked, recorded.poke),
        "Arcsine": Arcsine(classic, n_iterations=n_iterations),
        "LikelihoodOne": MaximumLikelihood(
            classic, modes, photons=2 * photons, read_noise=noise * 2**0.5, n_starts=1
        ),
        "LinearTwo": poked_linear(shifted, recorded.model, recorded.poked, recorded.poke),
        "PhaseShifted": PhaseShifted(shifted, n_iterations=n_iterations),
        "Accelerated": PhaseShifted(shifted, n_iterations=n_iterations, accelerate=True),
        "MaximumLikelihood": MaximumLikelihood(shifted, n_starts=1, photons=photons, read_noise=noise),
    }


class Loops(NamedTuple):
    """Loops that were closed with one method, at its best gain."""

    gain: float
    residuals: NDArray[np.float64]  # (n_loops,), rad rms over the segments

    def closed(self, start: float) -> NDArray[np.bool_]:
        """Whether each loop ends below half of the error at its start."""
        return self.residuals < start / 2


def bench_loops(
    recorded: RecordedBench, situations: Sequence[Situation], n_loops: int, seed: int
) -> list[dict[str, Loops]]:
    """Close linear loops on a bench in each situation, with one image and with two.

    The response to pokes calibrates the method, and the mirror is led to its flat command.
    """
    tasks = [(situation, name) for situation in situations for name in _ON_BENCH]
    loops = sweeps.run(_tuned_on_bench, tasks, recorded, n_loops, seed, name="bench_loops")
    size = len(_ON_BENCH)
    return [
        dict(zip(_ON_BENCH, loops[first:last], strict=True))
        for first, last in pairwise(range(0, len(loops) + 1, size))
    ]


def _tuned_on_bench(task: tuple[Situation, str], recorded: RecordedBench, n_loops: int, seed: int) -> Loops:
    """Choose the gain on a sixth as many screens, and close loops on new ones."""
    (rms, photons), name = task
    linear = poked_linear(getattr(recorded.model, _ON_BENCH[name]), recorded.model, recorded.poked, recorded.poke)
    camera = Camera.of(recorded, photons, linear.sensor.n_masks)
    first, then = map(int, np.random.SeedSequence(seed).generate_state(2))
    few = drifting_pistons(recorded.bench, rms, max(1, n_loops // 6), first)
    scores = {gain: typical(_close_loops(recorded, linear, camera, gain, few, first)) for gain in GAINS}
    best = min(scores, key=lambda gain: scores[gain])
    many = drifting_pistons(recorded.bench, rms, n_loops, then)
    return Loops(best, _close_loops(recorded, linear, camera, best, many, then))


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
    recorded: RecordedBench, linear: Any, camera: Camera, gain: float, pistons: NDArray, seed: int
) -> NDArray[np.float64]:
    """Residuals of loops over their last third, (n_screens,), rad rms over the segments."""
    model, k = recorded.model, linear.sensor.n_masks
    noise = np.random.default_rng([seed, 1])  # not that of the screens
    flat = model.pistons(linear(recorded.flat[:k] / model.scale[:k]).phase)
    mirror = [np.zeros(pistons[:, 0].shape)] * DELAY
    residual = []
    for drifted in pistons.swapaxes(0, 1):
        residual.append(drifted + mirror[-DELAY])
        counts, share = camera.shot(residual[-1], noise)
        measured = model.pistons(linear(counts / share / model.scale[:k]).phase) - flat
        mirror.append(mirror[-1] - gain * measured)
    # Not modulo 2 pi: a segment that is a wave off is not flat, though the sensor sees no error.
    return np.sqrt(np.mean(np.var(residual[-(len(residual) // 3) :], axis=-1), axis=0))


def typical(errors: NDArray) -> float:
    """Geometric mean of errors, which counts loops that diverged without ignoring the others."""
    return float(np.exp(np.mean(np.log(errors))))


@dataclass(frozen=True)
class Row:
    """One situation: the best method with one image and with two, in this order."""

    bench: str  # in words; none for a loop
    at: Situation
    methods: tuple[str, str]
    errors: tuple[float, float]  # rad rms: geometric means, in loops of those that close
    closed: tuple[int, int] = (0, 0)  # loops that close
    n_loops: int = 0  # none in open loop

    @property
    def gain(self) -> float:
        """Error with one image over that with two."""
        return self.errors[0] / self.errors[1]

    @property
    def start(self) -> str:
        """Wavefront error in words."""
        return f"{self.at.rms:g} rad rms"

    @property
    def method(self) -> str:
        """Methods in words."""
        single, pair = self.methods
        return pair if single == pair else f"{pair}; one image: {single}"

    def error(self, n_images: int) -> str:
        """Error in words; none where at most half of the loops close."""
        few = self.n_loops > 0 and self.closed[n_images - 1] <= self.n_loops / 2
        return MISSING if few else with_zeros(self.errors[n_images - 1])


def simplest(errors: Mapping[str, NDArray], names: Iterable[str]) -> str:
    """Name of the first method whose error is within `_ALIKE` of the smallest one."""
    means = {name: typical(errors[name]) for name in names}
    return next(name for name, mean in means.items() if mean <= _ALIKE * min(means.values()))


def open_rows(
    situations: Mapping[str, Sequence[Situation]], errors: Mapping[str, Sequence[Mapping[str, NDArray]]]
) -> list[Row]:
    """Rows of the open loop, for each bench."""
    rows = []
    for bench, cases in errors.items():
        for situation, case in zip(situations[bench], cases, strict=True):
            single, pair = simplest(case, ONE_IMAGE), simplest(case, TWO_IMAGES)
            means = typical(case[single]), typical(case[pair])
            rows.append(Row(BENCHES[bench], situation, (ONE_IMAGE[single], TWO_IMAGES[pair]), means))
    return in_order(rows)


def loop_rows(situations: Sequence[Situation], loops: Sequence[Mapping[str, Loops]]) -> list[Row]:
    """Rows of the closed loops."""
    rows = []
    for situation, tuned in zip(situations, loops, strict=True):
        methods, errors, counts = [], [], []
        for name in _ON_BENCH:
            closed = tuned[name].closed(situation.rms)
            methods.append(f"linear, gain {tuned[name].gain:g}")
            errors.append(typical(tuned[name].residuals[closed if closed.any() else ~closed]))
            counts.append(int(closed.sum()))
        single, pair = methods
        rows.append(
            Row("", situation, (single, pair), (errors[0], errors[1]), (counts[0], counts[1]), closed.size)
        )
    return in_order(rows)


def in_order(rows: Iterable[Row]) -> list[Row]:
    """Rows of the same bench one after the other, small errors and bright light first."""
    benches = ["", *BENCHES.values()]
    return sorted(rows, key=lambda row: (benches.index(row.bench), row.at.rms, -row.at.photons))


def findings(open_loop: Sequence[Row], loops: Sequence[Row]) -> Text:
    """Say where two images are better than one, and by how much."""
    better = [row for row in open_loop if row.gain > _ALIKE]
    text = f"In open loop, two images have the smaller error in {len(better)} of {len(open_loop)} cases"
    if better:
        most = max(better, key=lambda row: row.gain)
        text += f", by a factor of up to {with_zeros(most.gain)} ({_case(most)})"
    alike = [_case(row) for row in open_loop if 1 / _ALIKE <= row.gain <= _ALIKE]
    worse = [_case(row) for row in open_loop if row.gain < 1 / _ALIKE]
    text += "." + "".join(
        f" {words}: {', '.join(cases)}."
        for words, cases in (("About equal", alike), ("One image is better", worse))
        if cases
    )
    unequal = [row for row in loops if row.closed[0] != row.closed[1]]
    equal = [f"{row.closed[0]} at {_start(row)}" for row in loops if row not in unequal]
    text += f"\n\nIn closed loop, of {loops[0].n_loops} loops each, "
    if unequal:
        counts = [f"{row.closed[1]} instead of {row.closed[0]} at {_start(row)}" for row in unequal]
        text += f"these close with two images instead of one: {'; '.join(counts)}. "
    if equal:
        text += f"{'E' if unequal else 'e'}qually many close with both: {'; '.join(equal)}."
    return Text(text.strip())


def _start(row: Row) -> str:
    return f"{row.start} and {_light(row)}"


def _case(row: Row) -> str:
    return f"{row.bench}, {row.start}, {_light(row)}"


def _light(row: Row) -> str:
    return f"{row.at.photons:g} photon{'' if row.at.photons == 1 else 's'}"


def draw_comparison(open_loop: Sequence[Row], loops: Sequence[Row]) -> Figure:
    """Errors in open loop and loops that close, with two images and with one."""
    figure, (open_axes, loop_axes) = plt.subplots(1, 2, figsize=(7.5, 5), width_ratios=(1.25, 1))
    errors = [row.errors for row in open_loop]
    _pairs(open_axes, open_loop, errors, with_zeros)
    room = np.min(errors) / 3, 3 * np.max(errors)  # for the numbers at the markers
    open_axes.set(xscale="log", xlim=room, title="open loop", xlabel="error (rad rms)")
    n_loops = loops[0].n_loops
    _pairs(loop_axes, loops, [row.closed for row in loops], str)
    loop_axes.set(xlim=(-0.1 * n_loops, 1.1 * n_loops), xticks=(0, n_loops / 2, n_loops))
    loop_axes.set(title="closed loop", xlabel=f"loops that close (of {n_loops})")
    figure.legend(*open_axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _pairs(axes: Axes, rows: Sequence[Row], values: Sequence[tuple[float, float]], text: Callable) -> None:
    """Mark the values in each row; that with two images is above its marker, that with one image below."""
    places = np.arange(len(rows))[::-1]
    singles, pairs = np.transpose(values)
    axes.hlines(places, singles, pairs, color="#999999", lw=2, zorder=1)
    for (label, style), xs in zip(_MARKERS.items(), (pairs, singles), strict=True):
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
    first = f"{row.bench}\n" if row.bench else ""
    return f"{first}{row.at.rms:g} rad, {_light(row)}"


def open_table(rows: Sequence[Row]) -> Table:
    """Error of the best method with two images and with one, for each bench and wavefront."""
    header = ["situation", "photons per point and image", "error, two images", "error, one image", "method"]
    cells = [
        [f"{row.bench}, {row.start}", f"{row.at.photons:g}", row.error(2), row.error(1), row.method]
        for row in rows
    ]
    return Table(header, cells)


def loop_table(rows: Sequence[Row]) -> Table:
    """Loops that close, residual and gain with two images and with one."""
    header = ["initial error", "photons per point, image and step", "loops that close, two / one image"]
    header += ["error, two images", "error, one image", "method"]
    cells = [
        [
            row.start,
            f"{row.at.photons:g}",
            f"{row.closed[1]} / {row.closed[0]}",
            row.error(2),
            row.error(1),
            row.method,
        ]
        for row in rows
    ]
    return Table(header, cells)


def numbers(rms: float, rms_small: float, errors: Mapping[str, Sequence[Mapping[str, NDArray]]]) -> dict[str, Any]:
    """Numbers that other pages quote: inputs, and errors of two images on the bench with errors."""
    large, _, small = ({name: typical(values) for name, values in case.items()} for case in errors["real"])
    return rounded(
        {
            "rms": rms,
            "rms_small": rms_small,
            "real_large": min(large[name] for name in TWO_IMAGES),
            "real_small": small["LinearTwo"],
            "fine_large": typical(errors["fine"][0]["PhaseShifted"]),
        },
        ".2g",
    )
