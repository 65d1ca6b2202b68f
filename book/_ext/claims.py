"""The paper's claims, each judged by a rule from the numbers of a notebook, and their table."""

import json
import math
import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import yaml
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.errors import ExtensionError

from book._tools.notebook import glued_texts

HOLDS, REMARK, FAILS, UNTESTED = "holds", "holds with a remark", "does not hold", "not to be tested here"
# The signs differ in shape, for readers who do not see the colours.
SIGNS = {HOLDS: "✔", REMARK: "◐", FAILS: "✘", UNTESTED: "○"}

ROUNDING = 1e-12  # an identity must hold to this; the notebooks give no smaller errors

# The page that treats a section of the paper.
SECTIONS = {
    "2.1": "sensor.md#two-wave-interference",
    "2.2": "phase_shifted.md#phase-diversity-with-two-masks",
    "2.3": "phase_shifted.md#the-vector-sensor",
    "4.1": "theory.md#reconstruction-errors",
    "4.2": "phase_shifted.md#phase-diversity-with-two-masks",
    "5.2": "phase_shifted.md#the-vector-sensor",
}


class ClaimError(ExtensionError):
    """A claim cannot be judged: its notebook does not glue the numbers that its rule needs."""


@dataclass(frozen=True)
class Finding:
    """Result of a rule."""

    verdict: str  # one of `HOLDS`, `REMARK`, `FAILS` and `UNTESTED`
    measured: str = ""  # the measured values in words
    remark: str = ""  # the condition under which the claim holds, or the reason why it does not


Numbers = SimpleNamespace  # that a notebook glued
Rule = Callable[[Numbers], Finding]
RULES: dict[int, Rule] = {}


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, in our words, and its rule."""

    number: int
    section: str  # of the paper
    statement: str
    rule: Rule
    source: str = ""  # the notebook that measures it, and the heading to link to: ``notebook#its-words``

    @property
    def notebook(self) -> str:
        """The name of the notebook; empty if the claim is not measured."""
        return self.source.partition("#")[0]


def rule(number: int) -> Callable[[Rule], Rule]:
    """Decorate the rule of a claim of claims.yml."""

    def add(function: Rule) -> Rule:
        RULES[number] = function
        return function

    return add


def first(measured: str, *cases: tuple[bool, str, str] | tuple[bool, str]) -> Finding:
    """Return the finding of the first case that applies: condition, verdict, remark. Otherwise the claim holds."""
    for applies, verdict, *remark in cases:
        if applies:
            return Finding(verdict, measured, *remark)
    return Finding(HOLDS, measured)


@rule(1)
def two_waves(n: Numbers) -> Finding:
    error = n.dimple_two_wave_error
    return first(f"the two sides differ by {below(error)} of the mean intensity", (error > ROUNDING, FAILS))


@rule(2)
def any_patch(n: Numbers) -> Finding:
    measured = (
        f"for an uneven patch the two sides differ by {below(n.patch_two_wave_error)}, and the low-rank model "
        f"differs from a direct sum by {below(n.patch_model_error)}"
    )
    return first(measured, (max(n.patch_two_wave_error, n.patch_model_error) > ROUNDING, FAILS))


@rule(3)
def common_approximation(n: Numbers) -> Finding:
    """'Satisfactory' in the paper is an error of 5 %, of the wave and of a phase estimated with it."""
    steps = {0.1: n.step_error_01, 0.3: n.step_error_03, 0.5: n.step_error_05}
    worst = max(error / rms for rms, error in steps.items())
    measured = (
        f"if the amplitude is scaled instead, the error of the wave is {n.wave_error_01:.1%} at 0.1 rad rms and "
        f"{n.wave_error_05:.1%} at 0.5. After one step the phase has an error of up to {worst:.0%} of the input"
    )
    literal = (
        f"With the intensity scaled, the amplitude is off by {n.literal_amplitude_error_05:.1%} at 0.5 rad rms."
    )
    close = "The wave is not accurate enough."
    return first(
        measured,
        (n.wave_error_01 > 0.05, FAILS, literal),
        (worst > 0.05, REMARK, f"{close} {literal}"),
    )


@rule(4)
def determinant(n: Numbers) -> Finding:
    measured = (
        f"the determinant differs from the sine by {below(n.determinant_error)}, and the difference of the phases "
        f"from $(\\theta_b-\\theta_a)/2$, modulo $\\pi$, by {below(n.half_difference_error)} rad"
    )
    modulo = (
        f"A multiple of $\\pi$, which the paper omits, occurs for {n.pairs_off_by_pi:.0%} of the pairs. It does "
        "not change the inversion."
    )
    return first(
        measured,
        (max(n.determinant_error, n.half_difference_error) > ROUNDING, FAILS),
        (n.pairs_off_by_pi > 0, REMARK, modulo),
    )


@rule(5)
def diversity(n: Numbers) -> Finding:
    measured = (
        f"$\\lvert\\det M\\rvert$ is {below(n.diversity_at_0)} at a difference of 0, and largest, "
        f"{n.largest_diversity:.3f}, at {n.best_difference / math.pi:.2f} $\\pi$"
    )
    right = n.diversity_at_0 <= ROUNDING and math.isclose(n.best_difference, math.pi, abs_tol=1e-3)
    return first(measured, (not right, FAILS))


@rule(6)
def whole_circle(n: Numbers) -> Finding:
    measured = (
        f"with the true reference waves, two images recover phases up to {n.largest_phase:.1f} rad with an error "
        f"of {below(n.true_wave_error)} rad, and one image with {n.one_image_error:.2f} rad rms"
    )
    return first(measured, (n.true_wave_error > ROUNDING, FAILS))


@rule(7)
def arcsine(n: Numbers) -> Finding:
    """'about 0.3' is 0.2 to 0.4 rad rms."""
    measured = (
        f"up to 0.3 rad rms the error of the arcsine is at most {n.arcsine_over_linear:.0%} of the linear one. "
        f"It exceeds 5 % of the input above about {n.arcsine_limit:.2f} rad rms, and is "
        f"{n.arcsine_ratio_at_05:.0%} of it at 0.5"
    )
    worse = "It does not beat the linear reconstructor everywhere below 0.3 rad rms."
    return first(
        measured,
        (n.arcsine_over_linear >= 1, FAILS, worse),
        (not 0.2 <= n.arcsine_limit <= 0.4, REMARK, "It fails above another input than in the paper."),
    )


@rule(8)
def dynamic_range(n: Numbers) -> Finding:
    """Every non-linear method with two images, or some of them."""
    limits = {
        "phase-shifted": n.shifted_limit,
        "gradient descent": n.descent_limit,
        "Gerchberg-Saxton": n.saxton_limit,
    }
    gains = {name: limit / n.linear_limit for name, limit in limits.items()}
    short = [name for name, gain in gains.items() if gain <= 10]
    reached = [f"{name} {limits[name]:.1f} (about {gain:.0f} times)" for name, gain in gains.items() if gain]
    never = [f"{name} never stays within 5 %" for name, gain in gains.items() if not gain]
    repaired = f"Gerchberg-Saxton with the modelled field reaches {n.saxton_model_limit:.2f}"
    linear = f"limits in rad rms: linear {n.linear_limit:.3f}"
    measured = "; ".join([", ".join([linear, *reached]), *never, repaired])
    return first(
        measured,
        (len(short) == len(gains), FAILS),
        (bool(short), REMARK, f"Not for {' and '.join(short)} as we read the paper."),
    )


@rule(9)
def saxton_offset(n: Numbers) -> Finding:
    """An offset at 0.1 rad that falls as the lost light does, and to a tenth if that light is not taken as 0."""
    measured = (
        f"at 0.1 rad rms the error is {n.saxton_error:.3f} rad on a detector of {n.saxton_extent:.0f} D, which "
        f"loses {n.light_lost:.0%} of the light. It is {n.saxton_widest_error:.4f} rad on a detector of "
        f"{n.saxton_widest_extent:.0f} D, which loses {n.light_lost_widest:.0%}, and at most "
        f"{max(n.saxton_model_error, 1e-4):.4f} rad on 1 D if the modelled field is kept"
    )
    explained = (
        n.saxton_widest_error < n.saxton_error
        and n.light_lost_widest < n.light_lost
        and n.saxton_model_error < 0.1 * n.saxton_error
    )
    grows = f"The offset grows with the input, to {n.saxton_error_at_05:.2f} rad at 0.5 rad rms."
    return first(
        measured,
        (n.saxton_error <= 0.05 * 0.1, FAILS, "The error at 0.1 rad rms is below 5 % of the input."),
        (not explained, FAILS, "The lost light does not explain the offset."),
        (n.saxton_error_at_05 > 2 * n.saxton_error, REMARK, grows),
    )


@rule(10)
def alike(n: Numbers) -> Finding:
    """Passes through the model stand for time, which depends on the machine."""
    measured = (
        f"the errors of both are below $10^{{-6}}$ rad up to {n.alike_up_to:.1f} rad rms. For one screen at 0.5 "
        f"rad rms, the iteration takes {n.shifted_passes:.0f} passes through the model, descent "
        f"{n.descent_passes:.0f}"
    )
    caught = (
        f"At 1 rad rms, descent on modes recovers {n.modes_recovered_at_1:.0%} of the screens, on every point "
        f"{n.points_recovered_at_1:.0%}, and on modes from a phase-shifted start {n.started_recovered_at_1:.0%}."
    )
    return first(
        measured,
        (n.alike_up_to < 0.5, FAILS, "They do not perform alike."),
        (n.shifted_passes >= n.descent_passes, FAILS, "Gradient descent does not take more work."),
        (n.modes_recovered_at_1 < 1, REMARK, caught),
    )


@rule(11)
def wraps(n: Numbers) -> Finding:
    """The input at which half of the screens have wraps is 'around 1' within 0.2."""
    measured = (
        f"the share of screens that reach beyond $\\pm\\pi$ is {n.wrapped_screens_at_05:.0%} at 0.5 rad rms, "
        f"half at {n.wrap_onset:.1f}, and {n.wrapped_screens_at_1:.0%} at 1"
    )
    remark = f"On our screens the wraps begin {'earlier' if n.wrap_onset < 1 else 'later'}."
    return first(
        measured,
        (not 0.5 <= n.wrap_onset <= 1.5, FAILS),
        (not 0.8 <= n.wrap_onset <= 1.2, REMARK, remark),
    )


@rule(12)
def reach(n: Numbers) -> Finding:
    """'about 1' is 0.8 to 1.2 rad rms."""
    measured = (
        f"{n.recovered_at_1:.0%} of the screens are recovered at 1 rad rms (Strehl ratio {n.strehl_at_1:.2f}). "
        f"The mean error exceeds 5 % above about {n.shifted_limit:.1f} rad rms (Strehl ratio about "
        f"{n.strehl_at_limit:.1f})"
    )
    return first(
        measured,
        (n.shifted_limit < 0.8, FAILS, "On our screens the range ends earlier."),
        (
            n.shifted_limit > 1.2,
            REMARK,
            "The flat start of the iteration causes its limit, not the weak wave: the accelerated iteration and "
            "maximum likelihood [recover larger inputs](../notebooks/beyond_range.ipynb).",
        ),
    )


@rule(13)
def real_time(n: Numbers) -> Finding:
    """The paper's reason is tested; speed depends on the machine, and a verdict must not."""
    calls = f"{n.fourier_functions:.0f} functions" if n.fourier_functions else "no function"
    kept = json.loads(Path(__file__).with_name("performance.json").read_text("utf-8"))
    wanted = {"n_pixels": 100, "dtype": "float32", "accelerate": True, "n_iterations": 3}
    fast = next(row for row in kept["speed"]["real time"] if wanted.items() <= row.items())
    measured = (
        f"the reconstructors call {calls} for Fourier transforms. On one core ({kept['machine']}), "
        f"{fast['n_iterations']} accelerated phase-shifted iterations at {fast['n_pixels']} pixels across run "
        f"{fast['rate']:.0f} times per second, with a median error of {fast['median error']:.1g} rad"
    )
    remark = (
        f"The reason does not hold: {n.rank:.0f} coefficients describe the reference waves. The speed depends on "
        "the machine ([performance](performance.md))."
    )
    return first(measured, (not n.fourier_functions, FAILS, remark))


@rule(14)
def pairs(n: Numbers) -> Finding:
    """A pair works if the error of the iteration is below a thousandth of a radian."""
    measured = (
        f"of {n.n_allowed + n.n_singular:.0f} pairs, the {n.n_singular:.0f} with equal shifts or a shift of 0 "
        f"fail. The others have an error of {below(n.error_max_allowed_pairs)} rad at 0.5 rad rms"
    )
    return first(
        measured,
        (n.error_max_allowed_pairs > 1e-3 or not n.singular_as_expected, FAILS),
        (not n.zero_works, REMARK, "No pair with a shift of 0 works."),
    )


@rule(15)
def best_pair(n: Numbers) -> Finding:
    """Best means that no other pair has less noise by more than 2 %."""
    gains = {
        "photon noise on a flat wavefront": 1 - n.best_noise / n.noise_at_half_pi,
        "photon noise of the iteration at 0.5 rad rms": 1 - n.best_noise_aberrated / n.noise_at_half_pi_aberrated,
        "the information bound there": 1 - n.best_noise_bound / n.noise_at_half_pi_bound,
        "read noise": 1 - n.best_noise_read / n.noise_at_half_pi_read,
    }
    listed = ", by ".join(f"{gain:.0%} for {name}" for name, gain in gains.items())
    better = [name for name, gain in gains.items() if gain > 0.02]
    remark = (
        "It holds where the noise does not depend on the light. With photon noise and a flat wavefront, "
        f"$\\pm{n.best_pi:.1f}\\pi$ is better."
    )
    return first(
        f"the best pair has less noise than $\\pm\\pi/2$ by {listed}",
        (len(better) == len(gains), FAILS),
        (bool(better), REMARK, remark),
    )


@rule(16)
def diameter(n: Numbers) -> Finding:
    """'about 2.2' is 2.0 to 2.4, 'drastically' more than ten times."""
    measured = (
        f"the mean error exceeds 5 % of the input above about {n.diameter_5_percent:.1f} $\\lambda/D$. It grows "
        f"by a factor of about {round(n.error_at_26 / n.error_at_20, -2):.0f} from 2.0 to 2.6 $\\lambda/D$"
    )
    drastic = n.error_at_26 > 10 * n.error_at_20 and 2.0 <= n.diameter_5_percent <= 2.4
    slow = (
        f"With 400 iterations it is {n.diameter_5_percent_400:.1f}. Around a flat wavefront the iteration "
        f"converges slowly up to {n.contraction_crosses_1:.2f} $\\lambda/D$ and diverges above."
    )
    return first(
        measured,
        (not drastic, FAILS),
        (n.diameter_5_percent_400 - n.diameter_5_percent > 0.05, REMARK, slow),
    )


@rule(17)
def others_alike(n: Numbers) -> Finding:
    """The same behaviour is an error that grows more than ten times from 2.0 to 2.6."""
    ratios = {
        "linear": n.claim17_linear_ratio,
        "arcsine": n.claim17_arcsine_ratio,
        "Gerchberg-Saxton": n.claim17_saxton_ratio,
        "gradient descent on modes": n.claim17_descent_ratio,
        "gradient descent on points": n.claim17_descent_points_ratio,
    }
    listed = ", ".join(f"{name} {ratio:.{0 if ratio >= 10 else 1}f}" for name, ratio in ratios.items())
    *others, last = [name for name, ratio in ratios.items() if ratio <= 10] or [""]
    other = f"{', '.join(others)} and {last}" if others else last
    return first(
        f"ratio of the error at 2.6 $\\lambda/D$ to that at 2.0: {listed}",
        (
            bool(other),
            FAILS,
            f"{other[:1].upper()}{other[1:]} behave differently. The paper may mean methods with two images.",
        ),
    )


@rule(18)
def focus_shift(n: Numbers) -> Finding:
    """The optics themselves are not simulated, only the shift of focus that they cause."""
    measured = (
        f"on the simulated bench such a shift, alone, causes a gain of {n.gain_focus_difference:.2f} and an "
        f"offset of {n.offset_focus_difference:.4f} rad rms"
    )
    return Finding(
        UNTESTED,
        measured,
        "Whether real masks shift the focus is a question of hardware.",
    )


@rule(19)
def leakage(n: Numbers) -> Finding:
    """A gain below 1 by more than 1 %, and lower for more leakage."""
    measured = (
        f"on the simulated bench, at 0.3 rad rms, leakage of 3 % alone causes a gain of {n.gain_leakage:.2f}, and "
        f"leakage of 10 % a gain of {n.gain_leakage_10:.2f}"
    )
    return first(measured, (not n.gain_leakage_10 < n.gain_leakage < 0.99, FAILS))


@rule(20)
def on_the_bench(n: Numbers) -> Finding:
    """Alike within a third; twice the range; at a flat command ten times the error of the linear method."""
    end = "at least " if n.reach_shifted >= n.largest_input else ""
    measured = (
        f"on the simulated bench, from 0.3 rad rms on, the error of the arcsine is {n.arcsine_over_linear:.2f} "
        "times that of the linear method. The error stays below a quarter of the input up to "
        f"{n.reach_linear:.1f} rad rms (linear) and {end}{n.reach_shifted:.1f} (phase-shifted). At a flat command "
        f"the phase-shifted error is {n.offset_shifted:.3f} rad"
    )
    right = 0.75 <= n.arcsine_over_linear <= 1.33 and n.reach_shifted >= 2 * n.reach_linear
    remark = (
        "The static aberration that we put in causes the offset. Gerchberg-Saxton with zero field does not extend "
        "the range."
    )
    return first(
        measured,
        (not right or n.offset_shifted <= 10 * n.offset_linear, FAILS),
        (n.reach_saxton <= n.reach_linear, REMARK, remark),
    )


@rule(21)
def next_steps(n: Numbers) -> Finding:
    """An announcement, which no measurement could contradict."""
    remark = "This is a plan, not a statement to test."
    return Finding(UNTESTED, remark=remark)


CLAIMS = [
    Claim(**claim, rule=RULES[claim["number"]])
    for claim in yaml.safe_load(Path(__file__).with_name("claims.yml").read_text("utf-8"))
]


def below(error: float) -> str:
    """Write a small error with one digit, rounded up: the notebooks give none below `ROUNDING`."""
    exponent = math.floor(math.log10(error))
    digit = math.ceil(error / 10**exponent - 1e-9)
    if digit == 10:
        digit, exponent = 1, exponent + 1
    text = f"$10^{{{exponent}}}$" if digit == 1 else f"${digit}\\times10^{{{exponent}}}$"
    return f"at most {text}" if error <= ROUNDING else text


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


def judge(claim: Claim, numbers: dict[str, float]) -> Finding:
    """Judge a claim by the numbers of its notebook, see `glued`."""
    try:
        return claim.rule(Numbers(**numbers))
    except AttributeError as error:
        needed = f"the claim needs {error.name}: the notebook does not glue it"
        raise ClaimError(f"claim {claim.number}, {claim.notebook}: {needed}") from None


def findings(folder: Path) -> dict[Claim, Finding]:
    """Judge every claim by the executed notebooks in a folder."""
    numbers = {name: glued(folder / f"{name}.ipynb") for name in {claim.notebook for claim in CLAIMS} if name}
    return {claim: judge(claim, numbers.get(claim.notebook, {})) for claim in CLAIMS}


def count(judged: dict[Claim, Finding]) -> str:
    """Return a line with the number of claims of each verdict."""
    numbers = Counter(finding.verdict for finding in judged.values())
    listed = ", ".join(f"{numbers[verdict]} {_marked(verdict)}" for verdict in SIGNS if numbers[verdict])
    return f"The {len(judged)} claims of the paper: {listed}."


def table(judged: dict[Claim, Finding]) -> str:
    """Return the table of all claims as MyST text."""
    header = ["", "the paper says", "measured here", "verdict"]
    rows = [header, ["---"] * len(header), *(_row(claim, finding) for claim, finding in judged.items())]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([":::{table}", ":class: claims", "", *lines, ":::"])


def _row(claim: Claim, finding: Finding) -> list[str]:
    section = f"section {claim.section}"
    if page := SECTIONS.get(claim.section):
        section = f"[{section}]({page})"
    measured = [f"{finding.measured[:1].upper()}{finding.measured[1:]}."] if finding.measured else []
    measured += [finding.remark] if finding.remark else []
    if claim.notebook:
        address = claim.source.replace(claim.notebook, f"../notebooks/{claim.notebook}.ipynb")
        measured.append(f"*[{_title(claim.notebook)}]({address})*")
    return [str(claim.number), f"{claim.statement} *{section}*", " ".join(measured), _marked(finding.verdict)]


def _title(notebook: str) -> str:
    """Return the text of a link to a notebook: the number of its figure in the paper, or its name."""
    figure = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(figure[1])}" if figure else notebook.replace("_", " ").capitalize()


def _marked(verdict: str) -> str:
    """Return a verdict with its sign and the class for its colour."""
    return f"[{SIGNS[verdict]} {verdict}]{{.verdict-{verdict.replace(' ', '-')}}}"


def add_substitutions(app: Sphinx, config: Config) -> None:
    """Define ``{{ claims_table }}`` and ``{{ claims_count }}`` from the notebooks that the book shows."""
    judged = findings(Path(app.srcdir, config.executed_notebooks))
    added = {"claims_table": table(judged), "claims_count": count(judged)}
    config.myst_substitutions = config.myst_substitutions | added


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the substitutions."""
    app.setup_extension("book._ext.cards")
    app.connect("config-inited", add_substitutions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
