"""Formulas as MathML, which browsers draw and screen readers speak without a program."""

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.locale import _
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator

CLASSES = "math notranslate nohighlight"
CONVERTER = LatexToMathML(fancy_error=False)
LOGGER = logging.getLogger(__name__)


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line of text."""
    translator.body.append(f"{translator.starttag(node, 'span', '', CLASS=CLASSES)}{mathml(node)}</span>")
    raise nodes.SkipNode


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula on lines of its own, after its number."""
    translator.body.append(translator.starttag(node, "div", CLASS=CLASSES))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({get_node_equation_number(translator, node)})')
        translator.add_permalink_ref(node, _("Link to this equation"))
        translator.body.append("</span>")
    translator.body.append(f'<div class="formula">{mathml(node)}</div></div>\n')
    raise nodes.SkipNode


def mathml(node: nodes.math | nodes.math_block) -> str:
    """Return a formula as MathML; warn of a formula that cannot be read, and return it as it is written."""
    try:
        return CONVERTER.convert_with_local_state(node.astext(), displaystyle=isinstance(node, nodes.math_block))
    except LatexError as error:
        LOGGER.warning("formula %r: %s", node.astext(), error, location=node)
        return nodes.unescape(node.astext())


def setup(app: Sphinx) -> dict[str, bool]:
    """Offer the renderer, which `html_math_renderer` names."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
