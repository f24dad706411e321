"""An interrupted five_seeds.py leaves no process, prints no traceback and can be resumed."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.support.training import TRAIN, load_program

pytest.importorskip("torch", reason="needs the extra: train")

WAIT_MS = 20_000  # time in which a process must end


@pytest.mark.parametrize("ended_by", [signal.SIGKILL, signal.SIGINT])
def test_trainings_end_when_the_program_ends(tmp_path: Path, ended_by: signal.Signals) -> None:
    config = tmp_path / "long.yaml"
    config.write_text("env: ring\nnum_envs: 2\ntotal_agent_steps: 1000000000\n")
    words = ["--config", "long.yaml", "--seeds", "0", "1", "--jobs", "2"]
    errors = tmp_path / "errors"
    # A shell makes its background programs ignore SIGINT, and children inherit this.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with errors.open("w") as file:  # the trainings would keep a pipe open
        program = subprocess.Popen(
            [sys.executable, str(TRAIN / "five_seeds.py"), *words],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
        )
    signal.signal(signal.SIGINT, before)
    with program:
        try:
            assert program.stdout
            said = {program.stdout.readline() for _ in range(2)}
            assert said == {f"training seed {seed} on ring\n" for seed in (0, 1)}
            trainings = [
                os.pidfd_open(child.pid) for child in psutil.Process(program.pid).children()
            ]
            assert len(trainings) == 2
            program.send_signal(ended_by)
            ended = [has_ended(training) for training in trainings]
            assert ended == [True, True], "a training continues"
            program.wait(WAIT_MS / 1000)
        finally:
            program.kill()  # also after a failed assertion
    assert "Traceback" not in errors.read_text()
    if ended_by is signal.SIGINT:
        assert program.returncode == 130
        assert errors.read_text().startswith("interrupted: the same command resumes")
    else:
        assert program.returncode == -ended_by


def has_ended(pidfd: int) -> bool:
    """Return whether a process ends within the time limit; kill a process that does not."""
    ends = select.poll()
    ends.register(pidfd, select.POLLIN)
    ended = bool(ends.poll(WAIT_MS))
    with suppress(ProcessLookupError):
        signal.pidfd_send_signal(pidfd, signal.SIGKILL)
    os.close(pidfd)
    return ended


def test_an_interrupted_seed_continues(tmp_path: Path) -> None:
    program = load_program("five_seeds")
    commands: list[list[str]] = []

    class FakeChildren:
        def run(self, command: list[str], said: str) -> int:
            commands.append(command)
            return 0

    words = ["--config", "long.yaml", "--env", "ring", "--out", str(tmp_path)]
    (args,) = program.parse_args(words)
    (tmp_path / "seed_1").mkdir()
    (tmp_path / "seed_1" / "checkpoint.pt").touch()
    for seed in (0, 1):
        program.train_seed(args, seed, FakeChildren())
    assert commands[0][-4:] == ["--name", "seed_0", "--env", "ring"]
    assert commands[1][-2:] == ["--resume", str(tmp_path / "seed_1")]
