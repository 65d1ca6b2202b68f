"""Largest error of each package at each test vector: python -m tests.vectors.packages rewrites agreement.csv.

A column is a package with its settings. A package is run as its documentation says, and once more with the repair
that the book describes where a convention of it does not agree with itself.
"""

import contextlib
import csv
import warnings
from functools import partial
from unittest import mock

import numpy as np

from zwfs import Dimple, Patch, Pupil, ZernikeSensor

from ..reference import HcipySensor, prysm_propagation
from .make import FOLDER, cases

AGREEMENT = FOLDER / "agreement.csv"
UNABLE = "not possible"


def own_mask(mask):
    """Mask of zwfs."""
    if mask.tilt:
        return Patch(mask.diameter, lambda u, _: mask.amplitude * np.exp(1j * (mask.phase + mask.tilt * u)))
    return Dimple(mask.diameter, mask.phase, mask.amplitude)


def squared(case):
    """Pupil and phase of a case on a square with the optical axis in its middle, and the place of the detector."""
    center = np.add(case.pupil.center, case.margin)
    last = np.add(case.pupil.shape, 2 * case.margin - 1)
    half = max(*center, *(last - center))
    before = np.rint(half - center).astype(int)
    after = np.rint(half - (last - center)).astype(int)
    widths = [(a + case.margin, b + case.margin) for a, b in zip(before, after, strict=True)]
    place = tuple(slice(a, a + n + 1) for a, n in zip(before, last, strict=True))
    pupil = Pupil(np.pad(case.pupil.amplitude, widths), case.pupil.n_pixels, np.pad(case.pupil.segments, widths),
                  (half, half))  # fmt: skip
    return pupil, np.pad(case.phase, widths), place


def by_zwfs(case, tolerance):
    extent = 1 + 2 * case.margin / case.pupil.n_pixels
    masks = map(own_mask, case.masks)
    return ZernikeSensor(case.pupil, *masks, extent=extent, tolerance=tolerance).measure(case.phase)


def by_hcipy(case, n_samples):
    if any(mask.tilt or mask.amplitude != 1 for mask in case.masks):
        return None  # its dot changes the phase only, everywhere by the same
    pupil, phase, place = squared(case)
    return HcipySensor(pupil, *case.masks, num_pix=n_samples).measure(phase)[(..., *place)]


def by_prysm(case, n_samples):
    pupil, phase, place = squared(case)
    field = pupil.field(phase)
    fields = [prysm_propagation(pupil.n_pixels, own_mask(mask), n_samples)(field) for mask in case.masks]
    return np.abs(fields)[(..., *place)] ** 2


def by_prysm_babinet(case, n_samples):
    """As documented: the field less the light that the mask changes, with a sample of each grid on the axis."""
    from prysm.propagation import Wavefront

    pupil, phase, place = squared(case)
    wavefront = Wavefront(pupil.field(phase), 1e-3, 1 / pupil.n_pixels)
    frames = []
    for mask in case.masks:
        u = (np.arange(n_samples + 2) - (n_samples + 2) // 2) * mask.diameter / n_samples
        u, v = u, u[:, np.newaxis]
        through = own_mask(mask).transmission(u + 0 * v, v + 0 * u)
        lost = np.where(np.hypot(u, v) <= mask.diameter / 2, 1 - through, 0)
        frames.append(wavefront.babinet(1000.0, None, lost, mask.diameter / n_samples).intensity.data)
    return np.stack(frames)[(..., *place)]


def by_pyzelda(case, repaired):
    from pyzelda import ztools
    from pyzelda.utils import mft

    if any(mask.tilt or mask.amplitude != 1 for mask in case.masks):
        return None
    pupil, phase, place = squared(case)
    wavelength, ratio, glass = 1e-6, 65.0, "fused_silica"
    scale = 2 * (pupil.n_pixels // 2) / pupil.n_pixels if repaired else 1  # it halves D without the remainder
    frames = []
    with contextlib.ExitStack() as repairs:
        if repaired:  # the forward transform is centred between four samples: so are the disc and the inverse now
            repairs.enter_context(mock.patch.object(ztools.mft, "imft", partial(mft.imft, cpix=False)))
            disc = partial(lambda make, *a, **k: make(*a, **k | {"cpix": False}), ztools.aperture.disc)
            repairs.enter_context(mock.patch.object(ztools.aperture, "disc", disc))
        for mask in case.masks:
            diameter = mask.diameter * scale * ratio * wavelength
            depth = mask.phase / (2 * np.pi) * wavelength / (ztools.refractive_index(wavelength, glass) - 1)
            opd = phase * wavelength / (2 * np.pi)
            frame = ztools.propagate_opd_map(
                opd, diameter, depth, glass, ratio, pupil.n_pixels, pupil.amplitude, wavelength
            )
            frames.append(frame)
    return np.stack(frames)[(..., *place)]


PACKAGES = {
    "zwfs": partial(by_zwfs, tolerance=1e-10),
    "zwfs, tolerance 1e-14": partial(by_zwfs, tolerance=1e-14),
    "HCIPy": partial(by_hcipy, n_samples=128),
    "HCIPy, 1024 samples": partial(by_hcipy, n_samples=1024),
    "prysm, 128 samples": partial(by_prysm, n_samples=128),
    "prysm, 1024 samples": partial(by_prysm, n_samples=1024),
    "prysm, babinet": partial(by_prysm_babinet, n_samples=1024),
    "pyZELDA": partial(by_pyzelda, repaired=False),
    "pyZELDA, repaired": partial(by_pyzelda, repaired=True),
}


def error(name, case):
    """Largest difference of a frame from the vector, None where the package has no such mask."""
    with np.load(FOLDER / f"{case.name}.npz") as stored, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frames = PACKAGES[name](case)
        return None if frames is None else float(np.abs(frames - stored["frames"]).max())


def main():
    with AGREEMENT.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["case", *PACKAGES])
        for case in cases():
            errors = (error(name, case) for name in PACKAGES)
            table.writerow([case.name, *(UNABLE if value is None else f"{value:.1e}" for value in errors)])


if __name__ == "__main__":
    main()
