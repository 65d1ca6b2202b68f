"""Answers of `design_sensor`, against simulations on screens that it has not seen."""

import inspect
import math

import numpy as np
import pytest

import zwfs
from zwfs.design import method_errors

from .test_bad_input import BAD

NM = 2e-9 * np.pi
N_UNSEEN = 80

# Wanted error and input (nm rms), wavelength (m), and the rest of the question.
QUICK = [(5, 10, 635e-9, {"n_modes": 50}), (5, 50, 635e-9, {"n_modes": 50})]
SLOW = [
    (2, 10, 635e-9, {"n_modes": 20, "read_noise": 2}),
    (3, 40, 550e-9, {"n_modes": 100, "read_noise": 2}),
    (10, 80, 800e-9, {"n_modes": 30}),
    (5, 100, 635e-9, {"n_modes": 50, "read_noise": 2}),
    (20, 100, 1.6e-6, {"n_modes": 20}),
    (10, 150, 635e-9, {"n_modes": 50}),
    (2, 150, 1.65e-6, {"n_modes": 50, "read_noise": 2}),
    (10, 50, 635e-9, {}),  # of all pixels
]


@pytest.mark.parametrize(
    ("error", "rms", "wavelength", "more"),
    [*QUICK, *(pytest.param(*question, marks=pytest.mark.slow) for question in SLOW)],
)
def test_the_method_has_the_wanted_error_on_other_screens(error, rms, wavelength, more):
    answer = zwfs.design_sensor(error, rms, wavelength, **more)
    modes = zwfs.zernike_basis(answer.sensor.pupil, more.get("n_modes", 200))
    screens = zwfs.power_law_screens(modes, rms * NM / wavelength, N_UNSEEN, seed=99)
    noise = {"photons": answer.photons_per_point, "read_noise": more.get("read_noise", 0)}
    errors = method_errors(answer.sensor, screens, modes=answer.modes, seed=100, **noise)
    unseen = errors[answer.method].mean() * wavelength / NM
    assert unseen == pytest.approx(error, rel=0.1)
    assert answer.errors_nm[answer.method] == pytest.approx(error, rel=0.1)
    assert answer.bound_nm < 1.1 * error
    names = list(answer.errors_nm)
    for simpler in names[: names.index(answer.method)]:
        assert errors[simpler].mean() * wavelength / NM > 0.99 * unseen


FLAT = {"n_modes": 50, "diameters": (1.4, 1.4), "phase_shifts": (0.7 * np.pi, 0.7 * np.pi)}


def test_a_flat_wavefront_takes_6100_photons_for_5_nm_on_50_modes():
    answer = zwfs.design_sensor(5, 0, 635e-9, **FLAT)
    bound = zwfs.cramer_rao(answer.sensor, np.zeros((32, 32)), photons=1, modes=answer.modes)
    per_point = np.sum(bound**2) / (5 * NM / 635e-9) ** 2
    assert per_point * 2 * answer.sensor.pupil.n_points == pytest.approx(6100, rel=0.01)
    assert answer.photons_per_exposure == pytest.approx(6100, rel=0.1)
    assert answer.photons_per_exposure == pytest.approx(answer.photons_per_point * 2 * 804, rel=0.02)
    assert (answer.diameter, answer.phase_shift) == (1.4, pytest.approx(0.7 * np.pi))


def test_a_star_has_the_magnitude_that_its_photons_have():
    star = {"frame_rate_hz": 500, "throughput": 0.25, "diameter_m": 2, "zero_point": 1e10}
    answer = zwfs.design_sensor(5, 0, 635e-9, **FLAT, **star)
    assert answer.photons_per_second == pytest.approx(answer.photons_per_exposure * 2000)
    assert answer.photons_per_second == pytest.approx(np.pi * 1e10 * 10 ** (-0.4 * answer.magnitude))
    assert zwfs.design_sensor(5, 0, 635e-9, **FLAT).magnitude is None


def test_the_same_question_has_the_same_answer_in_one_line():
    small = {"n_modes": 6, "n_pixels": 16, "n_screens": 5}
    once, again = (zwfs.design_sensor(5, 20, 635e-9, **small, seed=3) for _ in range(2))
    assert repr(once) == repr(again)
    assert "\n" not in repr(once)
    assert (once.photons_per_exposure, once.errors_nm) == (again.photons_per_exposure, again.errors_nm)


def test_read_noise_takes_light():
    small = {"n_modes": 6, "n_pixels": 16, "n_screens": 20}
    light = [zwfs.design_sensor(5, 20, 635e-9, **small, read_noise=noise).photons_per_exposure for noise in (0, 4)]
    assert light[1] > 2 * light[0]


def test_each_image_has_some_light():
    answer = zwfs.design_sensor(20, 10, 635e-9, n_modes=1, n_pixels=16, n_screens=20)
    assert answer.photons_per_exposure == pytest.approx(200)
    assert answer.errors_nm[answer.method] < 20


def test_no_light_is_enough_for_an_input_beyond_the_range():
    star = {"frame_rate_hz": 500, "diameter_m": 2, "zero_point": 1e10}
    answer = zwfs.design_sensor(5, 635, 635e-9, n_modes=60, n_pixels=16, n_screens=5, **star)
    assert answer.method == "none"
    assert "no light is enough" in repr(answer)
    assert answer.photons_per_exposure == answer.photons_per_point == answer.photons_per_second == math.inf
    assert answer.magnitude == -math.inf
    assert min(answer.errors_nm.values()) > 5.5


PARAMETERS = inspect.signature(zwfs.design_sensor).parameters


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_bad_value_is_refused_by_its_name(name):
    question = {"error_nm": 5, "input_nm": 20, "wavelength_m": 635e-9, "n_modes": 6}
    for value in BAD.values():
        if value is not None or PARAMETERS[name].default is not None:
            with pytest.raises((TypeError, ValueError), match=f"^{name}"):
                zwfs.design_sensor(**question | {name: value})
