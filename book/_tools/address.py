"""Public address and DOI of the project: one setting in pyproject.toml, and all files that name it."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from nbformat import NotebookNode
from nbformat.v4 import new_code_cell

from .notebook import normalise, read, to_bytes
from .project import Project, ToolError

# What each key of [tool.zwfs] may be, unless it is empty, and how to say so.
EXPECTED = {
    "repository": (r"https://github\.com/[\w-]+/[\w.-]+(?<!\.git)", "https://github.com/OWNER/NAME"),
    "book": (r"https://[\w.-]+(/[\w.-]+)*/", "https://SITE/ with a slash at its end"),
    "doi": (r"10\.\d{4,}/[\w.;()/-]+", "10.NUMBER/NAME"),
}
BRANCH = "main"
BUTTONS = "use_repository_button", "use_issues_button", "use_edit_page_button"
COLAB = "google.colab"  # only the cell for Colab names it


@dataclass(frozen=True)
class Address:
    """Where the project is published; each part is empty if there is none."""

    repository: str = ""  # such as https://github.com/OWNER/NAME
    book: str = ""  # ends with a slash
    doi: str = ""  # of the software, without https://doi.org/

    @property
    def name(self) -> str:
        """Owner and name of the repository."""
        return self.repository.removeprefix("https://github.com/")

    @property
    def folder(self) -> str:
        """Folder of a clone."""
        return self.name.rpartition("/")[2]

    def theme(self) -> dict[str, object]:
        """Return the options of the theme of the book: the buttons at the top of the pages."""
        sites = {"binderhub_url": "https://mybinder.org", "colab_url": "https://colab.research.google.com"}
        options = {
            "repository_url": self.repository,
            "repository_branch": BRANCH,
            "launch_buttons": {"notebook_interface": "jupyterlab", **sites} if self.repository else {},
        }
        return options | dict.fromkeys(BUTTONS, bool(self.repository))

    def texts(self) -> dict[str, str]:
        """Return the parts of pages that depend on the address, as MyST."""
        if not self.repository:
            link = '<a href="../_static/zwfs.zip" download>zwfs.zip</a>'
            package = f"Download the repository, {link} (MIT licence), and install the package:"
            return {
                "install": f"{package}\n\n```sh\npip install zwfs.zip\n```",
                "clone": f"Unpack {link}, the whole repository.",
            }
        return {
            "install": f'```sh\npip install "zwfs @ git+{self.repository}"\n```',
            "clone": f"```sh\ngit clone {self.repository}\ncd {self.folder}\n```",
        }

    def cell(self) -> str:
        """Return the cell that installs the package on Colab, next to the files of a clone; empty without one."""
        if not self.repository:
            return ""
        lines = [
            f"!git clone -q --depth 1 {self.repository} /content/{self.folder}",
            f"%cd -q /content/{self.folder}/notebooks",
            f'%pip install -q "/content/{self.folder}[notebooks]"',
        ]
        return "\n    ".join([f'import sys\n\nif "{COLAB}" in sys.modules:', *lines])


def setting(root: Path) -> Address:
    """Return the table ``[tool.zwfs]`` of pyproject.toml; refuse what is no address."""
    table = tomllib.loads((root / "pyproject.toml").read_text("utf-8")).get("tool", {}).get("zwfs", {})
    for key, value in table.items():
        if key not in EXPECTED:
            raise ToolError(f"pyproject.toml, [tool.zwfs]: {key}: expected one of {', '.join(EXPECTED)}")
        pattern, form = EXPECTED[key]
        if value != "" and not (isinstance(value, str) and re.fullmatch(pattern, value)):
            raise ToolError(f"pyproject.toml, [tool.zwfs]: {key} = {value!r}: expected {form}, or an empty string")
    return Address(**table)


def address(project: Project) -> None:
    """Write the address to every file that names it, or remove it."""
    for name, content in contents(project, setting(project.root)).items():
        if (project.root / name).read_bytes() != content:
            (project.root / name).write_bytes(content)
            print(f"{name} is new")


def contents(project: Project, public: Address) -> dict[str, bytes]:
    """Return the content of the files that depend on the address, by name."""
    writers = {"README.md": readme, "CITATION.cff": citation, "pyproject.toml": metadata}
    texts = {name: write((project.root / name).read_text("utf-8"), public) for name, write in writers.items()}
    notebooks = {source: with_cell(read(source), public.cell()) for source in project.sources()}
    return {name: text.encode() for name, text in texts.items()} | {
        source.relative_to(project.root).as_posix(): to_bytes(one) for source, one in notebooks.items()
    }


def readme(text: str, public: Address) -> str:
    """Return the README with links under its title, and with a picture that other sites can show."""
    links = {
        "Read the book": public.book,
        "as one PDF": public.book and f"{public.book}zwfs.pdf",
        "run the notebooks on Binder": public.name
        and f"https://mybinder.org/v2/gh/{public.name}/{BRANCH}?urlpath=lab/tree/notebooks",
        "cite it": public.doi and f"https://doi.org/{public.doi}",
    }
    shown = " ·\n".join(f"[{label}]({link})" for label, link in links.items() if link)
    text = re.sub(
        r"(<!-- links: make address -->\n)(?:\[.*\n)*", lambda found: found[1] + shown + "\n" * bool(shown), text
    )
    raw = f"https://raw.githubusercontent.com/{public.name}/{BRANCH}/" if public.name else ""
    return re.sub(r"\]\((?:https://raw\S+?/main/)?(?=book/\S+\.png\))", f"]({raw}", text)


def citation(text: str, public: Address) -> str:
    """Return CITATION.cff with the address of the code and of the book, and the DOI."""
    lines = {"repository-code": public.repository, "url": public.book, "doi": public.doi}
    given = "".join(f'{key}: "{value}"\n' for key, value in lines.items() if value)
    text = re.sub(rf"(?m)^(?:{'|'.join(lines)}): .*\n", "", text)
    return re.sub(r"(?m)^(?=abstract:)", given, text)


def metadata(text: str, public: Address) -> str:
    """Return pyproject.toml with the links of the package."""
    links = {"Homepage": public.book, "Documentation": public.book and f"{public.book}book/api.html"}
    if public.repository:
        links |= {"Repository": public.repository, "Issues": f"{public.repository}/issues"}
        links["Changelog"] = f"{public.repository}/blob/{BRANCH}/CHANGELOG.md"
    given = "".join(f'{key} = "{value}"\n' for key, value in links.items() if value)
    text = re.sub(r"\[project\.urls\]\n(?:.+\n)*\n", "", text)
    table = f"[project.urls]\n{given}\n" if given else ""
    return text.replace("[project.optional-dependencies]\n", f"{table}[project.optional-dependencies]\n")


def with_cell(notebook: NotebookNode, source: str) -> NotebookNode:
    """Return a notebook with this cell for Colab after its title, or without one, numbered as a run would do."""
    notebook.cells = [cell for cell in notebook.cells if COLAB not in cell.source]
    if source:
        notebook.cells.insert(1, new_code_cell(source, metadata={"tags": ["remove-cell", "colab"]}))
    for number, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
        for counted in (cell, *(output for output in cell.outputs if "execution_count" in output)):
            counted.execution_count = number
    return normalise(notebook)
