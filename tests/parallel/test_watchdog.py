"""The watchdog of a worker treats a worker that waits for a working child as working."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from cavmarl.parallel.processes import watchdog
from cavmarl.parallel.processes.watchdog import CHECK_S, STILL_CHECKS, Watchdog

PARENT = """
import subprocess, sys
subprocess.run([sys.executable, "-c", sys.argv[1]])
"""


def verdict(child: str) -> str | None:
    """Return the verdict on a process whose child runs the code `child`."""
    words = [sys.executable, "-c", PARENT, f"print(flush=True)\n{child}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            dog = Watchdog(process.pid, 60.0)
            found = None
            for _ in range(3 * STILL_CHECKS):
                time.sleep(CHECK_S)
                found = found or dog.verdict()
            return found
        finally:
            process.kill()


def test_a_process_that_waits_for_its_working_child_is_not_asleep() -> None:
    assert verdict("import os\nwhile os.getppid() > 1: sum(range(100_000))") is None


def test_a_process_whose_child_also_sleeps_is_asleep() -> None:
    found = verdict("import time; time.sleep(8)")
    assert found is not None
    assert "asleep" in found


@pytest.mark.parametrize(("state", "is_at_work"), [("R", True), ("D", True), ("S", False)])
def test_a_child_that_waits_for_the_processor_is_not_asleep(
    monkeypatch: pytest.MonkeyPatch, state: str, is_at_work: bool
) -> None:
    """A child in state R may not run for seconds if other programs use the processor."""
    monkeypatch.setattr(watchdog, "read_state", lambda pid: ("S" if pid == 1 else state, 7))
    monkeypatch.setattr(watchdog, "descendants", lambda pid: [2])
    dog = Watchdog(1, 60.0)
    found = [dog.verdict() for _ in range(3 * STILL_CHECKS)]
    assert (found[-1] is None) == is_at_work
