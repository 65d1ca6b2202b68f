"""Parameters of a notebook, read without running it, and values for them from the command line and from files."""

import difflib
import inspect
import math
import re
from dataclasses import dataclass
from importlib import import_module
from pkgutil import resolve_name
from types import ModuleType, SimpleNamespace
from typing import Any

from nbformat import NotebookNode
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from studies.kit.parameters import Fields, check_parameters, example, typed

from .project import ToolError, one_line

# A unit is one of these behind the last comma of a parameter's comment; other words there belong to the meaning.
UNITS = ("rad", "rad rms", "lambda/D", "D", "D²/lambda", "nm", "m", "s", "Hz", "pixels", "electrons", "photons")
UNIT_NAMES = {"radian": "rad", "radian rms": "rad rms", "pixels rms": "pixels", "electrons rms": "electrons"}


class ParameterError(ToolError):
    """Refusal of a command line or of a value for a parameter; the message is one line."""

    status = 2

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


@dataclass(frozen=True)
class Parameter:
    """A parameter of a notebook; its comment is ``# meaning, unit``, without a unit for a pure number."""

    default: Any
    meaning: str
    unit: str
    limits: Any  # see `studies.kit.parameters.check_parameters`; None if the notebook gives none

    @property
    def kind(self) -> str:
        """Name of the type for a reader."""
        if isinstance(self.limits, Fields):
            return "mapping"
        depth, within = _unlisted(self.limits)
        return "list of " * depth + type(example(within)).__name__

    @property
    def allowed(self) -> str:
        """Limits in words for a reader."""
        _, limits = _unlisted(self.limits)
        if limits is None or isinstance(limits, type | Fields):
            return ""
        return ", ".join(limits) if isinstance(limits[0], str) else f"{limits[0]:g} to {limits[1]:.10g}"

    def fields(self) -> dict[str, "Parameter"]:
        """Return the values of a mapping as parameters, with meanings from the docstring of what takes them."""
        if not isinstance(self.limits, Fields):
            return {}
        of = resolve_name(self.limits.of)
        defaults = {name: argument.default for name, argument in inspect.signature(of).parameters.items()}
        documented = _documented(of)
        return {
            name: Parameter(defaults.get(name), *documented.get(name, ("", "")), limit)
            for name, limit in self.limits.every().items()
        }


def _documented(of: Any) -> dict[str, tuple[str, str]]:
    """Return meaning, in a sentence, and unit of each parameter in a docstring of numpydoc."""
    entries_by_name = {}
    entries = r"^([\w, ]+?)(?: : (.*))?\n((?:    .+\n?)+)"
    for names, kind, text in re.findall(entries, inspect.getdoc(of) or "", re.MULTILINE):
        sentence = re.split(r"(?<=\w)[.;:](?:\s|$)", " ".join(text.split()))[0]
        unit = kind.rpartition(",")[2].strip()
        for name in names.split(", "):
            entries_by_name[name] = sentence, unit if unit in UNITS else UNIT_NAMES.get(unit, "")
    return entries_by_name


def _unlisted(limits: Any) -> tuple[int, Any]:
    """Return how deep values are listed within some limits, and the limits of the single values."""
    depth = 0
    while isinstance(limits, list):
        depth, limits = depth + 1, limits[0]
    return depth, limits


def parameters(notebook: NotebookNode) -> dict[str, Parameter]:
    """Read the cell tagged ``parameters`` and the call of `check_parameters`."""
    limits = _limits(notebook)
    return {
        name: Parameter(
            _evaluated(value, np=SimpleNamespace(pi=math.pi)), *_meaning_and_unit(text), limits.get(name)
        )
        for name, (value, text) in assigned(notebook).items()
    }


def assigned(notebook: NotebookNode) -> dict[str, tuple[str, str]]:
    """Return value and comment of each parameter, as they are written in the cell tagged ``parameters``."""
    # Not at the top: it takes a second, and some commands need no parameters.
    from papermill.translators import papermill_translators

    python = papermill_translators.find_translator("python3", "python")
    cells = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    inspected = python.inspect(cells[0]) if cells else ()
    return {parameter.name: (parameter.default, parameter.help) for parameter in inspected}


def _evaluated(text: str, **names: Any) -> Any:
    """Return the value of an expression of literals and of some names."""
    try:
        return eval(text, {"__builtins__": {}, **names})
    except Exception:
        raise ParameterError(f"{text} is not a literal: it cannot be read without running it") from None


def _meaning_and_unit(comment: str) -> tuple[str, str]:
    """Split a comment; a remark behind a semicolon belongs to the meaning."""
    main, semicolon, remark = comment.partition(";")
    meaning, _, unit = main.rpartition(",")
    if unit.strip() not in UNITS:
        return (comment, "") if comment not in UNITS else ("", comment)
    return meaning + semicolon + remark, unit.strip()


def _limits(notebook: NotebookNode) -> dict[str, Any]:
    """Return the limits by the name of the parameter."""
    for cell in notebook.cells:
        if call := re.search(r"^check_parameters\(globals\(\),(.*)\)", cell.source, re.MULTILINE | re.DOTALL):
            return _evaluated(f"dict({call[1]})", dict=dict, str=str, bool=bool, study=study_of(notebook))
    return {}


def study_of(notebook: NotebookNode) -> ModuleType | None:
    """Return the module of `studies` that a notebook imports as ``study``; None if it imports none."""
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    named = re.search(r"^from studies import (\w+) as study$", code, re.MULTILINE)
    return import_module(f"studies.{named[1]}") if named else None


def joined(values: dict[str, Any], parameters: dict[str, Parameter]) -> dict[str, Any]:
    """Return values in which ``pupil.kind`` has replaced a field of `pupil`, the given one or else the default."""
    whole = dict(values)
    for name in values:
        parameter, dot, field = name.partition(".")
        if dot and parameter in parameters and isinstance(parameters[parameter].limits, Fields):
            others = whole.get(parameter, parameters[parameter].default)
            if isinstance(others, dict):
                whole[parameter] = others | {field: whole.pop(name)}
    return whole


def accept(values: dict[str, Any], parameters: dict[str, Parameter]) -> dict[str, Any]:
    """Check values, and return those that are not the defaults."""
    for name in values:
        if name not in parameters:
            raise ParameterError(f"unknown parameter {name!r}: {nearest(name, parameters)}")
        if parameters[name].limits is None:
            raise ParameterError(f"parameter {name!r} has no limits: add them to the notebook's check_parameters")
    try:
        check_parameters(values, **{name: parameters[name].limits for name in values})
    except (TypeError, ValueError) as error:
        raise ParameterError(str(error)) from None
    # In the order of the notebook: the order on the command line makes no difference.
    checked = {name: typed(values[name], parameters[name].limits) for name in parameters if name in values}
    return {name: value for name, value in checked.items() if value != parameters[name].default}


def accept_together(notebook: NotebookNode, values: dict[str, Any]) -> None:
    """Check all values of a notebook together."""
    if check := getattr(study_of(notebook), "CHECK_TOGETHER", None):
        try:
            check(**values)
        except (TypeError, ValueError, OSError) as error:
            raise ParameterError(str(error)) from None


def nearest(name: str, names: Any) -> str:
    """Suggest the known name that is most like a given one, or list all known names."""
    similar = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {similar[0]!r}?" if similar else f"expected one of {', '.join(names) or '(none)'}"


def load(text: str, origin: str) -> Any:
    """Read YAML 1.2: numbers, strings, lists and mappings."""
    yaml = YAML(typ="safe", pure=True)  # not the C parser: it reads YAML 1.1, in which yes is True and 010 is 8
    try:
        return yaml.load(text)
    except MarkedYAMLError as error:
        where = f", line {error.problem_mark.line + 1}" if "\n" in text else ""
        context = f" ({error.context})" if error.context else ""
        raise ParameterError(f"{origin}{where}: {error.problem}{context}") from None
    except (YAMLError, ValueError, RecursionError) as error:  # an odd character, too many digits, too deep lists
        raise ParameterError(f"{origin}: {error}") from None


def mapping(text: str, origin: str) -> dict[str, Any]:
    """Return the parameters that a file in YAML gives, by name."""
    values = load(text, origin)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ParameterError(f"{origin}: expected a mapping of names to values, as in 'n_screens: 50'")
    return values


def assignments(texts: list[str]) -> dict[str, Any]:
    """Return the parameters that texts of the form ``name=value`` give, the value in YAML."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ParameterError(f"-p {text}: expected name=value, as in n_screens=50")
        if name in values:
            raise ParameterError(f"-p {text}: {name!r} is given twice")
        values[name] = load(value, f"-p {text}")
    return values
