"""What a release needs: a complete manifest for checkers, a changelog with an entry, and a careful workflow."""

import os
import re
import subprocess

import pytest
import yaml

import zwfs
from book._tools import run
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
    authors = [f"{author['given-names']} {author['family-names']}" for author in cited["authors"]]
    assert [author["name"] for author in check["paper"]["authors"]] == authors


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
    (step,) = [step for step in workflow["jobs"]["build"]["steps"] if "tag" in step.get("name", "")]
    tag = {"GITHUB_REF_NAME": f"v{pattern.format(zwfs.__version__)}"}
    done = subprocess.run(["bash", "-c", step["run"]], cwd=ROOT, env=os.environ | tag, capture_output=True)
    assert (done.returncode == 0) == passes
