"""Processes that end with the one that has started them, however that ends.

Ctrl-C in a terminal is for that one, which sees to the rest: they do not hear it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def die_with_parent() -> None:
    """Let the system kill this process when the thread that started it ends; Linux alone can."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


# Runs in a fresh interpreter: code between fork and exec may hang where there are threads.
_WRAPPER = """
import ctypes, os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
ctypes.CDLL(None).prctl(int(sys.argv[1]), int(sys.argv[2]), 0, 0, 0)
if os.getppid() == int(sys.argv[3]):
    os.execv(sys.argv[4], sys.argv[4:])
"""


def dying_with_parent(command: Sequence[str]) -> list[str]:
    """A command that runs another one, a path and its arguments, which ends with this process."""
    if sys.platform != "linux":
        return list(command)
    numbers = (_PR_SET_PDEATHSIG, int(signal.SIGKILL), os.getpid())
    return [sys.executable, "-I", "-S", "-c", _WRAPPER, *map(str, numbers), *command]


def start_dying_with_process(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a command that ends with this process, not with the thread that asks for it.

    The system watches the thread that starts a process: that is the main one, or one that stays.
    """

    def start() -> subprocess.Popen[Any]:
        return subprocess.Popen(dying_with_parent(command), **options)

    if threading.current_thread() is threading.main_thread():
        return start()
    return _staying_thread(os.getpid()).submit(start).result()


@cache
def _staying_thread(_: int) -> ThreadPoolExecutor:
    """One for each process: a fork does not take it along."""
    return ThreadPoolExecutor(1, "starts-processes")
