"""The built book: it needs nothing but its own files, and its links lead somewhere."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parent.parent
HTML = ROOT / "_build" / "html"

pytestmark = pytest.mark.skipif(not HTML.is_dir(), reason="the book is not built: make book")


class Page(HTMLParser):
    """What a page loads, what it links to, and what can be linked to in it."""

    def __init__(self, file):
        super().__init__()
        self.loads, self.links, self.names = set(), set(), set()
        self.feed(file.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.names |= {attributes[key] for key in ("id", "name") if attributes.get(key)}
        self.loads |= {attributes[key] for key in ("src", "poster", "data") if attributes.get(key)}
        if attributes.get("href"):
            loaded = tag == "link" and attributes.get("rel") != "canonical"
            (self.loads if loaded else self.links).add(attributes["href"])
        if tag == "meta" and (attributes.get("http-equiv") or "").lower() == "refresh":
            self.links.add(attributes["content"].split("url=")[1])


@pytest.fixture(scope="module")
def book_pages():
    return {file: Page(file) for file in sorted(HTML.rglob("*.html")) if "_static" not in file.parts}


def test_pages_load_nothing_from_the_network(book_pages):
    remote = {
        f"{file.relative_to(HTML)} loads {address}"
        for file, page in book_pages.items()
        for address in page.loads
        if urlsplit(address).netloc or urlsplit(address).scheme not in ("", "data")
    }
    assert not remote


def test_styles_load_nothing_from_the_network():
    remote = re.compile(r"(?:url\(\s*|@import\s+)[\"']?(?:https?:)?//")
    assert not [file.name for file in HTML.rglob("*.css") if remote.search(file.read_text("utf-8"))]


def test_links_inside_the_book_resolve(book_pages):
    broken = []
    for file, page in book_pages.items():
        for address in page.loads | page.links:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            name = unquote(parts.fragment)
            known = book_pages.get(target)
            if not target.is_file() or (name and known and name not in known.names):
                broken.append(f"{file.relative_to(HTML)} -> {address}")
    assert not broken


def test_front_page_leads_to_the_book(book_pages):
    assert "book/index.html" in book_pages[HTML / "index.html"].links


def test_no_file_names_this_machine():
    places = [str(ROOT.resolve()), str(Path.home())]
    texts = (file for file in HTML.rglob("*") if file.suffix in (".html", ".js", ".ipynb", ".md", ".css"))
    assert not [file.name for file in texts for place in places if f"{place}/" in file.read_text("utf-8")]
