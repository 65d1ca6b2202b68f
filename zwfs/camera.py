"""Camera files: read frames from FITS or NPY, write the phase as FITS, and let the simulated bench write frames.

The only module that needs astropy, and only for FITS: `pip install zwfs[frames]`.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zwfs import _check
from zwfs.bench import Bench, Seed, segment_pistons, segment_residual
from zwfs.frames import Found
from zwfs.registration import Image, Recording, nearest_good
from zwfs.results import write_file

_PLATEAU = 10  # pixels that share exactly the largest value: noise does not do that, saturation does
_FULL = 50_000  # counts of the brightest pixel of a simulated 16-bit camera


@dataclass(frozen=True, eq=False)
class CameraFile:
    """What one file holds.

    Attributes
    ----------
    images : ndarray of float64, shape (n, ny, nx)
    name : str
        Of the file, without its folder.
    sha256 : str
        Of its bytes.
    header : dict
        Of a FITS file; empty for NPY.
    full_scale : float
        Largest value that the type of the file's numbers can hold; infinity for floats.
    """

    images: NDArray[np.float64]
    name: str
    sha256: str
    header: Mapping[str, Any] = field(default_factory=dict)
    full_scale: float = np.inf

    def keyword(self, key: str) -> float:
        """Number under a keyword of the header.

        Raises
        ------
        ValueError
            If the header lacks the keyword, or it is no number.
        """
        if key not in self.header:
            raise ValueError(f"{self.name}: its header has no {key}: give the value as a parameter")
        return _check.number(f"{self.name}: {key}", self.header[key])


def read(path: str | Path) -> CameraFile:
    """Read a FITS or NPY file, told apart by their first bytes.

    Integers, big-endian numbers, BZERO and BSCALE all become float64. Of a FITS file the first image is taken.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    CameraFile

    Raises
    ------
    FileNotFoundError
    ImportError
        If astropy is needed and missing.
    TypeError, ValueError
        If the file is of another kind, broken, holds no image, or one that is complex or not (ny, nx), (1, ny, nx)
        or (2, ny, nx).
    """
    path = Path(path)
    if not path.is_file():
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise FileNotFoundError(f"{path}: no such file{where}")
    content = stored = path.read_bytes()
    if content.startswith(b"\x1f\x8b"):
        try:
            content = gzip.decompress(content)
        except (OSError, EOFError, zlib.error) as error:
            raise ValueError(f"{path.name}: a broken gzip file: {error}") from None
    if content.startswith(b"\x93NUMPY"):
        data, header = _read_npy(content, path.name), {}
    elif content.startswith(b"SIMPLE  ="):
        data, header = _read_fits(content, path.name)
    else:
        raise ValueError(f"{path.name}: its first bytes are those of neither a FITS nor an NPY file")
    if data.dtype.kind not in "biuf":
        raise TypeError(f"{path.name}: its numbers are {data.dtype}: expected real ones")
    if data.ndim not in (2, 3) or data.size == 0 or (data.ndim == 3 and data.shape[0] > 2):
        raise ValueError(
            f"{path.name}: its shape is {data.shape}: expected (ny, nx), or (2, ny, nx) for two images"
        )
    full_scale = float(np.iinfo(data.dtype).max) if data.dtype.kind in "iu" else np.inf
    images = data.astype(np.float64).reshape(-1, *data.shape[-2:])
    return CameraFile(images, path.name, hashlib.sha256(stored).hexdigest(), header, full_scale)


def images(
    files: Sequence[CameraFile],
    darks: Sequence[CameraFile] = (),
    bad_pixels: Sequence[CameraFile] = (),
    saturation: float | None = None,
) -> tuple[Image, ...]:
    """One or two images from files, less the dark, with their bad pixels.

    Bad are pixels that are NaN or infinite, not 0 in the bad-pixel map, or saturated. Without a level, a pixel is
    saturated at SATURATE of the header, at the largest number that an integer type can hold, or where ten or more
    pixels share exactly the largest value.

    Parameters
    ----------
    files : sequence of one or two CameraFiles
    darks, bad_pixels : sequence of CameraFiles
        As many images as `files` hold, one for all of them, or none.
    saturation : float, counts, optional

    Returns
    -------
    tuple of Image

    Raises
    ------
    ValueError
        If the number of images or a shape is wrong, or every pixel of an image is bad.
    """
    if saturation is not None:
        saturation = _check.number("saturation", saturation, 0, open_low=True)
    found = [(file, counts) for file in files for counts in file.images]
    if len(found) not in (1, 2):
        names = ", ".join(file.name for file in files) or "no file"
        raise ValueError(f"{names}: {len(found)} images: expected one or two")
    result = []
    for index, (file, counts) in enumerate(found):
        dark = _companion("dark", darks, index, len(found), counts, file.name)
        marked = _companion("bad-pixel map", bad_pixels, index, len(found), counts, file.name)
        bad = ~np.isfinite(counts)
        level = saturation or _saturation(file, counts[~bad])
        bad |= np.where(bad, 0, counts) >= level
        if dark is not None:
            bad |= ~np.isfinite(dark)
            counts = counts - dark
        if marked is not None:
            bad |= marked != 0
        if bad.all():
            raise ValueError(f"{file.name}: all pixels are bad or saturated (level {level:g}): expected an image")
        name = file.name if len(file.images) == 1 else f"{file.name}[{index}]"
        result.append(Image(nearest_good(counts, ~bad), bad, name))
    return tuple(result)


def write_phase(
    path: str | Path,
    found: Found,
    recording: Recording,
    wavelength: float,
    sources: Sequence[CameraFile] = (),
) -> None:
    """Write a phase map as FITS: in radian, in nm as an extension, and the masked points as another.

    The header says what the map was made from and how well the frames are explained. It holds no date but DATE-OBS
    of the first source, so that the same input gives the same bytes.

    Parameters
    ----------
    path : str or Path
        Replaced if it is there.
    found : Found
    recording : Recording
    wavelength : float, nm
    sources : sequence of CameraFiles
        Their names and checksums go into the header.

    Raises
    ------
    ImportError
        If astropy is missing.
    ValueError
        If the wavelength is not above 0.
    """
    from zwfs import __version__

    fits = _fits()
    wavelength = _check.number("wavelength", wavelength, 0, open_low=True)
    measurement, optics = found.measurement, found.optics
    cards = [
        ("BUNIT", "rad", "in (-pi, pi]; NaN outside and where masked"),
        ("WAVELEN", wavelength, "[nm] wavelength"),
        ("PUPDIAM", measurement.diameter, "[pixel] diameter D of the pupil"),
        ("PIXSCALE", 1 / measurement.diameter, "[D] width of a pixel"),
        ("CENTROW", measurement.pupil.center[0], "[pixel] centre of the pupil, from 0"),
        ("CENTCOL", measurement.pupil.center[1], "[pixel] centre of the pupil, from 0"),
        ("DIMPLE", optics.diameter, "[lambda/D] diameter of the dimple"),
        *((f"THETA{i}", value, f"[rad] phase shift, image {i}") for i, value in enumerate(optics.phase_shifts, 1)),
        ("BACKGRND", optics.background, "background of the frames, 1 = mean of pupil"),
        ("PUPBACK", optics.pupil_background, "the same of the mask-out images"),
        ("SCALE", optics.scale, "factor on the frames"),
        ("LEAKAGE", optics.leakage, "fraction of the other image's light"),
        ("UNMASKED", optics.unmasked, "fraction of light the mask leaves as it is"),
        ("FLUXMASK", measurement.flux_ratio[0], "light of image 1 over image 2, mask in"),
        ("FLUXOUT", measurement.flux_ratio[1], "the same, mask out"),
        *((f"CORR{i}", value, "measured with modelled frame") for i, value in enumerate(found.correlation, 1)),
        *((f"RESID{i}", value, "rms difference of them") for i, value in enumerate(found.residual, 1)),
        ("NPOINTS", measurement.pupil.n_points, "points of the pupil"),
        ("NMASKED", measurement.n_masked, "of these, points that are masked"),
        ("CONVERGE", found.converged, "the iteration converged"),
    ]
    for index, (image, origin) in enumerate(zip(recording.images, recording.origins, strict=True), 1):
        cards += [
            (f"IMAGE{index}", image.name, "frames, then mask-out images"),
            (f"ROW{index}", origin[0], "[pixel] place of mask-out image 1 on it"),
            (f"COL{index}", origin[1], "[pixel]"),
        ]
    for index, source in enumerate(sources, 1):
        cards += [(f"FILE{index}", source.name, ""), (f"SHA{index}", source.sha256, "")]
    if sources and "DATE-OBS" in sources[0].header:
        cards.append(("DATE-OBS", str(sources[0].header["DATE-OBS"]), f"of {sources[0].name}"))
    cards.append(("CREATOR", f"zwfs {__version__}", ""))
    primary = fits.PrimaryHDU(found.phase)
    for key, value, comment in cards:
        primary.header[key] = (_rounded(value), comment) if comment else value
    nanometres = fits.ImageHDU(found.phase * wavelength / (2 * np.pi), name="PHASE_NM")
    nanometres.header["BUNIT"] = "nm"
    masked = fits.ImageHDU((measurement.pupil.mask & ~measurement.good).astype(np.uint8), name="MASKED")
    write_file(Path(path), _fits_bytes(fits.HDUList([primary, nanometres, masked])))


def write_bench(
    folder: str | Path,
    bench: Bench,
    pistons: ArrayLike | Mapping[int, float] | None = None,
    *,
    wavelength: float = 635.0,
    n_bad: int = 0,
    seed: Seed = None,
) -> dict[str, Path]:
    """Let the simulated bench write what a camera would: 16-bit FITS files with both pupils on one image.

    Parameters
    ----------
    folder : str or Path
        It must be there.
    bench : Bench
        With photons.
    pistons : as for `Bench.commanded_phase`, optional
        Flat if left out.
    wavelength : float, nm
        For the headers.
    n_bad : int
        Bad pixels of the camera: half of them dark and named by the bad-pixel map, half of them saturated.
    seed : int, Generator or SeedSequence, optional
        Of the noise and of the bad pixels.

    Returns
    -------
    dict of Path
        "frame", "pupils", "dark" and "bad_pixels".

    Raises
    ------
    ImportError
        If astropy is missing.
    """
    fits = _fits()
    n_bad = _check.integer("n_bad", n_bad, 0)
    rng = np.random.default_rng(seed)
    counts = {"frame": bench.frames(pistons, rng), "pupils": bench.pupil_images(rng), "dark": bench.dark(rng)}
    gain = _FULL / max(pair.max() for pair in counts.values())
    shape = np.hstack(counts["frame"]).shape
    places = rng.choice(shape[0] * shape[1], n_bad, replace=False)
    dead = np.zeros(shape, np.uint8)
    dead.flat[places[: n_bad // 2]] = 1
    paths = {}
    for name, pair in counts.items():
        image = np.clip(np.rint(np.hstack(pair) * gain), 0, 65535).astype(np.uint16)
        image[dead > 0] = 0
        image.flat[places[n_bad // 2 :]] = 65535
        hdu = fits.PrimaryHDU(image)
        hdu.header["BUNIT"] = "adu"
        hdu.header["WAVELEN"] = (wavelength, "[nm] wavelength")
        hdu.header["DIMPLE"] = (bench.diameter, "[lambda/D] diameter of the dimple by design")
        hdu.header["THETA1"] = (_rounded(bench.phase), "[rad] phase shift of the left image")
        hdu.header["THETA2"] = (_rounded(-bench.phase), "[rad] phase shift of the right image")
        hdu.header["SATURATE"] = (65535, "[adu] pixels that reach it are saturated")
        hdu.header["ORIGIN"] = ("zwfs", "simulated bench")
        paths[name] = Path(folder) / f"{name}.fits"
        write_file(paths[name], _fits_bytes(fits.HDUList([hdu])))
    paths["bad_pixels"] = Path(folder) / "bad_pixels.fits"
    write_file(paths["bad_pixels"], _fits_bytes(fits.HDUList([fits.PrimaryHDU(dead)])))
    return paths


def bench_error(bench: Bench, commanded: ArrayLike, recording: Recording, found: Found) -> float:
    """Rms error of the segment pistons in a phase found from frames that `write_bench` wrote, radian.

    Parameters
    ----------
    bench : Bench
    commanded : array_like, shape (n_segments,), radian
    recording : Recording
    found : Found
    """
    canvas = np.full(recording.pupil_images[0].counts.shape, np.nan)
    row, column = recording.corner
    canvas[row : row + recording.n_pixels, column : column + recording.n_pixels] = found.phase
    # The pupil stands in the middle of the left half of the image.
    (ny, nx), height = bench.segments.shape, canvas.shape[0]
    top = (height - ny) // 2
    pistons = segment_pistons(canvas[top : top + ny, top : top + nx], bench.segments, bench.numbers)
    return float(segment_residual(pistons, commanded).std())


def _fits() -> ModuleType:
    try:
        from astropy.io import fits
    except ImportError:
        raise ImportError("FITS files need astropy: pip install zwfs[frames]; NPY files do not") from None
    return fits


def _read_npy(content: bytes, name: str) -> NDArray:
    try:
        return np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{name}: a broken NPY file: {error}") from None


def _read_fits(content: bytes, name: str) -> tuple[NDArray, dict[str, Any]]:
    fits = _fits()
    try:
        with warnings.catch_warnings():
            # Odd header cards are no reason to refuse a file; missing pixels are.
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message=".*truncated.*")
            with fits.open(io.BytesIO(content), memmap=False) as units:
                for unit in units:
                    if unit.is_image and unit.data is not None:
                        data = np.array(unit.data)
                        return data, dict(units[0].header) | dict(unit.header)
    except (OSError, ValueError, TypeError, Warning) as error:
        raise ValueError(f"{name}: a broken FITS file: {error}") from None
    raise ValueError(f"{name}: a FITS file without an image")


def _companion(
    what: str, files: Sequence[CameraFile], index: int, n_images: int, counts: NDArray, name: str
) -> NDArray | None:
    """Dark or bad-pixel map of image number `index`, checked; None if there is none."""
    maps = [image for file in files for image in file.images]
    if not maps:
        return None
    if len(maps) not in (1, n_images):
        raise ValueError(f"{what}: {len(maps)} images for the {n_images} of {name}: expected one, or one for each")
    chosen = maps[0] if len(maps) == 1 else maps[index]
    if chosen.shape != counts.shape:
        raise ValueError(f"{what}: its shape is {chosen.shape}: expected {counts.shape}, that of {name}")
    return chosen


def _saturation(file: CameraFile, counts: NDArray) -> float:
    """Level at which pixels are saturated, as far as a file tells."""
    if "SATURATE" in file.header:
        return file.keyword("SATURATE")
    top = counts.max(initial=-np.inf)
    plateau = np.count_nonzero(counts == top) >= _PLATEAU and top > counts.min(initial=np.inf)
    return min(file.full_scale, top if plateau else np.inf)


def _rounded(value: Any) -> Any:
    """Floats to nine digits: headers do not show rounding errors. FITS has no NaN."""
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}") if np.isfinite(value) else "NaN"
    return bool(value) if isinstance(value, np.bool_) else value


def _fits_bytes(units: Any) -> bytes:
    stream = io.BytesIO()
    units.writeto(stream)
    return stream.getvalue()
