"""Every public name of the science has an example. `make test` runs them with --doctest-modules."""

import importlib
import inspect
import re

import pytest

from .conftest import ROOT
from .test_package import PUBLIC

# The notebooks are the examples of these packages, and nbval runs them.
SHOWN_BY_NOTEBOOKS = ("zwfs.paper", "zwfs.plots", "zwfs.companion")
# Results and states that only functions make, whose examples show them.
SHOWN_BY_OTHERS = {
    "zwfs.frames.calibration": {"Phases"},
    "zwfs.frames.joint": {"Estimate", "JointFit", "Score"},
    "zwfs.frames.optics_model": {"ArmValues", "Coefficients", "Linearised", "MaskValues"},
    "zwfs.frames.order": {"ImageOrder"},
    "zwfs.frames.pipeline": {"Measurement", "MeasuredPhase", "Step"},
    "zwfs.frames.registration": {"Placement"},
    "zwfs.frames.telemetry": {"Summary"},
    "zwfs.frames.verdict": {"Verdict"},
    "zwfs.reconstructors.base": {"Solution", "State", "Estimate"},
}


@pytest.mark.parametrize("name", [name for name in PUBLIC if not name.startswith(SHOWN_BY_NOTEBOOKS)])
def test_every_public_name_has_an_example(name):
    own = {
        key: thing
        for key, thing in vars(importlib.import_module(name)).items()
        if not key.startswith("_") and getattr(thing, "__module__", None) == name
    }
    things = {key: thing for key, thing in own.items() if inspect.isclass(thing) or inspect.isfunction(thing)}
    without = {key for key, thing in things.items() if ">>> " not in (thing.__doc__ or "")}
    assert without == SHOWN_BY_OTHERS.get(name, set())


def test_example_of_the_readme_runs(capsys):
    (code,) = re.findall(r"(?m)^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.S)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed.startswith("(20, 100, 100) [ True")
    assert "False" not in printed
