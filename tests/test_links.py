"""Links of the book: from equations to code and tests, and from the first use of a term to the glossary."""

import re

import pytest
from bs4 import BeautifulSoup

from book._ext import api, glossary

from .conftest import ROOT


def test_equations_of_the_paper_name_their_code_and_its_tests():
    text = "\n".join((ROOT / "book" / page).read_text("utf-8") for page in api.PAPER)
    lines = re.findall(r"^Code: (.*)", text, re.MULTILINE)
    assert len(lines) >= 8
    for line in lines:
        assert re.match(r"\{py:obj\}`zwfs\.[\w.]+`", line)
        assert all((ROOT / "tests" / name).is_file() for name in re.findall(r"`(test_\w+\.py)`", line))


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("The reference waves interfere.", ["reference waves"]),
        ("The wavefront error of a wavefront", ["wavefront error", "wavefront"]),
        ("A wavefront sensor, a phase shift, and a phase-shifted image", ["phase shift"]),
        ("The phase-shifted iteration", ["phase-shifted iteration"]),
        ("Maximum likelihood, then maximum likelihood", ["Maximum likelihood"]),
    ],
)
def test_terms_are_linked_at_their_first_use(text, terms):
    names = glossary.terms(ROOT / "book" / "glossary.md")
    assert len(names) > 25
    missing, links = {name.lower(): name for name in names}, []
    while match := glossary.pattern(missing).search(text):
        del missing[match[1].lower()]
        links.append(match[0])
        text = text[match.end() :]
    assert links == terms


def test_links_carry_the_definition_of_their_term():
    link = '<p><a href="glossary.html#{}"><span class="std-term">x</span></a></p>'
    body = BeautifulSoup(
        "".join(map(link.format, ("term-Cramer-Rao-bound", "term-dimple", "term-x"))), "html.parser"
    )
    glossary.define(body, ROOT / "book" / "glossary.md")
    bound, dimple, unknown = body.find_all("a")
    assert bound["data-definition"].startswith("The smallest error")
    assert dimple["data-definition"].endswith("passes through it by the phase shift.")
    assert "data-definition" not in unknown.attrs
