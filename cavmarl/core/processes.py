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
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from cavmarl.core.errors import WorkerError

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def is_fork(pid: int) -> bool:
    """Whether this process is a fork of the one that has made something, `pid`."""
    return os.getpid() != pid


def refuse_fork(pid: int, things: str) -> None:
    """See that this process may use `things`, which process `pid` has made.

    Raises:
        WorkerError: it is a fork of that one: both would speak to the same process, or write the
            same file.
    """
    if is_fork(pid):
        raise WorkerError(
            f"{things} are those of process {pid}, and this is a fork of it: make the environment "
            "here, after the fork"
        )


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


def start_python(
    words: Sequence[str], env: Mapping[str, str] | None = None, **options: Any
) -> subprocess.Popen[Any]:
    """Start a Python that ends with this process and finds the modules that this one finds.

    A module in the working directory is not found there, unless this process finds it.

    `words`: `-m` and a module, or `-c` and a program, and arguments. `env`: variables of the
    environment beside those of this process.
    """
    here = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([here, *(place for place in sys.path if place)])
    return start_dying_with_process(
        [sys.executable, "-P", *words],
        env={**os.environ, **(env or {}), "PYTHONPATH": path},
        **options,
    )


@cache
def _staying_thread(_: int) -> ThreadPoolExecutor:
    """One for each process: a fork does not take it along."""
    return ThreadPoolExecutor(1, "starts-processes")
