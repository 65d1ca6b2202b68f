"""The notebook `calibration`: its recorded frames, its verdict, and the code that its page shows."""

import re
from dataclasses import replace

import nbformat
import numpy as np
import pytest

from studies import calibration as study
from zwfs import Dimple, Pupil, ZernikeSensor, opd_to_phase

from . import calibration_frames


@pytest.fixture(scope="module")
def recording():
    return study.Recording.read()


def test_recorded_frames_are_those_that_the_script_makes(recording):
    assert calibration_frames.FILE.stat().st_size < 600e3
    arrays = calibration_frames.made()
    assert arrays.keys() == recording.arrays.keys()
    for name, values in arrays.items():
        assert values.dtype == recording.arrays[name].dtype
        # The last digits of the light depend on the processor: a draw may then differ by a count.
        np.testing.assert_allclose(recording.arrays[name], values, rtol=0, atol=values.dtype == np.int16)


def test_shorter_exposures_have_the_light_of_the_calibration_and_more_noise(recording):
    (bright, *_), (faint, *_) = (recording.unseen(0.5, photons) for photons in recording.photons)
    (light, noise), (same, more) = (recording.shot(number) for number in (bright, faint))
    assert same.sum() == pytest.approx(light.sum(), rel=0.05)  # of another screen
    assert np.median(more) > 10 * np.median(noise)


@pytest.mark.slow
@pytest.mark.parametrize(("error", "consistent"), [(0.02, True), (0.03, False)])
def test_verdict_shows_commands_that_are_wrong_by_three_percent(recording, error, consistent):
    wrong = {**recording.arrays, "commands": (1 + error) * recording.arrays["commands"]}
    assert study.calibrate(replace(recording, arrays=wrong)).bench.consistent == consistent


@pytest.mark.parametrize("mirrored", [False, True])
def test_three_pokes_place_the_mirror_on_the_camera(tmp_path, monkeypatch, mirrored):
    """The code of the page finds flip, rotation and scale; with the actuators in a wrong order it fails."""
    monkeypatch.chdir(tmp_path)
    notebook = nbformat.read(study.__file__.replace("studies/calibration.py", "calibration.ipynb"), as_version=4)
    texts = [cell.source for cell in notebook.cells if "Code of steps 2 and 3" in cell.source]
    code = re.search(r"Code of steps 2 and 3.*?```python\n(.*?)```", texts[0], re.DOTALL)[1]
    n, side, angle = 40, 52, np.radians(8)
    turn = 3.4 * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) @ np.diag([1, -1])
    actuators = np.indices((12, 12)).reshape(2, -1).T
    places = (actuators - 5.5) @ turn + [19.3, 20.4]
    apart = np.indices((n, n)) - places[:, :, None, None]
    influence = np.exp(-np.sum(apart**2, axis=1) / (1.1 * 3.4) ** 2)
    pupil = Pupil.circular(n)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2), extent=side / n)
    pokes = np.array([(3, 2), (9, 5), (3, 9)] if mirrored else [(2, 3), (5, 9), (9, 3)]) @ [12, 1]
    static, rng = 0.1 * np.sin(np.arange(n) / 5), np.random.default_rng(1)

    def read(name):
        sign = 1 if name == "pushed.fits" else -1
        return rng.poisson(2000 * sensor.measure(static + sign * 0.5 * influence[pokes])).astype(float)

    strokes = 40 * np.sin(actuators[:, 0] / 3) * np.cos(actuators[:, 1] / 4)
    np.save("strokes.npy", np.stack([0 * strokes, strokes]))
    exec(code, {"read": read, "np": np, "side": side})
    flat, shaped = np.load("commands.npy")
    true = opd_to_phase(2 * np.tensordot(strokes, influence, 1), 635.0)
    error = (shaped - true)[pupil.inside].std() / true[pupil.inside].std()
    assert not flat.any()
    assert error > 0.5 if mirrored else error < 0.05
