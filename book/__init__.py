"""The tools that build the book, and its Sphinx extensions; they read the studies of the notebooks."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "notebooks"))
