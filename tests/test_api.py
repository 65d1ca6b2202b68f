"""The API page: it lists every public name, and its docstrings link."""

import importlib
import re
from pathlib import Path

import api
import pytest

import zwfs

PAGE = Path(__file__).parent.parent / "_build" / "html" / "book" / "api.html"


def test_public_names_are_functions_classes_and_documented_constants():
    names = api.public_names(importlib.import_module("zwfs.paper.dimple_diameter"))
    assert {"DARK_RING", "DiameterCurve", "crossing"} <= set(names)
    assert not [name for name in names if name.startswith("_") or name in ("np", "Pupil", "Any")]
    assert api.constants(importlib.import_module("zwfs.paper.dimple_diameter"))["DARK_RING"].startswith(
        "Diameter of the first"
    )


def test_a_module_in_no_group_is_told(monkeypatch):
    monkeypatch.setitem(api.GROUPS, "Metrics", ())
    with pytest.raises(api.ApiError, match=r"GROUPS and the package differ in zwfs\.metrics"):
        api.targets()


def test_every_public_module_is_in_a_group():
    assert {name for group in api.GROUPS.values() for name in group} == set(api.modules())


@pytest.mark.skipif(not PAGE.is_file(), reason="the book is not built: make book")
def test_every_public_name_is_on_the_api_page():
    page = PAGE.read_text("utf-8")
    listed = set(re.findall(r'id="(zwfs\.[\w.]+)"', page))
    public = {f"zwfs.{name}" for name in zwfs.__all__}
    for name in api.modules():
        module = importlib.import_module(name)
        own = [
            thing for thing in api.public_names(module) if getattr(zwfs, thing, None) is not getattr(module, thing)
        ]
        public |= {f"{name}.{thing}" for thing in own}
    assert sorted(public - listed) == []
    assert not re.search(r"0x[0-9a-f]{6,}", page)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("See `eq-low-rank` of the\nbook, page 3.", "See :eq:`eq-low-rank`, page 3."),
        (
            "Chambouleyron et al. 2024, section 3.1, equations (9) and (10).",
            "Chambouleyron et al. 2024, section 3.1, equations :eq:`eq-phase-shifted` and :eq:`eq-determinant`.",
        ),
        ("A `Pupil`, or `x[0]`, or ``code``.", "A :py:obj:`Pupil <zwfs.Pupil>`, or ``x[0]``, or ``code``."),
        ("The modulus |psi| is A", "The modulus \\|psi\\| is A"),
        ("Other authors 2020, equation (2).", "Other authors 2020, equation (2)."),
    ],
)
def test_docstrings_link(text, expected):
    assert api.linked(text) == expected
