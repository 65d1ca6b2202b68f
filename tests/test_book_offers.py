"""Launch buttons of the built book, and its PDF, which is as complete as the pages."""

import re
import unicodedata
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import yaml
from bs4 import BeautifulSoup
from pypdf import PdfReader

ROOT = Path(__file__).parent.parent
HTML = ROOT / "_build" / "html"

pytestmark = pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book")


def read(file):
    return BeautifulSoup(file.read_text("utf-8"), "html.parser")


def launches(file):
    """Where the launch buttons of a page lead."""
    links = {link["href"] for link in read(file).find_all("a", href=True)}
    return {link for link in links if urlsplit(link).netloc in ("mybinder.org", "colab.research.google.com")}


def test_launch_buttons_open_the_notebook_of_their_page():
    repository = yaml.safe_load((ROOT / "_config.yml").read_text("utf-8"))["repository"]
    owner, branch = repository["url"].removeprefix("https://github.com/"), repository["branch"]
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert launches(HTML / "notebooks" / f"{notebook.stem}.html") == {
            f"https://mybinder.org/v2/gh/{owner}/{branch}?urlpath=lab/tree/notebooks/{notebook.name}",
            f"https://colab.research.google.com/github/{owner}/blob/{branch}/notebooks/{notebook.name}",
        }


def test_pages_that_are_no_notebooks_have_no_launch_buttons():
    others = [HTML / "index.html", *(HTML / "book").glob("*.html")]
    assert len(others) > 3
    assert [file.name for file in others if launches(file)] == []


def plain(text):
    """Text without blanks, which a PDF puts where it likes, and with plain letters for ligatures."""
    return "".join(unicodedata.normalize("NFKD", text).split())


def articles():
    for file in sorted(HTML.glob("*/*.html")):
        if article := read(file).select_one("article"):
            yield article


@pytest.fixture(scope="module")
def pdf():
    if not (HTML / "zwfs.pdf").exists():
        pytest.skip("the book has no PDF: make pdf")
    return PdfReader(HTML / "zwfs.pdf")


@pytest.fixture(scope="module")
def pdf_pages(pdf):
    return [plain(page.extract_text()) for page in pdf.pages]


def test_front_page_links_the_pdf_only_if_there_is_one():
    linked = read(HTML / "book" / "index.html").find("a", href="../zwfs.pdf")
    assert (linked is not None) == (HTML / "zwfs.pdf").exists()


def chapters(pdf):
    """The bookmarks of the chapters, as (title, number of the page from 0)."""
    nested = [entry for entry in pdf.outline if isinstance(entry, list)]
    found = [entry for part in nested for entry in part if not isinstance(entry, list)]
    return [(entry.title, pdf.get_destination_page_number(entry)) for entry in found]


def test_pdf_has_every_chapter_where_its_table_of_contents_says(pdf, pdf_pages):
    named = dict(chapters(pdf))
    titles = [article.h1.get_text().removesuffix("#") for article in articles()]
    front = "The phase-shifted Zernike wavefront sensor"
    assert front in titles
    assert {plain(title) for title in titles} - {plain(title) for title in named} == {plain(front)}
    for title in titles:
        if title != front:
            page = named[title]
            assert plain(title) in pdf_pages[page]
            assert plain(f"{title} {page + 1}") in "".join(pdf_pages[1:3])


def test_pdf_has_every_figure_and_its_caption(pdf, pdf_pages):
    text = "".join(pdf_pages)
    figures = [figure for article in articles() for figure in article.find_all("figure")]
    assert len(figures) > 9
    captions = [figure.select_one(".caption-text").get_text() for figure in figures]
    # Mathematics is set in letters of its own: what is before it must do.
    assert [caption for caption in captions if plain(re.split(r"[\\±]", caption)[0])[:60] not in text] == []


def test_pdf_has_no_raw_mathematics(pdf_pages):
    text = "".join(pdf_pages)
    assert not re.findall(r".{20}\\(?:frac|psi|phi|left|right|mathcal|begin|[()\[\]]).{20}", text)
    assert "Mathinputerror" not in text
    assert "Undefinedcontrolsequence" not in text


def test_pdf_links_lead_to_places_in_it_or_to_the_web(pdf):
    names = set(pdf.named_destinations)
    links = [link.get_object() for page in pdf.pages for link in page.get("/Annots", [])]
    assert len(links) > 100
    inner = {link["/Dest"] for link in links if "/Dest" in link}
    outer = {link["/A"]["/URI"] for link in links if "/URI" in link.get("/A", {})}
    assert len(inner) > 20
    assert inner <= names
    assert {urlsplit(address).scheme for address in outer} <= {"https", "http", "mailto"}


def test_pdf_has_no_date(pdf):
    assert set(pdf.metadata) == {"/Title", "/Author"}
