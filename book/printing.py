"""Print the built book into one PDF: its pages, put one after the other, as Chromium prints them."""

import functools
import html
import io
import logging
import os
import shutil
import tomllib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path, PurePosixPath
from posixpath import normpath
from urllib.parse import unquote, urlsplit

import yaml
from bs4 import BeautifulSoup, Tag
from playwright.sync_api import Page, sync_playwright
from pypdf import PdfReader, PdfWriter
from pypdf.generic import DictionaryObject, NameObject, TextStringObject
from sphinx_external_toc.api import SiteMap, TocTree
from sphinx_external_toc.parsing import parse_toc_yaml

STYLE = "book/print.css"  # a book that has none is not printed
NAME = "zwfs.pdf"

CHROMIUM = "ZWFS_CHROMIUM"  # environment variable that names the browser to use
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MISSING = (
    f"a PDF needs Chromium: install one, run .venv/bin/playwright install chromium, or name one in {CHROMIUM}"
)

# What makes sense on a screen only.
SCREEN_ONLY = [".run-card", "script", "style", "button", ".headerlink", ".d-print-none", "details.above-input"]
HEADINGS = [f"h{level}" for level in range(1, 7)]
STYLES = ["pygments.css", "sphinx-design.min.css", "custom.css"]

# Nothing is cut off: what is wider than the page is made smaller. Returns what is too wide even so.
FIT = """() => {
  const edge = document.body.getBoundingClientRect().right + 1;
  const wide = () => [...document.querySelectorAll("table, img, svg, pre, mjx-container")]
    .filter(element => element.getBoundingClientRect().right > edge);
  for (const element of wide()) {
    const box = element.getBoundingClientRect();
    element.style.zoom = 0.99 * (edge - box.left) / box.width;
  }
  return wide().map(element => element.outerHTML.slice(0, 200));
}"""

# Writes into the table of contents on which page each chapter begins.
NUMBER = """places => {
  for (const entry of document.querySelectorAll("nav .page")) entry.textContent = places[entry.dataset.name];
}"""

PRINT = {
    "prefer_css_page_size": True,
    "print_background": True,
    "display_header_footer": True,
    "header_template": "<span></span>",
    "footer_template": """<div style="font: 8pt serif; width: 100%; text-align: center">
        <span class="pageNumber"></span></div>""",
    "outline": True,
    "tagged": True,
}

logging.getLogger("pypdf").setLevel(logging.ERROR)  # it counts the objects of Chromium's files in another way


class PrintError(Exception):
    """The book cannot be printed; the message says why."""


@functools.cache
def find_chromium() -> str | None:
    """Return the path of a Chromium: the one in ``ZWFS_CHROMIUM``, else the system's, else Playwright's own."""
    if named := os.environ.get(CHROMIUM):
        return shutil.which(named)
    for name in BROWSERS:
        if path := shutil.which(name):
            return path
    with sync_playwright() as playwright:
        path = playwright.chromium.executable_path
    return path if os.path.exists(path) else None


def print_book(root: Path, book: Path, chromium: str) -> bytes:
    """Print a book.

    Parameters
    ----------
    root : Path
        The folder with _toc.yml, _config.yml, pyproject.toml and the style.
    book : Path
        The folder with the built pages; a page is written there for a moment.
    chromium : str
        The path of the browser.

    Returns
    -------
    bytes
        The PDF: the same for the same pages and the same browser.

    Raises
    ------
    PrintError
        Something is wider than a page.
    """
    pages = _assemble(root, book)
    paper = book / ".print.html"
    try:
        paper.write_text(str(pages), "utf-8")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 642, "height": 970})  # the text of a page, see the style
            _open(page, paper)
            # Only the printed book tells on which page a chapter begins; its table of contents is as long then.
            page.evaluate(NUMBER, _places(page.pdf(**PRINT)))
            printed = page.pdf(**PRINT)
            browser.close()
    finally:
        paper.unlink(missing_ok=True)
    return _finish(printed, pages)


def _assemble(root: Path, book: Path) -> BeautifulSoup:
    """Put all pages into one, behind a title and a table of contents."""
    toc = parse_toc_yaml(root / "_toc.yml")
    known = {f"{name}.html" for name in toc}
    config = yaml.safe_load((root / "_config.yml").read_text("utf-8"))
    version = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    mathjax = _mathjax(_read(book, toc.root.docname), toc.root.docname)
    chapters = {name: chapter(_read(book, name), name, known) for name in toc}
    chapters[toc.root.docname].select_one("h2").string = "Introduction"
    title, author = html.escape(config["title"]), html.escape(config["author"])
    listed = parts(toc)
    contents, body = "", ""
    for caption, names in listed:
        if caption:
            contents += f'<p class="part">{html.escape(caption)}</p>'
            body += f'<h1 class="part">{html.escape(caption)}</h1>'
        for name in names:
            heading = html.escape(chapters[name].select_one("h2").get_text())
            contents += f'<p><a href="#{name}">{heading}</a><span class="page" data-name="{name}">000</span></p>'
            body += str(chapters[name])
    style = (root / STYLE).read_text("utf-8")
    sheets = "".join(f'<link rel="stylesheet" href="_static/{sheet}">' for sheet in STYLES)
    return BeautifulSoup(
        f"""<!DOCTYPE html>
<html lang="en" data-theme="light"><head><meta charset="utf-8"><title>{title}</title>
{sheets}<style>{style}</style>{mathjax}</head>
<body><header><p class="title">{title}</p><p id="authors">{author}</p><p>zwfs {version}</p>
<p>{config["repository"]["url"]}</p><p>Text and figures: CC-BY-4.0. Code: MIT.</p></header>
<nav><p class="contents">Contents</p>{contents}</nav>{body}</body></html>""",
        "html.parser",
    )


def _read(book: Path, name: str) -> BeautifulSoup:
    return BeautifulSoup((book / f"{name}.html").read_text("utf-8"), "html.parser")


def parts(toc: SiteMap) -> list[tuple[str | None, list[str]]]:
    """List the parts of the book, each with its caption and its pages; the front page has no caption."""

    def below(tree: TocTree) -> list[str]:
        return [name for item in tree.items for name in (str(item), *chain(*map(below, toc[str(item)].subtrees)))]

    return [(None, [toc.root.docname]), *((tree.caption, below(tree)) for tree in toc.root.subtrees)]


def _mathjax(page: BeautifulSoup, name: str) -> str:
    """Return the scripts that set mathematics, as a page of the book has them."""
    scripts = [script for script in page.find_all("script") if "mathjax" in str(script).lower()]
    for script in scripts:
        if script.get("src"):
            script["src"] = _target(name, script["src"])[0]
    return "".join(map(str, scripts))


def chapter(page: BeautifulSoup, name: str, known: set[str]) -> Tag:
    """Return the article of a page, with names and links that hold in one file for all pages."""
    article = page.select_one("article.bd-article")
    for element in article.select(", ".join(SCREEN_ONLY)):
        element.decompose()
    for paragraph in article.find_all("p"):
        if paragraph.select(".download") and paragraph.get_text().startswith("Download"):
            paragraph.decompose()
    for details in article.find_all("details"):
        details["open"] = ""
    for level in range(5, 0, -1):
        for heading in article.find_all(f"h{level}"):
            heading.name = f"h{level + 1}"  # the parts are above the chapters
    for element in article.find_all(id=True):
        element["id"] = f"{name}--{element['id']}"
    for element in article.find_all(src=True):
        element["src"] = _target(name, element["src"])[0]
    for element in article.find_all("a", href=True):
        _redirect(element, name, known)
    article["id"] = name
    return article


def _target(name: str, address: str) -> tuple[str, str]:
    """Return the file and the fragment of an address on a page; the file from the book's folder."""
    parts = urlsplit(address)
    if parts.scheme or parts.netloc:
        return address, ""
    path = normpath(PurePosixPath(name).parent / unquote(parts.path)) if parts.path else f"{name}.html"
    return path, unquote(parts.fragment)


def _redirect(element: Tag, name: str, known: set[str]) -> None:
    """Let a link to another page lead to that page in the same file."""
    path, fragment = _target(name, element["href"])
    if path in known:
        page = path.removesuffix(".html")
        element["href"] = f"#{page}--{fragment}" if fragment else f"#{page}"
    elif not urlsplit(path).scheme:
        element.unwrap()  # a file beside the book: not beside the PDF


def _open(page: Page, file: Path) -> None:
    """Open a file as it is printed, and wait for its mathematics."""
    page.emulate_media(media="print")
    page.goto(file.resolve().as_uri())
    page.evaluate("async () => { await window.MathJax?.startup?.promise; await document.fonts.ready }")
    if wide := page.evaluate(FIT):
        raise PrintError("\n".join(["the book was not printed: too wide for a page:", *wide]))


def _places(printed: bytes) -> dict[str, int]:
    """Return the page on which each name that is linked to stands, from 1."""
    reader = PdfReader(io.BytesIO(printed))
    places = reader.named_destinations.items()
    return {name.lstrip("/"): reader.get_destination_page_number(place) + 1 for name, place in places}


def _finish(printed: bytes, pages: BeautifulSoup) -> bytes:
    """Leave out what differs from one print to the next, dates and versions, and mend the bookmarks."""
    writer = PdfWriter(clone_from=io.BytesIO(printed))
    writer.metadata = {"/Title": pages.title.string, "/Author": pages.select_one("#authors").string}
    headings = [" ".join(heading.get_text().split()) for heading in pages.find_all(HEADINGS)]
    whole = {"".join(heading.split()): heading for heading in headings}
    # Chromium loses the blank where a heading goes on in the next line.
    for entry in _entries(writer.get_outline_root()):
        title = entry["/Title"]
        entry[NameObject("/Title")] = TextStringObject(whole.get("".join(title.split()), title))
    result = io.BytesIO()
    writer.write(result)
    return result.getvalue()


def _entries(parent: DictionaryObject) -> Iterator[DictionaryObject]:
    """Go through the bookmarks below a bookmark."""
    entry = parent.get("/First")
    while entry:
        yield entry.get_object()
        yield from _entries(entry.get_object())
        entry = entry.get_object().get("/Next")
