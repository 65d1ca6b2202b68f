"""The order of reading of a notebook's page: figures first, then all code in one fold."""

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output

from book._ext.reading import COMPUTING, put_in_order

PARAMETERS, SET_UP, DRAW = "rms = 0.5", "import zwfs", 'publish(figure, "range")'


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


def test_figures_and_text_come_first_and_all_code_is_in_one_fold_at_the_end(reads):
    page = reads(
        new_markdown_cell("# Question"),
        code(PARAMETERS, "parameters"),
        code("check()", "remove-cell"),
        code(SET_UP, "hide-input"),
        code("curves = compute()"),
        code(DRAW, "hide-input", output=True),
        new_markdown_cell("::: files", id="card-range"),
        new_markdown_cell("## Results"),
        code("report(curves)", "hide-input", output=True),
        new_markdown_cell("## Second"),
        code("more = compute()"),
        code("draw(more)", "hide-input", output=True),
        new_markdown_cell("## Method"),
    )
    first = [
        "# Question",
        "check()",
        "output",
        "::: files",
        "## Results",
        "output",
        COMPUTING.format("figure"),
        "curves = compute()",
    ]
    sources = [PARAMETERS, SET_UP, "curves = compute()", DRAW, "report(curves)", "more = compute()", "draw(more)"]
    fold = ("folded", "\n\n".join(sources))
    assert page == [*first, "## Second", "output", "## Method", fold]


def test_sentences_of_a_cell_lead_before_the_figure(reads):
    page = reads(
        new_markdown_cell("# Question"),
        code("curves = compute()"),
        code("findings(curves)", "hide-input", output=True),
        code(DRAW, "hide-input", output=True),
    )
    assert page[:3] == ["# Question", "output", "output"]


def test_a_cell_that_computes_and_prints_keeps_its_code(reads):
    source = "table = compute()\ntable"
    assert reads(code(source, output=True)) == [source, ("folded", source)]


def test_cells_that_a_page_does_not_need_stand_in_the_fold_alone(reads):
    page = reads(code(DRAW, "hide-input", output=True), new_markdown_cell("Text"), code("one = 1", "fold"))
    assert page == ["output", "Text", ("folded", f"{DRAW}\n\none = 1")]
