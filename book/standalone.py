"""One executed notebook as one HTML file that opens by itself: pictures and mathematics are in it."""

import base64
import copy
import html
import importlib.util
import io
import mimetypes
import os
import re
import shutil
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

import bs4
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell
from runner import Project, to_bytes

from zwfs.companion.results import published

HERE = Path(__file__).parent
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
# What in the book serves its navigation; the page has none.
LEFT_OUT = {
    "api", "cards", "claims", "finish", "live", "performance", "sphinx.ext.autodoc", "sphinx.ext.napoleon",
    "sphinx_book_theme", "sphinx_comments", "sphinx_copybutton", "sphinx_togglebutton",
}  # fmt: skip
FRAME = """<!DOCTYPE html>
<html lang="en" data-theme="light">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
{scripts}
</head>
<body>
<main>{body}</main>
</body>
</html>
"""
MATHJAX = """
window.MathJax = {
  tex: {tags: "none"},
  svg: {fontCache: "global"},
  options: {enableMenu: false, ignoreHtmlClass: "tex2jax_ignore|document", processHtmlClass: "math"}
};
"""
# Neither of the page's own; Markdown can hold any HTML.
ACTIVE = ["script", "iframe", "object", "embed", "base", "meta", "link", "form"]


def page(project: Project, name: str, notebook: NotebookNode, files: list[Path], scratch: Path) -> tuple[str, str]:
    """Build the page of a notebook.

    The book's own Sphinx settings are used, and its other pages are read beside this one: equations have the
    numbers that they have there. Links to other pages become plain text.

    Parameters
    ----------
    project : Project
    name : str
        The stem of the notebook's file.
    notebook : NotebookNode
        Executed.
    files : list of Path
        What it published: the page links to them by their name, as files beside it.
    scratch : Path
        A folder to work in.

    Returns
    -------
    html : str
    warnings : str
        What Sphinx says of this page, a line each.
    """
    source, output = scratch / "source", scratch / "html"
    _stage(project, name, notebook, files, source)
    warnings = _sphinx(source, output, f"notebooks/{name}.ipynb")
    embedded = _embed(output, f"notebooks/{name}.html", {file.name for file in files})
    marked = [line for line in warnings.splitlines() if f"notebooks/{name}.ipynb" in line]
    return embedded, "\n".join(line.replace(f"{source}/", "") for line in marked)


def _stage(project: Project, name: str, notebook: NotebookNode, files: list[Path], source: Path) -> None:
    """Lay out what Sphinx reads: the book as it is committed, with this notebook in its place."""
    for file in (project.root / "_config.yml", project.root / "_toc.yml", *(project.root / "book").rglob("*")):
        if file.is_file() and file.suffix in (".yml", ".md", ".bib"):
            place = source / file.relative_to(project.root)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
    downloads = source / "notebooks" / "downloads"
    downloads.mkdir(parents=True)
    for other in project.sources():
        shutil.copyfile(other, source / "notebooks" / other.name)
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
            links = (f"{{download}}`{file.name} <downloads/{file.name}>`" for file in files if file.stem == figure)
            result.cells.append(new_markdown_cell("Download: " + " · ".join(links), id=f"files-{figure}"[:64]))
    return result


def _sphinx(source: Path, output: Path, document: str) -> str:
    """Let Sphinx write one document, and return its warnings."""
    from jupyter_book.config import get_final_config
    from sphinx.application import Sphinx
    from sphinx.util.docutils import docutils_namespace, patch_docutils

    config, _ = get_final_config(
        user_yaml=source / "_config.yml",
        cli_config={"external_toc_path": str(source / "_toc.yml"), "latex_individualpages": False},
        sourcedir=source,
    )
    config |= {
        "extensions": [name for name in config["extensions"] if name not in LEFT_OUT],
        "html_theme": "basic",
        "html_theme_options": {},
        "html_static_path": [],
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
        app.connect("env-updated", _forget_foreign)
        app.build(filenames=[str(source / document)])
    return COLOUR.sub("", warnings.getvalue())


def _forget_foreign(app: Any, env: Any) -> None:
    """Drop pictures that lie neither among the sources nor among the results: Sphinx would copy any file."""
    for picture in list(env.images):
        if not _is_within(Path(app.srcdir).parent, Path(app.srcdir) / picture):
            del env.images[picture]


def _is_within(folder: Path, file: Path) -> bool:
    """Say whether a file lies in a folder, also after every symbolic link is followed."""
    return Path(os.path.realpath(file)).is_relative_to(os.path.realpath(folder))


def _embed(output: Path, document: str, beside: set[str]) -> str:
    """Return the content of a page that Sphinx wrote, with the pictures and styles that it loads in it."""
    file = output / document
    soup = bs4.BeautifulSoup(file.read_text("utf-8"), "html.parser")
    body = soup.find("div", class_="body")
    for element in body.find_all(ACTIVE):
        element.decompose()
    for picture in body.find_all("img"):
        source = file.parent / unquote(picture.get("src", ""))
        if _is_within(output, source) and source.is_file():
            picture["src"] = _data(source)
        else:
            picture.replace_with(picture.get("alt", ""))
    for link in body.find_all("a"):
        target = urlsplit(link.get("href", ""))
        filename = unquote(target.path).rpartition("/")[2]
        if "download" in link.get("class", ()) and filename in beside:
            link["href"] = quote(filename)
        elif target.scheme not in ("http", "https", "mailto") and (target.scheme or target.netloc or target.path):
            link.unwrap()
    sheets = [sheet["href"].partition("?")[0] for sheet in soup.find_all("link", rel="stylesheet")]
    style = [(file.parent / sheet).read_text("utf-8") for sheet in sheets if not urlsplit(sheet).scheme]
    scripts = [MATHJAX, _mathjax()] if body.find(class_="math") else []
    return FRAME.format(
        policy=_policy(scripts),
        title=html.escape(body.find("h1").get_text()),
        style="\n".join([*style, (HERE / "standalone.css").read_text("utf-8")]),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
        body="".join(map(str, body.contents)),
    )


def _policy(scripts: list[str]) -> str:
    """Return what a browser may load and run: what is in the page, and of scripts only these."""
    digests = (base64.b64encode(sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; font-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _data(file: Path) -> str:
    """Return a file as an address that holds it."""
    kind = mimetypes.guess_type(file.name)[0]
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"


def _mathjax() -> str:
    """MathJax in one piece: the letters are drawn, so it loads no fonts."""
    package = importlib.util.find_spec("sphinx-mathjax-offline")
    code = Path(package.origin).parent / "static" / "mathjax" / "tex-svg-full.js"
    return code.read_text("utf-8").replace("</script", "<\\/script")
