"""A grid of inputs: every combination, labelled, in blocks that change no bit, and continued where it stopped."""

import csv
from importlib.util import find_spec

import numpy as np
import pytest
from joblib import parallel_config

from zwfs import PhaseShifted, plots
from zwfs.companion import sweeps
from zwfs.paper.grids import Recovery
from zwfs.paper.linearity import paper_reconstructors
from zwfs.paper.setups import make_pupil, make_screens


def task(x, y, n_screens, seed):
    drawn = np.random.default_rng(seed).standard_normal(n_screens)
    return {"value": 100 * x + y + drawn, "drawn": drawn}


@pytest.fixture(scope="module")
def result():
    return sweeps.grid(task, x=[1, 2, 3], y=np.array([0.5, 0.25]), n_screens=5, seed=4)


def test_every_combination_has_its_place(result):
    assert result.axes == {"x": (1, 2, 3), "y": (0.5, 0.25), "screen": (0, 1, 2, 3, 4)}
    expected = 100 * np.array([1, 2, 3])[:, None, None] + np.array([0.5, 0.25])[:, None]
    np.testing.assert_allclose(result.values["value"] - result.values["drawn"], np.tile(expected, 5))
    # All points see the same random numbers.
    assert np.ptp(result.values["drawn"], axis=(0, 1)).max() == 0
    assert np.ptp(result.values["drawn"]) > 0


def test_workers_change_no_bit(result):
    with parallel_config(n_jobs=1):
        again = sweeps.grid(task, x=[1, 2, 3], y=[0.5, 0.25], n_screens=5, seed=4)
    np.testing.assert_array_equal(again.values["value"], result.values["value"])


def test_a_larger_grid_computes_only_what_is_new(tmp_path, monkeypatch):
    monkeypatch.setenv("ZWFS_SWEEPS", str(tmp_path))
    counted = tmp_path / "counted"

    def counting(x, n_screens, seed):
        with counted.open("a") as file:
            file.write("x")
        return {"x": np.full(n_screens, x)}

    with parallel_config(n_jobs=1):
        sweeps.grid(counting, x=[1, 2], n_screens=4, block=2)
        assert counted.read_text() == 4 * "x"
        larger = sweeps.grid(counting, x=[1, 2, 3], n_screens=6, block=2)
    assert counted.read_text() == 9 * "x"
    np.testing.assert_array_equal(larger.values["x"][:, 5], [1, 2, 3])


def test_slices_and_tables(result, tmp_path):
    part = result.select(y=0.25, screen=2)
    np.testing.assert_array_equal(part.values["value"], result.values["value"][:, 1, 2])
    assert list(part.axes) == ["x"]
    result.write(tmp_path / "grid.csv")
    with (tmp_path / "grid.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 30
    assert float(rows[7]["value"]) == result.values["value"][0, 1, 2]
    assert (rows[7]["x"], rows[7]["y"], rows[7]["screen"]) == ("1", "0.25", "2")
    with pytest.raises(ValueError, match=r"y = 7: expected one of \[0.5, 0.25\]"):
        result.select(y=7)
    with pytest.raises(ValueError, match="axis = 'z'"):
        result.select(z=7)


@pytest.mark.skipif(not find_spec("pyarrow"), reason="needs pyarrow")
def test_parquet_holds_the_long_table(result, tmp_path):
    from pyarrow import parquet

    result.write(tmp_path / "grid.parquet")
    table = parquet.read_table(tmp_path / "grid.parquet")
    np.testing.assert_array_equal(table["value"].to_numpy(), result.columns()["value"])


@pytest.mark.skipif(not find_spec("xarray"), reason="needs xarray")
def test_xarray_knows_the_axes(result):
    value = result.to_xarray()["value"].sel(x=2, y=0.25)
    np.testing.assert_array_equal(value, result.values["value"][1, 1])


def test_missing_packages_are_named(result, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeps, "find_spec", lambda name: None)
    for call in (lambda: result.write(tmp_path / "grid.parquet"), result.to_xarray):
        with pytest.raises(ImportError, match=r"pip install (pyarrow|xarray)"):
            call()


def test_recovery_is_the_error_of_the_reconstructor():
    pupil = make_pupil(24)
    source = make_screens(pupil, 20, -2.0)
    result = sweeps.grid(Recovery(source), diameter=[1.06, 2.0], phase_shift=[1.0], rms=[0.1, 0.4], n_screens=3)
    method = PhaseShifted(paper_reconstructors(pupil, source.modes, 2.0, 1.0)["PhaseShifted"].sensor)
    screens = source(0.4, 3, np.random.SeedSequence(0, spawn_key=(0,)))
    estimate = method(method.sensor.measure(screens))
    error = pupil.gather(estimate.phase - screens)
    part = result.select(diameter=2.0, phase_shift=1.0, rms=0.4).values
    np.testing.assert_allclose(part["error"], error.std(axis=1), rtol=1e-6)
    np.testing.assert_array_equal(part["converged"], estimate.converged)


def test_single_precision_gives_nearly_the_same_errors():
    source = make_screens(make_pupil(24), 20, -2.0)
    one, half = (
        sweeps.grid(Recovery(source, dtype=dtype), rms=[0.2, 0.5], n_screens=3).values["error"]
        for dtype in ("float64", "float32")
    )
    np.testing.assert_allclose(half, one, atol=1e-4)
    with pytest.raises(TypeError, match="dtype = 'int8'"):
        Recovery(source, dtype="int8")


def test_a_slice_is_drawn(result):
    figure = plots.grid_slice(result, "value", "x", lines="y")
    curves = figure.axes[0].get_lines()
    np.testing.assert_allclose(curves[1].get_ydata(), result.values["value"][:, 1].mean(axis=-1))
    mapped = plots.grid_slice(result, "value", "x", "y").axes[0].collections[0].get_array()
    np.testing.assert_allclose(mapped, result.values["value"].mean(axis=-1).T)
    with pytest.raises(ValueError, match=r"axes \['y'\] have several values"):
        plots.grid_slice(result, "value", "x")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"n_screens": 0}, ValueError, "n_screens = 0"),
        ({"block": 0}, ValueError, "block = 0"),
        ({"x": 3}, TypeError, "x = 3: expected a list of values"),
        ({"x": []}, ValueError, "a value on each"),
        ({"task": 3}, TypeError, "task = 3: expected a function"),
        ({"task": lambda n_screens, seed, **_: {"v": 1.0}}, ValueError, r"v of shape \(\): expected \(2,\)"),
    ],
)
def test_bad_input_is_named(change, error, message):
    with parallel_config(n_jobs=1), pytest.raises(error, match=message):
        sweeps.grid(**{"task": task, "x": [1], "y": [2], "n_screens": 2} | change)
