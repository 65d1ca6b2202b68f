"""The base of objects that cannot be changed: caches stay out of their pickles, and arrays stay read-only."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from zwfs._arrays import KEPT, read_only


class Immutable:
    """Object whose arrays are read-only, here and after a pickle.

    A pickle holds neither cached properties nor constants per kind of arrays. They are cheap to compute again, and
    the pickle of an object does not depend on its use.
    """

    def __getstate__(self) -> dict[str, Any]:
        kind = type(self)
        return {
            name: value
            for name, value in self.__dict__.items()
            if name != KEPT and not isinstance(getattr(kind, name, None), cached_property)
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: read_only(value) for name, value in state.items()})
