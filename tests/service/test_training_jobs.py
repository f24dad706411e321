"""Training as a job of a service: the same driver as in one process, after losses and drains."""

from __future__ import annotations

import io
import shutil
import signal
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("torch", reason="needs the extra: train")

from cavmarl.cli import app
from cavmarl.client import Client
from cavmarl.config.registry import agent_entries, entries
from cavmarl.core.errors import ServiceError
from cavmarl.evaluate.provenance.manifest import read_closed
from cavmarl.evaluate.provenance.training_record import is_trained
from cavmarl.service.node_training import pack_run, unpack_run
from cavmarl.service.request_bodies import ConfigurationBody
from cavmarl.service.training_settings import check_training, program_options
from tests.learning.test_cluster_job import RUN, results_of
from tests.support.service import Cluster, running_service
from tests.support.training import load_program

SETTINGS: dict[str, Any] = {
    "hidden": 8, "num_steps": 32, "epochs": 2, "minibatches": 2, "checkpoint_updates": 20,
    "total_agent_steps": 100_000,
}  # fmt: skip
WORLD: dict[str, Any] = {"num_envs": 2, "agents": 2, "background": 2}


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with running_service(tmp_path / "service.sqlite", "--beat-s", "0.2") as service:
        made = Cluster(service)
        try:
            yield made
        finally:
            made.stop()


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    with cluster.service.client(cluster.service.grant("ada", "client")) as client:
        yield client


def start(cluster: Cluster, *names: str) -> None:
    cluster.start(*names, options=["--capability", "train"])


@pytest.mark.parametrize("end", ["kill", "drain"])
def test_a_training_continues_on_another_node_and_gives_the_same_driver(
    cluster: Cluster, client: Client, tmp_path: Path, end: str
) -> None:
    start(cluster, "first")
    job = client.train("ring", settings=SETTINGS, wait_s=60.0, **WORLD)
    has_ended = False

    def end_once(found: dict[str, Any]) -> None:
        nonlocal has_ended
        done = found["progress"][0] if found["progress"] else 0
        if has_ended or not (found["saved_number"] if end == "kill" else done):
            return
        has_ended = True
        start(cluster, "second")
        if end == "kill":
            cluster.processes["first"].kill()
        else:
            cluster.processes["first"].send_signal(signal.SIGTERM)
            assert cluster.processes["first"].wait() == 0

    found = client.wait(job, tmp_path / "there", 240.0, end_once)
    assert has_ended
    assert found["placements"] == 2
    assert read_closed(tmp_path / "there")["settings"]["resume"] == "runs/training"
    assert "cavmarl-files" not in (tmp_path / "there/manifest.json").read_text()
    assert [one["data"]["node"] for one in client.events(job) if "node" in one["data"]] == [
        "first", "second",
    ]  # fmt: skip
    words = [*RUN[1:], "--total-agent-steps", str(SETTINGS["total_agent_steps"])]
    words += ["--checkpoint-updates", "20", "--runs", str(tmp_path), "--name", "whole"]
    assert load_program("ppo").main(words) == 0
    assert results_of(tmp_path / "there") == results_of(tmp_path / "whole")


def test_a_training_with_own_files_is_submitted_and_fetched_by_commands(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    start(cluster, "first")
    shutil.copytree(entries()["ring"], tmp_path / "mine")
    shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "driver")
    secret = tmp_path / "secret"
    secret.touch(mode=0o600)
    secret.write_text(cluster.service.grant("ada", "client"), encoding="utf-8")
    access = ["--service", cluster.service.url, "--secret-file", str(secret)]
    words = ["ppo", "--env", "mine", "--start", "driver", "--num-envs", "2", "--agents", "2"]
    words += ["--num-steps", "16", "--total-agent-steps", "128", "--to", "service"]
    words += ["--settings", 'horizon_s=20,traffic.model={"idm":0.5,"krauss":0.5}']
    told = CliRunner().invoke(app, ["submit", "train", *words, *access], catch_exceptions=False)
    assert told.exit_code == 0, told.output
    lines = dict(line.split(": ", 1) for line in told.output.splitlines())
    command = lines["collect"].split()[1:]
    assert command[:2] == ["sessions", "--collect"]
    fetched = CliRunner().invoke(app, [*command, *access], catch_exceptions=False)
    assert fetched.exit_code == 0, fetched.output
    folder = tmp_path / "runs/mine_ippo_0"
    assert is_trained(folder)
    world = read_closed(folder)["world"]["config"]
    assert world["traffic"]["model"] == {"idm": 0.5, "krauss": 0.5}
    assert world["horizon_s"] == 20.0


def test_a_failed_training_reports_the_message_of_the_program(
    cluster: Cluster, client: Client, tmp_path: Path
) -> None:
    start(cluster, "first")
    cluster.start("without")
    job = client.train("ring", settings={"gamma": 2.0}, wait_s=60.0, **WORLD)
    with pytest.raises(ServiceError, match=r"is failed: .*--gamma 2.0: must be from 0 to 1"):
        client.wait(job, tmp_path / "there", 60.0)
    (assigned,) = [one for one in client.events(job) if "node" in one["data"]]
    assert assigned["data"]["node"] == "first"
    assert not (tmp_path / "there").exists()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"env": "merge"}, "env belongs to the configuration; remove it"),
        ({"num_envs": 4}, "num_envs belongs to the configuration"),
        ({"plugins": "antigravity"}, "plugins is chosen by the node"),
        ({"runs": "there"}, "runs is chosen by the node"),
        ({"resume": "there"}, "resume is chosen by the node"),
        ({"gama": 0.9}, "gama is unknown; known settings: anneal, average, "),
        ({"program": "ppo.py"}, "program is unknown"),
        ({"config": "merge"}, "config is unknown"),
        ({"device": "../cuda"}, "could name a file"),
        ({"start": "a/b"}, "could name a file"),
        ({"start": "nobody"}, "there is no driver 'nobody'"),
        ({"opponents": "idm,nobody"}, "there is no driver 'nobody'"),
    ],
)
def test_settings_that_name_files_or_code_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ServiceError, match=words) as refused:
        check_training(document(), settings)
    assert refused.value.problem == "refused"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"nodes": 2}, "nodes: 2: a training runs on one node"),
        ({"agents": 0}, "agents: 0: a training needs agents"),
        ({"max_cycles": 9}, "max_cycles: 9: give horizon_s"),
    ],
)
def test_configurations_that_cannot_be_trained_in_are_refused(
    given: dict[str, Any], words: str
) -> None:
    with pytest.raises(ServiceError, match=words):
        check_training(document(**given), {})


def test_the_options_of_the_program_follow_from_the_configuration_and_the_settings() -> None:
    made = document(agents=3, zones=2, num_envs=4, seed=5, overrides={"horizon_s": 9.0})
    options = program_options(made, {"anneal": False, "hidden": 8, "start": "merge_ippo"}, Path())
    args = load_program("ppo").parse_run(load_program("ppo").Args, options, "")
    assert (args.env, args.agents, args.num_envs, args.seed) == ("ring", 3, 4, 5)
    assert (args.anneal, args.hidden, args.start) == (False, 8, "merge_ippo")
    assert args.folder == Path("runs/training")
    parts = set(args.settings.split(","))
    assert parts == {"horizon_s=9.0", "zones.count=2"}


def document(**given: Any) -> dict[str, Any]:
    found = ConfigurationBody(environment="ring", **given).model_dump(exclude={"name"})
    return found


def test_a_packed_run_is_unpacked_unchanged(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/checkpoint.pt").write_bytes(bytes(range(256)))
    (tmp_path / "run/.lock").write_bytes(b"1")
    unpack_run(pack_run(tmp_path / "run"), tmp_path / "again/run")
    (found,) = (tmp_path / "again/run").iterdir()
    assert found.name == "checkpoint.pt"
    assert found.read_bytes() == bytes(range(256))


@pytest.mark.parametrize("name", ["../checkpoint.pt", "/etc/passwd", "a/b", ".lock", "C:x"])
def test_a_state_that_names_another_folder_is_refused(tmp_path: Path, name: str) -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("checkpoint.pt", b"x")
        archive.writestr(name, b"x")
    with pytest.raises(ServiceError, match="is not a name"):
        unpack_run(content.getvalue(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_every_change_of_a_packed_run_is_refused_or_leaves_whole_files(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/checkpoint.pt").write_bytes(bytes(2000))
    (tmp_path / "run/progress.csv").write_bytes(b"updates\n")
    content = pack_run(tmp_path / "run")
    for k in range(len(content)):
        changed = bytearray(content)
        changed[k] ^= 0xFF
        with suppress(ServiceError):
            unpack_run(bytes(changed), tmp_path / str(k))
            for file in (tmp_path / str(k)).iterdir():
                assert file.read_bytes() in (bytes(2000), b"updates\n")
    with pytest.raises(ServiceError, match="cannot be read"):
        unpack_run(content[:-9], tmp_path / "short")


def test_a_run_that_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cavmarl.service.node_training.MOST_RUN_BYTES", 10)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/checkpoint.pt").write_bytes(bytes(11))
    with pytest.raises(ServiceError, match="the run has 11 bytes: at most 10"):
        unpack_run(pack_run(tmp_path / "run"), tmp_path / "again")
