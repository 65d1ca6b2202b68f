"""Every public name of the science has an example. `make test` runs them with --doctest-modules."""

import importlib
import inspect
import re

import pytest

from .conftest import ROOT
from .test_package import PUBLIC

# Results that functions make, whose examples show them, and steps that the example of their package shows.
SHOWN_BY_OTHERS = {
    "zwfs.frames.calibration": {"Calibration"},
    "zwfs.frames.phases": {"Phases"},
    "zwfs.frames.files": {"read_all", "write_phase"},
    "zwfs.frames.pipeline": {
        *("Measurement", "MeasuredPhase", "reduce_frames", "recover_phase", "model", "ideal_frames"),
        *("predict_other", "upside_down"),
    },
    "zwfs.frames.refine": {"Step", "fit", "steps"},
    "zwfs.frames.registration": {"Placement", "RegisteredFrames", "register_frames"},
    "zwfs.frames.telemetry": {"Summary"},
    "zwfs.frames.verdict": {"CameraNoise", "ImageOrder", "Verdict", "error_bar", "near_edges"},
    "zwfs.bench.files": {"bench_error"},
    "zwfs.bench.model": {"segment_pistons", "segment_residual"},
    "zwfs.bench.relay": {"Relay"},
    "zwfs.loop": {"HeldDrift", "LoopRecord"},
    "zwfs.masks": {"Mask"},
    "zwfs.reconstructors.arcsine": {"Arcsine"},
    "zwfs.reconstructors.gerchberg_saxton": {"GerchbergSaxton"},
    "zwfs.reconstructors.gradient_descent": {"GradientDescent"},
    "zwfs.reconstructors.maximum_likelihood": {"LikelihoodReconstruction"},
    "zwfs.sensor": {"Sensor"},
}


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_an_example(name):
    own = {
        key: thing
        for key, thing in vars(importlib.import_module(name)).items()
        if not key.startswith("_") and getattr(thing, "__module__", None) == name
    }
    things = {key: thing for key, thing in own.items() if inspect.isclass(thing) or inspect.isfunction(thing)}
    if name == "zwfs.reconstructors.base":  # what it offers to authors, CONTRIBUTING shows
        return
    without = {key for key, thing in things.items() if ">>> " not in (thing.__doc__ or "")}
    assert without == SHOWN_BY_OTHERS.get(name, set())


def test_example_of_the_readme_runs(capsys):
    (code,) = re.findall(r"(?m)^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.S)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed.startswith("(20, 100, 100) [ True")
    assert "False" not in printed


def test_example_of_the_front_page_prints_what_it_says(capsys):
    page = (ROOT / "book" / "index.md").read_text("utf-8")
    (code,), (printed,) = (re.findall(rf"(?m)^```{kind}\n(.*?)^```", page, re.S) for kind in ("python", "text"))
    exec(compile(code, "index.md", "exec"), {})
    assert capsys.readouterr().out == printed


def test_example_of_gradients_fits_the_phase(capsys):
    jax = pytest.importorskip("jax", reason="JAX is not installed")
    page = (ROOT / "book" / "your_reconstructor.md").read_text("utf-8")
    (code,) = (block for block in re.findall(r"(?m)^```python\n(.*?)^```", page, re.S) if "zwfs.jax" in block)
    (stated,) = re.findall("falls to (.) × 10⁻⁸ rad", page)
    before = jax.config.jax_enable_x64
    try:
        exec(compile(code, "your_reconstructor.md", "exec"), {})
    finally:
        jax.config.update("jax_enable_x64", before)
    assert float(capsys.readouterr().out) == pytest.approx(int(stated) * 1e-8, rel=0.25)
