"""Benchmarks, which also run as modules: pytest finds the studies by its own settings, plain Python does not."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "notebooks"))
