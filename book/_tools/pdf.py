"""The book as one PDF: Chromium prints its pages, joined in one file."""

import functools
import html
import io
import logging
import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path, PurePosixPath
from posixpath import normpath
from urllib.parse import unquote, urlsplit

import yaml
from bs4 import BeautifulSoup, Tag
from playwright.sync_api import Browser, sync_playwright
from pypdf import PdfWriter
from pypdf.generic import DictionaryObject, NameObject, TextStringObject
from sphinx_external_toc.api import SiteMap
from sphinx_external_toc.parsing import parse_toc_yaml

from .address import setting
from .project import ToolError

STYLE = Path(__file__).with_name("print.css")
NAME = "zwfs.pdf"

CHROMIUM = "ZWFS_CHROMIUM"  # environment variable that names the browser to use
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

# Elements that make sense on a screen only.
SCREEN_ONLY = [".run-card", "script", "style", "button", ".headerlink", ".d-print-none", "details.above-input"]
NODE = re.compile(rb"\(node\d{8}\)")
HEADINGS = [f"h{level}" for level in range(1, 7)]
STYLES = ["pygments.css", "sphinx-design.min.css", "custom.css"]

# Shrinks elements that are wider than the page, so that nothing is cut off; returns those that stay too wide.
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

logging.getLogger("pypdf").setLevel(logging.ERROR)  # it warns of the count of objects in Chromium's files


class PrintError(ToolError):
    """Failure of the PDF; the message lists what does not fit on a page."""


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
    """Print the pages in the folder `book`; the bytes of the PDF depend on the pages and the browser only."""
    pages = _assemble(root, book)
    paper = book / ".print.html"
    try:
        paper.write_text(str(pages), "utf-8")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            printed = _print(browser, paper)
            browser.close()
    finally:
        paper.unlink(missing_ok=True)
    return _finish(printed, pages)


def _assemble(root: Path, book: Path) -> BeautifulSoup:
    """Join all pages, behind a title and a table of contents."""
    toc = parse_toc_yaml(root / "_toc.yml")
    known = {f"{name}.html" for name in toc}
    config = yaml.safe_load((root / "_config.yml").read_text("utf-8"))
    version = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    mathjax = _mathjax(_read(book, toc.root.docname), toc.root.docname)
    chapters = {name: chapter(_read(book, name), name, known) for name in toc}
    chapters[toc.root.docname].h1.string = "Introduction"
    title, author = html.escape(config["title"]), html.escape(config["author"])
    contents, body = "", ""
    for name, depth in depths(toc).items():
        heading = html.escape(chapters[name].h1.get_text())
        contents += f'<p class="depth-{depth}"><a href="#{name}">{heading}</a></p>'
        body += str(chapters[name])
    sheets = "".join(f'<link rel="stylesheet" href="_static/{sheet}">' for sheet in STYLES)
    return BeautifulSoup(
        f"""<!DOCTYPE html>
<html lang="en" data-theme="light"><head><meta charset="utf-8"><title>{title}</title>
{sheets}<style>{STYLE.read_text("utf-8")}</style>{mathjax}</head>
<body><header><p class="title">{title}</p><p id="authors">{author}</p><p>zwfs {version}</p>
<p>{setting(root).repository}</p><p>Text and figures: CC-BY-4.0. Code: MIT.</p></header>
<nav><p class="contents">Contents</p>{contents}</nav>{body}</body></html>""",
        "html.parser",
    )


def _read(book: Path, name: str) -> BeautifulSoup:
    return BeautifulSoup((book / f"{name}.html").read_text("utf-8"), "html.parser")


def depths(toc: SiteMap) -> dict[str, int]:
    """Return how deep each page is nested, in the order of the book; 0 for the front page and the parts."""

    def below(name: str, depth: int) -> Iterator[tuple[str, int]]:
        yield name, depth
        for item in chain(*(tree.items for tree in toc[name].subtrees)):
            yield from below(str(item), depth + 1)

    return {name: max(depth - 1, 0) for name, depth in below(toc.root.docname, 0)}


def _mathjax(page: BeautifulSoup, name: str) -> str:
    """Return the scripts of a page that set mathematics."""
    scripts = [script for script in page.find_all("script") if "mathjax" in str(script).lower()]
    for script in scripts:
        if script.get("src"):
            script["src"] = _target(name, script["src"])[0]
    return "".join(map(str, scripts))


def chapter(page: BeautifulSoup, name: str, known: set[str]) -> Tag:
    """Return the article of a page, with names and links that are unique in one file for all pages."""
    article = page.select_one("article.bd-article")
    for element in article.select(", ".join(SCREEN_ONLY)):
        element.decompose()
    for paragraph in article.find_all("p"):
        if paragraph.select(".download") and paragraph.get_text().startswith("Download"):
            paragraph.decompose()
    for details in article.find_all("details"):
        details["open"] = ""
    for element in article.find_all(id=True):
        element["id"] = f"{name}--{element['id']}"
    for element in article.find_all(src=True):
        element["src"] = _target(name, element["src"])[0]
    for element in article.find_all("a", href=True):
        _redirect(element, name, known)
    article["id"] = name
    return article


def _target(name: str, address: str) -> tuple[str, str]:
    """Return the file, relative to the folder of the book, and the fragment of an address on a page."""
    parts = urlsplit(address)
    if parts.scheme or parts.netloc:
        return address, ""
    path = normpath(PurePosixPath(name).parent / unquote(parts.path)) if parts.path else f"{name}.html"
    return path, unquote(parts.fragment)


def _redirect(element: Tag, name: str, known: set[str]) -> None:
    """Point a link to another page to that page in the same file."""
    path, fragment = _target(name, element["href"])
    if path in known:
        page = path.removesuffix(".html")
        element["href"] = f"#{page}--{fragment}" if fragment else f"#{page}"
    elif not urlsplit(path).scheme:
        element.unwrap()  # a file of the book, which does not come with the PDF


def _print(browser: Browser, file: Path) -> bytes:
    page = browser.new_page(viewport={"width": 642, "height": 970})  # the text of a page, see the style
    page.emulate_media(media="print")
    page.goto(file.resolve().as_uri())
    page.evaluate("async () => { await window.MathJax?.startup?.promise; await document.fonts.ready }")
    if wide := page.evaluate(FIT):
        raise PrintError("\n".join(["the book was not printed: too wide for a page:", *wide]))
    return page.pdf(**PRINT)


def _finish(printed: bytes, pages: BeautifulSoup) -> bytes:
    """Remove dates, versions and numbers of nodes, so that two prints are equal, and repair the bookmarks."""
    writer = PdfWriter(clone_from=io.BytesIO(printed))
    writer.metadata = {"/Title": pages.title.string, "/Author": pages.select_one("#authors").string}
    headings = [" ".join(heading.get_text().split()) for heading in pages.find_all(HEADINGS)]
    whole = {"".join(heading.split()): heading for heading in headings}
    # Chromium loses the blank at a line break in a heading.
    for entry in _entries(writer.get_outline_root()):
        title = entry["/Title"]
        entry[NameObject("/Title")] = TextStringObject(whole.get("".join(title.split()), title))
    result = io.BytesIO()
    writer.write(result)
    # Chromium's numbers for the headers of tables differ from one print to the next; their order does not.
    names = {name: b"(node%08d)" % n for n, name in enumerate(sorted(set(NODE.findall(result.getvalue()))))}
    return NODE.sub(lambda match: names[match[0]], result.getvalue())


def _entries(parent: DictionaryObject) -> Iterator[DictionaryObject]:
    """Return the bookmarks below a bookmark."""
    entry = parent.get("/First")
    while entry:
        yield entry.get_object()
        yield from _entries(entry.get_object())
        entry = entry.get_object().get("/Next")
