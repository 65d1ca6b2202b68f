"""Check of a release, and of every supported Python: the package as a stranger would install it."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from .notebook import read
from .project import Project, ToolError
from .scratch import scratch_folder, swap

UV = Path(sys.executable).with_name("uv")
# Tests without these words read no file outside tests/ and need no part of the book.
READS_CHECKOUT = re.compile(r"\bROOT\b|\bbook\b|notebooks|studies|bs4|myst_nb")
# Those of the sensor and of what it stands on: for other versions of Python, next to all examples.
CORE = ("detector", "masks", "metrics", "modes", "pupil", "sensor")


class ReleaseError(ToolError):
    """Reason why this tree cannot be released."""


def release_check(project: Project) -> None:
    """Build the package, test it in an empty environment, check the changelog and what notebooks import.

    All unit tests are collected, which imports what they need, and those of the core run, with all examples.
    """
    version = about(project)["version"]
    check_changelog((project.root / "CHANGELOG.md").read_text("utf-8"), version)
    with scratch_folder(project.build, "releasing-") as scratch:
        wheel, _ = build(project, version, scratch / "dist")
        python = environment(project, scratch / "env", f"zwfs[test] @ {wheel.as_uri()}")
        test(project, python, scratch, unit_tests(project), "-q", "--collect-only")
        test(project, python, scratch, core_tests(), "--doctest-modules")
        check_imports(project, wheel, scratch / "notebooks")
        swap(scratch / "dist", project.build / "dist", scratch / "earlier")
    print(f"zwfs {version} can be released: _build/dist")


def pythons(project: Project, asked: list[str]) -> None:
    """Run the examples and the core tests on versions of Python, and with the oldest dependencies on "lowest"."""
    known = supported(project)
    for name in asked or [*known, "lowest"]:
        if name not in (*known, "lowest"):
            raise ReleaseError(f"{name}: expected one of {', '.join(known)}, lowest")
        lowest = name == "lowest"
        if (found := interpreter(known[0] if lowest else name)) is None:
            print(f"Python {name}: not tested, because it is not installed and uv cannot fetch it here")
            continue
        with scratch_folder(project.build, "releasing-") as scratch:
            wheel, _ = build(project, about(project)["version"], scratch / "dist")
            python = environment(project, scratch / "env", f"zwfs[test] @ {wheel.as_uri()}", found, lowest)
            test(project, python, scratch, core_tests(), "--doctest-modules")
        print(f"Python {name}: passed")


def about(project: Project) -> dict[str, Any]:
    """Return the table `project` of pyproject.toml."""
    return tomllib.loads((project.root / "pyproject.toml").read_text("utf-8"))["project"]


def supported(project: Project) -> list[str]:
    """Return the supported versions of Python, the oldest first."""
    found = re.findall(r"Python :: (3\.\d+)", "\n".join(about(project)["classifiers"]))
    return sorted(found, key=lambda version: int(version.split(".")[1]))


def interpreter(version: str) -> str | None:
    """Return the Python of a version: one of pyenv, else one that uv finds or fetches; None if there is none."""
    folder = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
    installed = sorted(folder.glob(f"{version}.*/bin/python"), reverse=True)
    if installed:
        return str(installed[0])
    find, install = ([UV, "python", verb, version] for verb in ("find", "install"))
    if subprocess.run(find, capture_output=True).returncode:
        subprocess.run(install, capture_output=True)
    return subprocess.run(find, capture_output=True, text=True).stdout.strip() or None


def check_changelog(text: str, version: str) -> None:
    """Require an entry of a version, with changes under it."""
    newest = re.search(r"(?m)^## \[?(?:Unreleased\] - )?(\d[^\]\s]*)\]?.*\n((?:(?!## ).*\n?)*)", text)
    if not newest or newest[1] != version:
        raise ReleaseError(f"CHANGELOG.md: the newest entry is {newest and newest[1]}: expected {version}")
    if not re.search(r"(?m)^- ", newest[2]):
        raise ReleaseError(f"CHANGELOG.md: the entry of {version} lists no change: expected at least one")


def build(project: Project, version: str, folder: Path) -> tuple[Path, Path]:
    """Build the source distribution, and the wheel from it, in a folder."""
    call(project, UV, "build", "--quiet", "--no-build-isolation", "--python", sys.executable, "--out-dir", folder)
    wheel, source = folder / f"zwfs-{version}-py3-none-any.whl", folder / f"zwfs-{version}.tar.gz"
    if missing := [file.name for file in (wheel, source) if not file.is_file()]:
        raise ReleaseError(f"the build made no {', '.join(missing)}")
    return wheel, source


def environment(
    project: Project, folder: Path, requirement: str, version: str = sys.executable, lowest: bool = False
) -> Path:
    """Install a requirement into an empty environment, with the locked or the oldest versions."""
    call(project, UV, "venv", "--quiet", "--python", version, folder)
    chosen = ["--resolution", "lowest-direct"] if lowest else ["--constraint", pins(project, folder)]
    python = folder / "bin" / "python"
    call(project, UV, "pip", "install", "--quiet", "--python", python, *chosen, requirement)
    return python


def pins(project: Project, folder: Path) -> Path:
    """Write the versions of the lock without their hashes, which the package under test has not."""
    lock = (project.root / "environment" / "requirements.lock").read_text("utf-8")
    file = folder.with_suffix(".pins")
    lines = [line.rstrip(" \\") for line in lock.splitlines() if re.match(r"[\w.-]+==", line)]
    file.write_text("\n".join(lines) + "\n", "utf-8")
    return file


def unit_tests(project: Project) -> list[str]:
    """Return the tests that read no file outside tests/."""
    files = sorted((project.root / "tests").glob("test_*.py"))
    return [f"tests/{file.name}" for file in files if not READS_CHECKOUT.search(file.read_text("utf-8"))]


def core_tests() -> list[str]:
    """Return the tests of the sensor and of what it stands on."""
    return [f"tests/test_{name}.py" for name in CORE]


def test(project: Project, python: Path, scratch: Path, files: list[str], *options: str) -> None:
    """Run tests against an installed package, in a folder without its source."""
    place = scratch / "tests-only"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(project.root / "tests", place / "tests", ignore=ignored, dirs_exist_ok=True)
    shutil.copy(project.root / "pyproject.toml", place)
    examples = ["--pyargs", "zwfs"] if "--doctest-modules" in options else []
    ask = [str(python), "-c", "import zwfs; print(zwfs.__file__)"]
    where = subprocess.run(ask, cwd=place, capture_output=True, text=True)
    if not Path(where.stdout.strip()).is_relative_to(scratch):
        raise ReleaseError(f"the environment imports {where.stdout.strip() or where.stderr}: expected the wheel")
    quick = ["-q", "--numprocesses", "auto", "--dist", "loadfile", "--benchmark-disable", "-m", "not slow"]
    call(project, python, "-m", "pytest", *quick, *options, *examples, *files, folder=place)


def check_imports(project: Project, wheel: Path, folder: Path) -> None:
    """Install the wheel with the extra of the notebooks, and import what they and their studies do."""
    cells = [c.source for source in project.sources() for c in read(source).cells if c.cell_type == "code"]
    python = environment(project, folder, f"zwfs[notebooks] @ {wheel.as_uri()}")
    modules = {name for cell in cells for name in re.findall(r"(?m)^(?:from|import) ([\w.]+)", cell)}
    modules |= {f"studies.{file.stem}" for file in project.studies.glob("[!_]*.py")}
    code = f"import sys; sys.path.insert(0, sys.argv[1]); import {', '.join(sorted(modules))}"
    call(project, python, "-I", "-c", code, project.notebooks, folder=folder)


def call(project: Project, *command: str | Path, folder: Path | None = None) -> None:
    """Run a command with its output on the terminal."""
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run([str(part) for part in command], cwd=folder or project.root, env=clean)
    if done.returncode:
        raise ReleaseError(f"{Path(command[0]).name} {command[1]} failed with status {done.returncode}")
