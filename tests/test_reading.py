"""The order of reading of a notebook's page: figures first, then the code that leads to them."""

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output

from book._ext.reading import put_in_order

PARAMETERS, SET_UP, DRAW = "rms = 0.5", "import zwfs", 'publish(figure, "range", {})'


def code(source, *tags, output=False):
    shown = [new_output("display_data", {"text/plain": "shown"})] if output else []
    return new_code_cell(source, metadata={"tags": list(tags)}, outputs=shown)


@pytest.fixture
def reads():
    """Returns the cells of a page: their source, "output" where only the output is shown, and what is folded."""

    def read(*cells):
        notebook = nbformat.v4.new_notebook(cells=list(cells))
        put_in_order(notebook)
        return [kind(cell) for cell in notebook.cells]

    def kind(cell):
        tags = cell.metadata.get("tags", [])
        if "remove-input" in tags:
            return "output"
        return ("folded", cell.source) if "hide-input" in tags else cell.source

    return read


def test_figure_and_its_section_come_before_the_code(reads):
    page = reads(
        new_markdown_cell("# Question"),
        code(PARAMETERS, "parameters"),
        code(SET_UP, "hide-input"),
        code("curves = compute()"),
        code(DRAW, "hide-input", output=True),
        new_markdown_cell("::: files", id="card-range"),
        new_markdown_cell("## Results"),
        code("report(curves)", "hide-input", output=True),
        new_markdown_cell("## Method"),
    )
    fold = ("folded", f"{SET_UP}\n\n{DRAW}")
    results = ["## Results", "output", "curves = compute()", fold, "## Method"]
    assert page == ["# Question", "output", "::: files", *results]


def test_each_figure_has_its_own_code(reads):
    figures = [
        cell
        for name in ("first", "second")
        for cell in (
            code(f"{name} = compute()"),
            code(f'publish(figure, "{name}", {{}})', "hide-input", output=True),
            new_markdown_cell(f"What {name} shows."),
        )
    ]
    page = reads(*figures)
    first, second = (("folded", f'publish(figure, "{name}", {{}})') for name in ("first", "second"))
    assert page[:5] == ["output", "What first shows.", "first = compute()", first, "output"]
    assert page[5:] == ["What second shows.", "second = compute()", second]


def test_no_code_but_the_parameters_is_lost(reads):
    cells = [code(SET_UP, "hide-input"), code("x = 1"), code("record(x)", "hide-input", output=True)]
    assert reads(*cells) == ["output", "x = 1", ("folded", SET_UP)]
    assert reads(code(PARAMETERS, "parameters")) == []


def test_a_cell_that_computes_and_prints_keeps_its_code(reads):
    assert reads(code("table = compute()\ntable", output=True)) == ["table = compute()\ntable"]
