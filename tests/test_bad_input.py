"""Bad input to the public functions, classes and methods: a clear error or a right answer, never a wrong number.

Public names are collected from the modules, and their parameters from the signatures. Each parameter gets every
bad value while the others keep the valid ones of `valid`. A new public name needs no entry here unless it has a
required parameter of a new name; without one its tests fail.
"""

import importlib
import inspect
import re
import tempfile
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import zwfs
from zwfs.bench import Bench, BenchModel, segment_residual, segment_screens, write_bench
from zwfs.bench.model import segment_pistons
from zwfs.frames import BenchFit, Calibration, pipeline, reconstruct, recover_phase
from zwfs.frames.files import read_all
from zwfs.frames.refine import steps
from zwfs.frames.registration import register_frames
from zwfs.loop import LoopRecord
from zwfs.masks import focal_field
from zwfs.reconstructors.base import Reconstructor
from zwfs.reconstructors.learned import BenchErrors, BenchValues
from zwfs.turbulence import FrozenFlow, turbulent_screens

from .conftest import needs_modes, pair

# What simulates a sensor and reconstructs a phase. Most tests of camera frames are in other files.
MODULES = (
    *("pupil", "modes", "turbulence", "masks", "sensor", "polychromatic", "detector", "bounds", "loop", "metrics"),
    *("design", "units", "reconstructors", "bench.files", "bench.model"),
)

# Results that may be infinite: the limit lies beyond what was sampled, or no limit is set.
INFINITE = {"dynamic_range", "structure_function", "turbulent_screens"}
# Documented by their attributes.
_RESULTS = zwfs.Reconstruction, zwfs.LikelihoodReconstruction, LoopRecord, BenchModel, Calibration
RESULTS = {kind.__name__: kind for kind in _RESULTS}
# Hooks of the base classes of reconstructors.
INTERNAL = {"model", "solve", "invert", "begin", "step", "constants"}
# Give back what they are given, NaN and infinity too.
PASSED = {*RESULTS, "Pupil.gather", "Pupil.scatter", "phase_to_opd", "opd_to_phase"}
# Take complex numbers where the valid ones are real.
COMPLEX = {"Pupil.gather", "Pupil.scatter", "focal_field"}


@cache
def targets():
    """Public callables by name: functions, classes with documented parameters, and the methods of all classes."""
    public = {}
    for module in (importlib.import_module(f"zwfs.{name}") for name in MODULES):
        for name, thing in inspect.getmembers(module):  # of a package, too, which imports at the first use
            if (
                name.startswith("_")
                or name in INTERNAL
                or not getattr(thing, "__module__", "").startswith(module.__name__)
            ):
                continue
            if inspect.isfunction(thing):
                public[name if name not in public else f"{name} of {module.__name__[5:]}"] = thing
            elif inspect.isclass(thing) and not getattr(thing, "_is_protocol", False):
                # A class that documents attributes only is a result: functions of the package make it.
                if inspect.isabstract(thing):
                    continue
                if "Parameters\n" in (thing.__doc__ or "") or name == "Pupil":
                    public[name] = thing
                inherited = {"__call__": thing.__call__} if issubclass(thing, Reconstructor) else {}
                for key, member in (inherited | vars(thing)).items():
                    shown = not key.startswith("_") or key == "__call__"
                    if shown and key not in INTERNAL and callable(getattr(thing, key)):
                        public[f"{name}.{key}"] = member
    del public["Bench"]  # 26 parameters at 20 ms a value: see REFUSED
    del public["LearnedReference.train"]  # seconds a value: see test_learned.py
    del public["design_sensor"]  # the same: see test_design.py
    return public | RESULTS


BENCH = Bench(n_pixels=40, n_rings=1, missing=(), photons_per_image=1e8)


@cache
def camera():
    """Frames of a small bench, their measurement and calibration."""
    with tempfile.TemporaryDirectory() as folder:
        files = write_bench(folder, BENCH, seed=1)
        kinds = [[files[name]] for name in ("frame", "pupils", "dark")]
        frames, clear, _ = read_all(*kinds)
        registered = register_frames(frames, clear)
        measurement = pipeline.reduce_frames(registered, pipeline.Optics(1.06, (1.5, -1.5)))
        return frames, clear, measurement, Calibration.from_files(*kinds)


@cache
def valid() -> dict:
    """Valid arguments: by the name of the parameter, or of the callable and the parameter."""
    pupil = zwfs.Pupil.circular(12)
    modes = zwfs.zernike_basis(pupil, 5)
    plus, minus = zwfs.Dimple(1.06, np.pi / 2), zwfs.Dimple(1.06, -np.pi / 2)
    classic, shifted = zwfs.ZernikeSensor(pupil, plus), zwfs.ZernikeSensor(pupil, plus, minus)
    phase = zwfs.power_law_screens(modes, 0.2, 1, seed=1)[0]
    field = pupil.amplitude * np.exp(1j * phase)
    pistons, methods = np.linspace(-0.5, 0.5, BENCH.n_segments), {}
    for kind in zwfs.RECONSTRUCTORS:
        options = {"n_iterations": 3} if kind.iterative else {}
        options |= {"modes": modes} if needs_modes(kind) else {}
        methods[kind.__name__] = kind(shifted if kind.n_masks[1] > 1 else classic, **options)
    method, mirror = methods["PhaseShifted"], zwfs.Mirror(pupil, modes)
    learned, weights = zwfs.LearnedReference(shifted), Path(tempfile.mkdtemp()) / "weights.npz"
    learned.save(weights)
    arguments = {
        "pupil": pupil, "modes": modes, "phase": phase, "opd": phase, "field": field, "estimate": phase,
        "truth": phase, "sensor": shifted, "masks": plus, "maps": phase, "values": pupil.gather(phase),
        "image": np.abs(field) + 0.1, "center": (5.5, 5.5), "n_pixels": 12, "n_modes": 4, "rms": 0.2, "r0": 0.2,
        "separation": np.array([0.1, 0.5]), "n_screens": 1, "seed": 1, "diameter": 1.06,
        "function": lambda u, v: 0.9 * np.exp(1j * (u + v) / 9), "u": np.linspace(0, 0.5, 4),
        "v": np.linspace(0, 0.5, 4), "j": 4, "photons": 1e5, "electrons": np.abs(field),
        "frames": shifted.measure(phase), "change": phase, "reconstructor": method, "mirror": mirror,
        "plant": shifted, "influence": modes, "commands": np.zeros(5), "disturbance": phase[np.newaxis],
        "screens": phase[np.newaxis], "wavelength": 635.0, "n_cycles": 1, "wavelengths": [600.0, 650.0],
        "bandwidth": 0.1, "tolerance": 1e-3, "time": 0.01, "bench": BENCH, "folder": ".", "pistons": pistons,
        "commanded": pistons, "numbers": BENCH.numbers,
        # of one callable
        "Pupil.amplitude": pupil.amplitude,
        "Pupil.segments": pupil.segments,
        "Pupil.from_segments.amplitude": 1.0,
        "Dimple.amplitude": 1.0,
        "Dimple.phase": 1.5,
        "power_law_screens.frequencies": np.arange(1.0, 6.0),
        "ZernikeSensor.adjoint.field": shifted.propagate(field),
        "Sensor.measure.amplitude": pupil.amplitude,
        "cramer_rao.modes": modes,
        "cramer_rao.amplitude": pupil.amplitude,
        "close_loop.stroke": 1.0,
        "close_loop.camera": zwfs.Detector(1e3),
        "dynamic_range.rms": np.array([0.1, 0.2]),
        "dynamic_range.error": np.array([0.001, 0.1]),
        "Linear.amplitude": pupil.amplitude,
        "GradientDescent.modes": modes,
        "GradientDescent.cost.phase": pupil.gather(phase),
        "BenchModel.normalise.counts": BENCH.frames(seed=1),
        "BenchModel.pistons.phase": BENCH.commanded_phase(pistons),
        "segment_pistons.phase": BENCH.commanded_phase(pistons),
        "segment_pistons.segments": BENCH.segments,
        "bench_error.phase": recover_phase(camera()[2]),
        "LearnedReference.__call__.frames": shifted.measure(phase),
        "LearnedReference.average.frames": shifted.measure(modes[:3]),
        "LearnedReference.bench": BenchValues(0.0, 1.0, 0.0, np.zeros(2), 0.0, 0.0),
        "LearnedReference.save.path": "weights.npz",
        "LearnedReference.load.path": weights,
        "MaximumLikelihood.photons": 1e4,
        "MaximumLikelihood.modes": modes,
        "MaximumLikelihood.prior": np.eye(5),
        **{f"{name}.sensor": method.sensor for name, method in methods.items()},
        **{f"{name}.__call__.frames": method.sensor.measure(phase) for name, method in methods.items()},
        **{f"{name}.__call__.start": 0.1 * phase for name, method in methods.items() if method.iterative},
        **{f"{name}.__call__.start": None for name, method in methods.items() if not method.iterative},
    }  # fmt: skip
    instances = {
        "Pupil": pupil,
        "FrozenFlow": FrozenFlow(pupil, 0.2, 1, seed=1),
        "Dimple": plus,
        "Patch": zwfs.Patch(1.0, lambda u, v: 0.9 * np.exp(1j * u / 9)),
        "Sensor": shifted,
        "ZernikeSensor": shifted,
        "PolychromaticSensor": zwfs.PolychromaticSensor(shifted, [600.0, 650.0]),
        "Detector": zwfs.Detector(1e3),
        "Mirror": mirror,
        "LoopRecord": zwfs.close_loop(shifted, mirror, method, phase[np.newaxis]),
        "Reconstruction": method(shifted.measure(phase)),
        "LearnedReference": learned,
        **methods,
    }
    instances |= {
        "Calibration": camera()[-1],
        "LikelihoodReconstruction": methods["MaximumLikelihood"](shifted.measure(phase)),
        "Bench": BENCH,
        "BenchModel": BenchModel.from_images(BENCH, 1),
    }
    for name in RESULTS:
        arguments |= {f"{name}.{field}": getattr(instances[name], field) for field in parameters(name)}
    for value in arguments.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)  # who writes to an input raises
    return {"arguments": arguments, "instances": instances}


RAGGED = [[1.0, 2.0], [3.0]]
MASKED = np.ma.array(np.ones(3), mask=[0, 1, 0])


class _Evil:
    """Object that can neither be an array nor be printed."""

    def __repr__(self):
        raise RuntimeError("no text")

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("no array")


# What no parameter of a number, an array or an object takes.
BAD = {
    "nan": np.nan, "inf": np.inf, "-inf": -np.inf, "float32 nan": np.float32("nan"), "list of nan": [np.nan],
    "10**400": 10**400, "-10**400": -(10**400), "10**5000": 10**5000, "Fraction(10**400)": Fraction(10**400),
    "list of 10**400": [10**400, 1.0], "2**63": 2**63, "2**64": 2**64, "Decimal": Decimal("0.5"),
    "str": "a", "digits": "1",
    "long str": "a" * 5000, "empty str": "", "bytes": b"1", "complex": 1 + 2j,
    "complex array": np.array([1 + 2j, 1j]), "object array": np.array([None, 1], object), "ragged": RAGGED,
    "masked": MASKED, "masked scalar": np.ma.masked, "dict": {}, "dict of str": {"a": 1}, "set": {1}, "class": int,
    "array class": np.ndarray, "lambda": lambda *_: None, "module": np, "object": object(), "evil": _Evil(),
    "generator": (i for i in ()), "range": range(0), "Ellipsis": ..., "slice": slice(None),
    "datetime": np.datetime64(0, "s"),
    "timedelta array": np.zeros(3, "m8[s]"), "str array": np.array(["a", "b"]), "structured": np.zeros(3, "i4,f4"),
    "table of FITS": np.zeros((12, 12), "i4,f4").view(np.recarray), "row of a table": np.zeros(1, "i4,f4")[0],
    "None": None, "list of None": [None], "list of str": ["a"], "nested": [[[[1.0]]]],
    "exception": ValueError("x"),
}  # fmt: skip
# What some take: they must then give a right answer, the one of the plain value where there is one.
UNUSUAL = {
    "1e5": 1e5, "1e155": 1e155, "-1e155": -1e155, "1e308": 1e308, "5e-324": 5e-324,
    "10**7": 10**7, "10**9": 10**9, "10**18": 10**18, "0": 0, "-1": -1, "-0.5": -0.5, "0.0": 0.0,
    "1e-300": 1e-300, "True": True, "np.True_": np.True_,
    "Fraction": Fraction(1, 2), "float32": np.float32(0.5), "float16": np.float16(0.5), "int8": np.int8(1),
    "longdouble": np.longdouble(0.5), "0-d": np.array(0.5), "1-element": np.array([0.5]), "empty": np.array([]),
    "empty list": [], "empty tuple": (), "empty 3-d": np.zeros((0, 12, 12)), "wrong shape": np.ones((3, 7)),
    "5-d": np.ones((1, 1, 1, 1, 1)), "bool array": np.ones((12, 12), bool),
    "int array": np.ones((12, 12), np.int8),
}  # fmt: skip
PLAIN = {
    "Fraction": 0.5, "float32": 0.5, "float16": 0.5, "int8": 1, "longdouble": 0.5, "np.True_": True,
}  # fmt: skip


def variants(value):
    """Bad and unusual forms of a valid number or array: (label, value, plain value or None)."""
    if type(value) is int and abs(value) < 128:
        yield "as int8", np.int8(value), value
    if type(value) is float and np.isfinite(value):
        yield "as Fraction", Fraction(value), value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fc" or not value.ndim:
        return
    hole, pole = value.copy(), value.copy()
    hole.flat[value.size // 2], pole.flat[value.size // 2] = np.nan, np.inf
    yield "with nan", hole, None
    yield "with inf", pole, None
    for factor in (0.0, 1e-300, 1e-155, 1e38, 1e155, 1e300):
        yield f"times {factor:g}", factor * value, None
    yield "cut", value[..., :-1], None
    yield "empty batch", np.broadcast_to(value, (2, *value.shape))[:0], None
    yield "object", value.astype(object), None
    yield "str", value.astype(str), None
    yield "half masked", np.ma.array(value, mask=np.arange(value.size).reshape(value.shape) % 2), None
    yield "as masked array", np.ma.array(value), value
    yield "as list", value.tolist(), value
    yield "big-endian", value.astype(value.dtype.newbyteorder(">")), value
    yield "column-major", np.asfortranarray(value), value
    if value.dtype.kind == "f":
        yield "as complex array", value + 0.1j, None
        yield "negative", -value - 1, None
        yield "long double", value.astype(np.longdouble), value


def accepts(annotation: str, value) -> bool:
    """Whether the annotation of a parameter allows a value."""
    if "Iterable[Any]" in annotation:
        return isinstance(value, Iterable)
    if isinstance(value, bool | np.bool_):
        return bool(re.search("bool|complex|Any", annotation))
    if value is None:
        return "None" in annotation or "Seed" in annotation
    if isinstance(value, str | bytes):
        return bool(re.search("str|Path|Any" if isinstance(value, str) else "bytes|Any", annotation))
    if isinstance(value, int | np.integer):
        return bool(re.search(r"int|float|complex|Array|Any|Seed", annotation))
    if isinstance(value, float | np.floating | Fraction):
        return bool(re.search(r"float|complex|Array", annotation))
    if isinstance(value, complex):
        return bool(re.search("NDArray|complex", annotation))
    if isinstance(value, Mapping | set):
        return bool(re.search("Mapping|Sequence|Iterable", annotation))
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        return False
    if isinstance(value, np.ndarray) and value.dtype.kind not in "biufc":
        return "Sequence" in annotation and value.dtype.names is not None
    if isinstance(value, np.ndarray | list | tuple | range) or inspect.isgenerator(value):
        return bool(re.search(r"Array|Sequence|Iterable|tuple|Mapping", annotation))
    return "Any" in annotation


def leaves(value, path="", depth=0) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of numbers in a result, with their places."""
    if isinstance(value, np.ndarray | np.number | float | complex):
        yield path, np.asarray(value)
    elif isinstance(value, tuple | list):
        for index, item in enumerate(value):
            yield from leaves(item, f"{path}[{index}]", depth)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, f"{path}[{key!r}]", depth)
    elif depth < 4 and hasattr(value, "__dict__") and type(value).__module__.startswith("zwfs"):
        yield from leaves(value.__getstate__(), path, depth + 1)


def is_number(array):
    return array.dtype.kind in "fc"


def parameters(name):
    """Parameters of a public callable, without `self` and those of any name."""
    function = targets()[name]
    listed = list(inspect.signature(getattr(function, "__func__", function)).parameters.values())
    listed = listed[1:] if "." in name and not isinstance(function, staticmethod) else listed
    return {parameter.name: parameter for parameter in listed if parameter.kind is not parameter.VAR_KEYWORD}


class Call:
    """A public callable with valid arguments."""

    def __init__(self, name):
        self.name, self.parameters, self._expected = name, parameters(name), {}

    @property
    def function(self):
        """The callable; a method is that of a valid instance."""
        owner, _, method = self.name.partition(".")
        if not method:
            return targets()[self.name]
        if owner not in valid()["instances"]:
            raise AssertionError(f"{self.name}: no instance of {owner}: add one to `valid`")
        return getattr(valid()["instances"][owner], method)

    def argument(self, name):
        """Valid value of a parameter."""
        parameter, arguments = self.parameters[name], valid()["arguments"]
        for key in (f"{self.name}.{name}", f"{self.name.partition('.')[0]}.{name}"):
            if key in arguments:
                return arguments[key]
        if parameter.default is not parameter.empty and name != "seed":
            return parameter.default
        if name not in arguments:
            raise AssertionError(f"{self.name}: no valid value for its parameter {name}: add one to `valid`")
        return arguments[name]

    def expected(self, parameter, plain):
        """Numbers in the result for a plain value of a parameter, computed once."""
        if id(plain) not in self._expected:
            self._expected[id(plain)] = dict(leaves(self(**{parameter: plain})))
        return self._expected[id(plain)]

    def __call__(self, **changes):
        positional, named = [], {}
        for name, parameter in self.parameters.items():
            value = changes[name] if name in changes else self.argument(name)
            if parameter.kind is parameter.VAR_POSITIONAL:
                positional.append(value)
            elif parameter.kind is parameter.KEYWORD_ONLY or (named and not positional):
                named[name] = value
            else:
                positional.append(value)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)
            return self.function(*positional, **named)


@cache
def right(name):
    """Places of the numbers in the result of the valid call that are not finite."""
    with np.errstate(all="ignore"):
        longer = "history" in parameters(name) and name not in RESULTS
        results = [Call(name)(), Call(name)(history=True) if longer else None]
        numbers = list(leaves(results))
    return {path[3:] for path, array in numbers if is_number(array) and not np.isfinite(array).all()}


def judge(call, parameter, label, value, plain):
    """Return the fault of the answer to a value; None if the answer is right."""
    if "Callable" in str(call.parameters[parameter].annotation) and callable(value):
        return None  # what it raises is the caller's own
    annotation = str(call.parameters[parameter].annotation)
    try:
        result = call(**{parameter: value})
    except (TypeError, ValueError) as error:
        # Of two arguments that do not fit either may be named.
        fit = "|".join(call.parameters) if "shape" in str(error) else parameter
        if re.search(rf"(?<![A-Za-z])({fit})(?![A-Za-z])", str(error)):
            return None
        return f"{type(error).__name__} does not name it: {str(error)[:150]}"
    except FileNotFoundError as error:
        return None if str(error).startswith(parameter) else f"{error!r:.200}"
    except Exception as error:
        return f"{error!r:.200}"
    refused = label == "as complex array" and call.name not in COMPLEX
    if plain is None and (refused or not accepts(annotation, value)):
        return f"accepted, as a {annotation}: {result!r:.80}"
    if value is call.parameters[parameter].default:
        return None
    whole = call.name not in INFINITE
    for path, array in leaves(result):
        finite = not is_number(array) or (np.isfinite(array) if whole else ~np.isnan(array)).all()
        if not finite and call.name not in PASSED and path not in right(call.name):
            return f"result{path} is not finite"
    if plain is not None and annotation != "Any":
        expected = call.expected(parameter, plain)
        for path, array in leaves(result):
            if is_number(array) and not np.allclose(array, expected[path], rtol=1e-5, atol=1e-7, equal_nan=True):
                return f"result{path} differs from that of the plain value"
    return None


CASES = [(name, parameter) for name in targets() for parameter in parameters(name)]


@pytest.fixture(autouse=True)
def _one_thread_in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with threadpool_limits(1):
        yield


@pytest.mark.parametrize("name", targets())
def test_a_valid_call_works(name):
    Call(name)()


@pytest.mark.parametrize(("name", "parameter"), CASES, ids=[f"{name}({parameter})" for name, parameter in CASES])
def test_a_bad_value_is_named(name, parameter):
    call = Call(name)
    values = [(label, value, PLAIN.get(label)) for label, value in (BAD | UNUSUAL).items()]
    values += variants(call.argument(parameter))
    wrong = {
        label: fault
        for label, value, plain in values
        if (fault := judge(call, parameter, label, value, plain)) is not None
    }
    assert not wrong, "\n".join(f"{name}({parameter}={label}): {fault}" for label, fault in wrong.items())


RANDOM = {name for name, parameter in CASES if parameter == "seed"} - {"MaximumLikelihood", "write_bench"}


@pytest.mark.parametrize("name", sorted(RANDOM))
def test_a_seed_alone_decides_what_is_drawn(name):
    def drawn(seed):
        return [array for _, array in leaves(Call(name)(seed=seed)) if is_number(array)]

    state, first, rng = np.random.get_state()[1].copy(), drawn(5), np.random.default_rng(5)
    for seed, same in (
        (5, True),
        (np.random.SeedSequence(5), True),
        (rng, True),
        (rng, False),
        (6, False),
        (None, False),
    ):
        assert all(map(np.array_equal, drawn(seed), first)) == same
    np.testing.assert_array_equal(np.random.get_state()[1], state)


PUPIL = zwfs.Pupil.circular(8)
SENSOR = zwfs.ZernikeSensor(PUPIL, zwfs.Dimple(1.06, 1.5), zwfs.Dimple(1.06, -1.5))
SAME = np.stack([zwfs.zernike_basis(PUPIL, 4)[3]] * 6)
RECORDING = {"frames": np.ones((2, 2, 8, 8)), "clear_frames": np.ones((2, 8, 8)), "phases": np.ones((2, 8, 8))}


def fitted(**changes):
    return Calibration.fit(**RECORDING | {"n_pixels": 8, "noise": 1.0} | changes)


def from_files(**changes):
    return Calibration.from_files(["a.fits"], ["b.fits"], **changes)


def reconstructed(**changes):
    np.save("a.npy", np.ones((1, *camera()[-1].shape)))
    reconstruct("a.npy", camera()[-1], "b.fits", **changes)


def called(**changes):
    return camera()[-1](np.zeros(camera()[-1].shape), **changes)


def with_one_image(**changes):
    return replace(camera()[-1], optics=pipeline.Optics(1.06, (1.5,)))(np.zeros(camera()[-1].shape), **changes)


REFUSED = {
    r"modes: 1 of 6 are linearly independent": lambda: zwfs.MaximumLikelihood(SENSOR, SAME),
    r"modes: 1 of 6 are linearly": lambda: zwfs.cramer_rao(SENSOR, 0 * PUPIL.amplitude, photons=1e4, modes=SAME),
    "measurement is a int: expected": lambda: pipeline.predict_other(5),
    "measurement is a str: expected": lambda: recover_phase("a"),
    "measurement is a NoneType: expected": lambda: pipeline.upside_down(None),
    "margin = 0.5: expected an integer": lambda: camera()[2].registered.places(0.5),
    r"margin = 1000000: expected an integer in \[0, ": lambda: camera()[2].registered.places(10**6),
    r"pupil_diameter = 65504: expected .* \[8, ": lambda: register_frames(*camera()[:2], pupil_diameter=65504),
    "progress = 5: expected a function": lambda: fitted(progress=5),
    "progress = 'a': expected a function": lambda: from_files(progress="a"),
    "progress = 2: expected a function": lambda: reconstructed(progress=2),
    "commands = 5: expected a str or a Path": lambda: from_files(commands=5),
    "exposure with commands: expected": lambda: from_files(commands="c.npy", exposure=2.0),
    "phase_shifts = 5: expected": lambda: from_files(phase_shifts=5),
    "phases is 0 in all states, or NaN": lambda: fitted(phases=np.zeros((2, 8, 8))),
    "phases is 0 in all states, or NaN, at": lambda: fitted(phases=np.full((2, 8, 8), np.nan)),
    r"values is a list: expected a Mapping": lambda: BenchFit.replaced(None, []),
    "smooth needs the `bench` of a calibration": lambda: called(smooth=True),
    "light with smooth or noise: expected none": lambda: called(smooth=True, light=1.0),
    "follow with smooth or noise: expected none": lambda: called(smooth=True, follow=True),
    "follow = True with judge = False: expected": lambda: called(follow=True, judge=False),
    "follow = True with one phase shift: expected two": lambda: with_one_image(follow=True),
}


def altered_ring(**attributes):
    """A sensor with a mask of a user, one attribute of which is wrong."""
    ring = {"diameter": 2.0, "breaks": (1.0,), "n_samples": 0, "transmission": lambda u, v: 1 + 0 * u}
    return zwfs.ZernikeSensor(PUPIL, SimpleNamespace(**ring | attributes))


def outlined(outline):
    return zwfs.ZernikeSensor(PUPIL, zwfs.Patch(1.0, lambda u, v: 1, breaks=[outline]))


def likely(sensor=SENSOR, **options):
    return zwfs.MaximumLikelihood(sensor, **options)


def bound(sensor=SENSOR, **options):
    return zwfs.cramer_rao(sensor, FLAT, **{"photons": 10} | options)


def calibrated(*frames):
    return zwfs.Linear(SENSOR, MODES, calibration=frames)


def looped(**changes):
    arguments = {"mirror": zwfs.Mirror(PUPIL, MODES), "disturbance": np.zeros((2, 8, 8))} | changes
    return zwfs.close_loop(SENSOR, reconstructor=zwfs.PhaseShifted(SENSOR), **arguments)


def learnt(shifts=(np.pi / 2, -np.pi / 2), diameter=1.06, pupil=None, **options):
    return zwfs.LearnedReference(pair(pupil or zwfs.Pupil.circular(12), diameter, shifts), **options)


def taught(shifts=(np.pi / 2, -np.pi / 2), **settings):
    return zwfs.LearnedReference.train(pair(PUPIL, shifts=shifts), **settings)


def designed(**question):
    return zwfs.design_sensor(**{"error_nm": 5, "input_nm": 20, "wavelength_m": 635e-9, "n_modes": 6} | question)


def looked(frames, dark=None):
    return pipeline.phase_of(frames, np.ones((2, 10, 10)), dark)


def registered(**settings):
    return register_frames(*camera()[:2], **settings)


def linear():
    sensor = camera()[-1].sensor
    return zwfs.Linear(sensor, zwfs.zernike_basis(sensor.pupil, 3))


def controlled(**settings):
    return camera()[-1].controller(*[np.zeros(camera()[-1].shape)] * 3, **settings)


FLAT, MODES = np.zeros((8, 8)), zwfs.zernike_basis(PUPIL, 4)
IMPOSSIBLE = {
    "leakage": 0.6, "flux_imbalance": 1, "photons_per_image": 0, "read_noise": -1, "background": -1, "seed": -1,
    "static": -0.1, "focus_difference": 1, "misregistration": -1, "dimple_error": -1, "illumination": 2,
    "n_rings": -1, "gap": 0.5, "stop": 0, "missing": (38,), "diameter": -1, "extent": 0.5,
}  # fmt: skip
UNTEACHABLE = {
    "n_screens": 10, "photons": (0, 1), "read_noise": -1, "seed": -1, "progress": 5, "n_iterations": 0,
    "errors": (0, 1), "screens": np.ones((2, 3, 3)), "amplitude": np.ones(3), "tolerance": -1,
}  # fmt: skip
ONES, WHOLE, WIDE = np.ones((4, 4)), np.ones((4, 4), int), zwfs.Pupil.from_amplitude(np.ones((9, 9)))
POINTS, FOUR = np.ones(zwfs.Pupil.circular(4).n_points), zwfs.Pupil.circular(4)
GLASS, CLEAR = zwfs.Patch(1, lambda u, v: np.exp(1j * u)), zwfs.ZernikeSensor(PUPIL, zwfs.Dimple(1, 0))
MOVED, MOST = SENSOR.measure(0.01 * MODES), PUPIL.scatter(np.arange(PUPIL.n_points) > 0, fill=False)
BAND = zwfs.PolychromaticSensor(SENSOR, [600.0, 700.0])
TWICE = zwfs.ZernikeSensor(PUPIL, *(zwfs.Dimple(1.06, phase) for phase in (1.5, 1.5, -1.5)))
REFUSED |= {
    # pupils
    "n_pixels = 1:": lambda: zwfs.Pupil.circular(1),
    "n_pixels = 1000000": lambda: zwfs.Pupil.circular(10**6),
    "n_pixels = 0.5": lambda: zwfs.Pupil.from_amplitude(ONES, 0.5),
    r"n_pixels = 1e\+300": lambda: zwfs.Pupil.from_amplitude(ONES, 1e300),
    "central_obscuration = 1": lambda: zwfs.Pupil.circular(10, 1.0),
    "central_obscuration, spiders: the pupil is empty": lambda: zwfs.Pupil.circular(6, 0.99),
    r"spiders\[0\] width = -1": lambda: zwfs.Pupil.circular(10, spiders=[(0, -1)]),
    r"spiders\[0\] angle = 90.0: .*degrees": lambda: zwfs.Pupil.circular(8, spiders=[(90, 0.1)]),
    "n_rings = -1": lambda: zwfs.Pupil.hexagonal(50, n_rings=-1),
    "n_rings = 26: .*n_pixels = 50": lambda: zwfs.Pupil.hexagonal(50, n_rings=26),
    "gap = 1": lambda: zwfs.Pupil.hexagonal(50, gap=1),
    r"missing = \[38\]": lambda: zwfs.Pupil.hexagonal(50, missing=[38]),
    "missing, gap, stop: the pupil is empty": lambda: zwfs.Pupil.hexagonal(50, n_rings=0, missing=[1]),
    "stop = 1.5": lambda: zwfs.Pupil.hexagonal(50, stop=1.5),
    "stop = 1e-310": lambda: zwfs.Pupil.hexagonal(50, stop=1e-310),
    "image reaches down to -0.5": lambda: zwfs.Pupil.from_amplitude([[1, -0.5]]),
    "image: the pupil is empty": lambda: zwfs.Pupil.from_amplitude(0 * ONES),
    "threshold = 1": lambda: zwfs.Pupil.from_amplitude(np.ones((2, 2)), threshold=1),
    r"center = \(1, .*1000 D": lambda: zwfs.Pupil.from_amplitude(ONES, center=(1, 1e6)),
    "segments: the pupil is empty": lambda: zwfs.Pupil.from_segments(0 * WHOLE),
    "segments reaches down to -1": lambda: zwfs.Pupil.from_segments(-WHOLE),
    "segments reaches": lambda: zwfs.Pupil.from_segments(np.full((4, 4), 2**63, np.uint64)),
    "segments is": lambda: zwfs.Pupil.from_segments(ONES),
    "amplitude reaches down to 0": lambda: zwfs.Pupil.from_segments(WHOLE, 0.0),
    "amplitude: the pupil is empty": lambda: zwfs.Pupil(0 * ONES, 4, WHOLE, (1, 1)),
    "segments has shape": lambda: zwfs.Pupil(ONES, 4, WHOLE[:3], (1, 1)),
    "segments differs .* at 16 points": lambda: zwfs.Pupil(ONES, 4, 0 * WHOLE, (1, 1)),
    "fill = nan": lambda: FOUR.scatter(POINTS.astype(int)),
    "fill = 256": lambda: FOUR.scatter(POINTS.astype(np.uint8), 256),
    r"fill = 1e\+300": lambda: FOUR.scatter(POINTS.astype(np.float32), 1e300),
    "phase reaches a modulus of 1e.200 inside": lambda: FOUR.rms(1e200 * ONES),
    # modes and screens
    "j = 0": lambda: zwfs.noll_to_nm(0),
    "n_modes = 0": lambda: zwfs.zernike_basis(PUPIL, 0),
    "n_modes = 12: expected fewer .* 12 points": lambda: zwfs.zernike_basis(FOUR, 12),
    r"reaches 0\.6.* D": lambda: zwfs.zernike_basis(WIDE, 3),
    "modes .*different rms": lambda: zwfs.power_law_screens(MODES * np.arange(1, 5)[:, None, None], 1, 1),
    "rms = -1": lambda: zwfs.power_law_screens(MODES, -1, 1),
    "n_screens = 0": lambda: zwfs.power_law_screens(MODES, 1, 0),
    "modes .*NaN": lambda: zwfs.power_law_screens(np.full_like(MODES, np.nan), 1, 1),
    "modes": lambda: zwfs.power_law_screens(np.full_like(MODES, 1e300), 1, 1),
    "modes.*": lambda: zwfs.power_law_screens(0 * MODES, 1, 1),
    "r0 = 0": lambda: turbulent_screens(PUPIL, 0, 1),
    "outer_scale = 0.1": lambda: turbulent_screens(PUPIL, 0.1, 1, 0.1),
    # masks
    "diameter = 0": lambda: zwfs.Dimple(0, 1),
    "amplitude = 1.01": lambda: zwfs.Dimple(1, 1, 1.01),
    "amplitude = -0.1": lambda: zwfs.Dimple(1, 1, -0.1),
    "phase = 90: expected radian.*degrees": lambda: zwfs.Dimple(1.06, 90),
    "phase = -7.0: expected radian": lambda: zwfs.Dimple(1.06, -7.0),
    r"breaks\[0\] = 1: ": lambda: zwfs.Patch(1, lambda u, v: 1, breaks=[1]),
    "n_samples = -2": lambda: zwfs.Patch(1, lambda u, v: 1, n_samples=-2),
    r"n_samples = 2048: expected an integer in \[0, 1024\]": lambda: zwfs.Patch(1, lambda u, v: 1, n_samples=2048),
    "transmission reaches a modulus of 1.1": lambda: zwfs.Patch(1, lambda u, v: 1.1).transmission([0], [0]),
    "transmission holds 2 NaN": lambda: zwfs.Patch(1, lambda u, v: np.nan * u).transmission([0, 0], [0, 0]),
    "transmission has dtype": lambda: zwfs.Patch(1, lambda u, v: "glass").transmission([0], [0]),
    "transmission has shape": lambda: zwfs.Patch(1, lambda u, v: np.ones(3)).transmission([0, 0], [0, 0]),
    r"u and v have shapes \(2,\) and \(3,\)": lambda: zwfs.Dimple(1, 1).transmission([0, 1], [0, 1, 2]),
    "u reaches 4.1 lambda/D": lambda: focal_field(PUPIL, FLAT + 1, [4.1], [0.0]),
    # sensors
    "masks is empty": lambda: zwfs.ZernikeSensor(PUPIL),
    "extent = 0.9": lambda: zwfs.ZernikeSensor(PUPIL, GLASS, extent=0.9),
    "tolerance = 0": lambda: zwfs.ZernikeSensor(PUPIL, GLASS, tolerance=0),
    "tolerance = 1": lambda: zwfs.ZernikeSensor(PUPIL, GLASS, tolerance=1.0),
    "reaches a modulus of 2": lambda: zwfs.ZernikeSensor(PUPIL, zwfs.Patch(1, lambda u, v: 2.0)),
    "amplitude reaches down to -1": lambda: SENSOR.measure(FLAT, FLAT - 1),
    "amplitude is 0 everywhere": lambda: SENSOR.measure(FLAT, FLAT),
    "amplitude reaches a modulus of 1e": lambda: SENSOR.measure(FLAT.astype(np.float32), FLAT + 1e30),
    "phase and amplitude have shapes": lambda: SENSOR.measure(np.zeros((2, 8, 8)), np.ones((3, 8, 8))),
    "phase reaches a modulus": lambda: SENSOR.measure(FLAT + 1e200),
    "phase has shape": lambda: SENSOR.measure(np.empty((0, 8, 8))),
    "field has shape": lambda: SENSOR.propagate(np.empty((0, 8, 8))),
    "change has shape": lambda: SENSOR.jacobian(np.zeros((2, 8, 8)), FLAT),
    r"masks\[1\] is 8\.1 lambda/D wide: .* 8, the": lambda: zwfs.ZernikeSensor(PUPIL, GLASS, zwfs.Dimple(8.1, 1)),
    r"masks\[0\]\.breaks": lambda: altered_ring(breaks=1.0),
    r"masks\[0\]\.breaks\[0\] = 3": lambda: altered_ring(breaks=(3.0,)),
    r"masks\[0\]\.diameter": lambda: altered_ring(diameter=np.nan),
    r"masks\[0\]\.n_samples": lambda: altered_ring(n_samples=1.5),
    r"transmission of masks\[0\] holds": lambda: altered_ring(transmission=lambda u, v: np.nan * u),
    r"transmission of masks\[0\] has shape": lambda: altered_ring(transmission=lambda u, v: 1),
    r"breaks\[0\]\(angle\) has shape \(3,\)": lambda: outlined(lambda angle: np.full(3, 0.5)),
    r"breaks\[0\]\(angle\) holds .* NaN": lambda: outlined(lambda angle: np.nan * angle),
    r"breaks\[0\]\(angle\) has dtype": lambda: outlined(lambda angle: "wide"),
    r"breaks\[0\]\(angle\) reaches from 0\.7.* to 1\.1: ": lambda: outlined(lambda a: 0.9 + 0.2 * np.cos(a)),
    "wavelengths = ": lambda: zwfs.PolychromaticSensor(SENSOR, [600.0, -1.0]),
    "within a factor of 4": lambda: zwfs.PolychromaticSensor(SENSOR, [100.0, 600.0]),
    "wavelengths has 65 values": lambda: zwfs.PolychromaticSensor(SENSOR, np.ones(65)),
    "weights has shape": lambda: zwfs.PolychromaticSensor(SENSOR, [600.0], [1.0, 2.0]),
    "weights reaches down to -2": lambda: zwfs.PolychromaticSensor(SENSOR, [600.0, 700.0], [1.0, -2.0]),
    "weights is 0": lambda: zwfs.PolychromaticSensor(SENSOR, [600.0, 700.0], [0.0, 0.0]),
    "chromatic = True: expected Dimples": lambda: zwfs.PolychromaticSensor(
        zwfs.ZernikeSensor(PUPIL, GLASS), [0.9, 1.1], chromatic=True
    ),
    "expected a ZernikeSensor for PhaseShifted": lambda: zwfs.PhaseShifted(BAND),
    "recorded is False at 1 points of the pupil": lambda: zwfs.ZernikeSensor(PUPIL, GLASS, recorded=MOST),
    "unmeasured = 'zero': expected 'model'": lambda: zwfs.GerchbergSaxton(
        zwfs.ZernikeSensor(PUPIL, GLASS, recorded=PUPIL.inside)
    ),
    # a detector, metrics and units
    "photons = 0": lambda: zwfs.Detector(0),
    "read_noise = -1": lambda: zwfs.Detector(1, read_noise=-1),
    "frames reaches down to -1": lambda: zwfs.Detector(1).expose([1, -1]),
    "frames reach .* electrons": lambda: zwfs.Detector(1e25).expose([1.0]),
    "rms = .*expected increasing": lambda: zwfs.dynamic_range([2, 1], [0, 0]),
    "rms = .*above 0": lambda: zwfs.dynamic_range([0.0], [0]),
    "rms reaches down to -1": lambda: zwfs.dynamic_range([-1, 1], [0, 0]),
    "error reaches down to -2": lambda: zwfs.dynamic_range([1, 2], [-1, -2]),
    "threshold = 0": lambda: zwfs.dynamic_range([1, 2], [0, 0], 0),
    "wavelength = 0": lambda: zwfs.phase_to_opd(FLAT, 0),
    "wavelength = -635": lambda: zwfs.opd_to_phase(FLAT, -635.0),
    # likelihood
    "photons = 0: expected": lambda: likely(photons=0),
    "read_noise = 1: expected 0": lambda: likely(read_noise=1),
    "2 different masks: expected at least 3": lambda: likely(amplitude="unknown"),
    "2 different masks: expected at least": lambda: likely(TWICE, amplitude="unknown"),
    "amplitude = 'measured'": lambda: likely(amplitude="measured"),
    "amplitude = 'unknown': expected a known one": lambda: likely(amplitude="unknown", modes=MODES),
    "prior: expected None without modes": lambda: likely(prior=np.eye(4), photons=10),
    "prior: expected a number of photons": lambda: likely(prior=np.eye(4), modes=MODES),
    "from -0.5 to 1: .*definite": lambda: likely(prior=np.diag([1.0, 1, 1, -0.5]), modes=MODES, photons=10),
    "from 0 to 1: .*definite": lambda: likely(prior=np.diag([1.0, 1, 1, 0]), modes=MODES, photons=10),
    "not symmetric": lambda: likely(prior=np.eye(4) + np.eye(4, k=1), modes=MODES, photons=10),
    "modes: .* at most the": lambda: likely(modes=np.ones((PUPIL.n_points + 1, 8, 8))),
    "n_starts = 0": lambda: likely(n_starts=0),
    "none of its masks changes the light": lambda: likely(CLEAR),
    "sensor: none of its masks changes": lambda: bound(CLEAR),
    "photons = 0: expected a finite": lambda: bound(photons=0),
    "read_noise = -1: expected": lambda: bound(read_noise=-1),
    "2 different masks": lambda: bound(amplitude_known=False),
    "amplitude_known = False: expected True": lambda: bound(amplitude_known=False, modes=MODES),
    "modes: .* at most": lambda: bound(modes=np.ones((PUPIL.n_points + 1, 8, 8))),
    "the sensor has 2 wavelengths: expected a known amplitude": lambda: likely(BAND, amplitude="unknown"),
    "the sensor has 2 wavelengths": lambda: bound(BAND, amplitude_known=False),
    # a recorded calibration
    "calibration flat has a batch": lambda: calibrated(MOVED, MOVED, MOVED),
    "calibration pushed has a batch": lambda: calibrated(MOVED[0], MOVED[:-1], MOVED),
    "calibration pulled has shape": lambda: calibrated(MOVED[0], MOVED, MOVED[:, :1]),
    "calibration pulled: 8 of 8 hold no light": lambda: calibrated(MOVED[0], MOVED, -MOVED),
    "sensor sees none of them": lambda: calibrated(MOVED[0], MOVED, MOVED),
    "calibration has 2 parts: expected .flat, pushed, pulled": lambda: calibrated(MOVED[0], MOVED),
    # loops
    "mirror is a int": lambda: looped(mirror=1),
    "mirror has Pupil": lambda: looped(mirror=zwfs.Mirror(FOUR, zwfs.zernike_basis(FOUR, 3))),
    "gain = 2": lambda: looped(gain=2.0),
    "leak = 1": lambda: looped(leak=1.0),
    "delay = 0": lambda: looped(delay=0),
    "stroke = 0": lambda: looped(stroke=0.0),
    "disturbance is empty": lambda: looped(disturbance=[]),
    "disturbance.1. has shape": lambda: looped(disturbance=[FLAT, np.zeros((2, 8, 8))]),
    # a learned reference wave
    "of 1.06 lambda/D and 1.571 rad: expected .* the training": lambda: learnt((np.pi / 2,)),
    "1.06 lambda/D and 2 rad, .* the training": lambda: learnt((2.0, -1.0)),
    "and -1.5 rad: expected .* the training": lambda: learnt((1.0, 2.5, -1.5)),
    "dimples of 1.4 lambda/D .*: expected 1.06": lambda: learnt(diameter=1.4),
    "wave of a flat wavefront differs": lambda: learnt(pupil=zwfs.Pupil.circular(12, 0.5)),
    r"bench.phase_shift has shape \(3,\)": lambda: learnt(bench=BenchValues(0, 1, 0, np.zeros(3), 0, 0)),
    r"frames has shape \(12, 12\): expected \(2, 12, 12\)": lambda: learnt().look()(np.ones((12, 12))),
    "frames has dtype complex128": lambda: learnt().look()(np.ones((2, 12, 12), complex)),
    "out is .*: expected an array of float32": lambda: learnt().look()(np.ones((2, 12, 12)), np.empty((12, 12))),
    "bench = None: expected known errors of the bench": lambda: learnt(training="bench").look(),
    r"masks\[1\] = Dimple.*: expected dimples of one diameter": lambda: zwfs.LearnedReference(
        zwfs.ZernikeSensor(PUPIL, zwfs.Dimple(1.06, 1.5), zwfs.Dimple(1.2, -1.5))
    ),
    r"leakage = \(0.1, 0.0\): expected a smallest and a largest": lambda: BenchErrors(leakage=(0.1, 0.0)),
    "errors.flux_ratio = .* for one mask": lambda: taught((1.5,), errors=BenchErrors(flux_ratio=(0.9, 1.1))),
    "errors.leakage = .* for 3": lambda: taught((1.0, 2.0, -1.0), errors=BenchErrors(leakage=(0.0, 0.1))),
    r"screens\[1\] is constant": lambda: taught(screens=[MODES[0], FLAT]),
    r"rms = \(1.0, 1.0\): expected": lambda: taught(rms=(1, 1)),
    **{f"^{name}": lambda name=name: taught(**{name: UNTEACHABLE[name]}) for name in UNTEACHABLE},
    # a designed sensor
    r"wavelength_m = 635.0: expected a finite number in \[1e-10, 0.01\]": lambda: designed(wavelength_m=635.0),
    r"error_nm = 100: expected .* 63.5\]": lambda: designed(error_nm=100),
    r"input_nm = 700: expected .* 635\]": lambda: designed(input_nm=700),
    r"diameters = \(2.0, 1.0\): expected the smaller one first": lambda: designed(diameters=(2.0, 1.0)),
    "zero_point = 1.*: expected frame_rate_hz and diameter_m, too": lambda: designed(zero_point=1e10),
    # camera frames
    r"frames has shape \(3, 10, 10\): .* or \(2, ny, nx\)": lambda: looked(np.ones((3, 10, 10))),
    r"dark has shape \(3, 3\): expected \(2, 10, 10\)": lambda: looked(np.ones((2, 10, 10)), np.ones((3, 3))),
    r"expected \(row, column\) of each of two pupils": lambda: registered(pupil_centers=[[45, 45]]),
    "pupil_centers without a pupil_diameter": lambda: registered(pupil_centers=[[45, 45], [45, 137]]),
    "cut off at the top": lambda: registered(pupil_centers=[[10, 25], [25, 79]], pupil_diameter=40),
    "pupil_diameter = 7.9: expected": lambda: registered(pupil_diameter=7.9),
    "pupil_diameter = 400: expected": lambda: registered(pupil_diameter=400),
    "exposure = 0: expected": lambda: registered(exposure=0),
    "^diameter = 0: expected": lambda: pipeline.Optics(0),
    r"phase_shifts = \(1.5, 7.78": lambda: pipeline.Optics(phase_shifts=(1.5, 1.5 + 2 * np.pi)),
    r"phase_shifts = \(0.0, 1.0\)": lambda: pipeline.Optics(phase_shifts=(0.0, 1.0)),
    "leakage = 0.5: expected": lambda: pipeline.Optics(leakage=0.5),
    "masks holds a str: expected masks": lambda: pipeline.Optics(masks=("ring",)),
    r"fitted = \['colour'\]: expected": lambda: steps(*camera()[:2], pipeline.Optics(), ["colour"]),
    "fitted = .* each name once": lambda: steps(*camera()[:2], pipeline.Optics(), ["scale", "scale"]),
    "fitted = 'scale': expected a list": lambda: steps(*camera()[:2], pipeline.Optics(), "scale"),
    # frames of known commands
    "phases holds 1 state": lambda: fitted(phases=np.zeros((1, 8, 8)), frames=np.ones((1, 2, 8, 8))),
    "one for each state": lambda: fitted(phases=np.zeros((3, 8, 8))),
    "even differences": lambda: fitted(phases=np.ones((2, 7, 7))),
    "clear_frames has shape": lambda: fitted(clear_frames=np.ones((2, 6, 6))),
    "clear_frames hold .* expected light": lambda: fitted(clear_frames=np.zeros((2, 8, 8))),
    "noise = 0": lambda: fitted(noise=0.0),
    r"noise = 1e\+200": lambda: fitted(noise=1e200),
    r"gain = 1e\+200": lambda: fitted(gain=1e200),
    "diameter = 1000000000": lambda: fitted(diameter=1e9),
    "frames has 3 images": lambda: fitted(frames=np.ones((2, 3, 8, 8))),
    # a call of a calibration
    r"counts has shape \(3, 10, 10\): expected \(\.\.\., 52, 104\)": lambda: camera()[-1](np.zeros((3, 10, 10))),
    "method has another sensor": lambda: called(method=zwfs.PhaseShifted(SENSOR)),
    "method is a str: expected a Reconstructor": lambda: called(method="linear"),
    "start with method = Linear": lambda: called(start=np.zeros(camera()[-1].good.shape), method=linear()),
    "poke = 0: expected": lambda: controlled(poke=0),
    "gain = 3: expected": lambda: controlled(gain=3),
    "rcond = 1: expected": lambda: controlled(rcond=1),
    r"method = 'fast': expected one of \['linear'": lambda: controlled(method="fast"),
    "n_iterations = 0: expected at least 1": lambda: controlled(n_iterations=0),
    # the simulated bench
    **{f"^{name} = .*: .*expected": lambda name=name: Bench(**{name: IMPOSSIBLE[name]}) for name in IMPOSSIBLE},
    "phase is NaN all over a segment": lambda: segment_pistons(np.full((4, 4), np.nan), WHOLE, np.array([1])),
    "pistons and commanded have shapes": lambda: segment_residual([0.0, 1], [0.0, 1, 2]),
    "rms = -1: expected a finite": lambda: segment_screens(BENCH, -1, 2),
    "n_screens = 0: expected": lambda: segment_screens(BENCH, 1, 0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_bad_argument_is_refused_by_its_name_before_any_work(message):
    with pytest.raises((TypeError, ValueError), match=message):
        REFUSED[message]()


def test_modes_that_a_prior_tells_apart_need_not_be_independent():
    zwfs.MaximumLikelihood(SENSOR, SAME, photons=1e4, prior=np.eye(6))


def test_file_that_claims_a_larger_calibration_than_it_holds_is_refused_unread(tmp_path):
    camera()[-1].save(tmp_path / "whole.npz")
    with zipfile.ZipFile(tmp_path / "whole.npz") as whole, zipfile.ZipFile(tmp_path / "big.npz", "w") as big:
        for name in whole.namelist():
            if name != "dark.npy":
                big.writestr(name, whole.read(name))
        with big.open("dark.npy", "w") as dark:
            np.lib.format.write_array_header_1_0(
                dark, {"descr": "<f4", "fortran_order": False, "shape": (1, 2**15, 2**15)}
            )
    with pytest.raises(ValueError, match=r"big\.npz: its array dark\.npy has shape \(1, 32768, 32768\) and type"):
        Calibration.load(tmp_path / "big.npz")
