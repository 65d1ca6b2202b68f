"""Notebooks that were tampered with fail ``pytest --nbval``, and the stored ones show what a reader needs."""

import base64
import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest
from matplotlib.image import imread
from nbformat.v4 import new_code_cell, new_notebook, new_output
from PIL import Image

from book._ext.run import SHARES
from book._tools.run import FRONT_FIGURE
from studies.kit.results import published

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
GLUED = "application/papermill.record/text/plain"
WIDTH = 76  # letters of code that fit a page in a window 1280 pixels wide


def png(changed=0, level=0, value=255, shape=(800, 1200)):
    """A large white picture with a few other pixels, which hardly change its rms."""
    pixels = np.full((*shape, 3), value, dtype=np.uint8)
    pixels[0, :changed] = level
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return base64.b64encode(file.getvalue()).decode()


def svg(x="1.25", name="m1", word="rad", raster="", colour="#1f77b4"):
    return (
        f'<svg><defs><path id="{name}" d="M {x} 3 L 4 5"/></defs><use href="#{name}" style="fill: {colour}"/>'
        f'<text>{word}</text><image href="data:image/png;base64,{raster or png(shape=(4, 5))}"/></svg>'
    )


def display(**options):
    """A cell that displays something, and its stored output."""
    data = options.get("data", {})
    metadata = options.get("metadata", {})
    run = options.get("run", {"data": data, "metadata": metadata})
    call = f"display({run['data']!r}, metadata={run['metadata']!r}, raw=True)"
    outputs = [new_output("display_data", data=data, metadata=metadata)]
    return new_code_cell(f"from IPython.display import display\n{call}", execution_count=1, outputs=outputs)


def pair(kind, stored, fresh):
    return display(data={kind: stored}, run={"data": {kind: fresh}, "metadata": {}})


def rounding(kind, stored, fresh):
    """The same in a cell whose numbers depend on how a processor rounds."""
    cell = pair(kind, stored, fresh)
    cell.metadata["tags"] = ["rounding"]
    return cell


def glued(stored, fresh):
    data = {GLUED: "0.5"}
    metadata = [{"scrapbook": {"name": name}} for name in (stored, fresh)]
    return display(data=data, metadata=metadata[0], run={"data": data, "metadata": metadata[1]})


def printed(stored, fresh):
    outputs = [new_output("stream", text=f"{stored}\n")]
    return new_code_cell(f"print({fresh!r})", execution_count=1, outputs=outputs)


SAME = {
    "text": printed("rms 0.125 rad", "rms 0.125 rad"),
    "pixels within the tolerance": pair("image/png", png(), png(changed=12, level=250)),
    "coordinates within the tolerance": pair("image/svg+xml", svg("1.25"), svg("1.26")),
    "names of a vector picture": pair("image/svg+xml", svg(name="m1"), svg(name="other")),
    "a glued value": glued("x", "x"),
    "the last digit of a table": rounding("text/markdown", "| 1.10 ± 0.42 | +0.9 |", "| 1.10 ± 0.43 | +0.8 |"),
    "a glued number within the tolerance": rounding(GLUED, "1.97", "1.95"),
}
TAMPERED = {
    "digits": printed("rms 0.125 rad", "rms 0.126 rad"),
    "a glued name": glued("x", "y"),
    "the last digit of another table": pair("text/markdown", "| gain 0.8 |", "| gain 0.9 |"),
    "a glued number": rounding(GLUED, "1.97", "1.92"),
    "digits of a glued text": rounding(GLUED, "'0.021, arcsine'", "'0.023, arcsine'"),
    "digits of a table": rounding("text/markdown", "| 0.42 |", "| 0.44 |"),
    "a count of a table": rounding("text/markdown", "| 23 of 24 |", "| 24 of 24 |"),
    "a word of a table": rounding("text/markdown", "| linear |", "| arcsine |"),
    "12 pixels": pair("image/png", png(), png(changed=12)),
    "all pixels": pair("image/png", png(), png(value=250)),
    "the size of a picture": pair("image/png", png(shape=(40, 50)), png(shape=(50, 40))),
    "coordinates": pair("image/svg+xml", svg("1.25"), svg("1.35")),
    "a word in a vector picture": pair("image/svg+xml", svg(word="rad"), svg(word="deg")),
    "a colour": pair("image/svg+xml", svg(), svg(colour="#ff77b4")),
    "a raster in a vector picture": pair("image/svg+xml", svg(), svg(raster=png(value=250, shape=(4, 5)))),
    "the kind of an output": display(data={"image/png": png()}, run={"data": {"text/plain": ""}, "metadata": {}}),
    "a missing output": new_code_cell("print(1)", execution_count=1),
    "a cell that was never run": new_code_cell("n = 1"),
}


MESSAGES = [
    "- rms 0.126 rad",
    "+ rms 0.125 rad",
    "'| gain 0.8 |' stored, '| gain 0.9 |' in the fresh run",
    "1.97 stored, 1.92 in the fresh run, in '1.97'",
    "'rad</text>' stored, 'deg</text>' in the fresh run, in a vector picture",
]


def test_tampered_cells_fail_and_others_pass(tmp_path):
    cells = [*SAME.values(), *TAMPERED.values()]
    nbformat.write(new_notebook(cells=cells), tmp_path / "one.ipynb")
    shutil.copy(NOTEBOOKS / "conftest.py", tmp_path)
    # In two processes, which get whole notebooks.
    nbformat.write(new_notebook(cells=[new_code_cell("n = 1", execution_count=1)]), tmp_path / "two.ipynb")
    command = [sys.executable, "-m", "pytest", "--nbval", "-q", "--color=no", "-n", "2"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    failed = re.findall(r"(?m)^FAILED one.ipynb::Cell (\d+)", done.stdout)
    names = [*SAME, *TAMPERED]
    assert [names[int(number)] for number in failed] == list(TAMPERED), done.stdout[-4000:]
    assert [message for message in MESSAGES if message not in done.stdout] == []


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_cells_that_set_up_or_draw_are_folded_and_one_that_computes_is_not(path):
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    folded = [
        bool({"hide-input", "hide-cell", "remove-cell"} & set(cell.metadata.get("tags", ()))) for cell in cells
    ]
    computes = False
    for cell, hidden in zip(cells, folded, strict=True):
        shown = "parameters" in cell.metadata.get("tags", ())
        assert hidden or shown or not re.match(r"import |from |glue\(", cell.source), cell.source
        assert hidden or not published(cell.source), cell.source
        computes |= not hidden and not shown
    assert computes


def test_shares_of_time_are_those_of_cells_that_compute():
    shares = json.loads(SHARES.read_text("utf-8"))
    assert shares.keys() == {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
    for name, of_values in shares.items():
        cells = nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4).cells
        for seconds in of_values.values():
            assert {cells[int(number)].cell_type for number in seconds} == {"code"}, name


def shown_code():
    """Each block of code that a page of the book shows, by the name of its file."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        yield from ((path.name, cell.source) for cell in nbformat.read(path, 4).cells if cell.cell_type == "code")
    for path in sorted(NOTEBOOKS.with_name("book").glob("*.md")):
        blocks = re.findall(r"(?ms)^ *```\w+\n(.*?)^ *```$", path.read_text("utf-8"))
        yield from ((path.name, block) for block in blocks)


def test_no_line_of_code_is_cut_off_on_a_page():
    lines = [(name, line) for name, code in shown_code() for line in code.splitlines()]
    assert not [(name, line) for name, line in lines if len(line) > WIDTH]


def test_front_figure_is_the_stored_figure_of_its_notebook():
    notebook = nbformat.read(NOTEBOOKS / f"{FRONT_FIGURE}.ipynb", 4)
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", ()))
    stored = next(output.data["image/png"] for output in outputs if "image/png" in output.get("data", {}))
    front = imread(NOTEBOOKS.parent / "book" / "_static" / "front.png")
    assert np.array_equal(front, imread(io.BytesIO(base64.b64decode(stored))))
