"""Results as arrays, files and figures."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from astropy.io import fits

import zwfs
from zwfs.bench import Bench
from zwfs.frames import judge, recover_phase
from zwfs.frames.pipeline import Optics, reduce_frames
from zwfs.frames.registration import Image, register_frames
from zwfs.frames.verdict import ImageOrder


@pytest.fixture(scope="module")
def result():
    pupil = zwfs.Pupil.circular(16)
    sensor = zwfs.ZernikeSensor(pupil, zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2))
    screens = zwfs.power_law_screens(zwfs.zernike_basis(pupil, 8), 0.3, 2, seed=1)
    return zwfs.MaximumLikelihood(sensor, photons=1000.0)(sensor.measure(screens))


def test_a_result_is_its_phase_for_numpy(result):
    np.testing.assert_array_equal(np.asarray(result), result.phase)
    np.testing.assert_array_equal(2 * result - result, result.phase)
    np.testing.assert_array_equal(result[0], result.phase[0])
    assert np.nanstd(result) == np.nanstd(result.phase)


@pytest.mark.parametrize("ending", [".fits", ".npz"])
def test_a_saved_result_holds_all_arrays(tmp_path, result, ending):
    path = tmp_path / f"result{ending}"
    result.save(path)
    if ending == ".fits":
        with fits.open(path) as units:
            arrays = {unit.name: unit.data for unit in units}
            np.testing.assert_array_equal(units[0].data, result.phase)
    else:
        with np.load(path) as file:
            arrays = {name.upper(): file[name] for name in file.files}
            assert json.loads(str(file["values"]))["settings n_iterations"] == 50
    for name in ("phase", "converged", "chi2", "frames"):
        np.testing.assert_array_equal(arrays[name.upper()], getattr(result, name))


def test_an_existing_file_stays_and_other_endings_are_refused(tmp_path, result):
    path = tmp_path / "result.npz"
    path.write_text("mine")
    with pytest.raises(FileExistsError, match="expected a new name"):
        result.save(path)
    assert path.read_text() == "mine"
    with pytest.raises(ValueError, match=r"ends with \.fits or \.npz"):
        result.save(tmp_path / "result.txt")


def test_a_figure_shows_phase_and_standard_error(result):
    figure = result.plot()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels.count("row (pixel)") == 2
    assert {"phase (rad)", "standard error (rad)"} <= set(labels)
    assert len(repr(result).splitlines()) == 1


@pytest.fixture(scope="module")
def results():
    """Results of camera frames."""
    bench = Bench(n_pixels=40, n_rings=1, missing=(), photons_per_image=1e8)
    frames, clear = bench.frames(), bench.clear_frames()
    registered = register_frames(*([Image.of(counts, "image") for counts in pair] for pair in (frames, clear)))
    measurement = reduce_frames(registered, Optics())
    phases = recover_phase(measurement)
    instances = [phases, measurement, phases.agreement, registered, registered.placement]
    instances += [judge(phases), ImageOrder(Optics(), False, 1.0, 0.0)]
    return {type(instance).__name__: instance for instance in instances}


@pytest.mark.parametrize(
    "name",
    ["Agreement", "Measurement", "RegisteredFrames", "Placement", "Verdict", "Phases", "ImageOrder"],
)
def test_fields_of_another_kind_are_named(results, name):
    for field in fields(results[name]):
        for wrong in (object(), {}, b"1"):
            if field.name == "findings" and wrong == {}:
                continue
            with pytest.raises(TypeError, match=rf"^{field.name} "):
                replace(results[name], **{field.name: wrong})


def test_numbers_of_another_kind_are_named(results):
    phases = results["Phases"]
    with pytest.raises(TypeError, match="phase has dtype complex128: expected an array of float32"):
        replace(phases, phase=phases.phase.astype(complex))
    assert replace(phases, phase=phases.phase.astype(float)).phase.dtype == float


def test_a_figure_of_a_verdict_shows_the_control(results):
    [axes] = (axes for axes in results["Verdict"].plot().axes if axes.get_xlabel() == "image")
    assert [line.get_label() for line in axes.lines] == ["score", "control"]
