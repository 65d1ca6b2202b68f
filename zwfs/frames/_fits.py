"""Headers of FITS files, and how to write these. Only FITS files need astropy: `pip install astropy`."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIRST_BYTES = b"SIMPLE  ="
_KEYWORD = re.compile("[A-Z0-9_ -]*")  # of the standard, with the blanks of the convention HIERARCH


def fits_module() -> ModuleType:
    """Return `astropy.io.fits`, or say how to get it."""
    try:
        from astropy.io import fits
    except ImportError:
        raise ImportError("FITS files need astropy: pip install astropy; NPY files do not") from None
    return fits


def fits_content(*units: tuple[NDArray, str, Sequence[tuple[str, Any, str]]]) -> bytes:
    """Return the content of a file: image, name and header cards (keyword, value, comment) of each unit."""
    fits = fits_module()
    units_written = fits.HDUList()
    for image, name, cards in units:
        units_written.append(fits.ImageHDU(image, name=name) if units_written else fits.PrimaryHDU(image))
        set_cards(units_written[-1].header, cards)
    stream = io.BytesIO()
    units_written.writeto(stream)
    return stream.getvalue()


def set_cards(header: Any, cards: Sequence[tuple[str, Any, str]]) -> None:
    """Put cards (keyword, value, comment) into a header."""
    for key, value, comment in cards:
        header[key] = (card_value(value), comment) if comment else card_value(value)


def has_card(path: Path, card: bytes) -> bool:
    """Whether a file is FITS and the header of its first unit has a card that begins like this."""
    try:
        with path.open("rb") as file:
            header = file.read(2880 * 32)
    except OSError:
        return False
    cards = (header[place : place + 80] for place in range(0, len(header), 80))
    return header.startswith(FIRST_BYTES) and any(text.startswith(card) for text in cards)


def card_value(value: Any) -> Any:
    """Value for a FITS header: floats with nine digits, which hide rounding errors, no NaN, and ASCII strings."""
    if isinstance(value, str):
        return value if value.isascii() and value.isprintable() else ascii(value)[1:-1]
    if isinstance(value, float | np.floating):
        return float(f"{value:.9g}") if np.isfinite(value) else "NaN"
    return bool(value) if isinstance(value, np.bool_) else value


def header_cards(header: Any) -> dict[str, Any]:
    """Return the values of a FITS header by keyword; cards that do not follow the standard are left out."""
    values: dict[str, Any] = {}
    for card in header.cards:
        with suppress(fits_module().VerifyError):
            if _KEYWORD.fullmatch(card.keyword):
                values.setdefault(card.keyword, card.value)
    return values
