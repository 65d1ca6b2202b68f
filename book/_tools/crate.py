"""RO-Crates: descriptions of results that programs can read, next to the files."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from rocrate.model.contextentity import ContextEntity
from rocrate.rocrate import ROCrate

from .project import Project
from .record import commit_date, versions

NAME = "ro-crate-metadata.json"


def describe_rerun(folder: Path, about: dict[str, Any]) -> None:
    """Write the crate of a rerun: its files are the results of an action with parameters and software.

    Parameters
    ----------
    folder : Path
        With all files of the run but the record.
    about : dict
        The record, without its files.
    """
    changed = ", ".join(f"{name} = {value}" for name, value in about["changed"].items()) or "the defaults"
    crate = _crate(f"{about['notebook']} with {changed}", f"Made by: {about['command']}", about["made"])
    files = [
        crate.add_file(folder / name, properties={"name": name})
        for name in sorted(file.name for file in folder.iterdir())
    ]
    software = [_software(crate, name, version) for name, version in about["versions"].items()]
    # The value of a property in a crate cannot be a mapping: JSON text stands for it.
    plain = {name: json.dumps(value) if isinstance(value, dict) else value
             for name, value in about["parameters"].items()}  # fmt: skip
    values = [_entity(crate, f"#{name}", "PropertyValue", name=name, value=value) for name, value in plain.items()]
    run = _entity(crate, "#run", "CreateAction", name=about["command"], endTime=about["made"])
    run["instrument"], run["object"], run["result"] = software, values, files
    crate.root_dataset["mentions"] = run
    if about["commit"]:
        crate.root_dataset["version"] = about["commit"]
    crate.metadata.write(folder)


def describe_book(project: Project, pages: Path, commit: str | None) -> None:
    """Write the crate of the book: its pages, the notebooks behind them, the paper, and how to build it."""
    cited = yaml.safe_load((project.root / "CITATION.cff").read_text("utf-8"))
    paper = cited["preferred-citation"]
    crate = _crate(cited["title"], cited["abstract"], commit_date(project.root))
    root = crate.root_dataset
    root["license"] = [f"https://spdx.org/licenses/{name}" for name in cited["license"]]
    root["author"] = [_entity(crate, "#authors", "Organization", name=one["name"]) for one in cited["authors"]]
    root["version"], root["url"], root["keywords"] = cited["version"], cited["url"], cited["keywords"]
    root["isBasedOn"] = _entity(crate, f"https://doi.org/{paper['doi']}", "ScholarlyArticle", name=paper["title"])
    files = [crate.add_file(pages / "index.html", properties={"name": "the book"})]
    for source in project.sources():
        page = f"notebooks/{source.stem}.html"
        files.append(crate.add_file(pages / page, page, properties={"name": source.stem}))
    software = [_software(crate, name, version) for name, version in versions().items()]
    code = _entity(crate, cited["repository-code"], "SoftwareSourceCode", name="zwfs", version=commit or "unknown")
    build = _entity(crate, "#build", "CreateAction", name="make book")
    build["instrument"], build["result"] = [code, *software], files
    root["mentions"] = build
    crate.metadata.write(pages)


def _crate(name: str, description: str, date: str | None) -> ROCrate:
    crate = ROCrate()
    crate.name, crate.description = name, description
    crate.root_dataset["datePublished"] = date or datetime.now(UTC).date().isoformat()
    return crate


def _entity(crate: ROCrate, identifier: str, kind: str, **properties: Any) -> ContextEntity:
    return crate.add(ContextEntity(crate, identifier, properties={"@type": kind, **properties}))


def _software(crate: ROCrate, name: str, version: str) -> ContextEntity:
    return _entity(crate, f"#software-{name}", "SoftwareApplication", name=name, version=version)
