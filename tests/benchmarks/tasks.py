"""Cost of a task of each sweep at the figures' parameters, as a Markdown table: python -m tests.benchmarks.tasks.

Processor time does not grow when a machine is busy. The memory is that of a worker which does only such tasks.
"""

import multiprocessing
import os
import resource
from functools import partial
from time import process_time

# Before NumPy is loaded, here and in the processes that measure.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import numpy as np

import zwfs
from studies.error_budget import error_budget
from studies.fig03_dynamic_range import linearity_curves
from studies.fig04_dimple_diameter import iteration_curves
from studies.kit import sweeps
from studies.kit.bench import bench_curves, bench_reconstructors
from studies.kit.methods import paper_reconstructors
from studies.kit.setups import screens_at
from studies.phase_shift_pairs import pair_maps
from zwfs.bench.model import Bench, BenchModel


def screens_on(n_pixels, rms, n_screens):
    pupil = zwfs.Pupil.circular(n_pixels)
    return pupil, screens_at(zwfs.zernike_basis(pupil, 200), rms, n_screens, 2024, 0)


def figure_3(n_pixels):
    pupil = zwfs.Pupil.circular(n_pixels)
    modes = zwfs.zernike_basis(pupil, 200)
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2)
    linearity_curves(methods, modes, [0.1, 0.5, 1.0], 20, seed=2024)


def figure_4(n_iterations, n_screens):
    pupil, screens = screens_on(100, 0.5, n_screens)
    iteration_curves(pupil, np.pi / 2, n_iterations, [1.06, 2.0, 3.0], screens)


def figure_9():
    bench = Bench(extent=2.0)
    model = BenchModel.from_images(bench, 1)
    bench_curves(bench, model, bench_reconstructors(bench, model, seed=1), [0.05, 0.5, 1.0], 10, seed=1)


def budget():
    error_budget(Bench().single_errors(), ["PhaseShifted"], [0.0, 0.3, 0.8], 5, seed=1)


def maps():
    pupil, screens = screens_on(64, 0.5, 3)
    pair_maps(pupil, 1.06, np.linspace(-np.pi, np.pi, 7).round(12), screens)


EXPERIMENTS = {
    "Figure 3: an input, 20 screens, 6 reconstructors": partial(figure_3, 100),
    "the same, 50 pixels across": partial(figure_3, 50),
    "the same, 200 pixels across": partial(figure_3, 200),
    "Figure 4: a diameter, 20 screens, 25 iterations": partial(figure_4, 25, 20),
    "Figure 4: a diameter, 4 screens, 400 iterations": partial(figure_4, 400, 4),
    "Figure 9: an input, 10 screens, 5 reconstructors": figure_9,
    "Error budget: an error, 3 inputs, 5 screens": budget,
    "Pairs of phase shifts: a pair, 3 screens, 64 pixels across": maps,
}


def measure(experiment, results):
    """Do the tasks of an experiment one by one, and return the seconds of each and the most memory."""
    seconds, depth = [], 0

    def run(task, inputs, *shared, name):
        nonlocal depth
        found = []
        for value in inputs:
            begin, depth = process_time(), depth + 1
            found.append(task(value, *shared))
            depth -= 1
            if not depth:  # a sweep within a task is a part of it
                seconds.append(process_time() - begin)
        return found

    sweeps.run = run
    experiment()
    results.put((seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def main():
    print("| a task | processor time (s), mean | least to most | memory (MB) |")
    print("| --- | ---: | ---: | ---: |")
    for name, experiment in EXPERIMENTS.items():
        context = multiprocessing.get_context("spawn")
        results = context.Queue()
        process = context.Process(target=measure, args=(experiment, results))
        process.start()
        seconds, memory = results.get()
        process.join()
        spread = f"{min(seconds):.2g} to {max(seconds):.2g}"
        print(f"| {name} | {np.mean(seconds):.2g} | {spread} | {memory:.0f} |", flush=True)


if __name__ == "__main__":
    main()
