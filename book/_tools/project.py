"""Places of the files of a project."""

import sys
from dataclasses import dataclass
from pathlib import Path

# Environment variables for the extensions of the book: the folder of the executed notebooks from the root, and the
# name of the PDF.
EXECUTED, PDF = "ZWFS_EXECUTED", "ZWFS_PDF"


class ToolError(Exception):
    """Reason why a command stopped, in words for the terminal."""

    status = 1


def one_line(text: str) -> str:
    """Return a text for the terminal: on one line, without control characters, cut in the middle if it is long."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return line if len(line) <= 400 else f"{line[:250]} ... {line[-140:]}"


def repair(file: str) -> str:
    """Return the advice for a file that cannot be imported: empty unless it belongs to the environment."""
    ours = file.startswith(f"{sys.prefix}/")
    return "the environment is damaged: run make clean, then repeat the command" if ours else ""


@dataclass(frozen=True)
class Project:
    """Places of the files of a project.

    Parameters
    ----------
    root : Path
        The folder with notebooks/, zwfs/, book/ and the lock. Results go to its _build/.
    """

    root: Path

    @property
    def notebooks(self) -> Path:
        """Folder of the committed notebooks."""
        return self.root / "notebooks"

    @property
    def build(self) -> Path:
        """Folder of all results."""
        return self.root / "_build"

    @property
    def executed(self) -> Path:
        """Folder of the executed notebooks, each with its published files and its record."""
        return self.build / "notebooks"

    @property
    def kept(self) -> Path:
        """Folder of the last results of each notebook, by key: NAME/KEY/ has the content of `executed`."""
        return self.build / "kept"

    def source(self, name: str) -> Path:
        """Return the file of a committed notebook."""
        return self.notebooks / f"{name}.ipynb"

    def sources(self) -> list[Path]:
        """Return the files of the committed notebooks, in order."""
        return sorted(self.notebooks.glob("*.ipynb"))

    def published(self, name: str, folder: Path | None = None) -> list[Path]:
        """Return the figures and tables of a result in a folder, by default that of the last run, in order."""
        return sorted(((folder or self.executed) / f"{name}.files").glob("[!.]*"))

    @property
    def lock(self) -> Path:
        """Pinned versions of all packages."""
        return self.root / "environment" / "requirements.lock"

    def modules(self) -> list[Path]:
        """Return the files of the package."""
        return sorted((self.root / "zwfs").rglob("*.py"))
