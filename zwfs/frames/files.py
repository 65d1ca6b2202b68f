"""Camera files: read frames from FITS or NPY, write the phase as FITS.

FITS files need astropy: `pip install astropy`.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._system import is_there, path_of, paths_of, write_file
from zwfs.frames._blocks import MOST_BYTES, FileError, Images, file_and_unit
from zwfs.frames._fits import fits_content, fits_module, has_card
from zwfs.frames._part import Cards, scratch_of
from zwfs.frames._stack import segments_of
from zwfs.frames.phases import Phases
from zwfs.frames.pipeline import Optics
from zwfs.frames.registration import Image
from zwfs.units import phase_to_opd

__all__ = ["CameraFile", "check_output", "read", "read_all", "write_phase"]

_PLATEAU = 10  # pixels that share exactly the largest value: noise does not do that, saturation does
_PIECE = 2**22  # pixels of exposures that are read at once
_POSITIVE = ("DIMPLE", "EGAIN", "SATURATE")  # keywords whose value is above 0
SHORTEST = 10.0  # nm: a smaller WAVELEN is in another unit
# Keywords of the exposure time, and of the window on the detector: its ends, or where its rows and columns begin.
_TIMES = "EXPTIME", "EXPOSURE", "ITIME", "TINT", "ESO DET DIT", "ESO DET SEQ1 DIT"
_ENDS = "DETSEC", "CCDSEC", "SUBRECT"
_STARTS = (("YORGSUBF", "XORGSUBF"), ("YSTART", "XSTART"), ("ESO DET WIN1 STRY", "ESO DET WIN1 STRX"),
           ("ESO DET WIN STARTY", "ESO DET WIN STARTX"))  # fmt: skip
_WINDOWS = *_ENDS, *sum(_STARTS, ())
_PER_SECOND = "/s", "/sec", "s-1", "s^-1", "s**-1"  # ends of units
_SAME = 0.01  # relative difference up to which exposure times count as equal
_ALIKE = 5.0  # median absolute deviations by which two darks may differ
# Header card of a phase map: no other file is replaced.
_PHASE_CARD = b"CREATOR = 'zwfs "
_LONGEST = 240  # bytes of a file name; a partial file has a few more, and most file systems allow 255


@dataclass(frozen=True, eq=False)
class CameraFile:
    """Images and header of a file.

    Attributes
    ----------
    images : ndarray of float64, shape (n, ny, nx)
        NaN where a pixel is no number, or saturated in one of several exposures.
    name : str
        Of the file, without its folder.
    sha256 : str
        Of its bytes.
    header : dict
        Of a FITS file; empty for NPY.
    path : Path, optional
        Of the file, absolute. `write_phase` never replaces it.
    n_exposures : int
        Exposures of which the images are the mean.
    """

    images: NDArray[np.float64]
    name: str
    sha256: str
    header: Mapping[str, Any] = field(default_factory=dict)
    path: Path | None = None
    n_exposures: int = 1

    def __post_init__(self) -> None:
        images = _check.real_array("images", self.images)
        if images.ndim != 3 or not images.size:
            raise ValueError(f"images has shape {images.shape}: expected (n, ny, nx)")
        for name in ("name", "sha256"):
            _check.instance(name, getattr(self, name), str)
        _check.instance("header", self.header, Mapping)
        _check.integer("n_exposures", self.n_exposures, 1)
        if self.path is not None:
            _check.instance("path", self.path, Path)

    def keyword(self, key: str) -> float:
        """Number under a keyword of the header.

        Raises
        ------
        ValueError
            If the header lacks the keyword, or its value is not a number that the keyword can have: DIMPLE, EGAIN
            and SATURATE are above 0, and WAVELEN is above 10 nm.
        """
        _check.instance("key", key, str)
        if key not in self.header:
            name = _check.shown(key)[1:-1]
            raise ValueError(f"{self.name}: its header has no {name} (key): give the value as a parameter")
        low = SHORTEST if key == "WAVELEN" else 0 if key in _POSITIVE else -np.inf
        unit = " (nm)" * (key == "WAVELEN")
        return _check.number(f"{self.name}: {key}{unit}", self.header[key], low, open_low=True)

    def optics(self, diameter: float = 0.0, phase_shifts: Sequence[float] = ()) -> Optics:
        """Optics with these values, see `Optics`; by default DIMPLE, THETA1 and any THETA2 of the header."""
        diameter = _check.number("diameter", diameter, 0)
        _check.sequence("phase_shifts", phase_shifts, expected="a list of one or two numbers")
        keys = ("THETA1", "THETA2") if "THETA2" in self.header else ("THETA1",)
        shifts: Any = phase_shifts or [self.keyword(key) for key in keys]
        return Optics(diameter or self.keyword("DIMPLE"), tuple(shifts))


def read(path: str | Path, *, max_bytes: int = MOST_BYTES, max_images: int = 2) -> CameraFile:
    """Read all images of a FITS or NPY file, plain or packed with gzip; the first bytes decide which.

    FITS images may be compressed. Brackets behind the name choose a unit of a FITS file by number or name, such as
    ``frame.fits[1]`` or ``frame.fits[DARK]``. Without them, units whose names say that they are no frames (DARK,
    MASK, ...) are left out, and images in two units of one shape are read as an array of two images. All numbers
    become float64. Header cards that do not follow the standard are left out.

    Parameters
    ----------
    path : str or Path
    max_bytes : int
        Largest size of the file, also when it is unpacked, and of its images as float64. A larger file is refused
        before its images are in memory.
    max_images : int
        Largest number of images.

    Raises
    ------
    FileNotFoundError
    ImportError
        If astropy is needed and missing.
    FileError
        A ValueError: if the file is of another kind, broken, too large, or holds no image, too many of them,
        units that do not belong together, or numbers that are not real.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from zwfs.frames.files import read
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(f"{folder}/frame.npy", np.eye(16))
    ...     file = read(f"{folder}/frame.npy")
    ...
    >>> file.name, file.images.shape
    ('frame.npy', (1, 16, 16))
    """
    path = path_of("path", path)
    max_bytes, max_images = _check.integer("max_bytes", max_bytes, 1), _check.integer("max_images", max_images, 1)
    file, _ = file_and_unit(path)
    if file.is_file() and file.stat().st_size > max_bytes:
        raise FileError(f"{file.name}: it is larger than {max_bytes} bytes: expected at most max_bytes")
    segments = segments_of(path, verify=True, max_bytes=max_bytes)
    first, n = segments[0].arrays[0], sum(segment.n * segment.n_images for segment in segments)
    shape = n, *first.full[-2:]
    if n > max_images:
        raise FileError(f"{file.name}: its shape is {first.full}: expected (ny, nx), or up to {max_images} images")
    if (n_bytes := 8 * math.prod(shape)) > max_bytes:
        expected = f"at most max_bytes = {max_bytes}"
        raise FileError(f"{file.name}: its shape is {first.full}, {n_bytes} bytes as float64: expected {expected}")
    images = np.concatenate([segment.read(0, segment.n).reshape(-1, *shape[1:]) for segment in segments])
    return _camera_file(first, images.astype(np.float64))


def read_all(
    frame_files: Sequence[str | Path],
    pupil_files: Sequence[str | Path],
    dark_files: Sequence[str | Path] = (),
    bad_pixel_files: Sequence[str | Path] = (),
    saturation: float | None = None,
    *,
    pupil_dark_files: Sequence[str | Path] = (),
    n_images: int | None = None,
) -> tuple[tuple[Image, ...], tuple[Image, ...], list[CameraFile]]:
    """Read all files of a measurement: frames and clear frames, and optional darks and maps of bad pixels.

    Exposures are averaged. A file holds one (ny, nx), n of one image each (n, ny, nx), or n of two images
    (n, 2, ny, nx). Two units of a FITS file are the two images of an exposure, and so are two files. Three files
    or more are exposures. An array (2, ny, nx) holds two exposures; for the two images of one, set ``n_images=2``.

    A dark or a map belongs to the frames of its shape. If headers state windows on the detector (DETSEC, CCDSEC,
    SUBRECT, XORGSUBF, ...), it also belongs to the frames whose window it contains. Of several darks, a frame gets
    those with the same window and exposure time (EXPTIME, EXPOSURE, ...).

    Bad are pixels that are NaN, infinite or beyond 1e38, are not 0 in a map, or are saturated in one exposure.

    Parameters
    ----------
    frame_files, pupil_files : sequence of paths
        Frames, and clear frames.
    dark_files, bad_pixel_files : sequence of paths, optional
        Counts without light, and maps that are not 0 where a pixel is bad: for all images, or one for each.
    saturation : float, counts, optional
        Level from which on a pixel is saturated. By default it is SATURATE of the header, the largest number that
        an integer type can hold, or the largest value if ten or more pixels share exactly this value.
    pupil_dark_files : sequence of paths, optional
        Darks of the clear frames; `dark_files` are those of the frames then.
    n_images : int, optional
        Images of an exposure: 1, with both pupils on it, or 2. By default as above.

    Returns
    -------
    frames, clear_frames : tuple of Image
    sources : list of CameraFile
        All files, with the mean of their exposures; the first is that of the first frame.

    Raises
    ------
    FileNotFoundError, ImportError, FileError, ValueError
        As for `read`; if the number of images is wrong, a dark or map has the shape of no frame, every pixel of an
        image or of its dark is bad, or a map marks more than half of the pixels.
    """
    names = "frame_files", "pupil_files", "dark_files", "bad_pixel_files", "pupil_dark_files"
    lists = frame_files, pupil_files, dark_files, bad_pixel_files, pupil_dark_files
    kinds = [paths_of(name, paths) for name, paths in zip(names, lists, strict=True)]
    for name, paths in zip(names[:2], kinds, strict=False):
        if not paths:
            raise ValueError(f"{name} is empty: expected one file or more")
    if n_images is not None:
        n_images = _check.integer("n_images", n_images, 1, 2)
    if saturation is not None:
        saturation = _check.number("saturation", saturation, 0, open_low=True)
    frames, clear = ([averaged(path, n_images, saturation) for path in paths] for paths in kinds[:2])
    darks, maps, pupil_darks = ([averaged(path, n_images, np.inf) for path in paths] for paths in kinds[2:])
    shapes = {file.images.shape[1:] for file in (*frames, *clear)}
    for name, files in zip(names[2:], (darks, maps, pupil_darks), strict=True):
        for file in files:
            if not any(_on_window(file, frame) for frame in (*frames, *clear)):
                expected = " or ".join(map(str, sorted(shapes)))
                raise ValueError(
                    f"{name}: {file.name} has shape {file.images.shape[1:]}: expected {expected}, as the frames, "
                    "or headers with DETSEC that state where their windows lie"
                )
    return (
        combined(frames, darks, maps, n_images),
        combined(clear, pupil_darks or darks, maps, n_images),
        [*frames, *clear, *darks, *maps, *pupil_darks],
    )


def combined(
    files: Sequence[CameraFile],
    darks: Sequence[CameraFile] = (),
    bad_pixels: Sequence[CameraFile] = (),
    n_images: int | None = None,
) -> tuple[Image, ...]:
    """One or two images from means of exposures, less the dark, with their bad pixels, see `read_all`."""
    recorded = _by_image("files", files, n_images)
    if n_images and len(recorded) != n_images:
        raise ValueError(f"{_names(files)}: {len(recorded)} images in an exposure: expected n_images = {n_images}")
    result: list[Image] = []
    for index, sources in enumerate(recorded):
        dark = _companion("darks", darks, sources[0], index, len(recorded))
        marked = _companion("bad_pixels", bad_pixels, sources[0], index, len(recorded)) != 0
        with np.errstate(over="ignore", invalid="ignore"):
            counts = _mean(sources) - dark
        bad = ~_usable(counts) | marked
        if bad.all():
            names = _names([*sources, *darks, *bad_pixels])
            raise ValueError(f"{names}: all pixels are bad or saturated: expected an image")
        name = _names(sources) + f"[{index}]" * (len(files[0].images) > 1)
        result.append(Image(nearest_good(counts, ~bad), bad, name, dark=dark, window=_window(sources[0])))
    return tuple(result)


def check_output(output: str | Path, inputs: Sequence[str | Path] = (), *, overwrite: bool = False) -> Path:
    """Path of a phase map that is to be written, after a check that no other file is lost.

    Links are followed. Call it before a long computation; `write_phase` calls it again.

    Parameters
    ----------
    output : str or Path
        May be an earlier phase map, which is recognised by its header.
    inputs : sequence of str or Path
        Files that are never replaced: camera frames, darks, the calibration, and the like.
    overwrite : bool
        Whether `output` may also be a file that is not a phase map; it may never be an input.

    Returns
    -------
    Path
        Absolute, and without links.

    Raises
    ------
    TypeError, ValueError
        If `output` is one of the inputs, also under another name or as a hard link, is a file that `write_phase`
        did not write, is a folder, or cannot be written, or if an input is its scratch file.
    """
    overwrite = _check.flag("overwrite", overwrite)
    sources = [file_and_unit(source)[0] for source in paths_of("inputs", inputs)]
    path = path_of("output", output)
    named = f"output = {str(output)!r}"
    try:
        path = path.resolve()
        there = is_there(path)
    except (OSError, RuntimeError) as error:  # a name that is too long, or links in a circle
        raise ValueError(f"{named}: {error}") from None
    for source in sources:
        if there and os.path.exists(source) and os.path.samefile(path, source):
            raise ValueError(f"{named} is the input {str(source)!r}: expected another file")
        if source.resolve() == scratch_of(path):
            raise ValueError(f"{named}: its scratch file is the input {str(source)!r}: expected another file")
    if there and not path.is_file():
        raise ValueError(f"{named}: expected a file, not a folder or a device")
    if there and not overwrite and not has_card(path, _PHASE_CARD):
        raise ValueError(
            f"{named} exists and is not a phase map of zwfs: expected a new name, or overwrite = True"
        )
    folder = next(parent for parent in path.parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{named}: expected a file in a folder that can be written, not in {folder}")
    if len(os.fsencode(path.name)) > _LONGEST:
        raise ValueError(f"{named}: expected a name of at most {_LONGEST} bytes")
    return path


def write_phase(
    output: str | Path,
    phases: Phases,
    wavelength: float,
    sources: Sequence[CameraFile] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a phase map as FITS: in radian, in nm as an extension, and the bad points as another.

    The header names the sources and holds the optics and the agreement of the frames. It has no date but DATE-OBS
    of the first source, so that the same input gives the same bytes.

    Parameters
    ----------
    output : str or Path
        See `check_output`. An earlier phase map is replaced.
    phases : Phases
        Of `recover_phase` or `phase_of`.
    wavelength : float, nm
    sources : sequence of CameraFiles
        Their names and checksums go into the header. None of these files is replaced.
    overwrite : bool
        Whether any other file may be replaced.

    Raises
    ------
    ImportError
        If astropy is missing.
    TypeError, ValueError
        If the wavelength is not above 0, or `check_output` refuses the file.
    """
    from zwfs import __version__

    fits_module()
    _check.instance("phases", phases, Phases)
    _check.sequence("sources", sources, CameraFile)
    path = check_output(output, [source.path for source in sources if source.path], overwrite=overwrite)
    wavelength = _check.number("wavelength", wavelength, 0, open_low=True)
    cards = [
        ("BUNIT", "rad", "in (-pi, pi]; NaN outside and at bad points"),
        ("WAVELEN", wavelength, "[nm] wavelength"),
        *_agreement_cards(phases),
    ]
    for index, source in enumerate(sources, 1):
        cards += [(f"FILE{index}", source.name, ""), (f"SHA{index}", source.sha256, "")]
    if sources and "DATE-OBS" in sources[0].header:
        cards.append(("DATE-OBS", str(sources[0].header["DATE-OBS"]), f"of {sources[0].name}"))
    cards.append(("CREATOR", f"zwfs {__version__}", ""))
    measurement = phases.agreement.measurement
    bad = (measurement.pupil.inside & ~measurement.good).astype(np.uint8)
    units = (phase_to_opd(phases.phase, wavelength), "PHASE_NM", [("BUNIT", "nm", "")]), (bad, "BAD", ())
    write_file(path, fits_content((phases.phase, "", cards), *units))


def _agreement_cards(phases: Phases) -> list[tuple[str, Any, str]]:
    """Cards of the optics, of the agreement of the frames, and of their places."""
    agreement, measurement = phases.agreement, phases.agreement.measurement
    optics, registered = measurement.optics, measurement.registered
    placement = registered.placement
    cards = [
        ("PIXSCALE", 1 / registered.diameter, "[D] width of a pixel"),
        *sensor_cards(registered.diameter, measurement.pupil.center, optics),
        ("BACKGRND", optics.background, "background of the frames, 1 = mean of pupil"),
        ("PUPBACK", optics.pupil_background, "the same of the clear frames"),
        ("SCALE", optics.scale, "factor on the frames"),
        ("LEAKAGE", optics.leakage, "fraction of the other image's light"),
        ("UNMASKED", optics.unmasked, "fraction of light the mask does not shift"),
        ("FLUXMASK", measurement.flux_ratio[0], "light of image 1 over image 2, frames"),
        ("FLUXOUT", measurement.flux_ratio[1], "the same, clear frames"),
        *((f"CORR{i}", value, "measured with modelled frame") for i, value in enumerate(agreement.correlation, 1)),
        *((f"RESID{i}", value, "rms difference of them") for i, value in enumerate(agreement.residual, 1)),
        ("NPOINTS", measurement.pupil.n_points, "points of the pupil"),
        ("NBAD", measurement.n_bad, "of these, bad"),
        ("CONVERGE", bool(phases.converged), "the iteration converged"),
        ("ROTATE", placement.rotation, "[deg] image 2 from image 1, x to y"),
        ("ROTERR", placement.sigma[2], "[deg] standard error; NaN: not determined"),
        ("MAGNIF", placement.magnification, "size of image 2 over that of image 1"),
        ("MAGERR", placement.sigma[3], "standard error; NaN: not determined"),
    ]
    for index, (image, origin) in enumerate(zip(registered.images, registered.origins, strict=True), 1):
        cards += [
            (f"IMAGE{index}", image.name, "frames, then clear frames"),
            (f"ROW{index}", origin[0], "[pixel] pupil from its place on clear frame 1"),
            (f"COL{index}", origin[1], "[pixel]"),
        ]
    return cards


def sensor_cards(diameter: float, center: tuple[float, float], optics: Optics) -> Cards:
    """Header cards of the pupil (pixels) and of the masks."""
    return [
        ("PUPDIAM", diameter, "[pixel] diameter D of the pupil"),
        ("CENTROW", center[0], "[pixel] centre of the pupil, from 0"),
        ("CENTCOL", center[1], "[pixel] centre of the pupil, from 0"),
        ("DIMPLE", optics.diameter, "[lambda/D] diameter of the dimple"),
        *((f"THETA{i}", value, f"[rad] phase shift, image {i}") for i, value in enumerate(optics.phase_shifts, 1)),
    ]


def _usable(counts: NDArray) -> NDArray[np.bool_]:
    """Pixels that are numbers of a size that counts can have."""
    return np.abs(counts) <= _check.LARGEST


def _names(files: Sequence[CameraFile]) -> str:
    return ", ".join(dict.fromkeys(file.name for file in files)) or "files"


def _camera_file(array: Images, images: NDArray, **settings: Any) -> CameraFile:
    with array.path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return CameraFile(images, array.path.name, sha256, array.header, array.path, **settings)


def averaged(path: Path, n_images: int | None, saturation: float | None) -> CameraFile:
    """Mean exposure of a file, read in pieces: NaN where it is saturated once, or never a number."""
    segments = segments_of(path, n_images, verify=True)
    first = segments[0].arrays[0]
    shape = segments[0].n_images, *first.full[-2:]
    total, n_used, saturated = np.zeros(shape), np.zeros(shape, int), np.zeros(shape, bool)
    step = max(1, _PIECE // math.prod(shape))
    for segment in segments:
        for start in range(0, segment.n, step):
            for exposure in segment.read(start, min(start + step, segment.n)).astype(np.float64):
                saturated |= [_saturated(first, image, saturation) for image in exposure]
                good = _usable(exposure)
                total += np.where(good, exposure, 0)
                n_used += good
    if saturation not in (None, np.inf) and np.any((saturated | (n_used == 0)).all(axis=(1, 2))):
        raise ValueError(f"{first.name}: all pixels reach saturation = {saturation:g}: expected a higher level")
    mean = np.divide(total, n_used, out=np.full(shape, np.nan), where=~saturated & (n_used > 0))
    return _camera_file(first, mean, n_exposures=sum(segment.n for segment in segments))


def _saturated(source: Images, image: NDArray, level: float | None) -> NDArray[np.bool_]:
    """Saturated pixels of an exposure: above a level that is given or stated, or where many are equal."""
    usable = _usable(image)
    counts = image[usable]
    if level is None and "SATURATE" in source.header:
        level = _check.number(f"{source.name}: SATURATE", source.header["SATURATE"], 0, open_low=True)
    if level is None:
        top = counts.max(initial=-np.inf)
        plateau = np.count_nonzero(counts == top) >= _PLATEAU and top > counts.min(initial=np.inf)
        level = min(source.full_scale, top if plateau else np.inf)
    return usable & (image >= level)


def _by_image(argument: str, files: Sequence[CameraFile], n_images: int | None) -> list[list[CameraFile]]:
    """Files of each image, with this one alone."""
    sizes = {len(file.images) for file in files}
    if sizes == {1} and len(files) == 2 and n_images != 1:
        return [[file] for file in files]
    if sizes not in ({1}, {2}):
        n = sum(len(file.images) for file in files)
        raise ValueError(f"{argument}: {_names(files)}: {n} images: expected one or two")
    if len(shapes := {file.images.shape[1:] for file in files}) > 1:
        raise ValueError(f"{argument}: {_names(files)}: exposures of shapes {sorted(shapes)}: expected the same")
    return [[replace(file, images=file.images[k : k + 1]) for file in files] for k in range(sizes.pop())]


def _mean(files: Sequence[CameraFile]) -> NDArray[np.float64]:
    """Mean of files, each by its number of exposures; NaN where none has a number."""
    values = np.concatenate([file.images for file in files])
    weights = np.array([file.n_exposures for file in files])[:, np.newaxis, np.newaxis] * _usable(values)
    total = np.sum(np.where(weights > 0, values, 0) * weights, axis=0)
    weight = weights.sum(axis=0)
    return np.divide(total, weight, out=np.full(total.shape, np.nan), where=weight > 0)


def _companion(
    argument: str, files: Sequence[CameraFile], frame: CameraFile, index: int, n_images: int
) -> NDArray[np.float64]:
    """Dark or bad-pixel map of an image of a file: the mean of those that belong to it; 0 without files."""
    if not files:
        return np.zeros(())
    shape, first_shape = frame.images.shape[1:], files[0].images.shape[1:]
    same = [part for file in files if (part := _on_window(file, frame))]
    if not same:
        raise ValueError(
            f"{argument}: {_names(files)} has shape {first_shape}: expected {shape}, that of {frame.name}, "
            "or headers with DETSEC that state where both windows lie"
        )
    for file in same:
        if argument == "bad_pixels" and (share := np.mean(file.images != 0)) > 0.5:
            raise ValueError(
                f"{argument}: {file.name} marks {share:.1%} of its pixels as bad: expected 0 for good pixels, and "
                "less than half bad; it looks like a map with 1 = good"
            )
    differences = [_difference(file, frame) if argument == "darks" else "" for file in same]
    fitting = [file for file, difference in zip(same, differences, strict=True) if not difference]
    if not fitting:
        warnings.warn(f"darks: {differences[0]}: expected a dark with the same settings", stacklevel=4)
    by_image = _by_image(argument, fitting or same, 1 if n_images == 1 else None)
    if len(by_image) > n_images:  # two units for frames of one image are two exposures
        by_image = [by_image[0] + by_image[1]]
    chosen = by_image[index if len(by_image) > 1 else 0]
    if argument == "darks":
        _check_alike(chosen)
    return _mean(chosen)


def _check_alike(darks: Sequence[CameraFile]) -> None:
    """Require that darks of one image differ by no more than their noise."""
    first = darks[0]
    for file in darks[1:]:
        change = file.images - first.images
        middle = np.nanmedian(change)
        if abs(middle) > _ALIKE * np.nanmedian(np.abs(change - middle)):
            raise ValueError(
                f"darks: {file.name} has {middle:+.6g} counts more than {first.name}, beyond the noise: expected "
                "equal exposures; the darks of the clear frames are pupil_dark_files"
            )


def _window(file: CameraFile) -> tuple[int, int] | None:
    """First row and column of the images on the detector, as the header states them, counted from any number."""
    for key in _ENDS:
        numbers = [int(number) for number in re.findall("[0-9]{1,6}", str(file.header.get(key, "")))]
        if len(numbers) == 4:
            (left, right), (top, bottom) = sorted(numbers[:2]), sorted(numbers[2:])
            if (bottom - top + 1, right - left + 1) == file.images.shape[1:]:  # not so where pixels are binned
                return top, left
    for keys in _STARTS:
        starts: list[Any] = [file.header.get(key) for key in keys]
        if all(isinstance(start, int | float) and float(start).is_integer() for start in starts):
            return int(starts[0]), int(starts[1])
    return None


def _on_window(file: CameraFile, frame: CameraFile) -> CameraFile | None:
    """The part of a dark or a map on the window of a frame; all of it if it has this shape."""
    shape = frame.images.shape[1:]
    if file.images.shape[1:] == shape:
        return file
    own, window = _window(file), _window(frame)
    if own is None or window is None or window[0] < own[0] or window[1] < own[1]:
        return None
    row, column = window[0] - own[0], window[1] - own[1]
    images = file.images[:, row : row + shape[0], column : column + shape[1]]
    cards = {key: frame.header[key] for key in _WINDOWS if key in frame.header}
    return replace(file, images=images, header={**file.header, **cards}) if images.shape[1:] == shape else None


def relative_exposure(frame: CameraFile, clear_frame: CameraFile) -> float:
    """Exposure time of a frame over that of a clear frame; 1 where headers state none, or count per second."""
    headers = frame.header, clear_frame.header
    if any(str(header.get("BUNIT", "")).strip().lower().endswith(_PER_SECOND) for header in headers):
        return 1.0
    for key in _TIMES:
        time, clear_time = (header.get(key, 0) for header in headers)
        if all(isinstance(value, int | float) and 0 < value < np.inf for value in (time, clear_time)):
            return float(time / clear_time)
    return 1.0


def _difference(dark: CameraFile, frame: CameraFile) -> str:
    """Exposure time or window in which a dark differs from a frame, where both headers state it."""
    for key in (*_TIMES, *_WINDOWS):
        if key in dark.header and key in frame.header:
            values = dark.header[key], frame.header[key]
            numbers = all(isinstance(value, int | float) for value in values)
            if not (math.isclose(*values, rel_tol=_SAME) if numbers else values[0] == values[1]):
                return f"{key} is {values[0]} in {dark.name} and {values[1]} in {frame.name}"
    return ""
