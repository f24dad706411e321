"""The extras in `pyproject.toml`, and the errors and pages that name them."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from cavmarl.core.errors import MissingExtraError, missing, require_all

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
# The extra `all` does not include these extras. Their packages conflict with other packages, do not
# run on each machine, or are clients of services that few users have (`trackers`, `cluster`).
APART = {"benchmarl", "rllib", "lanelet2", "trackers", "cluster"}
TOOLS = {"all", "bench", "dev", "fuzz"}


def named_extras() -> Iterator[tuple[str, str]]:
    """Yield (extra, file) for each call of `require` or `missing`."""
    for folder in ("cavmarl", "benchmarks", "docs", "train"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_bytes())):
                if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                    continue
                if node.func.id in ("require", "missing") and len(node.args) == 2:
                    extra = node.args[1]
                    if isinstance(extra, ast.Constant):
                        yield str(extra.value), path.relative_to(ROOT).as_posix()


def included_extras(extra: str) -> set[str]:
    """Return an extra and all extras that it includes."""
    found = {extra}
    for line in EXTRAS[extra]:
        need = Requirement(line)
        if need.name == "cavmarl":
            found = found.union(*map(included_extras, need.extras))
    return found


def test_errors_name_existing_extras() -> None:
    named = list(named_extras())
    assert len(named) > 50
    assert not [(extra, file) for extra, file in named if extra not in EXTRAS]


def extras_of_pages() -> Iterator[tuple[str, str]]:
    """Yield (extra, file) for each extra that a page or a program names for installation."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    for path in (*pages, *(ROOT / "examples").rglob("*.*"), *(ROOT / "train").rglob("*.py")):
        text = path.read_text(encoding="utf-8", errors="ignore")
        installed = re.findall(r"(?:\.|cavmarl)\[([a-z0-9]+(?:, ?[a-z0-9]+)*)\]", text)
        for extra in (*re.findall(r"extra `(\w+)`", text), *re.split(r", ?", ",".join(installed))):
            if extra:
                yield extra, path.relative_to(ROOT).as_posix()


def test_pages_name_existing_extras() -> None:
    named = list(extras_of_pages())
    assert ("train", "README.md") in named
    assert not [(extra, file) for extra, file in named if extra not in EXTRAS]


def test_the_extra_all_includes_all_extras_without_conflicts() -> None:
    assert included_extras("all") == set(EXTRAS) - APART - TOOLS | {"all"}


@pytest.mark.parametrize("extra", ["all", "bench"])
def test_the_extra_dev_includes_the_extras_all_and_bench(extra: str) -> None:
    assert extra in included_extras("dev")


def test_one_error_names_all_missing_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    needed = {"no_torch": "train", "numpy": "report", "no_sumo": "sumo"}
    command = re.escape(f"pip install -e '{ROOT}[sumo,train]'")
    with pytest.raises(MissingExtraError, match=f"'no_torch' and 'no_sumo' are .*: {command}"):
        require_all(needed)
    monkeypatch.chdir(ROOT)
    with pytest.raises(MissingExtraError, match=r"pip install -e '\.\[train\]'"):
        require_all({"no_torch": "train"})


def test_the_error_of_an_installed_wheel_names_cavmarl_as_the_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cavmarl.core.errors.__file__", "/site-packages/cavmarl/core/errors.py")
    assert "pip install 'cavmarl[train]'" in str(missing("torch", "train"))
