"""What a release needs: a complete manifest for checkers, a changelog with an entry, and a careful workflow."""

import os
import re
import subprocess

import pytest
import yaml

import zwfs
from book._tools import release, run
from book._tools.project import Project

from .conftest import ROOT

PROJECT = Project(ROOT)


def test_manifest_names_every_notebook_and_no_missing_file():
    text = (ROOT / "codecheck.yml").read_bytes()
    assert text == run.manifest(PROJECT), "run make figures"
    check = yaml.safe_load(text)
    assert all((ROOT / entry["file"]).is_file() for entry in check["manifest"])
    assert all(entry["comment"] for entry in check["manifest"])
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["preferred-citation"]
    assert check["paper"]["reference"] == f"https://doi.org/{cited['doi']}"
    authors = [f"{one['given-names']} {one['family-names']}" for one in cited["authors"]]
    assert [one["name"] for one in check["paper"]["authors"]] == authors


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("## [1.2.0] - 2026-01-01\n\n### Added\n\n- New.\n\n## [1.1.0]\n", None),
        ("## [1.2.0]\n\n## [1.1.0]\n\n- Old.\n", "lists no change"),
        ("## [1.1.0]\n\n- Old.\n", "the newest entry is 1.1.0: expected 1.2.0"),
    ],
)
def test_changelog_needs_an_entry_of_the_version(text, message):
    if message is None:
        release.check_changelog(text, "1.2.0")
    else:
        with pytest.raises(release.ReleaseError, match=message):
            release.check_changelog(text, "1.2.0")


def test_unit_tests_are_those_of_the_package_and_an_unknown_python_is_refused():
    tests = release.unit_tests(PROJECT)
    assert {"tests/test_sensor.py", "tests/test_pupil.py"} <= set(tests)
    assert all((ROOT / f"tests/test_{name}.py").is_file() for name in release.CORE)
    assert "tests/test_book.py" not in tests
    with pytest.raises(release.ReleaseError, match=r"2\.7: expected one of 3\.11, 3\.12, 3\.13, lowest"):
        release.pythons(PROJECT, ["2.7"])


@pytest.mark.parametrize("name", ["ci.yml", "lock.yml", "release.yml"])
def test_workflows_pin_actions_and_have_the_least_privileges(name):
    text = (ROOT / ".github" / "workflows" / name).read_text("utf-8")
    used = re.findall(r"uses: (\S+)@(\S+)", text)
    assert used
    assert all(re.fullmatch("[0-9a-f]{40}", commit) for _, commit in used)
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] in ({}, {"contents": "read"})
    checkouts = [step for job in workflow["jobs"].values() for step in job["steps"] if "checkout" in str(step)]
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)
    for job in workflow["jobs"].values():
        writes = {right for right, level in job.get("permissions", {}).items() if level == "write"}
        assert writes <= {"attestations", "id-token", "pages"}
        # What can publish runs no code of this repository.
        assert not (writes and any("run" in step for step in job["steps"]))


@pytest.mark.parametrize(("pattern", "passes"), [("{}", True), (".*", False), ("{}.1", False)])
def test_a_release_needs_the_version_of_the_package_in_its_tag(pattern, passes):
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text("utf-8"))
    (step,) = [one for one in workflow["jobs"]["build"]["steps"] if "tag" in one.get("name", "")]
    tag = {"GITHUB_REF_NAME": f"v{pattern.format(zwfs.__version__)}"}
    done = subprocess.run(["bash", "-c", step["run"]], cwd=ROOT, env=os.environ | tag, capture_output=True)
    assert (done.returncode == 0) == passes
