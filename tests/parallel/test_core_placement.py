"""Processes that run on the same core are assigned to different cores."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from cavmarl.parallel.processes.core_placement import homes, keep_apart
from cavmarl.parallel.processes.process_barrier import usable_cores


@pytest.mark.parametrize(
    ("cores", "usable", "expected"),
    [
        ([2, 2], {0, 2}, [2, 0]),
        ([1, 1, 3, 3], {0, 1, 2, 3}, [1, 0, 3, 2]),
        ([0, 5], {0, 1}, [0, 1]),
        ([0, 0, 1], {0, 1}, []),
        ([0, 1], {0, 1}, [0, 1]),
    ],
)
def test_each_process_gets_its_own_core_if_there_are_enough(
    cores: list[int], usable: set[int], expected: list[int]
) -> None:
    assert homes(cores, usable) == expected


@pytest.fixture
def sleepers() -> Iterator[list[int]]:
    """Yield the pids of two sleeping processes."""
    command = [sys.executable, "-c", "import time; time.sleep(60)"]
    processes = [subprocess.Popen(command) for _ in range(2)]
    yield [process.pid for process in processes]
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.skipif(len(usable_cores()) < 2, reason="this machine has one core")
def test_processes_on_one_core_are_separated(sleepers: list[int]) -> None:
    usable = usable_cores()
    first, second, *_ = sorted(usable)
    keep_apart(sleepers, [first, second])
    keep_apart(sleepers, [-1, -1])
    assert [os.sched_getaffinity(pid) for pid in sleepers] == [usable, usable]
    keep_apart(sleepers, [second, second])
    assert [os.sched_getaffinity(pid) for pid in sleepers] == [usable - {first}, usable - {second}]


def test_a_dead_process_is_ignored() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    keep_apart([process.pid, process.pid], [min(usable_cores())] * 2)
