"""The paper's claims, each with the rule that judges it by what the notebooks measured."""

import inspect
import json
import math
import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PAGE = "book/claims.md"

HOLDS, REMARK, FAILS, UNTESTED = "holds", "holds with a remark", "does not hold", "not to be tested here"
# The signs differ in shape, for those who do not see the colours.
SIGNS = {HOLDS: "✔", REMARK: "◐", FAILS: "✘", UNTESTED: "○"}

ROUNDING = 1e-12  # an identity must hold to this; the notebooks give no smaller errors, see their `at_least`

# The page that treats a section of the paper.
SECTIONS = {
    "2.1": "sensor.md#two-wave-interference",
    "2.2": "phase_shifted.md#phase-diversity-with-two-masks",
    "2.3": "phase_shifted.md#the-vector-sensor",
    "4.1": "theory.md#reconstruction-errors",
    "4.2": "phase_shifted.md#phase-diversity-with-two-masks",
    "5.2": "phase_shifted.md#the-vector-sensor",
}


class ClaimError(Exception):
    """A claim cannot be judged, as a notebook does not give what its rule asks for."""


@dataclass(frozen=True)
class Finding:
    """What a rule says.

    Parameters
    ----------
    verdict : str
        One of `HOLDS`, `REMARK`, `FAILS` and `UNTESTED`.
    measured : str
        The measured values in words.
    remark : str
        What has to be added, or why the claim does not hold.
    """

    verdict: str
    measured: str = ""
    remark: str = ""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, and how it is judged.

    Parameters
    ----------
    number : int
    section : str
        Where the paper says it.
    statement : str
        What it says, in our words.
    rule : callable
        Takes measured values by keyword, under the names that they were glued by, and gives a `Finding`.
    notebooks : tuple of str
        The notebooks that glue them; the page links to the first.
    anchor : str
        The heading in it to link to, as ``#its-words``.
    """

    number: int
    section: str
    statement: str
    rule: Callable[..., Finding]
    notebooks: tuple[str, ...] = ()
    anchor: str = ""


def two_waves(dimple_two_wave_error: float) -> Finding:
    """Claim 1."""
    verdict = HOLDS if dimple_two_wave_error <= ROUNDING else FAILS
    return Finding(verdict, f"the two sides differ by {below(dimple_two_wave_error)} of the mean intensity")


def any_patch(patch_two_wave_error: float, patch_model_error: float) -> Finding:
    """Claim 2."""
    measured = (
        f"for a patch of uneven phase and amplitude the two sides differ by {below(patch_two_wave_error)}, "
        f"the low-rank model and a direct sum over the patch by {below(patch_model_error)}"
    )
    exact = max(patch_two_wave_error, patch_model_error) <= ROUNDING
    return Finding(HOLDS if exact else FAILS, measured)


def common_approximation(
    wave_error_01: float,
    wave_error_05: float,
    step_error_01: float,
    step_error_03: float,
    step_error_05: float,
    literal_amplitude_error_05: float,
) -> Finding:
    """Claim 3: 5 % is what the paper calls satisfactory, of the wave and of a phase found with it."""
    steps = {0.1: step_error_01, 0.3: step_error_03, 0.5: step_error_05}
    measured = (
        f"with the amplitude scaled by the square root, the wave is off by {wave_error_01:.1%} at 0.1 rad rms "
        f"and by {wave_error_05:.1%} at 0.5; one step with it by "
        + ", ".join(f"{error / rms:.0%} at {rms:g}" for rms, error in steps.items())
        + " of the input"
    )
    literal = (
        f"With the intensity scaled by it, the amplitude is {literal_amplitude_error_05:.1%} off at 0.5 rad rms."
    )
    if wave_error_01 > 0.05:
        return Finding(FAILS, measured, literal)
    if all(error <= 0.05 * rms for rms, error in steps.items()):
        return Finding(HOLDS, measured)
    remark = "Close as a wave, but not good enough to reconstruct with, not even for small aberrations."
    return Finding(REMARK, measured, f"{remark} {literal}")


def determinant(determinant_error: float, half_difference_error: float, pairs_off_by_pi: float) -> Finding:
    """Claim 4."""
    measured = (
        f"the determinant differs from the sine by {below(determinant_error)}, and the difference of the "
        f"reference phases from half of that of the dimples, modulo $\\pi$, by {below(half_difference_error)} rad"
    )
    if max(determinant_error, half_difference_error) > ROUNDING:
        return Finding(FAILS, measured)
    if pairs_off_by_pi == 0:
        return Finding(HOLDS, measured)
    remark = f"Modulo $\\pi$, which the paper leaves out: {pairs_off_by_pi:.0%} of the pairs are off by $\\pi$."
    return Finding(REMARK, measured, remark)


def diversity(diversity_at_0: float, largest_diversity: float, best_difference: float) -> Finding:
    """Claim 5."""
    measured = (
        f"$\\lvert\\det M\\rvert$ is {below(diversity_at_0)} at a difference of 0, and largest, "
        f"{largest_diversity:.3f}, at {best_difference / math.pi:.2f} $\\pi$"
    )
    right = diversity_at_0 <= ROUNDING and math.isclose(best_difference, math.pi, abs_tol=1e-3)
    return Finding(HOLDS if right else FAILS, measured)


def whole_circle(largest_phase: float, true_wave_error: float, one_image_error: float) -> Finding:
    """Claim 6."""
    measured = (
        f"phases up to {largest_phase:.1f} rad come back with an error of {below(true_wave_error)} rad; "
        f"from one image, with the true wave as well, the error is {one_image_error:.2f} rad rms"
    )
    return Finding(HOLDS if true_wave_error <= ROUNDING else FAILS, measured)


def arcsine(arcsine_over_linear: float, arcsine_limit: float, arcsine_ratio_at_05: float) -> Finding:
    """Claim 7: 'about 0.3' is 0.2 to 0.4 rad rms."""
    measured = (
        f"up to 0.3 rad rms its error is at most {arcsine_over_linear:.0%} of the linear one; it leaves 5 % of "
        f"the input at {arcsine_limit:.2f} rad rms and reaches {arcsine_ratio_at_05:.0%} at 0.5"
    )
    if arcsine_over_linear >= 1:
        return Finding(FAILS, measured, "It does not beat the linear reconstructor everywhere below 0.3 rad rms.")
    if 0.2 <= arcsine_limit <= 0.4:
        return Finding(HOLDS, measured)
    return Finding(REMARK, measured, "It fails at another input than the paper says.")


def dynamic_range(linear_limit: float, shifted_limit: float, descent_limit: float, saxton_limit: float) -> Finding:
    """Claim 8: every non-linear method with two images, or some of them."""
    gains = {
        "phase-shifted": shifted_limit / linear_limit,
        "gradient descent": descent_limit / linear_limit,
        "Gerchberg-Saxton": saxton_limit / linear_limit,
    }
    measured = f"linear {linear_limit:.3f} rad rms; " + ", ".join(
        f"{name} {gain:.0f} times that" for name, gain in gains.items()
    )
    short = [name for name, gain in gains.items() if gain <= 10]
    if not short:
        return Finding(HOLDS, measured)
    if len(short) == len(gains):
        return Finding(FAILS, measured)
    return Finding(REMARK, measured, f"Not with {' and '.join(short)}.")


def saxton_offset(
    saxton_error_2: float,
    saxton_error_4: float,
    light_lost_2: float,
    light_lost_4: float,
    saxton_error_at_05: float,
) -> Finding:
    """Claim 9: an offset at 0.1 rad that falls as the light lost does."""
    measured = (
        f"at 0.1 rad rms {saxton_error_2:.3f} rad on a detector of 2 D, which loses {light_lost_2:.0%} of the "
        f"light, and {saxton_error_4:.3f} on one of 4 D, which loses {light_lost_4:.0%}"
    )
    if saxton_error_2 <= 0.05 * 0.1:
        return Finding(FAILS, measured, "There is no offset.")
    if saxton_error_4 >= saxton_error_2 or light_lost_4 >= light_lost_2:
        return Finding(FAILS, measured, "The lost light does not explain the offset.")
    if saxton_error_at_05 > 2 * saxton_error_2:
        remark = (
            f"No constant offset but a bias that grows with the input, to {saxton_error_at_05:.2f} rad at 0.5."
        )
        return Finding(REMARK, measured, remark)
    return Finding(HOLDS, measured)


def alike(
    alike_up_to: float,
    lost_screens_at_1: float,
    points_lost_at_1: float,
    shifted_passes: float,
    descent_passes: float,
) -> Finding:
    """Claim 10: passes through the model stand for time, which depends on the machine."""
    measured = (
        f"both below $10^{{-6}}$ rad up to {alike_up_to:.1f} rad rms; {shifted_passes:.0f} passes through the "
        f"model against {descent_passes:.0f}, for one screen at 0.5 rad rms"
    )
    if alike_up_to < 0.5:
        return Finding(FAILS, measured, "They do not perform alike.")
    if shifted_passes >= descent_passes:
        return Finding(FAILS, measured, "Gradient descent does not take more work.")
    if lost_screens_at_1 == 0:
        return Finding(HOLDS, measured)
    remark = (
        f"At 1 rad rms descent on modes is caught in local minima on {lost_screens_at_1:.0%} of the screens, "
        f"descent on every point on {points_lost_at_1:.0%}."
    )
    return Finding(REMARK, measured, remark)


def wraps(wrapped_screens_at_05: float, wrapped_screens_at_1: float, wrap_onset: float) -> Finding:
    """Claim 11: the input at which half of the screens have wraps is 'around 1' within 0.2."""
    measured = (
        f"{wrapped_screens_at_05:.0%} of the screens reach beyond $\\pm\\pi$ at 0.5 rad rms, "
        f"{wrapped_screens_at_1:.0%} at 1, half of them from {wrap_onset:.1f} on"
    )
    if 0.8 <= wrap_onset <= 1.2:
        return Finding(HOLDS, measured)
    if 0.5 <= wrap_onset <= 1.5:
        return Finding(REMARK, measured, f"They set in {'earlier' if wrap_onset < 1 else 'later'} on our screens.")
    return Finding(FAILS, measured)


def reach(shifted_limit: float, recovered_at_1: float, strehl_at_1: float, strehl_at_limit: float) -> Finding:
    """Claim 12: 'about 1' is 0.8 to 1.2 rad rms."""
    measured = (
        f"{recovered_at_1:.0%} of the screens are recovered at 1 rad rms (Strehl ratio {strehl_at_1:.2f}); the "
        f"mean error leaves 5 % at {shifted_limit:.1f} rad rms (Strehl ratio {strehl_at_limit:.2f})"
    )
    if shifted_limit < 0.8:
        return Finding(FAILS, measured, "It ends earlier.")
    if shifted_limit <= 1.2:
        return Finding(HOLDS, measured)
    remark = "It goes further, as far as there is light for the reference wave."
    return Finding(REMARK, measured, remark)


def real_time(fourier_functions: float, rank: float) -> Finding:
    """Claim 13: the reason that the paper gives; speed depends on the machine, and a verdict must not."""
    measured = f"functions for Fourier transforms that any reconstructor calls: {fourier_functions:.0f}"
    if fourier_functions:
        return Finding(HOLDS, measured)
    remark = (
        f"The reason falls: the reference waves are made of {rank:.0f} numbers. "
        "How fast that is depends on the machine: see [Performance](performance.md)."
    )
    return Finding(REMARK, measured, remark)


def pairs(
    n_allowed: float,
    n_singular: float,
    singular_as_expected: float,
    zero_works: float,
    error_max_allowed_pairs: float,
) -> Finding:
    """Claim 14: a pair works if the iteration leaves less than a thousandth of a radian."""
    measured = (
        f"of {n_allowed + n_singular:.0f} pairs {n_singular:.0f} are refused, those with equal shifts or with a "
        f"shift of 0; all others leave at most {below(error_max_allowed_pairs)} rad at 0.5 rad rms"
    )
    if error_max_allowed_pairs > 1e-3 or not singular_as_expected:
        return Finding(FAILS, measured)
    if zero_works:
        return Finding(HOLDS, measured)
    return Finding(REMARK, measured, "$(0, \\pi)$ is no special case: no pair with a shift of 0 works.")


def best_pair(
    best_theta_a: float,
    best_noise: float,
    noise_at_half_pi: float,
    best_noise_aberrated: float,
    noise_at_half_pi_aberrated: float,
    best_noise_read: float,
    noise_at_half_pi_read: float,
) -> Finding:
    """Claim 15: best means that no other pair has less noise by more than 2 %."""
    gains = {
        "photon noise, flat wavefront": 1 - best_noise / noise_at_half_pi,
        "photon noise, 0.5 rad rms": 1 - best_noise_aberrated / noise_at_half_pi_aberrated,
        "read noise": 1 - best_noise_read / noise_at_half_pi_read,
    }
    measured = "the best pair of the map has less noise than $\\pm\\pi/2$ by " + ", ".join(
        f"{gain:.0%} ({name})" for name, gain in gains.items()
    )
    better = [name for name, gain in gains.items() if gain > 0.02]
    if not better:
        return Finding(HOLDS, measured)
    if len(better) == len(gains):
        return Finding(FAILS, measured)
    remark = (
        f"Right where the noise does not depend on the light; with photon noise on a flat wavefront "
        f"$\\pm{abs(best_theta_a) / math.pi:.1f}\\pi$ is better."
    )
    return Finding(REMARK, measured, remark)


def diameter(
    error_at_20: float,
    error_at_26: float,
    diameter_5_percent: float,
    diameter_5_percent_400: float,
    contraction_crosses_1: float,
) -> Finding:
    """Claim 16: 'about 2.2' is 2.0 to 2.4, 'drastically' more than ten times."""
    measured = (
        f"the mean error passes 5 % of the input at {diameter_5_percent:.2f} $\\lambda/D$, and grows "
        f"{error_at_26 / error_at_20:.0f} times from 2.0 to 2.6"
    )
    if error_at_26 <= 10 * error_at_20 or not 2.0 <= diameter_5_percent <= 2.4:
        return Finding(FAILS, measured)
    if diameter_5_percent_400 - diameter_5_percent <= 0.05:
        return Finding(HOLDS, measured)
    remark = (
        f"With 400 iterations only from {diameter_5_percent_400:.2f} on: it is slowness, up to "
        f"{contraction_crosses_1:.2f} $\\lambda/D$, from where on the iteration diverges."
    )
    return Finding(REMARK, measured, remark)


def others_alike(
    claim17_linear_ratio: float,
    claim17_arcsine_ratio: float,
    claim17_saxton_ratio: float,
    claim17_descent_ratio: float,
    claim17_descent_points_ratio: float,
) -> Finding:
    """Claim 17: the same behaviour is an error that grows more than ten times from 2.0 to 2.6."""
    ratios = {
        "linear": claim17_linear_ratio,
        "arcsine": claim17_arcsine_ratio,
        "Gerchberg-Saxton": claim17_saxton_ratio,
        "gradient descent on modes": claim17_descent_ratio,
        "gradient descent on points": claim17_descent_points_ratio,
    }
    told = ", ".join(f"{name} {ratio:.{0 if ratio >= 10 else 1}f}" for name, ratio in ratios.items())
    measured = f"error at 2.6 over that at 2.0 $\\lambda/D$: {told}"
    other = [name for name, ratio in ratios.items() if ratio <= 10]
    if not other:
        return Finding(HOLDS, measured)
    return Finding(FAILS, measured, f"Not {', '.join(other)}: each has a reason of its own, see Figure 4.")


def focus_shift(gain_focus_difference: float, offset_focus_difference: float) -> Finding:
    """Claim 18: a statement on prisms that are not here; what it does can be told."""
    measured = (
        f"on the simulated bench such a shift, alone, makes the gain {gain_focus_difference:.2f} and an offset of "
        f"{offset_focus_difference:.4f} rad rms"
    )
    return Finding(UNTESTED, measured, "A fact of hardware, taken over as a parameter of the bench.")


def leakage(gain_leakage: float, gain_leakage_10: float) -> Finding:
    """Claim 19: a gain below 1 by more than 1 %, and the more so the more leakage."""
    measured = (
        f"leakage of 3 % alone makes a gain of {gain_leakage:.2f} at 0.3 rad rms, leakage of 10 % one of "
        f"{gain_leakage_10:.2f}"
    )
    return Finding(HOLDS if gain_leakage_10 < gain_leakage < 0.99 else FAILS, measured)


def on_the_bench(
    arcsine_over_linear: float,
    offset_linear: float,
    offset_shifted: float,
    reach_linear: float,
    reach_shifted: float,
    reach_saxton: float,
) -> Finding:
    """Claim 20: alike within a third; twice the reach; an offset ten times that of the linear method."""
    measured = (
        f"from 0.3 rad rms on the arcsine has {arcsine_over_linear:.2f} times the error of the linear method; "
        f"errors stay below a quarter of the input up to {reach_linear:.1f} (linear) and {reach_shifted:.1f} rad "
        f"rms (phase-shifted), whose offset is {offset_shifted:.3f} rad"
    )
    right = 0.75 <= arcsine_over_linear <= 1.33 and reach_shifted >= 2 * reach_linear
    if not right or offset_shifted <= 10 * offset_linear:
        return Finding(FAILS, measured)
    if reach_saxton > reach_linear:
        return Finding(HOLDS, measured)
    return Finding(
        REMARK, measured, "Gerchberg-Saxton, which loses light, does not extend the range in this sense."
    )


def next_steps() -> Finding:
    """Claim 21: an announcement, which nothing measured could contradict."""
    remark = (
        "A plan, and no statement to be tested. Here no Fourier transform is left in the way of speed, see 13."
    )
    return Finding(UNTESTED, remark=remark)


IDENTITIES, FIGURE_3, FIGURE_4 = ("identities",), ("fig03_dynamic_range",), ("fig04_dimple_diameter",)
PAIRS, BUDGET, FIGURE_9 = ("phase_shift_pairs",), ("error_budget",), ("fig09_bench_linearity",)

CLAIMS = (
    Claim(
        1,
        "2.1",
        "The intensity on the detector is that of two interfering waves: the incoming one and the reference.",
        two_waves,
        IDENTITIES,
        "#two-waves-and-any-patch",
    ),
    Claim(
        2,
        "2.1",
        "A patch of any complex transmission fits the same description.",
        any_patch,
        IDENTITIES,
        "#two-waves-and-any-patch",
    ),
    Claim(
        3,
        "2.1",
        "A common approximation: the phase of the reference wave is that for a flat wavefront, and its intensity "
        "is scaled by the square root of the Strehl ratio.",
        common_approximation,
        IDENTITIES,
        "#the-common-approximation",
    ),
    Claim(
        4,
        "2.2",
        "The determinant of the system is the sine of the difference of the reference phases, which for two "
        "dimples of one size is $(\\theta_b-\\theta_a)/2$ at every point.",
        determinant,
        IDENTITIES,
        "#the-determinant",
    ),
    Claim(
        5,
        "2.2",
        "There is no diversity for phase shifts that differ by 0, and the most of it for a difference of $\\pi$, "
        "modulo $2\\pi$.",
        diversity,
        IDENTITIES,
        "#the-determinant",
    ),
    Claim(
        6,
        "2.2",
        "With accurate reference waves the phase is found on the whole circle.",
        whole_circle,
        IDENTITIES,
        "#the-whole-circle",
    ),
    Claim(
        7,
        "4.1",
        "The iterative arcsine does better than the linear reconstructor, but fails from about 0.3 rad rms on.",
        arcsine,
        FIGURE_3,
        "#one-pupil-image-linear-and-arcsine",
    ),
    Claim(
        8,
        "4.1",
        "With 5 % of the input as the limit, the phase-shifted sensor with non-linear methods has more than ten "
        "times the range of the classic one with linear reconstruction.",
        dynamic_range,
        FIGURE_3,
        "#where-each-curve-leaves-the-threshold",
    ),
    Claim(
        9,
        "4.1",
        "Gerchberg-Saxton has a systematic offset, since some light falls beside the detector.",
        saxton_offset,
        FIGURE_3,
        "#the-offset-of-gerchberg-saxton",
    ),
    Claim(
        10,
        "4.1",
        "The phase-shifted iteration and gradient descent perform alike; gradient descent takes more time.",
        alike,
        FIGURE_3,
        "#two-pupil-images-the-range-and-where-it-ends",
    ),
    Claim(
        11,
        "4.1",
        "Phase wraps occur around 1 rad rms.",
        wraps,
        FIGURE_3,
        "#two-pupil-images-the-range-and-where-it-ends",
    ),
    Claim(
        12,
        "4.1",
        "The phase-shifted sensor can be pushed to about 1 rad rms; beyond, no useful reference beam is left.",
        reach,
        FIGURE_3,
        "#two-pupil-images-the-range-and-where-it-ends",
    ),
    Claim(
        13,
        "4.1",
        "The reconstructors do not suit real time, as they need several Fourier transforms.",
        real_time,
        FIGURE_3,
        "#what-it-costs",
    ),
    Claim(
        14,
        "4.2",
        "Any pair of phase shifts works, but for a difference of $2\\pi$ and for the pair $(0, \\pi)$.",
        pairs,
        PAIRS,
        "#claim-14-which-pairs-work",
    ),
    Claim(15, "4.2", "The pair $\\pm\\pi/2$ is the most sensitive.", best_pair, PAIRS, "#claim-15-the-best-pair"),
    Claim(
        16,
        "4.2",
        "For dimples larger than about 2.2 $\\lambda/D$ the error of the iteration rises drastically.",
        diameter,
        FIGURE_4,
        "#where-it-leaves",
    ),
    Claim(
        17,
        "4.2",
        "All the other reconstructors behave in exactly the same way.",
        others_alike,
        FIGURE_4,
        "#the-other-methods",
    ),
    Claim(
        18,
        "2.3",
        "Both kinds of vector mask suffer from a small shift of focus between the two pupil images.",
        focus_shift,
        BUDGET,
    ),
    Claim(
        19,
        "5.2",
        "Leakage of one pupil image into the other can make the phase underestimated.",
        leakage,
        BUDGET,
        "#leakage-swept",
    ),
    Claim(
        20,
        "5.2",
        "On the bench, linear and arcsine are alike with one image; two images extend the range, with an offset "
        "near zero aberration.",
        on_the_bench,
        FIGURE_9,
        "#the-claims-of-section-52",
    ),
    Claim(
        21,
        "6",
        "Next: a better model of the bench, and reconstruction fast enough for kilohertz, for instance by machine "
        "learning.",
        next_steps,
    ),
)


def below(error: float) -> str:
    """Tell a small error by one digit, rounded up: the notebooks give none below `ROUNDING`."""
    exponent = math.floor(math.log10(error))
    digit = math.ceil(error / 10**exponent - 1e-9)
    if digit == 10:
        digit, exponent = 1, exponent + 1
    told = f"$10^{{{exponent}}}$" if digit == 1 else f"${digit}\\times10^{{{exponent}}}$"
    return f"at most {told}" if error <= ROUNDING else told


def glued(notebook: Path) -> dict[str, float]:
    """Return the numbers that an executed notebook glued, by name.

    Raises
    ------
    ClaimError
        There is no such notebook.
    """
    if not notebook.exists():
        raise ClaimError(f"there is no {notebook.name} in {notebook.parent.name}")
    numbers = {}
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        for output in cell.get("outputs", []):
            name = output.get("metadata", {}).get("scrapbook", {}).get("name")
            if name:
                texts = output["data"].values()
                # What is no number is said on the notebook's own page, and judges nothing.
                with suppress(ValueError):
                    numbers[name] = float("".join(next(iter(texts))))
    return numbers


def judge(claim: Claim, folder: Path) -> Finding:
    """Judge a claim by the executed notebooks in a folder.

    Raises
    ------
    ClaimError
        A value that the rule asks for is missing, or two notebooks give it.
    """
    found = [glued(folder / f"{name}.ipynb") for name in claim.notebooks]
    values = {}
    for key in inspect.signature(claim.rule).parameters:
        given = [numbers[key] for numbers in found if key in numbers]
        if len(given) != 1:
            where = " and ".join(claim.notebooks) or "no notebook"
            raise ClaimError(
                f"claim {claim.number} needs one value {key!r}: {where} glued {len(given)} of that name"
            )
        values[key] = given[0]
    return claim.rule(**values)


def fragments(folder: Path) -> dict[str, str]:
    """Return the parts of pages that tell the verdicts, by file name.

    Parameters
    ----------
    folder : Path
        The executed notebooks.
    """
    findings = {claim: judge(claim, folder) for claim in CLAIMS}
    return {"book/_claims_table.md": table(findings), "book/_claims_count.md": count(findings)}


def count(findings: dict[Claim, Finding]) -> str:
    """Say in a line how many claims have which verdict."""
    numbers = Counter(finding.verdict for finding in findings.values())
    listed = ", ".join(f"{numbers[verdict]} {_marked(verdict)}" for verdict in SIGNS if numbers[verdict])
    return f"The {len(findings)} claims of the paper, {{doc}}`one by one <claims>`: {listed}.\n"


def table(findings: dict[Claim, Finding]) -> str:
    """Return the table of all claims."""
    header = ["", "the paper says", "measured here", "verdict"]
    rows = [header, ["---"] * len(header), *(_row(claim, finding) for claim, finding in findings.items())]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([":::{table}", ":class: claims", "", *lines, ":::", ""])


def _row(claim: Claim, finding: Finding) -> list[str]:
    section = f"section {claim.section}"
    if page := SECTIONS.get(claim.section):
        section = f"[{section}]({page})"
    measured = [
        f"{finding.measured[:1].upper()}{finding.measured[1:]}." if finding.measured else "",
        finding.remark,
    ]
    if claim.notebooks:
        name = claim.notebooks[0]
        measured.append(f"*[{_title(name)}](../notebooks/{name}.ipynb{claim.anchor})*")
    said = f"{claim.statement} *{section}*"
    return [str(claim.number), said, " ".join(filter(None, measured)), _marked(finding.verdict)]


def _title(notebook: str) -> str:
    """Return what a link to a notebook says: figures by their number in the paper, others by their name."""
    figure = re.match(r"fig(\d+)_", notebook)
    return f"Figure {int(figure[1])}" if figure else notebook.replace("_", " ").capitalize()


def _marked(verdict: str) -> str:
    """Return a verdict with its sign and the class for its colour."""
    return f"[{SIGNS[verdict]} {verdict}]{{.verdict-{verdict.replace(' ', '-')}}}"
