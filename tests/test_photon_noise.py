import numpy as np
import pytest

import zwfs
from studies.design import PUBLISHED, Design, DesignMap, design_map, photon_costs, uneven
from studies.kit.setups import screens_at


@pytest.fixture(scope="module")
def wavefronts(pupil, modes):
    flat = np.zeros((1, *pupil.shape))
    return {"flat": flat, "1 rad rms": screens_at(modes, 1.0, 2, 3, 0)}


@pytest.fixture(scope="module")
def maps(pupil, wavefronts):
    return design_map(pupil, [1.06, 1.4, 2.4], np.array([0.3, 0.5, 0.7]) * np.pi, wavefronts)


def test_no_sensor_is_better_than_the_ideal_one(maps, pupil):
    # The bound leaves out the piston, one of as many directions as there are points.
    assert min(cost.min() for cost in maps.costs.values()) > 1 - 2 / pupil.n_points


def test_the_cost_is_the_mean_square_of_the_bound(pupil, shifted, wavefronts):
    paper = photon_costs(pupil, PUBLISHED[:1], wavefronts)
    for name, phases in wavefronts.items():
        # 250 photons per point in each of two frames.
        bound = pupil.gather(zwfs.cramer_rao(shifted, phases, photons=250))
        assert paper[name][0] == pytest.approx(np.mean(bound**2) * 4 * 500, rel=1e-3)


def test_turned_signs_cost_the_same_for_turned_wavefronts(pupil, wavefronts):
    design = Design("", 1.3, 0.9, -2.0)
    phases = wavefronts["1 rad rms"]
    turned = photon_costs(pupil, [Design("", 1.3, -0.9, 2.0)], {"": -phases[:, ::-1, ::-1]})
    assert photon_costs(pupil, [design], {"": phases})[""] == pytest.approx(turned[""], rel=1e-3)


def test_wider_dimples_with_larger_shifts_need_fewer_photons(maps):
    for costs in maps.costs.values():
        assert costs[1, 2] < 0.6 * costs[0, 1]
    assert maps.costs["flat"][2].min() > 3, "a small tilt is hardly seen near the dark ring"
    assert maps.costs["1 rad rms"][2, 1] < 0.6 * maps.costs["1 rad rms"][0, 1]


def test_equal_sizes_of_the_shifts_are_best(pupil, wavefronts):
    even = Design("", 1.6, 0.7 * np.pi, -0.7 * np.pi)
    costs = photon_costs(pupil, [even, uneven(even, 0.4), uneven(even, -0.4)], wavefronts)
    assert all(cost[0] < cost[1:].min() for cost in costs.values())
    assert costs["flat"][1] == pytest.approx(costs["flat"][2], rel=1e-3)


def test_best_designs_of_a_map():
    costs = {"a": np.array([[2.0, 1.0], [1.5, 4.0]]), "b": np.array([[9.0, 8.0], [3.0, 2.0]])}
    maps = DesignMap(np.array([1.0, 2.0]), np.array([0.5, 0.6]), costs)
    assert maps.best("a") == Design("best, a", 1.0, 0.6, -0.6)
    assert maps.best("b") == Design("best, b", 2.0, 0.6, -0.6)
    assert maps.all_round == Design("all-round", 2.0, 0.5, -0.5)
