"""zwfs beside HCIPy, pyZELDA and prysm; with --benchmark-disable each runs once and only its error is checked."""

import pytest

from .peers import Field

CONTESTANTS = list(Field().contestants())
SLOW = [pytest.mark.slow]  # as many samples as no default has
CASES = [pytest.param(one, marks=SLOW if "1024" in one.setting else []) for one in CONTESTANTS]

# Largest error that is believed of a package with its own setting: a worse one means that it is used wrongly here.
LARGEST = {"zwfs": 1e-9, "HCIPy": 5e-3, "HCIPy, vector": 5e-3, "prysm": 5e-3, "pyZELDA": 3e-2}


@pytest.mark.filterwarnings("ignore::Warning")
@pytest.mark.parametrize("contestant", CASES, ids=lambda c: f"{c.task}: {c.name}")
def test_contestant(benchmark, contestant):
    benchmark.group = contestant.task
    contestant.run()  # bases are set up at the first call
    result = benchmark(contestant.run)
    error = contestant.error(result)
    benchmark.extra_info.update(
        package=contestant.package, setting=contestant.setting, default=contestant.default, error=error
    )
    if contestant.default:
        assert error < LARGEST[contestant.package]
    assert error < 0.05


def test_sampled_packages_converge_to_the_exact_kernel():
    # The contest is fair only if every package computes the same thing, up to its sampling.
    for task, package in (("one frame", "HCIPy"), ("one frame", "prysm"), ("two frames", "HCIPy, vector")):
        coarse, fine = (
            next(c for c in CONTESTANTS if (c.task, c.package, c.setting) == (task, package, f"{n} samples"))
            for n in (32, 512)
        )
        assert fine.error(fine.run()) < min(2e-4, coarse.error(coarse.run()) / 20)
