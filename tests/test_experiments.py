import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from joblib import parallel_config

from studies.fig03_dynamic_range import count_work, light_lost, linearity_curves, saxton_by_width
from studies.kit.methods import own_reconstructors, paper_reconstructors, repaired_reconstructors
from studies.kit.setups import screens_at
from zwfs import RECONSTRUCTORS, Arcsine, Linear, PhaseShifted, dynamic_range, reconstruction_error

ROOT = Path(__file__).parent.parent
RMS = (0.05, 0.3, 0.6)


@pytest.fixture(scope="module")
def methods(classic, shifted, modes):
    return {"linear": Linear(classic, modes), "shifted": PhaseShifted(shifted)}


@pytest.fixture(scope="module")
def curves(methods, modes):
    return linearity_curves(methods, modes, RMS, 4, seed=7)


def test_errors_are_those_of_each_screen(curves, methods, modes, pupil, classic):
    screens = screens_at(modes, 0.3, 4, seed=7, task=1)
    np.testing.assert_allclose(pupil.rms(screens), 0.3)
    found = methods["linear"](classic.measure(screens))
    np.testing.assert_allclose(curves.errors["linear"][1], reconstruction_error(pupil, found.phase, screens))
    assert curves.converged["shifted"].shape == (3, 4)
    np.testing.assert_allclose(curves.mean("linear"), curves.errors["linear"].mean(axis=1))
    np.testing.assert_allclose(curves.std("linear"), curves.errors["linear"].std(axis=1))


def test_linear_leaves_its_range_before_the_phase_shifted(curves):
    assert 0 < curves.dynamic_range("linear") < 0.3
    assert curves.dynamic_range("shifted") == np.inf
    assert curves.dynamic_range("linear") == dynamic_range(RMS, curves.mean("linear"))
    assert np.all(np.diff(curves.mean("linear")) > 0)


def test_a_point_depends_on_the_seed_and_its_place_only(curves, methods, modes):
    alone = linearity_curves({"linear": methods["linear"]}, modes, RMS[:2], 4, seed=7)
    np.testing.assert_allclose(alone.errors["linear"], curves.errors["linear"][:2], rtol=1e-9)
    other = linearity_curves({"linear": methods["linear"]}, modes, RMS[:2], 4, seed=8)
    assert not np.allclose(alone.errors["linear"], other.errors["linear"])


def test_shares_of_the_screens_are_counted(methods, modes, pupil):
    inputs = (0.05, 0.6, 2.0)
    curves = linearity_curves({"linear": methods["linear"]}, modes, inputs, 4, seed=7)
    for task, rms in enumerate(inputs):
        phase = pupil.gather(screens_at(modes, rms, 4, seed=7, task=task))
        np.testing.assert_allclose(curves.folded[task], np.mean(phase < -np.pi / 4, axis=1))
        np.testing.assert_allclose(curves.wrapped[task], np.mean(np.abs(phase) > np.pi, axis=1))
        np.testing.assert_allclose(curves.strehl[task], np.abs(np.exp(1j * phase).mean(axis=1)) ** 2)
    assert curves.folded[-1].min() > 0
    assert np.abs([phase.min(), phase.max()]).min() > np.pi  # wrapped on both sides


def test_recovered_is_the_share_of_good_screens(curves):
    np.testing.assert_array_equal(curves.recovered("shifted"), 1)
    np.testing.assert_array_equal(curves.recovered("linear")[1:], 0)
    middle = np.median(curves.errors["linear"][0] / RMS[0])
    assert curves.recovered("linear", middle)[0] == 0.5


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


class Linear(Nothing):
    pass


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
    with pytest.raises(ValueError, match="path = 'own_methods:Linear': expected a name other than Linear"):
        own_reconstructors([f"{own_module}:Linear"], methods, modes)


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
    with pytest.raises(ValueError, match="path = 'zwfs:Arcsine': expected a name other than Linear"):
        own_reconstructors(["zwfs:Arcsine"], methods, modes)


def test_a_wider_detector_or_the_modelled_field_reduces_the_offset_of_gerchberg_saxton(pupil, modes):
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2)
    variants, curves = saxton_by_width(methods, modes, [2.0, 3.0], 1)
    assert [method.sensor.extent for method in variants.values()] == pytest.approx([2, 3, 2, 2])
    assert [method.unmeasured for method in variants.values()] == ["zero", "zero", "model", "model"]
    near, wide, kept, longer = (curves.mean(name)[0] for name in variants)
    assert 0.01 * near > kept > longer
    assert 0.1 > near > wide > 0
    sensors = [method.sensor for method in variants.values()][:2]
    assert 0.2 > light_lost(sensors[0]) > light_lost(sensors[1]) > 0


def test_repaired_reconstructors_find_what_the_originals_miss(pupil, modes):
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2, n_iterations=40)
    methods |= repaired_reconstructors(methods)
    curves = linearity_curves(methods, modes, [0.3], 4)
    assert curves.mean("GerchbergSaxtonModel") < 0.05 * curves.mean("GerchbergSaxton")
    started = methods["GradientDescentStarted"]
    frames = started.sensor.measure(screens_at(modes, 0.3, 2, seed=1, task=0))
    start = PhaseShifted(started.sensor, n_iterations=5)(frames).phase
    np.testing.assert_array_equal(started(frames).phase, methods["GradientDescent"](frames, start=start).phase)


def test_work_is_counted(methods, modes, shifted):
    screen = screens_at(modes, 0.3, 1, seed=7, task=0)[0]
    passes, fourier = count_work({**methods, "endless": PhaseShifted(shifted, tolerance=0.0)}, screen)
    assert passes["linear"] == 0
    assert 0 < passes["shifted"] < passes["endless"]
    assert not fourier
    assert count_work({"fft": Transforming(shifted)}, screen)[1]


class Transforming(PhaseShifted):
    """Reconstructor that calls a function for Fourier transforms."""

    def __call__(self, frames):
        np.fft.fft(np.ones(4))
        return super().__call__(frames)


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
    errors = {name: [float(one) for one in values] for name, *values in map(str.split, printed.splitlines())}
    assert errors["PhaseShifted"][1] < 0.001 < errors["FlatReference"][1] < errors["Linear"][1]
