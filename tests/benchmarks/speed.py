"""How fast the reconstructors are, one thread: python -m tests.benchmarks.speed [seconds for each] prints JSON.

Set OMP_NUM_THREADS=1, as `make bench` does. Times are those that the thread spends on the processor: on an idle
machine what the clock shows, on a busy one hardly more.
"""

import json
import sys
from dataclasses import replace
from functools import partial
from itertools import cycle
from time import perf_counter, thread_time

import numpy as np

from studies.kit.setups import screens_at
from zwfs import (
    Arcsine,
    Dimple,
    GerchbergSaxton,
    GradientDescent,
    LearnedReference,
    Linear,
    MaximumLikelihood,
    PhaseShifted,
    Pupil,
    ZernikeSensor,
    reconstruction_error,
    zernike_basis,
)

from ..reference import HcipySensor
from . import latency, telemetry
from .convolution import ConvolutionalNetwork

DIMPLES = (Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))


def best(function, seconds):
    """Time of a call in good moments, in seconds."""
    return best_of_each({"": function}, seconds)[""]


def best_of_each(functions, seconds):
    """Time of a call of each in good moments, in seconds.

    They take turns, so that busy moments of a machine meet all. One call in twenty is quicker: the shortest of all
    would be a fault of the clock, which virtual machines now and then let stand still.
    """
    for function in functions.values():
        function()  # precisions are converted at the first call
    times, end = {name: [] for name in functions}, perf_counter() + seconds * len(functions)
    while perf_counter() < end or not all(times.values()):
        for name, function in functions.items():
            turn = perf_counter() + seconds / 10
            while perf_counter() < turn or not times[name]:
                start = thread_time()
                function()
                times[name].append(thread_time() - start)
    return {name: float(np.percentile(measured, 5)) for name, measured in times.items()}


def _reading(method, frames, name):
    """Call of a method that also reads one part of its result, which is computed when it is read."""
    return lambda: getattr(method(frames), name)


def real_time(n_pixels, dtype, seconds, rms=0.8):
    """Rates and errors of one frame pair at a time, 20 screens as those of Figure 3, by options."""
    pupil = Pupil.circular(n_pixels)
    sensor = ZernikeSensor(pupil, *DIMPLES)
    screens = screens_at(zernike_basis(pupil, 200), rms, 20, 2024, 7)
    rows, calls, frames = [], {}, sensor.measure(screens).astype(dtype)
    for accelerate, n in ((False, 4), (False, 5), (False, 6), (True, 2), (True, 3), (True, 4)):
        method = PhaseShifted(sensor, n_iterations=n, tolerance=0.0, accelerate=accelerate)
        error = reconstruction_error(pupil, method(frames).phase, screens)
        calls[len(rows)] = partial(method, frames[0])
        rows.append({
            "n_pixels": n_pixels, "dtype": dtype, "accelerate": accelerate, "n_iterations": n,
            "median error": float(np.median(error)), "largest error": float(error.max()),
        })  # fmt: skip
    for index, time in best_of_each(calls, seconds).items():
        rows[index] |= {"time": time, "rate": 1 / time}
    return rows


def closed_loop(n_pixels, seconds):
    """Rate and error when each estimate starts from the one before, while a screen turns into another one."""
    pupil = Pupil.circular(n_pixels)
    sensor = ZernikeSensor(pupil, *DIMPLES)
    first, last = screens_at(zernike_basis(pupil, 200), 0.8, 2, 2024, 7)
    method = PhaseShifted(sensor, n_iterations=1, tolerance=0.0)
    phase, errors = None, []
    for turn in np.linspace(0, np.pi / 2, 101):
        truth = np.cos(turn) * first + np.sin(turn) * last
        frames = sensor.measure(truth).astype(np.float32)
        phase = method(frames, phase).phase
        errors.append(float(reconstruction_error(pupil, phase, truth)))
    time = best(lambda: method(frames, phase), seconds)
    return {"n_pixels": n_pixels, "time": time, "rate": 1 / time, "median error": float(np.median(errors[10:]))}


def slope(seconds, sizes=(32, 64, 128, 256, 512, 1024)):
    """Time of 5 iterations and of a residual against the number of pixels across the pupil."""
    calls = {}
    for n_pixels in sizes:
        sensor = ZernikeSensor(Pupil.circular(n_pixels), *DIMPLES)
        method = PhaseShifted(sensor, n_iterations=5, tolerance=0.0)
        frames = sensor.measure(np.zeros(sensor.pupil.shape)).astype(np.float32)
        calls[n_pixels] = _reading(method, frames, "residual")
    return {"n_pixels": list(sizes), "times": list(best_of_each(calls, seconds).values())}


def others(seconds):
    """Time per screen of each method, 25 iterations, one screen at a time, residual included; seconds."""
    pupil = Pupil.circular(100)
    modes = zernike_basis(pupil, 200)
    classic, shifted, wide = (
        ZernikeSensor(pupil, *masks, extent=extent)
        for masks, extent in ((DIMPLES[:1], 1), (DIMPLES, 1), (DIMPLES, 2))
    )
    steps = {"n_iterations": 25, "tolerance": 0.0}
    methods = {
        "Linear": Linear(classic, modes),
        "Arcsine": Arcsine(classic, **steps),
        "PhaseShifted": PhaseShifted(shifted, **steps),
        "GerchbergSaxton, detector of 2 D": GerchbergSaxton(wide, **steps),
        "GradientDescent, 200 modes, one mask": GradientDescent(classic, modes, **steps),
        "GradientDescent, 200 modes, two masks": GradientDescent(shifted, modes, **steps),
    }
    screen = screens_at(modes, 0.3, 1, 2024, 2)[0]
    return best_of_each(
        {name: _reading(method, method.sensor.measure(screen), "residual") for name, method in methods.items()},
        seconds,
    )


def likelihood(seconds, n_pixels=100):
    """Time of maximum likelihood and its error bars at 0.8 rad rms, in propagations of HCIPy in the same run."""
    pupil = Pupil.circular(n_pixels)
    screen = screens_at(zernike_basis(pupil, 200), 0.8, 1, 2024, 7)[0]
    peer = HcipySensor(pupil, DIMPLES[0])
    incoming = peer.wavefront(pupil.amplitude * np.exp(1j * screen))
    calls = {"one propagation": lambda: peer.optics[0].forward(incoming)}
    for diameter in (1.06, 2.4):
        sensor = ZernikeSensor(pupil, *(replace(dimple, diameter=diameter) for dimple in DIMPLES))
        frames, method = sensor.measure(screen), MaximumLikelihood(sensor)
        calls[f"{diameter} lambda/D"] = partial(method, frames)
        calls[f"{diameter} lambda/D, with error bars"] = _reading(method, frames, "sigma")
    times = best_of_each(calls, seconds)
    return {name: time / times["one propagation"] for name, time in times.items()}


def looks(seconds, n_pixels=100, rms=0.8):
    """Time and error of roads from one frame pair to the phase, in single precision, in the same run as HCIPy.

    The bare products are those of one look: frames with polynomials, the layers of the network, and the wave.
    """
    pupil = Pupil.circular(n_pixels)
    sensor = ZernikeSensor(pupil, *DIMPLES)
    screens = screens_at(zernike_basis(pupil, 200), rms, 20, 2024, 7)
    peer, frames = HcipySensor(pupil, DIMPLES[0]), sensor.measure(screens).astype(np.float32)
    incoming = peer.wavefront(pupil.amplitude * np.exp(1j * screens[0]))
    settings = {"tolerance": 0.0, "accelerate": True}
    two, three = (PhaseShifted(sensor, n_iterations=n, **settings) for n in (2, 3))
    learned, convolutional = LearnedReference(sensor), ConvolutionalNetwork()
    look, out, turn = learned.look(), np.empty(pupil.shape, np.float32), cycle(frames)
    plane, weights = look._plane, learned.training.network.weights
    layers = [np.ones(len(weight), np.float32) for weight in weights]
    wave = np.ones((2, plane.rank), np.float32)

    def products():
        image = next(turn)
        plane.project(image)
        image.reshape(2, -1) @ look._signal.T
        for layer, weight in zip(layers, weights, strict=True):
            layer @ weight
        plane.expand(wave)

    name = f"convolutional network, {1e-6 * convolutional.n_weights:.1f} million weights"
    roads = {
        "one propagation of HCIPy": lambda: peer.optics[0].forward(incoming),
        "bare products": products,
        "one look": lambda: look(next(turn), out=out),
        "full call": lambda: learned(next(turn)),
        "2 iterations, accelerated": lambda: two(next(turn)),
        "3 iterations, accelerated": lambda: three(next(turn)),
        name: lambda: convolutional(next(turn)),
    }
    phases = {
        "one look": np.stack([look(frame) for frame in frames]), "full call": learned(frames).phase,
        "2 iterations, accelerated": two(frames).phase, "3 iterations, accelerated": three(frames).phase,
    }  # fmt: skip
    errors = {
        road: float(np.median(reconstruction_error(pupil, phase, screens))) for road, phase in phases.items()
    }
    return [
        {"road": road, "n_pixels": n_pixels, "time": time, "median error": errors.get(road)}
        for road, time in best_of_each(roads, seconds).items()
    ]


def results(seconds=2.0):
    """All of the above: numbers, lists and dictionaries only."""
    return {
        "real time": [
            row
            for n_pixels in (100, 40)
            for dtype in ("float32", "float64")
            for row in real_time(n_pixels, dtype, seconds)
        ],
        "closed loop": [closed_loop(n_pixels, seconds) for n_pixels in (100, 40)],
        "slope": slope(seconds),
        "others": others(seconds),
        "likelihood": likelihood(seconds),
        "looks": looks(seconds),
        "latency": latency.results(),
        "controllers": latency.controllers(),
        "telemetry": telemetry.telemetry(),
    }


if __name__ == "__main__":
    print(json.dumps(results(*map(float, sys.argv[1:2])), indent=1))
