"""Interrupted runs resume bit for bit, and do not overwrite or mix files of other runs.

Starting a separate program takes 2 s, so only one test starts such a program, and kills it.
"""

from __future__ import annotations

import csv
import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs the extra: train")

from cavmarl.core.errors import ConfigError, TrainingError
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE, is_trained
from cavmarl.learning.checkpoint import read_checkpoint
from cavmarl.learning.log import Log
from cavmarl.learning.run_folder import parse_run
from tests.support.training import TRAIN, load_program

TIMES = {"seconds", "agent_steps_per_s", "simulation_s", "transfer_s", "inference_s", "learning_s"}
TINY = [
    "--env", "ring", "--num-envs", "2", "--agents", "2", "--background", "2", "--hidden", "8",
    "--num-steps", "8", "--epochs", "1", "--minibatches", "2", "--checkpoint-updates", "2",
]  # fmt: skip
LENGTH = ["--total-agent-steps", "200"]
CUT_AFTER = 5  # updates; the last checkpoint is of update 4

# Run a program and kill it after the fifth row of its log.
KILLED = """\
import os, runpy, signal, sys
from cavmarl.learning.log import Log
write = Log.write
def write_and_die(self, row):
    write(self, row)
    if row["updates"] == 5:
        os.kill(os.getpid(), signal.SIGKILL)
Log.write = write_and_die
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


Learnt = tuple[bytes, list[dict[str, str]], set[str]]


class Interrupted(BaseException):
    """An exception that ends a run and that the code of cavmarl does not catch."""


@pytest.fixture(scope="module")
def ippo() -> ModuleType:
    return load_program("ppo")


@pytest.fixture(scope="module")
def whole(ippo: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    """Return the results of an uninterrupted run."""
    runs = tmp_path_factory.mktemp("runs")
    assert ippo.main([*TINY, *LENGTH, "--runs", str(runs), "--name", "whole"]) == 0
    return results_of(runs / "whole")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refusal(ippo: ModuleType, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    def call(*words: str) -> str:
        assert ippo.main(list(words)) == 2
        return " ".join(capsys.readouterr().err.split())

    return call


def results_of(folder: Path) -> Learnt:
    """Return the weights, the learning curve without columns of times, and the names of files."""
    with (folder / "progress.csv").open(newline="") as file:
        rows = [{key: row[key] for key in row.keys() - TIMES} for row in csv.DictReader(file)]
    return (folder / "model.safetensors").read_bytes(), rows, {p.name for p in folder.iterdir()}


def run_until_interrupted(
    program: ModuleType, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run a program that `Interrupted` ends after `CUT_AFTER` updates."""
    update = program.Run.update

    def update_and_end(self: Any) -> dict[str, float]:
        row = update(self)
        if self.updates == CUT_AFTER:
            raise Interrupted
        return row

    with monkeypatch.context() as patch:
        patch.setattr(program.Run, "update", update_and_end)
        with pytest.raises(Interrupted):
            program.main(words)


def test_a_killed_run_resumes_bit_for_bit(ippo: ModuleType, here: Path, whole: Learnt) -> None:
    words = [*TINY, *LENGTH]
    command = [sys.executable, "-c", KILLED, str(TRAIN / "ppo.py"), *words, "--name", "cut"]
    killed = subprocess.run(command, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not is_trained(here / "runs" / "cut")
    state = read_checkpoint(here / "runs" / "cut")
    assert state.updates == 4
    rows = (here / "runs" / "cut" / "progress.csv").read_text().splitlines()
    assert len(rows) == 1 + CUT_AFTER
    left = here / "runs" / "cut" / ".build-left"  # as left by a killed writer
    left.mkdir()
    (left / CHECKPOINT_FILE).touch()
    # Resuming must not read the saved driver.
    (here / "runs" / "cut" / "model.safetensors").write_bytes(b"of another step")
    assert ippo.main(["--resume", "runs/cut"]) == 0
    assert results_of(here / "runs" / "cut") == whole
    assert is_trained(here / "runs" / "cut")


@pytest.mark.parametrize(
    ("words", "others"),
    [
        (["--imitation-weight", "1", "--end-at-red"], []),
        (["--imitation-weight", "1", "--imitate", "random_actions"], []),
        (["--move-off-weight", "0.3", "--keep", "0.5"], []),
        (["--shared", "--keep", "0.5", "--opponents", "idm,random_actions"], []),
        (["--residual"], []),
        (["--mappo"], ["--zones", "2"]),
        (["--mappo"], ["--workers", "2"]),
    ],
)
@pytest.mark.filterwarnings("ignore:workers = 2")
def test_a_run_with_other_settings_resumes_bit_for_bit(
    here: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], others: list[str]
) -> None:
    program = load_program("ppo")
    words = [*TINY, *LENGTH, *words]
    assert program.main([*words, "--name", "whole"]) == 0
    run_until_interrupted(program, [*words, "--name", "cut"], monkeypatch)
    assert program.main(["--resume", "runs/cut", *others]) == 0
    assert results_of(here / "runs" / "cut") == results_of(here / "runs" / "whole")


def test_resuming_a_finished_run_with_an_open_manifest_closes_it(
    ippo: ModuleType, here: Path, refusal: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object, **__: object) -> None:
        raise Interrupted

    words = [*TINY, "--total-agent-steps", "60", "--name", "run"]
    with monkeypatch.context() as patch:
        patch.setattr("cavmarl.learning.run_folder.end_training", die)
        with pytest.raises(Interrupted):
            ippo.main(words)
    before = results_of(here / "runs" / "run")
    assert ippo.main(["--resume", "runs/run"]) == 0
    assert results_of(here / "runs" / "run") == before
    more = ["--resume", "runs/run"]
    assert "--total-agent-steps 60: the run has 61; ask for more" in refusal(*more)
    more += ["--total-agent-steps", "90"]
    assert "--minutes 1e-05: the run has" in refusal(*more, "--minutes", "1e-5")
    assert ippo.main(more) == 0
    assert len(results_of(here / "runs" / "run")[1]) > len(before[1])


def test_a_folder_can_have_only_one_run_and_one_process(
    ippo: ModuleType, here: Path, refusal: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*TINY, "--total-agent-steps", "60", "--name", "run"]
    locked: list[str] = []
    update = ippo.Run.update

    def update_beside_another(self: Any) -> dict[str, float]:
        if not locked:
            locked.append("")
            locked[0] = refusal(*words) + refusal("--resume", "runs/run")
        return update(self)

    monkeypatch.setattr(ippo.Run, "update", update_beside_another)
    assert ippo.main(words) == 0
    assert locked[0].count(f"runs/run: process {os.getpid()} trains here; wait until") == 2
    before = results_of(here / "runs" / "run")
    assert "runs/run: contains a run, which is not overwritten; continue" in refusal(*words)
    assert results_of(here / "runs" / "run") == before


@pytest.mark.parametrize("full", ["checkpoint.pt", "progress.csv"])
def test_a_full_disk_does_not_damage_the_last_checkpoint(
    ippo: ModuleType,
    here: Path,
    whole: Learnt,
    refusal: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    full: str,
) -> None:
    fsync, calls = os.fsync, []

    def fsync_on_a_full_disk(fd: int) -> None:
        if full in os.readlink(f"/proc/self/fd/{fd}"):
            calls.append(fd)
            if len(calls) == 2:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(fd)

    words = [*TINY, *LENGTH]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync_on_a_full_disk)
        said = refusal(*words, "--name", "cut")
    assert f"runs/cut/{full}: cannot be written (No space left on device); free some space" in said
    assert "resume the last checkpoint: --resume runs/cut" in said
    assert not list((here / "runs" / "cut").glob(".build-*"))
    assert read_checkpoint(here / "runs" / "cut").updates == 0
    assert ippo.main(["--resume", "runs/cut"]) == 0
    assert results_of(here / "runs" / "cut") == whole


def test_a_full_disk_at_a_row_of_the_log_is_a_typed_error(here: Path) -> None:
    (here / "progress.csv").symlink_to("/dev/full")
    log = Log(here)
    with pytest.raises(TrainingError, match=r"progress\.csv: cannot be written \(No space left"):
        log.write({"updates": 1.0})
    log.close()


def test_a_run_that_failed_on_a_full_disk_can_be_started_again(
    ippo: ModuleType, here: Path, refusal: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    words = [*TINY, "--total-agent-steps", "20", "--name", "run"]
    with monkeypatch.context() as patch:
        patch.setattr("cavmarl.learning.run_folder.write_checkpoint", no_room)
        assert "checkpoint.pt: cannot be written" in refusal(*words)
    assert "--resume runs/run: has no checkpoint" in refusal("--resume", "runs/run")
    assert ippo.main(words) == 0


def test_damaged_files_and_files_of_other_runs_are_refused(
    ippo: ModuleType, here: Path, refusal: Callable[..., str]
) -> None:
    assert ippo.main([*TINY, "--total-agent-steps", "20", "--name", "run"]) == 0
    resume = ("--resume", "runs/run", "--total-agent-steps", "60")
    path = here / "runs" / "run" / CHECKPOINT_FILE
    written = path.read_bytes()
    flipped = bytearray(written)
    flipped[len(written) // 2] ^= 1
    for broken in (written[:-1], bytes(flipped), b"", b"of another version\n" + written):
        path.write_bytes(broken)
        assert "runs/run/checkpoint.pt: is damaged, or of another version" in refusal(*resume)
    path.write_bytes(written)
    other = load_program("ppo_gymnasium")
    with pytest.raises(ConfigError, match=r"is a run of ppo\.py; use that program"):
        parse_run(other.Args, resume, "")
    (path.parent / "progress.csv").write_text("rows\n")
    assert "progress.csv: rows written before the checkpoint are missing" in refusal(*resume)


def test_resuming_in_a_changed_environment_is_refused(
    ippo: ModuleType, here: Path, refusal: Callable[..., str]
) -> None:
    entry = here / "envs" / "small"
    entry.mkdir(parents=True)
    source = TRAIN.parent / "envs" / "ring" / "map" / "map.net.xml"
    text = f"name: small\nmap: {{source: {source}}}\npopulation: {{mode: respawn}}\n"
    (entry / "env.yaml").write_text(text)
    words = ["small" if word == "ring" else word for word in TINY]
    assert ippo.main([*words, "--total-agent-steps", "20", "--name", "run"]) == 0
    (entry / "env.yaml").write_text(text + "horizon_s: 33.0\n")
    said = refusal("--resume", "runs/run", "--total-agent-steps", "60")
    assert "--resume runs/run: the environment has changed since that run" in said


def test_resuming_with_a_changed_background_driver_is_refused(
    ippo: ModuleType, here: Path, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    shutil.copytree(TRAIN.parent / "agents" / "cities_ippo", here / "driver")
    model = ["--set", f"traffic.model=zoo:{here / 'driver'}"]
    run_until_interrupted(ippo, [*TINY, *LENGTH, *model, "--name", "run"], monkeypatch)
    shutil.copytree(TRAIN.parent / "agents" / "merge_ippo", here / "driver", dirs_exist_ok=True)
    said = refusal("--resume", "runs/run")
    assert "--resume runs/run: the environment has changed since that run" in said


def test_events_of_tensorboard_after_the_checkpoint_are_removed(
    ippo: ModuleType, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    def points(name: str) -> list[tuple[int, str, str]]:
        return sorted(
            (event.step, value.tag, repr(value.tensor.float_val[0]))
            for path in (here / "runs" / name).glob("events.*")
            for event in EventFileLoader(str(path)).Load()
            for value in event.summary.value
            if value.tag not in TIMES
        )

    words = [*TINY, *LENGTH, "--loggers", "tensorboard"]
    assert ippo.main([*words, "--name", "whole"]) == 0
    run_until_interrupted(ippo, [*words, "--name", "cut"], monkeypatch)
    assert ippo.main(["--resume", "runs/cut"]) == 0
    assert points("cut") == points("whole") != []


@pytest.mark.parametrize(
    ("name", "module"),
    [("ppo_gymnasium", "gymnasium"), ("ppo_sb3", "stable_baselines3"), ("ippo_torchrl", "torchrl")],
)
@pytest.mark.filterwarnings("ignore")  # the libraries warn about their own code
def test_a_run_of_a_library_resumes(
    here: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str
) -> None:
    pytest.importorskip(module)
    program, write = load_program(name), Log.write

    def write_and_end(self: Log, row: dict[str, float]) -> None:
        write(self, row)
        if row["updates"] == CUT_AFTER:
            raise Interrupted

    words = ["--env", "ring", "--num-worlds", "2", "--num-steps", "8", "--hidden", "8"]
    words += ["--epochs", "1", "--minibatches", "2", "--checkpoint-updates", "2"]
    words += ["--num-envs", "8"] if name == "ppo_gymnasium" else []
    words += ["--total-agent-steps", "400"]
    assert program.main([*words, "--name", "whole"]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(Log, "write", write_and_end)
        with pytest.raises(Interrupted):
            program.main([*words, "--name", "cut"])
    assert program.main([*words, "--name", "cut"]) == 2
    assert program.main(["--resume", "runs/cut"]) == 0
    assert is_trained(here / "runs" / "cut")
    uncut, resumed = results_of(here / "runs" / "whole"), results_of(here / "runs" / "cut")
    if name == "ippo_torchrl":  # its resumed worlds begin new episodes
        assert (resumed[1][:4], resumed[2]) == (uncut[1][:4], uncut[2])
        rows = (here / "runs" / "cut" / "progress.csv").read_text().splitlines()
        updates = [int(row.partition(",")[0]) for row in rows[1:]]
        assert updates == list(range(1, len(rows)))
        assert len(rows) > 1 + CUT_AFTER
    else:
        assert resumed == uncut
