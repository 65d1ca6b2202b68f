"""The PDF of a book of three pages."""

import io

import pytest
from bs4 import BeautifulSoup
from pypdf import PdfReader

from book._tools import book as commands
from book._tools import pdf as printing
from book._tools.project import Project

CHROMIUM = printing.find_chromium()
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")

FILES = {
    "_toc.yml": """
        format: jb-book
        root: book/index
        chapters:
          - file: book/theory
            sections:
              - file: notebooks/one""",
    "_config.yml": "{title: A book, author: Some & others}",
    "pyproject.toml": "[project]\nversion = '1.2.3'\n[tool.zwfs]\nrepository = 'https://github.com/reader/sensor'",
}
PAGES = {
    "book/index": "<h1>A book</h1><p>Begin with <a href='theory.html'>the theory</a>.</p>",
    "book/theory": "<h1>Theory<a class='headerlink' href='#theory'>#</a></h1><p id='here'>Some text.</p>"
    + "<p>More.</p>" * 80,
    "notebooks/one": "<h1>One notebook</h1><p>See <a href='../book/theory.html#here'>there</a>.</p>",
}


def page(article):
    return f"<html><body><nav>Elsewhere</nav><article class='bd-article'>{article}</article></body></html>"


@pytest.fixture
def book(tmp_path):
    """A project and its built pages."""
    built = tmp_path / "html"
    files = {tmp_path / name: text for name, text in FILES.items()}
    files |= {built / f"{name}.html": page(article) for name, article in PAGES.items()}
    for file, text in files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, "utf-8")
    return tmp_path, built


def chapter(article, name="notebooks/one"):
    known = {f"{name}.html" for name in PAGES}
    return str(printing.chapter(BeautifulSoup(page(article), "html.parser"), name, known))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('<a href="../book/theory.html#here">x</a>', '<a href="#book/theory--here">x</a>'),
        ('<a href="#here">x</a>', '<a href="#notebooks/one--here">x</a>'),
        ('<a href="https://example.org/a#b">x</a>', '<a href="https://example.org/a#b">x</a>'),
        ('<b><a href="../_downloads/data.csv">x</a></b>', "<b>x</b>"),
        ('<img src="../_images/a.png"/>', '<img src="_images/a.png"/>'),
        ('<p id="here">x</p>', '<p id="notebooks/one--here">x</p>'),
        ("<details><summary>x</summary>y</details>", '<details open=""><summary>x</summary>y</details>'),
    ],
)
def test_pages_are_made_fit_for_one_file(before, after):
    assert after in chapter(before)


def test_what_needs_a_screen_is_left_out():
    out = '<script>x</script><button>x</button><p class="d-print-none">x</p>'
    out += '<details class="above-input">x</details>'
    out += '<p>Download: <a class="download" href="../_downloads/x.csv">x</a></p>'
    assert "x" not in BeautifulSoup(chapter(f"<h1>One</h1>{out}"), "html.parser").get_text()


@pytest.mark.slow
@needs_chromium
def test_same_pages_give_the_same_file(book):
    pdf = printing.print_book(*book, CHROMIUM)
    assert PdfReader(io.BytesIO(pdf)).metadata == {"/Title": "A book", "/Author": "Some & others"}
    assert printing.print_book(*book, CHROMIUM) == pdf
    assert not list(book[1].glob(".*"))


@pytest.mark.slow
@needs_chromium
def test_numbers_that_chromium_gives_to_headers_of_tables_change_no_byte(book):
    rows, prints = "<tr><th>a</th><td>b</td></tr>" * 20, []
    for unseen in ("", "<p hidden>x</p>" * 9):  # counts, but is not printed
        article = page(f"<h1>One</h1>{unseen}<table>{rows}</table>")
        (book[1] / "notebooks" / "one.html").write_text(article, "utf-8")
        prints.append(printing.print_book(*book, CHROMIUM))
    assert b"/Headers" in prints[0]
    assert prints[0] == prints[1]


@pytest.mark.slow
@needs_chromium
def test_wide_things_are_made_smaller_and_stay_whole(book):
    cells = "".join(f"<td>column-{n}</td>" for n in range(60))
    (book[1] / "notebooks" / "one.html").write_text(page(f"<h1>One</h1><table><tr>{cells}</tr></table>"), "utf-8")
    pdf = PdfReader(io.BytesIO(printing.print_book(*book, CHROMIUM)))
    assert "https://github.com/reader/sensor" in pdf.pages[0].extract_text()
    assert "column-59" in "".join(pdf.pages[-1].extract_text().split())


@pytest.mark.slow
@needs_chromium
def test_what_cannot_be_made_to_fit_is_refused(book):
    table = '<table class="lost" style="margin-left: 900px"><tr><td>1</td></tr></table>'
    (book[1] / "notebooks" / "one.html").write_text(page(f"<h1>One</h1>{table}"), "utf-8")
    with pytest.raises(printing.PrintError, match='too wide for a page:\n<table class="lost"'):
        printing.print_book(*book, CHROMIUM)
    assert not list(book[1].glob(".*"))


def test_without_a_browser_the_reason_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(printing, "find_chromium", lambda: None)
    with pytest.raises(commands.BookError, match="needs Chromium"):
        commands.pdf(Project(tmp_path))


def test_the_browser_that_is_named_is_the_one(monkeypatch, tmp_path):
    named = tmp_path / "browser"
    monkeypatch.setenv(printing.CHROMIUM, str(named))
    assert printing.find_chromium.__wrapped__() is None
    named.touch(mode=0o755)
    assert printing.find_chromium.__wrapped__() == str(named)
