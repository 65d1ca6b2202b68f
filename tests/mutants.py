"""Defects that the tests must notice: `make mutants`, or `python -m tests.mutants loop` for one file.

Each mutant replaces one text of the package, in a copy of the repository, and runs the tests that guard it. A
mutant survives if these tests pass: the package then returns other numbers, and nobody notices.

The list is our own. cosmic-ray and mutmut make thousands of mutants and run the suite, which takes minutes, for
each of them. Most of their mutants change no result. A mutant here is a plausible mistake that changes a result.

Left out, because it changes no result: `Pupil.circular` without the points on its edge. There are none, since the
centre of a pixel lies there only if a^2 + b^2 = n^2 with n even and a, b odd, or with n odd and a, b even.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = shutil.ignore_patterns(".*", "_build", "build", "__pycache__", "*.egg-info")


class Mutant(NamedTuple):
    """Defect of `zwfs/PATH.py`, and the tests that must notice it: `FILE`, or `FILE -k WORD`, of `tests`."""

    path: str
    old: str
    new: str
    tests: str


MUTANTS = [
    # Known to have survived once.
    Mutant("_lowrank", "mask.breaks, mask.diameter]) / 2", "mask.breaks, mask.diameter])[:2] / 2",
           "sensor -k rings"),
    Mutant("_lowrank", "max(1e-3 * tolerance, 1e-18)", "max(tolerance, 1e-18)", "sensor -k quadrature"),
    Mutant("reconstructors/phase_shifted", "_PARALLEL = 1e-6", "_PARALLEL = 1e-5", "reconstructors -k parallel"),
    Mutant("reconstructors/phase_shifted", "_PARALLEL = 1e-6", "_PARALLEL = 1e-7", "reconstructors -k parallel"),
    # c is real only next to a phase shift of pi. Between +pi/2 and -pi/2 the signal would turn by 90 degrees.
    Mutant("reconstructors/phase_shifted", "w = -c.conj() * p", "w = -c * p",
           "reconstructors -k fixed_point_of_the_phase"),
    Mutant("reconstructors/arcsine", "cross >= -_IN_LINE", "cross > _IN_LINE", "reconstructors -k in_line"),
    Mutant("bench/model", 'self.blur, mode="nearest"', 'self.blur, mode="wrap"', "bench -k blur"),
    Mutant("frames/pipeline", "(flux.mean() / flux)[:", "(flux / flux.mean())[:", "frames -k balance"),
    Mutant("frames/pipeline", "dark * recording.exposure, dark", "dark, dark", "frames -k exposure"),
    Mutant("frames/registration", "rows - rows.mean(axis=1,", "rows - rows.mean(axis=0,", "frames -k correlation"),
    Mutant("paper/closed_loop", "(exponent / 2), 0)", "exponent, 0)", "closed_loop -k exponent"),
    Mutant("paper/linearity", "np.abs(phase) > np.pi", "phase > np.pi", "experiments -k wraps"),
    Mutant("loop", "((1 - leak) * commands + step) / excess", "(1 - leak) * commands + step", "loop -k stroke"),
    Mutant("loop", "> 0).all(axis=-1)", "> 0).any(axis=-1)", "loop -k one_of_two"),
    Mutant("loop", "speed / math.sqrt(sigma.size)", "speed", "loop -k speed"),
    Mutant("_likelihood", "unknown_amplitude and len(different) < 3", "unknown_amplitude and len(cores) < 3",
           "maximum_likelihood -k refuses"),
    Mutant("_likelihood", "(2 * expected + scale) * expected", "2 * expected * expected",
           "maximum_likelihood -k faint_photon"),
    Mutant("_likelihood", "xp.clip(expected, 1, None)", "xp.clip(expected, 0, None)",
           "maximum_likelihood -k one_photon"),
    Mutant("_likelihood", "xp.where(seen > 0, seen, 1.0)", "seen", "maximum_likelihood -k negative"),
    Mutant("loop", "= camera.normalise(counts)", "= np.maximum(camera.normalise(counts), 0)",
           "loop -k read_noise"),
    Mutant("reconstructors/maximum_likelihood", "_SIGMAS = 5.0", "_SIGMAS = 4.0", "maximum_likelihood -k misfit"),
    Mutant("reconstructors/maximum_likelihood", "_SIGMAS = 5.0", "_SIGMAS = 6.0", "maximum_likelihood -k misfit"),
    Mutant("reconstructors/maximum_likelihood", "shaped(fit.converged & self._explained(fit))",
           "shaped(self._explained(fit))", "maximum_likelihood -k has_not_converged"),
    Mutant("reconstructors/maximum_likelihood", "values[0] > 1e-14 * values[-1]", "values[-1] > 0",
           "maximum_likelihood -k refuses"),
    Mutant("turbulence", "(n_modes, *[2] * n_modes)", "(n_modes,)", "turbulence -k eigenvectors"),
    # The sensor.
    Mutant("_lowrank", "self._xp.conj(self._core).T", "self._core.T", "sensor -k adjoint"),
    Mutant("sensor", "axis.size + 2 * m) - m)", "axis.size + 2 * m) - m + 1)", "sensor -k airy"),
    Mutant("pupil", "radius >= obscuration / 2", "radius > obscuration / 2", "pupil"),
    Mutant("pupil", "(along >= -1e-12) &", "", "pupil"),
    Mutant("polychromatic", "mask.diameter * ratio,", "mask.diameter / ratio,", "polychromatic -k exact_kernel"),
    Mutant("polychromatic", "tuple(one * self.ratio for one", "tuple(one for one", "polychromatic -k patch"),
    Mutant("focal", "-2j * np.pi * np.outer(v", "2j * np.pi * np.outer(v", "focal"),
    Mutant("units", "(2 * np.pi / wavelength)", "(np.pi / wavelength)", "units"),
    # Input and metrics.
    Mutant("modes", "scales ** (exponent / 2)", "scales**exponent", "modes -k power_law"),
    Mutant("modes", "2 * (k - 1) * (k + m - 1) * c", "2 * (k - 1) * (k + m) * c", "modes -k polynomials"),
    Mutant("turbulence", " + rng.standard_normal((2, 2)) @ places", "", "turbulence"),
    Mutant("detector", "self.full_well - self.gain / 2", "self.full_well", "detector"),
    Mutant("metrics", "pupil.gather(pupil.amplitude)", "pupil.gather(pupil.amplitude**2)", "metrics"),
    Mutant("metrics", "last = above[0]", "last = above[-1]", "metrics"),
    # Reconstruction and its errors.
    Mutant("reconstructors/gerchberg_saxton", "self.sensor.n_masks * psi", "psi", "reconstructors -k kept"),
    Mutant("reconstructors/linear", ".T / (2 * poke)", ".T / poke", "reconstructors -k interaction_matrix"),
    Mutant("_information", "capacitance[:, rank:, rank:] -= self.gram", "", "bounds"),
    Mutant("_information", "- 1 / (info.scale * constants.n_points)", "", "bounds"),
    Mutant("loop", "(1 - leak) * figure + step", "figure + step", "loop -k leak"),
    Mutant("loop", "step**2 / (gains * (2 - gains))", "step**2 / gains", "loop -k held"),
    # The bench and its frames.
    Mutant("bench/relay", "2 * shift * u", "shift * u", "bench -k misregistration"),
    Mutant("bench/model", "focus - oval", "focus + oval", "bench -k grating"),
    Mutant("frames/registration", "return counts * self.areas[which, np.newaxis, np.newaxis]", "return counts",
           "foreign_frames -k light"),
    Mutant("frames/pipeline", "/ (1 - 2 * optics.leakage)", "/ (1 - optics.leakage)", "frames -k leakage"),
    Mutant("frames/calibration", "measurement.counts * recording.exposure", "measurement.counts",
           "telemetry -k exposure_time"),
]  # fmt: skip


def main(words: list[str]) -> int:
    """Try the mutants of files whose path contains a word, or all; return 1 if one survives."""
    mutants = [one for one in MUTANTS if not words or any(word in one.path for word in words)]
    texts = [mutated(one) for one in mutants]  # refuses a list that does not follow the code, before any work
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "zwfs")
        shutil.copytree(ROOT, copy, ignore=NOT_COPIED)
        for tests in dict.fromkeys(one.tests for one in mutants):
            if not passes(copy, tests):
                raise SystemExit(f"mutants: the tests {tests!r} fail without a mutant")
        for mutant, text in zip(mutants, texts, strict=True):
            file = copy / "zwfs" / f"{mutant.path}.py"
            sound = file.read_text()
            file.write_text(text)
            survived = passes(copy, mutant.tests)
            file.write_text(sound)
            survivors += survived
            change = f"{mutant.old} -> {mutant.new or 'nothing'}"
            print(f"{'SURVIVED' if survived else 'noticed '}  {mutant.path}: {change}", flush=True)
    print(f"{survivors} of {len(mutants)} mutants survived")
    return int(survivors > 0)


def mutated(mutant: Mutant) -> str:
    """Return the text of the file with the defect."""
    text = (ROOT / "zwfs" / f"{mutant.path}.py").read_text()
    if (n := text.count(mutant.old)) != 1:
        raise SystemExit(f"mutants: {mutant.old!r} occurs {n} times in zwfs/{mutant.path}.py: expected once")
    text = text.replace(mutant.old, mutant.new)
    compile(text, mutant.path, "exec")  # no test would have to notice it
    return text


def passes(copy: Path, tests: str) -> bool:
    """Run tests in the copy, without bytecode: it could be that of another mutant, of the same size and second."""
    name, *options = tests.split()
    pytest = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command = [*pytest, f"tests/test_{name}.py", *options]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"mutants: the tests {tests!r} did not run:\n{done.stdout}{done.stderr}")
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
