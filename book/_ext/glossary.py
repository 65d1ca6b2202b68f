"""Links to the glossary: the first use of each of its terms on a page, with the definition."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from bs4 import BeautifulSoup
from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

GLOSSARY = "book/glossary"
WITHOUT = {GLOSSARY, "book/bibliography", "book/notation"}
TERM = re.compile(r"^(\w.*)\n  (\S.*)", re.MULTILINE)
ROLE = re.compile(r"\{\w+\}`([^`<]*?)(?: <[^`]*>)?`")
COMMON = {"phase", "rms"}  # words that every reader knows, in the glossary for their exact meaning
EMPHASIS = re.compile(r"\*([^*]+)\*")
PROSE = (nodes.paragraph, nodes.emphasis, nodes.strong, nodes.list_item)


class LinkTerms(SphinxTransform):
    """Link the first use of each term in the prose of a page, unless a role ``{term}`` links it."""

    default_priority = 500

    def apply(self) -> None:
        """Split the texts that use a term."""
        if self.env.docname in WITHOUT or self.env.docname.startswith("book/api"):
            return
        source = Path(self.env.doc2path(GLOSSARY))
        self.env.note_dependency(str(source))
        by_roles = (xref for xref in self.document.findall(pending_xref) if xref["reftype"] == "term")
        done = COMMON | {xref["reftarget"].lower() for xref in by_roles}
        missing = {term.lower(): term for term in terms(source) if term.lower() not in done}
        for text in list(self.document.findall(nodes.Text)):
            if missing and in_prose(text):
                text.parent.replace(text, list(self.linked(str(text), missing)))

    def linked(self, text: str, missing: dict[str, str]) -> Iterator[nodes.Node]:
        """Yield the parts of a text, with links to the missing terms, which are missing no longer."""
        while missing and (use := pattern(missing).search(text)):
            term = missing.pop(use[1].lower())
            yield nodes.Text(text[: use.start()])
            shown = nodes.inline("", use[0], classes=["xref", "std", "std-term"])
            about = {"refdomain": "std", "reftype": "term", "reftarget": term, "refdoc": self.env.docname}
            yield pending_xref("", shown, refexplicit=True, refwarn=True, **about)
            text = text[use.end() :]
        yield nodes.Text(text)


def terms(glossary: Path) -> list[str]:
    """Return the terms that the page of the glossary defines."""
    return [*definitions(glossary)]


@cache
def definitions(glossary: Path) -> dict[str, str]:
    """Return the definition of each term on the page of the glossary, as plain text."""
    entries = TERM.findall(glossary.read_text("utf-8").partition("```{glossary}")[2])
    return {term: EMPHASIS.sub(r"\1", ROLE.sub(r"\1", definition)) for term, definition in entries}


def define(body: BeautifulSoup, glossary: Path) -> None:
    """Give each link to a term its definition, which shows on hover and on focus."""
    texts = {f"term-{nodes.make_id(term)}": text for term, text in definitions(glossary).items()}
    for link in body.select("a:has(> .std-term)"):
        if text := texts.get(str(link["href"]).partition("#")[2].lower()):
            link["data-definition"] = link["aria-description"] = text


def pattern(missing: dict[str, str]) -> re.Pattern[str]:
    """Return the pattern of a term or its plural; a longer term goes before one that it contains."""
    either = "|".join(re.escape(term) for term in sorted(missing, key=len, reverse=True))
    return re.compile(rf"(?<![-\w])({either})s?(?![-\w]| sens)", re.IGNORECASE)


def in_prose(text: nodes.Text) -> bool:
    """Whether a text stands in a paragraph, and not in a link, a button, a table or the text of another page."""
    parent = text.parent
    place = parent.index(text)
    if place and isinstance(parent[place - 1], nodes.raw) and parent[place - 1].astext().startswith("<button"):
        return False
    while isinstance(parent, PROSE):
        if isinstance(parent, nodes.paragraph):
            return not isinstance(parent.parent, nodes.entry)
        parent = parent.parent
    return False


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the links to each page."""
    app.add_transform(LinkTerms)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
