"""The API page of a plain build: it lists every public name, and its docstrings link."""

import inspect
import pkgutil
from importlib import import_module

import pytest
from bs4 import BeautifulSoup

import zwfs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page(plain_book):
    return BeautifulSoup((plain_book / "book" / "api.html").read_text("utf-8"), "html.parser")


def public_modules():
    names = (module.name for module in pkgutil.walk_packages(zwfs.__path__, "zwfs."))
    return [import_module(name) for name in names if "._" not in name]


def test_every_public_function_and_class_is_on_the_page_once(page):
    listed = [name["id"] for name in page.select("dt[id^='zwfs.']")]
    assert {f"zwfs.{name}" for name in zwfs.__all__ if callable(getattr(zwfs, name))} <= set(listed)
    for module in public_modules():
        for name, thing in vars(module).items():
            if not (inspect.isclass(thing) or inspect.isfunction(thing)) or name.startswith("_"):
                continue
            if thing.__module__ == module.__name__:
                package = module.__name__.split(".")[:-1]
                places = [f"{'.'.join(package[:depth])}.{name}" for depth in range(1, len(package) + 1)]
                assert sum(listed.count(place) for place in {*places, f"{module.__name__}.{name}"}) == 1, name


def test_the_page_lists_constants_with_their_docstrings(page):
    ring = page.find(id="zwfs.paper.dimple_diameter.DARK_RING")
    assert "dark ring" in ring.parent.dd.get_text()


def test_modules_are_sections_of_their_group(page):
    group = page.find("section", id="reconstructors")
    modules = [heading.get_text().rstrip("#") for heading in group.select("h3")]
    assert "zwfs.reconstructors.phase_shifted" in modules
    assert not [name for name in modules if "._" in name or not name.startswith("zwfs.reconstructors")]


def test_docstrings_link_names_and_equations(page):
    phase_shifted = page.find(id="zwfs.PhaseShifted").parent
    links = {link["href"] for link in phase_shifted.find_all("a", href=True)}
    # The paper numbers its equations, ours have labels.
    assert {"phase_shifted.html#equation-eq-phase-shifted", "theory.html#equation-eq-shared-wave"} <= links
    assert page.find(id="module-zwfs.reconstructors").find("a", href="#zwfs.Reconstruction") is not None


def test_the_page_names_no_object_of_one_process(page):
    assert " at 0x" not in page.get_text()
