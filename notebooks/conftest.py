"""Comparison of notebooks with a fresh run beyond that of nbval.

``pytest --nbval notebooks`` executes all cells and compares printed text exactly. This
file adds what nbval skips: pictures, metadata, and cells that were never run. In cells
with the tag "rounding", numbers of tables and glued values may differ a little: there,
long fits amplify how a processor rounds.
"""

import base64
import io
import os
import re
from decimal import Decimal
from itertools import zip_longest

import numpy as np
import pytest
from matplotlib.testing.compare import calculate_rms
from PIL import Image

from book._tools.environment import clean

# Levels of 0 to 255. One changed digit of a label exceeds the rms of all pixels.
# Processors differ by up to 35 levels in a pixel; a moved marker changes pixels by 100.
RMS, PIXEL = 0.5, 60
PATH = 0.05  # of each number in a vector picture, SVG units

GLUED = "application/papermill.record/text/plain"
TEXTS = "text/markdown", GLUED
ROUNDING = "rounding"
SHARE = 0.02  # of a glued number; in tables and glued texts it is one in the last digit

NUMBER = re.compile(r"(?<![\w.#])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
EMBEDDED = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")
NAME = re.compile(r'(?<=\bid=")[^"]+|(?<=href="#)[^"]+|(?<=url\(#)[^)]+')

# Notebooks that run at the same time share the cores.
workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
environment = clean(os.environ)
environment["LOKY_MAX_CPU_COUNT"] = str(max(1, os.cpu_count() // workers))
os.environ.clear()
os.environ.update(environment)


def pytest_configure(config):
    """Keep the cells of a notebook in one process, as ``--dist loadfile`` does."""
    if getattr(config.option, "dist", None) == "load":  # that of -n alone
        config.option.dist = "loadfile"


def pytest_collectstart(collector):
    """Exempt from the exact comparison of nbval what `compare` compares."""
    if hasattr(collector, "skip_compare"):
        collector.skip_compare = (
            *collector.skip_compare,
            "image/svg+xml",
            *TEXTS,
        )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Compare the rest after nbval has executed a cell and compared its text."""
    cell = getattr(item, "cell", None)
    if (
        cell is not None
        and cell.source.strip()
        and cell.execution_count is None
    ):
        pytest.fail("the cell was never run: it has no execution count")
    yield
    if cell is not None:
        stored, fresh = (
            [output for output in outputs if "data" in output]
            for outputs in (cell.outputs, item.test_outputs)
        )
        if len(stored) != len(fresh):
            pytest.fail(
                f"{len(stored)} outputs stored, {len(fresh)} in the fresh run"
            )
        rounding = ROUNDING in cell.metadata.get("tags", ())
        for old, new in zip(stored, fresh, strict=True):
            if difference := compare(old, new, rounding):
                pytest.fail(difference)


def compare(old, new, rounding):
    """Return how two outputs differ; None if they agree."""
    if old.metadata != new.metadata:  # it holds the names of glued values
        return f"{dict(old.metadata)} stored, {dict(new.metadata)} in the fresh run"
    if old.data.keys() != new.data.keys():
        return f"{list(old.data)} stored, {list(new.data)} in the fresh run"
    for kind in TEXTS:
        if kind in old.data and old.data[kind] != new.data[kind]:
            return compare_text(old.data[kind], new.data[kind], rounding)
    if "image/svg+xml" in old.data:
        return compare_svg(
            old.data["image/svg+xml"], new.data["image/svg+xml"]
        )
    if "image/png" in old.data:
        return compare_png(old.data["image/png"], new.data["image/png"])
    return None


def compare_text(old, new, rounding):
    """Return how two texts differ; None if `rounding` may explain it."""
    if not rounding or NUMBER.sub("", old) != NUMBER.sub("", new):
        return first_difference(old, new)
    for a, b in zip(*map(NUMBER.findall, (old, new)), strict=True):
        allowed = SHARE * abs(float(a)) if old == a else last_digit(a)
        if abs(Decimal(a) - Decimal(b)) > allowed:
            return f"{a} stored, {b} in the fresh run, in {old!r}"
    return None


def first_difference(old, new):
    """Return the first lines or tags in which two texts differ."""
    pieces = (re.split(r"(?<=[\n>])", text) for text in (old, new))
    pairs = zip_longest(*pieces, fillvalue="")
    a, b = next(pair for pair in pairs if pair[0] != pair[1])
    return f"{a.strip()!r} stored, {b.strip()!r} in the fresh run"


def last_digit(number):
    """Return one in the last digit of a number; 0 for an integer, which must not differ."""
    exponent = Decimal(number).as_tuple().exponent
    return Decimal(1).scaleb(exponent) if "." in number else 0


def compare_png(old, new):
    """Return how two PNG files in base64 differ; None if they agree."""
    files = (io.BytesIO(base64.b64decode(data)) for data in (old, new))
    a, b = (
        np.asarray(Image.open(file).convert("RGBA"), float)
        for file in files
    )
    if a.shape != b.shape:
        return f"a picture of shape {a.shape} stored, {b.shape} in the fresh run"
    rms, pixel = calculate_rms(a, b), abs(a - b).max()
    if rms > RMS or pixel > PIXEL:
        return f"pictures differ by {rms:.2f} rms, {pixel:.0f} in one pixel, of 255"
    return None


def compare_svg(old, new):
    """Return how two SVG files differ; None if they agree within the tolerance."""
    rasters = [EMBEDDED.findall(svg) for svg in (old, new)]
    texts = [numbered(EMBEDDED.sub("", svg)) for svg in (old, new)]
    if NUMBER.sub("", texts[0]) != NUMBER.sub("", texts[1]):
        return f"{first_difference(*texts)}, in a vector picture"
    for a, b in zip(*map(NUMBER.findall, texts), strict=True):
        if abs(float(a) - float(b)) > PATH:
            return f"{a} stored, {b} in the fresh run, in a vector picture"
    return next(filter(None, map(compare_png, *rasters)), None)


def numbered(svg):
    """Return an SVG with numbers for names, which matplotlib derives from paths."""
    names = {}
    return NAME.sub(
        lambda match: names.setdefault(match[0], f"name{len(names)}"), svg
    )
