"""What the pages still lack when Sphinx has written them.

Figures that can be read on a phone and pictures that keep their place while they load, a description for whoever
links to a page, roles that screen readers know, and scripts that keep quiet.
"""

import io
import re
import struct
import textwrap
from pathlib import Path
from urllib.parse import unquote, urlsplit

import yaml
from bs4 import BeautifulSoup, Tag
from matplotlib.figure import Figure
from matplotlib.image import imread

CARD = "_static/social.png"
CARD_SIZE = (1200, 630)  # pixels, what social networks show
CARD_ALT = "The logo and the title of the book above its Figure 3: error against input of five reconstructors."
MATH = {"lambda": "λ", "theta": "θ", "pi": "π", "pm": "±"}
TEX = re.compile(r"\\(?:[()]|([a-z]+))")
CONSOLE = re.compile(r"\bconsole\.(?:log|info|debug)\(")
FORWARD = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"/><title>{1}</title>
<meta http-equiv="refresh" content="0; url={0}"/></head>
<body><main><h1><a href="{0}">{1}</a></h1></main></body></html>
"""
# Pages from the file system may not fetch others, not even to show what a search found in them.
SUMMARY = ("else if (showSearchSummary)", 'else if (showSearchSummary && location.protocol !== "file:")')


def finish(source: Path, html: Path) -> None:
    """Finish a book.

    Parameters
    ----------
    source : Path
        The staged sources, with _config.yml.
    html : Path
        What Sphinx made of them; changed in place.
    """
    config = yaml.safe_load((source / "_config.yml").read_text("utf-8"))
    root = yaml.safe_load((source / "_toc.yml").read_text("utf-8"))["root"] + ".html"
    title, address = config["title"], config.get("html", {}).get("baseurl")
    if address:
        logo = source / "book" / "_static" / "logo.png"
        (html / CARD).write_bytes(social_card(source / config["social_figure"], logo, title))
    for file in sorted(html.rglob("*.html")):
        name = file.relative_to(html).as_posix()
        if name.startswith("_static/"):
            continue
        page = _parse(file.read_text("utf-8"))
        told = summary(page)
        if page.html is None:  # it forwards to the front page, and is what the book's address shows
            page, told = _parse(FORWARD.format(root, title)), summary(_parse((html / root).read_text("utf-8")))
        reserve_places(page, file)
        open_figures(page)
        name_roles(page)
        for script in page.find_all("script", string=CONSOLE):
            script.string = CONSOLE.sub("void(", script.string)
        if address:
            describe(page, title, told, address, name)
        file.write_text(str(page), "utf-8")
    for script in sorted((html / "_static").rglob("*.js")):
        if "mathjax" not in script.parts:
            script.write_text(CONSOLE.sub("void(", script.read_text("utf-8")).replace(*SUMMARY), "utf-8")


def _parse(text: str) -> BeautifulSoup:
    return BeautifulSoup(text, "html.parser")


def reserve_places(page: BeautifulSoup, file: Path) -> None:
    """Give every picture its width and height, so that nothing moves when it arrives."""
    for image in page.find_all("img"):
        parts = urlsplit(image["src"])
        picture = file.parent / unquote(parts.path)
        if not parts.scheme and picture.is_file():
            image["width"], image["height"] = map(str, size(picture))


def size(picture: Path) -> tuple[int, int]:
    """Width and height of a PNG or SVG file, CSS pixels; PNG files hold two pixels for each, for dense screens."""
    head = picture.read_bytes()
    if picture.suffix == ".png":
        return tuple(length // 2 for length in struct.unpack(">II", head[16:24]))
    box = re.search(rb'viewBox="([^"]+)"', head)
    if box is None:
        raise ValueError(f"{picture.name}: expected PNG, or SVG with a viewBox")
    return tuple(round(float(length)) for length in box[1].split()[2:])


def open_figures(page: BeautifulSoup) -> None:
    """Let figures be opened alone, and scroll where the page is narrower than their labels need."""
    for image in page.select("figure > img"):
        image.wrap(page.new_tag("a", href=image["src"], title="Open the figure alone"))
        image.parent.wrap(page.new_tag("div", **{"class": "wide-figure"}))


def name_roles(page: BeautifulSoup) -> None:
    """Replace roles of Sphinx that are no longer, or wrongly, used: a list has items."""
    for entry in page.select("[role=doc-biblioentry]"):
        entry["role"] = "listitem"


def summary(page: BeautifulSoup) -> str:
    """Say what a page is about: in its own words for that, or in its first paragraph."""
    if known := page.find("meta", attrs={"name": "description"}):
        return known["content"]
    first = page.select_one("article.bd-article section > p")
    return plain(first) if first else ""


def describe(page: BeautifulSoup, book: str, text: str, address: str, name: str) -> None:
    """Tell search engines and whoever links to a page what it is about, and what to show."""
    title = (plain(page.h1) if page.h1 else "") or book
    tags = [
        {"name": "description", "content": text},
        {"name": "twitter:card", "content": "summary_large_image"},
        {"property": "og:type", "content": "website"},
        {"property": "og:site_name", "content": book},
        {"property": "og:title", "content": title},
        {"property": "og:description", "content": text},
        {"property": "og:url", "content": f"{address}{name}"},
        {"property": "og:image", "content": f"{address}{CARD}"},
        {"property": "og:image:width", "content": str(CARD_SIZE[0])},
        {"property": "og:image:height", "content": str(CARD_SIZE[1])},
        {"property": "og:image:alt", "content": CARD_ALT},
    ]
    if page.find("meta", attrs={"name": "description"}) or not text:
        del tags[0]
    page.head.extend(page.new_tag("meta", attrs=tag) for tag in tags if tag["content"])


def plain(tag: Tag) -> str:
    """Text of a heading or paragraph without the link to itself, of at most 200 characters."""
    words = "".join(part for part in tag.strings if "headerlink" not in part.parent.get("class", ()))
    words = TEX.sub(lambda found: MATH.get(found[1], found[1] or ""), words)
    return textwrap.shorten(words, 200, placeholder=" …")


def social_card(figure: Path, logo: Path, title: str) -> bytes:
    """Draw the picture that is shown beside a link to the book: logo and title above a figure."""
    width, height = CARD_SIZE
    card = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="white")
    for picture, (left, bottom, wide, high) in ((logo, (40, 500, 100, 100)), (figure, (40, 20, 1120, 450))):
        box = (left / width, bottom / height, wide / width, high / height)
        card.add_axes(box, frameon=False, xticks=[], yticks=[]).imshow(imread(picture), interpolation="lanczos")
    lines = "\n".join(textwrap.wrap(title, 44))
    card.text(165 / width, 550 / height, lines, size=29, weight="bold", color="#1f2d3d", va="center")
    stream = io.BytesIO()
    card.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
