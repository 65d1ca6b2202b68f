"""The public address of the project: one setting that all files follow, in both directions."""

import re
import shutil
import tomllib

import pytest
import yaml
from IPython.core.inputtransformer2 import TransformerManager

from book._tools import address
from book._tools.address import Address
from book._tools.notebook import read
from book._tools.project import Project, ToolError

from .conftest import ROOT

NOWHERE = Address()
PUBLISHED = Address("https://github.com/reader/sensor", "https://reader.example.org/sensor/", "10.1234/sensor.1")


def give(root, public):
    """Set the address of a copy of the project, as RELEASING describes."""
    file = root / "pyproject.toml"
    text = file.read_text("utf-8")
    for key in ("repository", "book", "doi"):
        text = re.sub(rf'(?m)^{key} = ".*"$', f'{key} = "{getattr(public, key)}"', text)
    file.write_text(text, "utf-8")
    address.address(Project(root))


def content(root):
    names = ["README.md", "CITATION.cff", "pyproject.toml"]
    names += [source.relative_to(root).as_posix() for source in Project(root).sources()]
    return {name: (root / name).read_bytes() for name in names}


@pytest.fixture
def copy(tmp_path):
    (tmp_path / "notebooks").mkdir()
    for name in ("README.md", "CITATION.cff", "pyproject.toml", "notebooks/identities.ipynb"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    return tmp_path


def test_files_follow_the_setting():
    # After a change: make address
    assert address.contents(Project(ROOT), address.setting(ROOT)) == content(ROOT)


def test_address_can_be_given_and_taken_away(copy):
    give(copy, NOWHERE)
    before = content(copy)
    assert not [name for name, text in before.items() if b"reader/sensor" in text or b"git clone" in text]
    give(copy, PUBLISHED)
    given = content(copy)
    assert not [name for name in before if before[name] == given[name]]
    assert address.contents(Project(copy), PUBLISHED) == given
    give(copy, NOWHERE)
    assert content(copy) == before


def test_files_name_the_address(copy):
    give(copy, PUBLISHED)
    cited = yaml.safe_load((copy / "CITATION.cff").read_text("utf-8"))
    assert (cited["repository-code"], cited["url"], cited["doi"]) == (*vars(PUBLISHED).values(),)
    assert cited["preferred-citation"]["doi"] != PUBLISHED.doi
    links = tomllib.loads((copy / "pyproject.toml").read_text("utf-8"))["project"]["urls"]
    assert links["Homepage"] == PUBLISHED.book
    assert links["Repository"] == PUBLISHED.repository
    readme = (copy / "README.md").read_text("utf-8")
    assert f"[Read the book]({PUBLISHED.book})" in readme
    assert f"](https://doi.org/{PUBLISHED.doi})" in readme


@pytest.mark.parametrize("public", [NOWHERE, PUBLISHED], ids=["clone", "published"])
def test_readme_shows_its_pictures(copy, public):
    """From a clone by its path; with an address also on other sites."""
    give(copy, public)
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", (copy / "README.md").read_text("utf-8"))
    start = "https://raw.githubusercontent.com/reader/sensor/main/" if public.repository else ""
    assert pictures
    assert all(picture.startswith(start) for picture in pictures)
    assert all((ROOT / picture.removeprefix(start)).is_file() for picture in pictures)


def test_a_cell_of_a_notebook_fetches_the_repository_on_colab_and_does_nothing_elsewhere(copy):
    give(copy, PUBLISHED)
    for source in Project(copy).sources():
        first, *others = (cell for cell in read(source).cells if cell.cell_type == "code")
        assert f"git clone -q --depth 1 {PUBLISHED.repository} " in first.source
        assert first.metadata.tags == ["remove-cell", "colab"]
        assert not first.outputs
        assert [cell.execution_count for cell in (first, *others)] == list(range(1, len(others) + 2))
        exec(TransformerManager().transform_cell(first.source), {})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('repository = "https://github.com/zwfs.git"', "repository = 'https://github.com/zwfs.git': expected"),
        ('repository = "https://github.com/a/b/"', "expected https://github.com/OWNER/NAME, or an empty string"),
        ('book = "https://example.org"', "expected https://SITE/ with a slash at its end"),
        ('doi = "https://doi.org/10.1/a"', "expected 10.NUMBER/NAME"),
        ("doi = 10", "doi = 10: expected"),
        ("doi = '10.1234/a\\1'", "expected 10.NUMBER/NAME"),
        ('url = ""', "url: expected one of repository, book, doi"),
    ],
)
def test_wrong_settings_are_refused(tmp_path, line, message):
    (tmp_path / "pyproject.toml").write_text(f"[tool.zwfs]\n{line}\n")
    with pytest.raises(ToolError, match=re.escape(message)):
        address.setting(tmp_path)
