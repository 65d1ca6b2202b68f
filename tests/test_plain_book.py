"""``jupyter-book build .`` builds the whole book from the tracked files alone, without a warning."""

import inspect
import pkgutil
import re
import shutil
import subprocess
import sys
from importlib import import_module

import pytest
from bs4 import BeautifulSoup

import zwfs
from book._ext import api

from .conftest import ROOT


def read(file):
    return BeautifulSoup(file.read_text("utf-8"), "html.parser")


def build(root):
    """Run Jupyter Book on a copy of the tracked files, warnings as errors, and return the folder of pages."""
    listed = subprocess.run(["git", "-C", ROOT, "ls-files"], capture_output=True, text=True, check=True).stdout
    for name in filter(lambda name: (ROOT / name).is_file(), listed.splitlines()):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, root / name)
    jupyter_book = [sys.executable, "-c", "from jupyter_book.cli.main import main; main()"]
    command = [*jupyter_book, "build", "-W", "-n", "--keep-going", "."]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return root / "_build" / "html"


@pytest.fixture(scope="module")
def plain_book(tmp_path_factory):
    return build(tmp_path_factory.mktemp("plain"))


def test_claims_have_their_verdicts(plain_book):
    page = read(plain_book / "book" / "claims.html")
    rows = page.select("table.claims tbody tr")
    assert len(rows) == 21
    assert all(row.select_one("[class*=verdict]") for row in rows)
    for row in rows[:20]:
        name = row.select_one("td:first-child a")["href"].removeprefix("#")
        rule = page.find(id=name)
        assert f"number: {int(row.td.get_text().partition('.')[0])}" in rule.find_parent("details").get_text()
        assert "def numbers(" in rule.find_parent("details").get_text()
    counts = [int(text) for text in re.findall(r"(?:holds?|note|part|here): (\d+) \(", page.article.get_text())]
    assert sum(counts) == 21


def test_figures_have_cards_with_their_notebooks_and_the_address_leads_to_the_front_page(plain_book):
    for notebook in (ROOT / "notebooks").glob("fig*.ipynb"):
        page = plain_book / "notebooks" / f"{notebook.stem}.html"
        cards = read(page).select(".run-card")
        assert cards, page.name
        for link in (link for card in cards for link in card.select("a.download")):
            assert (page.parent / link["href"]).resolve().is_file()
    assert 'url=book/index.html"' in (plain_book / "index.html").read_text("utf-8")


def test_names_of_the_package_in_code_lead_to_the_api(plain_book):
    page = plain_book / "book" / "index.html"
    links = {link.get_text(): link["href"] for link in read(page).select(".highlight a")}
    assert links.keys() >= {"Pupil", "ZernikeSensor", "MaximumLikelihood", "reconstruction_error"}
    for name, address in links.items():
        file, _, place = address.partition("#")
        assert name in read(page.parent / file).find(id=place).get_text()


def test_equations_are_numbered_through_the_book_and_those_of_the_paper_as_there(plain_book):
    labels = api.paper_labels(ROOT / "book")
    assert len(labels) == 16
    named = {1: "eq-propagation", 6: "eq-arccos", 9: "eq-phase-shifted", 16: "eq-cost"}
    assert {number: labels[number - 1] for number in named} == named
    pages = [plain_book / "book" / page.replace(".md", ".html") for page in (*api.PAPER, "theory.md")]
    numbers = [
        int(number.get_text().strip("()#\uf0c1")) for page in pages for number in read(page).select(".eqno")
    ]
    assert numbers == list(range(1, len(numbers) + 1))


def test_book_names_no_public_address(plain_book):
    for file in plain_book.glob("**/*.html"):
        addresses = [link["href"] for link in read(file).find_all("a", href=True)]
        assert not re.search("executablebooks|/issues/new|/blob/|mybinder", " ".join(addresses)), file.name
    assert (plain_book / "_static" / "zwfs.zip").is_file()


# The API pages


@pytest.fixture(scope="module")
def api_pages(plain_book):
    return [read(page) for page in sorted((plain_book / "book").glob("api_*.html"))]


def public_modules():
    names = (module.name for module in pkgutil.walk_packages(zwfs.__path__, "zwfs."))
    return [import_module(name) for name in names if "._" not in name]


def test_every_public_function_and_class_is_on_the_pages_once(api_pages):
    listed = [name["id"] for page in api_pages for name in page.select("dt[id^='zwfs.']")]
    assert {f"zwfs.{name}" for name in zwfs.__all__ if callable(getattr(zwfs, name))} <= set(listed)
    for module in public_modules():
        for name, thing in vars(module).items():
            hidden = not hasattr(module, "__path__") and name not in getattr(module, "__all__", vars(module))
            if not (inspect.isclass(thing) or inspect.isfunction(thing)) or name.startswith("_") or hidden:
                continue
            if thing.__module__ == module.__name__:
                package = module.__name__.split(".")[:-1]
                places = [f"{'.'.join(package[:depth])}.{name}" for depth in range(1, len(package) + 1)]
                assert sum(listed.count(place) for place in {*places, f"{module.__name__}.{name}"}) == 1, name


def test_docstrings_link_names_and_equations(plain_book):
    page = read(plain_book / "book" / "api_reconstructors.html")
    phase_shifted = page.find(id="zwfs.PhaseShifted").parent
    links = {link["href"] for link in phase_shifted.find_all("a", href=True)}
    # The paper numbers its equations, ours have labels.
    assert {"phase_shifted.html#equation-eq-phase-shifted", "theory.html#equation-eq-shared-wave"} <= links
    assert page.find(id="module-zwfs.reconstructors").find("a", href="#zwfs.Reconstruction") is not None
