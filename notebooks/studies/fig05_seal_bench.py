"""Figure 5: the layout of the bench, drawn and in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from studies.kit.bench import check_bench
from studies.kit.drawings import (
    METAL,
    MINUS,
    NARROW,
    NARROW_LETTERS,
    PLUS,
    RETARDER,
    Point,
    Scene,
    focal_light,
    mask_picture,
    shift_label,
)
from studies.kit.parameters import bench_fields, parameter_limits
from studies.kit.style import INTENSITY_MAP, PHASE_MAP
from studies.kit.tables import Table
from studies.kit.variants import add_narrow
from zwfs import Dimple, Pupil, strehl
from zwfs.bench import Bench

LIMITS = parameter_limits("rms exponent", wavelength=(100.0, 20000.0), bench=bench_fields())
CHECK_TOGETHER = check_bench


def draw_bench_layout(bench: Bench, pistons: NDArray, frames: NDArray, wavelength: float) -> Figure:
    """Figure 5: simplified layout of the SEAL bench, folded at its two deformable mirrors; wavelength in nm."""
    pictures = _pictures(bench, pistons, frames)
    wide, narrow = Scene(9, 8.15), Scene(NARROW, 10.3, NARROW_LETTERS)
    _label_wide(wide, _optics(wide, _WIDE, bench, pistons), wavelength, pictures)
    _label_narrow(narrow, _optics(narrow, _FOLDED, bench, pistons), wavelength, pictures)
    for scene, places in ((wide, [(0.35, 5.95), (0.35, 5.55)]), (narrow, [(0.1, 0.1), (1.95, 0.1)])):
        for place, look, sign in zip(places, (PLUS, MINUS), (1, -1), strict=True):
            mask = Dimple(bench.diameter, sign * bench.phase)
            scene.key(*place, look, f"phase {shift_label(mask, plus=True)}")
    return add_narrow(wide.figure, narrow.figure)


@dataclass(frozen=True)
class _Layout:
    """Heights of the first and last leg, corner of the mirrors, focal lengths and sizes, inches."""

    top: float
    bottom: float
    corner: float
    f: float
    f_last: float
    half: float
    source: float
    collimator: float
    prism: float  # from the camera
    lens: float
    apart: float
    mirror: float  # size of a mirror over that of the wide drawing
    to_plate: float  # from the focus to the quarter-wave plate


_WIDE = _Layout(7.3, 1.3, 8.25, 1.5, 1.75, 0.27, 0.75, 1.45, 1.25, 0.9, 0.37, 1.0, 0.75)
_FOLDED = _Layout(9.5, 7.55, 3.22, 0.62, 0.7, 0.15, 0.2, 0.5, 0.56, 0.5, 0.2, 0.55, 0.36)


@dataclass(frozen=True)
class _Found:
    """Distances of elements from the left, inches."""

    at: _Layout
    stop: float
    focus: float
    camera: float
    prism: float


def _optics(scene: Scene, at: _Layout, bench: Bench, pistons: NDArray) -> _Found:
    """Light and optics; each leg takes a pupil to the next one, two lenses and four focal lengths on."""
    top, bottom, corner, f, f_last, half = at.top, at.bottom, at.corner, at.f, at.f_last, at.half
    stop, focus, camera = corner - 4 * f, corner - 2 * f_last, corner - 4 * f_last
    relay = [(stop + f, half), (stop + 2 * f, 0), (stop + 3 * f, half), (corner - half, half)]
    scene.beam([(at.source, 0), (at.collimator, half), *relay], origin=(0, top))
    down = (top - bottom) / 4
    scene.beam(
        [(half, half), (down, half), (2 * down, 0), (3 * down, half), (4 * down - half, half)],
        origin=(corner, top),
        angle=-np.pi / 2,
    )
    prism = camera + at.prism
    scene.beam(
        [(half, half), (f_last, half), (2 * f_last, 0), (3 * f_last, half), (corner - prism, half)],
        origin=(corner, bottom),
        angle=np.pi,
    )
    for y, side in ((top, -1), (bottom, 1)):
        inner = y + side * half
        scene.corner((corner - half, y - half), (corner - half, y + half), (corner + half, inner))
    scene.plate(at.source - 0.1 * at.mirror, top, 0.2 * at.mirror, 0.36 * at.mirror, METAL)
    scene.axes.add_patch(Circle((at.source, top), 0.05, fc="#c1121f", ec="none", zorder=4))
    scene.stop(stop, top, half, 1.85 * half)
    length = 0.35 * min(f, down)
    scene.arrows(stop + 0.28 * f, stop + 0.28 * f + length, top, half / 2)
    for across in (-half / 2, half / 2):
        scene.arrow((corner + across, top - half - 0.1 * f), (corner + across, top - half - 0.1 * f - length))
        scene.arrow(
            (corner - half - 0.25 * f, bottom + across), (corner - half - 0.25 * f - length, bottom + across)
        )
    for x in (at.collimator, stop + f, stop + 3 * f):
        scene.lens(x, top, at.lens)
    for y in (top - down, bottom + down):
        scene.lens(corner, y, at.lens, angle=np.pi / 2)
    _segmented_mirror(scene, (corner, top), np.pi / 4, at.mirror, bench, pistons)
    _actuated_mirror(scene, (corner, bottom), -np.pi / 4, at.mirror)

    scene.split_beam((prism, bottom), camera, half, at.apart)
    scene.edges([(focus, 0), (focus - f_last, half), (prism, half)], origin=(0, bottom))
    for x in (focus + f_last, focus - f_last):
        scene.lens(x, bottom, at.lens)
    scene.plate(focus, bottom, 0.07, 1.1 * half, RETARDER)
    scene.plate(focus - at.to_plate, bottom, 0.09, 2.2 * half, "#d9c7e8", edge=RETARDER)
    scene.wollaston(prism, bottom, 0.27 * at.lens, 0.94 * at.lens)
    scene.detector(camera - 0.08, bottom, 4 * at.apart)
    return _Found(at, stop, focus, camera, prism)


@dataclass(frozen=True)
class _Pictures:
    """Computed pictures next to the elements."""

    amplitude: NDArray
    phase: NDArray
    halo: NDArray
    mask: Dimple
    quilted: NDArray
    frames: NDArray

    def draw(self, scene: Scene, places: Sequence[Point], sizes: Sequence[float], names: Sequence[str]) -> None:
        """Draw stop, pistons, quilting, dimple and both images at their places."""
        limit = float(np.nanmax(np.abs(self.phase)))
        stop, pistons, quilting, dimple, *images = places
        for (x, y), size, name in zip(places, sizes, names, strict=False):
            scene.label(x, y + size / 2 + 0.08, name)
        scene.picture(*stop, sizes[0], self.amplitude**2, "gray", 0, self.amplitude.max() ** 2)
        shown = scene.picture(*pistons, sizes[1], self.phase, PHASE_MAP, -limit, limit)
        x, y = pistons
        scene.scale(shown, (x - 0.48 * sizes[1], y - sizes[1] / 2 - 0.11, 0.96 * sizes[1], 0.06), ticks=2)
        scene.picture(*quilting, sizes[2], self.quilted, INTENSITY_MAP, 0, self.quilted.max())
        mask_picture(scene, *dimple, sizes[3], self.mask, self.halo, 4, PLUS)
        shown_images = zip(self.frames, images, sizes[4:], (PLUS, MINUS), (1, 2), strict=True)
        for frame, (x, y), size, look, number in shown_images:
            scene.picture(x, y, size, frame, INTENSITY_MAP, 0, self.frames.max(), edge=look.color)
            scene.label(x, y + size / 2 + 0.07, f"image {number}", color=look.color)


def _pictures(bench: Bench, pistons: NDArray, frames: NDArray) -> _Pictures:
    """Pictures of Figure 5, from the fields of the bench."""
    pupil = Pupil.from_segments(bench.segments)
    phase = np.where(bench.segments > 0, bench.commanded_phase(pistons), np.nan)
    none: dict[str, Any] = dict.fromkeys((*bench.errors(), "photons_per_image", "read_noise", "background"), 0)
    quilted = replace(bench, **none | {"quilting": bench.quilting}).frames()[0]
    halo = focal_light(pupil, pupil.field(phase), 4)
    return _Pictures(pupil.amplitude, phase, halo, Dimple(bench.diameter, bench.phase), quilted, frames)


def _label_wide(scene: Scene, found: _Found, wavelength: float, pictures: _Pictures) -> None:
    """Names of the elements, and pictures inside the fold, with lines from their elements."""
    at = found.at
    top, bottom = at.top, at.bottom
    scene.label(0.05, top + 0.55, f"source, {wavelength:g} nm", ha="left")
    scene.label(found.stop, top + 0.55, "pupil stop")
    scene.label(8.85, top + 0.6, "IrisAO segmented mirror", ha="right")
    scene.label(8.85, bottom - 0.72, "BMC deformable mirror", ha="right")
    scene.label(found.focus, bottom - 0.4, "vector\nmask", va="top")
    scene.label(found.focus - 1.0, bottom - 0.4, "quarter-\nwave plate", va="top")
    scene.label(found.prism, bottom - 0.5, "Wollaston\nprism", va="top")
    scene.label(found.camera - 0.2, bottom, "camera", ha="right", va="center")

    left, right, upper, lower, size = 4.75, 6.7, 5.75, 3.3, 1.45
    scene.callout((found.stop, top - 0.5), (left - size / 2, upper + 0.4))
    scene.callout((8.0, top - 0.25), (right + size / 2, upper + size / 2))
    scene.callout((8.0, bottom + 0.25), (right + size / 2, lower - size / 2))
    scene.callout((left, bottom), (left, lower))
    for x in (1.2, 3.05):
        scene.callout((found.camera - 0.04, bottom + 0.75), (x, 3.6))
    places = [(left, upper), (right, upper), (right, lower), (left, lower), (1.2, 3.6), (3.05, 3.6)]
    dimple = f"dimple: {shift_label(pictures.mask, plus=True)}"
    pictures.draw(
        scene, places, [size] * 4 + [1.72] * 2, ["segments in stop", "pistons (rad)", "quilting", dimple]
    )


def _label_narrow(scene: Scene, found: _Found, wavelength: float, pictures: _Pictures) -> None:
    """Names of the elements, with letters that lead to the pictures below."""
    at = found.at
    top, bottom = at.top, at.bottom
    scene.label(0.05, top + 0.5, f"source, {wavelength:g} nm", ha="left")
    scene.label(found.stop, top - 0.42, "pupil stop A", va="top")
    scene.label(3.65, top + 0.5, "segmented mirror B", ha="right")
    scene.label(3.65, bottom - 0.42, "deformable\nmirror C", ha="right", va="top")
    scene.label(found.focus, bottom + 0.34, "vector mask D")
    scene.label(1.03, bottom - 0.42, "quarter-wave plate", ha="left", va="top")
    scene.callout((found.prism - 0.08, bottom - 0.25), (found.prism - 0.08, bottom - 0.66))
    scene.label(0.25, bottom - 0.68, "Wollaston prism", ha="left", va="top")
    scene.label(0.05, bottom + 0.5, "camera", ha="left")
    left, right, size = 0.95, 2.75, 1.4
    rows = 5.55, 3.35, 1.25
    places = [(x, y) for y in rows for x in (left, right)]
    names = [
        "A: segments in stop",
        "B: pistons (rad)",
        "C: quilting",
        f"D: dimple, {shift_label(pictures.mask, plus=True)}",
    ]
    pictures.draw(scene, places, [size] * 6, names)


def _segmented_mirror(
    scene: Scene, center: Point, tilt: float, size: float, bench: Bench, pistons: NDArray
) -> None:
    """Segments along the vertical diameter, each pushed by its command, on a plate."""
    middle = bench.segments[:, bench.segments.shape[1] // 2]
    numbers = [number for number in dict.fromkeys(middle.tolist()) if number]
    moved = dict(zip(bench.numbers.tolist(), pistons / np.abs(pistons).max(initial=1e-9), strict=True))
    width = 0.84 / len(numbers)
    for index, number in enumerate(numbers):
        across = (index - (len(numbers) - 1) / 2) * width
        corners = [(0.045 * moved[number] + s, across + t) for s, t in _box(0.0, 0.16, 0.45 * width)]
        _solid(scene, center, tilt, size, corners, "#8d99ae", METAL)
    _solid(scene, center, tilt, size, _box(0.2, 0.3, 0.46), METAL, "none")


def _actuated_mirror(scene: Scene, center: Point, tilt: float, size: float) -> None:
    """Continuous mirror on actuators, which leave their print on its face."""
    across = np.linspace(-0.42, 0.42, 127)
    face = [(0.022 * (1 - np.cos(2 * np.pi * t / 0.12)), t) for t in across]
    for t in np.linspace(-0.36, 0.36, 7):
        _solid(scene, center, tilt, size, [(s, t + d) for s, d in _box(0.1, 0.22, 0.015)], METAL, "none")
    _solid(scene, center, tilt, size, _box(0.2, 0.3, 0.46), METAL, "none")
    _solid(scene, center, tilt, size, [*face, (0.12, 0.42), (0.12, -0.42)], "#8d99ae", METAL)


def _box(low: float, high: float, half: float) -> list[Point]:
    """Corners of a rectangle from depth `low` to `high`, of half height `half`."""
    return [(low, -half), (high, -half), (high, half), (low, half)]


def _solid(
    scene: Scene, center: Point, tilt: float, size: float, corners: list[Point], color: str, edge: str
) -> None:
    """Polygon given by (depth, height), times `size`, turned by `tilt` (radian) around `center`."""
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    points = size * np.asarray(corners) @ turn.T + center
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
    rms, phase = float(pistons.std()), bench.commanded_phase(pistons)
    return Table(
        ["quantity", "value"],
        [
            ["segments of the mirror", bench.n_segments + len(bench.missing)],
            ["segments in use", bench.n_segments],
            ["segments across the stop", 1 / pitch],
            ["width of a gap (% of a segment)", bench.gap / pitch * 100],
            ["segments with more than 95 % of their area in the stop", int((share > 0.95).sum())],
            ["smallest share of a segment in the stop", float(share.min())],
            ["share of the stop that segments cover", pupil.n_points / Pupil.circular(bench.n_pixels).n_points],
            ["pistons (rad rms over the segments)", rms],
            ["pistons, wavefront (nm rms over the segments)", rms * wavelength / (2 * np.pi)],
            ["pistons (rad rms over the stop, which cuts the outer segments)", float(pupil.gather(phase).std())],
            ["Strehl ratio with these pistons", float(strehl(pupil, phase))],
        ],
    )
