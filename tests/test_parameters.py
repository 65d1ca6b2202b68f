"""Limits of parameters: what is let through, and what is said of the rest."""

import math
from pathlib import Path

import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_notebook

from book._tools import declared
from book._tools.notebook import read
from studies.fig03_dynamic_range import LIMITS
from studies.kit.parameters import check_parameters

PUPIL = LIMITS["pupil"]  # nested
NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize(
    ("value", "limits"),
    [
        (np.int64(3), (1, 5)),
        (4, (0.0, 4.0)),
        ([0.1, 2], [(0.0, 4.0)]),
        ((1, 2), [(1, 2)]),
        (["low", "high"], [("low", "high")]),
        ([], [str, ...]),
        (False, bool),
        ([[1.0, 2.0], [3, 4]], [[(0.0, 9.0)], ...]),
    ],
)
def test_values_within_limits_pass(value, limits):
    check_parameters({"x": value, "other": object()}, x=limits)


@pytest.mark.parametrize(
    ("value", "limits", "error", "message"),
    [
        (6, (1, 5), ValueError, r"x = 6: expected an integer in \[1, 5\]"),
        (3.0, (1, 5), TypeError, "x = 3.0: expected an integer, as in 3"),
        (True, (0, 5), TypeError, "x = True: expected an integer"),
        ("3", (1, 5), TypeError, "x = '3': expected an integer"),
        (math.nan, (0.0, 4.0), ValueError, "x = nan: expected a finite number"),
        (math.inf, (0.0, math.inf), ValueError, "x = inf: expected a finite number"),
        (1.0, [(0.0, 4.0)], TypeError, "x = 1.0: expected a list"),
        ("12", [(0, 4)], TypeError, "x = '12': expected a list"),
        ([], [(0.0, 4.0)], ValueError, r"x = \[\]: expected at least one value"),
        ([1.0, 5.0], [(0.0, 4.0), ...], ValueError, r"x\[1\] = 5.0: expected a finite number in \[0, 4\]"),
        ("middle", ("low", "high"), ValueError, "x = 'middle': expected one of 'low', 'high'"),
        (1, ("low", "high"), TypeError, "x = 1: expected one of 'low', 'high'"),
        (1, str, TypeError, "x = 1: expected a string"),
        (0, bool, TypeError, "x = 0: expected True or False"),
        (["a", 1], [str], TypeError, r"x\[1\] = 1: expected a string"),
        (1, (1,), TypeError, r"limits of x = \(1,\): expected"),
        (1, [(1, 2), (3, 4)], TypeError, "limits of x = "),
        ({"obstruction": 1.2}, PUPIL, ValueError, "x.obstruction = 1.2"),
        ({"obstuction": 0.2}, PUPIL, ValueError, "'x.obstuction' of kind 'circular': did you mean 'obstruction'"),
        ({"kind": "keck", "missing": [1, 0]}, PUPIL, ValueError, r"x.missing\[1\] = 0"),
        ({"kind": "kek"}, PUPIL, ValueError, "x.kind = 'kek'"),
        ({"vanes": [[0.0, "a"]]}, PUPIL, TypeError, r"x.vanes\[0\]\[1\] = 'a'"),
        ([], PUPIL, TypeError, r"x = \[\]"),
    ],
)
def test_values_beyond_limits_are_refused(value, limits, error, message):
    with pytest.raises(error, match=message):
        check_parameters({"x": value}, x=limits)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_parameter_of_a_notebook_has_a_meaning_and_limits(path):
    notebook = read(path)
    parameters = declared.parameters(notebook)
    assert parameters
    assert [
        name for name, parameter in parameters.items() if not parameter.meaning or parameter.limits is None
    ] == []
    # No limits for what is no parameter, and defaults within them.
    assert set(declared.study_of(notebook).LIMITS) == set(parameters)
    assert declared.accept({name: parameter.default for name, parameter in parameters.items()}, parameters) == {}


def test_notebook_refuses_bad_values_in_its_second_cell_of_code():
    notebook = read(next(path for path in NOTEBOOKS if path.stem.startswith("fig01")))
    [tagged] = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    after = notebook.cells[notebook.cells.index(tagged) + 1]
    exec(f"{tagged.source}\n{after.source}", {})
    with pytest.raises(ValueError, match="rms = 40"):
        exec(f"{tagged.source}\nrms = 40\n{after.source}", {})


def with_default(written):
    cell = new_code_cell(f"angle = {written}  # shift, rad", metadata={"tags": ["parameters"]})
    return new_notebook(cells=[cell])


@pytest.mark.parametrize(
    ("written", "value"),
    [("-np.pi / 2", -np.pi / 2), ("0.3 * np.pi", 0.3 * np.pi), ("[np.pi / 2, 1]", [np.pi / 2, 1])],
)
def test_defaults_may_be_fractions_of_pi(written, value):
    assert declared.parameters(with_default(written))["angle"].default == value
