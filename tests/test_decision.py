"""One image or two: what decides a row, and whether the comparison is fair."""

import numpy as np
import pytest

from studies.decision import (
    Row,
    Situation,
    findings,
    know_bench,
    open_rows,
    shots,
)
from zwfs.bench import Bench

SITUATIONS = [Situation(0.5, 1e4), Situation(0.5, 100.0), Situation(0.1, 1e4)]


@pytest.fixture
def errors():
    rng = np.random.default_rng(1)
    sizes = {"Linear": 0.2, "Arcsine": 0.1, "LikelihoodOne": 0.3}
    sizes |= {"LinearTwo": 0.2, "PhaseShifted": 0.02, "Accelerated": 0.03, "MaximumLikelihood": 0.04}
    scatter = rng.uniform(0.9, 1.1, 8)
    return {name: size * scatter for name, size in sizes.items()}


def row(errors):
    [result] = open_rows({"real": SITUATIONS[:1]}, {"real": [errors]})
    return result


def worse_by(factor, errors):
    return errors | {
        name: factor * errors[name] for name in ("LinearTwo", "PhaseShifted", "Accelerated", "MaximumLikelihood")
    }


def test_a_method_that_becomes_worse_loses_its_row(errors):
    assert row(errors).methods == ("arcsine", "phase-shifted")
    assert row(errors).errors == pytest.approx((0.1, 0.02), rel=0.1)
    assert row(errors | {"PhaseShifted": 3 * errors["PhaseShifted"]}).methods[1] == "phase-shifted, accelerated"
    assert row(worse_by(10, errors)).gain == pytest.approx(0.1 * row(errors).gain)


def test_the_simpler_of_two_methods_that_agree_is_named(errors):
    assert row(errors | {"Accelerated": 0.95 * errors["PhaseShifted"]}).methods[1] == "phase-shifted"
    assert row(errors | {"Accelerated": 0.8 * errors["PhaseShifted"]}).methods[1] == "phase-shifted, accelerated"


def test_the_sentences_say_which_case_each_number_of_images_wins(errors):
    situations, cases = {"real": SITUATIONS}, {"real": [errors, worse_by(5, errors), worse_by(100, errors)]}
    loop = Row("", Situation(1.0, 1.0), ("linear", "linear"), (0.1, 0.1), (4, 12), 12)
    text = findings(open_rows(situations, cases), [loop]).markdown
    assert "in 1 of 3 cases" in text
    assert "About equal: bench with errors, 0.5 rad rms, 100 photons." in text
    assert "One image is better: bench with errors, 0.1 rad rms, 10000 photons." in text
    assert "12 instead of 4 at 1 rad rms and 1 photon." in text


def test_one_image_gets_the_light_that_two_share():
    bench = Bench.ideal(n_pixels=40, extent=1.6, photons_per_image=1e10, flux_imbalance=0.2)
    learnt = know_bench(bench, 1e6, 0.1, seed=5)
    for photons in (50.0, 1e4):
        single, pair = shots(learnt, photons, np.zeros(bench.n_segments), np.random.SeedSequence(2))
        light = [shot.counts.sum() for shot in (single, pair)]
        share = np.divide(light, 2 * photons * np.count_nonzero(bench.segments))
        assert (single.counts.shape[0], pair.counts.shape[0]) == (1, 2)
        np.testing.assert_allclose(share[0], share[1], rtol=0.01)
        assert 0.85 < share[0] < 1  # the masks send some of the light past the camera
