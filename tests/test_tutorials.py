"""The Python code and the shell commands of each tutorial run."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.core.extensions import REGISTERED_MODELS, REGISTERED_SENSORS, REGISTERED_TERMS

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "tutorials"
NEEDS_SERVICE = "nodes_and_service"
EXPENSIVE = {"train"}  # trains a driver
PAGES = sorted(path.stem for path in FOLDER.glob("*.md") if path.stem != "README")
QUICK = [name for name in PAGES if name not in (NEEDS_SERVICE, *EXPENSIVE)]


@pytest.fixture(autouse=True)
def remove_registrations() -> Iterator[None]:
    """Remove the terms, sensors and models that a page has registered."""
    registries = (REGISTERED_TERMS, REGISTERED_SENSORS, REGISTERED_MODELS)
    before = [set(registry.names) for registry in registries]
    yield
    for registry, names in zip(registries, before, strict=True):
        for name in set(registry.names) - names:
            registry.remove(name)


def run_page(name: str) -> None:
    """Run the blocks of a page in order, in the working directory."""
    text = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(python|sh)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks
    names: dict[str, object] = {"__name__": f"tutorial_{name}"}
    for kind, content in blocks:
        if kind == "python":
            exec(compile(content, f"docs/tutorials/{name}.md", "exec", dont_inherit=True), names)
            continue
        for line in content.splitlines():
            run_line(shlex.split(line))


def run_line(words: list[str]) -> None:
    if words[0] == "cavmarl" and words[1] != "train":  # without a new process
        done = CliRunner().invoke(app, words[1:], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(words, check=True, capture_output=True, env={**os.environ, "PATH": path})


@pytest.mark.parametrize("name", QUICK)
def test_a_tutorial_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_page(name)


@pytest.mark.slow  # trains a driver
@pytest.mark.parametrize("name", sorted(EXPENSIVE))
def test_an_expensive_tutorial_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_page(name)


@pytest.mark.slow  # tests/service/test_service_page.py runs its commands
def test_the_tutorial_of_the_service_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.support.service import Cluster, running_service

    monkeypatch.chdir(tmp_path)
    with running_service(tmp_path / "store.sqlite") as service:
        cluster = Cluster(service)
        cluster.start("a", "b")
        monkeypatch.setenv("CAVMARL_SERVICE", service.url)
        monkeypatch.setenv("CAVMARL_SECRET", service.secret)
        run_page(NEEDS_SERVICE)
        cluster.stop()


def test_the_list_of_tutorials_is_complete() -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\]\((\w+)\.md\)", text)) == PAGES
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert all(f"tutorials/{name}.md" in navigation for name in PAGES)
