"""Tables of results that notebooks show: few digits, the same on every machine."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from zwfs import _check


@dataclass(frozen=True)
class Table:
    """Rows under a header; a notebook shows it as a table.

    Floats are given `digits` significant digits, so that rounding errors do not show. Strings are shown as they
    are: the name of a file can hold neither a link nor HTML.

    Attributes
    ----------
    header : sequence of str
    rows : sequence of sequences
        As long as the header each.
    digits : int
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 3

    def __post_init__(self) -> None:
        _check.sequence("header", self.header, str)
        _check.sequence("rows", self.rows, expected="a list")
        _check.integer("digits", self.digits, 1, 17)
        for index, row in enumerate(self.rows):
            _check.sequence(f"rows[{index}]", row, expected="a list of cells")
            if len(row) != len(self.header):
                raise ValueError(
                    f"rows[{index}] has {len(row)} cells: expected {len(self.header)}, as the header has"
                )

    def __repr__(self) -> str:
        return f"Table of {len(self.rows)} rows: {', '.join(self.header)}"

    def _repr_markdown_(self) -> str:
        lines = [list(map(self._text, self.header)), ["---"] * len(self.header)]
        lines += [[self._text(cell) for cell in row] for row in self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def _text(self, cell: Any) -> str:
        if isinstance(cell, bool):
            return "yes" if cell else "no"
        return f"{cell:.{self.digits}g}" if isinstance(cell, float) else plain(str(cell))


def small(value: float) -> str:
    """Return a number with two significant digits, or a bound below which digits are rounding errors."""
    return "<10⁻⁶" if value < 1e-6 else f"{value:.2g}"


def plain(text: str) -> str:
    """Return Markdown that shows a text as it is: one line, in which nothing is a link, a command or HTML."""
    _check.instance("text", text, str)
    line = "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)
    return re.sub(r"([\\`*_{}\[\]<>$|#&~])", r"\\\1", line)
