"""Environment of every process that runs a notebook: what changes numbers or pictures is set or removed."""

import os
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

# One thread for each kernel: the numbers do not depend on how many notebooks run at the same time.
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
# Another backend shows no pictures, and all variables of Python may change what runs.
REMOVED = ("MPLBACKEND", "PYTHON")


def clean(variables: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the variables that change results, and with those that fix them."""
    matplotlib = find_spec("matplotlib")
    fixed = dict.fromkeys(LIBRARIES, "1") | {"LC_ALL": "C.UTF-8", "PYTHONHASHSEED": "0", "PYTHONUTF8": "1"}
    fixed["IPYTHONDIR"] = str(Path(sys.prefix, ".ipython"))  # not that of the user, with files that run at a start
    if matplotlib and matplotlib.origin:  # its own settings, not those of the user
        fixed["MATPLOTLIBRC"] = str(Path(matplotlib.origin).with_name("mpl-data") / "matplotlibrc")
    return {name: value for name, value in variables.items() if not name.startswith(REMOVED)} | fixed


def enter_clean() -> None:
    """Continue in a new process if variables of Python, such as PYTHONPATH, could change this one."""
    wanted = clean(os.environ)
    if {name for name in os.environ if name.startswith("PYTHON")} - wanted.keys():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], wanted)
