"""The training program by its command line, with tiny numbers; and its arithmetic."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from cavmarl.errors import ConfigError
from cavmarl.evaluate.manifest import read_closed
from cavmarl.registry import entries

torch = pytest.importorskip("torch")

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "ippo_torch.py"
CONFIGS = sorted((SCRIPT.parent.parent / "configs" / "train").glob("*.yaml"))
TINY = [
    "--env", "merge", "--num-envs", "2", "--agents", "2", "--background", "2", "--hidden", "8",
    "--num-steps", "8", "--epochs", "1", "--minibatches", "2", "--threads", "1",
]  # fmt: skip


@pytest.fixture(scope="module")
def ippo() -> ModuleType:
    """The program as a module: a file that is read, for `train` is no package."""
    spec = importlib.util.spec_from_file_location("ippo_torch", SCRIPT)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_every_config_loads_and_options_shadow_it(ippo: ModuleType, config: Path) -> None:
    args = ippo.parse_args(["--config", str(config), "--seed", "77"])
    assert args.env in entries()
    bounds = {"total_agent_steps", "minutes"} & yaml.safe_load(config.read_text()).keys()
    assert bounds, "how long it trains is left to a default"
    assert all(getattr(args, bound) > 0 for bound in bounds)
    assert args.seed == 77


@pytest.mark.parametrize(
    ("text", "said"),
    [("minute: 3.0", "minute: .*minutes"), ("- 1", "must be a mapping"), ("seed: x", "seed")],
)
def test_a_wrong_config_is_refused(ippo: ModuleType, here: Path, text: str, said: str) -> None:
    (here / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        ippo.parse_args(["--config", "wrong.yaml"])


def log(folder: Path) -> list[dict[str, str]]:
    with (folder / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_two_updates_by_command_line(tmp_path: Path) -> None:
    words = [*TINY, "--total-agent-steps", "60", "--runs", str(tmp_path), "--name", "one"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "one" in done.stdout
    rows = log(tmp_path / "one")
    assert len(rows) >= 2
    assert int(rows[-1]["agent_steps"]) >= 60
    assert (tmp_path / "one" / "model.safetensors").stat().st_size < 1_000_000
    manifest = read_closed(tmp_path / "one")
    assert manifest["settings"]["total_agent_steps"] == 60
    assert manifest["world"]["map"]
    assert "model.safetensors" in manifest["results_sha256"]


def test_the_same_seed_learns_the_same(ippo: ModuleType, here: Path) -> None:
    words = [*TINY, "--total-agent-steps", "100"]
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert ippo.main([*words, "--name", name, "--seed", seed]) == 0
    weights = [(here / "runs" / name / "model.safetensors").read_bytes() for name in "abc"]
    assert weights[0] == weights[1] != weights[2]


def test_workers_that_are_killed_change_nothing_that_is_learnt(
    ippo: ModuleType, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*TINY, "--total-agent-steps", "100"]
    assert ippo.main([*words, "--name", "whole"]) == 0
    collect = ippo.Collector.collect

    def collect_after_a_kill(self: Any, with_suggested: bool) -> Any:
        os.kill(self.vec.worlds.pool.pids[0], signal.SIGKILL)
        return collect(self, with_suggested)

    monkeypatch.setattr(ippo.Collector, "collect", collect_after_a_kill)
    assert ippo.main([*words, "--name", "killed", "--workers", "2"]) == 0
    weights = [
        (here / "runs" / name / "model.safetensors").read_bytes() for name in ("whole", "killed")
    ]
    assert weights[0] == weights[1]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_a_run_goes_on_where_it_stopped_and_drives(ippo: ModuleType, here: Path, kind: str) -> None:
    from cavmarl.policies import load_policy
    from cavmarl.vector_env import make_vec

    entry = here / "envs" / "small"
    entry.mkdir(parents=True)
    source = SCRIPT.parents[1] / "envs" / "merge" / "map" / "map.net.xml"
    (entry / "env.yaml").write_text(
        f"name: small\nmap: {{source: {source}}}\naction: {{kind: {kind}}}\n"
        "population: {mode: seats, agents: 2, background: 2}\n"
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


def test_the_clock_ends_a_run(ippo: ModuleType, here: Path) -> None:
    words = [*TINY, "--minutes", "0.0001", "--name", "short"]
    assert ippo.main([*words, "--total-agent-steps", "1000000000"]) == 0
    rows = log(here / "runs" / "short")
    assert 1 <= len(rows) < 1000  # 6 ms are some updates, however fast the machine


def test_tensorboard_gets_the_same_numbers(ippo: ModuleType, here: Path) -> None:
    pytest.importorskip("tensorboard")
    words = [*TINY, "--total-agent-steps", "20", "--name", "board", "--tensorboard"]
    assert ippo.main(words) == 0
    assert list((here / "runs" / "board").glob("events.*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--env", "merg"], "did you mean merge"),
        (["--num-envs", "0"], "--num-envs 0: must be at least 1"),
        (["--learning-rate", "nan"], "--learning-rate nan: must be above 0"),
        (["--gamma", "1.5"], "--gamma 1.5: must be from 0 to 1"),
        (["--agents", "-1"], "--agents -1: must be at least 0"),
        (["--resume", "nowhere"], "--resume nowhere: no checkpoint there"),
    ],
)
def test_wrong_settings_are_refused(
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
def test_words_that_are_no_settings_are_wrong_use(ippo: ModuleType, words: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        ippo.main(words)


def test_a_broken_checkpoint_is_refused(
    ippo: ModuleType, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    folder = here / "runs" / "run"
    resume = ["--resume", str(folder), "--total-agent-steps", "100"]
    assert ippo.main([*resume, "--gamma", "0.5"]) == 2
    assert "--gamma: cannot change" in capsys.readouterr().err
    assert ippo.main(["--resume", str(folder), "--total-agent-steps", "10"]) == 2
    assert "has" in capsys.readouterr().err
    for name in ("optimizer.pt", "training.json", "model.safetensors"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(b"{broken")
        assert ippo.main(resume) == 2
        assert name in capsys.readouterr().err.replace("\n", "")
        (folder / name).write_bytes(whole)


def test_a_pickle_is_not_run(ippo: ModuleType, here: Path) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    folder = here / "runs" / "run"
    torch.save({"state": Path("anything")}, folder / "optimizer.pt")
    assert ippo.main(["--resume", str(folder), "--total-agent-steps", "100"]) == 2


def batch_of_one_seat(
    ippo: ModuleType, rewards: list[float], acted: list[bool], goes_on: list[bool], cut_value: float
) -> object:
    steps = len(rewards)

    def column(values: list[float] | list[bool]) -> object:
        return torch.tensor(values).reshape(steps, 1, 1)

    values = column([0.5] * steps)
    next_values = torch.where(column(goes_on), 0.5, 0.0)
    next_values[-1] = cut_value
    return ippo.Batch(
        observations=torch.zeros(steps, 1, 1, 1),
        actions=torch.zeros(steps, 1, 1, 2),
        log_probs=torch.zeros(steps, 1, 1),
        values=values,
        rewards=column(rewards),
        acted=column(acted),
        next_values=next_values,
        goes_on=column(goes_on),
    )


def test_advantages_by_hand(ippo: ModuleType) -> None:
    # A vehicle ends after step 1; the seat waits in step 2; the next vehicle is cut after step 4.
    batch = batch_of_one_seat(
        ippo,
        rewards=[1.0, 2.0, 9.0, 3.0, 4.0],
        acted=[True, True, False, True, True],
        goes_on=[True, False, False, True, False],
        cut_value=2.0,
    )
    found = batch.advantages(0.9, 0.5).flatten().tolist()  # type: ignore[attr-defined]
    ends = 2.0 - 0.5
    cut = 4.0 + 0.9 * 2.0 - 0.5
    first = 1.0 + 0.9 * 0.5 - 0.5 + 0.45 * ends
    fourth = 3.0 + 0.9 * 0.5 - 0.5 + 0.45 * cut
    assert found == pytest.approx([first, ends, 0.0, fourth, cut])


def test_what_is_collected_is_cut_at_ends_and_at_the_horizon(ippo: ModuleType) -> None:
    from cavmarl.networks import ActorCritic, NetworkConfig
    from cavmarl.vector_env import make_vec

    torch.manual_seed(0)
    vec = make_vec("merge", num_envs=3, agents=3, background=0, max_cycles=25)
    size = vec.single_observation_space.shape[0]
    config = NetworkConfig("merge", size, vec.config.sensors, vec.config.action, (8,))
    args = ippo.Args(num_steps=60)
    batch = ippo.Collector(vec, ActorCritic(config, 2.0), args, 0).collect(with_suggested=False)
    boundary = batch.acted & ~batch.goes_on
    bootstrapped = boundary & (batch.next_values != 0.0)
    assert bootstrapped[24].any()
    assert not bootstrapped[:24].any()
    ended = boundary & ~bootstrapped
    assert ended.any()
    assert not (batch.goes_on & ~batch.acted).any()
    # Where the vehicle goes on, the next decision is the same vehicle's.
    assert batch.acted[1:][batch.goes_on[:-1]].all()
