"""The built book: it needs only its own files, and its links lead somewhere."""

import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from bs4 import BeautifulSoup
from PIL import Image

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
    places = {tag[key] for key in ("src", "poster", "data", "href") for tag in soup.find_all(attrs={key: True})}
    moved = soup.select("meta[http-equiv=refresh i]")
    return places | {tag["content"].split("url=")[1] for tag in moved}


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


def test_no_file_names_this_machine():
    places = [str(ROOT.resolve()), str(Path.home())]
    texts = (file for file in HTML.rglob("*") if file.suffix in (".html", ".js", ".ipynb", ".md", ".css"))
    assert not [file.name for file in texts for place in places if f"{place}/" in file.read_text("utf-8")]


def articles():
    for file in sorted(HTML.glob("[!_]*/*.html")):  # without the sources
        if article := read(file).select_one("article"):
            yield article


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
    signatures = [
        signature.get_text() for signature in api.select("dt.sig") if "tolerance" in signature.get_text()
    ]
    assert [signature for signature in signatures if re.search(r"10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]", signature)] == []
    assert any("1e-" in signature for signature in signatures)
