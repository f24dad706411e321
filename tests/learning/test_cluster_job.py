"""Training as a job on this machine, and in Slurm if Slurm is installed."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

pytest.importorskip("torch", reason="needs the extra: train")

from cavmarl.cli import app
from cavmarl.cli.submit_train import make_job
from cavmarl.core.errors import CavmarlError, ConfigError, MissingExtraError, TrainingError
from cavmarl.evaluate.provenance.training_record import is_trained
from cavmarl.learning.checkpoint import read_checkpoint
from tests.support.training import TRAIN, load_program

TIMES = {"seconds", "agent_steps_per_s", "simulation_s", "transfer_s", "inference_s", "learning_s"}
RUN = [
    "ppo", "--env", "ring", "--num-envs", "2", "--agents", "2", "--background", "2",
    "--hidden", "8", "--num-steps", "32", "--epochs", "2", "--minibatches", "2",
    "--checkpoint-updates", "1000", "--total-agent-steps", "60000",
]  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{TRAIN.parent}:{os.environ.get('PYTHONPATH', '')}")
    return tmp_path


def submit(*words: str) -> dict[str, str]:
    """Return the printed `key: value` lines of `cavmarl submit train`."""
    done = CliRunner().invoke(app, ["submit", "train", *words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return dict(line.split(": ", 1) for line in done.output.splitlines())  # type: ignore[misc]


def refusal(kind: type[CavmarlError], *words: str) -> str:
    with pytest.raises(kind) as refused:
        CliRunner().invoke(app, ["submit", "train", *words], catch_exceptions=False)
    return str(refused.value)


def results_of(folder: Path) -> tuple[bytes, list[dict[str, str]]]:
    with (folder / "progress.csv").open(newline="") as file:
        rows = [{key: row[key] for key in row.keys() - TIMES} for row in csv.DictReader(file)]
    return (folder / "model.safetensors").read_bytes(), rows


def wait(told: Callable[[], object], log: Path | None = None, within_s: float = 300.0) -> None:
    until = time.monotonic() + within_s
    while not told():
        text = log.read_text() if log is not None and log.exists() else ""
        assert time.monotonic() < until, text
        time.sleep(0.05)


def rows(folder: Path) -> int:
    path = folder / "progress.csv"
    return path.read_text().count("\n") - 1 if path.exists() else 0


def check_resumed(folder: Path, *options: str) -> None:
    """Compare the results of a job with those of an uninterrupted run."""
    assert load_program("ppo").main([*RUN[1:], *options, "--name", "whole"]) == 0
    assert results_of(folder) == results_of(Path("runs/whole"))


# submitit drops its handle of the running process.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_preempted_job_is_requeued_and_resumes(here: Path) -> None:
    pytest.importorskip("submitit", reason="needs the extra: cluster")
    told = submit(*RUN, "--to", "local", "--name", "job")
    folder, log = Path(told["run"]), Path(told["log"])
    assert folder == here / "runs/job"
    wait(lambda: rows(folder) > 2, log)
    assert read_checkpoint(folder).updates == 0
    (trains,) = psutil.Process(int(told["job"])).children()  # the process that trains
    trains.send_signal(signal.SIGUSR2)
    wait(lambda: read_checkpoint(folder).updates, log)
    assert not is_trained(folder)
    wait(lambda: is_trained(folder), log)
    check_resumed(folder)


def test_a_job_fails_if_its_program_fails(here: Path) -> None:
    job = make_job("ppo", [*RUN[1:], "--name", "job"], 1)
    (here / "runs").mkdir()
    (here / "runs/job").touch()
    with pytest.raises(TrainingError, match=r"runs/job: the program ended with exit code 2"):
        job()


def test_a_job_resumes_only_its_own_run(here: Path) -> None:
    words = [*RUN[1:], "--total-agent-steps", "20", "--name", "job"]
    job = make_job("ppo", words, 1)
    assert job.command() == [sys.executable, str(TRAIN / "ppo.py"), *words]
    assert load_program("ppo").main(words) == 0
    assert job.command()[2:] == ["--resume", str(here / "runs/job")]
    assert job() == str(here / "runs/job")  # already complete
    said = refusal(TrainingError, *RUN, "--name", "job", "--to", "local")
    assert "runs/job: contains a run, which is not overwritten; continue it (--resume" in said
    more = ["--resume", "runs/job", "--total-agent-steps", "90"]
    assert make_job("ppo", more, 1).command()[2:] == more
    assert "torch.distributed.run" in make_job("ppo", RUN[1:], 2).command()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ppo_sb3", "--to", "service"], "--to service: nodes of a service train with ppo only"),
        (["ppo", "--to", "service", "--workers", "2"], "--workers: has no effect with --to serv"),
        (["ppo", "--to", "service", "--import", "os"], "--import: has no effect with --to serv"),
        (["ppo", "--to", "service", "--gpus", "1"], "--gpus: has no effect with --to service"),
        (["ppo", "--to", "pbs"], "--to pbs: unknown; give slurm, ray, service or local"),
        (["ppo", "--sbatch", "a=b", "--to", "local"], "--sbatch: has no effect with --to local"),
        (["ppo", "--to", "ray", "--job-minutes", "9"], "--job-minutes: has no effect with"),
        (["ppo", "--sbatch", "gpu"], "--sbatch gpu: must be KEY=VALUE"),
        (["pppo"], "pppo: is no training program that can resume; choose one of ippo_torchrl, "),
        (["ppo_rllib"], "ppo_rllib: is no training program that can resume; choose one of ippo_"),
        (["ppo", "--env", "merg"], "did you mean merge"),
        (["ppo", "--gamma", "2"], "--gamma 2.0: must be from 0 to 1"),
        (["ppo", "--processes", "3"], "--num-envs 16: cannot be divided equally among 3 proce"),
        (["ppo_sb3", "--processes", "2"], "--processes 2: ppo_sb3 trains in one process; use pp"),
    ],
)
def test_jobs_with_invalid_arguments_are_refused_before_they_are_queued(
    here: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_SECRET", "secret")
    assert said in refusal(ConfigError, *words)
    assert not list(here.iterdir())


def test_a_machine_without_slurm_is_refused(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit", reason="needs the extra: cluster")
    monkeypatch.setenv("PATH", "")
    assert "--to slurm: this machine has no sbatch" in refusal(TrainingError, *RUN)
    assert not list(here.rglob("*"))


def test_the_error_without_submitit_names_the_extra(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert "[cluster]" in refusal(MissingExtraError, *RUN, "--to", "local")


@pytest.mark.slow
def test_a_preempted_job_of_slurm_resumes(here: Path) -> None:
    pytest.importorskip("submitit", reason="needs the extra: cluster")
    if shutil.which("scontrol") is None or subprocess.call(["scontrol", "ping"]):
        pytest.skip("needs a Slurm cluster")
    told = submit(*RUN, "--to", "slurm", "--name", "job", "--sbatch", "open-mode=append")
    folder, log = Path(told["run"]), Path(told["log"])
    wait(lambda: rows(folder) > 2, log)
    subprocess.run(["scancel", "--signal=USR2", told["job"]], check=True)
    wait(lambda: read_checkpoint(folder).updates, log)
    assert not is_trained(folder)
    wait(lambda: is_trained(folder), log)
    check_resumed(folder)
