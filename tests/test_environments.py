"""All files that name a version of Python or of a package agree."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import zwfs

ROOT = Path(__file__).parent.parent
LOCK = "environment/requirements.lock"
UV_LOCK = "environment/uv.txt"
CHECK = "environment/check.py"


def read(name):
    return (ROOT / name).read_text("utf-8")


PROJECT = tomllib.loads(read("pyproject.toml"))["project"]
PINS = re.findall(r"(?m)^([\w.-]+)==([^\s;]+)", read(LOCK))
LOCKED = {canonicalize_name(name): version for name, version in PINS}


def stated(pattern, name):
    """All that a pattern finds in a file, and it finds something."""
    matches = re.findall(pattern, read(name))
    assert matches, f"{name} no longer says {pattern}"
    return set(matches)


def supported():
    """The versions of Python that the package says it runs on, in order."""
    named = [re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line) for line in PROJECT["classifiers"]]
    return sorted((match[1] for match in named if match), key=Version)


def test_oldest_python_is_the_same_everywhere():
    oldest = supported()[0]
    assert PROJECT["requires-python"] == f">={oldest}"
    assert stated(r"--python-version (\S+)", "Makefile") == {oldest}
    assert stated(r"zwfs needs Python (\S+)", "Makefile") == {oldest}
    assert stated(r"sys.version_info < \((\d+), (\d+)\)", "Makefile") == {tuple(oldest.split("."))}
    assert stated(r'target-version = "py(\d+)"', "pyproject.toml") == {oldest.replace(".", "")}


def test_every_supported_python_is_tested_and_environments_have_the_newest():
    workflow = yaml.safe_load(read(".github/workflows/ci.yml"))
    assert workflow["jobs"]["check"]["strategy"]["matrix"]["python"] == supported()
    *others, newest = supported()
    assert f"Python {', '.join(others)} or {newest}" in read("README.md")
    assert stated(r"(?m)^  - python=(\S+)$", "environment/environment.yml") == {newest}
    pinned = r"(?m)^FROM python:(\d+\.\d+)\.\d+-slim-bookworm@sha256:[0-9a-f]{64}$"
    assert stated(pinned, "environment/Dockerfile") == {newest}
    assert stated(r"^python-(\d+\.\d+)\s*$", ".binder/runtime.txt") == {newest}


def test_environments_install_the_lock():
    assert stated(r"(?m)^      - -r (\S+)$", "environment/environment.yml") == {Path(LOCK).name}
    assert stated(r"(?m)^-r (\S+)$", ".binder/requirements.txt") == {f"../{LOCK}"}
    assert stated(r"(?m)^RUN (make .+)$", "environment/Dockerfile") == {"make .venv/.ready"}
    assert stated(r"(?m)^LOCK := (\S+)$", "Makefile") == {LOCK}


def test_lock_has_what_the_package_and_its_extras_ask_for():
    extras = PROJECT["optional-dependencies"]
    asked = [Requirement(line) for line in [*PROJECT["dependencies"], *chain(*extras.values())]]
    wrong = [
        str(r)
        for r in asked
        if r.name != PROJECT["name"]
        and not ((v := LOCKED.get(canonicalize_name(r.name))) and r.specifier.contains(v, prereleases=True))
    ]
    assert not wrong
    used = {extra for r in asked if r.name == PROJECT["name"] for extra in r.extras}
    assert used | stated(r"--extra (\w+)", "Makefile") == set(extras)


def test_version_of_the_package_is_the_same_everywhere():
    citation = yaml.safe_load(read("CITATION.cff"))
    latest = re.findall(r"(?m)^## \[?(?:Unreleased\] - )?(\d+\.\d+\.\d+)", read("CHANGELOG.md"))[0]
    assert {PROJECT["version"], citation["version"], zwfs.__version__, latest} == {PROJECT["version"]}


def test_package_can_be_imported_next_to_a_folder_of_its_name(tmp_path):
    """As in the parent folder of a clone: every editable installation is of the compatible kind."""
    for name in ("Makefile", ".binder/postBuild", "environment/environment.yml"):
        assert stated(r"(\S+ \S+) --editable \.", name) == {"--config-settings editable_mode=compat"}
    (tmp_path / "zwfs" / "zwfs").mkdir(parents=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "import zwfs; print(zwfs.Pupil.__name__)"
    run = {"cwd": tmp_path, "env": environment, "check": True, "capture_output": True, "text": True}
    assert subprocess.run([sys.executable, "-c", code], **run).stdout == "Pupil\n"


# In place of pip: it installs a uv that only checks that it would copy, or is killed meanwhile, and make with it.
PIP = """
import os, pathlib, signal, sys

uv = pathlib.Path(sys.executable).with_name("uv")
uv.write_text('#!/bin/sh\\n[ "$UV_LINK_MODE" = copy ]')
if "--require-hashes" not in sys.argv:
    sys.exit("uv is not checked")
if "KILLED" in os.environ:
    os.killpg(0, signal.SIGKILL)
uv.chmod(0o755)
"""
PYTHON = """#!/bin/sh
[ "$2" = venv ] || exec {python} "$@"
{python} "$@" --without-pip && cp '{pip}' .venv/lib/python*/site-packages
"""


@pytest.fixture
def clone(tmp_path):
    """A folder with what a set-up needs, and programs that do it without the network."""
    folder = tmp_path / "clone"
    (folder / "environment").mkdir(parents=True)
    for name in ("Makefile", "pyproject.toml", LOCK, UV_LOCK, CHECK):
        shutil.copy(ROOT / name, folder / name)
    (tmp_path / "pip.py").write_text(PIP)
    (tmp_path / "python").write_text(PYTHON.format(python=sys.executable, pip=tmp_path / "pip.py"))
    (tmp_path / "python").chmod(0o755)
    return folder


def make(folder, *arguments, **variables):
    """Run make, and return its status and what it says."""
    command = ["make", *arguments, f"PYTHON={folder.parent / 'python'}"]
    run = {"cwd": folder, "env": os.environ | variables, "start_new_session": True}
    done = subprocess.run(command, **run, capture_output=True, text=True)
    return done.returncode, done.stdout


READY = "setting up .venv\n"


def test_environment_is_set_up_once_and_again_after_a_kill_in_a_moved_folder_and_without_its_python(clone):
    assert make(clone, "-s", ".venv/.ready", KILLED="yes")[0] != 0
    assert (clone / ".venv" / "bin" / "uv").exists()
    assert make(clone, "-s", ".venv/.ready") == (0, READY)
    moved, locale = clone.rename(clone.with_name("it's bewegt für alle")), {"LC_ALL": "de_XX.ISO-8859-1"}
    assert make(moved, "-s", ".venv/.ready", **locale) == (0, READY)
    for packages in moved.glob(".venv/lib/python3*/site-packages"):  # as an editable installation does
        (packages / "zwfs.pth").write_text(f"{moved}\n", encoding="utf8")
    assert make(moved, "-s", ".venv/.ready") == (0, "")
    assert make(moved, "-s", ".venv/.ready", **locale) == (0, "")
    python = moved / ".venv" / "bin" / "python"
    python.unlink()
    python.symlink_to("/usr/bin/python0")
    assert make(moved, "-s", ".venv/.ready") == (0, READY)


@pytest.mark.parametrize("damage", [lambda file: os.truncate(file, 3), Path.unlink], ids=["cut", "missing"])
@pytest.mark.parametrize("name", ["module.py", "module-1.0.dist-info/RECORD"])
def test_set_up_stops_at_a_damaged_file_and_says_how_to_repair_it(clone, tmp_path, name, damage):
    packages = tmp_path / "packages"
    (packages / "module-1.0.dist-info").mkdir(parents=True)
    (packages / "module.py").write_text("a = 1\n")
    # The hash: hashlib.sha256(b"a = 1\n") in base64.
    record = "module.py,sha256=y3i9ihf3t1H-DUZjNm3LwlcgQDPvfd1ksfKWlXO1suI,6\nmodule-1.0.dist-info/RECORD,,\n"
    (packages / "module-1.0.dist-info" / "RECORD").write_text(record)
    copy = f"shutil.copytree({str(packages)!r}, sysconfig.get_path('purelib'), dirs_exist_ok=True)"
    (tmp_path / "pip.py").write_text(f"import shutil, sysconfig\n{PIP}\n{copy}\n")
    assert make(clone, "-s", ".venv/.ready") == (0, READY)
    damage(packages / name)
    (clone / ".venv" / ".ready").unlink()
    assert make(clone, "-s", ".venv/.ready")[0] != 0
    assert not (clone / ".venv" / ".ready").exists()
    said = subprocess.run([clone / ".venv/bin/python", clone / CHECK], capture_output=True, text=True).stderr
    assert name in said
    assert "rm -rf .venv && UV_NO_CACHE=1 make .venv/.ready" in said
    assert said.count("\n") == 1


def test_clean_keeps_what_belongs_to_the_user(clone):
    results = "html/index.html", "notebooks/a.ipynb", "running-1/a"
    for name in (*results, "rerun/mine/record.json", "other/a"):
        (clone / "_build" / name).parent.mkdir(parents=True, exist_ok=True)
        (clone / "_build" / name).write_text("")
    status, said = make(clone, "-s", "clean")
    assert status == 0
    assert said == "kept: _build/other _build/rerun\n"
    assert sorted(os.listdir(clone / "_build")) == ["other", "rerun"]
    assert (clone / "_build" / "rerun" / "mine" / "record.json").exists()
    shutil.rmtree(clone / "_build")
    assert make(clone, "-s", "clean") == (0, "")
