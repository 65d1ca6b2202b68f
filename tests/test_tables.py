import pytest

from book._ext import driver
from studies.kit.tables import Table, small, two_digits


def test_few_digits_are_shown_and_truths_in_words():
    table = Table(["quantity", "value"], [["pi", 3.14159265], ["count", 7860], ["holds", True]])
    assert table._repr_markdown_().splitlines() == [
        "| quantity | value |",
        "| --- | --- |",
        "| pi | 3.14 |",
        "| count | 7860 |",
        "| holds | yes |",
    ]
    assert "| 3.1 |" in Table(["a"], [[3.14159]], digits=2)._repr_markdown_()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_dash_stands_for_a_number_that_does_not_exist(value):
    assert Table(["a", "b"], [[value, 0.0]])._repr_markdown_().splitlines()[2:] == ["| – | 0 |"]
    assert small(value) == "–"


def test_string_of_several_lines_stays_in_its_cell():
    assert Table(["a"], [["b\n\n# c\x1b"]])._repr_markdown_().splitlines()[2:] == ["| b\\\\n\\\\n\\# c\\\\x1b |"]


@pytest.mark.parametrize(
    ("value", "text"), [(0.12345, "0.12"), (1e-6, "1e-06"), (9.9e-7, "<10⁻⁶"), (0.0, "<10⁻⁶")]
)
def test_rounding_errors_are_shown_as_a_bound(value, text):
    assert small(value) == text


def test_sentences_are_html_and_hold_no_html_of_their_own():
    said = "**Two** [pages](other.ipynb#part), `1 < 2`, <b>x</b> [y](javascript:x)\n\n- one\n- two"
    expected = (
        '<p><strong>Two</strong> <a href="other.html#part">pages</a>, <code>1 &lt; 2</code>, '
        "&lt;b&gt;x&lt;/b&gt; [y](javascript:x)</p>\n"
        "<ul>\n<li>one</li>\n<li>two</li>\n</ul>\n"
    )
    assert driver.in_html(said) == expected


@pytest.mark.parametrize(
    ("value", "shown"), [(1659.0, "1700"), (0.0996, "0.1"), (-0.0374, "-0.037"), (0.0, "0"), (float("nan"), "–")]
)
def test_two_digits_are_shown(value, shown):
    assert two_digits(value) == shown
