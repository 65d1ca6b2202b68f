"""Calibration on frames of HCIPy: python -m tests.benchmarks.foreign_bench [cases] [--draws N] [--pixels N].

For each case and each order of the images one line gives the misfit, the errors of the numbers next to their error
bars, and the errors of unseen screens next to those of the plain route with the values of the design, as
`tests.hcipy_bench.BEFORE` stores them. With --draws the noise is drawn anew, and the coverage of the error bars is
printed. Set OMP_NUM_THREADS=1.
"""

import argparse
from dataclasses import replace
from time import process_time

import numpy as np

from tests.hcipy_bench import BEFORE, CASES, RMS
from zwfs.frames import Calibration


def fitted(bench, seed=1):
    """Calibration from one recording, and its time on a core in seconds."""
    frames, clear, phases = bench.recording(seed=seed)
    start = process_time()
    calibration = Calibration.fit(frames, clear, phases, n_pixels=bench.pixels, noise=bench.noise)
    return calibration, process_time() - start


def unseen(bench, calibration, seeds=(1, 2)):
    """Rms errors of unseen screens, radian, (n_rms, n_seeds)."""

    def error(rms, seed):
        screen = bench.smooth(rms, seed=seed)
        return bench.error(calibration(bench.counts(screen, (7, seed)), smooth=True), screen)

    return np.array([[error(rms, seed) for seed in seeds] for rms in RMS])


def line(name, bench, fit, seconds):
    """Print the errors of a fit."""
    truth, pulls = bench.truth, bench.pulls(fit)
    optics = ("diameter", "first", "second")
    relative = max(abs(fit[one].value / truth[one] - 1) for one in optics)
    off = {one: fit[one].value - truth[one] for one in ("leakage", "blur")}
    print(
        f"{name:20s} misfit {fit.misfit.mean():.3f}  consistent {fit.consistent}  converged {fit.converged}  "
        f"diameter and shifts {100 * relative:.3f} %, {max(abs(pulls[one]) for one in optics):.1f} sigma  "
        f"leakage {off['leakage']:+.4f}  blur {off['blur']:+.3f} pixel  "
        f"worst {max(map(abs, pulls.values())):.1f} sigma  {seconds:.0f} s {' '.join(fit.remarks)}",
        flush=True,
    )


def coverage(name, bench, n_draws):
    """Print the share of all numbers within one error bar, and the largest error, over draws of the noise."""
    pulls = []
    for seed in range(n_draws):
        calibration, _ = fitted(bench, seed)
        pulls.append(np.abs(list(bench.pulls(calibration.bench).values())))
        print(
            f"{name:20s} draw {seed}: {np.mean(pulls[-1] < 1):.2f} within one, largest {pulls[-1].max():.1f}",
            flush=True,
        )
    pooled = np.concatenate(pulls)
    print(f"{name:20s} {n_draws} draws: {np.mean(pooled < 1):.3f} within one, largest {pooled.max():.1f}")


def main():
    """Run the cases that the arguments name."""
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--pixels", type=int, default=56)
    arguments = parser.parse_args()
    for name in arguments.cases:
        bench = replace(CASES[name], pixels=arguments.pixels, side=arguments.pixels + 16)
        if arguments.draws:
            coverage(name, bench, arguments.draws)
            continue
        for order, one in (("", bench), (" reversed", bench.reversed)):
            calibration, seconds = fitted(one)
            line(name + order, one, calibration.bench, seconds)
            if not order:
                errors = unseen(one, calibration)
                before = BEFORE[name.replace("turned VLT", "VLT")]["plain"]
                pairs = zip(RMS, errors, before, strict=True)
                print("    unseen:", "; ".join(f"{rms} rad: {e.max():.4f} (before {b})" for rms, e, b in pairs))


if __name__ == "__main__":
    main()
