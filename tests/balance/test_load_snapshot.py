"""Load snapshots that are measured on this machine or read from a file."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.probe import Watch, take_snapshot
from cavmarl.core.errors import ConfigError


def test_a_snapshot_of_this_machine_has_shares_between_0_and_1() -> None:
    found = take_snapshot({1: os.getpid(), 0: None}, interval_s=0.05)
    assert [worker.worker for worker in found.workers] == [0, 1]
    assert all(worker.available for worker in found.workers)
    assert all(0.0 < worker.use.ram < 1.0 for worker in found.workers)
    assert found.origin == "measured"


def test_a_snapshot_without_nvidia_smi_has_no_gpu_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    found = take_snapshot({0: None}, interval_s=0.01)
    assert found.gpu_source == "none"
    assert found.workers[0].use.gpu == 0.0


@pytest.mark.parametrize(
    ("says", "share", "source"),
    [
        ("echo 12; echo 55", 0.55, "nvidia-smi"),
        ("echo '[N/A]'", 0.0, "none"),
        ("echo 55; exit 9", 0.0, "none"),
    ],
)
def test_the_busiest_gpu_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: str, share: float, source: str
) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n{says}\n", encoding="utf-8")
    tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    found = take_snapshot({0: None}, interval_s=0.01)
    assert (found.workers[0].use.gpu, found.gpu_source) == (share, source)


def test_a_worker_that_has_died_is_not_available() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    found = take_snapshot({0: process.pid, 1: None}, interval_s=0.01)
    assert [worker.available for worker in found.workers] == [False, True]


def test_the_load_of_a_worker_excludes_its_own_processor_time() -> None:
    endless = "while True: pass"
    with subprocess.Popen([sys.executable, "-c", endless]) as process:
        try:
            watches = [Watch({0: process.pid, 1: None}), Watch({0: None, 1: None})]
            time.sleep(1.0)
            found = [watch.snapshot() for watch in watches]
        finally:
            process.kill()
    own, other = ([worker.use.cpu for worker in one.workers] for one in found)
    assert all(mine < theirs for mine, theirs in zip(own, other, strict=True))


def test_the_workers_of_a_snapshot_are_sorted() -> None:
    taken = LoadSnapshot(
        (Candidate(1, Utilisation(0.1, 0.2, 0.3), 4), Candidate(0, Utilisation(1 / 3, 0.2))),
        "none",
        "measured",
    )
    assert [worker.worker for worker in taken.workers] == [0, 1]


def test_a_snapshot_with_a_repeated_worker_is_refused() -> None:
    with pytest.raises(ConfigError, match="no workers"):
        idle_snapshot(0)
    with pytest.raises(ConfigError, match="must be named once"):
        LoadSnapshot(idle_snapshot(1).workers * 2, "none", "")


@pytest.mark.parametrize("interval_s", [0.0, -1.0, float("nan")])
def test_an_invalid_measuring_interval_is_refused(interval_s: float) -> None:
    with pytest.raises(ConfigError, match="interval_s"):
        take_snapshot({0: None}, interval_s=interval_s)
