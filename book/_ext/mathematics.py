"""Formulas as MathML, which browsers draw and screen readers speak without a program."""

import base64
import html
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.locale import _
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator

CLASSES = "math notranslate nohighlight"
CONVERTER = LatexToMathML(fancy_error=False)
STYLE = Path(__file__).with_name("math.css")
FONT = STYLE.with_suffix(".woff2")
SPACING = re.compile(r"(?<=\\\\)\[[\d.]+e[mx]\]")  # after a row: math-core would print it
MARK = re.compile(r"[.,;:!?)\]]+")  # may not begin a line
LOGGER = logging.getLogger(__name__)


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line of text."""
    translator.body.append(f"{translator.starttag(node, 'span', '', CLASS=CLASSES)}{mathml(node)}</span>")
    raise nodes.SkipNode


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed formula, after its number."""
    translator.body.append(translator.starttag(node, "div", CLASS=CLASSES))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({get_node_equation_number(translator, node)})')
        translator.add_permalink_ref(node, _("Link to this equation"))
        translator.body.append("</span>")
    translator.body.append(f'<div class="formula">{mathml(node)}</div></div>\n')
    raise nodes.SkipNode


def mathml(node: nodes.math | nodes.math_block) -> str:
    """Return a formula as MathML; warn of a formula that cannot be read, and return it as it is written."""
    text = SPACING.sub("", node.astext())
    try:
        return CONVERTER.convert_with_local_state(text, displaystyle=isinstance(node, nodes.math_block))
    except LatexError as error:
        LOGGER.warning("formula %r: %s", text, error, location=node)
        return html.escape(text)


def keep_marks(app: Sphinx, tree: nodes.document, page: str) -> None:
    """Keep the mark after a formula on its line: browsers may begin a line after any formula."""
    for formula in list(tree.findall(nodes.math)):
        line, place = formula.parent, formula.parent.index(formula)
        after = line[place + 1] if place + 1 < len(line) else ""
        if isinstance(after, nodes.Text) and (mark := MARK.match(after)):
            together = nodes.inline("", "", formula, nodes.Text(mark[0]), classes=["unbroken"])
            line[place : place + 2] = [together, nodes.Text(after[mark.end() :])]


def add_style(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: nodes.document) -> None:
    """Load the style of formulas on pages that have some."""
    if "<math" in context.get("body", ""):
        app.add_css_file(STYLE.name)


def write_style(app: Sphinx, exception: Exception | None) -> None:
    """Write the style of formulas, with its font in it: a font that arrives later moves the text."""
    if exception is None and app.builder.format == "html":
        font = f"data:font/woff2;base64,{base64.b64encode(FONT.read_bytes()).decode()}"
        style = STYLE.read_text("utf-8").replace(FONT.name, font)
        Path(app.outdir, "_static", STYLE.name).write_text(style, "utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Offer the renderer, which `html_math_renderer` names."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.connect("doctree-resolved", keep_marks)
    app.connect("html-page-context", add_style)
    app.connect("build-finished", write_style)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
