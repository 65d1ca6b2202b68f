"""Measures book/_ext/shares.json: how the time of each notebook divides among its cells and their sweeps.

    PYTHONPATH=notebooks .venv/bin/python -m environment.shares

A page needs it for the time left. Takes 10 min of one core.
"""

import json
import os
import sys
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import nbformat
from joblib import parallel_config

from book._ext import driver
from book._ext.run import SHARES, described

ROOT = Path(__file__).parents[1]


def main(*names: str) -> None:
    """Write the file; names of notebooks measure these alone."""
    os.chdir(ROOT / "notebooks")  # its files are named from there
    shares = json.loads(SHARES.read_text("utf-8")) if names else {}
    ends: list[float] = []
    driver.prepare(lambda name, done, total: ends.append(process_time()) if done == total else None)
    for name in names or sorted(path.stem for path in Path().glob("*.ipynb")):
        about = described(nbformat.read(f"{name}.ipynb", as_version=4), name)
        shares[name] = {kind: measured(about, about.get(kind, {}), ends) for kind in ("book", "quick")}
        lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in sorted(shares.items()))
        SHARES.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")


def measured(about: dict[str, Any], values: dict[str, Any], ends: list[float]) -> dict[int, list[float]]:
    """Return the seconds of each cell that takes some: to the end of each sweep, and after the last."""
    cells = dict(enumerate(about["notebook"]["cells"]))
    [defaults] = (cell.source for cell in cells.values() if "parameters" in cell.metadata.get("tags", ()))
    if refused := driver.begin(about["name"], defaults, json.dumps({k: json.dumps(v) for k, v in values.items()})):
        raise ValueError(refused)
    seconds = {}
    for number, cell in cells.items():
        if cell.cell_type == "code" and cell.source != defaults:
            ends[:] = [process_time()]
            with parallel_config(backend="sequential"):  # as in the page
                shown = json.loads(driver.cell(cell.source))
            if error := shown.get("error"):
                raise RuntimeError(error)
            ends.append(process_time())
            parts = [round(end - begin, 2) for begin, end in pairwise(ends)]
            if sum(parts) >= 0.05:
                seconds[number] = parts
    return seconds


if __name__ == "__main__":
    main(*sys.argv[1:])
