"""Recordings of runs that were killed."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

from cavmarl.recordings.recording import Recording
from tests.support.forked_processes import ForkedProcess


def killed_recording(path: Path, program: str, parts: int) -> Recording:
    """Kill a recording program after it has written some parts, and return the recording.

    Args:
        path: path of the recording, the first argument of the program.
        program: text of the program, which prints `begun` and never ends.
        parts: number of parts of the first world before the kill.
    """
    with ForkedProcess(["-c", program, str(path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"begun\n"
        until = time.monotonic() + 30.0
        while len(found := list(path.glob("world-0/frames/0*.parquet"))) < parts:
            if time.monotonic() > until:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    assert len(found) >= parts
    recording = Recording.open(path)
    assert not recording.is_whole
    return recording
