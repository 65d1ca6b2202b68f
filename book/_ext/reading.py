"""Order of reading: a page shows its figures and what they say; all of its code stands in one fold at the end.

A notebook runs from its parameters to its figures. Everywhere but on its page of the book it keeps that order.
"""

import copy

from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell

from studies.kit.results import published

CARD = "card-"  # with which the ids of the cards begin
FOLD = "Code of this page"
COMPUTING = "This code computes the numbers of the {}:"
STUDY = "from studies import "  # with which the removed cell begins that the code of the page needs
FOLDED = "fold"  # tag of a cell that computes and yet goes into the fold


def put_in_order(notebook: NotebookNode) -> None:
    """Move the code of a notebook into a fold at its end, in place.

    The first cell that computes also stays visible, with a line before it, at the end of the section that follows
    the first figure. Cells with the tag `FOLDED` do not.
    """
    code = [cell for cell in notebook.cells if cell.cell_type == "code" and not tagged(cell, "remove-cell")]
    computing = [cell for cell in code if not (cell.outputs or tagged(cell, "hide-input", "parameters", FOLDED))][
        :1
    ]
    if computing:
        figure = "first figure" if sum(bool(published(cell.source)) for cell in code) > 1 else "figure"
        computing.insert(0, new_markdown_cell(COMPUTING.format(figure), id="computing"))
    cells: list[NotebookNode] = []
    drawn = described = False  # whether the first figure, and text on it, are above
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            if described and cell.source.startswith("#"):
                cells, computing = cells + computing, []
            described = described or (drawn and not cell.id.startswith(CARD))
            cells.append(cell)
        elif cell.outputs or tagged(cell, "remove-cell"):
            drawn = drawn or bool(published(cell.source))
            cells.append(without_code(cell) if tagged(cell, "hide-input") else cell)
    whole = [cell for cell in notebook.cells if cell in code or cell.source.startswith(STUDY)]
    notebook.cells = [*cells, *computing, *([fold(whole)] if code else [])]


def tagged(cell: NotebookNode, *tags: str) -> bool:
    """Return whether a cell has one of these tags."""
    return not set(tags).isdisjoint(cell.metadata.get("tags", []))


def fold(code: list[NotebookNode]) -> NotebookNode:
    """Return a folded cell with the source of others."""
    metadata = {"tags": ["hide-input"], "mystnb": {"code_prompt_show": FOLD, "code_prompt_hide": FOLD}}
    return new_code_cell("\n\n".join(cell.source for cell in code), metadata=metadata, id="code")


def without_code(cell: NotebookNode) -> NotebookNode:
    """Return a cell that shows its output only."""
    cell = copy.deepcopy(cell)
    tags = [tag for tag in cell.metadata.get("tags", []) if tag != "hide-input"]
    cell.metadata["tags"] = [*tags, "remove-input"]
    return cell
