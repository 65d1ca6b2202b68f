"""An executed notebook as one HTML file, with its pictures and the font of its formulas in it."""

import base64
import copy
import html
import io
import mimetypes
import re
import shutil
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

import bs4
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell

from studies.kit.results import SCREENS, published

from .notebook import to_bytes
from .project import Project

STYLE = Path(__file__).with_name("standalone.css")
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
MATHEMATICS = "book._ext.mathematics"
# Extensions for the other pages of the book and for its navigation.
OMITTED = ("book._ext.", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_book_theme", "sphinx_comments",
           "sphinx_copybutton", "sphinx_togglebutton")  # fmt: skip
FRAME = """<!DOCTYPE html>
<html lang="en" data-theme="light">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>{body}</main>
</body>
</html>
"""
# Elements that the page does not need; Markdown can hold any HTML.
ACTIVE = ["script", "iframe", "object", "embed", "base", "meta", "link", "form"]


def page(
    project: Project, name: str, notebook: NotebookNode, files: list[Path], scratch: Path, *, changed: bool = False
) -> tuple[str, str]:
    """Build the page of an executed notebook; return it and the warnings of Sphinx, a line each.

    Sphinx reads the whole book with its settings and writes this page: equations have the same numbers as in the
    book. Links to other pages become plain text. With `changed`, figures lose their descriptions.
    """
    source, output = scratch / "source", scratch / "html"
    _stage(project, name, notebook, files, source)
    warnings = _sphinx(source, output, f"notebooks/{name}.ipynb")
    embedded = _embed(output, f"notebooks/{name}.html", {file.name for file in files}, changed)
    marked = [line for line in warnings.splitlines() if f"notebooks/{name}.ipynb" in line]
    return embedded, "\n".join(line.replace(f"{source}/", "") for line in marked)


def _stage(project: Project, name: str, notebook: NotebookNode, files: list[Path], source: Path) -> None:
    """Lay out the sources for Sphinx: the committed book, with this notebook in its place."""
    root = project.root
    (source / "book").mkdir(parents=True)
    for file in (root / "_config.yml", root / "_toc.yml", *root.glob("book/*.md"), *root.glob("book/*.bib")):
        shutil.copyfile(file, source / file.relative_to(root))
    downloads = source / "notebooks" / "downloads"
    downloads.mkdir(parents=True)
    for notebook_of_book in project.sources():
        shutil.copyfile(notebook_of_book, source / "notebooks" / notebook_of_book.name)
    (source / "notebooks" / f"{name}.ipynb").write_bytes(to_bytes(_with_downloads(notebook, files)))
    for file in files:
        shutil.copyfile(file, downloads / file.name)


def _with_downloads(notebook: NotebookNode, files: list[Path]) -> NotebookNode:
    """Return the notebook with links to the files of each figure under it."""
    result = copy.copy(notebook)
    result.cells = []
    for cell in notebook.cells:
        result.cells.append(cell)
        for figure in published(cell.source) if cell.cell_type == "code" else []:
            own = [file.name for file in files if file.stem in (figure, figure + SCREENS)]
            links = (f"{{download}}`{file} <downloads/{file}>`" for file in own)
            result.cells.append(new_markdown_cell("Download: " + " · ".join(links), id=f"files-{figure}"[:64]))
    return result


def _sphinx(source: Path, output: Path, document: str) -> str:
    """Write one document with Sphinx, and return its warnings."""
    from jupyter_book.config import get_final_config
    from sphinx.application import Sphinx
    from sphinx.util.docutils import docutils_namespace, patch_docutils

    config, _ = get_final_config(
        user_yaml=source / "_config.yml",
        cli_config={"external_toc_path": str(source / "_toc.yml"), "latex_individualpages": False},
        sourcedir=source,
    )
    config |= {
        "extensions": [MATHEMATICS, *(name for name in config["extensions"] if not name.startswith(OMITTED))],
        "html_theme": "basic",
        "html_theme_options": {},
        "html_static_path": [],
        "templates_path": [],
        "html_css_files": [],
        "html_copy_source": False,
        "html_permalinks": False,
        "pygments_style": "tango",
    }
    warnings = io.StringIO()
    with patch_docutils(), docutils_namespace():
        app = Sphinx(
            source, None, output, output.with_name("doctrees"), "html", config, status=None, warning=warnings
        )
        app.build(filenames=[str(source / document)])
    return COLOUR.sub("", warnings.getvalue())


def _embed(output: Path, document: str, published: set[str], changed: bool) -> str:
    """Return a page that Sphinx wrote, with its pictures and styles in it, and without active elements."""
    file = output / document
    soup = bs4.BeautifulSoup(file.read_text("utf-8"), "html.parser")
    body = soup.find("div", class_="body")
    for element in body.find_all(ACTIVE):
        element.decompose()
    if changed:
        for picture in body.select("img[alt]"):
            picture["alt"] = "Figure of this run; the CSV file has its numbers."
    for picture in body.find_all("img"):
        source = file.parent / unquote(picture.get("src", ""))
        if source.is_file():
            picture["src"] = _data(source)
        else:
            picture.replace_with(picture.get("alt", ""))
    for link in body.find_all("a"):
        target = urlsplit(link.get("href", ""))
        filename = unquote(target.path).rpartition("/")[2]
        if "download" in link.get("class", ()) and filename in published:
            link["href"] = quote(filename)
        elif target.scheme not in ("http", "https", "mailto") and (target.scheme or target.netloc or target.path):
            link.unwrap()
    sheets = [sheet["href"].partition("?")[0] for sheet in soup.find_all("link", rel="stylesheet")]
    style = [(file.parent / sheet).read_text("utf-8") for sheet in sheets if not urlsplit(sheet).scheme]
    return FRAME.format(
        title=html.escape(body.find("h1").get_text()),
        style="\n".join([*style, STYLE.read_text("utf-8")]),
        body="".join(map(str, body.contents)),
    )


def _data(file: Path) -> str:
    """Return a data URL that holds a file."""
    kind = mimetypes.guess_type(file.name)[0]
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"
