"""The limits of a notebook's parameters: what a reader may put in place of its defaults."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from zwfs import _check


@dataclass(frozen=True)
class Fields:
    """Limits of a mapping of arguments to values, any of which may be left out.

    Attributes
    ----------
    of : str
        Full name of the function or class with these arguments; its docstring gives their meanings.
    limits : dict
        Limits of each argument.
    kinds : dict of dict
        Limits of more arguments, by the value of the argument "kind"; the first kind is the default.
    """

    of: str
    limits: Mapping[str, Any] = field(default_factory=dict)
    kinds: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def of_kind(self, kind: str) -> dict[str, Any]:
        """Return the limits of all arguments of a kind."""
        return ({"kind": tuple(self.kinds), **self.kinds[kind]} if self.kinds else {}) | dict(self.limits)

    def every(self) -> dict[str, Any]:
        """Return the limits of the arguments of all kinds."""
        return {name: limit for kind in self.kinds or ("",) for name, limit in self.of_kind(kind).items()}


def check_parameters(values: Mapping[str, Any], /, **limits: Any) -> None:
    """Refuse parameters of the wrong type or out of range.

    A notebook calls it in the cell after its parameters, with literals, so that the limits can also be read
    without running it: ``check_parameters(globals(), n_screens=(1, 1000), rms=(0.0, 4.0), inputs=[(0.0, 4.0)])``.

    Parameters
    ----------
    values : mapping of str
        Parameters by name; it may hold more than those with limits.
    **limits
        What is allowed, by the name of the parameter. Either end of a range belongs to it.

        - ``(low, high)``, both int: an integer between them;
        - ``(low, high)``, one a float: a finite number between them;
        - a tuple of str: one of these;
        - ``str`` or ``bool``: any text, or True or False;
        - ``[limits]``: a list of one or more values, each within the limits;
        - ``[limits, ...]``: the same, or an empty list;
        - `Fields`: a mapping of known names to values within their limits.

    Raises
    ------
    TypeError
        If a value is of another type, or limits have none of these forms.
    ValueError
        If a value is out of range, or there is no value for a name.

    Examples
    --------
    >>> from zwfs.companion.parameters import check_parameters
    >>> check_parameters({"n_screens": 20, "rms": 0.5}, n_screens=(1, 1000), rms=(0.0, 4.0))
    """
    for name, limit in limits.items():
        if name not in values:
            raise ValueError(f"{name} has limits but no value: expected a parameter of that name")
        _check_value(name, values[name], limit)


@contextmanager
def within(path: str, names: Iterable[str]) -> Iterator[None]:
    """Put the path of a nested parameter before the errors of the code that takes its values.

    Parameters
    ----------
    path : str
        Path of the parameter.
    names : iterable of str
        Names of its values, with which an error may begin.

    Examples
    --------
    >>> from zwfs.companion.parameters import within
    >>> with within("pupil", ["gap"]):
    ...     raise ValueError("gap = 2: expected less")
    Traceback (most recent call last):
    ValueError: pupil.gap = 2: expected less
    """
    try:
        yield
    except (TypeError, ValueError) as error:
        message = str(error)
        begins = message.startswith(tuple(f"{name} " for name in names))
        raise type(error)(f"{path}{'.' if begins else ': '}{message}") from None


def _check_value(name: str, value: Any, limit: Any) -> None:
    match limit:
        case type() if limit in (str, bool):
            if not isinstance(value, limit):
                raise TypeError(f"{name} = {value!r}: expected {'a text' if limit is str else 'True or False'}")
        case [within, *more] if isinstance(limit, list) and more in ([], [...]):
            if not isinstance(value, list | tuple):
                raise TypeError(f"{name} = {value!r}: expected a list")
            if not value and not more:
                raise ValueError(f"{name} = {value!r}: expected at least one value")
            for index, item in enumerate(value):
                _check_value(f"{name}[{index}]", item, within)
        case Fields():
            _check_fields(name, value, limit)
        case (str(), *_) if all(isinstance(choice, str) for choice in limit):
            if value not in limit:
                error = ValueError if isinstance(value, str) else TypeError
                raise error(f"{name} = {value!r}: expected one of {', '.join(map(repr, limit))}")
        case (int() as low, int() as high):
            _check.integer(name, value, low, high)
        case (float() | int() as low, float() | int() as high):
            _check.number(name, value, low, high)
        case _:
            raise TypeError(
                f"limits of {name} = {limit!r}: expected (low, high), strings, a type, or a list of one of these"
            )


def _check_fields(name: str, values: Any, fields: Fields) -> None:
    if not isinstance(values, Mapping):
        raise TypeError(f"{name} = {values!r}: expected a mapping, as in {{{', '.join(fields.every())}}}")
    if "kind" in values and fields.kinds:
        _check_value(f"{name}.kind", values["kind"], tuple(fields.kinds))
    kind = values.get("kind", next(iter(fields.kinds), ""))
    known = fields.of_kind(kind)
    for key, value in values.items():
        if key not in known:
            similar = get_close_matches(str(key), known, n=1)
            expected = f"did you mean {similar[0]!r}?" if similar else f"expected one of {', '.join(known)}"
            raise ValueError(
                f"unknown parameter {f'{name}.{key}'!r}{f' of kind {kind!r}' if kind else ''}: {expected}"
            )
        _check_value(f"{name}.{key}", value, known[key])
