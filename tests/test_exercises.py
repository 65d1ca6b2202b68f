"""The exercises of the book: the code of each answer gives the number that the answer states."""

import contextlib
import io
import json
import re

import pytest

from .conftest import ROOT

EXERCISE = re.compile(r"^::::\{admonition\} Predict, then try: (.+?)\n(.+?)^::::$", re.MULTILINE | re.DOTALL)
NAME = re.compile(r":name: exercise-(\S+)")
CODE = re.compile(r"```python\n(.+?)```", re.DOTALL)
STATED = re.compile(r":::\{dropdown\} Answer\n\*\*[^*]*?([−-]?\d[\d.]*(?:e-\d+)?)", re.DOTALL)


def texts():
    for page in sorted((ROOT / "book").glob("*.md")):
        yield page.read_text("utf-8")
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        yield "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


EXERCISES = {NAME.search(body)[1]: body for text in texts() for _, body in EXERCISE.findall(text)}


def test_there_are_as_many_exercises_as_names():
    assert len(EXERCISES) == sum(text.count("Predict, then try: ") for text in texts()) >= 6


@pytest.mark.parametrize("name", EXERCISES)
def test_the_code_of_an_answer_prints_its_number(name):
    body = EXERCISES[name]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(CODE.search(body)[1], {})
    assert float(printed.getvalue()) == float(STATED.search(body)[1].rstrip(".").replace("−", "-"))
