"""Every public name of the science has an example. `make test` runs them with --doctest-modules."""

import re

import nbformat
import numpy as np
import pytest

from studies.kit.tables import with_zeros
from zwfs.bench import Bench, write_bench

from .conftest import ROOT, code_of


def test_example_of_the_readme_runs(capsys):
    (code,) = re.findall(r"(?m)^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.S)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed.startswith("(20, 100, 100) [ True")
    assert "False" not in printed


@pytest.mark.parametrize("page", ["index.md", "own.md"])
def test_example_of_a_page_prints_what_it_says(page, capsys):
    (code,), (printed,) = code_of(page), code_of(page, "text")
    exec(compile(code, page, "exec"), {})
    assert capsys.readouterr().out == printed


def test_fewer_loops_close_with_one_image(capsys):
    page = (ROOT / "book" / "own.md").read_text("utf-8")
    (code,) = code_of("own.md")
    exec(compile(code.replace("# One image: ", ""), "own.md", "exec"), {})
    (closed,) = re.findall(r"With one image \(comment in the code\), (\d+) of 24 loops close", page)
    assert capsys.readouterr().out.startswith(f"{closed} of 24 loops close")


def test_table_of_delays_and_winds_is_that_of_the_example(capsys):
    page = (ROOT / "book" / "own.md").read_text("utf-8")
    (code,) = code_of("own.md")
    rows = re.findall(r"(?m)^\| ([123]) steps? \| (.*?) \| (.*?) \| (.*?) \|$", page)
    assert len(rows) == 3

    def residual(delay, speed, gain):
        changed = code.replace('"gain": 0.6, "delay": 2', f'"gain": {gain}, "delay": {delay}')
        changed = changed.replace("cutoff=3.0", f"cutoff=3.0, speed={speed / 8}")
        changed = changed.replace("{residual:.3f}", "{residual}")
        exec(compile(changed, "own.md", "exec"), {})
        return float(re.search(r"residual (\S+)", capsys.readouterr().out)[1])

    for delay, *cells in rows:
        for speed, cell in zip((20, 10, 5), cells, strict=True):
            residuals = {gain: residual(delay, speed, gain) for gain in (0.2, 0.4, 0.6, 0.8)}
            best = min(residuals, key=residuals.get)
            assert cell == f"{with_zeros(residuals[best])}, gain {best}"


def test_example_of_a_verdict_needs_only_the_package(tmp_path, monkeypatch, capsys):
    notebook = nbformat.read(ROOT / "notebooks" / "own_frames.ipynb", 4)
    (text,) = (cell.source for cell in notebook.cells if "With the package alone" in cell.source)
    monkeypatch.chdir(tmp_path)
    write_bench(".", Bench(n_pixels=40), seed=1)
    exec(compile(re.search(r"```python\n(.*?)```", text, re.S)[1], "own_frames", "exec"), {})
    assert "fit: Not explained" in capsys.readouterr().out
    phase, error_bar = np.load("phase.npy"), np.load("error_bar.npy")
    assert 0 < np.nanmedian(error_bar) < np.nanstd(phase)


def test_example_of_gradients_fits_the_phase(capsys):
    jax = pytest.importorskip("jax", reason="JAX is not installed")
    page = (ROOT / "book" / "your_reconstructor.md").read_text("utf-8")
    (code,) = (block for block in code_of("your_reconstructor.md") if "import jax" in block)
    (stated,) = re.findall("(.) × 10⁻⁸ rad", page)
    before = jax.config.jax_enable_x64
    try:
        exec(compile(code, "your_reconstructor.md", "exec"), {})
    finally:
        jax.config.update("jax_enable_x64", before)
    assert float(capsys.readouterr().out) == pytest.approx(int(stated) * 1e-8, rel=0.25)
