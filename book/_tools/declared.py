"""Parameters of a notebook, read without running it, and values for them from the command line and from files."""

import ast
import difflib
import inspect
import io
import math
import operator
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

from nbformat import NotebookNode
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, Event

from zwfs.companion.limits import LIMITS, TOGETHER
from zwfs.companion.parameters import Fields, check_parameters

from .project import ToolError, one_line

# A unit is one of these behind the last comma of a parameter's comment; other words there belong to the meaning.
UNITS = ("rad", "rad rms", "lambda/D", "D", "D²/lambda", "nm", "m", "s", "Hz", "pixels", "electrons", "photons")

UNIT_NAMES = {"radian": "rad", "radian rms": "rad rms", "pixels rms": "pixels", "electrons rms": "electrons"}

# Limits that are types.
TYPES = {"str": str, "bool": bool}


# Limits of the YAML of parameters: a list of 1000 numbers is half as long, and no list is nested more than twice.
LONGEST = 16384  # characters, read in a second
DEEPEST = 8
NOT_PLAIN = "tags (!), anchors (&), aliases (*), merges (<<) and directives (%) are not allowed; quote strings"


class ParameterError(ToolError):
    """Refusal of a command line or of a value for a parameter; the message is one line."""

    status = 2

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


@dataclass(frozen=True)
class Parameter:
    """A parameter of a notebook.

    Attributes
    ----------
    default : Any
        A literal.
    meaning, unit : str
        From the comment behind it, ``# meaning, unit``; the unit of a pure number is empty.
    limits : Any
        See `zwfs.companion.parameters.check_parameters`; None if the notebook gives none.
    """

    default: Any
    meaning: str
    unit: str
    limits: Any

    @property
    def kind(self) -> str:
        """Name of the type for a reader."""
        if isinstance(self.limits, Fields):
            return "mapping"
        depth, limits = 0, self.limits
        while isinstance(limits, list):
            depth, limits = depth + 1, limits[0]
        return "list of " * depth + type(_scalar(limits)).__name__

    @property
    def allowed(self) -> str:
        """Limits in words for a reader."""
        limits = self.limits
        while isinstance(limits, list):
            limits = limits[0]
        if limits is None or isinstance(limits, type | Fields):
            return ""
        return ", ".join(limits) if isinstance(limits[0], str) else f"{limits[0]:g} to {limits[1]:.10g}"

    def fields(self) -> dict[str, "Parameter"]:
        """Return the values of a mapping as parameters, with meanings from the docstring of what takes them."""
        if not isinstance(self.limits, Fields):
            return {}
        of = resolve_name(self.limits.of)
        defaults = {name: one.default for name, one in inspect.signature(of).parameters.items()}
        documented = _documented(of)
        return {
            name: Parameter(defaults.get(name), *documented.get(name, ("", "")), limit)
            for name, limit in self.limits.every().items()
        }


def _documented(of: Any) -> dict[str, tuple[str, str]]:
    """Return meaning, in a sentence, and unit of each parameter in a docstring of numpydoc."""
    found = {}
    for names, kind, text in re.findall(
        r"^([\w, ]+?)(?: : (.*))?\n((?:    .+\n?)+)", inspect.getdoc(of) or "", re.MULTILINE
    ):
        sentence = re.split(r"(?<=\w)[.;:](?:\s|$)", " ".join(text.split()))[0]
        unit = kind.rpartition(",")[2].strip()
        for name in names.split(", "):
            found[name] = sentence, unit if unit in UNITS else UNIT_NAMES.get(unit, "")
    return found


def _scalar(limits: Any) -> Any:
    """Return a value of the type that single values within some limits have."""
    if isinstance(limits, list):
        return _scalar(limits[0])
    if isinstance(limits, type):
        return limits()
    floats = [limit for limit in limits or () if isinstance(limit, float)]
    return floats[0] if floats else limits[0] if limits else None


def parameters(notebook: NotebookNode) -> dict[str, Parameter]:
    """Read the cell tagged ``parameters`` and the call of `check_parameters`.

    Raises
    ------
    ParameterError
        If a default or a limit is not a literal.
    """
    limits = _limits(notebook)
    return {
        name: Parameter(_literal(_expression(value)), *_meaning_and_unit(comment), limits.get(name))
        for name, (value, comment) in assigned(notebook).items()
    }


def assigned(notebook: NotebookNode) -> dict[str, tuple[str, str]]:
    """Return value and comment of each parameter, as they are written in the cell tagged ``parameters``."""
    source = next((c.source for c in notebook.cells if "parameters" in c.metadata.get("tags", ())), "")
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    return {
        target.id: (ast.get_source_segment(source, node.value), comments.get(node.end_lineno, ""))
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign)
        for target in node.targets
    }


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
        # A cell of another kind need not be Python: it may hold a command of the notebook.
        if cell.cell_type == "code" and f"{check_parameters.__name__}(" in cell.source:
            for node in ast.walk(ast.parse(cell.source)):
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == check_parameters.__name__:
                    limits = {}
                    for keyword in node.keywords:
                        # Without a name the keyword is a mapping: **LIMITS["fig03_dynamic_range"].
                        limits |= {keyword.arg: _limit(keyword.value)} if keyword.arg else _listed(keyword.value)
                    return limits
    return {}


def _listed(node: ast.expr) -> dict[str, Any]:
    """Return the limits that the package lists under a name: ``LIMITS["name"]``."""
    match node:
        case ast.Subscript(value=ast.Name(id="LIMITS"), slice=ast.Constant(value=name)) if name in LIMITS:
            return LIMITS[name]
    raise ParameterError(
        f"{ast.unparse(node)}: expected limits of zwfs.companion.limits, one of {', '.join(LIMITS)}"
    )


def _limit(node: ast.expr) -> Any:
    """Return limits, which are literals but for the types that stand for any text or truth value."""
    if isinstance(node, ast.List):
        return [_limit(item) for item in node.elts]
    return TYPES[node.id] if isinstance(node, ast.Name) and node.id in TYPES else _literal(node)


def _expression(value: str) -> ast.expr:
    # Of a value on several lines the parentheses may be missing.
    return ast.parse(f"({value})", mode="eval").body


def _literal(node: ast.expr) -> Any:
    """Evaluate a literal, in which np.pi may stand: -np.pi / 2, 0.3 * np.pi."""
    match node:
        case ast.Attribute(value=ast.Name(id="np"), attr="pi"):
            return math.pi
        case ast.List(elts=items):
            return [_literal(item) for item in items]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_literal(operand)
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as operation, right=right):
            return (operator.mul if isinstance(operation, ast.Mult) else operator.truediv)(
                _literal(left), _literal(right)
            )
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise ParameterError(
            f"{ast.unparse(node)} is not a literal: it cannot be read without running it"
        ) from None


def accept(given: dict[str, Any], known: dict[str, Parameter]) -> dict[str, Any]:
    """Check values, and return those that are not the defaults.

    Parameters
    ----------
    given : dict
        Values by name. An int may stand for a float, and becomes one.
    known : dict of Parameter
        The parameters of the notebook.

    Raises
    ------
    ParameterError
        If a name is unknown, or a value has another type or is out of the limits.
    """
    for name in given:
        if name not in known:
            raise ParameterError(f"unknown parameter {name!r}: {nearest(name, known)}")
        if known[name].limits is None:
            raise ParameterError(f"parameter {name!r} has no limits: add them to the notebook's check_parameters")
    try:
        check_parameters(given, **{name: known[name].limits for name in given})
    except (TypeError, ValueError) as error:
        raise ParameterError(str(error)) from None
    # In the order of the notebook: the order on the command line makes no difference.
    typed = {name: _typed(given[name], one.limits) for name, one in known.items() if name in given}
    return {name: value for name, value in typed.items() if value != known[name].default}


def accept_together(name: str, values: dict[str, Any]) -> None:
    """Check all values of a notebook together.

    Raises
    ------
    ParameterError
        If some of them contradict each other.
    """
    if name in TOGETHER:
        try:
            resolve_name(TOGETHER[name])(**values)
        except (TypeError, ValueError, OSError) as error:
            raise ParameterError(str(error)) from None


def nearest(name: str, known: Any) -> str:
    """Suggest the known name that is most like a given one, or list all known names."""
    similar = difflib.get_close_matches(str(name), known, n=1)
    return f"did you mean {similar[0]!r}?" if similar else f"expected one of {', '.join(known) or '(none)'}"


def _typed(value: Any, limits: Any) -> Any:
    """Return a checked value, with floats in place of integers where the limits are floats."""
    if isinstance(limits, Fields):
        return {name: _typed(one, limits.every()[name]) for name, one in value.items()}
    if isinstance(value, list):
        return [_typed(item, limits[0]) for item in value]
    return float(value) if isinstance(_scalar(limits), float) else value


def _whole(text: str) -> str:
    """Return a text with one character for each pair of surrogates, which JSON writes; half a pair raises."""
    whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
    whole.encode()
    return whole


class _Constructor(SafeConstructor):
    """Constructor that reads dates as strings: no parameter is a date."""

    def construct_scalar(self, node: Any) -> Any:
        """Return the text of a scalar."""
        value = super().construct_scalar(node)
        return _whole(value) if isinstance(value, str) else value


_Constructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def load(text: str, origin: str) -> Any:
    """Read plain YAML 1.2: numbers, strings, lists and mappings, without tags, anchors and merged mappings.

    Parameters
    ----------
    text : str
    origin : str
        The source of the text, for the error message.

    Raises
    ------
    ParameterError
        If the text is not plain YAML, is longer than `LONGEST`, or is nested deeper than `DEEPEST`.
    """
    if len(text) > LONGEST:
        raise ParameterError(f"{origin}: {len(text)} characters: expected at most {LONGEST}")
    yaml = YAML(typ="safe", pure=True)  # not the C parser: it reads YAML 1.1, in which yes is True and 010 is 8
    yaml.Constructor = _Constructor
    try:
        _check_plain(yaml.parse(text))
        return yaml.load(text)
    except MarkedYAMLError as error:
        where = f", line {error.problem_mark.line + 1}" if "\n" in text else ""
        context = f" ({error.context})" if error.context else ""
        raise ParameterError(f"{origin}{where}: {error.problem}{context}") from None
    except (YAMLError, ValueError) as error:  # an invalid character, or a number with too many digits
        raise ParameterError(f"{origin}: {error}") from None


def _check_plain(events: Iterator[Event]) -> None:
    """Refuse all other YAML while it is still a stream: a few characters can stand for gigabytes."""
    depth = 0
    for event in events:
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        _whole(getattr(event, "value", None) or "")
        special = any(getattr(event, name, None) for name in ("anchor", "tag", "tags", "version"))
        if special or isinstance(event, AliasEvent) or getattr(event, "value", None) == "<<":
            raise MarkedYAMLError(problem=NOT_PLAIN, problem_mark=event.start_mark)
        if depth > DEEPEST:
            problem = f"expected lists and mappings at most {DEEPEST} deep"
            raise MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


def mapping(text: str, origin: str) -> dict[str, Any]:
    """Return the parameters that a file in YAML gives, by name."""
    given = load(text, origin)
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ParameterError(f"{origin}: expected a mapping of names to values, as in 'n_screens: 50'")
    return given


def assignments(texts: list[str]) -> dict[str, Any]:
    """Return the parameters that texts of the form ``name=value`` give, the value in YAML."""
    given: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ParameterError(f"-p {text}: expected name=value, as in n_screens=50")
        if name in given:
            raise ParameterError(f"-p {text}: {name!r} is given twice")
        given[name] = load(value, f"-p {text}")
    return given
