"""Cost of a task of each sweep at the figures' parameters, as a Markdown table: python -m tests.benchmarks.tasks.

Processor time does not grow when a machine is busy. The memory is that of a worker which does only such tasks.
"""

import multiprocessing
import os
import resource
from time import process_time

# Before NumPy is loaded, here and in the processes that measure.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import numpy as np

import zwfs
from zwfs.bench.model import Bench, BenchModel
from zwfs.companion import sweeps
from zwfs.paper.bench_linearity import bench_curves, bench_reconstructors, error_budget
from zwfs.paper.dimple_diameter import iteration_curves
from zwfs.paper.linearity import linearity_curves, paper_reconstructors, screens_at
from zwfs.paper.phase_shifts import pair_maps


def screens_on(n_pixels, rms, n_screens):
    pupil = zwfs.Pupil.circular(n_pixels)
    return pupil, screens_at(zwfs.zernike_basis(pupil, 200), rms, n_screens, 2024, 0)


def figure_3(n_pixels=100):
    """Figure 3: an input, 20 screens, 6 reconstructors"""
    pupil = zwfs.Pupil.circular(n_pixels)
    modes = zwfs.zernike_basis(pupil, 200)
    methods = paper_reconstructors(pupil, modes, 1.06, np.pi / 2)
    linearity_curves(methods, modes, [0.1, 0.5, 1.0], 20, seed=2024)


def figure_3_half():
    """the same, 50 pixels across"""
    figure_3(50)


def figure_3_double():
    """the same, 200 pixels across"""
    figure_3(200)


def figure_4(n_iterations=25, n_screens=20):
    """Figure 4: a diameter, 20 screens, 25 iterations"""
    pupil, screens = screens_on(100, 0.5, n_screens)
    iteration_curves(pupil, np.pi / 2, n_iterations, [1.06, 2.0, 3.0], screens)


def figure_4_long():
    """Figure 4: a diameter, 4 screens, 400 iterations"""
    figure_4(400, 4)


def figure_9():
    """Figure 9: an input, 10 screens, 5 reconstructors"""
    bench = Bench(extent=2.0)
    model = BenchModel.from_images(bench, 1)
    bench_curves(bench, model, bench_reconstructors(bench, model, seed=1), [0.05, 0.5, 1.0], 10, seed=1)


def budget():
    """Error budget: an error, 3 inputs, 5 screens"""
    error_budget(Bench().single_errors(), ["PhaseShifted"], [0.0, 0.3, 0.8], 5, seed=1)


def maps():
    """Pairs of phase shifts: a pair, 3 screens, 64 pixels across"""
    pupil, screens = screens_on(64, 0.5, 3)
    pair_maps(pupil, 1.06, np.linspace(-np.pi, np.pi, 7).round(12), screens)


def measure(experiment, results):
    """Do the tasks of an experiment one by one, and tell the seconds of each and the most memory."""
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
    for experiment in (figure_3, figure_3_half, figure_3_double, figure_4, figure_4_long, figure_9, budget, maps):
        context = multiprocessing.get_context("spawn")
        results = context.Queue()
        process = context.Process(target=measure, args=(experiment, results))
        process.start()
        seconds, memory = results.get()
        process.join()
        spread = f"{min(seconds):.2g} to {max(seconds):.2g}"
        print(f"| {experiment.__doc__} | {np.mean(seconds):.2g} | {spread} | {memory:.0f} |", flush=True)


if __name__ == "__main__":
    main()
