"""The commands of `docs/guides/service.md` run, its tests exist, and its containers can start.

Every test run executes the commands, although they start a service and two nodes, because readers
try them first.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import click
import pytest
import typer
import yaml
from typer.testing import CliRunner

from cavmarl.cli import app
from tests.support.service import Cluster, running_service

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "guides" / "service.md").read_text(encoding="utf-8")
CONTAINERS = ROOT / "configs" / "service"


def commands() -> list[str]:
    block = re.search(r"<!-- session -->\n```sh\n(.*?)```", PAGE, re.DOTALL)
    assert block
    return [line.split("  #")[0].strip() for line in block[1].splitlines()]


def test_the_commands_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = {}
    with running_service(tmp_path / "store.sqlite", "--beat-s", "0.5") as service:
        monkeypatch.setenv("CAVMARL_SERVICE", service.url)
        monkeypatch.setenv("CAVMARL_SECRET", service.secret)
        cluster = Cluster(service)
        for line in commands():
            words = shlex.split(line.replace("--episodes 8", "--episodes 1 --agents 2"))
            if words[1] == "serve" or words[0] == "export":
                continue
            if words[1] == "node":
                secret = Path(words[words.index("--secret-file") + 1]).read_text().strip()
                cluster.start(words[words.index("--name") + 1], secret=secret)
                continue
            done = CliRunner().invoke(app, words[1:], catch_exceptions=False)
            assert done.exit_code == 0, line
            said[words[1]] = done.stdout
        assert Path("node.secret").stat().st_mode & 0o777 == 0o600
        assert cluster.processes["a"].wait(timeout=20.0) == 0
        cluster.stop()
    assert "done" in said["sessions"]
    kinds = [json.loads(line)["kind"] for line in said["events"].splitlines()]
    assert {"node.registered", "session.done"} <= set(kinds)
    assert "merge" in said["manifest"]
    assert Path("runs/there/trips.csv").is_file()
    told = Path("runs/there/service_events.jsonl").read_text().splitlines()
    assert [json.loads(line)["kind"] for line in told][:2] == ["session.opened", "session.assigned"]


@pytest.mark.slow  # every run has test_sessions.py, with smaller worlds
def test_the_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    block = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert block
    with running_service(tmp_path / "store.sqlite", "--beat-s", "0.5") as service:
        cluster = Cluster(service)
        cluster.start("b")
        example = block[1].replace("http://127.0.0.1:8700", service.url)
        example = example.replace("range(100)", "range(3)").replace("episodes=8", "episodes=1")
        example = example.replace("agents=4, ", "agents=4, wait_s=10.0, ")
        try:
            exec(compile(example, "docs/guides/service.md", "exec"), {"secret": service.secret})
        finally:
            cluster.stop()
    assert (tmp_path / "runs" / "there" / "manifest.json").is_file()


def test_the_tests_that_the_page_names_exist() -> None:
    named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", PAGE)
    assert len(named) == 10
    for file, test in named:
        text = (ROOT / "tests" / "service" / file).read_text(encoding="utf-8")
        assert f"def {test}(" in text, test


def test_the_containers_run_existing_commands() -> None:
    compose = yaml.safe_load((CONTAINERS / "compose.yaml").read_text(encoding="utf-8"))
    assert set(compose["services"]) == {"service", "node-a", "node-b"}
    for name, service in compose["services"].items():
        parse(shlex.split(service["command"]))
        for volume in service["volumes"]:
            source = volume.split(":")[0]
            assert source.startswith("./") or source in compose["volumes"], name
        assert (CONTAINERS / service["build"]["context"]).resolve() == ROOT
        assert (ROOT / service["build"]["dockerfile"]).is_file()
    lines = (CONTAINERS / "Containerfile").read_text(encoding="utf-8").splitlines()
    words = {line.split()[0] for line in lines if line and not line.startswith("#")}
    assert words <= {"FROM", "RUN", "WORKDIR", "COPY", "USER", "VOLUME", "ENTRYPOINT", "CMD"}
    (entry,) = [line for line in lines if line.startswith("ENTRYPOINT")]
    assert json.loads(entry.split(maxsplit=1)[1]) == ["cavmarl"]
    (usual,) = [line for line in lines if line.startswith("CMD")]
    parse(json.loads(usual.split(maxsplit=1)[1]))


def parse(words: list[str]) -> None:
    """Parse a command; raise an error for wrong names and values."""
    group = typer.main.get_command(app)
    assert isinstance(group, click.Group) or hasattr(group, "get_command")
    context = group.make_context("cavmarl", list(words), resilient_parsing=False)
    name, command, rest = group.resolve_command(context, list(words))
    assert command is not None, name
    command.make_context(name, rest, parent=context)
