"""FITS files. The only module that imports astropy: `pip install astropy`."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

FIRST_BYTES = b"SIMPLE  ="
# Types of the numbers of an image, by BITPIX, and the cards that give them a meaning, with their defaults.
TYPES = {bits: np.dtype(kind) for bits, kind in
         {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}.items()}  # fmt: skip
KEYWORD = re.compile("[A-Z0-9_ -]*")  # of the standard, with the blanks of the convention HIERARCH
SCALING = {"BSCALE": 1, "BZERO": 0, "BLANK": None}


def fits_module() -> ModuleType:
    """Return `astropy.io.fits`, or say how to get it."""
    try:
        from astropy.io import fits
    except ImportError:
        raise ImportError("FITS files need astropy: pip install astropy; NPY files do not") from None
    return fits


def open_fits(content: BinaryIO, **options: Any) -> Any:
    """Open a FITS file for reading, see `astropy.io.fits.open`; return its units."""
    return fits_module().open(content, memmap=False, **options)


def header_cards(header: Any) -> dict[str, Any]:
    """Values of a FITS header by keyword; cards that do not follow the standard are left out."""
    values: dict[str, Any] = {}
    for card in header.cards:
        with suppress(fits_module().VerifyError):
            if KEYWORD.fullmatch(card.keyword):
                values.setdefault(card.keyword, card.value)
    return values


def fits_content(*units: tuple[NDArray, str, Sequence[tuple[str, Any, str]]]) -> bytes:
    """Return the content of a file: image, name and header cards (keyword, value, comment) of each unit."""
    fits = fits_module()
    made = fits.HDUList()
    for image, name, cards in units:
        made.append(fits.ImageHDU(image, name=name) if made else fits.PrimaryHDU(image))
        for key, value, comment in cards:
            made[-1].header[key] = (card_value(value), comment) if comment else card_value(value)
    stream = io.BytesIO()
    made.writeto(stream)
    return stream.getvalue()


def has_card(path: Path, card: bytes) -> bool:
    """Whether a file is FITS and the header of its first unit has a card that begins like this."""
    try:
        with path.open("rb") as file:
            header = file.read(2880 * 32)
    except OSError:
        return False
    cards = (header[place : place + 80] for place in range(0, len(header), 80))
    return header.startswith(FIRST_BYTES) and any(one.startswith(card) for one in cards)


def card_value(value: Any) -> Any:
    """Value for a FITS header: floats with nine digits, which hide rounding errors, no NaN, and ASCII strings."""
    if isinstance(value, str):
        return value if value.isascii() and value.isprintable() else ascii(value)[1:-1]
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}") if np.isfinite(value) else "NaN"
    return bool(value) if isinstance(value, np.bool_) else value


def full_scale(dtype: np.dtype, scale: float = 1.0, zero: float = 0.0) -> float:
    """Largest value that numbers of a type can stand for, each times `scale` plus `zero`; infinity for floats."""
    if dtype.kind not in "iu":
        return np.inf
    return max(float(end) * scale + zero for end in (np.iinfo(dtype).min, np.iinfo(dtype).max))
