"""Time of single frames in a process that runs for long: python -m tests.benchmarks.latency [frames] prints JSON.

Each frame pair goes from camera counts to the phase, by three iterations, and to the commands of 50 modes. The
process is warm and uses one core. Set OMP_NUM_THREADS=1, as `make bench` does, and keep the computer quiet: unlike
the other benchmarks this one takes the time of the clock, since a control loop waits for it.

A call is late if it takes more than 1.3 times the median. For the late calls the benchmark counts the causes that
the operating system and Python report: the scheduler took the core away, memory pages were mapped, the garbage
collector ran. The other late calls had the core for all of their time: an interrupt of the hardware or of the host
of a virtual machine, a change of the clock rate, or caches that another process has filled.

The roads from counts to 50 commands are compared in turns: a bare product, the controllers, and the linear method.
"""

import gc
import json
import resource
import sys
from time import perf_counter_ns, thread_time_ns

import numpy as np

from zwfs import Linear, zernike_basis

from .telemetry import POKE, camera

LATE = 1.3  # times the median
SETTINGS = {"poke": POKE, "gain": 0.5}


def latency(n_pixels, n_frames=10_000, *, frozen=True):
    """Percentiles of the time of a call, seconds, and the causes of late calls.

    `frozen` takes the garbage collector out of the loop.
    """
    calibration, frames, pokes = camera(n_pixels, 16, poked=50)
    step = calibration.controller(*pokes, **SETTINGS, method="phase-shifted", n_iterations=3)
    for index in range(min(n_frames, 500)):
        step(frames[index % len(frames)])
    collections = []

    def note(phase, info):
        if phase == "start":
            collections.append(info["generation"])

    measured = np.zeros((n_frames, 4), np.int64)  # clock, switches, pages, collections
    gc.collect()
    gc.callbacks.append(note)
    if frozen:
        gc.freeze()
        gc.disable()
    try:
        for index in range(n_frames):
            counts = frames[index % len(frames)]
            before, n_before = resource.getrusage(resource.RUSAGE_THREAD), len(collections)
            clock = perf_counter_ns()
            step(counts)
            clock = perf_counter_ns() - clock
            after = resource.getrusage(resource.RUSAGE_THREAD)
            measured[index] = (
                clock, after.ru_nivcsw - before.ru_nivcsw, after.ru_minflt - before.ru_minflt,
                len(collections) - n_before,
            )  # fmt: skip
    finally:
        gc.callbacks.remove(note)
        gc.enable()
        gc.unfreeze()
    return {"n_pixels": n_pixels, "n_frames": n_frames, "frozen": frozen} | _report(measured)


def controllers(n_pixels=100, n_frames=2000):
    """Time of the processor and of the clock, p50 and p99 in seconds, of each road from counts to 50 commands.

    The bare product takes the pixels of the controller out of the image, and multiplies them by a matrix.
    """
    calibration, frames, pokes = camera(n_pixels, 16, poked=50)
    product = calibration.controller(*pokes, **SETTINGS)
    iterated = calibration.controller(*pokes, **SETTINGS, method="phase-shifted", n_iterations=3)
    modes = zernike_basis(calibration.sensor.pupil, 50)
    linear, modal = Linear(calibration.sensor, modes), calibration.modal_matrix(modes).astype(np.float32)
    pixels, out = np.flatnonzero(product.mask), np.empty(50, np.float32)
    roads = {
        "bare product": lambda counts: product.matrix @ counts.take(pixels).astype(np.float32),
        "controller": lambda counts: product(counts, out=out),
        "three iterations": lambda counts: iterated(counts, out=out),
        "phase by Linear, then modes": lambda counts: calibration.coefficients(
            calibration(counts, judge=False, method=linear), modal
        ),
    }
    times = {name: np.zeros((n_frames, 2)) for name in roads}
    for index in range(-32, n_frames):
        counts = frames[index % len(frames)]
        for name, road in roads.items():
            for _ in range(2):  # the first call of a turn finds the caches of the other roads
                clock, processor = perf_counter_ns(), thread_time_ns()
                road(counts)
                elapsed = thread_time_ns() - processor, perf_counter_ns() - clock
            if index >= 0:
                times[name][index] = elapsed
    rows = []
    for name, measured in times.items():
        (p50, wall50), (p99, wall99) = np.percentile(measured * 1e-9, (50, 99), axis=0).tolist()
        rows.append({
            "road": name, "n_pixels": n_pixels, "processor p50": p50, "processor p99": p99, "clock p50": wall50,
            "clock p99": wall99,
        })  # fmt: skip
    return rows


def _report(measured):
    clock, switches, pages, collections = measured.T
    median, p99, p999 = np.percentile(clock, (50, 99, 99.9)) * 1e-9
    late = clock * 1e-9 > LATE * median
    reported = (switches > 0) | (pages > 0) | (collections > 0)
    return {
        "p50": float(median), "p99": float(p99), "p99.9": float(p999),
        "p99 / p50": float(p99 / median),
        "late": float(np.mean(late)),
        "late, core taken away": float(np.mean(late & (switches > 0))),
        "late, pages mapped": float(np.mean(late & (pages > 0))),
        "late, garbage collector": float(np.mean(late & (collections > 0))),
        "late, none of these": float(np.mean(late & ~reported)),
    }  # fmt: skip


def results(n_frames=10_000):
    """Rows for 40 and 100 pixels, and for 40 pixels with the garbage collector."""
    return [latency(40, n_frames), latency(40, n_frames, frozen=False), latency(100, n_frames)]


if __name__ == "__main__":
    number = list(map(int, sys.argv[1:2]))
    print(json.dumps({"controllers": controllers(100, *number), "latency": results(*number)}, indent=1))
