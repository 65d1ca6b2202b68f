"""Figure 5: the layout of the bench, drawn and in numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from studies.kit.bench import check_bench
from studies.kit.drawings import METAL, MINUS, PLUS, RETARDER, Point, Scene, focal_light, mask_picture, shift_label
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from zwfs import Dimple, Pupil, strehl
from zwfs.bench import Bench

LIMITS = parameter_limits("rms exponent", wavelength=(100.0, 20000.0), bench=bench_fields())
CHECK_TOGETHER = check_bench


def draw_bench_layout(bench: Bench, pistons: NDArray, frames: NDArray, wavelength: float) -> Figure:
    """Figure 5: simplified layout of the SEAL bench, folded at its two deformable mirrors; wavelength in nm."""
    phase = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    scene = Scene(9, 8.2)
    top, bottom, corner, f, f_last, half = 7.3, 1.3, 8.25, 1.5, 1.75, 0.27
    stop, focus, camera = corner - 4 * f, corner - 2 * f_last, corner - 4 * f_last

    # Each leg takes a pupil to the next one, two lenses and four focal lengths on.
    relay = [(stop + f, half), (stop + 2 * f, 0), (stop + 3 * f, half), (corner - half, half)]
    scene.beam([(0.75, 0), (1.45, half), *relay], origin=(0, top))
    down = (top - bottom) / 4
    scene.beam(
        [(half, half), (down, half), (2 * down, 0), (3 * down, half), (4 * down - half, half)],
        origin=(corner, top),
        angle=-np.pi / 2,
    )
    prism = camera + 1.25
    scene.beam(
        [(half, half), (f_last, half), (2 * f_last, 0), (3 * f_last, half), (corner - prism, half)],
        origin=(corner, bottom),
        angle=np.pi,
    )
    for y, side in ((top, -1), (bottom, 1)):
        inner = y + side * half
        scene.corner((corner - half, y - half), (corner - half, y + half), (corner + half, inner))
    _source(scene, 0.75, top, wavelength)
    scene.stop(stop, top, half, 0.5)
    scene.label(stop, top + 0.58, "pupil stop")
    scene.arrows(2.55, 3.05, top, 0.13)
    for x in (1.45, stop + f, stop + 3 * f):
        scene.lens(x, top, 0.9)
    for y in (top - down, bottom + down):
        scene.lens(corner, y, 0.9, angle=np.pi / 2)
    _segmented_mirror(scene, (corner, top), np.pi / 4, bench, pistons)
    scene.label(8.85, top + 0.6, "IrisAO segmented mirror", ha="right")
    _actuated_mirror(scene, (corner, bottom), -np.pi / 4)
    scene.label(8.85, bottom - 0.72, "BMC deformable mirror", ha="right")

    scene.split_beam((prism, bottom), camera, half, 0.37)
    scene.edges([(focus, 0), (focus - f_last, half), (prism, half)], origin=(0, bottom))
    for x in (focus + f_last, focus - f_last):
        scene.lens(x, bottom, 0.9)
    scene.plate(focus, bottom, 0.07, 0.3, RETARDER)
    scene.label(focus, bottom - 0.4, "vector\nmask", va="top")
    scene.plate(focus - 0.75, bottom, 0.09, 0.6, "#d9c7e8", edge=RETARDER)
    scene.label(focus - 1.0, bottom - 0.4, "quarter-\nwave plate", va="top")
    scene.wollaston(prism, bottom, 0.24, 0.85)
    scene.label(prism, bottom - 0.5, "Wollaston\nprism", va="top")
    scene.detector(camera - 0.08, bottom, 1.5)
    scene.callout((camera - 0.04, bottom + 0.75), (camera - 0.04, 3.6))
    scene.label(camera - 0.2, bottom, "camera", ha="right", va="center")
    _bench_pictures(scene, bench, phase, frames)
    return scene.figure


def _bench_pictures(scene: Scene, bench: Bench, phase: NDArray, frames: NDArray) -> None:
    """Computed pictures of Figure 5, next to their elements."""
    pupil = Pupil.from_segments(bench.segments)
    limit = np.nanmax(np.abs(phase))
    left, right, upper, lower, size = 4.75, 6.7, 5.75, 3.3, 1.45
    scene.callout((8.0, 7.05), (right + size / 2, upper + size / 2))
    scene.picture(left, upper, size, pupil.amplitude**2, "gray", 0, pupil.amplitude.max() ** 2)
    scene.label(left, upper + 0.8, "segments in stop")
    shown = scene.picture(right, upper, size, phase, PHASE_MAP, -limit, limit)
    scene.label(right, upper + 0.8, "pistons (rad)")
    scene.scale(shown, (right - 0.7, upper - 0.83, 1.4, 0.06), ticks=2)

    scene.callout((8.0, 1.55), (right + size / 2, lower - size / 2))
    none: dict[str, Any] = dict.fromkeys((*bench.errors(), "photons", "read_noise", "background"), 0)
    quilted = replace(bench, **none | {"quilting": bench.quilting}).frames()[0]
    scene.picture(right, lower, size, quilted, INTENSITY_MAP, 0, quilted.max())
    scene.label(right, lower + 0.8, "quilting")
    mask = Dimple(bench.diameter, bench.phase)
    halo = focal_light(pupil, pupil.field(phase), 4)
    scene.callout((left, 1.3), (left, lower))
    mask_picture(scene, left, lower, size, mask, halo, 4, PLUS)
    scene.label(left, lower + 0.8, f"dimple: {shift_label(mask, plus=True)}")

    for frame, x, look, number in zip(frames, (1.2, 3.05), (PLUS, MINUS), (1, 2), strict=True):
        scene.picture(x, 3.6, 1.72, frame, INTENSITY_MAP, 0, frames.max(), edge=look.color)
        scene.label(x, 4.53, f"image {number}", color=look.color)
    for y, look, text in ((5.95, PLUS, r"sees phase $+\theta$"), (5.55, MINUS, r"sees phase $-\theta$")):
        scene.key(0.35, y, look, text)


def _source(scene: Scene, x: float, y: float, wavelength: float) -> None:
    """Source of light, a point."""
    scene.axes.add_patch(Rectangle((x - 0.73, y - 0.18), 0.7, 0.36, fc=METAL, ec="none"))
    scene.axes.add_patch(Circle((x, y), 0.04, fc="#c1121f", ec="none", zorder=4))
    scene.label(x - 0.38, y - 0.01, "source", color="white", va="center")
    scene.label(x - 0.73, y + 0.27, f"{wavelength:g} nm", ha="left")


def _segmented_mirror(scene: Scene, center: Point, tilt: float, bench: Bench, pistons: NDArray) -> None:
    """Segments along the vertical diameter, each pushed by its command, on a plate."""
    middle = bench.segments[:, bench.segments.shape[1] // 2]
    numbers = [number for number in dict.fromkeys(middle.tolist()) if number]
    moved = dict(zip(bench.numbers.tolist(), pistons / np.abs(pistons).max(initial=1e-9), strict=True))
    width = 0.84 / len(numbers)
    for index, number in enumerate(numbers):
        across = (index - (len(numbers) - 1) / 2) * width
        corners = [(0.045 * moved[number] + s, across + t) for s, t in _box(0.0, 0.16, 0.45 * width)]
        _solid(scene, center, tilt, corners, "#8d99ae", METAL)
    _solid(scene, center, tilt, _box(0.2, 0.3, 0.46), METAL, "none")


def _actuated_mirror(scene: Scene, center: Point, tilt: float) -> None:
    """Continuous mirror on actuators, which leave their print on its face."""
    across = np.linspace(-0.42, 0.42, 127)
    face = [(0.022 * (1 - np.cos(2 * np.pi * t / 0.12)), t) for t in across]
    for t in np.linspace(-0.36, 0.36, 7):
        _solid(scene, center, tilt, [(s, t + d) for s, d in _box(0.1, 0.22, 0.015)], METAL, "none")
    _solid(scene, center, tilt, _box(0.2, 0.3, 0.46), METAL, "none")
    _solid(scene, center, tilt, [*face, (0.12, 0.42), (0.12, -0.42)], "#8d99ae", METAL)


def _box(low: float, high: float, half: float) -> list[Point]:
    """Corners of a rectangle from depth `low` to `high`, of half height `half`."""
    return [(low, -half), (high, -half), (high, half), (low, half)]


def _solid(scene: Scene, center: Point, tilt: float, corners: list[Point], color: str, edge: str) -> None:
    """Polygon given by (depth, height), turned by `tilt` (radian) around `center`."""
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    points = np.asarray(corners) @ turn.T + center
    scene.axes.add_patch(Polygon(points, closed=True, fc=color, ec=edge, lw=0.8, zorder=3))


def piston_columns(bench: Bench, pistons: NDArray) -> dict[str, NDArray]:
    """Piston of each segment."""
    return {"segment": bench.numbers, "piston (rad)": pistons}


def layout_table(bench: Bench, pistons: NDArray, wavelength: float) -> Table:
    """Sizes of the segments, and the pistons (rad) compared with the wavelength (nm)."""
    pupil = Pupil.from_segments(bench.segments)
    number = pupil.gather(bench.segments)
    share = np.bincount(number)[bench.numbers] / np.bincount(number).max()
    center = {one: pupil.points[number == one].mean(axis=0) for one in (1, 3)}
    pitch = float(np.hypot(*(center[3] - center[1])))  # segment 3 touches segment 1
    rms = float(pistons.std())
    return Table(
        ["quantity", "value"],
        [
            ["segments of the mirror", bench.n_segments + len(bench.missing)],
            ["segments in use", bench.n_segments],
            ["segments across the stop", 1 / pitch],
            ["width of a gap (% of a segment)", bench.gap / pitch * 100],
            ["segments with more than 95 % of their area in the stop", int((share > 0.95).sum())],
            ["smallest share of a segment in the stop", float(share.min())],
            ["fill factor of the stop", pupil.n_points / Pupil.circular(bench.n_pixels).n_points],
            ["pistons (rad rms)", rms],
            ["pistons, wavefront (nm rms)", rms * wavelength / (2 * np.pi)],
            ["Strehl ratio with these pistons", float(strehl(pupil, bench.commanded_phase(pistons)))],
        ],
    )
