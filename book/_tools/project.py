"""Places of the files of a project."""

from dataclasses import dataclass
from pathlib import Path

from .imports import dependencies

# Environment variables for the extensions of the book: the folder of the executed notebooks from the root, and a
# folder with Pyodide to copy into the book.
EXECUTED, PYODIDE = "ZWFS_EXECUTED", "ZWFS_PYODIDE"


class ToolError(Exception):
    """Reason why a command stopped, in words for the terminal."""

    status = 1


def one_line(text: str) -> str:
    """Return a text for the terminal: on one line, without control characters, cut in the middle if it is long."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return line if len(line) <= 400 else f"{line[:250]} ... {line[-140:]}"


@dataclass(frozen=True)
class Project:
    """Places of the files of a project."""

    root: Path

    @property
    def notebooks(self) -> Path:
        """Folder of the committed notebooks."""
        return self.root / "notebooks"

    @property
    def studies(self) -> Path:
        """Folder of the code of the notebooks."""
        return self.notebooks / "studies"

    @property
    def build(self) -> Path:
        """Folder of all results."""
        return self.root / "_build"

    @property
    def executed(self) -> Path:
        """Folder of the executed notebooks, each with its published files and its record."""
        return self.build / "notebooks"

    def source(self, name: str) -> Path:
        """Return the file of a committed notebook."""
        return self.notebooks / f"{name}.ipynb"

    def sources(self) -> list[Path]:
        """Return the files of the committed notebooks, in order."""
        return sorted(self.notebooks.glob("*.ipynb"))

    def published(self, name: str) -> list[Path]:
        """Return the figures and tables of the last run of a notebook, in order."""
        return sorted((self.executed / f"{name}.files").glob("[!.]*"))

    @property
    def lock(self) -> Path:
        """Pinned versions of all packages."""
        return self.root / "environment" / "requirements.lock"

    def modules(self) -> list[Path]:
        """Return the files of the package and of the studies, with the data of a study."""
        files = (file for folder in ("zwfs", "notebooks") for file in (self.root / folder).rglob("*.py"))
        data = (file for kind in ("npz", "svg") for file in self.studies.glob(f"*.{kind}"))
        return sorted([*files, *data])

    def depends_on(self, name: str) -> set[Path]:
        """Return what a notebook depends on: the modules that it imports, directly or not, and their data."""
        modules = {}
        for file in (file for file in self.modules() if file.suffix == ".py"):
            folder = self.notebooks if file.is_relative_to(self.notebooks) else self.root
            modules[".".join(file.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")] = file
        return dependencies(self.source(name), modules)
