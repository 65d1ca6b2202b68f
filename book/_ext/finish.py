"""Finish of the pages: numbers, variants and sizes of pictures, names of folds, icons."""

import base64
import copy
import io
import os
import re
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from bs4 import BeautifulSoup, Tag
from docutils import nodes
from fontTools.subset import Subsetter
from fontTools.ttLib import TTFont
from sphinx.application import Sphinx
from sphinx.util.fileutil import copy_asset_file

from book._ext.glossary import GLOSSARY, define
from book._ext.performance import PICTURES
from studies.kit.tables import MISSING

VARIANTS = "variants-"  # with which the class of a figure begins that may have dark and narrow variants
MOVED = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>This page has moved</title>
<meta http-equiv="refresh" content="0; url={address}">
</head>
<body><p>This page has moved: <a href="{address}">open it</a>.</p></body>
</html>
"""
PHONE = "(max-width: 600px)"
BY_ROW = "table:is(.claims, .decision), .tag_decision table"
POWER = re.compile(r"(?<![\w.])(-?\d(?:\.\d+)?)e([+-])0*(\d+)\b")
MINUS = re.compile(r"(?<![\w.)-])-(?=\d)")
PERCENT = re.compile(r"(?:(?<=\d)|^) ?%")  # the number may be in the element before
DIGITS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
ICON = re.compile(r"(?:\.fa-[\w-]+:before,?)+\{content:[^}]*\}")
CLASS = re.compile(r"fa-[\w-]+")
LETTER = re.compile(r"\\(f[\da-f]{3})\b|([\uf000-\uf8ff])")
FONT = re.compile(r"url\([^)]*fa-solid-900[^}]*")
IMPORTED = re.compile(r"^from zwfs[\w.]* import (\([^)]*\)|.*)$", re.MULTILINE)


def finish_page(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: nodes.document) -> None:
    """Finish the body of a page.

    Each picture gets its size, so that the text does not move when the picture arrives. Each figure links to its
    file, and scrolls on narrow screens.
    """
    body = BeautifulSoup(context.get("body", ""), "html.parser")
    write_numbers(body)
    pictures = {name: Path(app.srcdir, source) for source, name in app.builder.images.items()}
    for image in body.find_all("img"):
        if picture := pictures.get(unquote(image["src"].rpartition("/")[2])):
            image["width"], image["height"] = map(str, size(picture))
    for image in body.find_all("img"):
        image["loading"] = "lazy"
    for image in body.select("figure > img"):
        image.wrap(body.new_tag("a", href=image["src"], title="Open the figure alone"))
        image.parent.wrap(body.new_tag("div", **{"class": "wide-figure"}))
    for figure in body.select(f"figure[class*={VARIANTS}]"):
        add_variants(app, figure)
    for fold in body.select("details > summary[aria-label]"):
        del fold["aria-label"]  # the same for every fold; its title says what it holds
    name_cells(body)
    define(body, Path(app.srcdir, f"{GLOSSARY}.md"))
    for entry in body.select("[role=doc-biblioentry]"):
        entry["role"] = "listitem"  # the role of Sphinx is deprecated: a list has items
    link_code(app, page, body)
    if body.find(id="phasor"):
        app.add_css_file("phasor.css")
        app.add_js_file("phasor.js", loading_method="defer")
    context["body"] = str(body)


def name_cells(body: Tag) -> None:
    """Give the cells of the tables in `BY_ROW` the heads of their columns, for narrow screens."""
    for table in body.select(BY_ROW):
        table["class"] = " ".join([*table.get_attribute_list("class"), "rows"])
        heads = [head.get_text().strip() for head in table.select("thead th")]
        for row in table.select("tbody tr"):
            for head, cell in list(zip(heads, row.find_all("td", recursive=False), strict=True))[1:]:
                cell["data-head"] = head[:1].upper() + head[1:]
                if cell.get_text().strip() == MISSING:
                    cell["class"] = " ".join([*cell.get_attribute_list("class"), "missing"])


def link_code(app: Sphinx, page: str, body: Tag) -> None:
    """Link names of the package in code to their entries of the API, which link to the source."""
    entries: dict[str, str] = {}
    objects = app.env.domaindata["py"]["objects"]
    for path in sorted(objects, key=lambda path: (len(path), path)):
        entry = objects[path]
        if entry.objtype in ("class", "function") and page != entry.docname:
            address = f"{app.builder.get_relative_uri(page, entry.docname)}#{entry.node_id}"
            entries.setdefault(path.rpartition(".")[2], address)
    code = "\n".join(block.get_text() for block in body.select(".highlight pre"))
    imported = {name for names in IMPORTED.findall(code) for name in re.findall(r"\w+", names)}
    for name in body.select(".highlight .n"):
        before = "".join(part.get_text() for part in reversed(list(name.previous_siblings)[:2]))
        if name.string in entries and (name.string in imported or before == "zwfs."):
            name.wrap(body.new_tag("a", href=entries[name.string], title="Open its entry in the API"))


def write_numbers(body: Tag) -> None:
    """Write 1.4e+08 as 1.4·10⁸, -1 as −1, and per cent after a space that breaks no line, but not in code."""
    for text in body.find_all(string=re.compile(r"\d|%")):
        if not text.find_parent(["code", "pre", "samp", "script", "style"]) and not text.find_parent(class_="sig"):
            minus = "-" if text.find_parent(class_=["math", "py"]) else "−"  # names of classes of Sphinx
            text.replace_with(PERCENT.sub("\u00a0%", MINUS.sub(minus, POWER.sub(power, text))))


def power(number: re.Match[str]) -> str:
    """Write one such number with a superscript; a factor of 1 is left out."""
    factor, sign, exponent = number.groups()
    ten = f"10{(sign.replace('+', '') + exponent).translate(DIGITS)}"
    return ten if factor == "1" else f"{factor.replace('-', '−')}·{ten}"


def add_variants(app: Sphinx, figure: Tag) -> None:
    """Show the dark and the narrow variants of a figure, in place, if there are files of them."""
    name = next(word for word in figure["class"] if word.startswith(VARIANTS)).removeprefix(VARIANTS)
    folders = *Path(app.srcdir, app.config.executed_notebooks).glob("*.files"), Path(app.srcdir, PICTURES)
    # In the class of a directive, Docutils writes hyphens.
    named = (file for folder in folders for file in folder.glob(f"{name.replace('-', '[-_]')}.dark.png"))
    first, light = next(named, None), figure.img
    if light is None or first is None:
        return
    files = {kind: first.with_suffix("").with_suffix(f".{kind}.png") for kind in ("dark", "narrow", "narrow-dark")}
    dark = copy.copy(light)
    light.insert_after(dark)
    dark.attrs |= shown(app, light, files["dark"], "src") | {"loading": "lazy"}
    new = BeautifulSoup("", "html.parser").new_tag
    for image, narrow, mode in ((light, "narrow", "only-light"), (dark, "narrow-dark", "only-dark")):
        image.wrap(new("picture", **{"class": mode}))
        if files[narrow].exists():
            source = new("source", media=PHONE, **shown(app, light, files[narrow], "srcset"))
            image.insert_before(source)
    if figure.source:
        figure["class"].append("narrow")


def shown(app: Sphinx, image: Tag, file: Path, name: str) -> dict[str, str]:
    """Copy a picture to the folder of `image`; return its size, and its address under a name."""
    images = Path(app.outdir, "_images")
    images.mkdir(parents=True, exist_ok=True)
    copy_asset_file(file, images)
    width, height = map(str, size(file))
    return {name: f"{image['src'].rpartition('/')[0]}/{file.name}", "width": width, "height": height}


def size(picture: Path) -> tuple[int, int]:
    """Return width and height of a PNG or SVG file in CSS pixels; PNG files hold two pixels for each."""
    head = picture.read_bytes()
    if picture.suffix == ".png":
        return tuple(length // 2 for length in struct.unpack(">II", head[16:24]))
    box = re.search(rb'viewBox="([^"]+)"', head)
    if box is None:
        raise ValueError(f"{picture.name}: expected PNG, or SVG with a viewBox")
    return tuple(round(float(length)) for length in box[1].split()[2:])


def finish_folder(app: Sphinx, exception: Exception | None) -> None:
    """Copy what pages load, leave out what they do not need, and write a page for each address that moved."""
    if exception is not None or app.builder.format != "html":
        return
    drop_icons(Path(app.outdir))
    for old, new in app.config.moved_pages.items():
        page = Path(app.outdir, f"{old}.html")
        address = os.path.relpath(Path(app.outdir, f"{new}.html"), page.parent)
        page.write_text(MOVED.format(address=Path(address).as_posix()), "utf-8")


def drop_icons(folder: Path) -> None:
    """Keep only the icons that pages show: their rules, and their letters in the font.

    The script of the theme draws all icons a second time, so it is emptied.
    """
    static = folder / "_static"
    (static / "scripts" / "fontawesome.js").write_text("", "utf-8")
    pages = "".join(page.read_text("utf-8") for page in folder.rglob("*.html"))
    shown = set(re.findall(r"\bfa-[\w-]+", pages))
    sheet = static / "styles" / "pydata-sphinx-theme.css"
    style = ICON.sub(lambda rule: rule[0] if shown & set(CLASS.findall(rule[0])) else "", sheet.read_text("utf-8"))
    sheets = style, (static / "styles" / "sphinx-book-theme.css").read_text("utf-8")
    letters = {int(code, 16) if code else ord(letter) for code, letter in LETTER.findall("".join(sheets))}
    file = static / "vendor" / "fontawesome" / "webfonts" / "fa-solid-900.ttf"
    sheet.write_text(FONT.sub(f"url({font_with(letters, file)})", style), "utf-8")


def font_with(letters: set[int], file: Path) -> str:
    """Return a font that holds only these letters, as a data URL."""
    font = TTFont(file, recalcTimestamp=False)
    subsetter = Subsetter()
    subsetter.populate(unicodes=letters)
    subsetter.subset(font)
    content = io.BytesIO()
    font.save(content)
    return f"data:font/ttf;base64,{base64.b64encode(content.getvalue()).decode()}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Finish each page, and their folder at the end."""
    app.add_config_value("moved_pages", {}, "html")
    app.connect("html-page-context", finish_page, priority=900)
    app.connect("build-finished", finish_folder)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
