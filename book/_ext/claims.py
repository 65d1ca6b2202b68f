"""The paper's claims: their table, with measured values and verdicts, and the rules that give these."""

import json
import math
import re
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

HOLDS, NOTED, PARTLY = "holds", "holds, with a note", "holds in part"
FAILS, UNTESTED = "does not hold", "not testable here"
# The signs differ in shape, for readers who do not see the colours.
SIGNS = {HOLDS: "✔", NOTED: "◕", PARTLY: "◐", FAILS: "✘", UNTESTED: "○"}
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

    verdict: str  # a key of `SIGNS`
    measured: str = ""  # the measured values in words
    remark: str = ""  # the condition under which the claim holds, or the reason why it does not


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, in our words, and its rule: an entry of claims.yml."""

    number: int
    title: str
    section: str  # of the paper
    statement: str
    verdicts: list[dict[str, str]]  # the first whose condition applies; otherwise the claim holds
    source: str = ""  # the notebook that measures it, and the heading to link to: ``notebook#its-words``
    # The functions and classes that compute its numbers; those outside of its study with their file.
    code: list[str] = field(default_factory=list)
    rule: str = ""  # the conditions of the verdicts, in plain words
    given: dict[str, str] = field(default_factory=dict)  # names for expressions
    measured: str = ""  # template of the measured values
    also: str = ""  # another notebook whose numbers the rule uses

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
    values = dict(numbers)

    def find(expression: str) -> Any:
        return RULES.compile_expression(expression, undefined_to_none=False)(values)

    try:
        for name, expression in claim.given.items():
            values[name] = find(expression)
        measured = RULES.from_string(claim.measured).render(values)
        for case in claim.verdicts:
            if find(case["if"]):
                remark = RULES.from_string(case.get("remark", "")).render(values)
                return Finding(case["verdict"], measured, remark)
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


def by_verdict(judged: dict[int, Finding]) -> str:
    """Return a list of the verdicts, with their numbers and links to the rows of their claims."""
    lines = []
    for verdict in SIGNS:
        rows = [
            f"[{claim.number}\u00a0{claim.title}](#claim-{claim.number})"
            for claim in CLAIMS
            if judged[claim.number].verdict == verdict
        ]
        if rows:
            lines.append(f"- {_marked(verdict)}: {len(rows)} ({', '.join(rows)})")
    return "\n".join(lines)


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
        f"[{claim.number}.]{{#claim-{claim.number}}} **{claim.title}** {verdict}",
        f"{claim.statement} *Section {claim.section}*",
        " ".join(measured),
    ]


def rules() -> str:
    """Return as MyST text, in one fold for each notebook, the rules of its claims and the code of its numbers."""
    text = ""
    for notebook in dict.fromkeys(claim.notebook for claim in CLAIMS if claim.notebook):
        text += f"::::{{dropdown}} Rules and numbers: {_title(notebook)}\n"
        text += ":class-container: d-print-none claim-code\n\n"
        study = f"notebooks/studies/{notebook}.py"
        text += "".join(_rule(claim, study) for claim in CLAIMS if claim.notebook == notebook)
        text += f"**All numbers**, `{study}`:\n\n"
        text += _include(f"../{study}", name=f"numbers-{notebook}", pyobject="numbers") + "::::\n\n"
    return text


def _rule(claim: Claim, study: str) -> str:
    """Return the rule of a claim and the code of its numbers."""
    number = claim.number
    ends = {"language": "yaml", "start-at": f"- number: {number}"}
    if claim is not CLAIMS[-1]:
        ends["end-before"] = f"- number: {number + 1}"
    text = f"(rule-{number})=\n**[Claim {number}](#claim-{number}).** {claim.rule}\n\n"
    text += _include("_ext/claims.yml", **ends) + f"(code-{number})=\n**Code that computes its numbers:**\n\n"
    for path in claim.code:
        file, _, name = path.rpartition(" ")
        text += f"`{file or study}`\n\n" + _include(f"../{file or study}", pyobject=name)
    if claim.also:
        text += f"The others are from [{_title(claim.also)}](../notebooks/{claim.also}.ipynb).\n\n"
    return text


def _include(file: str, **options: str) -> str:
    lines = "".join(f":{name}: {value}\n" for name, value in options.items())
    return f":::{{literalinclude}} {file}\n:lineno-match:\n{lines}:::\n\n"


def _title(notebook: str) -> str:
    """Return the text of a link to a notebook: the number of its figure in the paper, or its name."""
    figure = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(figure[1])}" if figure else notebook.replace("_", " ").capitalize()


def _marked(verdict: str, address: str = "") -> str:
    """Return a verdict with its sign, the class for its colour, and a link if it has an address in brackets."""
    word = re.sub(r"\W+", "-", verdict)
    return f"[{SIGNS[verdict]} {verdict}]{address}{{.verdict-{word}}}"


def add_substitutions(app: Sphinx, config: Config) -> None:
    """Define the tables of the claims, their number and rules, from the notebooks that the book shows."""
    judged = findings(Path(app.srcdir, config.executed_notebooks))
    added = {f"claims_{name}": table(judged, numbers) for name, numbers in PARTS.items()}
    added |= {"claims_list": by_verdict(judged), "claims_rules": rules()}
    config.myst_substitutions = config.myst_substitutions | added


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the substitutions."""
    app.setup_extension("book._ext.cards")
    app.connect("config-inited", add_substitutions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
