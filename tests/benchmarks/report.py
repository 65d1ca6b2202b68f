"""Numbers of the book from what pytest-benchmark measured: python -m tests.benchmarks.report MEASURED.json.

It also runs `tests.benchmarks.speed`, and writes both to book/_ext/performance.json, from which the page is made.

The shortest time of each contestant is divided by that of zwfs with its own settings at the same task, so that
what is kept depends little on the machine.
"""

import hashlib
import json
import sys
from pathlib import Path

from zwfs._system import write_file

from . import speed

KEPT = Path(__file__).parents[2] / "book" / "_ext" / "performance.json"


def digits(value, n):
    return float(f"{value:.{n}g}")


def rounded(values):
    """The same numbers with three digits; whole numbers stay."""
    if isinstance(values, dict):
        return {name: rounded(value) for name, value in values.items()}
    if isinstance(values, list):
        return [rounded(value) for value in values]
    return digits(values, 3) if isinstance(values, float) else values


def peers(measured):
    """One row for each contestant: task, package, setting, default, ratio of times, error."""
    rows = [(run["extra_info"], run["stats"]["min"], run["group"]) for run in measured["benchmarks"]]
    rows = [row for row in rows if "package" in row[0]]
    unit = {task: seconds for info, seconds, task in rows if info["package"] == "zwfs" and info["default"]}
    return [
        {"task": task, **info, "error": digits(info["error"], 2), "ratio": digits(seconds / unit[task], 3)}
        for info, seconds, task in rows
    ]


def machine(info):
    """Name of the processor, and whether it has the instructions that NumPy needs for a quick arctangent."""
    wide = "avx512dq" in info["cpu"].get("flags", ())
    return f"{info['cpu']['brand_raw']}, {'with' if wide else 'without'} AVX-512"


def fingerprint(kept):
    """sha256 of all measured numbers: with it the file shows that nobody changed a number by hand."""
    numbers = {name: value for name, value in kept.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()


def main(path):
    measured = json.loads(Path(path).read_text())
    kept = {
        "machine": machine(measured["machine_info"]),
        "peers": peers(measured),
        "speed": rounded(speed.results(1.0)),
        "pages": json.loads(KEPT.read_text("utf-8")).get("pages", []),  # see pages.py
    }
    kept["sha256"] = fingerprint(kept)
    write_file(KEPT, (json.dumps(kept, indent=1, ensure_ascii=False) + "\n").encode())
    for row in kept["peers"]:
        mark = "*" if row["default"] else " "
        name = f"{row['package']}, {row['setting']}"
        print(f"{row['task']:36}{mark}{name:32}{row['ratio']:9.3g}{row['error']:10.2g}")


if __name__ == "__main__":
    main(sys.argv[1])
