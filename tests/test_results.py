import csv
import io
import os
import pickle
import re

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from studies.kit.results import FOLDER, csv_bytes, glue_numbers, publish, rounded, screen_columns, stacked

matplotlib.use("agg")


@pytest.fixture
def plain():
    """A figure that takes little time to draw."""
    figure = plt.figure(figsize=(1, 1))
    yield figure
    plt.close(figure)


@pytest.fixture
def figure():
    """Two panels with a colour bar: their constrained layout changes each time it is computed."""
    figure, axes = plt.subplots(2, 2, layout="constrained", figsize=(4, 3))
    figure.colorbar(axes[0, 0].imshow(np.eye(5)), ax=axes[0])
    axes[1, 0].set_title("two\nlines")
    yield figure
    plt.close(figure)


def published(folder, monkeypatch, figure, **screens):
    folder.mkdir()
    monkeypatch.setenv(FOLDER, str(folder))
    publish(figure, "plot", **screens)
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_nothing_is_written_without_a_folder_and_the_figure_looks_the_same(figure, tmp_path, monkeypatch):
    twin = pickle.loads(pickle.dumps(figure))
    published(tmp_path / "files", monkeypatch, figure)
    monkeypatch.delenv(FOLDER)
    monkeypatch.chdir(tmp_path)
    publish(twin, "plot")
    assert os.listdir() == ["files"]
    shown = [io.BytesIO(), io.BytesIO()]
    for stream, drawing in zip(shown, (figure, twin), strict=True):
        drawing.savefig(stream, format="png", bbox_inches="tight", metadata={"Software": None})
    assert shown[0].getvalue() == shown[1].getvalue()


def test_files_are_the_same_from_run_to_run(figure, tmp_path, monkeypatch):
    twin = pickle.loads(pickle.dumps(figure))
    first = published(tmp_path / "first", monkeypatch, figure)
    kinds = "csv", "dark.png", "narrow-dark.png", "narrow.png", "pdf", "png", "svg"
    assert sorted(first) == [f"plot.{kind}" for kind in kinds]
    assert published(tmp_path / "second", monkeypatch, twin) == first
    assert b"CreationDate" not in first["plot.pdf"]
    assert b"Software" not in first["plot.png"]
    assert first["plot.pdf"].startswith(b"%PDF")
    assert b"<svg" in first["plot.svg"]
    assert not re.search(rb"<dc:(date|creator)", first["plot.svg"])
    assert plt.imread(tmp_path / "first" / "plot.png").shape[:2] == (600, 800)  # 200 dots per inch


def test_single_screens_are_written_with_a_row_each(plain, tmp_path, monkeypatch):
    errors = np.arange(12.0).reshape(2, 2, 3)
    tables = {
        n: screen_columns({"input": [0.1, 0.2], "photons": [1, 10]}, {"error": factor * errors})
        for n, factor in (("a", 1), ("b", 2))
    }
    files = published(tmp_path / "files", monkeypatch, plain, screens=stacked("case", tables))
    header, *rows = csv.reader(files["plot_screens.csv"].decode().splitlines())
    assert header == ["case", "input", "photons", "screen", "error"]
    assert len(rows) == 24
    for case, rms, photons, screen, error in rows:
        place = ["0.1", "0.2"].index(rms), ["1", "10"].index(photons), int(screen) - 1
        assert float(error) == {"a": 1, "b": 2}[case] * errors[place]


def test_a_file_is_replaced_and_not_written_through_a_link(plain, tmp_path, monkeypatch):
    folder = tmp_path / "new" / "folder"
    monkeypatch.setenv(FOLDER, str(folder))
    publish(plain, "plot")
    (tmp_path / "raw").write_bytes(b"raw")
    (folder / "plot.csv").unlink()
    (folder / "plot.csv").symlink_to(tmp_path / "raw")
    names = sorted(file.name for file in folder.iterdir())
    publish(plain, "plot")
    assert (tmp_path / "raw").read_bytes() == b"raw"
    assert not (folder / "plot.csv").is_symlink()
    assert sorted(file.name for file in folder.iterdir()) == names


def test_rounded_numbers_are_glued_as_they_are_and_strings_stay(monkeypatch):
    glued = {}
    monkeypatch.setattr("myst_nb.glue", lambda name, value, display: glued.update({name: value}))
    numbers = rounded({"small": 1.2345e-7, "ratio": 3210.123, "flag": True}, ".3g")
    glue_numbers(numbers | rounded({"error": np.float64(0.123456), "limit": np.inf, "where": "never"}))
    expected = {"small": 1.23e-7, "ratio": 3210, "flag": 1.0, "error": 0.1235, "limit": np.inf, "where": "never"}
    assert glued == expected


@pytest.mark.parametrize("name", ["Plot", "../plot"])
def test_bad_names_are_refused(plain, name):
    with pytest.raises(ValueError, match=f"name = '{name}'"):
        publish(plain, name)


def test_columns_are_written_in_order_with_nine_digits():
    columns = {"x, y (rad)": np.array([np.pi, np.nan]), "n": [1, 2], "d (lambda/D)": [1.06]}
    columns |= {"method": ["linear"], "single": np.float32([0.5, 1e-30])}
    assert list(csv.reader(csv_bytes(columns).decode().splitlines())) == [
        list(columns),
        ["3.14159265", "1", "1.06", "linear", "0.5"],
        ["nan", "2", "", "", "1e-30"],
    ]
