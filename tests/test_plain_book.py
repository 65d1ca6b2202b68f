"""``jupyter-book build .`` builds the whole book from the tracked files alone, without a warning."""

import pytest
from bs4 import BeautifulSoup

pytestmark = pytest.mark.slow


def read(file):
    return BeautifulSoup(file.read_text("utf-8"), "html.parser")


def test_claims_have_their_verdicts(plain_book):
    rows = read(plain_book / "book" / "claims.html").select("table.claims tbody tr")
    assert len(rows) == 21
    assert all(row.select_one("[class^=verdict]") for row in rows)
    assert "The 21 claims" in read(plain_book / "book" / "index.html").article.get_text()


def test_performance_page_has_tables_and_pictures(plain_book):
    page = read(plain_book / "book" / "performance.html")
    assert len(page.select("article table")) >= 10
    assert all((plain_book / "book" / image["src"]).is_file() for image in page.select("figure img"))


def test_live_page_has_its_data(plain_book):
    for script in read(plain_book / "book" / "live.html").select("article script[src]"):
        assert (plain_book / "book" / script["src"]).stat().st_size > 0


def test_every_figure_of_the_paper_has_a_card_with_its_notebook(plain_book):
    for page in (plain_book / "notebooks").glob("fig*.html"):
        cards = read(page).select(".run-card")
        assert cards, page.name
        for link in (link for card in cards for link in card.select("a.download")):
            assert (page.parent / link["href"]).resolve().is_file()


def test_pages_have_mathematics_and_the_address_leads_to_the_front_page(plain_book):
    assert (plain_book / "_static" / "mathjax" / "tex-chtml-full.js").is_file()
    assert 'url=book/index.html"' in (plain_book / "index.html").read_text("utf-8")


def test_no_pdf_is_linked(plain_book):
    assert "zwfs.pdf" not in (plain_book / "book" / "index.html").read_text("utf-8")


def test_a_build_in_another_folder_gives_the_same_bytes(plain_book, build_plain_book, tmp_path):
    again = build_plain_book(tmp_path / "another folder")
    files = [{file.relative_to(top) for file in top.rglob("*") if file.is_file()} for top in (plain_book, again)]
    assert files[0] == files[1]
    assert [
        name for name in sorted(files[0]) if (plain_book / name).read_bytes() != (again / name).read_bytes()
    ] == []
