"""Training of one network by two processes that `torchrun` starts."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("torch", reason="needs the extra: train")

from cavmarl.learning.checkpoint import read_checkpoint, write_checkpoint
from cavmarl.learning.data_parallel import Ranks
from cavmarl.learning.log import mean_of_ranks
from tests.support.training import TRAIN, load_program

TIMES = {"seconds", "agent_steps_per_s", "simulation_s", "transfer_s", "inference_s", "learning_s"}
TINY = [
    "--env", "ring", "--num-envs", "4", "--agents", "2", "--background", "2", "--hidden", "8",
    "--num-steps", "8", "--epochs", "2", "--minibatches", "2", "--checkpoint-updates", "2",
]  # fmt: skip

# Run `ppo.py` and save the weights of each process. After update STOP, signal process 1 to end.
WATCHED = """\
import importlib.util, os, signal, sys
import torch
spec = importlib.util.spec_from_file_location("ppo", sys.argv[1])
ppo = sys.modules["ppo"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(ppo)
rank, stop = os.environ["RANK"], int(sys.argv[2])
save, update = ppo.Run.save, ppo.Run.update
def update_and_stop(self):
    row = update(self)
    if rank == "1" and row["updates"] == stop:
        os.kill(os.getpid(), signal.SIGTERM)
    return row
def save_and_watch(self):
    torch.save(self.network.state_dict(), f"rank_{rank}.pt")
    save(self)
ppo.Run.update, ppo.Run.save = update_and_stop, save_and_watch
sys.exit(ppo.main(sys.argv[3:]))
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def results_of(folder: Path) -> tuple[bytes, list[dict[str, str]]]:
    with (folder / "progress.csv").open(newline="") as file:
        rows = [{key: row[key] for key in row.keys() - TIMES} for row in csv.DictReader(file)]
    return (folder / "model.safetensors").read_bytes(), rows


def torchrun(*words: str, stop: int = 0) -> subprocess.CompletedProcess[str]:
    """Run `ppo.py` in two processes."""
    Path("watched.py").write_text(WATCHED)
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.run(
        [*launch, "watched.py", str(TRAIN / "ppo.py"), str(stop), *words],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(TRAIN.parent)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_two_processes_learn_one_network_and_resume_bit_for_bit(here: Path) -> None:
    import torch

    words = [*TINY, "--total-agent-steps", "300"]
    done = torchrun(*words, "--name", "whole")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("driver: runs/whole") == 1
    one, other = (torch.load(f"rank_{rank}.pt", weights_only=True) for rank in (0, 1))
    assert all(torch.equal(one[name], other[name]) for name in one)
    rows = results_of(here / "runs/whole")[1]
    # Steps of both processes count: at most 4 worlds · 2 agents · 8 steps.
    assert 4 * 2 * 8 * 0.5 < int(rows[0]["agent_steps"]) <= 4 * 2 * 8
    state = read_checkpoint(here / "runs/whole")
    worlds = [parts["collector"]["worlds"] for parts in (state.parts, state.shares[0]["parts"])]
    assert not torch.equal(*worlds)
    assert torchrun(*words, "--name", "cut", stop=3).returncode
    assert read_checkpoint(here / "runs/cut").updates == 3
    done = torchrun("--resume", "runs/cut")
    assert done.returncode == 0, done.stderr
    assert results_of(here / "runs/cut") == results_of(here / "runs/whole")


def test_another_number_of_processes_is_refused(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = load_program("ppo")
    assert program.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    state = read_checkpoint(here / "runs/run")
    write_checkpoint(here / "runs/run", replace(state, shares=[{"random": {}, "parts": {}}]))
    assert program.main(["--resume", "runs/run", "--total-agent-steps", "90"]) == 2
    assert "run has 2 processes, not 1; torchrun has to start 2" in capsys.readouterr().err


def test_a_number_of_worlds_that_cannot_be_shared_equally_is_refused(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = load_program("ppo")
    monkeypatch.setattr(program.Ranks, "of_torchrun", lambda: Ranks(2, 1))
    assert program.main([*TINY, "--num-envs", "3", "--name", "odd"]) == 2
    said = capsys.readouterr().err
    assert "--num-envs 3: cannot be divided equally among 2 processes; give a multiple" in said
    assert not (here / "runs").exists()


def test_without_torchrun_a_run_has_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")  # set by some batch systems
    assert Ranks.of_torchrun().size == 1


def test_a_process_that_gets_sigterm_saves_its_run(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run resumes bit for bit from its last update."""
    program: ModuleType = load_program("ppo")
    words = [*TINY, "--total-agent-steps", "300"]
    assert program.main([*words, "--name", "whole"]) == 0
    update = program.Run.update

    def update_and_stop(self: object) -> dict[str, float]:
        row: dict[str, float] = update(self)
        if row["updates"] == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return row

    with monkeypatch.context() as patch:
        patch.setattr(program.Run, "update", update_and_stop)
        with pytest.raises(SystemExit, match="143"):
            program.main([*words, "--name", "cut"])
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert read_checkpoint(here / "runs/cut").updates == 3
    assert program.main(["--resume", "runs/cut"]) == 0
    assert results_of(here / "runs/cut") == results_of(here / "runs/whole")


def test_means_of_processes_are_weighted_by_their_numbers_of_trips() -> None:
    nan = float("nan")
    one = {"trips": 1, "success": 1.0}
    assert mean_of_ranks([one]) is one
    assert mean_of_ranks([one, {"trips": 3, "success": 0.0}]) == {"trips": 4, "success": 0.25}
    assert mean_of_ranks([one, {"trips": 0, "success": nan}]) == {"trips": 1, "success": 1.0}
    none = mean_of_ranks([{"trips": 0, "success": nan}] * 2)
    assert none["trips"] == 0
    assert none["success"] != none["success"]
