"""`docs/explanation/architecture.md` agrees with the folders and with the layers of imports."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "cavmarl"
MAX_WORDS = 1_500
# The first folder is only in the wheel; folders with the second name are in several folders.
ELSEWHERE = {"cavmarl/data/", "kernels/"}
QUESTIONS = re.findall(r"^\| ([^|]+\?) \| (.+) \|$", PAGE, re.MULTILINE)


def test_the_page_has_at_most_1500_words() -> None:
    # The bars of tables do not count as words.
    words = [word for word in PAGE.split() if re.search(r"\w", word)]
    assert len(words) <= MAX_WORDS


def test_the_drawing_has_the_layers_of_the_contract() -> None:
    drawing = re.search(r"<!-- layers -->\n```\n(.*?)\n```\n<!-- end -->", PAGE, re.DOTALL)
    assert drawing
    inside = [line.split("│")[1] for line in drawing[1].splitlines() if "│" in line]
    assert [re.findall(r"\w+|\|", line) for line in inside] == layers()


def test_the_table_of_the_package_has_each_folder_once() -> None:
    rows = re.findall(r"^\| `(\w+)/` \|", section("The package"), re.MULTILINE)
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert sorted(rows) == sorted(folders)


def test_the_page_answers_at_least_twenty_questions() -> None:
    assert len(QUESTIONS) >= 20


@pytest.mark.parametrize(("question", "answer"), QUESTIONS)
def test_the_file_that_answers_a_question_exists(question: str, answer: str) -> None:
    paths = re.findall(r"`([\w/]+\.py)`", answer)
    assert paths, question
    for path in paths:
        assert (PACKAGE / path).is_file(), path


def test_each_path_on_the_page_exists() -> None:
    for path in re.findall(r"`(\w+/[\w/]*(?:\.py)?)`", PAGE):
        assert (PACKAGE / path).exists() or (ROOT / path).exists() or path in ELSEWHERE, path


def layers() -> list[list[str]]:
    """Return the folders of each layer of the contract, with "|" between independent folders."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    contract = next(contract for contract in contracts if contract["id"] == "layers")
    return [re.findall(r"\w+|\|", layer) for layer in contract["layers"]]


def section(title: str) -> str:
    """Return the text under a heading of the page."""
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
