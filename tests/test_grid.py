"""A grid of inputs: every combination, in blocks that change no bit, and continued where it stopped."""

import csv

import numpy as np
import pytest
from joblib import parallel_config

from studies.kit.grids import Recovery, draw_slice, grid
from studies.kit.methods import paper_reconstructors
from studies.kit.setups import make_pupil, make_screens
from zwfs import PhaseShifted


def task(x, y, n_screens, seed):
    drawn = np.random.default_rng(seed).standard_normal(n_screens)
    return {"value": 100 * x + y + drawn, "drawn": drawn}


@pytest.fixture(scope="module")
def result():
    return grid(task, x=[1, 2, 3], y=np.array([0.5, 0.25]), n_screens=5, seed=4)


def of_points(result, name):
    """A column as an array over the axes and the screens."""
    return result.columns[name].reshape(3, 2, 5)


def test_every_combination_has_its_rows(result):
    expected = 100 * np.array([1, 2, 3])[:, None, None] + np.array([0.5, 0.25])[:, None] + np.zeros(5)
    np.testing.assert_allclose(of_points(result, "value") - of_points(result, "drawn"), expected)
    assert of_points(result, "x")[:, 1, 2].tolist() == [1, 2, 3]
    assert of_points(result, "y")[2, :, 2].tolist() == [0.5, 0.25]
    assert of_points(result, "screen")[1, 1].tolist() == [0, 1, 2, 3, 4]
    # All points see the same random numbers.
    assert np.ptp(of_points(result, "drawn"), axis=(0, 1)).max() == 0
    assert np.ptp(result.columns["drawn"]) > 0


def test_a_larger_grid_computes_only_what_is_new(tmp_path, monkeypatch):
    monkeypatch.setenv("ZWFS_SWEEPS", str(tmp_path))
    counted = tmp_path / "counted"

    def counting(x, n_screens, seed):
        with counted.open("a") as file:
            file.write("x")
        return {"value": np.full(n_screens, x)}

    with parallel_config(n_jobs=1):
        grid(counting, x=[1, 2], n_screens=4, block=2)
        assert counted.read_text() == 4 * "x"
        larger = grid(counting, x=[1, 2, 3], n_screens=6, block=2)
    assert counted.read_text() == 9 * "x"
    np.testing.assert_array_equal(larger.columns["value"][5::6], [1, 2, 3])


def test_slices_and_the_file(result, tmp_path):
    part = result.select(y=0.25, screen=2)
    np.testing.assert_array_equal(part.columns["value"], of_points(result, "value")[:, 1, 2])
    result.write(tmp_path / "grid.csv")
    with (tmp_path / "grid.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 30
    assert float(rows[7]["value"]) == of_points(result, "value")[0, 1, 2]
    assert (rows[7]["x"], rows[7]["y"], rows[7]["screen"]) == ("1", "0.25", "2")
    with pytest.raises(ValueError, match=r"y = 7: expected one of \[0.25, 0.5\]"):
        result.select(y=7)
    with pytest.raises(ValueError, match="unknown axis 'z': expected one of x, y"):
        result.select(z=7)


def test_recovery_is_the_error_of_the_reconstructor():
    pupil = make_pupil(24)
    source = make_screens(pupil, 20, -2.0)
    result = grid(Recovery(source), diameter=[1.06, 2.0], phase_shift=[1.0], rms=[0.1, 0.4], n_screens=3)
    method = PhaseShifted(paper_reconstructors(pupil, source.modes, 2.0, 1.0)["PhaseShifted"].sensor)
    screens = source(0.4, 3, np.random.SeedSequence(0, spawn_key=(0,)))
    estimate = method(method.sensor.measure(screens))
    error = pupil.gather(estimate.phase - screens)
    part = result.select(diameter=2.0, phase_shift=1.0, rms=0.4).columns
    np.testing.assert_allclose(part["error"], error.std(axis=1), rtol=1e-6)
    np.testing.assert_array_equal(part["converged"], estimate.converged)


def test_a_slice_is_the_mean_over_the_screens(result):
    order = [1, 0]  # the values of y, sorted
    mean = of_points(result, "value").mean(axis=-1)
    for index, y in zip(order, (0.25, 0.5), strict=True):
        axes = draw_slice(result.select(y=y), "value", "x").axes[0]
        np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), mean[:, index])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x", "mean of value")
    mapped = draw_slice(result, "value", "x", "y").axes[0].collections[0].get_array()
    np.testing.assert_allclose(mapped, mean.T[order])
    with pytest.raises(ValueError, match=r"axes \['y'\] have several values"):
        draw_slice(result, "value", "x")


@pytest.mark.parametrize("screens", [slice(None), 3])
def test_a_slice_survives_a_failed_column(screens):
    def failing(diameter, rms, n_screens, seed):
        error = np.full(n_screens, rms)
        error[screens if diameter == 2 else slice(0)] = np.nan
        return {"error": error}

    with parallel_config(n_jobs=1):
        result = grid(failing, diameter=[1.0, 2.0, 3.0], rms=[0.5, 1.0], n_screens=4)
    drawn = draw_slice(result, "error", "diameter", "rms")
    middle = np.nan if screens == slice(None) else 1.0
    shown = np.ma.filled(drawn.axes[0].collections[0].get_array(), np.nan)
    np.testing.assert_array_equal(shown[1], [1.0, middle, 1.0])
    assert [axes.get_ylabel() for axes in drawn.axes] == ["rms (rad rms)", "mean of error (rad rms)"]
    drawn.canvas.draw()
