"""Pupils, screens and noise that nested parameters choose: the paper's by default, and what they say otherwise."""

import inspect
import re
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from book._tools import declared, rerun
from book._tools.notebook import read
from book._tools.project import Project
from studies.kit.parameters import Fields, check_parameters
from studies.kit.setups import BASES, SCREENS, Noise, make_pupil, make_screens, turbulent_rms
from zwfs import Dimple, Pupil, ZernikeSensor
from zwfs.turbulence import structure_function, turbulent_screens

FIGURE_3 = "fig03_dynamic_range"
NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
STUDIES = {path.stem: import_module(f"studies.{path.stem}") for path in sorted(NOTEBOOKS.glob("*.ipynb"))}
NESTED = [
    (name, key)
    for name, study in STUDIES.items()
    for key, limits in study.LIMITS.items()
    if isinstance(limits, Fields)
]


def default(name):
    parameters = declared.parameters(read(NOTEBOOKS / f"{name}.ipynb"))
    return {key: parameter.default for key, parameter in parameters.items()}


def test_a_change_is_made_to_the_preset():
    seal, whole = make_pupil(64, "seal"), make_pupil(64, "seal", missing=[])
    assert set(np.unique(whole.segments)) - set(np.unique(seal.segments)) == {21}
    assert (whole.segments == Pupil.hexagonal(64, 3, 0.015, (), 0.78).segments).all()
    cut = make_pupil(64, "seal", obstruction=0.5)
    x, y = np.meshgrid(cut.x, cut.y)
    assert not cut.inside[np.hypot(x, y) < 0.25].any()


@pytest.mark.parametrize("kind", [kind for kind in SCREENS if kind != "file"])
@pytest.mark.parametrize("basis", BASES)
def test_screens_of_every_kind_have_the_rms_and_the_seed_decides(kind, basis):
    pupil = make_pupil(32, "hexagonal")
    source = make_screens(pupil, 20, -2.0, kind=kind, basis=basis)
    screens = source(0.4, 3, 1)
    np.testing.assert_allclose(pupil.rms(screens), 0.4, rtol=1e-9)
    np.testing.assert_array_equal(screens, source(0.4, 3, 1))
    assert not np.allclose(screens, source(0.4, 3, 2))
    if kind == "segments":
        assert len(np.unique(screens[0].round(12))) <= 38


def test_the_mean_square_of_turbulence_is_that_of_the_structure_function():
    """On a disc the distances have a known density, and Noll 1976 gives 1.0299 for the mean square."""

    def integrand(s):  # of the distance in a disc of radius 1
        density = 4 * s / np.pi * np.arccos(s / 2) - 2 * s**2 / np.pi * np.sqrt(1 - s**2 / 4)
        return density * structure_function(s / 2) / 2

    expected = quad(integrand, 0, 2)[0]
    assert expected == pytest.approx(1.0299, rel=3e-3)
    assert turbulent_rms(make_pupil(100)) ** 2 == pytest.approx(expected, rel=1e-3)
    pupil = make_pupil(16, "vlt", obstruction=0.3)
    apart = np.hypot(*(pupil.points[:, np.newaxis] - pupil.points).transpose(2, 0, 1))
    for scale in (np.inf, 5.0):
        pairs = np.mean(structure_function(apart, outer_scale=scale)) / 2
        assert turbulent_rms(pupil, scale) ** 2 == pytest.approx(pairs, rel=1e-9)


@pytest.mark.parametrize("kind", ["kolmogorov", "von_karman"])
def test_screens_of_a_strength_scatter_as_turbulence_around_their_root_mean_square(kind):
    pupil = make_pupil(24)
    source = make_screens(pupil, 10, -2.0, kind=kind, d_over_r0=8.0)
    largest = source.largest(1.0)
    screens = source(largest, 1000, 1)
    sizes = pupil.rms(screens)
    assert np.sqrt(np.mean(sizes**2)) == pytest.approx(source.unit * 8.0 ** (5 / 6), rel=0.05)
    assert sizes.std() > 0.2 * sizes.mean()
    # The same turbulence as the package draws it, and half of its rms at half of the input.
    r0 = turbulent_screens(pupil, 1 / 8, 1000, source.outer_scale, 1)
    np.testing.assert_allclose(screens, r0, rtol=1e-3)
    np.testing.assert_allclose(source(largest / 2, 2, 1), screens[:2] / 2, rtol=1e-12)
    assert source.d_over_r0_of(largest) == pytest.approx(8.0, rel=1e-3)
    assert source.inputs([0.1, 1.0, 40.0]) == [0.1, 1.0, largest]


def test_a_file_gives_pupil_and_screens(tmp_path):
    image = np.clip(np.add.outer(np.arange(20.0), np.arange(20.0)), 3, None)
    np.save(tmp_path / "pupil.npy", image)
    pupil = make_pupil(20, "file", file=str(tmp_path / "pupil.npy"))
    np.testing.assert_allclose(pupil.amplitude / pupil.amplitude.max(), image / image.max())
    with pytest.raises(ValueError, match="expected n_pixels = 24"):
        make_pupil(24, "file", file=str(tmp_path / "pupil.npy"))
    maps = np.random.default_rng(1).normal(size=(4, 20, 20))
    np.save(tmp_path / "screens.npy", maps)
    inside = Pupil.circular(20)
    source = make_screens(inside, 5, -2.0, kind="file", file=str(tmp_path / "screens.npy"))
    drawn = inside.gather(source(0.3, 4, 1))
    correlation = np.corrcoef(drawn, inside.gather(maps))[:4, 4:]
    assert sorted(correlation.argmax(axis=1)) == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="at most the 4"):
        source(0.3, 5, 1)


def refusal(**values):
    notebook = read(NOTEBOOKS / f"{FIGURE_3}.ipynb")
    defaults = {key: parameter.default for key, parameter in declared.parameters(notebook).items()}
    begin = time.process_time()
    with pytest.raises(declared.ParameterError) as caught:
        declared.accept_together(notebook, defaults | {"n_pixels": 24, "n_modes": 10} | values)
    assert time.process_time() - begin < 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("parameter", "values", "message"),
    [
        ("screens", np.ones((3, 24, 24)), r"screens: a.npy\[0\] is flat, not finite"),
        ("screens", np.stack([np.eye(24)] * 2), "n_screens = 20: expected at most the 2 of the file"),
        ("pupil", np.ones((24, 24)), "pupil: pupil reaches 0.6776 D from its axis"),
        ("pupil", np.ones((2, 24, 24)), r"pupil: a.npy: its shape is \(2, 24, 24\): expected"),
    ],
)
def test_files_that_do_not_fit_are_refused_before_any_work(parameter, values, message, tmp_path):
    np.save(tmp_path / "a.npy", values)
    assert re.match(message, refusal(**{parameter: {"kind": "file", "file": str(tmp_path / "a.npy")}}))


def test_endless_and_huge_files_are_not_read(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:  # zeros that take no place on the disk
        np.lib.format.write_array_header_1_0(
            file, {"shape": (1000, 775, 775), "fortran_order": False, "descr": "<f8"}
        )
        file.truncate(4_805_000_128)
    assert "a.npy: it is larger than" in refusal(screens={"kind": "file", "file": str(tmp_path / "a.npy")})
    assert "/dev/zero: no such file" in refusal(screens={"kind": "file", "file": "/dev/zero"})
    assert "screens: path = ''" in refusal(screens={"kind": "file"})


def test_noise_is_that_of_the_photons():
    pupil = make_pupil(32)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))
    phase, photons, read_noise = np.zeros((200, *pupil.shape)), 1000.0, 10.0
    frames = pupil.gather(Noise(photons, read_noise)(sensor, phase, 1))
    mean = pupil.gather(sensor.measure(phase[0]))
    assert np.mean(frames.var(axis=0) / (mean / photons + (read_noise / photons) ** 2)) == pytest.approx(
        1, abs=0.02
    )
    faint = Noise(10.0, read_noise)(sensor, phase, 1)
    assert np.mean(faint - sensor.measure(phase[0])) == pytest.approx(0, abs=0.01)  # negative pixels are kept
    with pytest.raises(ValueError, match=r"noise.read_noise = 1 with photons = 0"):
        Noise(read_noise=1.0)


@pytest.mark.parametrize(
    ("figure", "settings", "message"),
    [
        ("3", ["n_pixels=16", "n_modes=300"], "n_modes = 300: expected at most 207 with the 208 points of pupil"),
        ("3", ["pupil={kind: keck, missing: [40]}"], r"pupil.missing = \[40\]"),
        ("4", ["pupil={vanes: [[0.0, 3.0], [3.1416, 3.0]]}"], r"pupil: spiders\[0\] width = 3.0"),
        ("3", ["screens={kind: segments}"], "screens.kind = .segments.: expected a pupil of two or more segments"),
        ("5", ["bench={missing: [38]}"], r"bench.missing = \[38\]: expected segment numbers from 1 to 37"),
    ],
)
def test_values_that_contradict_each_other_are_refused_before_a_kernel_starts(figure, settings, message):
    begin = time.process_time()
    with pytest.raises(declared.ParameterError, match=message):
        rerun.rerun(
            Project(NOTEBOOKS.parent), [figure, *(text for setting in settings for text in ("-p", setting))]
        )
    assert time.process_time() - begin < 2


@pytest.mark.parametrize(("name", "key"), NESTED)
def test_every_field_is_listed_with_a_meaning_and_its_default_is_allowed(name, key):
    parameter = declared.parameters(read(NOTEBOOKS / f"{name}.ipynb"))[key]
    for field, limited in parameter.fields().items():
        assert limited.meaning, field
        if limited.default not in (None, "", inspect.Parameter.empty):
            value = list(limited.default) if isinstance(limited.default, tuple) else limited.default
            check_parameters({field: value}, **{field: limited.limits})
