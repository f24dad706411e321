"""The training program `ppo.py`, called with small settings."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from cavmarl.config.registry import entries
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import make_vec
from cavmarl.evaluate.provenance.manifest import read_closed
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE
from cavmarl.learning.actor_critic import load_network
from cavmarl.learning.checkpoint import read_checkpoint, write_checkpoint
from cavmarl.learning.run_folder import parse_run
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.policies.loading import load_policy
from tests.support.training import TRAIN, load_program

CONFIGS = sorted((TRAIN.parent / "configs" / "train").glob("*.yaml"))
FORMS = ([], ["--mappo"], ["--shared", "--keep", "0.4"])
TIMES = {"seconds", "agent_steps_per_s", "simulation_s", "transfer_s", "inference_s", "learning_s"}
TINY = [
    "--env", "merge", "--num-envs", "2", "--agents", "2", "--background", "2", "--hidden", "8",
    "--num-steps", "8", "--epochs", "1", "--minibatches", "2", "--threads", "1",
]  # fmt: skip


@pytest.fixture(scope="module")
def ippo() -> ModuleType:
    return load_program("ppo")


@pytest.fixture(params=FORMS, ids=" ".join)
def form(request: pytest.FixtureRequest) -> list[str]:
    words: list[str] = request.param
    return words


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_every_config_loads_and_options_override_it(ippo: ModuleType, config: Path) -> None:
    args = parse_run(ippo.Args, ["--config", str(config), "--seed", "77"], "")
    assert args.env in entries()
    bounds = {"total_agent_steps", "minutes"} & yaml.safe_load(config.read_text()).keys()
    assert bounds, "the config does not set the length of the training"
    assert all(getattr(args, bound) > 0 for bound in bounds)
    assert args.seed == 77


@pytest.mark.parametrize(
    ("text", "said"),
    [("minute: 3.0", "minute: .*minutes"), ("- 1", "must be a mapping"), ("seed: x", "seed")],
)
def test_an_invalid_config_is_refused(ippo: ModuleType, here: Path, text: str, said: str) -> None:
    (here / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        parse_run(ippo.Args, ["--config", "wrong.yaml"], "")


def log(folder: Path) -> list[dict[str, str]]:
    with (folder / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_two_updates_run_from_the_command_line(tmp_path: Path) -> None:
    words = [*TINY, "--total-agent-steps", "60", "--runs", str(tmp_path), "--name", "one"]
    done = subprocess.run(
        [sys.executable, str(TRAIN / "ppo.py"), *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "one" in done.stdout
    rows = log(tmp_path / "one")
    assert len(rows) >= 2
    assert int(rows[-1]["agent_steps"]) >= 60
    assert (tmp_path / "one" / "model.safetensors").stat().st_size < 1_000_000
    manifest = read_closed(tmp_path / "one")
    assert manifest["program"] == "ppo.py"
    assert manifest["settings"]["total_agent_steps"] == 60
    assert manifest["world"]["map"]
    assert "model.safetensors" in manifest["results_sha256"]


def test_the_same_seed_gives_the_same_weights(
    ippo: ModuleType, here: Path, form: list[str]
) -> None:
    words = [*TINY, *form, "--total-agent-steps", "100"]
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert ippo.main([*words, "--name", name, "--seed", seed]) == 0
    weights = [(here / "runs" / name / "model.safetensors").read_bytes() for name in "abc"]
    assert weights[0] == weights[1] != weights[2]


def results_of(folder: Path) -> tuple[bytes, list[dict[str, str]]]:
    """Return the weights and the learning curve; columns of times are left out."""
    rows = [{key: row[key] for key in row.keys() - TIMES} for row in log(folder)]
    return (folder / "model.safetensors").read_bytes(), rows


def test_killed_workers_do_not_change_what_is_learned(
    ippo: ModuleType, here: Path, monkeypatch: pytest.MonkeyPatch, form: list[str]
) -> None:
    words = [*TINY, "--total-agent-steps", "100", *form]
    assert ippo.main([*words, "--name", "whole"]) == 0
    collect = ippo.Collector.collect
    killed: list[int] = []

    def collect_after_a_kill(self: Any, with_suggested: bool) -> Any:
        worlds = self.vec.worlds
        assert isinstance(worlds, PooledWorlds)
        killed.append(worlds.pool.pids[0])
        os.kill(killed[-1], signal.SIGKILL)
        return collect(self, with_suggested)

    monkeypatch.setattr(ippo.Collector, "collect", collect_after_a_kill)
    assert ippo.main([*words, "--name", "killed", "--workers", "2"]) == 0
    assert len(set(killed)) >= 2
    assert results_of(here / "runs" / "whole") == results_of(here / "runs" / "killed")


def test_zones_in_workers_do_not_change_what_is_learned(ippo: ModuleType, here: Path) -> None:
    words = [*TINY, "--mappo", "--num-envs", "1", "--total-agent-steps", "40"]
    assert ippo.main([*words, "--name", "whole"]) == 0
    assert ippo.main([*words, "--name", "split", "--zones", "2", "--workers", "2"]) == 0
    assert results_of(here / "runs" / "whole") == results_of(here / "runs" / "split")


def test_a_central_critic_is_not_part_of_the_driver(ippo: ModuleType, here: Path) -> None:
    words = [*TINY, "--mappo", "--total-agent-steps", "20", "--name", "run"]
    assert ippo.main(words) == 0
    network, config = load_network(here / "runs" / "run")
    vec = make_vec("merge", agents=2, background=2)
    observations, infos = vec.reset(seed=0)
    assert config.state_size == vec.state_size == vec.state().shape[1] > 0
    assert network.critic[0].in_features == config.observation_size + config.state_size
    driver = load_policy(here / "runs" / "run", vec)
    vec.step(driver.act_batch(observations, infos["mask"]))


@pytest.mark.parametrize("kind", ["continuous", "discrete", "grid"])
def test_a_stopped_run_resumes_and_its_driver_drives(
    ippo: ModuleType, here: Path, kind: str
) -> None:
    entry = here / "envs" / "small"
    entry.mkdir(parents=True)
    source = TRAIN.parent / "envs" / "merge" / "map" / "map.net.xml"
    (entry / "env.yaml").write_text(
        f"name: small\nmap: {{source: {source}}}\naction: {{kind: {kind}}}\n"
        "population: {mode: respawn, agents: 2, background: 2}\n"
    )
    words = [word if word != "merge" else "small" for word in TINY]
    assert ippo.main([*words, "--total-agent-steps", "60"]) == 0
    folder = here / "runs" / "small_ippo_0"
    before = len(log(folder))
    assert ippo.main(["--resume", str(folder), "--total-agent-steps", "150"]) == 0
    rows = log(folder)
    assert [int(row["updates"]) for row in rows] == list(range(1, len(rows) + 1))
    assert len(rows) > before
    config = json.loads((folder / "config.json").read_text())
    assert config["agent_steps"] == int(rows[-1]["agent_steps"]) >= 150
    vec = make_vec("small")
    observations, infos = vec.reset(seed=0)
    vec.step(load_policy(folder, vec).act_batch(observations, infos["mask"]))


def test_the_time_limit_ends_a_run(ippo: ModuleType, here: Path) -> None:
    words = [*TINY, "--minutes", "0.0001", "--name", "short"]
    assert ippo.main([*words, "--total-agent-steps", "1000000000"]) == 0
    rows = log(here / "runs" / "short")
    assert 1 <= len(rows) < 1000  # any machine does few updates in 6 ms


def test_the_logger_tensorboard_writes_a_file_of_events(ippo: ModuleType, here: Path) -> None:
    pytest.importorskip("tensorboard")
    words = [*TINY, "--total-agent-steps", "20", "--name", "board", "--loggers", "tensorboard"]
    assert ippo.main(words) == 0
    assert list((here / "runs" / "board").glob("events.*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--env", "merg"], "did you mean merge"),
        (["--num-envs", "0"], "--num-envs 0: must be at least 1"),
        (["--learning-rate", "nan"], "--learning-rate nan: must be above 0"),
        (
            ["--move-off-weight", "1", "--imitation-weight", "1"],
            "--move-off-weight: leave out --residual and --imitation-weight",
        ),
        (["--mappo", "--shared"], "--shared: leave out --mappo"),
        (["--loggers", "tensorbord"], "--loggers tensorbord: no such logger; give some of"),
        (["--keep", "0"], "--keep 0.0: must be above 0"),
        (["--gamma", "1.5"], "--gamma 1.5: must be from 0 to 1"),
        (["--average", "1"], "--average 1.0: must be below 1"),
        (["--agents", "-1"], "--agents -1: must be at least 0"),
        (["--resume", "nowhere"], "--resume nowhere: has no checkpoint"),
    ],
)
def test_invalid_settings_are_refused(
    ippo: ModuleType,
    here: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    assert ippo.main(words) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (here / "runs").exists()


def test_a_folder_that_cannot_be_written_is_refused(
    ippo: ModuleType, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "file").touch()
    assert ippo.main([*TINY, "--runs", "file", "--name", "run"]) == 2
    assert "file/run: cannot be written" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("words", [["--num-envs", "x"], ["--nonsense"], ["--minutes"]])
def test_unknown_options_are_refused(ippo: ModuleType, words: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        ippo.main(words)


def test_a_resumed_run_refuses_changes_of_fixed_settings(
    ippo: ModuleType, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    folder = here / "runs" / "run"
    resume = ["--resume", str(folder), "--total-agent-steps", "100"]
    assert ippo.main([*resume, "--gamma", "0.5"]) == 2
    assert "--gamma: cannot change" in capsys.readouterr().err
    assert ippo.main(["--resume", str(folder), "--total-agent-steps", "10"]) == 2
    assert "has" in capsys.readouterr().err


def test_a_checkpoint_with_pickled_objects_is_refused(
    ippo: ModuleType, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    folder = here / "runs" / "run"
    state = read_checkpoint(folder)
    write_checkpoint(folder, replace(state, parts={"learner": Path("anything")}))
    assert ippo.main(["--resume", str(folder), "--total-agent-steps", "100"]) == 2
    assert f"{CHECKPOINT_FILE}: is damaged" in capsys.readouterr().err.replace("\n", "")


def test_a_run_with_start_begins_with_the_weights_of_that_driver(
    ippo: ModuleType, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "60", "--name", "first"]) == 0
    still = [*TINY, "--total-agent-steps", "20", "--learning-rate", "1e-12"]
    assert ippo.main([*still, "--name", "next", "--start", "runs/first"]) == 0
    one, other = (load_network(here / "runs" / name)[0] for name in ("first", "next"))
    for mine, theirs in zip(one.parameters(), other.parameters(), strict=True):
        assert (mine - theirs).abs().max() < 1e-6
    assert ippo.main([*TINY, "--mappo", "--name", "sees", "--start", "runs/first"]) == 2
    assert "--start runs/first: does not fit this run" in capsys.readouterr().err


def test_a_run_logs_how_many_numbers_of_its_start_driver_it_does_not_observe(
    ippo: ModuleType, here: Path, caplog: pytest.LogCaptureFixture
) -> None:
    short = [*TINY, "--total-agent-steps", "20"]
    more = ["--settings", "sensors.conflicts.count=2"]
    assert ippo.main([*short, *more, "--name", "first"]) == 0
    less = ["--settings", "sensors.conflicts.count=1"]
    assert ippo.main([*short, *less, "--name", "next", "--start", "runs/first"]) == 0
    assert "observes 9 numbers that this run does not" in caplog.text


@pytest.mark.parametrize("form", [["--shared"], ["--residual"], ["--hidden", "9"]])
def test_a_run_with_start_has_the_form_of_that_driver(
    ippo: ModuleType, here: Path, form: list[str]
) -> None:
    short = [*TINY, "--total-agent-steps", "20"]
    assert ippo.main([*short, *form, "--name", "first"]) == 0
    assert ippo.main([*short, "--name", "next", "--start", "runs/first"]) == 0
    one, other = (load_network(here / "runs" / name)[1] for name in ("first", "next"))
    assert (one.hidden, one.shared, one.residual) == (other.hidden, other.shared, other.residual)
    assert ippo.main(["--resume", "runs/next", "--total-agent-steps", "40"]) == 0
