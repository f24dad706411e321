"""The training programs that use other libraries, called as a user calls them, but small."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import entries, load_config
from cavmarl.config.signals import SIGNAL_CONTROLLERS
from cavmarl.evaluate.provenance.manifest import read_closed
from cavmarl.evaluate.provenance.training_record import is_trained
from cavmarl.networks.driver_network import load_driver_network
from tests.support.generated import check_block
from tests.support.training import TRAIN, load_program

pytest.importorskip("torch", reason="needs the extra: train")

AGENTS = load_config("merge")[0].population.agents
SMALL = """\
env: merge
agents: 2
background: 0
num_envs: 2
num_steps: 8
minibatches: 2
hidden: 8
total_agent_steps: 40
"""


def call(program: str, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TRAIN / program), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def refusal(capsys: pytest.CaptureFixture[str], program: str, *words: object) -> str:
    """Return a program's error; the program runs in this process, because torch loads slowly."""
    try:
        code = load_program(program.removesuffix(".py")).main([*map(str, words)])
    except SystemExit as end:  # raised by argparse
        code = end.code
    assert code == 2
    return capsys.readouterr().err


def small(updates: int) -> list[object]:
    """Return options for a run with this number of updates of 2 worlds · 8 steps."""
    sizes = ["--num-worlds", 2, "--num-steps", 8, "--minibatches", 2, "--hidden", 8]
    return [*sizes, "--total-agent-steps", 2 * 8 * AGENTS * (updates - 1) + 1]


@pytest.mark.parametrize(
    ("program", "module", "extra"),
    [
        ("ppo_gymnasium.py", "gymnasium", "train"),
        ("ppo_sb3.py", "stable_baselines3", "train"),
        ("ippo_torchrl.py", "torchrl", "torchrl"),
        ("ppo_rllib.py", "ray.rllib", "rllib (make libraries)"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code
def test_a_library_trains_a_driver_that_can_be_loaded(
    tmp_path: Path, program: str, module: str, extra: str
) -> None:
    pytest.importorskip(module, reason=f"needs the extra: {extra}")
    rows = ["--num-envs", 2 * AGENTS] if program == "ppo_gymnasium.py" else []
    done = call(program, *small(updates=2), *rows, "--runs", tmp_path, "--name", "a")
    assert done.returncode == 0, done.stderr
    manifest = read_closed(tmp_path / "a")
    assert manifest["program"] == program
    files = {"model.safetensors", "config.json", "progress.csv"}
    assert set(manifest["results_sha256"]) >= files
    header, *rows = (tmp_path / "a" / "progress.csv").read_text().splitlines()
    assert header == "updates,agent_steps,seconds,trips,trip_return,success"
    assert len(rows) == 2
    from cavmarl.env.vector import make_vec
    from cavmarl.policies.loading import load_policy

    vec = make_vec("merge")
    observations, infos = vec.reset(seed=0)
    vec.step(load_policy(tmp_path / "a", vec).act_batch(observations, infos["mask"]))


@pytest.mark.parametrize("algorithm", ["ippo", "mappo"])
@pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code
def test_benchmarl_trains(tmp_path: Path, algorithm: str) -> None:
    pytest.importorskip("benchmarl", reason="needs the extra: benchmarl (make libraries)")
    sizes = ["--num-worlds", 2, "--num-steps", 8, "--minibatches", 2, "--hidden", 8]
    words = [*sizes, "--updates", 2, "--algorithm", algorithm]
    done = call("ippo_benchmarl.py", *words, "--runs", tmp_path, "--name", "a")
    assert done.returncode == 0, done.stderr
    assert read_closed(tmp_path / "a")["program"] == "ippo_benchmarl.py"
    (table,) = (tmp_path / "a").rglob("collection_reward_reward_mean.csv")
    assert len(table.read_text().splitlines()) == 2
    assert (tmp_path / "a/model.safetensors").exists() == (algorithm == "ippo")
    if algorithm == "ippo":
        check_driver_of_benchmarl(tmp_path / "a")


def check_driver_of_benchmarl(folder: Path) -> None:
    """Compare the outputs of the saved driver with a network of BenchMARL's weights."""
    torch = pytest.importorskip("torch")
    network = load_driver_network(folder)
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 105)).astype(np.float32)
    found = torch.load(folder / "policy.pt", weights_only=False)
    layers = {
        name.partition("mlp.params.")[2]: tensor
        for name, tensor in found.items()
        if "mlp.params." in name and isinstance(tensor, torch.Tensor)
    }
    expected = torch.from_numpy(seen)
    for place in (0, 2, 4):
        expected = expected @ layers[f"{place}.weight"].T + layers[f"{place}.bias"]
        expected = torch.tanh(expected) if place < 4 else expected
    assert network.outputs(seen) == pytest.approx(expected[:, :2].numpy(), abs=1e-5)


@pytest.mark.parametrize(
    ("program", "module", "words", "message"),
    [
        ("ippo_torchrl.py", "torchrl", ["--num-steps", 0], "--num-steps 0: must be at least 1"),
        ("ppo_rllib.py", "ray.rllib", ["--num-runners", -1], "--num-runners -1: must be"),
        ("ippo_benchmarl.py", "benchmarl", ["--algorithm", "x"], "--algorithm x: must be one of"),
        ("ippo_torchrl.py", "torchrl", ["--env", "nowhere"], "nowhere"),
        ("ppo_gymnasium.py", "gymnasium", ["--env", "nowhere"], "nowhere"),
        ("ppo_gymnasium.py", "gymnasium", ["--num-worlds", 3], "a multiple of num_worlds = 3"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code
def test_a_program_of_a_library_refuses_invalid_arguments(
    tmp_path: Path,
    program: str,
    module: str,
    words: list[object],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip(module)
    assert message in refusal(capsys, program, *words, "--runs", tmp_path)


@pytest.mark.parametrize(
    ("program", "module"),
    [("ppo.py", "torch"), ("ippo_torchrl.py", "torchrl"), ("ppo_rllib.py", "ray.rllib")],
)
@pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code
def test_programs_that_train_drivers_refuse_signal_agents(
    tmp_path: Path, program: str, module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(module)
    source = entries()["grid4x4"] / "map" / "map.net.xml"
    settings = {
        "name": "lights", "version": 1, "map": {"source": str(source)},
        "signals": {"agents": "all"},
    }  # fmt: skip
    (tmp_path / "env.yaml").write_text(json.dumps(settings), encoding="utf-8")
    said = refusal(capsys, program, "--env", tmp_path, "--runs", tmp_path / "runs")
    assert "this program has only vehicles as agents" in said


def test_five_seeds_trains_missing_seeds_and_writes_the_table(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra: report")
    config = tmp_path / "small.yaml"
    config.write_text(SMALL)
    words = ["--config", config, "--seeds", 0, 1, "--episodes", 1, "--repeats", 2]
    done = call("five_seeds.py", *words, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "idm" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "curves.svg").stat().st_size > 1000
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(result["trained"]["success"]["runs"]) == 2
    assert read_closed(tmp_path / "out" / "evaluation")["policies"]["seed_1"]
    assert is_trained(tmp_path / "out" / "seed_0")
    (tmp_path / "out" / "seed_0" / "progress.csv").write_text("changed\n")
    assert not is_trained(tmp_path / "out" / "seed_0")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
        (["--config", "{small}", "--seeds", "3"], "--seeds"),
        (["--config", "{small}", "--jobs", "0"], "--jobs"),
        (["--config", "{list}"], "mapping"),
    ],
)
def test_five_seeds_refuses_invalid_arguments(
    tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    small, listed = tmp_path / "small.yaml", tmp_path / "list.yaml"
    small.write_text(SMALL)
    listed.write_text("- env\n")
    given = (word.format(small=small, list=listed) for word in words)
    assert message in refusal(capsys, "five_seeds.py", *given)


@pytest.mark.filterwarnings("ignore")  # the library warns about its own code
def test_a_network_for_signals_is_trained_and_compared_with_controllers(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    sizes = ["--num-worlds", 1, "--num-steps", 8, "--minibatches", 2, "--hidden", 8]
    words: list[object] = [
        *sizes,
        "--updates",
        2,
        "--background",
        20,
        "--horizon-s",
        60,
        "--evaluations",
        1,
    ]
    done = call("signals_sb3.py", *words, "--runs", tmp_path, "--name", "a")
    assert done.returncode == 0, done.stderr
    manifest = read_closed(tmp_path / "a")
    assert manifest["program"] == "signals_sb3.py"
    assert set(manifest["results_sha256"]) == {"model.zip", "evaluation.json"}
    figures = json.loads((tmp_path / "a" / "evaluation.json").read_text())
    assert figures.keys() == {"PPO", "map", *SIGNAL_CONTROLLERS}
    assert figures["PPO"][0]["departed"] >= 20
    again = call("signals_sb3.py", *words, "--runs", tmp_path, "--name", "a")
    assert again.returncode == 2
    assert "contains a run" in again.stderr


@pytest.mark.filterwarnings("ignore")  # the library warns about its own code
def test_one_network_controls_signals_with_different_numbers_of_greens(tmp_path: Path) -> None:
    """Learning changes all weights, and no forbidden green is chosen."""
    pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    program = load_program("signals_sb3")
    args = program.Args(
        env="town", num_worlds=2, num_steps=16, minibatches=2, hidden=8, background=60
    )
    model, rows = program.make_model(args)
    with closing(rows):
        assert len({len(greens) for greens in rows.get_attr("signals")[0].table.greens}) > 1
        allowed = []
        accept = rows.step_async

        def check_and_accept(actions: NDArray[np.int64]) -> None:
            allowed.append(rows.action_masks()[np.arange(len(actions)), actions])
            accept(actions)

        rows.step_async = check_and_accept
        before = [each.detach().clone() for each in model.policy.parameters()]
        model.learn(2 * 16 * rows.num_envs)
        changed = [
            not np.array_equal(old, new.detach())
            for old, new in zip(before, model.policy.parameters(), strict=True)
        ]
    assert all(changed)
    assert np.all(allowed)


def test_the_table_of_training_seeds_on_the_page_is_current(
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = load_program("signal_seeds")
    assert program.main(["--table", "docs/figures/signal_control.json"]) == 0
    check_block(Path("docs/guides/signal_control.md"), "signals", capsys.readouterr().out.rstrip())


def test_training_seeds_without_maps_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "has no file" in refusal(capsys, "signal_seeds.py", "--maps", tmp_path)
    assert "--maps FOLDER" in refusal(capsys, "signal_seeds.py")
