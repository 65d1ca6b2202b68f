"""How the book reads: its order, what each page leads to, its equations and its notation."""

import importlib
import inspect
import json
import re
from pathlib import Path

import nbformat
import pytest
import yaml

from book._ext import api
from zwfs.companion.results import published

ROOT = Path(__file__).parent.parent
BOOK, HTML = ROOT / "book", ROOT / "_build" / "html"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

# Mathematics in a text: a directive, a display, or between dollar signs in one paragraph.
MATH = re.compile(r"```\{math\}\n(.*?)```|\$\$(.+?)\$\$|(?<![\\$`])\$([^$\n]+(?:\n[^$\n]+)?)\$", re.DOTALL)
# What is no symbol: labels, environments, words, functions that every reader knows, upper indices that are words.
NO_SYMBOL = re.compile(
    r":label:.*|\\(?:begin|end)\{\w+\}|\\text\{[^}]*\}|\\mathrm\{(?:Re|Im|sign|var)\}|\^\{?[HT]\}?|\^\{[a-z]{2,}\}"
)
GREEK = (
    "alpha beta gamma delta epsilon varepsilon zeta eta theta kappa lambda mu nu xi pi rho sigma tau phi chi psi "
    "omega Gamma Delta Theta Lambda Xi Pi Sigma Phi Psi Omega"
).replace(" ", "|")
WORD = r"_\{(?P<word>in|[a-z]{3,})(?:,\w+)?\}"
# A letter with its lower index, if that is a word; a command; the word below an integral or a bar.
ATOM = re.compile(
    rf"(?P<base>\\mathrm\{{\w+\}}|\\mathcal ?[A-Z]|\\(?:{GREEK})(?![A-Za-z])|[A-Za-z])'*(?:{WORD})?"
    r"|\\[A-Za-z]+|_\{[a-z]{3,}\}"
)


def symbols(text):
    """The symbols in the mathematics of a text: letters, each with its lower index if that is a word."""
    found = set()
    for match in MATH.finditer(text):
        tex = NO_SYMBOL.sub(" ", next(filter(None, match.groups())))
        for atom in filter(lambda atom: atom["base"], ATOM.finditer(tex)):
            base = re.sub(r"[\s{}\\]|mathrm", "", atom["base"])
            found.add(f"{base}_{atom['word']}" if atom["word"] else base)
    return found


def prose():
    """The texts of the book, by the file that they are in."""
    for page in sorted(BOOK.glob("*.md")):
        if page.name != "notation.md":
            yield page.name, page.read_text("utf-8")
    for notebook in NOTEBOOKS:
        for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
            caption = cell["metadata"].get("mystnb", {}).get("figure", {}).get("caption", "")
            yield notebook.name, "".join(cell["source"]) if cell["cell_type"] == "markdown" else caption


def notation_rows():
    """The rows of the tables of symbols."""
    lines = (BOOK / "notation.md").read_text("utf-8").split("## The planes")[1].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] not in ("symbol", "---")]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (r"$\psi_{ref}^{flat}$ and $I_k$", {"psi_ref", "I", "k"}),
        (r"$\mathcal F^{-1}[\hat\psi_{in}]$", {"mathcalF", "psi_in"}),
        (r"$L^{H}B_{pup}^T x'$", {"L", "B_pup", "x"}),
        (r"$\int\limits_{pupil} e^{2\pi i u}\,dx$", {"e", "pi", "i", "u", "d", "x"}),
        (r"$D_{kl}=\mathrm{Im}(r_k)\sqrt2$, \$5 for $\text{words}$", {"D", "k", "l", "r"}),
        ("```{math}\n:label: eq-a\n\\begin{aligned}a &= \\frac{b}{c}\\end{aligned}\n```", {"a", "b", "c"}),
    ],
)
def test_symbols_are_told_from_commands(text, expected):
    assert symbols(text) == expected


def test_every_symbol_is_in_the_notation():
    listed = symbols(" ".join(row[0] for row in notation_rows()))
    missing = {f"{symbol} in {name}" for name, text in prose() for symbol in symbols(text) - listed}
    assert not missing


def test_notation_lists_no_symbol_that_the_book_does_not_use():
    used = set().union(*(symbols(text) for _, text in prose()))
    assert not symbols(" ".join(row[0] for row in notation_rows())) - used


def test_names_in_the_notation_exist():
    # The others are links, and a link that leads nowhere fails the build.
    modules = [importlib.import_module(name) for name in api.modules()]
    for row in notation_rows():
        for owner, attribute in re.findall(r"(?<!\})`(\w+)\.(\w+)`", row[-1]):
            found = next(getattr(module, owner) for module in modules if hasattr(module, owner))
            assert re.search(rf"\b{attribute}\b", inspect.getsource(found)), f"{owner}.{attribute}"


def documents(toc):
    """The pages in the order of the table of contents, by the caption of their part."""
    return {part["caption"]: [chapter["file"] for chapter in part["chapters"]] for part in toc["parts"]}


def test_the_book_has_the_order_of_the_paper():
    parts = documents(yaml.safe_load((ROOT / "_toc.yml").read_text()))
    order = ["The problem", "The sensor", "The phase-shifted sensor", "Reconstruction methods", "Simulations"]
    order += ["The bench", "Conclusions", "Claims", "Reference"]
    assert [caption for caption in parts if caption in order] == order
    pages = [page for chapters in parts.values() for page in chapters]
    figures = [page for page in pages if re.match(r"notebooks/fig\d", page)]
    assert figures == sorted(figures)
    assert parts["Claims"] == ["book/claims", "book/differences"]
    assert parts["Reference"][-3:] == ["book/notation", "book/api", "book/bibliography"]
    committed = {f"notebooks/{notebook.stem}" for notebook in NOTEBOOKS}
    assert len(pages) == len(set(pages))
    assert committed <= set(pages)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_that_set_up_or_draw_are_folded_and_one_that_computes_is_not(path):
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    folded = [
        bool({"hide-input", "hide-cell", "remove-cell"} & set(cell.metadata.get("tags", ()))) for cell in cells
    ]
    for cell, hidden in zip(cells, folded, strict=True):
        shown = "parameters" in cell.metadata.get("tags", ())
        assert hidden or shown or not re.match(r"import |from |glue\(", cell.source), cell.source
        assert hidden or not published(cell.source), cell.source
    assert not all(
        hidden or "parameters" in cell.metadata.get("tags", ()) for cell, hidden in zip(cells, folded, strict=True)
    )


def test_the_papers_equations_have_its_numbers():
    labels = api.paper_labels(BOOK)
    assert len(labels) == 16
    assert (labels[0], labels[5], labels[8], labels[15]) == (
        "eq-propagation",
        "eq-arccos",
        "eq-phase-shifted",
        "eq-cost",
    )


@pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book")
def test_equations_are_numbered_through_the_book():
    pages = [*api.PAPER, "theory.md"]
    texts = [(HTML / "book" / page).with_suffix(".html").read_text("utf-8") for page in pages]
    numbers = [int(number) for text in texts for number in re.findall(r'class="eqno">\((\d+)\)', text)]
    assert numbers == list(range(1, len(numbers) + 1))
