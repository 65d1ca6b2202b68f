"""The package as a whole: what `import zwfs` imports, which names it has, and what type checkers learn of them."""

import pickle
import pkgutil
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import zwfs
from book._ext.run import package, repository, zipped
from book._tools.project import Project
from zwfs._lazy import offered

from .conftest import EXAMPLES, ROOT


def run(*command, folder=ROOT):
    return subprocess.run([sys.executable, *command], cwd=folder, capture_output=True, text=True)


def test_import_is_light():
    late = {"astropy", "cloudpickle", "distributed", "jax", "joblib", "matplotlib", "threadpoolctl"}
    late |= {"numpy", "scipy", "zwfs.frames", "zwfs.pupil"}
    done = run("-c", f"import sys, zwfs; print({late} & set(sys.modules), zwfs.__version__ > '0')")
    assert done.stdout == "set() True\n", done.stderr


def test_the_sensor_does_without_the_packages_of_others_but_numpy():
    late = {"astropy", "matplotlib", "scipy.optimize", "zwfs.frames", "zwfs.reconstructors"}
    done = run("-c", f"import sys; from zwfs import Pupil, ZernikeSensor; print({late} & set(sys.modules))")
    assert done.stdout == "set()\n", done.stderr


@pytest.mark.parametrize("name", ["zwfs", "zwfs.bench", "zwfs.frames", "zwfs.reconstructors"])
def test_a_package_offers_the_names_that_type_checkers_see_and_its_modules(name):
    package = import_module(name)
    assert offered(Path(package.__file__).read_text("utf-8")).keys() == set(package.__all__) <= set(dir(package))
    for own in package.__all__:
        assert getattr(package, own) is vars(package)[own]
    for module in pkgutil.iter_modules(package.__path__):
        if module.name != "__main__":
            assert getattr(package, module.name) is sys.modules[f"{name}.{module.name}"]
    assert pickle.loads(pickle.dumps(zwfs.Pupil)) is zwfs.pupil.Pupil


@pytest.mark.slow
def test_type_checkers_know_modules_and_results_and_accept_a_new_reconstructor(tmp_path):
    file = tmp_path / "script.py"
    code = "\n".join(
        [
            "import zwfs",
            "import zwfs.frames.files",
            "reveal_type(zwfs.Pupil.circular(10).n_points)",
            "reveal_type(zwfs.frames.files.read)",
            "zwfs.cameras",
        ]
    )
    file.write_text(code)
    example = tmp_path / "second_order.py"
    shutil.copy(EXAMPLES / "wirtinger_flow.py", example)
    count, read, unknown, errors = run("-m", "mypy", str(file), str(example)).stdout.splitlines()
    assert 'Revealed type is "int"' in count
    assert 'Revealed type is "def (path: ' in read
    assert 'Module has no attribute "cameras"' in unknown
    assert errors.startswith("Found 1 error")


@pytest.mark.slow
def test_the_wheel_says_that_the_package_has_types_and_the_sources_come_without_tests(tmp_path):
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "LICENSE-TEXT"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_nothing.py").touch()
    shutil.copytree(ROOT / "zwfs", tmp_path / "zwfs", ignore=shutil.ignore_patterns("__pycache__"))
    build = "from setuptools.build_meta import build_sdist, build_wheel; build_wheel('wheels'); build_sdist('.')"
    done = run("-c", build, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    (wheel,) = (tmp_path / "wheels").glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("zwfs/")}
    sources = (file for file in (ROOT / "zwfs").rglob("*") if file.suffix in (".py", ".typed", ".npz"))
    assert held == {file.relative_to(ROOT).as_posix() for file in sources}
    assert "zwfs/py.typed" in held
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as files:
        assert not [name for name in files.getnames() if "test" in name]


def test_the_repository_that_the_front_page_offers_is_whole(tmp_path):
    listed = subprocess.run(["git", "-C", ROOT, "ls-files"], capture_output=True, text=True, check=True).stdout
    offered = repository(Project(ROOT))
    assert {f"zwfs-book/{name}" for name in listed.split() if not name.startswith(".")} <= offered.keys()
    assert not [name for name in offered if "__pycache__" in name or "/_build/" in name or "/." in name]


def test_pip_installs_the_package_that_the_front_page_offers(tmp_path):
    (tmp_path / "zwfs.zip").write_bytes(zipped(repository(Project(ROOT))))
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--target", "here"]
    subprocess.run([*pip, "zwfs.zip"], cwd=tmp_path, check=True, capture_output=True)
    here = tmp_path / "here"
    installed = {
        file.relative_to(here).as_posix()
        for file in here.rglob("zwfs/**/*")
        if file.suffix in (".py", ".typed", ".npz")
    }
    assert installed == set(package(Project(ROOT)))
