import pytest

from zwfs.tables import Table


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


def test_plain_text_tells_no_address():
    assert repr(Table(["a", "b"], [[1, 2]])) == "Table of 1 rows: a, b"


def test_a_bar_does_not_end_the_cell():
    assert Table(["a"], [["|det M|"]])._repr_markdown_().endswith("| \\|det M\\| |")


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match=r"rows\[1\] has 1 cells: expected 2"):
        Table(["a", "b"], [[1, 2], [1]])
