"""The committed notebooks agree with a fresh run, and what disagrees is found."""

import base64
import copy
import io
from pathlib import Path

import build
import compare
import numpy as np
import pytest
import runner
from nbformat.v4 import new_code_cell, new_notebook, new_output
from PIL import Image
from runner import Project

PROJECT = Project(Path(__file__).parent.parent)


@pytest.fixture(scope="module")
def fresh_run():
    runner.run(PROJECT, say=print)


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in PROJECT.sources()])
def test_committed_notebook_agrees_with_a_fresh_run(fresh_run, name):
    found = build.check_notebook(PROJECT, name)
    assert not found, "\n".join(found)


@pytest.mark.slow
def test_committed_front_figure_agrees_with_a_fresh_run(fresh_run):
    assert build.check_front(PROJECT) == []
    assert "(book/_static/front.png)" in (PROJECT.root / "README.md").read_text("utf-8")


def png(value=255, changed=0, shape=(40, 50)):
    pixels = np.full((*shape, 3), value, dtype=np.uint8)
    pixels[:changed, 0] = 0
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return base64.b64encode(file.getvalue()).decode()


def svg(x="1.25", name="m1", word="rad", colour="#1f77b4", raster=None):
    return (
        f'<svg><defs><path id="{name}" d="M {x} 3 L 4 5"/></defs><use href="#{name}" style="fill: {colour}"/>'
        f'<g clip-path="url(#{name})"/><text>{word}</text>'
        f'<image href="data:image/png;base64,{raster or png()}"/></svg>'
    )


def inverted(n_pixels, shape=(800, 1200)):
    """A large picture with a few inverted pixels, which hardly change the rms."""
    pixels = np.full((*shape, 3), 255, dtype=np.uint8)
    pixels[0, :n_pixels] = 0
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return base64.b64encode(file.getvalue()).decode()


def notebook(text="rms 0.125 rad, 25 iterations\n", picture=None, vector=None, glued="0.5", key="x"):
    data = {"image/png": picture or png(), "image/svg+xml": vector or svg()}
    glue = {"application/papermill.record/text/plain": glued}
    outputs = [
        new_output("stream", text=text),
        new_output("display_data", data=data),
        new_output("display_data", data=glue, metadata={"scrapbook": {"name": key}}),
    ]
    parameters = new_code_cell("n = 1", execution_count=1, metadata={"tags": ["parameters"]})
    cell = new_code_cell("show()", execution_count=2, outputs=outputs)
    return runner.normalise(new_notebook(cells=[parameters, cell]))


@pytest.mark.parametrize(
    "same",
    [
        {},
        {"text": "rms 0.125001 rad, 25 iterations\n"},
        {"text": "rms  0.125 rad, 25 iterations\n"},
        {"picture": png(254)},
        {"vector": svg(x="1.26")},
        {"vector": svg(name="other")},
        {"vector": svg(raster=png(255, changed=0))},
        {"glued": "0.50000001"},
    ],
)
def test_differences_within_tolerance_pass(same):
    tolerance = compare.Tolerance(pixel_rms=2.0)
    assert compare.differences(notebook(), notebook(**same), tolerance) == []


@pytest.mark.parametrize(
    ("tampered", "message"),
    [
        ({"text": "rms 0.126 rad, 25 iterations\n"}, "0.125 committed, 0.126 in the fresh run"),
        ({"text": "rms -0.125 rad, 25 iterations\n"}, "0.125 committed, -0.125 in the fresh run"),
        ({"text": "rms 0.125 rad, 24 iterations\n"}, "25 committed, 24 in the fresh run"),
        (
            {"text": "rms 0.125 deg, 25 iterations\n"},
            "'rms 0.125 rad, 25 iterations' committed, 'rms 0.125 deg",
        ),
        ({"text": "rms nan rad, 25 iterations\n"}, "'rms nan rad"),
        ({"text": "rms 0.125 rad, 25 iterations\nmore\n"}, "1 lines committed, 2 in the fresh run"),
        ({"picture": png(250)}, "the pictures differ by"),
        ({"picture": png(changed=1)}, "the pictures differ by"),
        ({"picture": png(shape=(50, 40))}, "50 x 40 pixels committed, 40 x 50 in the fresh run"),
        ({"vector": svg(x="1.35")}, "1.25 committed, 1.35 in the fresh run"),
        ({"vector": svg(word="deg")}, "deg"),
        ({"vector": svg(colour="#ff77b4")}, "#ff77b4"),
        ({"vector": svg(raster=png(250))}, "embedded picture 1: the pictures differ by"),
        ({"glued": "0.6"}, "0.5 committed, 0.6 in the fresh run"),
    ],
)
def test_tampering_is_found(tampered, message):
    found = compare.differences(notebook(), notebook(**tampered))
    assert len(found) == 1
    assert found[0].startswith("cell 2, output ")
    assert message in found[0]


def test_a_renamed_glued_value_is_found():
    found = compare.differences(notebook(), notebook(key="y"))
    assert len(found) == 1
    assert "{'name': 'x'}" in found[0]
    assert "{'name': 'y'}" in found[0]


def test_a_few_changed_pixels_are_found():
    found = compare.differences(notebook(picture=inverted(0)), notebook(picture=inverted(1)))
    assert found == [
        "cell 2, output 2 (image/png): a pixel of the pictures differs by 255 of 255, and 10 is allowed"
    ]


def test_missing_outputs_are_found():
    stripped = notebook()
    stripped.cells[1].outputs = []
    assert compare.faults(stripped) == ["no cell has any output"]
    assert compare.differences(stripped, notebook()) == ["cell 2, outputs: 0 committed, 3 in the fresh run"]


def test_another_kind_of_output_is_found():
    other = notebook()
    del other.cells[1].outputs[1].data["image/png"]
    assert compare.differences(notebook(), other) == [
        "cell 2, output 2: image/png, image/svg+xml committed, image/svg+xml in the fresh run"
    ]


def test_changed_source_and_changed_number_of_cells_are_found():
    other = copy.deepcopy(notebook())
    other.cells[1].source = "show(1)"
    message = "cell 2: its source differs from the one that was run"
    assert compare.differences(notebook(), other) == [message]
    del other.cells[1]
    assert compare.differences(notebook(), other) == ["2 cells are committed, 1 were run"]


def test_notebook_that_was_never_run_is_found():
    raw = notebook()
    raw.cells[0].execution_count = None
    raw.cells[0].metadata = {}
    assert compare.faults(raw) == [
        "cell 1 was never run: it has no execution count",
        "no cell is tagged 'parameters'",
    ]


@pytest.mark.parametrize("text", ["v1.2.3", "#1f77b4", "fig03", "a_1", "0x1f"])
def test_digits_in_names_are_text(text):
    other = text.replace("1", "2").replace("03", "04")
    assert compare.text_difference(text, other, relative=10, absolute=10)
