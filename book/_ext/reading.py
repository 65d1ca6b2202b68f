"""Order of reading: a page shows a figure and what it says, and then the code that leads to it.

A notebook runs from its parameters to its figures. Everywhere but on its page of the book it keeps that order.
"""

import copy

from nbformat import NotebookNode
from nbformat.v4 import new_code_cell

from studies.kit.results import published

CARD = "card-"  # with which the ids of the cards begin
FOLD = "Set-up and drawing"


def put_in_order(notebook: NotebookNode) -> None:
    """Move the code of each figure to the end of the section that follows the figure, in place.

    The code that computes stays visible there; what sets up and draws is folded. The page omits two kinds of code:
    the parameters, which the card of the first figure shows, and code that only prints a table.
    """
    cells: list[NotebookNode] = []
    ahead: list[NotebookNode] = []  # code of the next figure
    behind: list[NotebookNode] = []  # code of the last figure
    described = False  # whether text followed the last figure
    for cell in notebook.cells:
        tags = cell.metadata.get("tags", [])
        if cell.cell_type == "markdown":
            if described and cell.source.startswith("#"):
                cells, behind = cells + arranged(behind), []
            cells, described = [*cells, cell], described or not cell.id.startswith(CARD)
        elif published(cell.source) and cell.outputs:
            cells = [*cells, *arranged(behind), without_code(cell)]
            ahead, behind, described = [], [*ahead, cell], False
        elif cell.outputs or "remove-cell" in tags:
            cells.append(without_code(cell) if "hide-input" in tags else cell)
        elif "parameters" not in tags:
            ahead.append(cell)
    notebook.cells = cells + arranged(behind + ahead)


def arranged(code: list[NotebookNode]) -> list[NotebookNode]:
    """Return the cells that compute, and in one folded cell the source of the others."""
    folded = [cell for cell in code if "hide-input" in cell.metadata.get("tags", [])]
    if not folded:
        return code
    metadata = {"tags": ["hide-input"], "mystnb": {"code_prompt_show": FOLD, "code_prompt_hide": FOLD}}
    source = "\n\n".join(cell.source for cell in folded)
    fold = new_code_cell(source, metadata=metadata, id=f"code-{folded[-1].id}"[:64])
    return [*(cell for cell in code if cell not in folded), fold]


def without_code(cell: NotebookNode) -> NotebookNode:
    """Return a cell that shows its output only."""
    cell = copy.deepcopy(cell)
    kept = [tag for tag in cell.metadata.get("tags", []) if tag != "hide-input"]
    cell.metadata["tags"] = [*kept, "remove-input"]
    return cell
