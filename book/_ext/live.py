"""The data of the live sensor: its dimples, its screens, the map of designs and the colours of the figures."""

import base64
import csv
import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure
from matplotlib.pyplot import get_cmap
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sphinx.application import Sphinx

import zwfs
from studies.kit.style import DARK_PHASE_MAP, INTENSITY_MAP, PHASE_MAP

DATA = "_static/live-data.js"
DESIGNS = Path(__file__).with_name("design.csv")  # bounds of pairs of opposite shifts

N_PIXELS = 64
N_MODES = 200
N_SEEDS = 50
DIAMETERS = (0.5, 3.0)  # lambda/D
# The core of a dimple is an entire function of the diameter: 14 samples interpolate it to 1e-7.
N_DIAMETERS = 14
TOLERANCE = 1e-7  # of the reference waves, which are stored in single precision
COST_MAP = "cividis_r"
PUBLISHED = (1.06, 0.5), (2.4, 0.3, 0.68), (2.05, 0.33, 0.74)
"""Diameter (lambda/D) and sizes of the phase shifts (pi): paper, Keck, and OZIRIIS with the mean of its masks."""
MOST = 10  # photon cost at the end of its scale
MAP_SIZE = 2.9, 2.4  # of the map of designs on a phone, inch
NEAREST = 0.11  # of a label of a contour to anything else, inch
COST_LINES = dict.fromkeys((1.25, 1.5, 2, 3), "#000000") | dict.fromkeys((5, 10), "#ffffff")
"""Photon costs at which a line is drawn, and its colour, with a contrast of at least 4.5 to that of the map."""


def script() -> str:
    """Return a script that defines the data: browsers block pages from the file system from reading data files."""
    return f"window.zwfsLiveData = {json.dumps(data())};\n"


def data() -> dict[str, Any]:
    """Return the input of book/_static/live-model.js, ready for JSON."""
    pupil = zwfs.Pupil.circular(N_PIXELS)
    diameters, functions, cores = dimples(pupil)
    maps = {"phase": PHASE_MAP, "darkPhase": DARK_PHASE_MAP, "intensity": INTENSITY_MAP, "cost": COST_MAP}
    return {
        "inside": _encode(pupil.inside.astype(np.uint8)),
        "diameters": diameters.tolist(),
        "functions": _encode(functions),
        "cores": _encode(cores[..., *np.tril_indices(cores.shape[-1])].astype(np.float32)),
        "orders": [zwfs.noll_to_nm(j) for j in range(2, N_MODES + 2)],
        "screens": _encode(screens(pupil).astype(np.float32)),
        "designs": designs(),
        "colors": {name: _encode(get_cmap(color)(np.arange(256), bytes=True)) for name, color in maps.items()},
    }


def dimples(pupil: zwfs.Pupil) -> tuple[NDArray, NDArray, NDArray]:
    """Return diameters, functions of an axis, and the light through dimples of these diameters, in the functions.

    A dark dimple blocks its light: its reference wave is minus that light. Its core is real and symmetric. The
    functions of an axis are even or odd, so products of them belong to one of four classes: 2 (odd in y) + (odd in
    x). A core couples functions of one class only.
    """
    low, high = DIAMETERS
    angles = np.pi * (np.arange(N_DIAMETERS) + 0.5) / N_DIAMETERS
    diameters = (low + high) / 2 - (high - low) / 2 * np.cos(angles)
    dark = [zwfs.Dimple(diameter, phase=0.0, amplitude=0.0) for diameter in diameters]
    factors = zwfs.ZernikeSensor(pupil, *dark, tolerance=TOLERANCE).factors
    functions = factors.pupil.along_y
    cores = -(factors.detector.combine @ factors.core.real @ factors.pupil.combine.T)
    a = len(functions)
    cores = cores.reshape(-1, a, a, a, a)
    blocks = [cores[:, y::2, x::2, y::2, x::2] for y in (0, 1) for x in (0, 1)]
    size = (a // 2) ** 2
    # (n,) in lambda/D, Chebyshev points; (a, n_pixels), even and odd in turn; (n, 4, b, b), b products in y and x.
    return diameters, functions, np.stack([block.reshape(-1, size, size) for block in blocks], axis=1)


def screens(pupil: zwfs.Pupil) -> NDArray:
    """Return the coefficients of the screens of the seeds from 1 on, unit rms: (n_seeds, n_modes)."""
    modes = zwfs.zernike_basis(pupil, N_MODES)
    maps = np.concatenate([zwfs.power_law_screens(modes, 1.0, 1, seed=1 + k) for k in range(N_SEEDS)])
    return np.linalg.lstsq(pupil.gather(modes).T, pupil.gather(maps).T)[0].T


def designs() -> dict[str, Any]:
    """Return the photon costs of designs, a row for each diameter, and their contours, by the wavefronts."""
    with DESIGNS.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    table = np.array(rows, float)
    diameters, shifts = np.unique(table[:, 0]), np.unique(table[:, 1]) / np.pi
    costs = {
        name.rpartition(", ")[2]: table[:, column].reshape(diameters.size, shifts.size)
        for column, name in enumerate(header[2:], 2)
    }
    return {
        "diameters": diameters.tolist(),
        "shifts": shifts.round(6).tolist(),
        "costs": {name: cost.tolist() for name, cost in costs.items()},
        "most": MOST,
        "contours": {name: contours(diameters, shifts, cost) for name, cost in costs.items()},
    }


def contours(diameters: NDArray, shifts: NDArray, costs: NDArray) -> dict[str, Any]:
    """Return the contours of costs (a, b) as paths by their colours, and their labels; units are cells of the map.

    The diameters (a,) are in lambda/D, the shifts (b,) in units of pi.
    """
    cells = np.arange(diameters.size) + 0.5, shifts.size - np.arange(shifts.size) - 0.5
    lines = Figure().subplots().contour(*cells, costs.T, list(COST_LINES)).allsegs
    parts = dict(zip(COST_LINES, lines, strict=True))
    ends = [(diameter, shift) for diameter, *shifts_of in PUBLISHED for shift in shifts_of]
    best = np.unravel_index(costs.argmin(), costs.shape)
    across, up = np.transpose([*ends, (diameters[best[0]], shifts[best[1]])])
    marks = [np.interp(across, diameters, cells[0]), np.interp(up, shifts, cells[1])]
    places = label_places(parts, np.transpose(marks), (0, diameters.size, 0, shifts.size), MAP_SIZE)
    paths = dict.fromkeys(COST_LINES.values(), "")
    for level, color in COST_LINES.items():
        paths[color] += "".join(_path(part) for part in parts[level] if part.size)
    labels = [
        {
            "text": f"{level:g}",
            "color": COST_LINES[level],
            "ground": _ground(level),
            "place": place.round(2).tolist(),
        }
        for level, place in places.items()
    ]
    return {"paths": paths, "labels": labels}


def label_places(
    paths: Mapping[float, Sequence[NDArray]], marks: NDArray, extent: Sequence[float], size: Sequence[float]
) -> dict[float, NDArray]:
    """Choose a place for the label of each contour: far from other contours, marks, labels and the frame."""
    start, end, low, high = extent
    scale = np.divide(size, (end - start, high - low))
    frame = _dense(np.array([(start, low), (end, low), (end, high), (start, high), (start, low)]))
    points = {level: np.concatenate([np.empty((0, 2)), *parts]) for level, parts in paths.items()}
    places: dict[float, NDArray] = {}
    for level, own in points.items():
        other_paths = [path for key, path in points.items() if key != level]
        avoided = np.concatenate([frame, marks, *other_paths, *(place[np.newaxis] for place in places.values())])
        distances = cdist(own * scale, avoided * scale).min(axis=1)
        if distances.size and distances.max() > NEAREST:
            places[level] = own[distances.argmax()]
    return places


def _dense(corners: NDArray) -> NDArray:
    """Points on a line with these corners."""
    steps = np.linspace(0, 1, 25)[:, np.newaxis]
    return np.concatenate([corners[:1], *(a + steps * (b - a) for a, b in pairwise(corners))])


def _ground(cost: float) -> str:
    """Return the colour of a cost on the map."""
    return to_hex(get_cmap(COST_MAP)(LogNorm(1, MOST)(cost)))


def _path(points: NDArray) -> str:
    return "M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in points)


def _encode(array: NDArray) -> dict[str, Any]:
    """Return shape, type, and the values in base64, little-endian."""
    values = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
    return {"shape": array.shape, "type": array.dtype.name, "values": base64.b64encode(values).decode()}


def write_data(app: Sphinx, exception: Exception | None) -> None:
    """Write the script next to the scripts of the live page."""
    if exception is None and app.builder.format == "html":
        Path(app.outdir, DATA).write_text(script(), "utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the data at the end of each build."""
    app.connect("build-finished", write_data)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
