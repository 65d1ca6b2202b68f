"""The built book: it needs only its own files, its links lead somewhere, and its PDF is complete."""

import re
import unicodedata
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from bs4 import BeautifulSoup
from PIL import Image
from pypdf import PdfReader

ROOT = Path(__file__).parent.parent
HTML = ROOT / "_build" / "html"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book"),
]


def read(file):
    return BeautifulSoup(file.read_text("utf-8"), "html.parser")


def addresses(soup):
    """Files that a page loads, and its links."""
    found = {tag[key] for key in ("src", "poster", "data", "href") for tag in soup.find_all(attrs={key: True})}
    moved = soup.select("meta[http-equiv=refresh]")
    return found | {tag["content"].split("url=")[1] for tag in moved}


@pytest.fixture(scope="module")
def book_pages():
    return {file: read(file) for file in sorted(HTML.rglob("*.html")) if "_static" not in file.parts}


def test_links_inside_the_book_resolve(book_pages):
    broken = []
    names = {
        file: {tag.get(key) for key in ("id", "name") for tag in soup.find_all(attrs={key: True})}
        for file, soup in book_pages.items()
    }
    for file, soup in book_pages.items():
        for address in addresses(soup):
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            name = unquote(parts.fragment)
            if not target.is_file() or (name and name not in names.get(target, {name})):
                broken.append(f"{file.relative_to(HTML)} -> {address}")
    assert not broken


def test_figures_say_what_they_show_and_keep_their_place():
    shown = []
    for file in HTML.rglob("notebooks/*.html"):
        soup = read(file)
        for dark in soup.select(".only-dark"):
            dark.decompose()
        outputs = soup.select(".cell_output img")
        assert outputs == soup.select(".cell_output .wide-figure > a img"), file.name
        for image in outputs:
            shown.append(image["alt"])
            assert len(image["alt"].split()) >= 15, file.name
            assert image.find_parent("a")["href"] == image["src"]
            assert int(image["width"]) > 0
            assert int(image["height"]) > 0
            if image["src"].endswith(".png"):
                # Two pixels of the file are one of the page.
                with Image.open(file.parent / image["src"]) as picture:
                    assert (int(image["width"]), int(image["height"])) == tuple(n // 2 for n in picture.size)
    assert len(set(shown)) == len(shown) >= len(list((ROOT / "notebooks").glob("*.ipynb")))


def test_pages_tell_what_they_are_about(book_pages):
    seen = {}
    for file, soup in book_pages.items():
        described = soup.head.select_one("meta[name=description]")
        seen[file.relative_to(HTML).as_posix()] = described and described["content"]
    assert 60 < len(seen["index.html"]) <= 250
    assert seen["index.html"] == seen["book/index.html"]
    assert seen["book/conclusions.html"] == seen["book/claims.html"]
    forwards = {
        file.relative_to(HTML).as_posix() for file, soup in book_pages.items() if soup.select("[http-equiv]")
    }
    described = [text for name, text in seen.items() if name.partition("/")[1] and name not in forwards]
    assert len(set(described)) == len(described)
    assert not [text for text in described if not text or "\\" in text]


def test_no_file_names_this_machine():
    places = [str(ROOT.resolve()), str(Path.home())]
    texts = (file for file in HTML.rglob("*") if file.suffix in (".html", ".js", ".ipynb", ".md", ".css"))
    assert not [file.name for file in texts for place in places if f"{place}/" in file.read_text("utf-8")]


# The PDF


def plain(text):
    """Text without blanks, which a PDF puts where it likes, and with plain letters for ligatures."""
    return "".join(unicodedata.normalize("NFKD", text).split())


def articles():
    for file in sorted(HTML.glob("[!_]*/*.html")):  # without the sources
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


def test_prose_and_tables_have_powers_of_ten():
    texts = [
        text for article in articles() for text in article.find_all(string=re.compile(r"\d(e[+-]\d|·10[⁻¹-⁹])"))
    ]
    code = ["code", "pre", "script", "style"]
    prose = [text for text in texts if not text.find_parent(code) and not text.find_parent(class_="sig")]
    assert prose
    assert [text for text in prose if re.search(r"\de[+-]\d", text)] == []


def test_signatures_are_python():
    api = read(HTML / "book" / "api_reconstructors.html")
    signatures = [one.get_text() for one in api.select("dt.sig") if "tolerance" in one.get_text()]
    assert [one for one in signatures if re.search(r"10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]", one)] == []
    assert any("1e-" in one for one in signatures)


def chapters(pdf):
    """The bookmarks of the chapters, as (title, number of the page from 0)."""
    found = [entry for entry in pdf.outline if not isinstance(entry, list)]
    return [(entry.title, pdf.get_destination_page_number(entry)) for entry in found]


def test_contents_of_the_pdf_lead_to_every_chapter(pdf, pdf_pages):
    titles = [article.h1.get_text().removesuffix("#") for article in articles()]
    front = "The phase-shifted Zernike wavefront sensor"
    assert front in titles
    named = dict(chapters(pdf))
    assert {plain(title) for title in titles} - {plain(title) for title in named} == {plain(front)}
    links = (link.get_object() for page in pdf.pages[1:3] for link in page.get("/Annots", []))
    listed = [pdf.named_destinations[link["/Dest"]] for link in links if "/Dest" in link]
    starts = [pdf.get_destination_page_number(place) for place in listed]
    assert len(starts) == len(titles)
    assert set(starts) == set(named.values())
    for title, page in named.items():
        assert plain(title) in pdf_pages[page]


def test_pdf_has_every_figure_and_its_caption(pdf, pdf_pages):
    text = "".join(pdf_pages)
    captions = [one.get_text() for article in articles() for one in article.select("figure .caption-text")]
    assert len(captions) > 9
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
