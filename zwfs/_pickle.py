"""What travels to another process, and what is made again there."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from zwfs._arrays import read_only


def uncached_state(self: Any) -> dict[str, Any]:
    """State without the values of cached properties, to stand as ``__getstate__`` in a class.

    They are cheap to make again, and what was looked at before does not change the pickle.
    """
    kind = type(self)
    return {
        name: value
        for name, value in self.__dict__.items()
        if not isinstance(getattr(kind, name, None), cached_property)
    }


def read_only_state(self: Any, state: dict[str, Any]) -> None:
    """Restore a state with read-only arrays, as ``__setstate__`` of a class: a pickle forgets that they were."""
    self.__dict__.update({name: read_only(value) for name, value in state.items()})
