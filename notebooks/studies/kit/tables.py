"""Tables and sentences of results that notebooks show: few digits, the same on every machine."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import Any, NamedTuple

MISSING = "–"
"""What stands for a number that does not exist."""


class Link(NamedTuple):
    """A cell that links to a page; in the book, the output needs the format `myst`."""

    text: str
    page: str  # relative to the notebook


@dataclass(frozen=True)
class Table:
    """Rows under a header; a notebook shows it as a table."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 3

    def __repr__(self) -> str:
        return f"Table of {len(self.rows)} rows: {', '.join(self.header)}"

    def _repr_markdown_(self) -> str:
        lines = [list(map(self._text, self.header)), ["---"] * len(self.header)]
        lines += [[self._text(cell) for cell in row] for row in self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def _text(self, cell: Any) -> str:
        if isinstance(cell, Link):
            return f"[{plain(cell.text)}]({cell.page})"
        if isinstance(cell, bool):
            return "yes" if cell else "no"
        if isinstance(cell, float):
            return f"{cell:.{self.digits}g}" if isfinite(cell) else MISSING
        return plain(str(cell))


@dataclass(frozen=True)
class Text:
    """Markdown that a cell computes: sentences on its results, which are right for any parameters."""

    markdown: str

    def __repr__(self) -> str:
        return "Text"

    def _repr_markdown_(self) -> str:
        return self.markdown


def two_digits(value: float) -> str:
    """Return a number with two significant digits, or a dash if it is not finite."""
    return f"{float(f'{value:.1e}'):g}" if isfinite(value) else MISSING


def with_zeros(value: float) -> str:
    """Return a number with two significant digits, zeros at the end included; a power of ten from a million on."""
    if not isfinite(value):
        return MISSING
    rounded = float(f"{value:.2g}")
    if rounded < 1e6:
        return f"{rounded:.{max(0, 1 - floor(log10(rounded)))}f}" if rounded else "0"
    digits, power = f"{rounded:.1e}".split("e")
    return f"{digits}×10{str(int(power)).translate(str.maketrans('0123456789', '⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def small(value: float) -> str:
    """Return a number with two significant digits, or a bound below which digits are rounding errors."""
    if not isfinite(value):
        return MISSING
    return "<10⁻⁶" if value < 1e-6 else f"{value:.2g}"


def plain(text: str) -> str:
    """Return Markdown that shows a text as it is: one line, in which nothing is a link, a command or HTML."""
    line = "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)
    return re.sub(r"([\\`*_{}\[\]<>$|#&~])", r"\\\1", line)
