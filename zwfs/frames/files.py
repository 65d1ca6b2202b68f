"""Camera files: read frames from FITS or NPY, write the phase as FITS.

FITS files need astropy: `pip install astropy`.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zwfs import _check
from zwfs._images import nearest_good
from zwfs._system import is_there, path_of, paths_of, write_file
from zwfs.frames._blocks import FileError, blocks_in, unpacked
from zwfs.frames._fits import fits_content, fits_module, has_card
from zwfs.frames._part import Cards, scratch_of
from zwfs.frames.pipeline import MeasuredPhase, Optics
from zwfs.frames.registration import Image

__all__ = ["CameraFile", "check_output", "images", "read", "read_all", "write_phase"]

_PLATEAU = 10  # pixels that share exactly the largest value: noise does not do that, saturation does
# Header card of a phase map: no other file is replaced.
_PHASE_CARD = b"CREATOR = 'zwfs "
_LONGEST = 240  # bytes of a file name; a partial file has a few more, and most file systems allow 255


@dataclass(frozen=True, eq=False)
class CameraFile:
    """Images and header of a file.

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
    path : Path, optional
        Of the file, absolute. `write_phase` never replaces it.
    """

    images: NDArray[np.float64]
    name: str
    sha256: str
    header: Mapping[str, Any] = field(default_factory=dict)
    full_scale: float = np.inf
    path: Path | None = None

    def __post_init__(self) -> None:
        images = _check.real_array("images", self.images)
        if images.ndim != 3 or not images.size:
            raise ValueError(f"images has shape {images.shape}: expected (n, ny, nx)")

    def keyword(self, key: str) -> float:
        """Number under a keyword of the header.

        Raises
        ------
        ValueError
            If the header lacks the keyword, or its value is not a number.
        """
        _check.instance("key", key, str)
        if key not in self.header:
            raise ValueError(f"{self.name}: its header has no {key}: give the value as a parameter")
        return _check.number(f"{self.name}: {key}", self.header[key])

    def optics(self, diameter: float = 0.0, phase_shifts: Sequence[float] = ()) -> Optics:
        """Optics with these values, see `Optics`; by default those of the header, DIMPLE, THETA1 and THETA2."""
        diameter = _check.number("diameter", diameter, 0)
        _check.sequence("phase_shifts", phase_shifts, expected="a list of two numbers")
        shifts: Any = phase_shifts or [self.keyword(key) for key in ("THETA1", "THETA2")]
        return Optics(diameter or self.keyword("DIMPLE"), tuple(shifts))


def read(path: str | Path, *, max_bytes: int = 2**29, max_images: int = 2) -> CameraFile:
    """Read a FITS or NPY file, plain or packed with gzip; the first bytes decide which.

    Integers, big-endian numbers, BZERO and BSCALE all become float64. Two images in two extensions of a FITS file
    are read as an array of two images. Header cards that do not follow the standard are left out.

    Parameters
    ----------
    path : str or Path
    max_bytes : int
        Largest size of the file, also when it is unpacked, and of its images as float64. A larger file is refused
        before its images are in memory.
    max_images : int
        Largest number of images.

    Returns
    -------
    CameraFile

    Raises
    ------
    FileNotFoundError
    ImportError
        If astropy is needed and missing.
    FileError
        A ValueError: if the file is of another kind, broken, too large, compressed with fpack, holds no image, too
        many of them, an array that is neither (ny, nx) nor (n, ny, nx), or numbers that are not real.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from zwfs.frames.files import images, read
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(f"{folder}/frame.npy", np.eye(16))
    ...     file = read(f"{folder}/frame.npy")
    ...
    >>> file.name, file.images.shape
    ('frame.npy', (1, 16, 16))
    >>> images([file], saturation=2.0)[0].counts.shape
    (16, 16)
    """
    path = path_of("path", path)
    max_bytes, max_images = _check.integer("max_bytes", max_bytes, 1), _check.integer("max_images", max_images, 1)
    if not os.path.isfile(path):
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise FileNotFoundError(f"{path}: no such file{where}")
    name = path.name
    with path.open("rb") as file:
        content = unpacked(file, name, max_bytes)
        file.seek(0)
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    blocks = blocks_in(content, path, verify=True)
    shapes = [block.full for block in blocks]
    if len(blocks) > 2 or shapes[0] != shapes[-1] or (len(blocks) == 2 and len(shapes[0]) != 2):
        raise FileError(f"{name}: images of shapes {shapes}: expected one, or two of the same (ny, nx)")
    shape = shapes[0] if len(blocks) == 1 else (2, *shapes[0])
    if len(shape) not in (2, 3) or min(shape) < 1 or (len(shape) == 3 and shape[0] > max_images):
        expected = f"(ny, nx), or (n, ny, nx) with n up to {max_images}"
        raise FileError(f"{name}: its shape is {shape}: expected {expected}")
    if (n_bytes := 8 * math.prod(shape)) > max_bytes:
        expected = f"at most max_bytes = {max_bytes}"
        raise FileError(f"{name}: its shape is {shape}, {n_bytes} bytes as float64: expected {expected}")
    images = [block.scaled(block.take(content, 0, block.n), np.float64)[:, 0] for block in blocks]
    highest = min(block.full_scale for block in blocks)
    return CameraFile(np.concatenate(images), name, sha256, blocks[0].header, highest, path.resolve())


def read_all(
    frame_files: Sequence[str | Path],
    pupil_files: Sequence[str | Path],
    dark_files: Sequence[str | Path] = (),
    bad_pixel_files: Sequence[str | Path] = (),
    saturation: float | None = None,
) -> tuple[tuple[Image, ...], tuple[Image, ...], list[CameraFile]]:
    """Read all files of a measurement: one or two each of frames and clear frames, and optional darks and maps.

    The parameters are those of `read` and `images`.

    Returns
    -------
    frames, clear_frames : tuple of Image
    sources : list of CameraFile
        All files; the first is that of the first frame.
    """
    names = "frame_files", "pupil_files", "dark_files", "bad_pixel_files"
    given = frame_files, pupil_files, dark_files, bad_pixel_files
    kinds = [paths_of(name, paths) for name, paths in zip(names, given, strict=True)]
    for name, paths in zip(names[:2], kinds, strict=False):
        if not paths:
            raise ValueError(f"{name} is empty: expected one file or two")
    frames, clear, darks, maps = ([read(path) for path in paths] for paths in kinds)
    shared = darks, maps, saturation
    return images(frames, *shared), images(clear, *shared), [*frames, *clear, *darks, *maps]


def images(
    files: Sequence[CameraFile],
    darks: Sequence[CameraFile] = (),
    bad_pixels: Sequence[CameraFile] = (),
    saturation: float | None = None,
) -> tuple[Image, ...]:
    """One or two images from files, less the dark, with their bad pixels.

    Bad are pixels that are NaN, infinite or beyond 1e38, are not 0 in the bad-pixel map, or are saturated. Without
    a level, a pixel is saturated at SATURATE of the header, at the largest number that an integer type can hold,
    or where ten or more pixels share exactly the largest value.

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
        If the number of images or a shape is wrong, every pixel of an image or of its dark is bad, or the
        bad-pixel map marks all of them.
    """
    for argument, given in (("files", files), ("darks", darks), ("bad_pixels", bad_pixels)):
        _check.sequence(argument, given, CameraFile)
    if saturation is not None:
        saturation = _check.number("saturation", saturation, 0, open_low=True)
    recorded = [(file, counts) for file in files for counts in file.images]
    if len(recorded) not in (1, 2):
        names = ", ".join(dict.fromkeys(file.name for file in files)) or "files"
        raise ValueError(f"{names}: {len(recorded)} images: expected one or two")
    result: list[Image] = []
    for (file, counts), dark, marked in zip(
        recorded,
        _companions("darks", darks, recorded, _usable),
        _companions("bad_pixels", bad_pixels, recorded, np.logical_not),
        strict=True,
    ):
        bad = ~_usable(counts)
        level = saturation or _saturation(file, counts[~bad])
        bad |= np.where(bad, 0, counts) >= level
        with np.errstate(over="ignore", invalid="ignore"):
            counts = counts - dark
        bad |= ~_usable(counts) | (marked != 0)
        if bad.all():
            names = ", ".join([file.name, *(one.name for one in (*darks, *bad_pixels))])
            raise ValueError(
                f"{names}: all pixels are bad or saturated (saturation = {level:g}): expected an image"
            )
        name = file.name if len(file.images) == 1 else f"{file.name}[{len(result)}]"
        result.append(Image(nearest_good(counts, ~bad), bad, name))
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
        did not write, is a folder, or cannot be written, or if an input lies in its scratch folder.
    """
    overwrite = _check.flag("overwrite", overwrite)
    sources = paths_of("inputs", inputs)
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
        if scratch_of(path) in source.resolve().parents:
            raise ValueError(f"{named}: its scratch folder holds the input {str(source)!r}: expected another file")
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
    phase: MeasuredPhase,
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
    phase : MeasuredPhase
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
    _check.instance("phase", phase, MeasuredPhase)
    _check.sequence("sources", sources, CameraFile)
    path = check_output(output, [source.path for source in sources if source.path], overwrite=overwrite)
    wavelength = _check.number("wavelength", wavelength, 0, open_low=True)
    measurement, registered, optics = phase.measurement, phase.measurement.registered, phase.measurement.optics
    placement = registered.placement
    cards = [
        ("BUNIT", "rad", "in (-pi, pi]; NaN outside and at bad points"),
        ("WAVELEN", wavelength, "[nm] wavelength"),
        ("PIXSCALE", 1 / registered.diameter, "[D] width of a pixel"),
        *sensor_cards(registered.diameter, measurement.pupil.center, optics),
        ("BACKGRND", optics.background, "background of the frames, 1 = mean of pupil"),
        ("PUPBACK", optics.pupil_background, "the same of the clear frames"),
        ("SCALE", optics.scale, "factor on the frames"),
        ("LEAKAGE", optics.leakage, "fraction of the other image's light"),
        ("UNMASKED", optics.unmasked, "fraction of light the mask does not shift"),
        ("FLUXMASK", measurement.flux_ratio[0], "light of image 1 over image 2, frames"),
        ("FLUXOUT", measurement.flux_ratio[1], "the same, clear frames"),
        *((f"CORR{i}", value, "measured with modelled frame") for i, value in enumerate(phase.correlation, 1)),
        *((f"RESID{i}", value, "rms difference of them") for i, value in enumerate(phase.residual, 1)),
        ("NPOINTS", measurement.pupil.n_points, "points of the pupil"),
        ("NBAD", measurement.n_bad, "of these, bad"),
        ("CONVERGE", phase.converged, "the iteration converged"),
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
    for index, source in enumerate(sources, 1):
        cards += [(f"FILE{index}", source.name, ""), (f"SHA{index}", source.sha256, "")]
    if sources and "DATE-OBS" in sources[0].header:
        cards.append(("DATE-OBS", str(sources[0].header["DATE-OBS"]), f"of {sources[0].name}"))
    cards.append(("CREATOR", f"zwfs {__version__}", ""))
    bad = (measurement.pupil.inside & ~measurement.good).astype(np.uint8)
    units = (phase.opd(wavelength), "PHASE_NM", [("BUNIT", "nm", "")]), (bad, "BAD", ())
    write_file(path, fits_content((phase.phase, "", cards), *units))


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


def _companions(
    argument: str,
    files: Sequence[CameraFile],
    recorded: list[tuple[CameraFile, NDArray]],
    good: Callable[[NDArray], NDArray],
) -> list[NDArray]:
    """Dark or bad-pixel map of each recorded image, with at least one good pixel; 0 everywhere without files."""
    maps = [(file.name, image) for file in files for image in file.images]
    if not maps:
        return [np.zeros(())] * len(recorded)
    n = len(recorded)
    if len(maps) not in (1, n):
        names = ", ".join(dict.fromkeys(file.name for file in files))
        raise ValueError(
            f"{argument}: {names}: {len(maps)} images for the {n} of {recorded[0][0].name}: "
            "expected one, or one for each"
        )
    maps = maps * n if len(maps) == 1 else maps
    for (name, image), (file, counts) in zip(maps, recorded, strict=True):
        if image.shape != counts.shape:
            raise ValueError(
                f"{argument}: {name} has shape {image.shape}: expected {counts.shape}, that of {file.name}"
            )
        if not good(image).any():
            raise ValueError(f"{argument}: {name} has no good pixel: expected some")
    return [image for _, image in maps]


def _saturation(file: CameraFile, counts: NDArray) -> float:
    """Level at which pixels are saturated, if a file states it."""
    if "SATURATE" in file.header:
        return file.keyword("SATURATE")
    top = counts.max(initial=-np.inf)
    plateau = np.count_nonzero(counts == top) >= _PLATEAU and top > counts.min(initial=np.inf)
    return min(file.full_scale, top if plateau else np.inf)
