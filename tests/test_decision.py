"""The table of the best methods: what decides a cell, and whether the comparison is fair."""

from dataclasses import replace

import numpy as np
import pytest

from studies.decision import (
    BENCHES,
    Cell,
    Row,
    Situation,
    bench_loops,
    dimmed,
    draw_comparison,
    know_bench,
    open_cell,
    open_loop_errors,
    shots,
)
from zwfs.bench import Bench

SITUATIONS = [Situation(0.5, 1e4), Situation(0.5, 100.0), Situation(0.1, 1e4)]


@pytest.fixture(scope="module")
def known():
    return know_bench(Bench.ideal(n_pixels=40, extent=1.3, photons_per_image=1e10), 1e5, 0.1, seed=5)


@pytest.fixture
def errors():
    rng = np.random.default_rng(1)
    scatter = {name: rng.uniform(0.9, 1.1, 8) for name in ("Linear", "Arcsine", "PhaseShifted", "Accelerated")}
    sizes = {"Linear": 0.2, "Arcsine": 0.1, "PhaseShifted": 0.02, "Accelerated": 0.03}
    return {name: sizes[name] * scatter[name] for name in sizes}


def test_a_method_that_becomes_worse_loses_its_cell(errors):
    cell = open_cell(errors)
    assert (cell.images, cell.one, cell.two) == (2, "arcsine", "phase-shifted")
    assert cell.typical == pytest.approx((0.1, 0.02), rel=0.1)
    assert cell.ratio == pytest.approx(0.2, rel=0.1)
    worse = open_cell(errors | {"PhaseShifted": 3 * errors["PhaseShifted"]})
    assert (worse.images, worse.two) == (2, "phase-shifted, accelerated")
    lost = open_cell(worse_by(10, errors))
    assert (lost.images, lost.one) == (1, "arcsine")
    assert lost.typical[0] == pytest.approx(0.1, rel=0.1)
    assert lost.ratio == pytest.approx(10 * cell.ratio, rel=0.2)


def worse_by(factor, errors):
    return errors | {name: factor * errors[name] for name in ("PhaseShifted", "Accelerated")}


def test_methods_that_agree_within_the_scatter_are_called_alike(errors):
    cell = open_cell(errors | {"PhaseShifted": errors["Arcsine"][::-1]})
    assert cell.images == 2  # by the accelerated iteration
    tied = open_cell(worse_by(1e3, errors) | {"PhaseShifted": errors["Arcsine"][::-1]})
    assert tied.images is None
    assert (tied.one, tied.two) == ("arcsine", "phase-shifted")


def test_a_cell_of_loops_says_how_many_close():
    both, settings = (0.7, 0.05), {"n_loops": 12}
    won = Cell("linear", "linear", both, 0.07, 0.06, 0.09, (1, 12), **settings)
    tied = Cell("linear", "linear", both, 1.0, 0.9, 1.1, (12, 12), **settings)
    counts = {"closed": "12 / 1", "closed_one": "1", "closed_two": "12"}
    assert won.texts == {"two": "0.050", "one": "–", "method": "linear", **counts}
    assert (tied.texts["one"], tied.texts["closed"], tied.texts["closed_one"]) == ("0.70", "12 / 12", "12")
    mixed = replace(won, one="arcsine", closed=None).texts
    assert (mixed["two"], mixed["one"], mixed["method"]) == ("0.050", "0.70", "linear; one image: arcsine")
    assert (mixed["closed_one"], mixed["closed_two"]) == ("–", "–")


def test_the_picture_starts_with_small_errors_and_writes_equal_values_once():
    won, tied = (Cell("linear", "linear", both, 0.1, 0.1, 0.1) for both in ((0.3, 0.03), (0.0021, 0.0021)))
    rows = [Row("a", BENCHES["real"], SITUATIONS[0], won), Row("b", BENCHES["real"], SITUATIONS[2], tied)]
    loop = Row("c", "", Situation(0.5, 1.0), Cell("linear", "linear", (0.1, 0.1), 1.0, 0.9, 1.1, (4, 12), 12))
    left, right = draw_comparison(rows, [loop]).axes
    assert [label.get_text().partition("\n")[2] for label in left.get_yticklabels()] == [
        "0.1 rad, 10000 photons",
        "0.5 rad, 10000 photons",
    ]
    assert sorted(text.get_text() for text in left.texts) == ["0.0021", "0.030", "0.30"]
    assert sorted(text.get_text() for text in right.texts) == ["12", "4"]
    assert [label.get_text() for label in right.get_yticklabels()] == ["0.5 rad, 1 photon"]


def test_the_simpler_of_two_methods_that_agree_is_named(errors):
    cell = open_cell(errors | {"Accelerated": 0.99 * errors["PhaseShifted"]})
    assert cell.two == "phase-shifted"


def test_one_image_gets_the_light_that_two_share():
    bench = Bench.ideal(n_pixels=40, extent=1.6, photons_per_image=1e10, flux_imbalance=0.2)
    known = know_bench(bench, 1e6, 0.1, seed=5)
    for photons in (50.0, 1e4):
        one, two = shots(known, photons, np.zeros(bench.n_segments), np.random.SeedSequence(2))
        light = [shot.counts.sum() for shot in (one, two)]
        share = np.divide(light, 2 * photons * np.count_nonzero(bench.segments))
        assert (one.counts.shape[0], two.counts.shape[0]) == (1, 2)
        np.testing.assert_allclose(share[0], share[1], rtol=0.01)
        assert 0.85 < share[0] < 1  # the masks send some of the light past the camera


def test_winners_on_a_bench_without_errors_do_not_depend_on_the_screens(known):
    errors = open_loop_errors({"perfect": known}, {"perfect": SITUATIONS}, {"perfect": 8}, 25, seed=7)["perfect"]
    cells = [open_cell(one) for one in errors]
    assert [cell.images for cell in cells] == [2, 2, None]
    assert all(cell.two == "phase-shifted" for cell in cells[:2])


def test_loops_of_two_images_bring_more_benches_to_flat():
    real = know_bench(Bench(n_pixels=40, extent=1.3), 1e5, 0.1, seed=5)
    near, far = bench_loops(real, [Situation(0.3, 1000.0), Situation(1.0, 1000.0)], 12, seed=3)
    assert near.loops.closed("LinearTwo").all()
    assert near.loops.closed("Linear").all()
    assert far.loops.closed("LinearTwo").sum() > far.loops.closed("Linear").sum() + 3
    # A loop reaches flat, or leaves a segment at least one wave away.
    settled, wave = far.loops.settled["LinearTwo"], 2 * np.pi / np.sqrt(real.bench.n_segments)
    assert np.all((settled < 0.05) | (settled > 0.9 * wave))


def test_exposures_keep_the_share_of_the_background():
    bench = Bench(n_pixels=40)
    short = dimmed(bench, 1e4)
    n_points = np.count_nonzero(bench.segments)
    share = short.photons_per_image / bench.photons_per_image
    assert short.photons_per_image == pytest.approx(1e4 * n_points)
    assert short.background == pytest.approx(share * bench.background)
    assert short.read_noise**2 == pytest.approx(share * bench.read_noise**2)
