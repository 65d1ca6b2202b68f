"""The calls that the benchmarks time give right answers."""

import json

import pytest

from . import latency, speed, telemetry
from .report import KEPT, fingerprint


def test_numbers_of_the_performance_page_are_those_that_were_measured():
    kept = json.loads(KEPT.read_text("utf-8"))
    assert kept["sha256"] == fingerprint(kept)
    kept["speed"]["slope"]["times"][0] += 0.01
    assert kept["sha256"] != fingerprint(kept)


def test_real_time_settings_meet_their_errors():
    rows = speed.real_time(40, "float32", seconds=0)
    json.dumps(rows)
    fewest = {row["n_iterations"]: row["median error"] for row in rows if row["accelerate"]}
    assert fewest[2] < 0.01
    assert fewest[4] < fewest[3] < fewest[2]
    assert all(row["rate"] > 0 for row in rows)


def test_one_iteration_follows_a_slow_wavefront():
    assert speed.closed_loop(40, seconds=0)["median error"] < 0.01


def test_causes_of_late_calls_are_shares_of_all_calls():
    row = latency.latency(40, 30)
    assert row["p50"] <= row["p99"] <= row["p99.9"]
    assert all(0 <= row[name] <= row["late"] <= 1 for name in row if name.startswith("late"))


def test_controller_takes_little_more_than_a_bare_product():
    rows = {row["road"]: row for row in latency.controllers(40, 200)}
    assert rows["controller"]["processor p50"] < rows["three iterations"]["processor p50"]
    assert all(row["processor p50"] <= row["processor p99"] for row in rows.values())


def test_long_cube_is_reconstructed_without_a_flag():
    found = telemetry.telemetry(70, 1, 40)
    assert found["output"] > 70 * 4 * 40**2
    assert found["parts"]["whole"] > found["parts"]["resampling"] > 0


def test_likelihood_is_timed_in_propagations():
    assert speed.likelihood(0, n_pixels=32)["one propagation"] == 1


def test_roads_to_the_phase_are_timed_together():
    rows = {row["road"]: row for row in speed.looks(0, n_pixels=32)}
    assert rows["one look"]["median error"] == pytest.approx(rows["full call"]["median error"], rel=1e-2)
    assert rows["3 iterations, accelerated"]["median error"] < rows["one look"]["median error"] < 0.02
    assert all(row["time"] > 0 for row in rows.values())
