"""The methods of the page in a few lines of NumPy: they agree with the package."""

import contextlib
import io
import re

import numpy as np
import pytest

import zwfs

from .conftest import code_of

SET_UP, *BLOCKS = [code for code in code_of("methods.md") if "import zwfs" not in code]


@pytest.fixture(scope="module")
def setting():
    names = {}
    exec(SET_UP, names)
    return names


def of_the_package(method, names):
    """Phase, at the points of the pupil, that a reconstructor of the package computes from the same frames."""
    pupil = zwfs.Pupil.circular(names["n"])
    plus, minus = (zwfs.Dimple(names["d"], shift) for shift in (np.pi / 2, -np.pi / 2))
    modes = pupil.scatter(names["modes"].T, fill=0)
    wide = zwfs.ZernikeSensor(pupil, plus, minus, extent=2.0)
    frames = names["frames"].reshape(2, *wide.detector_shape)
    images, pair = frames[(..., *wide.window)], zwfs.ZernikeSensor(pupil, plus, minus)
    estimate = {
        "linear": lambda: zwfs.Linear(pair, modes)(images),
        "arcsine": lambda: zwfs.Arcsine(zwfs.ZernikeSensor(pupil, plus))(images[:1]),
        "shifted": lambda: zwfs.PhaseShifted(pair)(images),
        "saxton": lambda: zwfs.GerchbergSaxton(wide)(frames),
        "descent": lambda: zwfs.GradientDescent(wide, modes, n_iterations=100)(frames),
    }[method]()
    return pupil.gather(estimate.phase)


@pytest.mark.parametrize("method", ["linear", "arcsine", "shifted", "saxton", "descent"])
def test_a_method_in_numpy_agrees_with_the_package(method, setting):
    (code,) = (block for block in BLOCKS if f"error({method})" in block)
    assert len([line for line in code.splitlines() if line]) <= 12
    names, printed = dict(setting), io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(code, names)
    assert printed.getvalue().strip() == re.search(r"# (\S+)$", code)[1]
    difference = np.exp(1j * (names[method] - of_the_package(method, names)))
    assert np.abs(np.angle(difference / difference.mean())).max() < 1e-5
