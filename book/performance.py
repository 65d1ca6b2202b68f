"""Tables and figure of the performance page, from the ratios that `make bench` measured."""

import io
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from zwfs import figures

MEASURED = "book/performance.json"
ACCURATE = 1.05e-4  # largest error of the second comparison, 1e-4 when rounded
PACKAGES = {
    "zwfs": ("#0072B2", "v"),
    "HCIPy": ("#D55E00", "o"),
    "HCIPy, vector": ("#CC79A7", "D"),
    "prysm": ("#009E73", "^"),
    "pyZELDA": ("#000000", "s"),
}
ERRORS = {
    "one frame": "largest error of the intensity",
    "two frames": "largest error of the intensity",
    "phase of one frame": "error of the phase (rad rms)",
    "phase of two frames, 25 iterations": "error of the phase (rad rms)",
}


def fragments(measured: Path) -> dict[str, bytes]:
    """Pieces of the page by their place in the staged sources: a table for each task, the machine, the figure."""
    kept = json.loads(measured.read_text("utf-8"))
    tasks: dict[str, list[dict[str, Any]]] = {}
    for row in kept["peers"]:
        tasks.setdefault(row["task"], []).append(row)
    tables = "\n\n".join(f"### {task.capitalize()}\n\n{table(task, rows)}" for task, rows in tasks.items())
    return {
        "book/_peers.md": f"{tables}\n".encode(),
        "book/_machine.md": f"{kept['machine']}\n".encode(),
        "book/_static/peers.png": picture(error_against_time(tasks["one frame"] + tasks["two frames"])),
    }


def table(task: str, rows: list[dict[str, Any]]) -> str:
    """Each package with its own settings, and with the first setting that is accurate enough."""
    lines = [f"| package | setting | time (zwfs = 1) | {ERRORS[task]} |", "| --- | --- | ---: | ---: |"]
    for row in chosen(rows):
        own = ", its own" if row["default"] else ""
        lines.append(f"| {row['package']} | {row['setting']}{own} | {row['ratio']:.3g} | {power(row['error'])} |")
    return "\n".join(lines)


def chosen(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each package its own setting, and the quickest one that is accurate enough if that is another."""
    picked = []
    for package in dict.fromkeys(row["package"] for row in rows):
        mine = [row for row in rows if row["package"] == package]
        accurate = [row for row in mine if row["error"] <= ACCURATE]
        quickest = min(accurate, key=lambda row: row["ratio"], default=None)
        picked += [row for row in mine if row["default"] or row is quickest]
    return picked


def power(value: float) -> str:
    """Number as a power of ten where it is small."""
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{value:.2g}" if value >= 1e-3 else f"${mantissa}\\times10^{{{int(exponent)}}}$"


def error_against_time(rows: list[dict[str, Any]]) -> Figure:
    """Error of one or two frames against the time they take, for every setting of every package."""
    figure, axes = plt.subplots(figsize=(7, 4.2))
    for package, (color, marker) in PACKAGES.items():
        mine = [
            row for row in rows if row["package"] == package and (package != "zwfs" or row["task"] == "one frame")
        ]
        style = {"color": color, "marker": marker, "linestyle": "-", "lw": 1}
        axes.loglog([row["ratio"] for row in mine], [row["error"] for row in mine], label=package, **style)
        own = [row for row in mine if row["default"]]
        axes.plot([row["ratio"] for row in own], [row["error"] for row in own], "o", mfc="none", mec=color, ms=12)
    axes.set(xlabel="time (zwfs with its own settings = 1)", ylabel="largest error of the intensity")
    axes.legend(fontsize=9)
    return figure


def picture(figure: Figure) -> bytes:
    """PNG without a date."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=200, metadata={"Software": None})
    plt.close(figure)
    return stream.getvalue()


figures.use_style()
