"""Tables and figures of the performance page, from the measurements of `make bench`."""

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.config import Config

from studies.kit.style import use_style
from studies.kit.variants import variants
from zwfs._system import write_file

MEASURED = "book/_ext/performance.json"
PICTURES = "_build/performance"
ACCURATE = 1.05e-4  # largest error of the second comparison, 1e-4 when rounded
# Tol's muted colours; the colours of the figures stand for methods only.
PACKAGES = {
    "zwfs": ("#332288", "v"),
    "HCIPy": ("#CC6677", "o"),
    "HCIPy, vector": ("#882255", "D"),
    "prysm": ("#117733", "^"),
    "pyZELDA": ("#888888", "s"),
}
INTENSITY = "largest error of the intensity"


def add_substitutions(app: Sphinx, config: Config) -> None:
    """Define the tables of the page, as in ``{{ performance.rates }}``, and draw its figures."""
    measured = json.loads(Path(app.srcdir, MEASURED).read_text("utf-8"))
    added = tables(measured["speed"]) | {
        "peers": peers([row for row in measured["peers"] if row["task"] == "one frame"]),
        "machine": measured["machine"],
        "pages": pages(measured.get("pages", [])),
    }
    config.myst_substitutions = config.myst_substitutions | {"performance": added}
    with plt.rc_context():
        use_style()
        figures = {
            "peers": error_against_time(measured["peers"]),
            "growth": time_against_pixels(measured["speed"]["slope"]),
        }
        for name, figure in figures.items():
            drawn = {name: figure} | {f"{name}.{kind}": drawing for kind, drawing in variants(figure).items()}
            for file, drawing in drawn.items():
                stream = io.BytesIO()
                drawing.savefig(stream, format="png", dpi=200, metadata={"Software": None})
                write_file(Path(app.srcdir, PICTURES, f"{file}.png"), stream.getvalue())
            plt.close(figure)


def table(header: list[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown; all columns but the first are aligned to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def peers(rows: list[dict[str, Any]]) -> str:
    """Return a table of each package with its default, and with its fastest accurate setting."""
    lines = []
    for package in dict.fromkeys(row["package"] for row in rows):
        mine = [row for row in rows if row["package"] == package]
        accurate = [row for row in mine if row["error"] <= ACCURATE]
        quickest = min(accurate, key=lambda row: row["ratio"], default=None)
        for row in mine:
            if row["default"] or row is quickest:
                usual = "our choice" if package == "prysm" else "default"  # prysm has no default
                setting = f"{package}, {row['setting']}{f' ({usual})' if row['default'] else ''}"
                lines.append([setting, f"{row['ratio']:.3g}", power(row["error"])])
    return table(["package and setting", "time (zwfs\u00a0=\u00a01)", INTENSITY], lines)


def tables(speed: dict[str, Any]) -> dict[str, str]:
    """Return the tables and sentences on speed, by name."""
    methods = [[name, f"{1e3 * t:.2g}"] for name, t in speed["others"].items()]
    return {
        "rates": rates(speed),
        "methods": table(["method", "time (ms)"], methods),
        "likelihood": table(
            ["task", "time, in propagations of HCIPy"],
            [[name.replace("lambda/D", "λ/D"), f"{ratio:.2g}"] for name, ratio in speed["likelihood"].items()],
        ),
        "looks": looks(speed["looks"]),
        "telemetry": telemetry(speed["telemetry"]),
        "latency": latency(speed["latency"]),
        "late": late(speed["latency"]),
        "controllers": controllers(speed["controllers"]),
    }


def pages(rows: list[dict[str, Any]]) -> str:
    """Return a table of the times of the pages, the shortest first."""
    lines = [
        [
            f"{{doc}}`../notebooks/{row['page']}`",
            "quick" if row["quick"] else "of the book",
            f"{row['figure']:.0f}",
        ]
        for row in sorted(rows, key=lambda row: float(row["figure"]))
    ]
    return table(["page", "parameters", "time to the figure (s)"], lines)


def rates(speed: dict[str, Any]) -> str:
    """Return a table of reconstructions per second, one frame pair at a time."""
    chosen = [
        row
        for row in speed["real time"]
        if row["dtype"] == "float32" and (row["accelerate"] or row["n_pixels"] == 100)
    ]
    settings = [f"{row['n_iterations']} iterations{', accelerated' * row['accelerate']}" for row in chosen]
    settings += ["1 iteration that starts from the previous phase"] * len(speed["closed loop"])
    rows = [
        [f"{row['n_pixels']} pixels, {setting}", f"{row['rate']:.0f}"]
        + [power(row[error]) if error in row else "" for error in ("median error", "largest error")]
        for row, setting in zip(chosen + speed["closed loop"], settings, strict=True)
    ]
    return table(["setting", "rate (1/s)", "median error, no noise (rad)", "largest error (rad)"], rows)


def looks(rows: list[dict[str, Any]]) -> str:
    """Return a table of times from a frame pair to the phase, over that of a propagation of HCIPy, the first."""
    lines = [
        [
            row["road"],
            f"{row['time'] / rows[0]['time']:.2g}",
            "" if row["median error"] is None else power(row["median error"]),
        ]
        for row in rows
    ]
    pair = f"one frame pair, {rows[0]['n_pixels']} pixels"
    return table([pair, "time, in propagations of HCIPy", "median error, no noise (rad)"], lines)


def latency(rows: list[dict[str, Any]]) -> str:
    """Return a table of the times of single frames."""
    settings = [f"{row['n_pixels']} pixels{'' if row['frozen'] else ', with garbage collector'}" for row in rows]
    quantiles = "p50", "p99", "p99.9"
    times = [
        [setting, *(f"{1e6 * row[name]:.0f}" for name in quantiles), f"{100 * row['late']:.1f}"]
        for setting, row in zip(settings, rows, strict=True)
    ]
    return table([f"{rows[0]['n_frames']} frames", *(f"{name} (μs)" for name in quantiles), "late (%)"], times)


def controllers(rows: list[dict[str, Any]]) -> str:
    """Return a table of the processor time of each road to commands, over that of the bare product, the first."""
    unit = rows[0]["processor p50"]
    lines = [[row["road"], *(f"{row[f'processor {name}'] / unit:.2g}" for name in ("p50", "p99"))] for row in rows]
    return table([f"processor time, {rows[0]['n_pixels']} pixels to 50 commands", "p50", "p99"], lines)


def late(rows: list[dict[str, Any]]) -> str:
    """Return a sentence on the median and the share of late calls, with the garbage collector off."""
    frozen = [row for row in rows if row["frozen"]]
    medians = " and ".join(f"{1e6 * row['p50']:.0f} μs at {row['n_pixels']} pixels" for row in frozen)
    shares = " and ".join(f"{100 * row['late']:.1f} % at {row['n_pixels']} pixels" for row in frozen)
    slow = [f"{row['n_pixels']}" for row in frozen if row["p99"] > 1e-3]
    missed = f" At {' and '.join(slow)} pixels more than 1 % of the results take longer than 1 ms." if slow else ""
    defined = "A result is *late* if it takes more than 1.3 times the median"
    return f"The median is {medians}. {defined}: {shares} are late.{missed}"


def telemetry(measured: dict[str, Any]) -> str:
    """Return sentences on the time of a long cube."""
    parts = {name: 1e3 * time for name, time in measured["parts"].items()}
    files = f"{measured['frames']} simulated frame pairs of {measured['n_pixels']} pixels"
    sigma, of_modes = (parts[name] / parts["whole"] for name in ("sigma", "sigma of 50 modes"))
    return (
        f"Without commands, {files} took {measured['time']:.1f} s with {measured['threads']} threads, files "
        "included: "
        f"{1e3 * measured['processor time'] / measured['frames']:.2f} ms of processor time for each pair. "
        f"The computation alone takes {parts['whole']:.2f} ms: "
        f"{parts['resampling']:.2f} ms for resampling, {parts['iteration']:.2f} ms for the iteration and "
        f"{parts['residual']:.2f} ms for the residual. The memory grew by {measured['memory'] / 1e6:.0f} MB. "
        f"Standard errors of all points take {sigma:.0f} times as long as the phase, those of 50 modes "
        f"{of_modes:.0f} times.\n"
    )


def power(value: float) -> str:
    """Write a number, a small one as a power of ten."""
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{value:.2g}" if value >= 1e-3 else f"${mantissa}\\times10^{{{int(exponent)}}}$"


def error_against_time(rows: list[dict[str, Any]]) -> Figure:
    """Draw the error of one or two frames against time, for every setting of every package."""
    figure, axes = plt.subplots(figsize=(7, 4.2))
    for package, (color, marker) in PACKAGES.items():
        mine = [row for row in rows if row["package"] == package]
        if package == "zwfs":
            mine = [row for row in mine if row["task"] == "one frame"]
        line = {"color": color, "marker": marker, "linestyle": "-", "lw": 1}
        axes.loglog([row["ratio"] for row in mine], [row["error"] for row in mine], label=package, **line)
        own = [row for row in mine if row["default"]]
        axes.plot([row["ratio"] for row in own], [row["error"] for row in own], "o", mfc="none", mec=color, ms=12)
    axes.set(xlabel="time (zwfs with its defaults = 1)", ylabel=INTENSITY)
    axes.legend(fontsize=9)
    return figure


def time_against_pixels(slope: dict[str, Any]) -> Figure:
    """Draw the time of a reconstruction against the number of pixels across the pupil."""
    figure, axes = plt.subplots(figsize=(7, 3.8))
    pixels, times = slope["n_pixels"], [1e3 * time for time in slope["times"]]
    axes.loglog(pixels, times, "v-", color=PACKAGES["zwfs"][0], label="measured")
    proportion = [times[-1] * (n / pixels[-1]) ** 2 for n in pixels]
    axes.loglog(pixels, proportion, "--", color="#777777", label="proportional to the number of pixels")
    axes.set(xlabel="pixels across the pupil", ylabel="time (ms)")
    axes.set_xticks(pixels, map(str, pixels))
    axes.minorticks_off()
    axes.legend(fontsize=9)
    return figure


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the substitutions."""
    app.connect("config-inited", add_substitutions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
