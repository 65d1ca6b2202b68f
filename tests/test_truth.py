"""Text of a run with other parameters: what holds for the book's alone is hidden, and all numbers make sense."""

import ast
import re
import sys
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from joblib import parallel_config

from book._tools.declared import accept, accept_together, parameters
from book._tools.notebook import BOOK
from studies import fig09_bench_linearity, photon_noise
from studies.kit import results
from studies.kit.iteration import DARK_RING
from studies.kit.methods import MASKS
from studies.kit.tables import Table, Text

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
SMALL = {"n_pixels": 24, "n_screens": 1, "n_modes": 15, "n_iterations": 3}
# NaN, infinity or a limit of zero: no page may show them.
NONSENSE = re.compile(r"(?<![\w.])-?(inf|nan)(?!\w)|\b(inf|nan) ?%|\b0\.0+ ?(±|rad\b|λ)", re.IGNORECASE)
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?")
TARGET = re.compile(r"\]\([^)]*\)|`[^`]*`")  # of a link, and code
# For which value something was computed: in a sentence, and in the head of a table, its first column or a legend.
SAID = re.compile(r"\b(?:[Aa]t|[Ii]n a band of) ([\d.]+(?:e[+-]?\d+)?) ?(rad\b|%|λ/D|photons)")
LABEL = re.compile(r"(?:^|, |\bat |\binput )([\d.]+(?:e[+-]?\d+)?)(?: ?(rad\b|%|λ/D|photons)|$)")
FIXED = {  # values that no parameter changes
    "beyond_range": [DARK_RING, *(mask.diameter for masks in MASKS.values() for mask in masks)],
    "calibration": [0.5],  # rad rms, of the recorded faint frames
    "fig04_dimple_diameter": [DARK_RING],
    "fig09_bench_linearity": [fig09_bench_linearity._SHARE],
    "photon_noise": photon_noise.EXPECTED,
}


def run(name, given, monkeypatch):
    """Run the code cells of a notebook here; return the Markdown that they compute, and the figures."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    known = parameters(notebook)
    monkeypatch.chdir(NOTEBOOKS)
    changed = accept(given, known)
    accept_together(notebook, {key: one.default for key, one in known.items()} | changed)
    stub = ModuleType("myst_nb")
    stub.glue = lambda name, value, display: None
    monkeypatch.setitem(sys.modules, "myst_nb", stub)
    monkeypatch.delenv(results.FOLDER, raising=False)
    shown, figures, space = [], [], {"__name__": "notebook"}
    # Drawing takes half of the time.
    monkeypatch.setattr(results, "publish", lambda figure, name, screens=None: figures.append(figure))
    with parallel_config(backend="sequential"), plt.rc_context():
        for cell in notebook.cells:
            if cell.cell_type != "code":
                continue
            code = ast.parse(cell.source)
            last = code.body.pop() if isinstance(code.body[-1], ast.Expr) else None
            exec(compile(code, name, "exec"), space)
            if last is not None:
                shown.append(eval(compile(ast.Expression(last.value), name, "eval"), space))
            if "parameters" in cell.metadata.get("tags", ()):
                space |= changed
            plt.close("all")
    return [output for output in shown if isinstance(output, Table | Text)], figures


def long_numbers(markdown):
    """Numbers of a text with more than three significant digits, but for years, which are whole numbers."""
    for number in NUMBER.findall(TARGET.sub("", markdown)):
        digits = number.replace(".", "").lstrip("0") if "." in number else number.strip("0")
        if len(digits) > 3 and not re.fullmatch(r"(19|20)\d\d", number):
            yield number


def numbers_in(value):
    """Numbers of a parameter."""
    if isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers_in(part)
    elif isinstance(value, int | float):
        yield value


def labels(computed, figures):
    """Values, with their unit, for which text and figures say that something was computed."""
    for output in computed:
        if isinstance(output, Text):
            yield from SAID.findall(output.markdown)
        else:
            for cell in [*output.header, *(row[0] for row in output.rows)]:
                yield from LABEL.findall(str(cell))
    for figure in figures:
        legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
        texts = [text for legend in legends if legend for text in legend.get_texts()]
        texts += [text for axes in figure.axes for text in (axes.title, *axes.texts)]
        for text in texts:
            yield from LABEL.findall(text.get_text())


def sampled(name, given, figures):
    """Parameters of a run, and where its curves have points."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    values = {key: one.default for key, one in parameters(notebook).items()} | given
    lines = [np.ravel(line.get_xdata()) for figure in figures for axes in figure.axes for line in axes.lines]
    return np.concatenate([list(numbers_in(values)), FIXED.get(name, []), *lines])


def unsampled(labels, sampled):
    """Labels of values, with their unit, that are no sampled value with two digits or more."""
    written = [float(f"{value:.{digits}g}") for value in sampled for digits in (2, 3, 6)]
    for number, unit in labels:
        if not np.isclose(float(number) / (100 if unit == "%" else 1), written, rtol=1e-6).any():
            yield f"{number} {unit}"


def without_data(axes):
    """Whether a panel has axes but nothing finite on them."""
    if not (axes.axison and axes.get_visible()) or hasattr(axes, "_colorbar"):
        return False
    drawn = (*axes.images, *axes.containers, *(drawing for drawing in axes.collections if drawing.get_paths()))
    curves = [line.get_xydata() for line in axes.lines if line.get_transform() == axes.transData]
    return not drawn and not any(np.isfinite(points).all(axis=1).any() for points in curves)


BENCH = {"n_pixels": 32}
FIGURE_4 = SMALL | {"n_modes": 149, "step": 0.5, "step_fine": 0.3, "more_iterations": [5], "n_screens_few": 1}
RANGE = SMALL | {
    "inputs": [0.1, 1.0], "inputs_noiseless": [2.0], "photons": [1e3], "n_subpixels": 2, "n_screens_model": 1,
    "n_screens_many": 2, "diameters": [1.0, 3.5], "n_screens_dimple": 1, "n_screens_bound": 1,
}  # fmt: skip
DECISION = BENCH | {
    "n_pixels_fine": 40,
    "n_screens": 2, "n_screens_fine": 2, "n_screens_perfect": 2, "n_loops": 2,
    "n_iterations": 3,
}  # fmt: skip
ZONE = {"n_pixels": 16, "n_modes": 3, "n_cycles": 4, "n_screens": 1, "photons": [1e8], "photons_gain": [1e8]}


def each(**odd):
    """Each of the odd values alone."""
    return [{name: value} for name, values in odd.items() for value in values]


# The base of a notebook, which is quick, and what is changed of it.
CASES = {
    "fig03_dynamic_range": (
        SMALL | {"n_rms": 3, "rms_fine": [0.05], "rms_beyond": [1.5], "extents": [1.0, 2.0]},
        {"noise": {"photons": 10.0}}, {"noise": {"photons": 1e3, "read_noise": 5.0}, "n_screens": 2},
        {"rms_max": 4.0, "rms_beyond": []}, {"rms_max": 0.05, "rms_beyond": [], "rms_fine": []},
        {"screens": {"kind": "von_karman", "outer_scale": 0.5}, "pupil": {"kind": "vlt"}},
        {"pupil": {"kind": "hexagonal"}, "screens": {"kind": "segments"}, "n_pixels": 48},
        {"threshold": 0.001, "n_iterations": 1}, {"diameter": 8.0, "phase_shift": 3.13, "extents": [1.0]},
        *each(screens=[{"kind": "kolmogorov", "d_over_r0": 20.0}], threshold=[1.0]),
    ),
    "fig04_dimple_diameter": (FIGURE_4,
        {"diameter_max": 1.0}, {"diameter_max": 1.0, "step": 2.0, "noise": {"photons": 10.0}},
        {"diameter_max": 2.2, "rms": 2.0}, {"diameter_max": 8.0, "step": 2.0},
        {"rms": 0.01, "threshold": 1.0, "diameter_max": 1.5},
        {"threshold": 0.001, "diameter_max": 2.5, "noise": {"photons": 100.0}},
        {"screens": {"kind": "kolmogorov", "d_over_r0": 2.0}, "diameter_max": 1.5},
        {"pupil": {"kind": "vlt"}, "claimed": 8.0, "diameter_max": 2.0},
        {"phase_shift": 0.01, "diameter_max": 1.2, "n_iterations": 1},
        {"rms": 4.0, "more_iterations": [1], "diameter_max": 1.5},
    ),
    "beyond_range": (RANGE,
        {"inputs": [4.0], "n_iterations": 1}, {"inputs": [0.01], "inputs_noiseless": [], "input_many": 0.01},
        {"photons": [1.0], "photons_shown": 1e12},
        {"diameter_error": 0.0, "shift_error": 0.0, "image_shift": 0.0, "amplitude_error": 0.0},
        {"diameters": [8.0, 0.1], "n_modes": 3, "input_many": 4.0}, {"diameters": [1.0], "exponent": 0.0},
        *each(phase_shift=[3.13, 0.01], input_dimple=[4.0, 0.01]),
        *each(screens=[{"kind": "kolmogorov", "d_over_r0": 20.0},
        {"kind": "von_karman", "outer_scale": 0.2, "d_over_r0": 0.1}], threshold=[0.001, 1.0], diameter=[0.1]),
    ),
    "photon_noise": (SMALL | {"inputs": [0.5], "photons": [100.0], "wrong": [2.0, 0.5]},
        {"photons": [1.0]}, {"photons": [1e9], "photons_bars": 1e9}, {"n_modes": 1, "extent": 1.0},
        *each(inputs=[[4.0], [0.001, 0.002]], wrong=[[1.0], [100.0, 0.01]], diameter=[0.1], diameter_wide=[8.0],
        phase_shift=[3.13]),
    ),
    "design": ({"n_pixels": 24, "n_screens": 2, "n_modes": 15, "wanted_error": 10.0},
        {"input_error": 0.0}, {"read_noise": 0.0, "n_modes": 1}, {"input_error": 635.0, "n_modes": 30},
        *each(throughput=[1.0], frame_rate=[1e6], wanted_error=[63.0, 0.05], read_noise=[20.0]),
    ),
    "sensors": (
        {"n_pixels": 16, "n_modes": 4, "n_screens": 1, "inputs": [0.0, 0.5], "n_positions": 2, "padding": 2,
        "n_steps": 3}, {"inputs": [3.0]}, *each(n_modes=[3], n_steps=[1], inputs=[[0.0], [1.0, 1.0]],
        read_noise=[0.0, 1e4], diameter=[0.1, 8.0], phase_shift=[0.01, 3.13], diameter_large=[0.1, 8.0],
        phase_shift_large=[0.01], n_positions=[1], modulation=[0.1], exponent=[0.0], shown=[0.0, 3.0],
        photons=[1.0]),
    ),
    "phase_shift_pairs": (SMALL | {"n_quarter": 2},
        {"rms": 4.0}, *each(rms=[0.0], n_quarter=[1], diameter=[0.1, 8.0], n_modes=[1],
        n_iterations=[2], exponent=[0.0]),
    ),
    "phase_amplitude": ({"n_pixels": 16, "n_modes": 3, "n_screens": 1, "variations": [0.0, 0.2]},
        {"variations": [0.4]}, *each(variations=[[0.0]], photons=[1.0, 1e9], rms=[0.0, 4.0], shown=[0.0],
        diameter=[8.0], phase_shift=[0.01], n_modes=[1]),
    ),
    "dark_zone": (ZONE,
        {"drift": 1e3}, {"wavelength": 20000.0, "photons_gain": [1e4, 1e14]}, *each(drift=[0.001],
        photons=[[1e4], [1e14]], gains=[[1.5], [0.01]], diameter=[8.0], phase_shift=[3.13],
        phase_shift_best=[0.01]),
    ),
    "bandwidth": ({"n_pixels": 16, "n_modes": 3, "n_screens": 1, "inputs": [0.5], "bandwidths": [0.0, 0.2]},
        {"inputs": [4.0]}, *each(inputs=[[0.001], [0.1, 0.2]], bandwidths=[[0.0], [1.0]], photons=[1.0, 1e9],
        phase_shift=[0.01], diameter=[8.0], n_modes=[1]),
    ),
    "identities": ({"n_pixels": 24, "n_modes": 15, "n_screens": 1, "n_shifts": 4, "inputs": [0.1]},
        *each(inputs=[[0.001]], rms=[0.0, 4.0], diameter=[0.1, 8.0], largest_phase=[0.1], resolution=[0.001],
        n_shifts=[4], patch_diameter=[0.1, 8.0]),
    ),
    "zernike_sensor": ({"n_pixels": 24},
        *each(height=[3.0, 0.1], diameter=[0.1, 8.0], phase_shift=[0.01, 3.13], n_pixels=[16, 33, 100, 101]),
    ),
    "at_a_glance": ({"n_pixels": 24, "n_modes": 15},
        *each(rms=[4.0, 0.0], diameter=[0.1, 8.0], phase_shift=[0.01, 3.13], n_iterations=[1], n_modes=[1],
        exponent=[0.0, -6.0]),
    ),
    "one_look": (SMALL | {"inputs": [0.5], "leakages": [0.03], "rms_pairs": [0.5], "pairs": [1, 3]},
        {"inputs": [4.0]}, {"inputs": [0.001, 0.002], "pairs": [1]}, *each(leakages=[[0.4], [0.0, 0.0]],
        photons=[1.0, 1e9], leakage=[0.0, 0.4], flux_ratio=[0.25, 4.0], rms=[0.0, 4.0], rms_pairs=[[4.0, 0.001]],
        n_iterations=[1], n_modes=[1], exponent=[0.0]),
    ),
    "fig09_bench_linearity": (BENCH | {"n_screens": 1, "n_rms": 2, "rms_fine": [], "n_iterations": 3},
        {}, {"rms_fine": [0.1, 0.3], "poke": 1.5}, *each(rms_max=[4.0, 0.05], bench=[{"photons_per_image": 1e7},
        {"static": 0.0}, {"n_rings": 1, "missing": []}, {"leakage": 0.5}], n_iterations=[1], extent=[1.0]),
    ),
    "bench": (BENCH,
        {}, *each(rms=[0.0, 4.0], bench=[{"photons_per_image": 1e7}, {"static": 3.0}, {"leakage": 0.5},
        {"n_rings": 1, "missing": []}, {"blur": 20.0}, {"diameter": 8.0}, {"static": 0.0}], n_iterations=[1],
        exponent=[0.0, -4.0], wavelength=[100.0, 2e4]),
    ),
    "error_budget": (BENCH | {"n_screens": 1, "n_iterations": 2, "inputs": [0.3], "leakages": [0.1]},
        {}, *each(inputs=[[0.001], [4.0]], leakages=[[], [0.49]],
        bench=[{"static": 0.0}, {"photons_per_image": 1e7}, {"n_rings": 1, "missing": []}, {"blur": 20.0}],
        n_iterations=[1]),
    ),
    "calibration": (
        dict.fromkeys(("n_commands", "n_steps", "oversampling", "n_screens"), 1) | {"largest": 0.1},
        {}, {"n_steps": 2, "n_commands": 2}, *each(n_commands=[4], n_steps=[2], oversampling=[2],
        largest=[1.2], n_screens=[2], n_iterations=[1]),
    ),
    "decision": (DECISION,
        {}, {"rms": 0.01, "rms_small": 0.01}, {"photons": 10.0, "photons_faint": 10.0},
        {"rms_loop": 0.01, "rms_loop_small": 0.01},
        dict.fromkeys(("rms_loop", "rms_loop_middle", "rms_loop_small"), 4.0),
        {"photons_loop": 0.01, "photons_loop_faint": 0.01}, *each(rms=[4.0], poke=[1.5], extent=[2.0],
        n_iterations=[1]),
    ),
}  # fmt: skip
LAYOUT = (
    {"n_pixels": 24},
    *each(n_pixels=[16, 33], diameter=[0.1, 8.0], phase_shift=[0.01, 3.13], rms=[0.0, 4.0], seed=[0, 7]),
)
CASES |= {"fig01_sensor_layout": LAYOUT, "fig02_vector_sensor": LAYOUT}
CASES["own_frames"] = (
    {"fitted": []},
    {"fitted": ["background"], "n_iterations": 2},
    *each(
        rms=[0.0, 4.0],
        n_bad=[0, 2000],
        n_iterations=[1],
        diameter=[0.5, 3.0],
        read_noise=[1e3],
        exposure_ratio=[2.0],
    ),
)
LONG = {"calibration", "decision"}
COSTLY = {name for name in CASES if name not in ("zernike_sensor", "at_a_glance", "identities")}


def alike(parameters):
    """Parameters, of which those of the mask and of the band count as one.

    Together, odd values of a mask leave no reference wave, and a wide band of a large dimple takes minutes.
    """
    return {"mask" if name.startswith(("diameter", "phase_shift", "bandwidth")) else name for name in parameters}


def packed(odds):
    """Odd values of different parameters together: every value is in one of few sets."""
    packs = []
    for odd in odds:
        free = next((pack for pack in packs if not alike(pack) & alike(odd)), None)
        if free is None:
            packs.append(free := {})
        free.update(odd)
    return packs


def marks(name, place):
    return [pytest.mark.slow] if name in LONG or (name in COSTLY and place) else []


SETS = [
    pytest.param(name, base | pack, marks=marks(name, place))
    for name, (base, *odds) in CASES.items()
    for place, pack in enumerate([odds[0], *packed(odds[1:])])
]
FUZZ = pytest.mark.slow, pytest.mark.fuzz
ALONE = [(name, base | odd) for name, (base, *odds) in CASES.items() for odd in odds[1:]]


@pytest.mark.parametrize(("name", "given"), [*SETS, *(pytest.param(*one, marks=FUZZ) for one in ALONE)])
@pytest.mark.filterwarnings("ignore")  # of phases beyond what a sensor resolves
def test_text_of_odd_parameters_names_no_limit_that_does_not_exist(name, given, monkeypatch):
    computed, figures = run(name, given, monkeypatch)
    assert not [output for output in computed if NONSENSE.search(output._repr_markdown_())]
    sentences = [output.markdown for output in computed if isinstance(output, Text)]
    assert not [said for said in sentences if any(long_numbers(said))]
    assert not [said for said in sentences if "$" in said]  # a run in the page sets no formulas
    assert not [figure for figure in figures if any(map(without_data, figure.axes))]
    strange = set(unsampled(labels(computed, figures), sampled(name, given, figures)))
    if "d_over_r0" in given.get("screens", {}):
        strange = {label for label in strange if not label.endswith(" rad")}  # an rms that was measured
    assert not strange


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("0.9964 of 1000 photons, 100000 at most, and 1.02", ["0.9964"]),
        ("[Figure 3](fig03.ipynb#a-1234) of 2024, 12345 screens, 1.5e-05, `1.2345`", ["12345"]),
    ],
)
def test_long_numbers_in_sentences_are_found(said, expected):
    assert list(long_numbers(said)) == expected


def test_labels_of_values_that_were_not_sampled_are_found():
    table = Table(["input", "at 2.6", "phase-shifted, 5 %"], [["0.8 rad", 1.0, 3.0]])
    text = Text("At 0.5 rad rms it is wrong by 0.3 rad. In a band of 20 % and at 1000 photons it fails.")
    said = labels([table, text], [])
    assert list(unsampled(said, [0.3, 0.504, 2.5, 1e3])) == ["2.6 ", "5 %", "0.8 rad", "20 %"]


@pytest.mark.parametrize("name", CASES)
def test_markdown_holds_no_numbers_of_a_run(name):
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    written = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    written += [cell.metadata.get("mystnb", {}).get("figure", {}).get("caption", "") for cell in notebook.cells]
    assert not [text for text in written if "{glue:" in text or "defaults}" in text or "} defaults" in text]
    marked = [cell.source for cell in notebook.cells if BOOK in cell.metadata.get("tags", ())]
    assert all(text.startswith("## With the book's parameters\n") for text in marked)


def test_every_notebook_is_tried():
    assert CASES.keys() == {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
