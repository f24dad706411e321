"""Processes that end with the one that has started them, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def die_with_parent() -> None:
    """Let the system kill this process when the thread that started it ends; Linux alone can."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


# Runs in a fresh interpreter: code between fork and exec may hang where there are threads.
_WRAPPER = """
import ctypes, os, sys
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
