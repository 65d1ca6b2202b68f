"""The paper's claims: their table, with measured values and verdicts, and the rules that give these."""

import ast
import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, StrictUndefined, UndefinedError
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.errors import ExtensionError

from book._tools.notebook import glued_texts

HOLDS, PARTLY, FAILS, UNTESTED = "holds", "holds in part", "does not hold", "not testable here"
# The signs differ in shape, for readers who do not see the colours.
SIGNS = {HOLDS: "✔", PARTLY: "◐", FAILS: "✘", UNTESTED: "○"}
REASONS = ("a part does not hold", "a number differs", "the paper leaves a condition open")  # of `PARTLY`
STUDIES = Path(__file__).parents[2] / "notebooks" / "studies"
BENCHMARKS = Path(__file__).parents[2] / "tests" / "benchmarks"
PARTS = {"sensor": range(1, 7), "range": range(7, 14), "choices": range(14, 18), "bench": range(18, 22)}


def below(error: float) -> str:
    """Write an upper limit of a small error: one digit, rounded up."""
    exponent = math.floor(math.log10(error))
    digit = math.ceil(error / 10**exponent - 1e-9)
    if digit == 10:
        digit, exponent = 1, exponent + 1
    text = f"$10^{{{exponent}}}$" if digit == 1 else f"${digit}\\times10^{{{exponent}}}$"
    return f"at most {text}"


def listed(names: Sequence[str]) -> str:
    """Join names by commas, and the last by "and"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def sentence(text: str) -> str:
    """Begin a text with a capital."""
    return text[:1].upper() + text[1:]


RULES = Environment(undefined=StrictUndefined)
RULES.filters |= {"write": format, "below": below, "listed": listed, "sentence": sentence}
RULES.globals |= {
    "pi": math.pi,
    "performance": json.loads(Path(__file__).with_name("performance.json").read_text("utf-8")),
}


class ClaimError(ExtensionError):
    """A claim cannot be judged: its notebook does not glue the numbers that its rule needs."""


@dataclass(frozen=True)
class Finding:
    """Result of a rule."""

    verdict: str  # one of `HOLDS`, `PARTLY`, `FAILS` and `UNTESTED`
    measured: str = ""  # the measured values in words
    remark: str = ""  # the condition under which the claim holds, or the reason why it does not
    because: str = ""  # one of `REASONS` for `PARTLY`


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, in our words, and its rule: an entry of claims.yml."""

    number: int
    title: str
    section: str  # of the paper
    statement: str
    verdicts: list[dict[str, str]]  # the first whose condition applies; otherwise the claim holds
    source: str = ""  # the notebook that measures it, and the heading to link to: ``notebook#its-words``
    code: list[str] = field(default_factory=list)  # functions and classes in its study that compute its numbers
    rule: str = ""  # the conditions of the verdicts, in plain words
    given: dict[str, str] = field(default_factory=dict)  # names for expressions
    measured: str = ""  # template of the measured values
    timed: list[dict[str, str]] = field(default_factory=list)  # functions of the benchmarks that measure its times
    also: str = ""  # another notebook whose numbers the rule uses
    refined: list[str] = field(default_factory=list)  # functions in `kit/curves.py` that its code calls

    @property
    def notebook(self) -> str:
        """The name of the notebook; empty if the claim is not measured."""
        return self.source.partition("#")[0]


_KEPT = yaml.safe_load(Path(__file__).with_name("claims.yml").read_text("utf-8"))["claims"]
CLAIMS = [Claim(**entry) for entry in _KEPT]


def glued(notebook: Path) -> dict[str, float]:
    """Return the numbers that an executed notebook glued, by name."""
    if not notebook.exists():
        raise ClaimError(f"{notebook.parent.name}/{notebook.name} does not exist")
    numbers = {}
    for name, text in glued_texts(notebook).items():
        # Only numbers can judge; a glued string appears on the notebook's own page.
        with suppress(ValueError):
            numbers[name] = float(text)
    return numbers


def judge(claim: Claim, numbers: Mapping[str, Any]) -> Finding:
    """Judge a claim by the numbers of its notebook, see `glued`."""
    known = dict(numbers)

    def find(expression: str) -> Any:
        return RULES.compile_expression(expression, undefined_to_none=False)(known)

    try:
        for name, expression in claim.given.items():
            known[name] = find(expression)
        measured = RULES.from_string(claim.measured).render(known)
        for case in claim.verdicts:
            if find(case["if"]):
                remark = RULES.from_string(case.get("remark", "")).render(known)
                return Finding(case["verdict"], measured, remark, case.get("because", ""))
    except UndefinedError as error:
        needed = f"{error.message}: the notebook does not glue it"
        raise ClaimError(f"claim {claim.number}, {claim.notebook}: {needed}") from None
    return Finding(HOLDS, measured)


def findings(folder: Path) -> dict[int, Finding]:
    """Judge every claim by the executed notebooks in a folder."""
    names = {name for claim in CLAIMS for name in (claim.notebook, claim.also) if name}
    numbers: dict[str, dict[str, float]] = {"": {}}
    numbers |= {name: glued(folder / f"{name}.ipynb") for name in names}
    return {claim.number: judge(claim, numbers[claim.also] | numbers[claim.notebook]) for claim in CLAIMS}


def count(judged: dict[int, Finding]) -> str:
    """Return a line with the number of claims of each verdict."""
    numbers = Counter(finding.verdict for finding in judged.values())
    open_ones = sum(finding.because == REASONS[-1] for finding in judged.values())
    verdicts = {verdict: f"{_marked(verdict)}: {numbers[verdict]}" for verdict in SIGNS}
    counted = f"Of [{len(judged)} claims that we chose from the paper](claims.md): {', '.join(verdicts.values())}."
    return f"{counted} For {open_ones} of the {numbers[PARTLY]} that hold in part, {REASONS[-1]}."


def by_verdict(judged: dict[int, Finding]) -> str:
    """Return a list of the verdicts, with links to the rows of their claims."""
    groups: dict[tuple[str, str], list[str]] = {}
    for verdict in SIGNS:
        for reason in REASONS if verdict == PARTLY else ("",):
            groups[verdict, reason] = [
                f"[{one.number}\u00a0{one.title}](#claim-{one.number})"
                for one in CLAIMS
                if (judged[one.number].verdict, judged[one.number].because) == (verdict, reason)
            ]
    return "\n".join(
        f"- {_marked(verdict)}{f', {reason}' if reason else ''}: {', '.join(rows) or 'none'}"
        for (verdict, reason), rows in groups.items()
        if rows or not reason
    )


def table(judged: dict[int, Finding], numbers: range) -> str:
    """Return the table of some claims as MyST text."""
    header = ["claim", "the paper says", "measured here"]
    claims = (claim for claim in CLAIMS if claim.number in numbers)
    rows = [header, ["---"] * len(header), *(_row(claim, judged[claim.number]) for claim in claims)]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([":::{table}", ":class: claims", "", *lines, ":::"])


def _row(claim: Claim, finding: Finding) -> list[str]:
    verdict = _marked(finding.verdict)
    measured = [f"{sentence(finding.measured)}."] if finding.measured else []
    if finding.remark and finding.verdict == HOLDS:
        measured.append(finding.remark)
    elif finding.remark:  # what limits the claim comes first
        measured.insert(0, f"{SIGNS[finding.verdict]} {finding.remark}")
    if claim.notebook:
        address = claim.source.replace(claim.notebook, f"../notebooks/{claim.notebook}.ipynb")
        measured.append(f"*[{_title(claim.notebook)}]({address}), [code](#code-{claim.number})*")
        verdict = _marked(finding.verdict, f"(#rule-{claim.number})")
    return [
        f"[{claim.number}.]{{#claim-{claim.number}}} **{claim.title}** {verdict}"
        + (f": {finding.because}" if finding.because else ""),
        f"{claim.statement} *Section {claim.section}*",
        " ".join(measured),
    ]


def rules() -> str:
    """Return as MyST text, in one fold for each notebook, the rules of its claims and the code of its numbers."""
    text = ""
    for notebook in dict.fromkeys(claim.notebook for claim in CLAIMS if claim.notebook):
        text += f"::::{{dropdown}} Rules and numbers: {_title(notebook)}\n"
        text += ":class-container: d-print-none claim-code\n\n"
        code = f"../notebooks/studies/{notebook}.py"
        for claim in CLAIMS:
            if claim.notebook == notebook:
                ends = {"start-at": f"- number: {claim.number}", "end-before": f"- number: {claim.number + 1}"}
                row = f"[Claim {claim.number}](#claim-{claim.number})"
                text += f"(rule-{claim.number})=\n**{row}.** {claim.rule}\n\n"
                text += _include("_ext/claims.yml", language="yaml", **ends)
                text += f"(code-{claim.number})=\n"
                for timed in claim.timed:
                    file, options = timing_lines(**timed)
                    text += f"**Its times**, `tests/benchmarks/{timed['file']}`:\n\n" + _include(file, **options)
                files = {name: _defining(notebook, name) for name in claim.code}
                shown = " and ".join(f"`{file.removeprefix('../')}`" for file in dict.fromkeys(files.values()))
                text += f"**Code that computes its numbers**, {shown}:\n\n"
                for name, file in files.items():
                    text += _include(file, pyobject=name)
                if claim.refined:
                    text += "From `notebooks/studies/kit/curves.py`:\n\n"
                for function in claim.refined:
                    text += _include("../notebooks/studies/kit/curves.py", pyobject=function)
                text += f"**Its numbers**, the marked lines of `notebooks/studies/{notebook}.py`:\n\n"
                text += _include(code, **marked_lines(claim, (STUDIES / f"{notebook}.py").read_text("utf-8")))
                if claim.also:
                    text += f"The others are from [{_title(claim.also)}](../notebooks/{claim.also}.ipynb).\n\n"
        text += "**All numbers:**\n\n"
        text += _include(code, name=f"numbers-{notebook}", pyobject="numbers") + "::::\n\n"
    return text


def _defining(notebook: str, name: str) -> str:
    """Return the file that defines a function or class: the study, or the experiments that studies share."""
    own = re.search(rf"(?m)^(def|class) {name}\b", (STUDIES / f"{notebook}.py").read_text("utf-8"))
    return f"../notebooks/studies/{notebook if own else 'kit/experiments'}.py"


def marked_lines(claim: Claim, code: str) -> dict[str, str]:
    """Return the lines of a study that compute the numbers of a claim, as options of ``literalinclude``."""
    [function] = [
        one for one in ast.parse(code).body if isinstance(one, ast.FunctionDef) and one.name == "numbers"
    ]
    expressions = [*claim.given.values(), claim.measured]
    expressions += [text for case in claim.verdicts for text in (case["if"], case.get("remark", ""))]
    names = set(re.findall(r"[a-z]\w+", " ".join(expressions)))
    found = set()
    for number, line in enumerate(code.splitlines(), 1):
        if function.lineno <= number <= (function.end_lineno or 0):
            # A name as a key, of which a part may be filled in.
            keys = [re.sub(r"{\w+}", r"\\w*", key) for key in re.findall(r'"([\w{}]+)"(?::|\] =)', line)]
            if any(re.fullmatch(key, name) for key in keys for name in names):
                found.add(number)
    # And the lines of local names on them.
    lines = code.splitlines()
    used = set(re.findall(r"\w+", " ".join(re.sub(r'^ *\S*":', "", lines[number - 1]) for number in found)))
    for one in (one for one in function.body if found and isinstance(one, ast.Assign)):
        named = (name for target in one.targets for name in ast.walk(target) if isinstance(name, ast.Name))
        targets = {name.id for name in named if isinstance(name.ctx, ast.Store)}
        if targets & (used - {"mean", "rms"}):
            found |= set(range(one.lineno, (one.end_lineno or one.lineno) + 1))
    if not found:
        raise ClaimError(f"claim {claim.number}, {claim.notebook}: no line of its study computes its numbers")
    loops = [node for node in ast.walk(function) if isinstance(node, ast.For)]
    found |= {one.lineno for one in loops if found & set(range(one.lineno, (one.end_lineno or 0) + 1))}
    first, last = min(found), max(found)
    marked = ",".join(str(number - first + 1) for number in sorted(found))
    return {"lines": f"{first}-{last}", "emphasize-lines": marked}


def timing_lines(file: str, function: str, marks: str) -> tuple[str, dict[str, str]]:
    """Return the file and the options of ``literalinclude`` for a function of the benchmarks.

    Lines in which the pattern `marks` is found are emphasized.
    """
    code = (BENCHMARKS / file).read_text("utf-8")
    [found] = [one for one in ast.parse(code).body if getattr(one, "name", "") == function]
    lines = enumerate(code.splitlines()[found.lineno - 1 : found.end_lineno], 1)
    marked = [str(number) for number, line in lines if re.search(marks, line)]
    return f"../tests/benchmarks/{file}", {"pyobject": function, "emphasize-lines": ",".join(marked)}


def _include(file: str, **options: str) -> str:
    lines = "".join(f":{name}: {value}\n" for name, value in options.items())
    return f":::{{literalinclude}} {file}\n:lineno-match:\n{lines}:::\n\n"


def _title(notebook: str) -> str:
    """Return the text of a link to a notebook: the number of its figure in the paper, or its name."""
    figure = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(figure[1])}" if figure else notebook.replace("_", " ").capitalize()


def _marked(verdict: str, address: str = "") -> str:
    """Return a verdict with its sign, the class for its colour, and a link if it has an address in brackets."""
    return f"[{SIGNS[verdict]} {verdict}]{address}{{.verdict-{verdict.replace(' ', '-')}}}"


def add_substitutions(app: Sphinx, config: Config) -> None:
    """Define the tables of the claims, their number and rules, from the notebooks that the book shows."""
    judged = findings(Path(app.srcdir, config.executed_notebooks))
    added = {f"claims_{name}": table(judged, numbers) for name, numbers in PARTS.items()}
    added |= {"claims_count": count(judged), "claims_list": by_verdict(judged), "claims_rules": rules()}
    config.myst_substitutions = config.myst_substitutions | added


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the substitutions."""
    app.setup_extension("book._ext.cards")
    app.connect("config-inited", add_substitutions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
