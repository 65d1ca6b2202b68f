import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from joblib import parallel_config

from studies.kit.experiments import linearity_curves
from studies.kit.methods import own_reconstructors, paper_reconstructors
from zwfs import RECONSTRUCTORS, Arcsine

ROOT = Path(__file__).parent.parent
OWN = """
import numpy as np
from types import SimpleNamespace


class Nothing:
    n_masks = 1

    def __init__(self, sensor):
        self.sensor = sensor

    def __call__(self, frames):
        phase = np.zeros((*frames.shape[:-3], *self.sensor.pupil.shape))
        return SimpleNamespace(phase=phase, converged=np.ones(phase.shape[:-2], bool))


class NothingOfTwo(Nothing):
    n_masks = 2


class Modal(Nothing):
    def __init__(self, sensor, modes):
        super().__init__(sensor)
        self.modes = modes
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    (tmp_path / "own_methods.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    return "own_methods"


def test_an_own_reconstructor_gets_the_sensor_with_its_number_of_masks(own_module, pupil, modes):
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2)
    [(name, own)] = own_reconstructors([f"{own_module}:Nothing"], methods, modes).items()
    assert (name, own.sensor.n_masks) == ("Nothing", 1)
    two = own_reconstructors([f"{own_module}:NothingOfTwo"], methods, modes)["NothingOfTwo"]
    assert two.sensor.n_masks == 2
    assert own_reconstructors([], methods, modes) == {}
    with parallel_config(n_jobs=1):  # other workers may have started before the module was there
        curves = linearity_curves({name: own}, modes, [0.1, 0.2], 2)
    np.testing.assert_allclose(curves.mean(name), [0.1, 0.2], rtol=1e-3)


def test_an_own_reconstructor_gets_the_settings_that_it_asks_for(own_module, pupil, modes):
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2, n_iterations=7)
    paths = [f"{own_module}:Modal", "zwfs:MaximumLikelihood"]
    own = own_reconstructors(paths, methods, modes)
    assert own["Modal"].modes is modes
    assert own["MaximumLikelihood"].settings.n_iterations == 7


def test_a_reconstructor_that_is_added_to_the_package_is_in_the_figures(monkeypatch, pupil, modes):
    class OneMask(Arcsine):
        n_masks = 1, 1

    monkeypatch.setattr("studies.kit.methods.RECONSTRUCTORS", (*RECONSTRUCTORS, OneMask))
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2)
    for paths in ([], ["zwfs:OneMask"]):
        [(name, added)] = own_reconstructors(paths, methods, modes).items()
        assert (name, added.sensor.n_masks) == ("OneMask", 1)


@pytest.mark.slow
def test_the_reconstructor_on_the_page_stands_next_to_the_five(tmp_path):
    page = (ROOT / "book" / "your_reconstructor.md").read_text("utf-8")
    [code, _] = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len([line for line in code.splitlines() if line.strip()]) <= 30
    (tmp_path / "flat_reference.py").write_text(code)
    run = [sys.executable, "flat_reference.py"]
    studies = os.environ | {"PYTHONPATH": str(ROOT / "notebooks")}  # where a reader keeps the file
    printed = subprocess.run(run, cwd=tmp_path, env=studies, capture_output=True, text=True, check=True).stdout
    assert printed in page
    errors = {name: [float(value) for value in values] for name, *values in map(str.split, printed.splitlines())}
    assert errors["PhaseShifted"][1] < 0.001 < errors["FlatReference"][1] < errors["Linear"][1]
