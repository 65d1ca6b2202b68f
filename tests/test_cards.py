"""The cards under the figures: what they tell, and that their links work."""

import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cards
import nbformat
import pytest
from runner import Project

ROOT = Path(__file__).parent.parent
HTML = ROOT / "_build" / "html"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def notebook(*sources):
    """A notebook of code cells; the first one holds the parameters."""
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    cells[0].metadata["tags"] = ["parameters"]
    return nbformat.v4.new_notebook(cells=cells)


def test_a_card_tells_what_was_run():
    made = notebook("rms = 0.5  # input, rad rms\nseed = 3", 'publish(figure, "fig03_range", {})', "x = 1")
    cards.with_cards(made, "fig03_range", {"Python": "3.12.1"}, "`abc`")
    assert [cell.cell_type for cell in made.cells] == ["code", "code", "markdown", "code"]
    card = made.cells[2].source
    told = ["Figure 3 of the paper", "`rms = 0.5`: input, rad rms", "Seed: `3`", "Commit: `abc`", "Python 3.12.1"]
    told += [
        "downloads/fig03_range.ipynb",
        "downloads/fig03_range.png",
        cards.RERUN.format(notebook="fig03_range"),
    ]
    assert not [text for text in told if text not in card]


def test_a_card_without_parameters_says_so():
    made = cards.with_cards(notebook("", 'publish(figure, "other", {})'), "fig04_dimple", {}, "not known")
    card = made.cells[-1].source
    assert "Not in the paper, goes with Figure 4 of the paper" in card
    assert "Seed: none, nothing is random. Commit: not known. Versions: not known." in card


def test_two_figures_of_a_cell_have_a_card_each():
    made = notebook("n = 1", 'publish(a, "first", {})\npublish(b, "second", {})')
    cards.with_cards(made, "pairs", {}, "not known")
    assert [cell.id for cell in made.cells[2:]] == ["card-first", "card-second"]


def test_the_meaning_of_a_parameter_is_shown_as_it_is():
    made = notebook("d = [1,\n     2]  # *not* markup | $x$ [y]", 'publish(a, "first", {})')
    card = cards.with_cards(made, "pairs", {}, "not known").cells[-1].source
    assert r": \*not\* markup \| \$x\$ \[y\]" in card


def test_the_state_tells_commit_and_changes_of_this_folder_alone(tmp_path):
    def git(*command):
        names = ("-c", "user.name=Nobody", "-c", "user.email=nobody@example.org")
        return subprocess.run(["git", "-C", tmp_path, *names, *command], capture_output=True, check=True).stdout

    project = Project(tmp_path)
    assert cards.state_of(project) == "not known"
    git("init")
    git("commit", "--allow-empty", "--message", "First")
    head = git("rev-parse", "HEAD").decode()[:12]
    assert cards.state_of(project) == f"`{head}`"
    # Never committed, so the commit does not tell all that the book is made from.
    (tmp_path / "new.ipynb").touch()
    assert cards.state_of(project) == f"`{head}`, with changes"
    (tmp_path / "within").mkdir()
    assert cards.state_of(Project(tmp_path / "within")) == "not known"


def test_a_record_of_an_earlier_kind_has_no_versions(tmp_path):
    assert cards.versions_of(Project(tmp_path), "none") == {}


class Cards(HTMLParser):
    """The cards of a page: the links in each, and what the folded part is called."""

    def __init__(self, file):
        super().__init__()
        self.links, self.titles, self.depth, self.in_title = [], [], 0, False
        self.feed(file.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag == "div":
            if "run-card" in (attributes.get("class") or "").split():
                self.links.append([])
                self.depth = 1
            elif self.depth:
                self.depth += 1
        if self.depth and tag == "a":
            self.links[-1].append(attributes["href"])
        if self.depth and tag == "summary":
            self.titles.append("")
            self.in_title = True

    def handle_endtag(self, tag):
        if tag == "div" and self.depth:
            self.depth -= 1
        self.in_title = self.in_title and tag != "summary"

    def handle_data(self, data):
        if self.in_title:
            self.titles[-1] += data


@pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book")
def test_every_figure_has_a_card_whose_links_work():
    titles = []
    for path in NOTEBOOKS:
        code = [cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
        names = [name for source in code for name in cards.published(source)]
        page = HTML / "notebooks" / f"{path.stem}.html"
        found = Cards(page)
        assert len(found.titles) == len(names), path.stem
        titles += [title.strip() for title in found.titles]
        for name, links in zip(names, found.links, strict=True):
            files = [(page.parent / link).resolve() for link in links]
            assert all(file.is_file() for file in files), name
            assert [file.name for file in files] == [
                f"{path.stem}.ipynb",
                *(f"{name}.{e}" for e in ("png", "pdf", "csv")),
            ]
    assert len(titles) == len(set(titles)) > 0
    assert all(titles)
