"""The data of the live sensor: its dimples, its screens and the colours of the figures."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from sphinx.application import Sphinx

import zwfs
from zwfs._arrays import Kind
from zwfs.lowrank import Factors, Plane
from zwfs.plots.style import INTENSITY_MAP, PHASE_MAP

DATA = "_static/live-data.js"

N_PIXELS = 64
N_MODES = 200
N_SEEDS = 50
DIAMETERS = (0.5, 3.0)  # lambda/D
# The core of a dimple is an entire function of the diameter: 14 samples interpolate it to 1e-7.
N_DIAMETERS = 14
TOLERANCE = 1e-7  # of the reference waves, which are stored in single precision


def script() -> str:
    """Return a script that defines the data: browsers block pages from the file system from reading data files."""
    return f"window.zwfsLiveData = {json.dumps(data())};\n"


def data() -> dict[str, Any]:
    """Return the input of book/_static/live-model.js, ready for JSON."""
    pupil = zwfs.Pupil.circular(N_PIXELS)
    diameters, factors = dimples(pupil)
    return {
        "inside": _encode(pupil.inside.astype(np.uint8)),
        "diameters": diameters.tolist(),
        "pupil": _plane(factors.pupil.to(Kind.numpy(np.float32))),
        "detector": _plane(factors.detector.to(Kind.numpy(np.float32))),
        "cores": [_encode(-core.real.astype(np.float32)) for core in factors.core],
        "screens": _plane(screens(pupil)),
        "colors": {
            "phase": _encode(colormaps[PHASE_MAP](np.arange(256), bytes=True)),
            "intensity": _encode(colormaps[INTENSITY_MAP](np.arange(256), bytes=True)),
        },
    }


def dimples(pupil: zwfs.Pupil) -> tuple[NDArray, Factors]:
    """Return Chebyshev points in the range of diameters, and the factors of dark dimples of these diameters.

    A dark dimple blocks its light: its reference wave is minus that light. Its core is real: minus the core of the
    kernel without the factor exp(i theta) - 1.
    """
    low, high = DIAMETERS
    angles = np.pi * (np.arange(N_DIAMETERS) + 0.5) / N_DIAMETERS
    diameters = (low + high) / 2 - (high - low) / 2 * np.cos(angles)
    dark = [zwfs.Dimple(diameter, phase=0.0, amplitude=0.0) for diameter in diameters]
    return diameters, zwfs.ZernikeSensor(pupil, *dark, tolerance=TOLERANCE).factors


def screens(pupil: zwfs.Pupil) -> Plane:
    """Return the screens of the seeds from 1 on, unit rms, as combinations of products of Legendre polynomials.

    Zernike modes are polynomials in x and y of a degree up to the radial order of the last mode. They are huge in
    the corners of the square outside the pupil: the coefficients need double precision.
    """
    degree = zwfs.noll_to_nm(N_MODES + 1)[0]
    modes = zwfs.zernike_basis(pupil, N_MODES)
    maps = np.concatenate([zwfs.power_law_screens(modes, 1.0, 1, seed=1 + k) for k in range(N_SEEDS)])
    along_y, along_x = (np.polynomial.legendre.legvander(2 * axis, degree).T for axis in (pupil.y, pupil.x))
    products = np.einsum("iy,jx->ijyx", along_y, along_x).reshape(-1, *pupil.shape)
    combine = np.linalg.lstsq(pupil.gather(products).T, pupil.gather(maps).T)[0]
    return Plane(along_y, along_x, combine)


def _plane(plane: Plane) -> dict[str, Any]:
    return {"y": _encode(plane.along_y), "x": _encode(plane.along_x), "combine": _encode(plane.combine)}


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
