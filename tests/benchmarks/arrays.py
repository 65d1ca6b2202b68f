"""Frames a second by library and device, one batch: python -m tests.benchmarks.arrays [frames].

Every library of the array API that is at hand is measured in the same run, beside NumPy; set OMP_NUM_THREADS=1 to
compare with one core.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from time import perf_counter

import numpy as np

from studies.kit.setups import screens_at
from zwfs import Dimple, PhaseShifted, Pupil, ZernikeSensor, reconstruction_error, zernike_basis

REPEATS = 3


def at_hand():
    """Libraries and devices that can be measured here: name, array of NumPy to array, and back."""
    yield "NumPy", np.asarray, np.asarray
    if find_spec("torch"):
        torch = import_module("torch")
        for device in ("cpu", "cuda")[: 1 + torch.cuda.is_available()]:
            yield (
                f"PyTorch, {device}",
                lambda array, device=device: torch.asarray(array, device=device),
                lambda array: array.cpu().numpy(),
            )
    if find_spec("cupy"):
        cupy = import_module("cupy")
        if cupy.is_available():
            yield "CuPy", cupy.asarray, cupy.asnumpy


def rates(n_frames, n_pixels=100):
    """Name, frames a second and median error of each library, at the settings for real time."""
    pupil = Pupil.circular(n_pixels)
    sensor = ZernikeSensor(pupil, Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))
    method = PhaseShifted(sensor, n_iterations=2, tolerance=0.0, accelerate=True)
    screens = screens_at(zernike_basis(pupil, 200), 0.8, 20, 2024, 7).astype(np.float32)
    frames = np.resize(sensor.measure(screens), (n_frames, sensor.n_masks, *pupil.shape))
    for name, there, back in at_hand():
        batch, shortest = there(frames), np.inf
        for _ in range(1 + REPEATS):  # constants are converted at the first call
            start = perf_counter()
            phase = method(batch).phase
            float(phase[-1, n_pixels // 2, n_pixels // 2])  # waits for the device
            shortest = min(shortest, perf_counter() - start)
        few = min(n_frames, len(screens))
        error = np.median(reconstruction_error(pupil, back(phase[:few]), screens[:few]))
        yield name, n_frames / shortest, float(error)


def main(n_frames=1000):
    print("| library | frames a second | NumPy = 1 | median error (rad) |")
    print("| --- | ---: | ---: | ---: |")
    own = None
    for name, rate, error in rates(n_frames):
        own = own or rate
        print(f"| {name} | {rate:.0f} | {rate / own:.3g} | {error:.2g} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
