"""The base of objects that cannot be changed: caches stay out of their pickles, and arrays stay read-only."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, NoReturn

from zwfs._arrays import KEPT, read_only

_OPEN = "_open"  # attribute of an object while its constructor runs


class Immutable:
    """Object that cannot be changed once it is made: its arrays are read-only, here and after a pickle.

    A pickle holds neither cached properties nor constants per kind of arrays. They are cheap to compute again, and
    the pickle of an object does not depend on its use.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__init__" not in vars(cls):
            return
        construct: Callable[..., None] = cls.__init__

        @wraps(construct)
        def closing(self: Immutable, *arguments: Any, **named: Any) -> None:
            if _OPEN in vars(self):  # called by the constructor of a subclass, which may set more
                return construct(self, *arguments, **named)
            vars(self)[_OPEN] = True
            try:
                construct(self, *arguments, **named)
            finally:
                del vars(self)[_OPEN]

        cls.__init__ = closing  # type: ignore[assignment, method-assign]

    def __setattr__(self, name: str, value: Any) -> None:
        if _OPEN not in vars(self):
            self._refuse(name)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        self._refuse(name)

    def _refuse(self, name: str) -> NoReturn:
        raise AttributeError(f"{name}: a {type(self).__name__} cannot be changed; make another one")

    def __getstate__(self) -> dict[str, Any]:
        kind = type(self)
        return {
            name: value
            for name, value in self.__dict__.items()
            if name != KEPT and not isinstance(getattr(kind, name, None), cached_property)
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: read_only(value) for name, value in state.items()})
