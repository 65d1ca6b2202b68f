"""The limits of a notebook's parameters: what a reader may put in place of its defaults."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from difflib import get_close_matches
from math import inf
from numbers import Integral, Real
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Fields:
    """Limits of a mapping of arguments to values, any of which may be left out."""

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
    """Refuse parameters of the wrong type or out of range."""
    for name, limit in limits.items():
        if name not in values:
            raise ValueError(f"{name} has limits but no value: expected a parameter of that name")
        _check_value(name, values[name], limit)


@contextmanager
def within(path: str, names: Iterable[str]) -> Iterator[None]:
    """Put the path of a nested parameter before the errors of the code that takes its values."""
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
                raise TypeError(f"{name} = {value!r}: expected {'a string' if limit is str else 'True or False'}")
        case [each, *more] if isinstance(limit, list) and more in ([], [...]):
            if not isinstance(value, list | tuple):
                raise TypeError(f"{name} = {value!r}: expected a list")
            if not value and not more:
                raise ValueError(f"{name} = {value!r}: expected at least one value")
            for index, item in enumerate(value):
                _check_value(f"{name}[{index}]", item, each)
        case Fields():
            _check_fields(name, value, limit)
        case (str(), *_) if all(isinstance(choice, str) for choice in limit):
            if value not in limit:
                error = ValueError if isinstance(value, str) else TypeError
                raise error(f"{name} = {value!r}: expected one of {', '.join(map(repr, limit))}")
        case (float() | int() as low, float() | int() as high):
            _check_number(name, value, low, high)
        case _:
            raise TypeError(
                f"limits of {name} = {limit!r}: expected (low, high), strings, a type, or a list of one of these"
            )


def _check_number(name: str, value: Any, low: float, high: float) -> None:
    """Require a number within limits; integers as limits ask for an integer."""
    whole = isinstance(low, int) and isinstance(high, int)
    kind, range_ = ("an integer", f"[{low}, {high}]") if whole else ("a finite number", f"[{low:g}, {high:g}]")
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral if whole else Real):
        as_in = f", as in {int(value)}" if whole and isinstance(value, float) and value.is_integer() else ""
        raise TypeError(f"{name} = {value!r}: expected {kind if whole else 'a real number'}{as_in}")
    number: Any = value
    if not (low <= number <= high and abs(number) < inf):
        raise ValueError(f"{name} = {value!r}: expected {kind} in {range_}")


def _check_fields(name: str, values: Any, fields: Fields) -> None:
    if not isinstance(values, Mapping):
        raise TypeError(f"{name} = {values!r}: expected a mapping, as in {{{', '.join(fields.every())}}}")
    if "kind" in values and fields.kinds:
        _check_value(f"{name}.kind", values["kind"], tuple(fields.kinds))
    kind = values.get("kind", next(iter(fields.kinds), ""))
    limits = fields.of_kind(kind)
    for key, value in values.items():
        if key not in limits:
            similar = get_close_matches(str(key), limits, n=1)
            expected = f"did you mean {similar[0]!r}?" if similar else f"expected one of {', '.join(limits)}"
            raise ValueError(
                f"unknown parameter {f'{name}.{key}'!r}{f' of kind {kind!r}' if kind else ''}: {expected}"
            )
        _check_value(f"{name}.{key}", value, limits[key])


def typed(value: Any, limits: Any) -> Any:
    """Return a checked value, with floats in place of integers where the limits are floats."""
    if isinstance(limits, Fields):
        return {name: typed(field, limits.every()[name]) for name, field in value.items()}
    if isinstance(value, list):
        return [typed(item, limits[0]) for item in value]
    return float(value) if isinstance(example(limits), float) else value


def example(limits: Any) -> Any:
    """Return a value of the type that single values within some limits have: a float if one limit is a float."""
    if isinstance(limits, type):
        return limits()
    return next((limit for limit in limits or () if isinstance(limit, float)), limits[0] if limits else None)


_CUT = {"obstruction": (0.0, 0.9), "vanes": [[(-6.2832, 6.2832)], ...]}
_RINGS = _CUT | {"n_rings": (1, 50), "gap": (0.0, 0.1), "missing": [(1, 10000), ...], "stop": (0.1, 1.0)}
_BASIS = {"basis": ("zernike", "fourier", "hexagonal")}
_STRENGTH = {"d_over_r0": (0.0, 20.0)}
SETUP: dict[str, Any] = {
    "pupil": Fields(
        "studies.kit.setups.make_pupil",
        kinds={
            "circular": _CUT,
            "vlt": _CUT,
            "hexagonal": _RINGS,
            "keck": _RINGS,
            "elt": _RINGS,
            "seal": _RINGS,
            "file": {"file": str},
        },
    ),
    "screens": Fields(
        "studies.kit.setups.make_screens",
        _BASIS,
        {
            "power_law": {},
            "kolmogorov": _STRENGTH,
            "von_karman": {"outer_scale": (0.2, 1e5)} | _STRENGTH,
            "segments": {},
            "file": {"file": str},
        },
    ),
    "noise": Fields("studies.kit.setups.Noise", {"photons": (0.0, 1e12), "read_noise": (0.0, 1e6)}),
    "reconstructors": [str, ...],
}


_BENCH = {
    "n_pixels": (32, 1024),
    "extent": (1.0, 4.0),
    "n_rings": (1, 10),
    "gap": (0.0, 0.2),
    "missing": [(1, 1000), ...],
    "stop": (0.1, 1.0),
    "diameter": (0.1, 8.0),
    "phase": (0.01, 3.13),
    "illumination": (0.0, 1.9),
    "leakage": (0.0, 0.5),
    "focus_difference": (0.0, 0.01),
    "misregistration": (0.0, 10.0),
    "blur": (0.0, 20.0),
    "flux_imbalance": (-0.9, 0.9),
    "dimple_error": (-0.9, 10.0),
    "static": (0.0, 3.0),
    "quilting": (0.0, 3.0),
    "photons_per_image": (0.0, 1e18),
    "read_noise": (0.0, 1e6),
    "background": (0.0, 1e12),
    "seed": (0, 4294967295),
}


def bench_fields(*others: str) -> Fields:
    """Limits of the fields of the bench, but for those that are parameters of the notebook."""
    return Fields("zwfs.bench.model.Bench", {name: limit for name, limit in _BENCH.items() if name not in others})


USUAL = {
    "n_pixels": (16, 1024),
    "n_modes": (1, 1000),
    "diameter": (0.1, 8.0),
    "phase_shift": (0.01, 3.13),
    "rms": (0.0, 4.0),
    "rms_max": (0.05, 4.0),
    "n_rms": (2, 200),
    "rms_fine": [(0.0, 4.0), ...],
    "inputs": [(0.001, 4.0)],
    "n_screens": (1, 1000),
    "exponent": (-6.0, 0.0),
    "n_iterations": (1, 10000),
    "extent": (1.0, 8.0),
    "threshold": (0.001, 1.0),
}


def parameter_limits(usual: str = "", **own: Any) -> dict[str, Any]:
    """Limits of one notebook: the usual ones of the named parameters, its own ones, and those of the seed."""
    return {name: USUAL[name] for name in usual.split()} | own | {"seed": (0, 4294967295)}
