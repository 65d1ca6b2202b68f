"""The verdicts on the paper's claims: from the committed notebooks, and the rules at their boundaries."""

import json
from pathlib import Path

import claims
import pytest
from claims import FAILS, HOLDS, REMARK, UNTESTED, Claim, ClaimError, Finding
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output, writes

ROOT = Path(__file__).parent.parent
NOTEBOOKS = ROOT / "notebooks"
VERDICTS = json.loads((Path(__file__).parent / "claims.json").read_text())


@pytest.mark.parametrize("claim", claims.CLAIMS, ids=lambda claim: str(claim.number))
def test_verdict_is_the_recorded_one(claim):
    found = claims.judge(claim, NOTEBOOKS)
    assert found.verdict == VERDICTS[str(claim.number)], found.measured


def test_every_claim_is_there_once():
    numbers = [claim.number for claim in claims.CLAIMS]
    assert numbers == list(range(1, 22))
    assert list(VERDICTS) == [str(number) for number in numbers]


@pytest.mark.parametrize("claim", claims.CLAIMS, ids=str)
def test_whoever_differs_says_why(claim):
    found = claims.judge(claim, NOTEBOOKS)
    assert found.remark or found.verdict == HOLDS
    assert found.measured or not claim.notebooks
    assert "|" not in claim.statement + found.measured + found.remark, "it would end the cell of the table"


def glue(folder, name, **numbers):
    outputs = [
        new_output(
            "display_data",
            data={"application/papermill.record/text/plain": repr(value)},
            metadata={"scrapbook": {"name": key, "mime_prefix": "application/papermill.record/"}},
        )
        for key, value in numbers.items()
    ]
    cells = [
        new_markdown_cell("# text"),
        new_code_cell("glue()", outputs=[*outputs, new_output("stream", text="")]),
    ]
    (folder / f"{name}.ipynb").write_text(writes(new_notebook(cells=cells)))


def small_claim(*notebooks):
    def rule(gain: float, limit: float) -> Finding:
        return Finding(HOLDS if gain > limit else FAILS, f"{gain:.1f}")

    return Claim(3, "2.1", "It gains.", rule, notebooks)


def test_numbers_come_from_the_notebooks(tmp_path):
    glue(tmp_path, "one", gain=12.5, other=1.0, told="at 2 λ/D")
    glue(tmp_path, "two", limit=float("inf"), more=1e-12)
    assert claims.glued(tmp_path / "one.ipynb") == {"gain": 12.5, "other": 1.0}
    assert claims.judge(small_claim("one", "two"), tmp_path) == Finding(FAILS, "12.5")


def test_missing_number_is_named(tmp_path):
    glue(tmp_path, "one", gain=1.0)
    with pytest.raises(ClaimError, match="claim 3 needs one value 'limit': one glued 0 of that name"):
        claims.judge(small_claim("one"), tmp_path)


def test_number_that_two_notebooks_give_is_named(tmp_path):
    glue(tmp_path, "one", gain=1.0, limit=1.0)
    glue(tmp_path, "two", gain=2.0)
    with pytest.raises(ClaimError, match="claim 3 needs one value 'gain': one and two glued 2 of that name"):
        claims.judge(small_claim("one", "two"), tmp_path)


def test_missing_notebook_is_named(tmp_path):
    with pytest.raises(ClaimError, match=r"there is no nowhere.ipynb"):
        claims.judge(small_claim("nowhere"), tmp_path)


TINY, LARGE = claims.ROUNDING, 1.01 * claims.ROUNDING

# Values that make a rule say HOLDS.
GOOD = {
    claims.two_waves: {"dimple_two_wave_error": TINY},
    claims.any_patch: {"patch_two_wave_error": TINY, "patch_model_error": TINY},
    claims.common_approximation: {
        "wave_error_01": 0.01,
        "wave_error_05": 0.02,
        "step_error_01": 0.0049,
        "step_error_03": 0.0149,
        "step_error_05": 0.0249,
        "literal_amplitude_error_05": 0.06,
    },
    claims.determinant: {"determinant_error": TINY, "half_difference_error": TINY, "pairs_off_by_pi": 0.0},
    claims.diversity: {"diversity_at_0": TINY, "largest_diversity": 1.0, "best_difference": 3.1416},
    claims.whole_circle: {"largest_phase": 3.0, "true_wave_error": TINY, "one_image_error": 0.2},
    claims.arcsine: {"arcsine_over_linear": 0.99, "arcsine_limit": 0.3, "arcsine_ratio_at_05": 0.3},
    claims.dynamic_range: {
        "linear_limit": 0.1,
        "shifted_limit": 1.01,
        "descent_limit": 1.01,
        "saxton_limit": 1.01,
    },
    claims.saxton_offset: {
        "saxton_error_2": 0.03,
        "saxton_error_4": 0.01,
        "light_lost_2": 0.1,
        "light_lost_4": 0.05,
        "saxton_error_at_05": 0.0599,
    },
    claims.alike: {
        "alike_up_to": 0.5,
        "lost_screens_at_1": 0.0,
        "points_lost_at_1": 0.0,
        "shifted_passes": 10.0,
        "descent_passes": 11.0,
    },
    claims.wraps: {"wrapped_screens_at_05": 0.1, "wrapped_screens_at_1": 1.0, "wrap_onset": 1.0},
    claims.reach: {"shifted_limit": 1.0, "recovered_at_1": 1.0, "strehl_at_1": 0.4, "strehl_at_limit": 0.4},
    claims.real_time: {"fourier_functions": 1.0, "rank": 28.0},
    claims.pairs: {
        "n_allowed": 10.0,
        "n_singular": 2.0,
        "singular_as_expected": 1.0,
        "zero_works": 1.0,
        "error_max_allowed_pairs": 1e-3,
    },
    claims.best_pair: {
        "best_theta_a": 1.6,
        "best_noise": 0.99,
        "noise_at_half_pi": 1.0,
        "best_noise_aberrated": 0.99,
        "noise_at_half_pi_aberrated": 1.0,
        "best_noise_read": 0.99,
        "noise_at_half_pi_read": 1.0,
    },
    claims.diameter: {
        "error_at_20": 0.01,
        "error_at_26": 0.2,
        "diameter_5_percent": 2.2,
        "diameter_5_percent_400": 2.24,
        "contraction_crosses_1": 2.4,
    },
    claims.others_alike: {
        "claim17_linear_ratio": 11.0,
        "claim17_arcsine_ratio": 11.0,
        "claim17_saxton_ratio": 11.0,
        "claim17_descent_ratio": 11.0,
        "claim17_descent_points_ratio": 11.0,
    },
    claims.leakage: {"gain_leakage": 0.95, "gain_leakage_10": 0.8},
    claims.on_the_bench: {
        "arcsine_over_linear": 1.0,
        "offset_linear": 0.001,
        "offset_shifted": 0.04,
        "reach_linear": 0.3,
        "reach_shifted": 0.6,
        "reach_saxton": 0.4,
    },
}


@pytest.mark.parametrize("rule", GOOD, ids=lambda rule: rule.__name__)
def test_rule_holds(rule):
    assert rule(**GOOD[rule]).verdict == HOLDS


@pytest.mark.parametrize(
    ("rule", "changed", "verdict"),
    [
        (claims.two_waves, {"dimple_two_wave_error": LARGE}, FAILS),
        (claims.any_patch, {"patch_two_wave_error": LARGE}, FAILS),
        (claims.any_patch, {"patch_model_error": LARGE}, FAILS),
        (claims.common_approximation, {"step_error_01": 0.0051}, REMARK),
        (claims.common_approximation, {"step_error_03": 0.0151}, REMARK),
        (claims.common_approximation, {"step_error_05": 0.0251}, REMARK),
        (claims.common_approximation, {"wave_error_01": 0.05}, HOLDS),
        (claims.common_approximation, {"wave_error_01": 0.051}, FAILS),
        (claims.determinant, {"pairs_off_by_pi": 0.01}, REMARK),
        (claims.determinant, {"determinant_error": LARGE}, FAILS),
        (claims.determinant, {"half_difference_error": LARGE}, FAILS),
        (claims.diversity, {"diversity_at_0": LARGE}, FAILS),
        (claims.diversity, {"best_difference": 3.15}, FAILS),
        (claims.whole_circle, {"true_wave_error": LARGE}, FAILS),
        (claims.arcsine, {"arcsine_over_linear": 1.0}, FAILS),
        (claims.arcsine, {"arcsine_limit": 0.2}, HOLDS),
        (claims.arcsine, {"arcsine_limit": 0.19}, REMARK),
        (claims.arcsine, {"arcsine_limit": 0.4}, HOLDS),
        (claims.arcsine, {"arcsine_limit": 0.41}, REMARK),
        (claims.dynamic_range, {"saxton_limit": 0.99}, REMARK),
        (claims.dynamic_range, {"shifted_limit": 0.99, "descent_limit": 0.99}, REMARK),
        (claims.dynamic_range, {"shifted_limit": 0.99, "descent_limit": 0.99, "saxton_limit": 0.0}, FAILS),
        (claims.dynamic_range, {"shifted_limit": float("inf")}, HOLDS),
        (claims.saxton_offset, {"saxton_error_at_05": 0.0601}, REMARK),
        (claims.saxton_offset, {"saxton_error_2": 0.005, "saxton_error_4": 0.001}, FAILS),
        (claims.saxton_offset, {"saxton_error_2": 0.0051, "saxton_error_4": 0.001}, REMARK),
        (claims.saxton_offset, {"saxton_error_4": 0.03}, FAILS),
        (claims.saxton_offset, {"light_lost_4": 0.1}, FAILS),
        (claims.alike, {"lost_screens_at_1": 0.05}, REMARK),
        (claims.alike, {"alike_up_to": 0.49}, FAILS),
        (claims.alike, {"descent_passes": 10.0}, FAILS),
        (claims.wraps, {"wrap_onset": 0.8}, HOLDS),
        (claims.wraps, {"wrap_onset": 0.79}, REMARK),
        (claims.wraps, {"wrap_onset": 1.21}, REMARK),
        (claims.wraps, {"wrap_onset": 0.49}, FAILS),
        (claims.wraps, {"wrap_onset": 1.51}, FAILS),
        (claims.reach, {"shifted_limit": 0.8}, HOLDS),
        (claims.reach, {"shifted_limit": 0.79}, FAILS),
        (claims.reach, {"shifted_limit": 1.2}, HOLDS),
        (claims.reach, {"shifted_limit": 1.21}, REMARK),
        (claims.real_time, {"fourier_functions": 0.0}, REMARK),
        (claims.pairs, {"zero_works": 0.0}, REMARK),
        (claims.pairs, {"singular_as_expected": 0.0}, FAILS),
        (claims.pairs, {"error_max_allowed_pairs": 1.1e-3}, FAILS),
        (claims.best_pair, {"best_noise": 0.97}, REMARK),
        (claims.best_pair, {"best_noise": 0.97, "best_noise_aberrated": 0.97, "best_noise_read": 0.97}, FAILS),
        (claims.diameter, {"diameter_5_percent_400": 2.3}, REMARK),
        (claims.diameter, {"diameter_5_percent": 2.41, "diameter_5_percent_400": 2.41}, FAILS),
        (claims.diameter, {"error_at_26": 0.1}, FAILS),
        (claims.others_alike, {"claim17_saxton_ratio": 10.0}, FAILS),
        (claims.leakage, {"gain_leakage": 0.99}, FAILS),
        (claims.leakage, {"gain_leakage_10": 0.951}, FAILS),
        (claims.on_the_bench, {"reach_saxton": 0.3}, REMARK),
        (claims.on_the_bench, {"arcsine_over_linear": 1.34}, FAILS),
        (claims.on_the_bench, {"arcsine_over_linear": 0.74}, FAILS),
        (claims.on_the_bench, {"reach_shifted": 0.59}, FAILS),
        (claims.on_the_bench, {"offset_shifted": 0.01}, FAILS),
    ],
)
def test_rule_at_its_boundary(rule, changed, verdict):
    found = rule(**(GOOD[rule] | changed))
    assert found.verdict == verdict
    assert found.measured


def test_rules_at_their_boundaries_are_those_of_the_claims():
    assert {claim.rule for claim in claims.CLAIMS} == {*GOOD, claims.focus_shift, claims.next_steps}


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (1e-12, "at most $10^{-12}$"),
        (2e-11, "$2\\times10^{-11}$"),
        (1e-3, "$10^{-3}$"),
        (1.23e-7, "$2\\times10^{-7}$"),
        (9.1e-7, "$10^{-6}$"),
        (0.26, "$3\\times10^{-1}$"),
    ],
)
def test_small_errors_are_told_as_powers(error, text):
    assert claims.below(error) == text


def test_fragments_tell_every_claim_and_the_counts():
    one, two, three = (Claim(n, "6", f"Statement {n}.", claims.next_steps) for n in (1, 2, 3))
    findings = {one: Finding(HOLDS, "one", "So."), two: Finding(HOLDS), three: Finding(UNTESTED)}
    assert claims.count(findings).endswith(
        ": 2 [✔ holds]{.verdict-holds}, 1 [○ not to be tested here]{.verdict-not-to-be-tested-here}.\n"
    )
    text = claims.table(findings)
    assert "| 1 | Statement 1. *section 6* | One. So. | [✔ holds]{.verdict-holds} |" in text
    assert text.count("\n| ") == 5
