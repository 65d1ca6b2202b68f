"""Files for archives, from CITATION.cff, pyproject.toml and the notebooks: codemeta, Zenodo, CODECHECK."""

import json
import re
from typing import Any

import yaml

from .notebook import read
from .project import Project
from .release import about

PAPER = "https://doi.org/"


def metadata(project: Project) -> None:
    """Write the files, and the version of pyproject.toml to CITATION.cff."""
    for name, text in contents(project).items():
        file = project.root / name
        if not file.exists() or file.read_text("utf-8") != text:
            file.write_text(text, "utf-8")
            print(f"{name} is new")


def contents(project: Project) -> dict[str, str]:
    """Return the texts of the files by name."""
    package = about(project)
    citation = (project.root / "CITATION.cff").read_text("utf-8")
    citation = re.sub(r"(?m)^version: .*$", f"version: {package['version']}", citation)
    cited = yaml.safe_load(citation)
    return {
        "CITATION.cff": citation,
        "codemeta.json": _json(codemeta(cited, package)),
        ".zenodo.json": _json(zenodo(cited)),
        "codecheck.yml": codecheck(project, cited["preferred-citation"]),
    }


def codemeta(cited: dict[str, Any], package: dict[str, Any]) -> dict[str, Any]:
    """Return the description of the software in the terms of CodeMeta."""
    paper = cited["preferred-citation"]
    return {
        "@context": "https://w3id.org/codemeta/3.0",
        "@type": "SoftwareSourceCode",
        "name": cited["title"],
        "identifier": package["name"],
        "version": cited["version"],
        "description": cited["abstract"],
        "author": [{"@type": "Organization", "name": author["name"]} for author in cited["authors"]],
        "license": [f"https://spdx.org/licenses/{name}" for name in cited["license"]],
        "keywords": cited["keywords"],
        "codeRepository": cited["repository-code"],
        "url": cited["url"],
        "issueTracker": package["urls"]["Issues"],
        "programmingLanguage": "Python",
        "runtimePlatform": f"Python {package['requires-python']}",
        "softwareRequirements": package["dependencies"],
        "referencePublication": {
            "@type": "ScholarlyArticle",
            "@id": PAPER + paper["doi"],
            "name": paper["title"],
            "author": [
                {"@type": "Person", "givenName": author["given-names"], "familyName": author["family-names"]}
                for author in paper["authors"]
            ],
        },
    }


def zenodo(cited: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a release for Zenodo."""
    paper = cited["preferred-citation"]
    related = [
        {"identifier": paper["doi"], "relation": "isSupplementTo", "resource_type": "publication-conferencepaper"},
        {"identifier": cited["url"], "relation": "isDocumentedBy", "resource_type": "publication-other"},
    ]
    return {
        "upload_type": "software",
        "title": cited["title"],
        "version": cited["version"],
        "description": f"<p>{cited['abstract']}</p><p>Code: MIT. Text and figures: CC-BY-4.0.</p>",
        "creators": [{"name": author["name"]} for author in cited["authors"]],
        "keywords": cited["keywords"],
        "license": cited["license"][0].lower(),
        "access_right": "open",
        "related_identifiers": related,
    }


def codecheck(project: Project, paper: dict[str, Any]) -> str:
    """Return the manifest of CODECHECK: the paper, and the files that a checker makes again."""
    manifest = [
        {"file": f"notebooks/{source.name}", "comment": title(read(source).cells)} for source in project.sources()
    ]
    manifest.append({"file": "book/_static/front.png", "comment": "Figure of the front page and of the README"})
    check = {
        "version": "https://codecheck.org.uk/spec/config/1.0/",
        "paper": {
            "title": paper["title"],
            "authors": [{"name": f"{one['given-names']} {one['family-names']}"} for one in paper["authors"]],
            "reference": PAPER + paper["doi"],
        },
        "manifest": manifest,
    }
    note = "# Steps: book/checking.md. A checker adds codechecker, report and certificate.\n"
    return note + yaml.safe_dump(check, sort_keys=False, allow_unicode=True, width=110)


def title(cells: list[Any]) -> str:
    """Return the heading of a notebook."""
    return next(line[2:] for cell in cells for line in cell.source.splitlines() if line.startswith("# "))


def _json(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"
