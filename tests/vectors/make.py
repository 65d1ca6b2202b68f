"""Write the test vectors next to this file, as FITS and NPZ: python -m tests.vectors.make.

A case is a pupil, a phase and one or more masks. Its frames come from the kernel of the mask, summed over every
pair of a pupil point and a detector pixel in double precision. Neither a Fourier transform nor the sensor model of
zwfs takes part. The page *Test vectors* of the book states the conventions.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits

from zwfs import Pupil, power_law_screens, zernike_basis

from ..reference import airy

FOLDER = Path(__file__).parent
STEP = 2.0**-16  # radian; phases are multiples, so that every machine and single precision hold the same ones


@dataclass(frozen=True)
class Mask:
    """Disc of the transmission amplitude * exp(i (phase + tilt * u)), 1 around it; u is horizontal."""

    diameter: float = 1.06  # lambda/D
    phase: float = np.pi / 2  # radian
    amplitude: float = 1.0
    tilt: float = 0.0  # radian per lambda/D

    def kernel(self, x, y):
        """Integral of (transmission - 1) * exp(2 pi i (u x + v y)) over the disc, x and y in D."""
        through = self.amplitude * np.exp(1j * self.phase) * airy(self.diameter, x + self.tilt / (2 * np.pi), y)
        return through - airy(self.diameter, x, y)


@dataclass(frozen=True)
class Case:
    """Input of a test vector."""

    name: str
    text: str
    pupil: Pupil
    phase: np.ndarray  # (ny, nx), radian; 0 outside the pupil
    masks: tuple[Mask, ...]
    margin: int = 0  # pixels by which the detector is wider than the pupil on each side

    def fields(self):
        """Field on the detector behind each mask, shape (n_masks, ny, nx)."""
        field, n_pixels = self.pupil.field(self.phase), self.pupil.n_pixels
        return np.stack([brute_force(field, n_pixels, mask, self.margin) for mask in self.masks])

    def arrays(self):
        """All that a file holds."""
        fields = self.fields()
        return {
            "frames": np.abs(fields) ** 2,
            "field": fields,
            "phase": self.phase,
            "amplitude": self.pupil.amplitude,
            "n_pixels": np.float64(self.pupil.n_pixels),
            "masks": np.array([astuple(mask) for mask in self.masks]),
            "description": np.str_(self.text),
        }


def brute_force(field, n_pixels, mask, margin=0):
    """Field on the detector: the field itself and its reference wave, one sum per pixel over all pupil points."""
    ny, nx = field.shape
    y, x = (np.arange(-(n + margin - 1), n + margin) / n_pixels for n in (ny, nx))
    kernel = mask.kernel(x, y[:, np.newaxis])
    # Row by row: kernel[a - b] for detector row a and pupil row b, and the same for columns.
    rows = np.arange(ny + 2 * margin)[:, np.newaxis] - np.arange(ny) + ny - 1
    columns = np.arange(nx + 2 * margin)[:, np.newaxis] - np.arange(nx) + nx - 1
    out = np.pad(field, margin)
    for a, row in enumerate(rows):
        out[a] += np.einsum("bcd,bd->c", kernel[row[:, np.newaxis, np.newaxis], columns], field) / n_pixels**2
    return out


def cases():
    """Every test vector."""
    half = np.pi / 2
    plus, pair = (Mask(),), (Mask(phase=half), Mask(phase=-half))
    disc, odd = Pupil.circular(32), Pupil.circular(33)
    vanes = Pupil.circular(40, 0.28, [(np.pi * angle / 180, 0.03) for angle in (20, 110, 200, 290)])
    hexagons = Pupil.hexagonal(40, n_rings=2, gap=0.02, missing=(11,))
    uneven = Pupil.from_amplitude(np.where(odd.inside, 1 + 0.6 * odd.x - 0.3 * odd.y[:, np.newaxis], 0), 33)
    dark = (0, 3), (5, 0)
    offset = Pupil(np.pad(disc.amplitude, dark), 32, np.pad(disc.segments, dark), (15.5, 20.5))
    shifts = tuple(Mask(1.06, theta) for theta in (0.3, 0.3 + 2 * np.pi / 3, 0.3 - 2 * np.pi / 3))
    wide, widest, dim, wedge = Mask(2.0), Mask(4.0, 0.7), Mask(amplitude=0.7), Mask(tilt=1.0)
    simple = [
        Case("circular_flat", "flat wavefront", disc, flat(disc), plus),
        Case("circular_tilt", "tilt of 0.3 lambda/D along +x", disc, tilt(disc, 0.3), pair),
    ]
    screens = [
        ("circular_small", "0.1 rad rms", disc, 0.1, plus),
        ("circular_large", "1.5 rad rms", disc, 1.5, plus),
        ("circular_pair_small", "0.1 rad rms, two masks", disc, 0.1, pair),
        ("circular_pair_large", "1.5 rad rms, two masks", disc, 1.5, pair),
        ("circular_three_shifts", "0.8 rad rms, three masks", disc, 0.8, shifts),
        ("circular_dimple_2", "0.5 rad rms, dimple of 2 lambda/D", disc, 0.5, (wide,)),
        ("circular_dimple_4", "0.5 rad rms, dimple of 4 lambda/D", disc, 0.5, (widest,)),
        ("circular_absorbing", "0.5 rad rms, the dimple dims the light", disc, 0.5, (dim,)),
        ("circular_wedge", "0.5 rad rms, the dimple is a wedge", disc, 0.5, (wedge,)),
        ("circular_wide", "0.8 rad rms, detector of 1.5 D", disc, 0.8, plus, 8),
        ("odd_small", "33 pixels across, 0.1 rad rms", odd, 0.1, plus),
        ("odd_pair_large", "33 pixels across, 1.5 rad rms, two masks", odd, 1.5, pair),
        ("spiders_small", "obstruction of 0.28 D and four vanes, 0.1 rad rms", vanes, 0.1, plus),
        ("spiders_pair_large", "the same, 1.5 rad rms, two masks", vanes, 1.5, pair),
        ("segmented_small", "18 segments with piston and tilt, 0.1 rad rms", hexagons, 0.1, plus),
        ("segmented_pair_large", "the same, 1.2 rad rms, two masks", hexagons, 1.2, pair),
        ("uneven_pair", "33 pixels, uneven amplitude, 0.8 rad rms, two masks", uneven, 0.8, pair),
        ("oblong_pair", "35 by 37 pixels, D off their centre, 0.8 rad rms", offset, 0.8, pair),
    ]
    random = []
    for seed, (name, text, pupil, rms, masks, *margin) in enumerate(screens, start=1):
        phase = (pistons if pupil is hexagons else screen)(pupil, rms, seed)
        random.append(Case(name, text, pupil, phase, masks, *margin))
    return simple + random


def rounded(pupil, phase):
    return np.where(pupil.inside, np.round(phase / STEP) * STEP, 0)


def flat(pupil):
    return np.zeros(pupil.shape)


def tilt(pupil, size):
    return rounded(pupil, 2 * np.pi * size * pupil.x + 0 * pupil.y[:, np.newaxis])


def screen(pupil, rms, seed):
    return rounded(pupil, power_law_screens(zernike_basis(pupil, 60, orthonormal=False), rms, 1, seed=seed)[0])


def pistons(pupil, rms, seed):
    """Piston and tilt of each segment."""
    draws = np.random.default_rng(seed).standard_normal((3, pupil.segments.max() + 1))[:, pupil.segments]
    phase = draws[0] + 2 * draws[1] * pupil.x + 2 * draws[2] * pupil.y[:, np.newaxis]
    return rounded(pupil, phase * rms / pupil.rms(phase))


def write(case, folder=FOLDER):
    """Write one case, as FITS and as NPZ."""
    arrays = case.arrays()
    np.savez_compressed(folder / f"{case.name}.npz", **arrays)
    header = fits.Header([("CASE", case.name), ("NPIXELS", case.pupil.n_pixels, "[pix] pupil diameter D")])
    for k, mask in enumerate(case.masks, start=1):
        header[f"DIAM{k}"] = mask.diameter, "[lambda/D] diameter of the dimple"
        header[f"PHASE{k}"] = mask.phase, "[rad] phase shift"
        header[f"AMPL{k}"] = mask.amplitude, "amplitude transmission"
        header[f"TILT{k}"] = mask.tilt, "[rad per lambda/D] slope of the phase shift"
    header["COMMENT"] = case.text
    maps = {"PHASE": "phase", "AMPLITUDE": "amplitude"}
    fits.HDUList(
        [
            fits.PrimaryHDU(arrays["frames"], header),
            *(fits.ImageHDU(arrays[key], name=name) for name, key in maps.items()),
            fits.ImageHDU(arrays["field"].real, name="FIELD_RE"),
            fits.ImageHDU(arrays["field"].imag, name="FIELD_IM"),
        ]
    ).writeto(folder / f"{case.name}.fits", overwrite=True)


if __name__ == "__main__":
    for case in cases():
        write(case)
