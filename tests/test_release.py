"""Versions, badges and issue forms agree with the package."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.command_lines import check_command

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
FORMS = sorted(ROOT.glob(".github/ISSUE_TEMPLATE/*_*.yml"))
KINDS = {"textarea", "input", "dropdown", "checkboxes"}
PYTHON = "Programming Language :: Python :: "


def test_all_files_name_the_same_version_and_licence() -> None:
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert newest
    assert PROJECT["version"] == CITATION["version"] == newest[1]
    assert PROJECT["license"] == CITATION["license"]
    assert [author["name"] for author in CITATION["authors"]] == [
        author["name"] for author in PROJECT["authors"]
    ]


def test_the_citation_has_the_required_fields() -> None:
    assert {"cff-version", "message", "title", "authors"} <= CITATION.keys()
    assert CITATION["title"].startswith("cavmarl: ")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("licence", [PROJECT["license"]]),
        ("python", [c.removeprefix(PYTHON) for c in PROJECT["classifiers"] if PYTHON in c]),
    ],
)
def test_badges_agree_with_the_package(name: str, values: list[str]) -> None:
    badge = (ROOT / f"docs/images/badge_{name}.svg").read_text("utf-8")
    assert f"<title>{name}: {' | '.join(values)}</title>" in badge
    assert badge.count(" | ".join(values)) == 3
    readme = (ROOT / "README.md").read_text("utf-8")
    assert f"{', '.join(values)}](docs/images/badge_{name}.svg)" in readme


def test_there_are_two_issue_forms() -> None:
    assert [path.stem for path in FORMS] == ["bug_report", "feature_request"]


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_an_issue_form_has_valid_fields(path: Path) -> None:
    form: Any = yaml.safe_load(path.read_text("utf-8"))
    assert {"name", "description", "labels", "body"} == form.keys()
    assert {field["type"] for field in form["body"]} <= KINDS
    names = [field["id"] for field in form["body"]]
    assert len(set(names)) == len(names)
    assert all(field["attributes"]["label"] for field in form["body"])
    assert any(field.get("validations", {}).get("required") for field in form["body"])
    for command in re.findall(r"`(cavmarl [^`]+)`", path.read_text("utf-8")):
        check_command(command)
