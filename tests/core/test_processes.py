"""Started processes: they ignore Ctrl-C and end with the process that started them."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.core.processes import start_dying_with_process, start_python
from cavmarl.evaluate.subprocess_calls import call_in_fresh_process

READY = "print('ready', flush=True); input(); print('heard nothing', flush=True)"


def test_a_started_process_ignores_an_interrupt() -> None:
    process = start_dying_with_process(
        [sys.executable, "-c", READY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline() == "heard nothing\n"
    assert process.returncode == 0


@pytest.mark.usefixtures("fresh_processes")
def test_modules_of_the_working_directory_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("cavmarl", "numba", "json"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('it was run')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    for words in (["-c", "import json, cavmarl"], ["-m", "json.tool", "--help"]):
        assert start_python(words, stdout=subprocess.DEVNULL).wait() == 0
    assert call_in_fresh_process("a length", len, [1, 2]) == 2


def test_a_process_ends_even_if_its_caller_is_killed_during_the_start() -> None:
    caller = (
        "import os, signal, sys\n"
        "from cavmarl.core.processes import start_dying_with_process as start\n"
        "process = start([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", caller], stdout=subprocess.PIPE, text=True)
    try:
        pidfd = os.pidfd_open(int(done.stdout))
    except ProcessLookupError:  # the process has ended
        return
    try:
        assert select.select([pidfd], [], [], 10.0)[0]
    finally:
        os.close(pidfd)
