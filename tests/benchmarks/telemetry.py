"""Reconstruction of a long cube: python -m tests.benchmarks.telemetry [frame pairs] [threads] prints JSON.

Simulated frame pairs of a hexagonal pupil of 90 pixels, 16-bit FITS, photon noise. The phase goes to a FITS file
in the folder for temporary files. Set OMP_NUM_THREADS=1, as `make bench` does.
"""

import json
import resource
import sys
import tempfile
from pathlib import Path
from time import perf_counter, process_time, thread_time

import numpy as np

from studies.kit.setups import screens_at
from zwfs import Dimple, Pupil, ZernikeSensor, zernike_basis
from zwfs.frames import Calibration, reconstruct
from zwfs.frames._fits import fits_module
from zwfs.frames.pipeline import Optics, reduce_frames
from zwfs.frames.registration import Image, register_frames

PHOTONS, MARGIN, DARK = 1e4, 12, 500
POKE = 0.1  # rad
DIMPLES = (Dimple(1.06, np.pi / 2), Dimple(1.06, -np.pi / 2))
_DISTINCT = 64  # frame pairs, which a cube repeats


def camera(n_pixels, n_frames, rms=0.5, poked=1):
    """Calibration of a simulated bench, and camera images of screens, 16 bit, both pupils on one image.

    The third result is the images of the flat mirror, and of so many modes pushed and pulled by `POKE`.
    """
    pupil = Pupil.hexagonal(n_pixels, 3, 0.03, (21,), 0.8)
    sensor = ZernikeSensor(pupil, *DIMPLES, extent=1 + 2 * MARGIN / n_pixels)
    screens = screens_at(zernike_basis(Pupil.circular(n_pixels), 200), rms, n_frames, 2024, 7)
    rng = np.random.default_rng(1)

    def exposed(frames):
        image = np.concatenate(list(np.moveaxis(frames, -3, 0)), axis=-1)
        return np.rint(rng.poisson(image * PHOTONS) + DARK).astype(np.uint16)

    def image(counts):
        return Image(counts - float(DARK), np.zeros(counts.shape, bool), dark=float(DARK))

    flat = exposed(sensor.measure(np.zeros(pupil.shape)))
    clear = exposed(np.stack([np.pad(pupil.amplitude**2, MARGIN)] * 2))
    registered = register_frames([image(flat)], [image(clear)])
    calibration = Calibration.of(reduce_frames(registered, Optics()), saturation=65535)
    images, steps = exposed(sensor.measure(screens)), POKE * zernike_basis(pupil, poked)
    return calibration, images, (flat, exposed(sensor.measure(steps)), exposed(sensor.measure(-steps)))


def write_cube(path, frames, n):
    """Write a FITS cube of n frames, which repeat those given, without keeping it in memory."""
    fits = fits_module()
    header = fits.PrimaryHDU(frames[:1]).header
    header["NAXIS3"] = n
    stream = fits.StreamingHDU(path, header)
    for first in range(0, n, len(frames)):
        stream.write((frames[: n - first].astype(np.int32) - 32768).astype(np.int16))
    stream.close()


def parts(calibration, frames):
    """Processor time of each part of a frame pair, one thread, seconds."""
    work, k = calibration._work, 8
    calibration(frames[:k])

    def best(function):
        times = []
        for first in range(0, len(frames), k):
            begin = thread_time()
            function(frames[first : first + k])
            times.append((thread_time() - begin) / k)
        return float(np.percentile(times, 20))

    def on_grid(some):
        work.on_grid(some[:, np.newaxis], 65535, calibration.good)

    found = calibration(frames[:k])
    modes = zernike_basis(calibration.sensor.pupil, 50)
    whole = best(calibration)
    unjudged = best(lambda some: calibration(some, judge=False))
    grid = best(on_grid)
    return {
        "resampling": grid, "iteration": unjudged - grid, "residual": whole - unjudged, "whole": whole,
        "sigma": best(lambda _: calibration.sigma(found, PHOTONS)),
        "sigma of 50 modes": best(lambda _: calibration.sigma(found, PHOTONS, modes=modes)),
    }  # fmt: skip


def telemetry(n=10_000, n_workers=2, n_pixels=90):
    """Times of a cube: by the clock, of the processor, of its parts for each frame pair; and memory, bytes."""
    calibration, frames, _ = camera(n_pixels, _DISTINCT)
    with tempfile.TemporaryDirectory() as folder:
        cube, output = Path(folder, "cube.fits"), Path(folder, "phase.fits")
        write_cube(cube, frames, n)
        calibration(frames[:1])
        before, clock, busy = _peak(), perf_counter(), process_time()
        found = reconstruct(cube, calibration, output, n_workers=n_workers)
        clock, busy = perf_counter() - clock, process_time() - busy
        assert found.n_flagged == 0
        return {
            "frames": n, "threads": n_workers, "n_pixels": n_pixels, "time": clock, "processor time": busy,
            "memory": _peak() - before, "output": output.stat().st_size,
            "parts": parts(calibration, frames),
        }  # fmt: skip


def _peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    print(json.dumps(telemetry(*map(int, sys.argv[1:3])), indent=1))
